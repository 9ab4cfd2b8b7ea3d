"""The documentation: its examples run, and it mentions every key that the readers accept."""

from __future__ import annotations

import ast
import doctest
import importlib.util
import pkgutil
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import pytest
import torch
from cli_helpers import process

import difffilter
from difffilter import (
    Checkpoint,
    CoordinatedTurn,
    InnovationMatching,
    PredictionCorrection,
    StrongTracking,
)
from difffilter.adaptation import scaling
from difffilter.adaptation.credibility import Credibility
from difffilter.adaptation.registry import ADAPTATIONS
from difffilter.baselines.registry import BASELINES
from difffilter.comparison.comparison import compare
from difffilter.core.beliefs import Record
from difffilter.engine.build import compiler
from difffilter.export.c99 import export_c
from difffilter.filters.filter import RULES, STANDARDISATIONS
from difffilter.logs.family import ROLES
from difffilter.motions import blocks as motion
from difffilter.motions.registry import MOTIONS
from difffilter.registry import Registry
from difffilter.robust import gate, groups, recovery
from difffilter.scenario import (
    checkpoint,
    faults,
    options,
    scenario,
    starting,
    table,
)
from difffilter.scenario.scenario import load_scenario
from difffilter.scenario.settings import OPTIMISERS, TuneSettings
from difffilter.scenario.simulation import simulate
from difffilter.scoring import metrics
from difffilter.scoring.losses import LOSSES
from difffilter.sensors.registry import SENSORS
from difffilter.tuning.loop import tune
from difffilter.weights.registry import WEIGHTS

ROOT = Path(__file__).parents[2]
REGISTRIES: tuple[Registry[Any], ...] = (
    WEIGHTS, ADAPTATIONS, BASELINES, LOSSES, SENSORS, MOTIONS,
)  # fmt: skip
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
EXAMPLE = DOCS / "example.toml"
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
HEADING = re.compile(r"^#+ (.*)$", re.MULTILINE)
SMALL = {"trajectories": 8, "validation": 4, "test": 4, "batch": 4}


def page_id(page: Path) -> str:
    """A page's path without suffix, for the names of tests."""
    return page.relative_to(ROOT).with_suffix("").as_posix().removeprefix("docs/")


class Block(NamedTuple):
    """A fenced block: language, text, and the line it begins at."""

    language: str
    text: str
    line: int


def blocks(page: Path) -> list[Block]:
    """Fenced blocks of a page, in order."""
    text = page.read_text(encoding="utf-8")
    return [
        Block(found[1], found[2], text.count("\n", 0, found.start()) + 1)
        for found in FENCE.finditer(text)
    ]


def without_code(page: Path) -> str:
    """A page without its fenced blocks."""
    return FENCE.sub("", page.read_text(encoding="utf-8"))


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as forges make them."""
    found = HEADING.findall(without_code(page))
    return {re.sub(r"[^\w\- ]", "", text.strip().lower()).replace(" ", "-") for text in found}


def sections(page: Path) -> dict[str, str]:
    """Text of each section without its subsections, by heading without backticks."""
    parts = re.split(r"^#+ (.*)$", page.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {
        name.replace("`", ""): text for name, text in zip(parts[1::2], parts[2::2], strict=True)
    }


# Examples


@pytest.fixture
def only_built_in() -> Iterator[None]:
    """Take back what an example registers."""
    known = [(registry, set(registry)) for registry in REGISTRIES]
    yield
    for registry, names in known:
        for name in set(registry) - names:
            registry.remove(name)


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_examples_run(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, only_built_in: None
) -> None:
    """A page's files, commands and Python blocks, in order, in one folder and one namespace."""
    shutil.copytree(DOCS, tmp_path / "docs")
    monkeypatch.chdir(tmp_path)
    module = ModuleType(f"docs_{page.stem.replace('-', '_')}")
    monkeypatch.setitem(sys.modules, module.__name__, module)  # dataclasses look there
    for block in blocks(page):
        if block.language == "toml":
            title = re.match(r"# ([\w.-]+\.toml)", block.text)
            if title:
                (tmp_path / title[1]).write_text(block.text, encoding="utf-8")
        elif block.language in ("console", "bash"):
            for line in block.text.replace("\\\n", " ").splitlines():
                if line.startswith("$ difffilter "):
                    done = process(*shlex.split(line)[2:], cwd=tmp_path)
                    assert done.returncode == 0, f"{page.name}: {line}\n{done.stderr}"
        elif block.language == "python" and (own := re.match(r"# (\w+\.py)\n", block.text)):
            (tmp_path / own[1]).write_text(block.text, encoding="utf-8")
        elif block.language == "python":
            source = "\n" * block.line + block.text  # so that a traceback has the page's lines
            exec(compile(source, str(page), "exec", dont_inherit=True), vars(module))


