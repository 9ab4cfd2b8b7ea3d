"""What is kept of a compiled step: a cached start neither traces nor writes C."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from difffilter import (
    ConstantVelocity,
    Filter,
    FunctionSensor,
    Gate,
    Log,
    Position,
    Start,
    Track,
    Tracker,
    huber,
    run,
    tanh,
)
from difffilter.engine import build as builder
from difffilter.engine import compiled
from difffilter.engine.build import compiler
from difffilter.engine.fingerprint import fingerprint
from difffilter.filters.recipe import Recipe

pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler")

D = torch.float64


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A cache of its own."""
    monkeypatch.setenv("DIFFFILTER_CACHE", str(tmp_path / "cache"))
    forget()
    yield tmp_path / "cache"
    forget()


def forget() -> None:
    """What a new process does not know."""
    builder.build.cache_clear()
    compiled._MADE.clear()
    compiled._TRACED.clear()


def own(sigma: float = 2.0) -> Filter:
    return Filter(ConstantVelocity(axes=1), (Position(axes=1, sigma=sigma),), huber)


def tracked(filter: Recipe, rows: int = 6) -> Track:
    time = torch.arange(rows, dtype=D)
    z = torch.tensor([0.3, -1.0, 9.0, torch.nan, 2.0, 4.5], dtype=D)[:rows, None]
    log = Log(filter.channels, time, z, start=Start(torch.zeros(2, dtype=D), torch.eye(2, dtype=D)))
    return run(filter, log, engine="fused")


def test_a_cached_start_neither_traces_nor_writes(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = tracked(own())
    forget()
    monkeypatch.setattr(compiled, "trace", lambda *_: pytest.fail("traced again"))
    again = tracked(own())
    assert torch.equal(first.mean, again.mean)
    assert again.record is not None
    assert first.record is not None
    assert torch.equal(first.record.observed, again.record.observed)


@pytest.mark.parametrize("damage", ["cut", "foreign", "library gone"])
def test_a_damaged_note_is_written_anew(folder: Path, damage: str) -> None:
    first = tracked(own())
    (path,) = folder.glob("*.json")
    if damage == "cut":
        path.write_text(path.read_text()[:-9])
    elif damage == "foreign":
        path.write_text("[]")
    else:
        (library,) = folder.glob("*.so")
        library.unlink()
    forget()
    assert torch.equal(tracked(own()).mean, first.mean)
    (written,) = folder.glob("*.json")
    forget()
    assert builder.known("none") is None
    assert len(written.read_text()) > 50


def test_other_values_are_the_same_program(folder: Path) -> None:
    tracked(own())
    forget()
    tracked(own(5.0))
    assert len(list(folder.glob("*.so"))) == 1


def test_a_users_function_is_traced_each_time(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    filter = Filter(
        ConstantVelocity(axes=1), (FunctionSensor(("r",), lambda s, i, v: s[..., :1], sigma=1.0),)
    )
    tracked(filter)
    assert list(folder.glob("*.json")) == []
    assert fingerprint(filter) is None


def test_fingerprints_tell_recipes_apart() -> None:
    first = own()
    others = [
        own(3.0),
        replace(first, weight=tanh),
        replace(first, gate=Gate("reject")),
        Filter(ConstantVelocity(axes=2), (Position(axes=2, sigma=2.0),), huber),
    ]
    assert fingerprint(first) == fingerprint(own())
    texts = [fingerprint(filter) for filter in (first, *others)]
    assert None not in texts
    assert len(set(texts)) == len(texts)


def test_a_belief_stays_as_it_was_read() -> None:
    tracker = Tracker(own(), [0.0, 1.0], [[4.0, 0.0], [0.0, 1.0]], engine="fused")
    tracker.step([1.0], 1.0)
    read = tracker.belief
    kept = read.mean.clone(), read.deviations.clone()
    record = tracker.step([7.0], 1.0)
    innovation = record.innovation.clone()
    assert torch.equal(read.mean, kept[0])
    assert torch.equal(read.deviations, kept[1])
    assert not torch.equal(tracker.belief.mean, kept[0])
    tracker.step([3.0], 1.0)
    assert torch.equal(record.innovation, innovation)
