"""Golden vectors: what the torch filter makes of a short log, for the C code to repeat."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.core.linalg import semidefinite_cholesky
from difffilter.export.decisions import decided
from difffilter.export.rows import rows
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log
from difffilter.logs.track import Track
from difffilter.motions.retraction import lifted
from difffilter.parameters.parameters import Values
from difffilter.running.batch import run
from difffilter.scenario.checkpoint import Checkpoint
from difffilter.seeds import stream

__all__ = ["USABLE", "Golden", "golden"]

SEED = 7
#: Times the deviation of torch's own run in float32, scaled to double's roundings and as it is,
#: and the least tolerance, in double and in float.
MARGIN, LEAST = (20.0, 20.0), (1e-12, 1e-5)
FINER = torch.finfo(torch.float64).eps / torch.finfo(torch.float32).eps
#: A tolerance in float beyond which the test would prove nothing: in standard deviations.
USABLE = 1.0
#: Logs that are tried until float decides as double at every gate, and the best is kept.
TRIES = 4
#: Standard deviations below this share of a state's size count as this.
FLOOR = 1e-6


class Golden(NamedTuple):
    """Rows and what the filter believes after each.

    Attributes:
        log: one trajectory with missing channels and irregular times.
        dt: (T,); mean (n,) and deviations (p, p): of the start.
        means: (T, n); covariances: (T, p, p); spread: (T, p) and size: (T, n), the standard
            deviations in which those of covariances and of means are told: the same but for
            states that are no plain numbers.
        results: what the step tells of each channel, (T, m) each, and ``deviation`` (T, m), the
            innovation's standard deviation.
        tolerance: of double and of float, in the spread and of weights and gates.
    """

    log: Log
    dt: Tensor
    mean: Tensor
    deviations: Tensor
    means: Tensor
    covariances: Tensor
    spread: Tensor
    size: Tensor
    results: dict[str, Tensor]
    tolerance: tuple[float, float]


def golden(checkpoint: Checkpoint, filter: Recipe, known: Sequence[str]) -> Golden:
    """The filter's own run over :func:`difffilter.export.rows.rows`.

    Args:
        filter: the checkpoint's, or the same relative to an origin.
        known: names of the inputs that the step reads.
    """
    best: Golden | None = None
    for close, seed in product((True, False), range(SEED, SEED + TRIES)):
        log = rows(checkpoint, filter, known, seed)
        if close:  # where float decides otherwise so close to a bound, rows further off must do
            log = decided(filter, log, checkpoint.values, checkpoint.temperature, seed)
        found = _vectors(checkpoint, filter, log)
        if best is None or found.tolerance[1] < best.tolerance[1]:
            best = found
        if best.tolerance[1] < USABLE / 10.0:
            break
    assert best is not None
    return best


def _vectors(checkpoint: Checkpoint, filter: Recipe, log: Log) -> Golden:
    values, start = checkpoint.values, log.start
    assert start is not None
    assert start.covariance is not None

    def track(log: Log, values: Values) -> Track:
        return run(filter, log, values, temperature=checkpoint.temperature, engine="torch")

    made = track(log, values)
    rough = track(log.to(torch.float32), {name: value.float() for name, value in values.items()})
    spread, size = _spread(made, filter)
    apart = _apart(rough, made, spread, size)
    # Where the rows amplify rounding they do so in both precisions alike.
    double = max(MARGIN[0] * FINER * apart, LEAST[0])
    single = max(MARGIN[1] * apart, LEAST[1])
    return Golden(
        log=log,
        dt=log.intervals(start.time),
        mean=start.mean,
        deviations=_root(start.covariance),
        means=made.mean,
        covariances=made.covariance,
        spread=spread,
        size=size,
        results=_results(made),
        tolerance=(double, single),
    )


def _spread(track: Track, filter: Recipe) -> tuple[Tensor, Tensor]:
    """Standard deviation (T, p) of each error and (T, n) of each state.

    Not below a share of the state's size.
    """
    sigma = track.covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0.0).sqrt()
    least = FLOOR * track.mean.abs().clamp(min=1.0)
    if filter.motion.flat:
        sigma = torch.maximum(sigma, least)
        return sigma, sigma
    columns = lifted(filter.motion, track.mean, track.deviations)
    return sigma.clamp(min=FLOOR), torch.maximum(columns.square().sum(-1).sqrt(), least)


def _results(track: Track) -> dict[str, Tensor]:
    record = track.record
    assert record is not None
    deviation = record.innovation_variance.clamp(min=0.0).sqrt()
    return {
        "innovation": record.innovation,
        "standardised": record.standardised,
        "weight": record.weight,
        "gate": record.gate,
        "deviation": torch.where(deviation > 0.0, deviation, 1.0),
    }


def _apart(found: Track, expected: Track, spread: Tensor, size: Tensor) -> float:
    """What the self-test measures: the largest deviation, in standard deviations."""
    a, b = _results(found), _results(expected)
    both = spread.unsqueeze(-1) * spread.unsqueeze(-2)
    parts = [
        (found.mean.double() - expected.mean) / size,
        (found.covariance.double() - expected.covariance) / both,
        (a["innovation"].double() - b["innovation"]) / b["deviation"],
        (a["standardised"].double() - b["standardised"]) / b["standardised"].abs().clamp(min=1.0),
        a["weight"].double() - b["weight"],
        a["gate"].double() - b["gate"],
    ]
    return float(torch.cat([part.flatten().abs() for part in parts]).max())


def _root(covariance: Tensor) -> Tensor:
    """A factor without zeros: C must do with any, and a term with a zero would not be tested."""
    factor, info = torch.linalg.cholesky_ex(covariance)
    factor = factor if int(info) == 0 else semidefinite_cholesky(covariance)
    generator = stream(SEED, "factor")
    rows = torch.randn(factor.shape, generator=generator, dtype=torch.float64)
    root: Tensor = factor @ torch.linalg.qr(rows).Q
    return root
