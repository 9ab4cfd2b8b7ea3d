"""The benchmark runs, says what it found, and times nothing that disagrees. No times here."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli_helpers import process

from difffilter.bench import peers
from difffilter.bench.claims import claims
from difffilter.bench.findings import Findings, Speed
from difffilter.bench.job import FUSED, IMQ, M_EKF, PLAIN, TASKS, TORCH, own, problem, task
from difffilter.bench.measure import DisagreementError, agree, interleaved
from difffilter.bench.sizes import FULL, QUICK
from difffilter.bench.stream import FED, READ
from difffilter.cli.main import main
from difffilter.engine.build import compiler
from difffilter.errors import InputError

needs_compiler = pytest.mark.skipif(compiler() is None, reason="no C compiler")


@needs_compiler
def test_a_quick_run_reports_every_row_in_finite_numbers(tmp_path: Path) -> None:
    done = process("bench", "--quick", "--peers", "none", "--json", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    report = json.loads(done.stdout)
    assert report == json.loads((tmp_path / "report.json").read_text())
    tables = report["tables"]
    expected = [
        [name, steps, batch, who]
        for steps, batch in QUICK.speed
        for name in TASKS
        for who in (FUSED, TORCH)
    ]
    assert [list(row.values())[:4] for row in tables["speed"]] == expected
    for row in tables["speed"]:
        assert row["value (us)"] > 0.0
        assert row["value + gradient (us)"] > 0.0
    assert [row["contender"] for row in tables["memory"]] == [FUSED, TORCH]
    streamed = [(row["contender"], row["filter"]) for row in tables["streaming"]]
    assert streamed == [(FUSED, IMQ), (READ, IMQ), (FUSED, PLAIN), (TORCH, IMQ), (FED, IMQ)]
    assert [row["filter"] for row in tables["compile"]] == list(QUICK.compiled)
    numbers = [
        value
        for name in ("memory", "streaming", "compile")
        for row in tables[name]
        for value in row.values()
        if not isinstance(value, str)
    ]
    assert numbers
    assert all(math.isfinite(value) and value >= 0.0 for value in numbers)
    assert {row["what"] for row in tables["machine"]} >= {"cores", "compiler", "OMP_NUM_THREADS"}
    page = (tmp_path / "report.md").read_text()
    assert "A quick run" in page
    assert "Not decided by this run: " in page


@pytest.mark.parametrize("off", ["loss", "gradient", "nan", "shape"])
def test_a_peer_that_computes_something_else_is_refused(off: str) -> None:
    first = own(task(PLAIN, problem(3, 2)), "torch")
    assert first.gradient is not None
    loss, gradient = first.gradient()
    wrong = {
        "loss": (loss * (1.0 + 1e-6), gradient),
        "gradient": (loss, gradient * np.array([1.0, 1.0 + 1e-6])),
        "nan": (math.nan, gradient),
        "shape": (loss, gradient[:1]),
    }[off]
    agree([first, first], 3, 2)
    other = replace(first, name="wrong", value=lambda: wrong[0], gradient=lambda: wrong)
    with pytest.raises(DisagreementError, match=r"^wrong: its \S.* differs by .* expected 1e-09"):
        agree([first, other], 3, 2)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("name", peers.PEERS)
def test_each_installed_peer_computes_the_same(name: str) -> None:
    if peers.installed(name) is None:
        pytest.skip(f"{name} is not installed")
    found = 0
    for filter in (IMQ, PLAIN):
        made = peers.contenders(task(filter, problem(20, 3)), [name], ["torch"])
        agree(made, 20, 3)
        found += len(made) - 1
    assert found


def test_what_takes_minutes_is_not_run_and_a_slow_call_is_not_repeated() -> None:
    eager = own(task(M_EKF, problem(2, 1)), "torch")
    assert eager.takes("value", 100, 256)
    assert not eager.takes("gradient", 100, 4096)
    assert not eager.takes("value", 10_000, 1)
    assert not replace(eager, gradient=None).takes("gradient", 1, 1)
    slow, fast = [], []
    calls = {"slow": lambda: slow.append(sum(range(100_000))), "fast": lambda: fast.append(1)}
    times = interleaved(calls, 5, seconds=1e-9)
    assert len(slow) == 1
    assert set(times) == {"slow", "fast"}
    assert all(taken >= 0.0 for taken in times.values())


def test_claims_hold_or_not_by_the_numbers_and_say_what_was_asked() -> None:
    found = Findings(
        speeds=[
            Speed(IMQ, 100, 4096, FUSED, 0.1, 0.2),
            Speed(IMQ, 100, 4096, "JAX, textbook", 4.0, 9.0),
            Speed(IMQ, 100, 4096, "JAX, sequential", 3.0, 5.0),
            Speed(M_EKF, 100, 4096, FUSED, 1.0, 2.6),
        ],
        memory={(FUSED, IMQ): (2.0, 9.0)},
        streaming={(FUSED, IMQ): 19.0},
        compiled={"airport-mlat/m-ekf-mad": (None, None)},
    )
    made = claims(found, FULL)
    assert [claim.held for claim in made] == [False, True, False, False, True, False, None, None]
    assert made[0].got == {"asked": 30.0, "got": 25.0}
    assert made[5].got == {"asked, s": 60.0, "got": "> 120 s"}
    best = [found.best_other(one, "gradient") for one in found.speeds]
    assert best == [5.0, 0.2, 0.2, None]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--peers", "numba"], "--peers: found 'numba', expected some of jax, dynamax, filterpy"),
        (["--peers", "none,jax"], "--peers: found 'none'"),
        (["--peers", ""], "--peers: found '', expected some of"),
        (["--repetitions", "0"], "expected a whole number of 1 or more"),
        (["--out", "/dev/null/here"], "is not a writable folder"),
    ],
)
@needs_compiler
def test_wrong_options_are_one_line_and_exit_2(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bench", *arguments]) == 2
    line = capsys.readouterr().err
    assert line.startswith("difffilter: error: ")
    assert said in line
    assert line.count("\n") == 1


def test_a_peer_that_is_named_must_be_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peers, "installed", lambda name: None)
    assert peers.chosen(None) == ()
    with pytest.raises(InputError, match=r"jax is not installed, expected pip install"):
        peers.chosen("jax")


@pytest.mark.parametrize("place", ["/nowhere/cc", ""])
def test_no_compiler_is_one_line_and_exit_2(
    place: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setenv("DIFFFILTER_CC", place)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert main(["bench", "--quick", "--peers", "none", "--out", str(tmp_path)]) == 2
    line = capsys.readouterr().err
    assert "C compiler" in line
    assert line.count("\n") == 1
