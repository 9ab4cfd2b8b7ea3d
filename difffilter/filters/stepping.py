"""The step that streaming, batch runs and training all execute.

Pure: torch operations of static shape on (..., n) tensors, no hidden state, no branch on a
tensor's value. Branches are on the recipe alone.
"""

from __future__ import annotations

import torch
from torch import Tensor

from difffilter.core.beliefs import Belief, Measurement, Record
from difffilter.core.compression import compress
from difffilter.core.linearised import Linearised
from difffilter.filters.filter import Filter
from difffilter.filters.prediction import linearise, predict
from difffilter.motions.retraction import moved
from difffilter.parameters.parameters import Values
from difffilter.robust.groups import spread
from difffilter.robust.recovery import STREAK, Recovery
from difffilter.robust.weighing import reweigh, weigh_once

__all__ = ["step"]


def step(
    filter: Filter, constants: Values, belief: Belief, measurement: Measurement
) -> tuple[Belief, Record]:
    """One time step: predict to the measurement's time, linearise, weigh, condition.

    Args:
        filter: the recipe.
        constants: from :meth:`Filter.prepare`.
        belief: at the previous time, mean (..., n).
        measurement: z (..., m) with NaN where a channel is missing, dt, known inputs.

    Returns:
        The belief after the measurement, and the record of what was done. Nothing is checked
        here: a belief may turn out not finite (:func:`difffilter.run` raises then).
    """
    if filter.fusion is not None:
        return filter.fusion.step(filter, constants, belief, measurement)
    predicted = predict(filter, constants, belief, measurement)
    linear, present = linearise(filter, constants, predicted, measurement)
    isolated = None
    if filter.federated:
        linear, present, isolated = _isolate(filter, linear, present)
    memory, widening = belief.memory, None
    if filter.adaptation is not None:
        linear, memory = filter.adaptation.before_condition(
            memory, linear, present, measurement.inputs, constants
        )
    if filter.recovery is not None:
        streak = torch.where(present.any(-1), belief.memory[STREAK], 0.0)
        linear, widening = _recover(filter.recovery, streak, linear, constants)
    weigh = reweigh if filter.iterations else weigh_once
    conditioned, record = weigh(filter, constants, linear, present, widening)
    if filter.adaptation is not None:
        memory = filter.adaptation.after_condition(
            memory, linear, conditioned, record.weight, present, constants
        )
    if filter.recovery is not None:
        streak = filter.recovery.count(belief.memory[STREAK], record.weight, present)
        memory = {**memory, STREAK: streak}
    if isolated is not None:
        record = record._replace(isolated=isolated)
    n = len(filter.motion.tangent)
    posterior = conditioned.deviations[..., :n, :]
    if posterior.shape[-1] > n:  # common noise, cubature: static, by the recipe
        posterior = compress(posterior)
    mean, posterior = moved(filter.motion, linear.mean, conditioned.shift[..., :n], posterior)
    return Belief(mean, posterior, memory), record


def _isolate(
    filter: Filter, linear: Linearised, present: Tensor
) -> tuple[Linearised, Tensor, Tensor]:
    """Take out whole sensors with anything that is not finite; the record names them."""
    finite = torch.isfinite(linear.innovation.square()) & torch.isfinite(linear.independent)
    finite = finite & torch.isfinite(linear.observed).all(-1)
    isolated = spread(filter.members, [~finite[..., [*own]].all(-1) for own in filter.members])
    sound = linear._replace(
        innovation=torch.where(isolated, 0.0, linear.innovation),
        observed=torch.where(isolated.unsqueeze(-1), 0.0, linear.observed),
        independent=torch.where(isolated, 1.0, linear.independent),
        total=torch.where(isolated, 1.0, linear.total),
    )
    return sound, present & ~isolated, isolated


def _recover(
    recovery: Recovery, streak: Tensor, linear: Linearised, constants: Values
) -> tuple[Linearised, Tensor | None]:
    """The predicted covariance grown, or the factor by which gate and weights are widened."""
    growth = recovery.growth(streak, constants)
    if recovery.action == "widen":
        return linear, growth
    columns = growth.sqrt().unsqueeze(-1).expand(*growth.shape, linear.own)
    columns = torch.nn.functional.pad(columns, (0, linear.common), value=1.0).unsqueeze(-2)
    grown = linear._replace(
        deviations=linear.deviations * columns, observed=linear.observed * columns
    )
    return grown, None
