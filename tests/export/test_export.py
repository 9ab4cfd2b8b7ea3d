"""Exported C: compiles without a warning, and repeats the Python filter."""

from __future__ import annotations

import copy
import dataclasses
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from difffilter.cli.main import main
from difffilter.errors import InputError
from difffilter.export.c99 import export_c
from difffilter.export.program import element, identifier, identifiers, literal
from difffilter.export.words import frozen_values
from difffilter.files import write_together
from difffilter.filters.recipe import Recipe
from difffilter.scenario.checkpoint import Checkpoint, load
from difffilter.scenario.scenario import load_scenario, read_scenario

CHECKPOINTS = sorted((Path(__file__).parents[2] / "checkpoints").glob("*.json"))
CC = shutil.which("cc") or shutil.which("gcc")
STRICT = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O1"]
#: Systems that no checkpoint holds.
OTHERS = [
    ("airport-mlat-intermittent", "m-ekf-all-rows"),
    ("airport-mlat-intermittent", "adaptive-ekf"),
    ("airborne-bearing-absolute", "robust-noise"),
    ("manoeuvre-fusion-2", "pooled-robust"),
    ("manoeuvre-fusion-2", "stf-srckf"),
    ("gate-lockout", "gated-widen"),
    ("gate-lockout", "gated-inflate"),
    ("airport-mlat", "m-ekf-mad"),
    ("manoeuvre-fusion-1", "imm"),
    ("manoeuvre-fusion-1", "imm-turns-gated"),
]
needs_compiler = pytest.mark.skipif(CC is None, reason="no C compiler")


def published(scenario: str, system: str) -> Checkpoint:
    loaded = load_scenario(scenario)
    filter = loaded.system(system)
    assert isinstance(filter, Recipe)
    return Checkpoint(loaded, system, filter.published())


def changed(scenario: str, system: str, **tables: Any) -> Checkpoint:
    """Published values of a scenario whose document has other top-level entries."""
    document = dict(load_scenario(scenario).document) | tables
    loaded = read_scenario(document, Path("changed.toml"))
    filter = loaded.system(system)
    assert isinstance(filter, Recipe)
    return Checkpoint(loaded, system, filter.published())


def self_test(folder: Path, name: str, *flags: str) -> subprocess.CompletedProcess[str]:
    files = [f"{name}.c", f"{name}_test.c"]
    command = [str(CC), *STRICT, "-Wdouble-promotion", *flags, *files, "-o", "check", "-lm"]
    made = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    return subprocess.run(["./check"], cwd=folder, capture_output=True, text=True, check=False)


def check(checkpoint: Checkpoint, folder: Path) -> None:
    export_c(checkpoint, folder, "one")
    for flags in ([], ["-DONE_FLOAT"]):
        done = self_test(folder, "one", *flags)
        assert done.returncode == 0, done.stdout
        assert done.stdout.count("\n") == 1


@needs_compiler
@pytest.mark.parametrize("path", CHECKPOINTS, ids=lambda path: path.stem)
def test_every_checkpoint_repeats_the_python_filter_in_double_and_float(
    path: Path, tmp_path: Path
) -> None:
    check(load(path), tmp_path)


@needs_compiler
@pytest.mark.parametrize(("scenario", "system"), OTHERS)
def test_other_systems_do_too(scenario: str, system: str, tmp_path: Path) -> None:
    check(published(scenario, system), tmp_path)


@needs_compiler
def test_the_self_test_fails_where_the_filter_or_the_vectors_differ(tmp_path: Path) -> None:
    export_c(published("uwb-ranges", "robust"), tmp_path, "one")
    source = tmp_path / "one.c"
    text = source.read_text()
    other = re.sub(r"(D_RANGE_INDEPENDENT.*= \{)", r"\g<1>1.001 * ", text)
    assert other != text
    source.write_text(other)
    assert self_test(tmp_path, "one").returncode == 1
    source.write_text(text)
    vectors = tmp_path / "one_golden.h"
    golden = vectors.read_text()
    for array, step in (
        ("means", 1e-6),
        ("weight", 1e-6),
        ("gate", -1.0),
        ("standardised", float("nan")),
    ):
        number = re.search(rf"one_golden_{array}\[.*= \{{\{{([^,]+),", golden)
        assert number is not None
        wrong = "(0.0 / 0.0)" if step != step else repr(float(number[1]) * (1 + step))
        vectors.write_text(golden[: number.start(1)] + wrong + golden[number.end(1) :])
        assert self_test(tmp_path, "one").returncode == 1