def test_every_block_has_a_language_that_is_run_or_known() -> None:
    for page in PAGES:
        for block in blocks(page):
            where = f"{page.name}:{block.line}"
            assert block.language in ("python", "console", "toml", "text"), where


def test_recipes_are_faults_that_load() -> None:
    """Each recipe works by itself in the example's world."""
    recipes = sections(DOCS / "scenario-files.md")["Fault recipes"]
    texts = [found[2] for found in FENCE.finditer(recipes)]
    assert len(texts) >= 6
    for text in texts:
        for name, fault in tomllib.loads(text)["faults"].items():
            keys = {"world.steps": 50, "worlds": []}
            changed = load_scenario(EXAMPLE, {"faults": {name: fault}, **keys})
            before = simulate(load_scenario(EXAMPLE, {"faults": {}, **keys}), 4)
            after = simulate(changed, 4)
            assert not after.z.equal(before.z), name


def test_parameter_recipes_load() -> None:
    text = sections(DOCS / "scenario-files.md")["[parameters.COMPONENT.NAME]"]
    for found in FENCE.finditer(text):
        values = {
            f"parameters.{component}.{name}": entry
            for component, group in tomllib.loads(found[2])["parameters"].items()
            for name, entry in group.items()
        }
        load_scenario(EXAMPLE, values).system("robust").prepare()


def test_groups_of_a_system_load() -> None:
    text = sections(DOCS / "scenario-files.md")["[systems.NAME]"]
    for found in FENCE.finditer(text):
        for name, changes in tomllib.loads(found[2])["systems"].items():
            changed = load_scenario(EXAMPLE, {f"systems.{name}.{k}": v for k, v in changes.items()})
            assert changed.system(name).grouped


def test_federated_systems_load_and_run() -> None:
    text = sections(DOCS / "scenario-files.md")["Federated filters and credibility"]
    (block,) = FENCE.finditer(text)
    document = tomllib.loads(block[2])
    overrides = {f"systems.{name}": system for name, system in document["systems"].items()}
    for name, entry in document["parameters"]["credibility"].items():
        overrides[f"parameters.credibility.{name}"] = entry
    changed = load_scenario(EXAMPLE, overrides)
    rows = compare(changed, trajectories=2, systems=tuple(document["systems"])).rows
    assert [row.system for row in rows] == list(document["systems"])
    assert all(changed.system(name).federation for name in document["systems"])


@pytest.mark.parametrize("name", ["Adaptations", "Distributed fusion", "Pooled sensors"])
def test_systems_of_a_section_load_and_run(name: str) -> None:
    """A section's tables, added to the example, whose other systems keep their sensors."""
    (block,) = FENCE.finditer(sections(DOCS / "scenario-files.md")[name])
    document = tomllib.loads(block[2])
    example = load_scenario(EXAMPLE)
    overrides: dict[str, Any] = {
        f"systems.{system}.sensors": ["range", "fix"] for system in example.systems
    }
    for table_name in ("sensors", "systems"):
        overrides |= {f"{table_name}.{k}": v for k, v in document.get(table_name, {}).items()}
    for component, group in document.get("parameters", {}).items():
        overrides |= {f"parameters.{component}.{k}": v for k, v in group.items()}
    changed = load_scenario(EXAMPLE, overrides)
    rows = compare(changed, trajectories=2, systems=tuple(document["systems"])).rows
    assert [row.system for row in rows] == list(document["systems"])


