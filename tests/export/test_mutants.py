"""The self-test of exported C fails for a C that is wrong in one place, and nowhere else."""

from __future__ import annotations

import copy
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from mutants import mutated

from difffilter.errors import InputError
from difffilter.export.c99 import export_c
from difffilter.filters.recipe import Recipe
from difffilter.scenario.checkpoint import Checkpoint
from difffilter.scenario.scenario import load_scenario, read_scenario

CC = shutil.which("cc") or shutil.which("gcc")
pytestmark = pytest.mark.skipif(CC is None, reason="no C compiler")
#: Anchors in a national grid.
GRID = """
schema = 1
name = "grid"
title = "Ranges in a national grid"
[sensors.range]
kind = "range"
stations = [[500000.0, 5400000.0], [500040.0, 5400000.0],
            [500040.0, 5400030.0], [500000.0, 5400030.0]]
[parameters.motion.acceleration]
value = 0.5
tuned = true
[parameters.range.sigma]
value = 0.2
tuned = true
[systems.ekf]
"""
ORIGIN = (500000.0, 5400000.0)


def published(scenario: str, system: str) -> Checkpoint:
    loaded = load_scenario(scenario)
    filter = loaded.system(system)
    assert isinstance(filter, Recipe)
    return Checkpoint(loaded, system, filter.published())


@pytest.fixture
def grid(tmp_path: Path) -> Checkpoint:
    """No world and no start.sigma: as for a filter of recordings that starts by itself."""
    path = tmp_path / "grid.toml"
    path.write_text(GRID)
    return published(str(path), "ekf")


def compiled(folder: Path, *flags: str) -> subprocess.CompletedProcess[str]:
    command = [str(CC), "-std=c99", "-O0", *flags, "one.c", "one_test.c", "-o", "check", "-lm"]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def passes(folder: Path, number: int = 0) -> bool:
    environment = os.environ | {"MUTANT": str(number)}
    done = subprocess.run(["./check"], cwd=folder, env=environment, check=False,
                          stdout=subprocess.DEVNULL)  # fmt: skip
    assert done.returncode in (0, 1)
    return done.returncode == 0


@pytest.mark.parametrize(
    ("case", "every", "flags"),
    [(("uwb-ranges", "robust"), 7, []), (("uwb-ranges", "robust"), 7, ["-DONE_FLOAT"]),
     (("gate-lockout", "gated"), 5, [])],
    ids=["double", "float", "gate"],
)  # fmt: skip
def test_a_wrong_sign_operation_or_dropped_term_anywhere_fails(
    case: tuple[str, str], every: int, flags: list[str], tmp_path: Path
) -> None:
    """What leads to a gate is seen in its decisions alone: rows lie next to its bound."""
    export_c(published(*case), tmp_path, "one")
    text, told = mutated((tmp_path / "one.c").read_text())
    (tmp_path / "one.c").write_text(text)
    made = compiled(tmp_path, *flags)
    assert made.returncode == 0, made.stderr
    assert passes(tmp_path)
    numbers = range(1, len(told) + 1, every)
    assert len(numbers) > 100
    # Guards against a division by zero, say, matter where none is near.
    left = [told[n - 1] for n in numbers if passes(tmp_path, n)]
    assert len(left) < (0.02 if every == 7 else 0.03) * len(numbers), left


@pytest.mark.parametrize("flags", [[], ["-DONE_FLOAT"]], ids=["double", "float"])
def test_in_a_national_grid_a_flipped_velocity_or_a_wrong_noise_fails(
    grid: Checkpoint, flags: list[str], tmp_path: Path
) -> None:
    export_c(grid, tmp_path, "one", origin=ORIGIN)
    assert compiled(tmp_path, "-Werror", *flags).returncode == 0
    assert passes(tmp_path)
    header = tmp_path / "one.h"
    assert "ONE_ORIGIN[2] = {500000.0, 5400000.0};" in header.read_text()
    source = tmp_path / "one.c"
    text = source.read_text()
    flipped = re.sub(r"(after\.mean\[2\] = )", r"\1-", text)
    wild = re.sub(r"(D_RANGE_INDEPENDENT.*= \{)", r"\g<1>1e6 * ", text)
    for wrong in (flipped, wild):
        assert wrong != text
        source.write_text(wrong)
        assert compiled(tmp_path, *flags).returncode == 0
        assert not passes(tmp_path)


def test_without_an_origin_float_is_refused_there_and_double_goes(
    grid: Checkpoint, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=r"float has too few digits .*--origin"):
        export_c(grid, tmp_path / "c", "one", single=True)
    assert not (tmp_path / "c").exists()
    export_c(grid, tmp_path, "one")
    assert compiled(tmp_path).returncode == 0
    assert passes(tmp_path)
    made = compiled(tmp_path, "-DONE_FLOAT")
    assert made.returncode != 0
    assert "export relative to an origin" in made.stderr


def test_an_origin_of_other_dimensions_is_refused(grid: Checkpoint, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="origin: found 3 coordinates, expected 2"):
        export_c(grid, tmp_path / "c", "one", origin=(1.0, 2.0, 3.0))


def test_no_text_of_a_file_becomes_code(tmp_path: Path) -> None:
    document = copy.deepcopy(dict(load_scenario("gate-lockout").document))
    hostile = "*/ int x; /* ??/ \\ */ #error x"
    for component in document["parameters"].values():
        for parameter in component.values():
            parameter["source"] = hostile
    loaded = read_scenario(document, Path("changed.toml"))
    filter = loaded.system("gated")
    assert isinstance(filter, Recipe)
    export_c(Checkpoint(loaded, "gated", filter.published()), tmp_path, "one")
    assert compiled(tmp_path, "-Wall", "-Wextra", "-Werror", "-pedantic").returncode == 0
    assert "int x;" in (tmp_path / "one.h").read_text()
    for path in tmp_path.glob("one*.[ch]"):
        text = path.read_text()
        assert text.count("/*") == text.count("*/")
        assert "??" not in text


SANITIZE = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g"]


@pytest.mark.parametrize(
    ("scenario", "system"),
    [("uwb-ranges", "robust"), ("gate-lockout", "gated-inflate"), ("airborne-bearing", "gated"),
     ("airport-mlat-intermittent", "huber")],
)  # fmt: skip
def test_no_sanitizer_has_anything_to_say(scenario: str, system: str, tmp_path: Path) -> None:
    export_c(published(scenario, system), tmp_path, "one")
    made = compiled(tmp_path, *SANITIZE)
    if made.returncode and "sanitize" in made.stderr + "asan":
        pytest.skip("no sanitizers here")
    assert passes(tmp_path)