@needs_compiler
def test_a_program_of_ones_own_runs_the_filter(tmp_path: Path) -> None:
    export_c(published("gate-lockout", "gated"), tmp_path, "one")
    (tmp_path / "mine.c").write_text("""
#include <stdio.h>
#include "one.h"
int main(void)
{
    one_belief belief;
    one_result result;
    const one_real mean[ONE_STATES] = {0}, far[ONE_CHANNELS] = {1e200, 1e200};
    const one_real z[ONE_CHANNELS] = {3.0, 4.0};
    one_real x[ONE_STATES][ONE_STATES] = {{0}};
    const unsigned char all[ONE_CHANNELS] = {1, 1}, none[ONE_CHANNELS] = {0};
    for (int i = 0; i < ONE_STATES; i++)
        x[i][i] = 10.0;
    one_start(&belief, mean, x);
    if (one_step(&belief, z, all, 1.0, &result) || result.innovation[0] != 3.0)
        return 1;
    one_belief before = belief;
    if (!one_step(&belief, far, all, 1e200, &result) || belief.mean[0] != before.mean[0])
        return 2;
    if (one_step(&belief, z, none, 0.0, NULL) || belief.mean[1] != before.mean[1])
        return 3;
    before = belief;
    if (one_step(&belief, z, all, -1.0, NULL) != 2 || belief.mean[1] != before.mean[1])
        return 4;
    return 0;
}
""")
    command = [str(CC), *STRICT, "one.c", "mine.c", "-o", "mine", "-lm"]
    made = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    assert subprocess.run(["./mine"], cwd=tmp_path, check=False).returncode == 0


def test_the_same_checkpoint_gives_the_same_bytes(tmp_path: Path) -> None:
    checkpoint = published("uwb-ranges", "robust")
    first, second = (export_c(checkpoint, tmp_path / side) for side in ("a", "b"))
    assert [p.name for p in first] == [
        "uwb_ranges.h", "uwb_ranges.c", "uwb_ranges_golden.h", "uwb_ranges_test.c",
    ]  # fmt: skip
    for a, b in zip(first, second, strict=True):
        assert a.read_bytes() == b.read_bytes()


def test_frozen_values_stand_in_the_header_with_meaning_unit_and_source() -> None:
    path = next(path for path in CHECKPOINTS if path.stem == "uwb-ranges")
    checkpoint = load(path)
    text = "\n".join(frozen_values(checkpoint, "one"))
    sigma = float(checkpoint.values["range.sigma"])
    assert f"static const one_real ONE_RANGE_SIGMA = (one_real){sigma!r};" in text
    assert "/* range.sigma: measurement noise: standard deviation; m; tuned */" in text
    assert "/* start.sigma: initial standard deviation; m, m/s; hand-picked */" in text


@needs_compiler
def test_float_by_default_and_double_on_demand(tmp_path: Path) -> None:
    export_c(published("uwb-ranges", "robust"), tmp_path, "one", single=True)
    for flags, double in (([], False), (["-DONE_FLOAT"], False), (["-DONE_DOUBLE"], True)):
        done = self_test(tmp_path, "one", *flags)
        assert done.returncode == 0
        assert done.stdout.endswith("tolerance 1e-12\n") is double


@needs_compiler
def test_a_soft_checkpoint_is_exported_soft(tmp_path: Path) -> None:
    soft = dataclasses.replace(published("airport-mlat", "huber"), temperature=0.5)
    check(soft, tmp_path)
    assert "soft, temperature 0.5" in (tmp_path / "one.h").read_text()
    assert "D_TEMPERATURE = (REAL)0.5;" in (tmp_path / "one.c").read_text()


@needs_compiler
@pytest.mark.parametrize("name", ["gr\u00f6\u00dfe", "int", "a-b_c", "x" * 64])
def test_any_name_of_a_scenario_makes_plain_c(name: str, tmp_path: Path) -> None:
    checkpoint = changed("gate-lockout", "gated", name=name)
    made = export_c(checkpoint, tmp_path)
    stem = made[0].stem
    assert re.fullmatch(r"\w+", stem, re.ASCII)
    assert self_test(tmp_path, stem).returncode == 0


@needs_compiler
@pytest.mark.parametrize("world", [True, False])
def test_a_platform_is_a_struct_of_known_inputs(world: bool, tmp_path: Path) -> None:
    document: dict[str, Any] = copy.deepcopy(dict(load_scenario("airborne-bearing").document))
    document["sensors"]["bearing"]["platform"] = ["platform_x", "platform_y"]
    document["world"]["platform"] = {"position": [0.0, 0.0], "velocity": [3.0, 1.0]}
    document["inputs"] = ["unread"]
    if not world:
        document = {k: v for k, v in document.items() if k not in ("world", "faults", "worlds")}
    loaded = read_scenario(document, Path("platform.toml"))
    filter = loaded.system("robust")
    assert isinstance(filter, Recipe)
    check(Checkpoint(loaded, "robust", filter.published()), tmp_path)
    header = (tmp_path / "one.h").read_text()
    assert "    one_real platform_x;\n    one_real platform_y;\n} one_inputs;" in header
    assert "unread" not in header


@needs_compiler
def test_a_known_turn_rate_is_an_input_where_the_scenario_names_it(tmp_path: Path) -> None:
    motion = {"model": "coordinated-turn"}
    for inputs, found in ((["turn_rate", "while"], True), ([], False)):
        changes = {"motion": motion, "inputs": inputs}
        check(changed("gate-lockout", "gated", **changes), tmp_path)
        assert ("    one_real turn_rate;\n}" in (tmp_path / "one.h").read_text()) is found