def test_the_example_loads_simulates_and_tunes() -> None:
    example = load_scenario(EXAMPLE)
    log = simulate(example, 2, seed=3)
    assert log.z.shape == (60, 2, 6)
    assert not log.present.all()
    settings = SMALL | {"steps": 2, "evaluate_every": 1}
    result = tune(example, settings=settings)
    assert len(result.history) == 3
    assert result.held_out is not None
    assert set(result.held_out.rows[0].per_scene) == {"straight", "turn", "slowing"}
    assert {row.system for row in compare(example, trajectories=2).rows} == set(example.systems)


@pytest.mark.skipif(compiler() is None, reason="no C compiler")
def test_the_c_example_runs_as_the_tracker(tmp_path: Path) -> None:
    (program,) = [b.text for b in blocks(DOCS / "deployment.md") if "#include" in b.text]
    (tmp_path / "example.c").write_text(program, encoding="utf-8")
    example = load_scenario(EXAMPLE)
    frozen = Checkpoint(example, "robust", example.system("robust").published())
    export_c(frozen, tmp_path, "launch")
    command = [str(compiler()), "-std=c99", "-Wall", "-Werror", "-pedantic", "example.c"]
    subprocess.run([*command, "launch.c", "-lm"], cwd=tmp_path, check=True)
    done = subprocess.run(["./a.out"], cwd=tmp_path, capture_output=True, text=True, check=True)
    start = torch.diag(torch.tensor([4.0, 4.0, 1.0, 1.0]))
    tracker = frozen.tracker([40.0, 60.0, 4.0, 0.0], start)
    record = tracker.step([287.1, 369.4, 169.5, None, 42.0, 61.0], dt=0.5)
    expected = [*tracker.belief.mean[:2].tolist(), float(record.weight[0])]
    assert [float(word) for word in done.stdout.split()] == pytest.approx(expected, rel=1e-8)


# Links and names


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)]+)\)", without_code(page)):
        path, _, anchor = target.partition("#")
        other = page.parent / path if path else page
        assert other.is_file(), target
        if anchor:
            assert anchor in anchors(other), target


def test_every_page_is_in_the_index() -> None:
    text = (DOCS / "index.md").read_text(encoding="utf-8")
    for page in PAGES:
        own = page.parent / "index.md"
        listed = own.read_text(encoding="utf-8") if own.is_file() else text
        assert page.name in ("README.md", "index.md") or f"({page.name})" in listed


def test_every_public_name_is_in_the_library_page() -> None:
    names = sections(DOCS / "library.md")["All names"]
    for name in difffilter.__all__:
        assert f"`{name}`" in names, name


def test_every_public_function_and_class_has_a_docstring() -> None:
    for name in difffilter.__all__:
        thing = getattr(difffilter, name)
        if callable(thing):
            assert (thing.__doc__ or "").strip(), name
            # A dataclass without one would show its signature.
            assert not (thing.__doc__ or "").startswith(f"{name}("), name


def test_records_and_checkpoints_are_described_whole() -> None:
    record = sections(DOCS / "design.md")["The record"]
    for field in (*Record._fields, "innovation_variance", "nis"):
        assert f"`{field}`" in record, field
    layout = sections(DOCS / "checkpoints.md")["Format"]
    for key in (*checkpoint._KEYS, *checkpoint._PARAMETER_KEYS):
        assert f"`{key}`" in layout, key
    tuning = sections(DOCS / "tuning.md")["The losses"]
    for loss in LOSSES:
        assert f"`{loss}`" in tuning, loss


# Scenario files


