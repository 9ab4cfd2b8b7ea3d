"""Comparison and verdict on logs without truth."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import tensor

import difffilter as df
from difffilter.comparison.questions import AHEAD, NEXT, OTHERS, WINDOWS
from difffilter.comparison.without_truth import UNKNOWABLE, Untold, compare_without_truth
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.logs.log import Log
from difffilter.motions.blocks import ConstantVelocity
from difffilter.reports.report import Report
from difffilter.scenario.model import Model
from difffilter.scoring.foretelling import Foretold, correlation, surprise
from difffilter.sensors.builtin import Position
from difffilter.verdict.without_truth import (
    grade_without_truth,
    index_without_truth,
    verdict_without_truth,
)

D = torch.float64


def made(sigma: float = 3.0) -> Model:
    """Two sensors of 1 m, both declared with another sigma; b is biased by 2 m."""
    sensors = tuple(Position(name=n, axes=1, sigma=sigma) for n in "ab")
    recipe = Filter(ConstantVelocity(1, acceleration=0.3), sensors, start_sigma=(5.0, 2.0))
    free = {n: replace(recipe.declarations[n], tuned=True) for n in ("a.sigma", "b.sigma")}
    return Model(replace(recipe, overrides=free), "boat")


def log_of(rows: int = 60, bias: float = 0.0) -> Log:
    rng = np.random.default_rng(12)
    z = np.arange(rows)[:, None] * 0.5 + rng.standard_normal((rows, 2)) + [0.0, bias]
    return Log(("a_1", "b_1"), torch.arange(rows, dtype=D), tensor(z))


def checkpoint(model: Model, sigma: float) -> df.Checkpoint:
    values = {**model.system().published(), "a.sigma": tensor(sigma), "b.sigma": tensor(sigma)}
    return df.Checkpoint(model, "boat", values)


@pytest.fixture(scope="module")
def found() -> Untold:
    model = made()
    return compare_without_truth(
        model, {"published": None, "tuned": checkpoint(model, 1.0)}, log=log_of()
    )


def test_the_right_noise_foretells_more(found: Untold) -> None:
    before, after = found.of("boat", "published"), found.of("boat", "tuned")
    assert set(after) == {NEXT, OTHERS, AHEAD, WINDOWS}
    for question, answer in after.items():
        assert answer.gain == pytest.approx(before[question].score - answer.score, abs=1e-12)
        assert answer.gain_ci95[0] > 0.0
        assert 0.6 < answer.squares < 1.5
        assert before[question].squares < 0.4
    assert found.of("boat", "published")[NEXT].gain == 0.0
    made_of = grade_without_truth(found, "boat")
    assert made_of.word == "adopt if"
    assert "no error that all sensors share" in made_of.text
    assert UNKNOWABLE in found.markdown()
    json.dumps(found.as_dict())


def test_channels_tell_a_bias_between_sensors(found: Untold) -> None:
    model = made(1.0)
    biased = compare_without_truth(model, log=log_of(bias=8.0))
    for one, sign in zip(biased.channels, (-1.0, 1.0), strict=True):
        assert one.apart is not None
        assert sign * one.apart[0] > 3.0
        assert one.apart[1] * one.apart[2] > 0.0
    for one in found.channels:
        assert one.apart is not None
        assert abs(one.apart[0]) < 0.5
        assert abs(one.correlation) < 2.0 * one.white


def test_by_hand() -> None:
    """Surprise, mean square, share beyond, correlation of two trajectories with gaps."""
    z = tensor([[1.0, 2.0], [9.0, -1.0], [3.0, 0.0]]).unsqueeze(-1)
    present = torch.tensor([[True, True], [False, True], [True, True]]).unsqueeze(-1)
    told = Foretold(z, torch.full_like(z, 4.0), present)
    assert told.squares() == pytest.approx((1 + 9 + 4 + 1 + 0) / 4.0 / 5.0)
    assert told.beyond() == 0.0
    assert correlation(told) == pytest.approx((1 * 3 + 2 * -1 + 0) / (1 + 9 + 4 + 1))
    density = torch.distributions.StudentT(tensor(4.0), tensor(0.0), tensor(2.0))
    assert float(surprise(z, told.variance)[0, 0, 0]) == pytest.approx(
        -float(density.log_prob(tensor(1.0)))
    )


def test_pages(tmp_path: Path) -> None:
    """A verdict, and the index of two, that keep and adopt."""
    model = made()
    report = Report(tmp_path, "Two")
    for name, sigma in (("good", 1.0), ("bad", 20.0)):
        verdict_without_truth(report, checkpoint(model, sigma), log_of(30), name=name)
    text = report.write().read_text(encoding="utf-8")
    assert UNKNOWABLE in text
    judged = {key: {**data, "page": "x.html"} for key, data in report.judged.items()}
    assert [data["grade"] for data in judged.values()] == ["adopt if", "keep"]
    index_without_truth(report, judged)


def test_what_cannot_be_asked_is_told() -> None:
    recipe = Filter(
        ConstantVelocity(2, acceleration=0.3), (Position(),), start_sigma=(5.0, 5.0, 2.0, 2.0)
    )
    short = Log(recipe.channels, torch.arange(6, dtype=D), torch.zeros(6, 2, dtype=D))
    found = compare_without_truth(recipe, log=short)
    assert set(found.unasked) == {OTHERS, AHEAD, WINDOWS}
    assert "whose axes tell nothing of each other" in found.unasked[OTHERS]
    assert found.channels[0].apart is None
    with pytest.raises(InputError, match="compare_without_truth"):
        df.compare(recipe, log=short)
