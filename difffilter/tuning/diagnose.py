"""Where a gradient turned non-finite: trajectory, step and channel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from difffilter.errors import NonFiniteError
from difffilter.filters.filter import Filter
from difffilter.logs.log import Log
from difffilter.parameters.parameters import Values
from difffilter.running.batch import run
from difffilter.scoring.losses import LossContext, total_loss
from difffilter.tuning.data import Batch

__all__ = ["gradient_error"]


def gradient_error(
    filter: Filter,
    values: Values,
    batch: Batch,
    loss: Mapping[str, float],
    context: LossContext,
    temperature: float | None,
) -> NonFiniteError:
    """The error for a batch whose gradient is not finite.

    Runs the batch again with the gradient towards every measurement: backpropagation goes
    from the last step to the first, so the last step with a non-finite entry is the origin.
    """
    z = batch.log.z.clone().requires_grad_()
    log: Log = replace(batch.log, z=z)
    detached = {name: value.detach() for name, value in values.items()}
    track = run(filter, log, detached, batch.start, temperature=temperature)
    total, _ = total_loss(loss, track, batch.log, context)
    gradient: Tensor = torch.autograd.grad(total, z)[0]
    bad = ~torch.isfinite(gradient)
    if not bool(bad.any()):
        name = next(iter(values))
        return NonFiniteError("gradient towards the parameters", 0, 0, name)
    step = int(bad.flatten(1).any(-1).nonzero()[-1])
    trajectory, channel = bad[step].reshape(-1, bad.shape[-1]).nonzero()[0].tolist()
    return NonFiniteError("gradient", trajectory, step, filter.channels[channel])