LAYOUT: dict[str, Any] = {
    "time": "t", "format": "unix", "zone": "UTC", "separator": ";", "decimal": ",",
    "by": "anchor", "value": "metres", "beyond": "missing", "sort": False, "ignore": ["*"],
    "missing": [-1, "none"], "columns": {"a": "b"}, "units": {"b": "km"}, "relative": {"b": "c"},
}  # fmt: skip
#: Tables that the example does not have, so that every reader reads every key.
RECORDED: dict[str, Any] = {
    "schema": 1,
    "name": "recorded",
    "title": "all that a world would exclude",
    "axes": 2,
    "sensors": {
        "tdoa": {
            "kind": "tdoa",
            "stations": [[0.0, 0.0], [9.0, 0.0], [0.0, 9.0], [9.0, 9.0]],
            "noise": {"schedule": [{"first": 1, "last": 2, "sigma": 2.0}]},
        }
    },
    "parameters": {"motion": {"acceleration": {"value": 1.0}}},
    "systems": {"ekf": {}},
    "references": [{"run": "a", "system": "b", "rmse": 1.0, "source": "c"}],
    "worlds": [{"name": "night", "logs": ["night-*"]}],
    "log": {"gap": 1.0, **LAYOUT, "files": {"radar": {"file": "{run}_radar.csv", **LAYOUT}}},
}
#: How the second part of these tables' paths is written in a heading.
NAMED = {"sensors": "NAME", "faults": "NAME", "systems": "NAME", "runs": "NAME"}
READERS = {
    "text", "flag", "number", "integer", "numbers", "nested", "points", "names", "table",
    "tables", "take", "_numbers", "label",
}  # fmt: skip


def heading(path: str) -> str:
    """The section that describes a table of the document."""
    if not path:
        return "Top level"
    parts = re.sub(r"\[\d+\]", "", path).split(".")
    if parts[0] in NAMED and len(parts) > 1:
        parts[1] = NAMED[parts[0]]
    if parts[-1] == "motion":
        return "[motion]"
    if parts == ["world", "platform", "segments"]:
        return "[[world.segments]]"
    if parts[0] == "systems" and parts[2:3] == ["modes"] and len(parts) > 3:
        parts[3] = "MODE"
    if parts[:2] == ["log", "files"] and len(parts) == 3:
        parts[2] = "NAME"
    if parts[0] == "parameters" and len(parts) == 3:
        parts[1:] = ["COMPONENT", "NAME"]
    name = ".".join(parts)
    return f"[[{name}]]" if path.endswith("]") else f"[{name}]"


@pytest.fixture
def accepted(monkeypatch: pytest.MonkeyPatch) -> set[tuple[str, str]]:
    """Pairs (section, key) that the readers ask for, over files that hold every table."""
    found: set[tuple[str, str]] = set()
    finish = table.Table.finish

    def noted(self: table.Table) -> None:
        section = heading(self.path)
        for key in self._read:
            # A mode has the options of a system, which describes them.
            mode = section == "[systems.NAME.modes.MODE]" and key in options.OPTIONS
            found.add(("[systems.NAME]" if mode else section, key))
        finish(self)

    monkeypatch.setattr(table.Table, "finish", noted)
    load_scenario(EXAMPLE)
    for kind in ("constant", "uniform"):
        numbers = {"constant": {"value": 1.0}, "uniform": {"low": 0.0, "high": 1.0}}[kind]
        load_scenario(EXAMPLE, {"world.acceleration": {"distribution": kind, **numbers}})
    scenario.read_scenario(RECORDED, Path("recorded.toml"))
    for name in difffilter.scenario_names():
        load_scenario(name)
    return found


def test_every_key_is_documented_in_its_section(accepted: set[tuple[str, str]]) -> None:
    described = sections(DOCS / "scenario-files.md")
    expected = accepted | {("Top level", "extends")}
    # The loss table's keys are losses; [parameters] and [runs] hold the user's own names.
    missing = [
        (section, key)
        for section, key in sorted(expected)
        if section != "[tuning.loss]" and f"`{key}`" not in described.get(section, "")
    ]
    assert not missing


def test_the_files_that_are_read_hold_every_key(accepted: set[tuple[str, str]]) -> None:
    """Every key in the readers' source was asked for: none hides in a branch not taken."""
    keys = {key for _, key in accepted}
    for path in Path(scenario.__file__).parent.glob("*.py"):
        for key in keys_in(path.read_text(encoding="utf-8")):
            assert key in keys, f"{path.name}: {key}"


