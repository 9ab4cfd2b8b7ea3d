"""Exported C: compiles without a warning, and repeats the Python filter."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from difffilter.checkpoint import Checkpoint, load
from difffilter.errors import InputError
from difffilter.export.c99 import export_c
from difffilter.export.program import element, identifier
from difffilter.filter import Filter
from difffilter.scenario.scenario import load_scenario

CHECKPOINTS = sorted((Path(__file__).parent.parent / "checkpoints").glob("*.json"))
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
]
needs_compiler = pytest.mark.skipif(CC is None, reason="no C compiler")


def published(scenario: str, system: str) -> Checkpoint:
    loaded = load_scenario(scenario)
    filter = loaded.system(system)
    assert isinstance(filter, Filter)
    return Checkpoint(loaded, system, filter.published())


def self_test(folder: Path, name: str, *flags: str) -> subprocess.CompletedProcess[str]:
    files = [f"{name}.c", f"{name}_test.c"]
    command = [str(CC), *STRICT, *flags, *files, "-o", "check", "-lm"]
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
    changed = re.sub(r"(#define D_\w+ \(REAL\)\()", r"\g<1>1.001 * ", text)
    assert changed != text
    source.write_text(changed)
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


def test_frozen_values_stand_in_the_header_with_unit_and_source() -> None:
    path = next(path for path in CHECKPOINTS if path.stem == "uwb-ranges")
    checkpoint = load(path)
    from difffilter.export.c99 import frozen_values

    text = "\n".join(frozen_values(checkpoint, "one"))
    sigma = float(checkpoint.values["range.sigma"])
    assert f"#define ONE_RANGE_SIGMA {sigma!r} /* m, tuned */" in text


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


def command(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "difffilter", "export", *words],
        capture_output=True, text=True, check=False,
    )  # fmt: skip


def test_the_command_names_what_it_wrote_and_what_is_wrong(tmp_path: Path) -> None:
    path = str(next(path for path in CHECKPOINTS if path.stem == "uwb-ranges"))
    done = command(path, "--to", "c", "--out", str(tmp_path / "c"), "--name", "mine")
    assert done.stdout.splitlines()[0] == str(tmp_path / "c" / "mine.h")
    taken = tmp_path / "file"
    taken.write_text("")
    for words, message in (
        ((path, "--to", "c", "--out", str(taken)), "found a file, expected a folder"),
        ((path, "--to", "rust", "--out", "x"), "rust"),
        ((str(taken), "--to", "c", "--out", "x"), f"{taken}"),
        ((path, "--to", "c", "--out", "x", "--name", "a-b"), "--name: found 'a-b'"),
    ):
        done = command(*words)
        assert done.returncode == 2
        assert message in done.stderr
        assert done.stderr.count("\n") == 1


def test_identifiers_and_subscripts() -> None:
    assert identifier("tdoa.sigma") == "tdoa_sigma"
    assert identifier("3d tail") == "_3d_tail"
    assert element("x", (2, 3), 5) == "x[1][2]"
    assert element("x", (), 0) == "x"


@needs_compiler
def test_the_program_of_the_documentation_does_what_the_tracker_does(tmp_path: Path) -> None:
    page = Path(__file__).parent.parent / "docs" / "deployment.md"
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
