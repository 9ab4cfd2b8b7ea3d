# make reproduce   everything, from an empty checkout to report/
# make test        lint, formatting, types, layers, tests
# make bench       speed, memory and start beside JAX and others (an extra, installed on demand)
# make fuzz        random recipes, logs and faults of the machine (SECONDS=120 SEED=0)
# make sanitize    exported C of every checkpoint under AddressSanitizer and UBSan
# make docs        this documentation as a site, with the API reference: site/index.html
# Each sets up .venv first. QUICK=1 makes reproduce a matter of five minutes.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
export OMP_NUM_THREADS ?= 1
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: setup reproduce test lint fuzz sanitize docs bench clean

setup: $(VENV)/.ready

$(VENV)/.ready: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "$(PYTHON) is `$(PYTHON) --version`, expected Python 3.11 or later (make PYTHON=...)"; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[test,docs,search]'
	touch $@

reproduce: setup
	$(BIN)/python -m training.reproduce $(if $(QUICK),--quick)

test: lint
	$(BIN)/python -m pytest -n 2 --dist loadfile

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo --no-cache

fuzz: setup
	$(BIN)/python tests/fuzz/campaign.py --seconds $(or $(SECONDS),120) --seed $(or $(SEED),0)

sanitize: setup
	$(BIN)/python tests/export/sanitize.py

docs: setup
	NO_MKDOCS_2_WARNING=true $(BIN)/mkdocs build --strict --quiet

bench: setup
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[bench]'
	env -u OMP_NUM_THREADS $(BIN)/python -m difffilter bench --out report/bench $(if $(QUICK),--quick)

clean:
	rm -rf $(VENV) report runs site