def keys_in(source: str) -> Iterator[str]:
    """Constant keys that a module reads from tables."""
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Call):
            continue
        function = node.func
        name = function.attr if isinstance(function, ast.Attribute) else ""
        name = function.id if isinstance(function, ast.Name) else name
        for argument in node.args[:1]:
            if (
                name in READERS
                and isinstance(argument, ast.Constant)
                and isinstance(argument.value, str)
            ):
                yield argument.value


def test_every_choice_is_documented() -> None:
    text = without_code(DOCS / "scenario-files.md")
    choices = (
        *SENSORS, *faults.KINDS, *WEIGHTS, *LOSSES, *gate.ACTIONS, *motion.NOISES,
        *STANDARDISATIONS, *RULES, *MOTIONS, *options.FUSIONS, "filter", *BASELINES,
        *ADAPTATIONS, *(unit for units in table.MEASURES.values() for unit in units),
        *groups.SCOPES, *groups.DISTANCES, *recovery.RECOVERIES, *starting.STARTS, *metrics.SCORES,
        *OPTIMISERS, *ROLES, "constant", "uniform", "normal", "sigma",
    )  # fmt: skip
    for choice in choices:
        assert re.search(rf'`"?{re.escape(choice)}"?`', text), choice


def test_every_weight_is_described_with_its_parameters() -> None:
    functions = sections(DOCS / "weights.md")["The functions"]
    for weight in WEIGHTS.values():
        row = re.search(rf"^\| `{weight.name}` \|.*$", functions, re.MULTILINE)
        assert row, weight.name
        for parameter in weight.parameters:
            assert f"`{parameter.name}` {parameter.tensor().tolist()}" in row[0], parameter.name


def test_tuning_defaults_are_documented() -> None:
    text = sections(DOCS / "scenario-files.md")["[tuning]"]
    for key, field in TuneSettings.__dataclass_fields__.items():
        row = re.search(rf"^\| `{key}` \|.*$", text, re.MULTILINE)
        assert row, key
        if key not in ("system", "loss"):
            default = field.default
            shown = str(list(default)) if isinstance(default, tuple) else str(default)
            assert f"| {shown} |" in row[0], key


def test_every_parameter_and_its_default_is_documented() -> None:
    text = sections(DOCS / "scenario-files.md")["[parameters.COMPONENT.NAME]"]
    parameters = [p for weight in WEIGHTS.values() for p in weight.parameters]
    parameters += gate.Gate().parameters
    parameters += recovery.Recovery().parameters
    parameters += scaling.InnovationScaling().parameters
    parameters += Credibility(((0,), (1,)), axes=1).parameters
    for plug_in in (InnovationMatching(), PredictionCorrection(), StrongTracking()):
        parameters += plug_in.parameters
    parameters += [p for p in CoordinatedTurn().parameters if p.name == "motion.turn_rate"]
    for parameter in parameters:
        row = next((r for r in text.splitlines() if f"`{parameter.name}`" in r), "")
        assert row, parameter.name
        value = parameter.value
        for number in value if isinstance(value, tuple) else (value,):
            assert re.search(rf"(?<![\d.]){re.escape(f'{number:.4g}')}", row), parameter.name
    for name in difffilter.scenario_names():
        for declared in load_scenario(name).declarations():
            *_, component, field = declared.split(".")  # a mode's own: MODE.COMPONENT.NAME
            parameter = f"{component}.{field}"
            assert f"`{parameter}`" in text or f"`NAME.{field}`" in text, parameter


# Docstrings


def modules_with_examples() -> list[str]:
    """Modules of the library whose source has examples."""
    names = [info.name for info in pkgutil.walk_packages(difffilter.__path__, "difffilter.")]
    found = []
    for name in names:
        if name != "difffilter.__main__":
            spec = importlib.util.find_spec(name)
            if spec and spec.origin and ">>> " in Path(spec.origin).read_text(encoding="utf-8"):
                found.append(name)
    return found


@pytest.mark.parametrize("name", modules_with_examples())
def test_docstring_examples(name: str) -> None:
    result = doctest.testmod(importlib.import_module(name))
    assert result.attempted
    assert not result.failed
