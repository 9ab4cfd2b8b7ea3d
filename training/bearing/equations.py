"""Paper 1's printed equations (3) and (10), and its threshold, checked by numbers."""

from __future__ import annotations

import math

import torch

import difffilter as df
from difffilter.reports.report import Report

#: The emitter, m.
PLACE = (5000.0, 10000.0)
#: Chi-square, one degree of freedom: the significance level and threshold of the paper.
LEVEL, THRESHOLD = 0.005, 7.879
#: Drift of the emitter, m/s^2, known to the filter: enough for P(k+1|k) to tell.
DRIFT = 3.0
#: The start reads the first bearings: from here on the innovations count.
SETTLED = 20


def judge_equations(report: Report, matched: df.Scenario, runs: int, seed: int) -> None:
    """Three claims."""
    derivative(report)
    innovation_covariance(report, matched, runs, seed)
    reached = math.erfc(math.sqrt(THRESHOLD / 2.0))
    report.claim(
        f"paper 1: {THRESHOLD} is the chi-square threshold of one degree of freedom at {LEVEL}",
        abs(reached / LEVEL - 1.0) < 0.001,
        {"probability beyond it": f"{reached:.6f}"},
    )


def derivative(report: Report) -> None:
    """Eq. (3): the derivative of the bearing along y."""
    x, y = (torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in PLACE)
    (slope,) = torch.autograd.grad(torch.atan2(y, x), y)
    printed = -PLACE[0] / (PLACE[0] ** 2 + PLACE[1] ** 2)
    report.claim(
        "paper 1, eq. (3): the second entry of H as printed, with a minus, is the derivative of "
        "the bearing",
        math.isclose(printed, float(slope)),
        {"as printed (rad/m)": f"{printed:.2e}", "derivative (rad/m)": f"{float(slope):.2e}"},
    )


def innovation_covariance(report: Report, matched: df.Scenario, runs: int, seed: int) -> None:
    """Eq. (10): which covariance the innovations have, where the filter's model is true."""
    world = matched.with_overrides(
        {
            "faults.wild.probability": 0.0,
            "world.acceleration.sigma": DRIFT,
            "parameters.motion.acceleration.value": DRIFT,
        }
    )
    log = df.simulate(world, runs, seed, "equations")
    system = world.system("ekf")
    with torch.no_grad():
        track = df.estimate(system, df.started(world, system, log))
    record = track.record
    assert record is not None
    predicted = record.innovation_variance - record.noise
    # One bearing: H P(k+1|k+1) H^T of the update with it.
    updated = predicted * record.noise / (predicted + record.noise)
    squared = record.innovation.square()
    ratios = {
        name: float((squared / (variance + record.noise))[SETTLED:].mean())
        for name, variance in (("P(k+1|k+1)", updated), ("P(k+1|k)", predicted))
    }
    apart = {name: abs(ratio - 1.0) for name, ratio in ratios.items()}
    report.claim(
        "paper 1, eq. (10): P(k+1|k+1), as printed, gives the innovations' covariance",
        apart["P(k+1|k+1)"] < apart["P(k+1|k)"],
        {f"mean NIS with {name}, 1 expected": ratio for name, ratio in ratios.items()}
        | {"trajectories": runs, "drift (m/s^2)": DRIFT},
    )
