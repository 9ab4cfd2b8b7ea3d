"""Red flags: what makes tuned values suspect, whatever the RMSE says.

Each is a pure function of what is known of a tuning and of its held-out runs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
from torch import Tensor

from difffilter.parameters.constraints import Above, Below, Bounded, Interval
from difffilter.parameters.parameters import Parameter, Values

__all__ = [
    "Flag",
    "capped",
    "direction_flags",
    "luck_flags",
    "memory_flags",
    "merged",
    "noise_flags",
    "refusal_flags",
    "sensor_flags",
    "value_flags",
]

#: Share of the range, or of the published value, within which a value is at its bound.
AT_BOUND = 0.01
#: Standard deviation of process noise relative to the published one: below it there is none.
DEAD = 0.01
#: Sigma in spreads of its residuals from which a sensor is switched off.
SILENT = 10.0
#: Share of its measurements that are rejected, from which a sensor is switched off.
REFUSED = 0.5
#: Spreads of its residuals by which a bias may be off.
BIASED = 3.0
#: NEES along a direction that is honest.
HONEST = (0.3, 3.0)
#: Share of the runs on which a gain must not rest.
FEW_RUNS = 0.05
#: Share of the gain that must be left without them, or in the median run.
LEFT = 0.1


@dataclass(frozen=True)
class Flag:
    """One reason not to adopt as it is.

    Attributes:
        kind: ``bound``, ``undetermined``, ``process-noise``, ``sensor-off``, ``bias``,
            ``direction``, ``lucky-runs``, ``overfit`` or ``capped``.
        about: parameter, channel or direction.
        text: what was found, in plain words.
        cost: what it costs when the condition fails.
        monitor: what to watch in operation.
        keep: parameters to keep as published to avoid it; empty where that is no cure.
    """

    kind: str
    about: str
    text: str
    cost: str
    monitor: str
    keep: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def value_flags(
    declarations: Mapping[str, Parameter], values: Values, training: Mapping[str, Any]
) -> list[Flag]:
    """Values at a bound, or that the data do not determine."""
    found: list[Flag] = []
    errors: Mapping[str, float | None] = training.get("standard_errors", {})
    told = [line for line in training.get("undetermined", ()) if "the data" in line]
    for name, parameter in declarations.items():
        if not parameter.tuned:
            continue
        before, after = parameter.tensor().reshape(-1), values[name].reshape(-1)
        for entry, old, new in zip(
            parameter.entries(), before.tolist(), after.tolist(), strict=True
        ):
            if old == new:
                continue
            bound = _bound(parameter, old, new)
            free = errors.get(entry, 0.0) is None and any(entry in line for line in told)
            if bound is not None:
                text = f"{entry} = {new:.3g} {parameter.unit} lies at its bound {bound:g}"
                found.append(
                    Flag("bound", entry, text, "the data asked for what is not allowed: the model "
                         "lacks something, and the number stands for it",
                         f"the innovations of what {entry} acts on", (name,))
                )  # fmt: skip
            elif free:
                text = f"{entry} = {new:.3g} {parameter.unit} (published {old:.3g}): the data do "
                text += "not determine it"
                found.append(
                    Flag("undetermined", entry, text, "its effect outside the training data is "
                         "not known", f"the innovations of what {entry} acts on", (name,))
                )  # fmt: skip
    return found


def noise_flags(states: tuple[str, ...], before: Tensor, after: Tensor, names: tuple[str, ...]) -> (
    list[Flag]
):  # fmt: skip
    """Process noise that went to zero.

    Args:
        before, after: (n,), standard deviation that one step adds to each state, published
            and tuned.
        names: tuned parameters that make it.
    """
    found = []
    for state, old, new in zip(states, before.tolist(), after.tolist(), strict=True):
        if old > 0.0 and new < DEAD * old:
            text = f"the process noise of {state} went to {new / old:.2g} of the published one"
            found.append(
                Flag("process-noise", state, text,
                     f"the filter takes {state} as foretold for ever, and follows no change of it",
                     f"the mean of the innovations over 20 rows: it leaves 0 when {state} changes",
                     names)
            )  # fmt: skip
    return found


def sensor_flags(
    errors: Tensor,
    sigma: tuple[Tensor, Tensor],
    channels: tuple[str, ...],
    shift: Tensor,
    owners: Mapping[str, tuple[str, ...]],
) -> list[Flag]:
    """Sensors that are switched off by their sigma, and biases that no residual supports.

    Args:
        errors: (T, ..., m), measured minus true under the tuned values, NaN where unknown.
        sigma: published and tuned standard deviations of the channels' noise, (m,) each.
        shift: (m,), median of those errors less that under the published values.
        owners: tuned parameters of each channel's sensor.
    """
    found = []
    for at, name in enumerate(channels):
        known = errors[..., at][torch.isfinite(errors[..., at])]
        if len(known) < 10:
            continue
        centre = float(known.median())
        spread = 1.4826 * float((known - centre).abs().median())
        if spread <= 0.0:
            continue
        old, new = float(sigma[0][at]), float(sigma[1][at])
        if new > SILENT * spread and new > 1.01 * old:
            text = f"{name}: sigma {new:.3g}, though its residuals spread by {spread:.2g} alone"
            keep = tuple(n for n in owners.get(name, ()) if "sigma" in n)
            found.append(
                Flag("sensor-off", name, f"{text}: it is switched off",
                     "the filter stands on the other sensors alone",
                     f"the innovations of {name} against {new:.3g}", keep)
            )  # fmt: skip
        if abs(centre) > BIASED * spread and abs(float(shift[at])) > 0.5 * abs(centre):
            text = f"{name}: a bias off by {abs(centre):.3g}, {abs(centre) / spread:.0f} spreads "
            text += f"({spread:.2g}) of its residuals"
            keep = tuple(n for n in owners.get(name, ()) if "bias" in n) or owners.get(name, ())
            found.append(
                Flag("bias", name, text, f"{name} pulls the estimate off wherever it is trusted",
                     f"the mean innovation of {name}: 0 is right", keep)
            )  # fmt: skip
    return found


def refusal_flags(before: Mapping[str, float], after: Mapping[str, float]) -> list[Flag]:
    """Channels most of whose measurements only the tuned filter rejects: shares, 0 to 1."""
    return [
        Flag("sensor-off", name, f"{name}: {100 * share:.0f} % of its measurements are rejected "
             f"({100 * before.get(name, 0.0):.0f} % with the published values)",
             "the filter stands on the other sensors alone", f"the share of rejected {name}")
        for name, share in after.items()
        if share > REFUSED and before.get(name, 0.0) <= REFUSED
    ]  # fmt: skip


def direction_flags(
    published: Mapping[str, float], tuned: Mapping[str, float]
) -> list[Flag]:  # fmt: skip
    """Claims that do not hold along some principal direction of P."""
    found = []
    low, high = HONEST
    for name, value in tuned.items():
        if low <= value <= high:
            continue
        before = published.get(name, math.nan)
        size = f"NEES {value:.2g} (published {before:.2g})"
        if value > high:
            text = f"{name}: errors {math.sqrt(value):.1f} times as large as claimed; {size}"
            cost = "whoever trusts the covariance (gates, fusion, alarms) is misled"
        else:
            text = f"{name}: errors {1 / math.sqrt(max(value, 1e-12)):.1f} times smaller than "
            text += f"claimed; {size}"
            cost = "gates built on the covariance are too wide, and fusion trusts it too little"
        found.append(Flag("direction", name, text, cost, "NIS per channel: 1 is right"))
    return found


def luck_flags(published: Tensor, tuned: Tensor) -> list[Flag]:
    """A gain that rests on few runs.

    Args:
        published, tuned: (B,), squared errors of each run, over the same rows.
    """
    count = len(published)
    if count < 1.0 / FEW_RUNS or float(published.sum()) <= 0.0:
        return []
    ratio = math.sqrt(float(tuned.sum() / published.sum()))
    if ratio >= 1.0:
        return []
    few = max(int(FEW_RUNS * count), 1)
    rest = (published - tuned).argsort(descending=True)[few:]
    without = math.sqrt(float(tuned[rest].sum() / published[rest].sum()))
    median = math.sqrt(float((tuned / published.clamp_min(1e-300)).median()))
    least = 1.0 - LEFT * (1.0 - ratio)
    if without < least or median < least:
        return []
    text = f"the gain rests on {few} of {count} runs: without them the ratio is {without:.3f}, in "
    text += f"the median run {median:.3f}, though {ratio:.3f} over all"
    return [
        Flag("lucky-runs", "runs", text, "the usual run gains nothing",
             "how often runs like those few come")
    ]  # fmt: skip


def memory_flags(
    train: tuple[float, float, float], held: tuple[float, float, float]
) -> list[Flag]:  # fmt: skip
    """A gain on the training data beyond that on held-out data by more than both intervals.

    Args:
        train, held: RMSE relative to the published values, with its 95 % interval.
    """
    if not train[2] < held[1]:
        return []
    text = f"in training RMSE is {train[0]:.3f} of the published one, held out {held[0]:.3f}: "
    text += "the values know the training data"
    return [
        Flag("overfit", "training", text, "elsewhere the gain is smaller still",
             "the error against an independent reference")
    ]  # fmt: skip


def capped(training: Mapping[str, Any]) -> list[Flag]:
    """A tuning that ended at its cap."""
    end = training.get("end")
    if end not in ("steps", "runs"):
        return []
    text = f"the tuning ended at its cap of {'steps' if end == 'steps' else 'filter runs'}, before "
    text += "it converged"
    return [
        Flag("capped", "tuning", text, "these are values on the way, not the best ones",
             "nothing: go on tuning with a larger cap")
    ]  # fmt: skip


def merged(flags: list[Flag]) -> list[Flag]:
    """One flag for each kind and set of cures, so that a page stays short."""
    found: dict[tuple[str, tuple[str, ...]], Flag] = {}
    for flag in flags:
        key = (flag.kind, flag.keep)
        known = found.get(key)
        if known is None:
            found[key] = flag
        else:
            found[key] = replace(
                known,
                about=f"{known.about}, {flag.about}",
                text=f"{known.text}; {flag.text}",
            )
    return list(found.values())


def _bound(parameter: Parameter, old: float, new: float) -> float | None:
    """The bound at which a value lies and the published one does not."""
    kind = parameter.constraint
    low = getattr(kind, "low", None) if isinstance(kind, Above | Interval | Bounded) else None
    high = getattr(kind, "high", None) if isinstance(kind, Below | Interval | Bounded) else None
    for bound in (low, high):
        if bound is None or not math.isfinite(bound):
            continue
        ends = [end for end in (low, high) if end is not None and math.isfinite(end)]
        size = abs(ends[-1] - ends[0]) if len(ends) > 1 else abs(old - bound)
        if abs(new - bound) <= AT_BOUND * size < abs(old - bound):
            return float(bound)
    return None
