"""Tunings that are killed and resumed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from tune_cases import FEW, airport

from difffilter.tuning.descent import Descent
from difffilter.tuning.loop import TuneResult, tune

Run = Callable[..., TuneResult]


STEPS = {"steps": 7, "evaluate_every": 2, "starts": 2, "patience": 9, "optimiser": "adam"}


#: Warm starts are renewed every 3 steps and validated every 2: neither coincide.
WINDOWED = {"window": 9, "batch": 3, "refresh": 3}


def simulated(tmp_path: Path) -> Run:
    def run(**options: Any) -> TuneResult:
        return tune(airport(), **{"seed": 1, "settings": FEW | STEPS} | options)

    return run


def kill_after(monkeypatch: pytest.MonkeyPatch, steps: int) -> None:
    """Ctrl-C in the gradient step after so many."""
    original, count = Descent._step, 0

    def counted(self: Descent, *args: Any) -> float:
        nonlocal count
        count += 1
        if count > steps:
            raise KeyboardInterrupt
        return original(self, *args)

    monkeypatch.setattr(Descent, "_step", counted)


def same(found: TuneResult, expected: TuneResult) -> None:
    assert repr(found.history) == repr(expected.history)
    assert set(found.checkpoint.values) == set(expected.checkpoint.values)
    for name, value in expected.checkpoint.values.items():
        assert torch.equal(found.checkpoint.values[name], value)
    assert found.checkpoint.as_dict() == expected.checkpoint.as_dict()
