"""What transfers: recorded UWB ranges run with values tuned in simulation or on other runs."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Mapping, Sequence
from typing import Any

import torch

import difffilter as df
from difffilter.reports.report import Report
from training.common import checkpoint_path
from training.uwb.claims import judge_transfer
from training.uwb.scores import (
    HAND,
    LASTING,
    OTHERS,
    PAIRS,
    RUNS,
    SIMULATED,
    SQUARED,
    Errors,
    Score,
)
from training.uwb.tables import finding, transfer_tables


def logs(scenario: df.Scenario, options: Namespace, runs: Sequence[str]) -> df.Log:
    """The recordings of some runs; the first 250 rows of each in a quick run."""
    log = df.load_logs(scenario, [options.data / f"{run}.csv" for run in runs])
    return log.rows(0, 250) if options.quick else log


def transfer(
    report: Report,
    options: Namespace,
    scenario: df.Scenario,
    rotated: Mapping[str, df.Checkpoint],
    quick: Mapping[str, Any],
) -> None:
    """Tuned in simulation, on one run, on two, on the other three (``rotated``): run on all."""
    seed = options.seed
    world = df.load_scenario("uwb-simulated", {"world.steps": 60} if options.quick else {})
    longer = world.with_overrides(lasting(world))
    small = {**quick, "steps": 1} if options.quick else {}
    size = {**small, "trajectories": 8, "validation": 8, "test": 8} if options.quick else {}
    alone = size | {"loss": {"position": 1.0, "consistency": 0.0}}
    path = checkpoint_path("uwb-simulated", options)
    simulated = df.tune(world, seed=seed, settings=size, out=path)
    assert simulated.held_out is not None
    sets = {
        SIMULATED: simulated.checkpoint,
        SQUARED: df.tune(world, seed=seed, settings=alone).checkpoint,
        LASTING: df.tune(longer, seed=seed, settings=size).checkpoint,
    }
    for name, runs in ({run: (run,) for run in RUNS} | PAIRS).items():
        train = logs(scenario, options, runs)
        sets[name] = df.tune(
            scenario, train, validation=train, seed=seed, settings=small
        ).checkpoint
    errors = {
        name: range_errors(df.simulate(one, 20, seed, "range errors"), one)
        for name, one in ((SIMULATED, world), (LASTING, longer))
    }
    scores = {}
    for run in RUNS:
        test = logs(scenario, options, [run])
        values = {HAND: None, OTHERS: rotated[run], **sets}
        found = df.compare(scenario, values, log=test, systems=("robust",))
        scores |= {(r.values, run): Score(r.rmse, r.nees_per_state) for r in found.rows}
        errors[run] = range_errors(test, scenario)
    transfer_tables(report, sets, scores)
    process = {name: float(one.values["motion.acceleration"]) for name, one in sets.items()}
    told = simulated.held_out.row("robust", "tuned").nees_per_state
    report.text(finding(scores, process, told, errors))
    judge_transfer(report, scores)


def lasting(world: df.Scenario) -> dict[str, float]:
    """Overrides: the bursts of offsets last five times as long and begin a fifth as often."""
    keys = {}
    for name, fault in world.faults.items():
        if fault.kind == "offset" and fault.duration > 1:
            keys[f"faults.{name}.duration"] = 5 * fault.duration
            keys[f"faults.{name}.probability"] = fault.probability / 5
    return keys


def range_errors(log: df.Log, scenario: df.Scenario) -> Errors:
    """Of the measured ranges within 1 m of each channel's median error."""
    sensor = scenario.document["sensors"]["range"]
    stations = log.inputs.get("range.stations", log.z.new_tensor(sensor["stations"]))
    place = torch.full((*log.truth.shape[:-1], 3), sensor["height"], dtype=log.z.dtype)
    place[..., :2] = log.truth[..., [log.truth_states.index(axis) for axis in ("x", "y")]]
    error = log.z - (place.unsqueeze(-2) - stations).norm(dim=-1)
    error = error - error.nanmedian(dim=0).values
    error = torch.where(error.abs() < 1.0, error, torch.nan)
    error = error - error.nanmean(dim=0)
    lag = round(1.0 / float(log.time.diff(dim=0).median()))
    pairs = torch.stack([error[lag:], error[:-lag]])
    now, later = pairs[:, pairs.isfinite().all(0)]
    correlation = (now * later).sum() / (now.square().sum() * later.square().sum()).sqrt()
    return Errors(float(error.square().nanmean().sqrt()), float(correlation))
