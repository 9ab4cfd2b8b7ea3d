"""A tracker fed row by row, held against the batch run."""

from __future__ import annotations

import torch
from helpers import assert_close, tensor
from run_cases import P0

from difffilter.filters.filter import Filter
from difffilter.logs.log import Log, Start
from difffilter.logs.track import Track
from difffilter.running.batch import run
from difffilter.running.tracker import Tracker

COVARIANCE = torch.diag(tensor(P0).square())


def stream(tracker: Tracker, log: Log) -> Track:
    """Feed a log row by row."""
    beliefs, records = [], []
    for row, dt in enumerate(log.intervals(0.0)):
        inputs = {name: value[row] for name, value in log.inputs.items()}
        records.append(tracker.step(log.z[row], dt, inputs))
        beliefs.append(tracker.belief)
    filter = tracker.filter
    return Track(
        filter.states,
        filter.channels,
        log.time,
        torch.stack([b.mean for b in beliefs]),
        torch.stack([b.deviations for b in beliefs]),
        type(records[0])(*(torch.stack(field) for field in zip(*records, strict=True))),
        beliefs[-1],
    )


def check(filter: Filter, log: Log, mean: torch.Tensor) -> None:
    expected = run(filter, log, start=Start(mean, COVARIANCE.expand(*mean.shape, 4), 0.0))
    found = stream(Tracker(filter, mean, COVARIANCE.expand(*mean.shape, 4)), log)
    assert expected.record is not None
    assert found.record is not None
    assert_close(found.mean, expected.mean, 1e-12)
    assert_close(found.covariance, expected.covariance, 1e-12)
    for ours, theirs in zip(found.record, expected.record, strict=True):
        assert_close(ours.double(), theirs.double(), 1e-11)
    assert found.final is not None
    assert expected.final is not None
    assert set(found.final.memory) == set(expected.final.memory)
    for name, value in expected.final.memory.items():
        assert_close(found.final.memory[name].double(), value.double(), 1e-11)
