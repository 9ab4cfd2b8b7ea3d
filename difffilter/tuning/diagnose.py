"""Where a gradient turned non-finite: trajectory, step and channel."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from difffilter.errors import NonFiniteError
from difffilter.logs.log import Log
from difffilter.parameters.parameters import Values
from difffilter.running.batch import run
from difffilter.running.problem import Problem
from difffilter.running.tangents import detached
from difffilter.scoring.losses import total_loss

__all__ = ["gradient_error"]


def gradient_error(problem: Problem, values: Values) -> NonFiniteError:
    """The error for a problem whose gradient is not finite.

    Runs the batch again with the gradient towards every measurement: backpropagation goes
    from the last step to the first, so the last step with a non-finite entry is the origin.
    """
    z = problem.log.z.clone().requires_grad_()
    log: Log = replace(problem.log, z=z)
    track = run(
        problem.recipe, log, detached(values), problem.start, temperature=problem.temperature
    )
    total, _ = total_loss(problem.losses, track, problem.log, problem.context)
    gradient: Tensor = torch.autograd.grad(total, z)[0]
    bad = ~torch.isfinite(gradient)
    if not bool(bad.any()):
        name = next(iter(values))
        return NonFiniteError("gradient towards the parameters", 0, 0, name)
    step = int(bad.flatten(1).any(-1).nonzero()[-1])
    trajectory, channel = bad[step].reshape(-1, bad.shape[-1]).nonzero()[0].tolist()
    return NonFiniteError("gradient", trajectory, step, problem.recipe.channels[channel])