@needs_compiler
def test_inputs_that_no_step_reads_leave_no_struct(tmp_path: Path) -> None:
    check(changed("gate-lockout", "gated", inputs=["while", "unread"]), tmp_path)
    assert "inputs" not in (tmp_path / "one.h").read_text()


def test_all_files_or_none(tmp_path: Path) -> None:
    (tmp_path / "one_test.c").mkdir()
    with pytest.raises(InputError, match=r"one_test\.c: found a folder, expected a file"):
        export_c(published("gate-lockout", "ekf"), tmp_path, "one")
    assert [p.name for p in tmp_path.iterdir()] == ["one_test.c"]
    taken = tmp_path / "file"
    taken.write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        write_together(taken / "below", {"a": "text"})


@pytest.mark.parametrize(
    ("scenario", "system"),
    [("airborne-bearing", "clairvoyant"), ("urban-credibility", "ideal")],
)
def test_what_is_told_of_faults_cannot_be_exported(
    scenario: str, system: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=f"export: {system} is told of faults"):
        export_c(published(scenario, system), tmp_path / "c")
    assert not (tmp_path / "c").exists()


def test_the_command_names_what_it_wrote_and_what_is_wrong(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(next(path for path in CHECKPOINTS if path.stem == "uwb-ranges"))
    out = tmp_path / "c"
    assert main(["export", path, "--to", "c", "--out", str(out), "--name", "mine", "--float"]) == 0
    assert capsys.readouterr().out.splitlines()[0] == str(out / "mine.h")
    assert "Compiled in float" in (out / "mine.h").read_text()
    taken, damaged = tmp_path / "file", tmp_path / "damaged.json"
    taken.write_text("")
    damaged.write_text(Path(path).read_text()[:1000])
    other = str(tmp_path / "x")
    for words, message in (
        ((path, "--to", "c", "--out", str(taken)), "found a file, expected a folder"),
        ((path, "--to", "rust", "--out", other), "rust"),
        ((str(taken), "--to", "c", "--out", other), f"{taken}"),
        ((str(damaged), "--to", "c", "--out", other), "damaged or truncated JSON"),
        ((path, "--to", "c", "--out", other, "--name", "a-b"), "--name: found 'a-b'"),
        ((path, "--to", "c", "--out", other, "--name", "\u00e9"), "--name: found"),
    ):
        assert main(["export", *words]) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
        assert not Path(other).exists()


def test_a_baseline_is_no_filter_to_export(tmp_path: Path) -> None:
    baseline = Checkpoint(load_scenario("airport-mlat"), "taylor-ls", {})
    with pytest.raises(InputError, match="is a baseline, expected a filter"):
        export_c(baseline, tmp_path / "c")


def test_identifiers_and_subscripts() -> None:
    assert identifier("tdoa.sigma") == "tdoa_sigma"
    assert identifier("3d tail") == "f_3d_tail"
    assert identifiers(["a.b", "A_b", "int"]) == {"a.b": "a_b", "A_b": "A_b_", "int": "int_"}
    assert identifiers(["step"], ["step"]) == {"step": "step_"}
    assert element("x", (2, 3), 5) == "x[1][2]"
    assert element("x", (), 0) == "x"


def test_numbers_of_either_precision() -> None:
    assert literal(-0.5) == "(REAL)-0.5"
    assert literal(float("inf")) == "(REAL)INFINITY"
    assert literal(float("nan")) == "(REAL)NAN"
    assert literal(sys.float_info.min) == "SMALLEST"
    assert literal(sys.float_info.min**0.5) == "ROOT_SMALLEST"
    assert literal(1e-300) == "TINY(1e-300)"
    assert literal(4 * sys.float_info.epsilon) == "(4 * EPSILON)"


@needs_compiler
def test_the_program_of_the_documentation_does_what_the_tracker_does(tmp_path: Path) -> None:
    page = Path(__file__).parents[2] / "docs" / "deployment.md"
    program = re.search(r"^```text\n(#include.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL)
    assert program is not None
    (tmp_path / "main.c").write_text(program[1])
    checkpoint = published(str(page.parent / "example.toml"), "robust")
    export_c(checkpoint, tmp_path, "launch")
    tracker = checkpoint.tracker([40.0, 60.0, 4.0, 0.0], torch.diag(torch.tensor([4.0, 4, 1, 1])))
    record = tracker.step([287.1, 369.4, 169.5, None, 42.0, 61.0], dt=0.5)
    expected = [*tracker.belief.mean[:2].tolist(), float(record.weight[0])]
    for flags, tolerance in (([], 1e-8), (["-DLAUNCH_FLOAT"], 1e-5)):
        command = [str(CC), *STRICT, *flags, "launch.c", "main.c", "-o", "main", "-lm"]
        made = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert made.returncode == 0, made.stderr
        done = subprocess.run(["./main"], cwd=tmp_path, capture_output=True, text=True, check=True)
        assert list(map(float, done.stdout.split())) == pytest.approx(expected, rel=tolerance)
