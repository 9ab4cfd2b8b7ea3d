"""What a log says about itself, and with truth about its sensors: before any filter runs."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from difffilter.errors import DifffilterError
from difffilter.filters.filter import Filter
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log
from difffilter.logs.residuals import Correlated, Residuals, residuals
from difffilter.logs.timing import Pulse, Timing, pulse, timing
from difffilter.running.batch import start_belief
from difffilter.scenario.case import Case
from difffilter.scenario.estimation import started
from difffilter.scenario.model import as_case
from difffilter.scenario.plausibility import against_truth, unit_of

__all__ = ["Inspection", "Proposal", "inspect_log"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Proposal:
    """Published values that a log with truth proposes for a sensor.

    Attributes:
        sensor: name; channels: its channels.
        sigma, bias: one number per channel, in the channel's SI unit.
        unit: that unit.
        error: the error that goes on in time, common to all channels or each one's own; None
            where errors are new in each row.
        common: whether it is common.
        reasons: a line each.
    """

    sensor: str
    channels: tuple[str, ...]
    sigma: tuple[float, ...]
    bias: tuple[float, ...]
    unit: str
    error: Correlated | None
    common: bool
    reasons: tuple[str, ...]


@dataclass(frozen=True)
class Inspection:
    """What :func:`inspect_log` found.

    Attributes:
        timing: of the rows; pulses: of each channel.
        start: mean and standard deviation by state that a filter would start with, or why there
            is no start; None without a case.
        residuals: by channel, with truth; common: by sensor, the error that its channels share.
        proposals: one per sensor.
        errors: (T, m), measurement minus what the truth gives, for a picture; None without truth.
    """

    timing: Timing
    pulses: dict[str, Pulse]
    start: dict[str, tuple[float, float]] | str | None = None
    residuals: dict[str, Residuals] | None = None
    common: dict[str, Correlated] | None = None
    proposals: tuple[Proposal, ...] = ()
    errors: Array | None = None

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        found = asdict(self)
        del found["errors"]
        return found

    def toml(self) -> str:
        """The proposals as ``[parameters]`` of a scenario, each with its reasons."""
        lines = ["# Proposed by difffilter inspect from one log with truth."]
        for one in self.proposals:
            for key, values in (("sigma", one.sigma), ("bias", one.bias)):
                lines += ["", *(f"# {reason}" for reason in one.reasons if reason.startswith(key))]
                lines += [f"[parameters.{one.sensor}.{key}]", f"value = {_toml(values)}"]
                lines += [f'unit = "{one.unit}"'] if one.unit != "1" else []
                lines.append('source = "residuals against truth"')
            rest = [r for r in one.reasons if not r.startswith(("sigma", "bias"))]
            lines += [f"# {reason}" for reason in rest]
        return "\n".join(lines) + "\n"


def inspect_log(
    log: Log, case: Case | Filter | None = None, system: str | None = None
) -> Inspection:
    """Rates, gaps and silent channels of a log; with a case its start; with truth its errors.

    Args:
        log: one trajectory, z (T, m), as it was read.
        case: a scenario, a model or a filter: what the channels measure.
        system: which system's sensors and start; the one that is tuned if None.

    Raises:
        InputError: channels that the system has and the log has not.

    Example:
        >>> import torch
        >>> from difffilter import ConstantVelocity, Filter, Log, Position, inspect_log
        >>> time = torch.arange(500).double() / 10
        >>> noise = torch.randn(500, 1, generator=torch.Generator().manual_seed(0)).double()
        >>> log = Log(("p_1",), time, 2 * noise, truth=0 * noise, truth_states=("x",))
        >>> recipe = Filter(ConstantVelocity(axes=1), (Position(name="p", axes=1, sigma=1.0),))
        >>> round(inspect_log(log, recipe).residuals["p_1"].sigma)
        2
    """
    time = log.time.numpy()
    columns = zip(log.channels, log.z.unbind(-1), strict=True)
    pulses = {name: pulse(time, values.numpy()) for name, values in columns}
    found = Inspection(timing(time), pulses)
    if case is None:
        return found
    case = as_case(case)
    recipe = case.system(system)
    start = _start(case, recipe, log)
    if log.truth is None or not isinstance(recipe, Filter):
        return Inspection(found.timing, pulses, start)
    errors, each = _errors(recipe, log.only(recipe.channels))
    told: dict[str, Residuals] = {}
    shared: dict[str, Correlated] = {}
    proposals, at = [], 0
    for sensor, names, unit in each:
        stats, common = residuals(time, errors[:, at : at + len(names)], names)
        at += len(names)
        told |= stats
        if common is not None:
            shared[sensor] = common
        if len(stats) == len(names):
            proposals.append(_proposal(sensor, unit, stats, common))
    return Inspection(
        timing=found.timing,
        pulses=pulses,
        start=start,
        residuals=told,
        common=shared,
        proposals=tuple(proposals),
        errors=errors,
    )


def _start(case: Case, recipe: Any, log: Log) -> dict[str, tuple[float, float]] | str:
    """By state: mean and standard deviation; or why there is no start."""
    try:
        start = started(case, recipe, log).start
        if start is None or not isinstance(recipe, Recipe):
            return "the system takes none"
        constants = recipe.prepare(recipe.published(log.z.dtype), None)
        belief = start_belief(recipe, constants, start)
    except DifffilterError as error:
        return str(error)
    mean = belief.mean.reshape(-1).tolist()
    spread = belief.deviations.square().sum(-1).sqrt().reshape(-1).tolist()
    return dict(zip(recipe.states, zip(mean, spread, strict=True), strict=False))


def _errors(recipe: Filter, log: Log) -> tuple[Array, list[tuple[str, tuple[str, ...], str]]]:
    """Measurements minus what the truth gives, without bias; each sensor: name, channels, unit."""
    parts, sensors = [], []
    for sensor, at, expected in against_truth(recipe, log):
        parts.append(sensor.residual(log.z[:, at : at + len(sensor.channels)], expected))
        name = str(getattr(sensor, "name", sensor.channels[0]))
        sensors.append((name, tuple(sensor.channels), unit_of(recipe, sensor)))
    return torch.cat(parts, dim=-1).numpy(), sensors


def _proposal(
    name: str, unit: str, stats: dict[str, Residuals], common: Correlated | None
) -> Proposal:
    """Sigma by the median absolute deviation, bias by the median, and why."""
    each = list(stats.values())
    own = [r.own for r in each if r.own.sigma > 0.0]
    error = common
    if common is None and len(own) * 2 > len(each):
        error = Correlated(*(float(np.median([getattr(o, k) for o in own])) for k in KEYS))
    reasons = [
        f"sigma: 1.4826 times the median absolute deviation of {min(r.count for r in each)} or "
        f"more errors; beyond 3 sigma: {100 * max(r.tails for r in each):.2g} % (0.27 if normal)",
        "bias: the median error",
    ]
    if error is not None:
        whose = "common to all channels" if common is not None else "of each channel's own"
        reasons.append(
            f"error: Gauss-Markov, {whose}, sigma {error.sigma:.3g} {unit}, time {error.time:.3g} "
            f"s, beside white noise of sigma {error.white:.3g} {unit}: a filter that takes errors "
            "as new in each row is too sure; adapt it, or tune with a consistency loss"
        )
    return Proposal(
        sensor=name, channels=tuple(stats), sigma=tuple(r.sigma for r in each),
        bias=tuple(r.bias for r in each), unit=unit,
        error=error, common=common is not None, reasons=tuple(reasons),
    )  # fmt: skip


KEYS = ("white", "sigma", "time")


def _toml(values: tuple[float, ...]) -> str:
    rounded = [float(f"{value:.4g}") for value in values]
    return repr(rounded[0]) if len(rounded) == 1 else repr(rounded)
