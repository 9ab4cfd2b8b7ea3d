"""How well data determine tuned values: standard errors, and directions that stay free."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from difffilter.parameters.constraints import Above, Positive
from difffilter.parameters.parameters import ParameterSet
from difffilter.tuning.curvature import Expansion, chain_rule

__all__ = ["Certainty", "certainty"]

#: Half of the interval over which gradients are compared, in unconstrained numbers.
REACH = 1e-2
#: A direction is free where one standard error is a whole unit: a factor e of a scale.
FREE = 1.0
#: Newton's step from which a direction leads to a bound, not to a minimum: a scale whose
#: square the loss pays for falls to zero with steps of one half.
AHEAD = 0.4
#: Share of a unit direction from which a parameter is named with it.
NAMED = 0.25


@dataclass(frozen=True)
class Certainty:
    """Sampling errors of tuned values.

    Attributes:
        errors: standard error of each tuned number by entry name, in its unit; None where
            it is unknown: the data do not determine the value, the tuning ended on its way to
            it, or one trajectory alone tells nothing about others.
        free: one line for each direction that the data do not determine, or in which the tuning
            ended on its way.
    """

    errors: dict[str, float | None]
    free: tuple[str, ...]


def certainty(
    parameters: ParameterSet,
    expand: Callable[[], Expansion],
    count: int = 2,
    capped: bool = False,
) -> Certainty:
    """Sandwich estimate H^-1 (sum of s_b s_b^T) H^-1 at the current values.

    H is the Hessian of the loss, by central differences of its gradient; s_b is what
    trajectory b adds to that gradient, so that errors hold for dependent rows too
    [P. J. Huber, 1967].

    Args:
        expand: the loss to second order at the parameters' current values.
        count: trajectories or windows; of fewer than two, nobody knows how much the gradient
            varies: no error is known.
        capped: whether the tuning ended before it converged: what is then ahead in a direction
            is a minimum that it did not reach.
    """
    free = list(parameters.free().values())
    p = sum(x.numel() for x in free)
    now = expand()
    hessian = torch.stack([_slope(free, i, expand) for i in range(p)])
    values, vectors = torch.linalg.eigh(0.5 * (hessian + hessian.mT))
    # Standard deviation of the gradient, and the gradient, along each direction.
    noise = ((now.spread @ vectors) * vectors).sum(0).clamp_min(0.0).sqrt()
    ahead = (now.gradient @ vectors).abs()
    known = (values > 0.0) & (noise < FREE * values)
    determined = known & (ahead < AHEAD * values)
    short = known & ~determined if capped else torch.zeros_like(known)
    loose = vectors[:, ~determined]
    kept = vectors[:, determined]
    inverse = (kept / values[determined]) @ kept.mT
    covariance = inverse @ now.spread @ inverse
    chain = chain_rule(parameters)
    errors = ((chain @ covariance) * chain).sum(1).clamp_min(0.0).sqrt()
    # The share of each physical number's moves that lies in free directions.
    reach = chain.square().sum(1)
    lost = chain.square() @ loose.square().sum(1) / reach.clamp_min(1e-300)
    each = zip(_names(parameters), errors.tolist(), lost.tolist(), reach.tolist(), strict=True)
    return Certainty(
        {
            name: error if part < 0.5 and count > 1 else None
            for name, error, part, moves in each
            if moves > 0.0
        },
        tuple(
            _told(parameters, chain, direction, bool(early))
            for direction, early in zip(loose.mT, short[~determined], strict=True)
        ),
    )


def _slope(free: list[torch.nn.Parameter], at: int, expand: Callable[[], Expansion]) -> Tensor:
    """Row of the Hessian: how the gradient changes with one number."""
    for x in free:
        if at < x.numel():
            break
        at -= x.numel()
    found = []
    flat = x.data.view(-1)
    centre = float(flat[at])
    for side in (1.0, -1.0):
        flat[at] = centre + side * REACH
        found.append(expand().gradient)
    flat[at] = centre
    return (found[0] - found[1]) / (2.0 * REACH)


def _names(parameters: ParameterSet) -> list[str]:
    declarations = parameters.declarations
    return [entry for name in parameters.free() for entry in declarations[name].entries()]


def _told(parameters: ParameterSet, chain: Tensor, direction: Tensor, early: bool) -> str:
    """A free direction in words."""
    entries = _names(parameters)
    scales = [
        isinstance(parameters.declarations[name].constraint, (Positive, Above))
        for name, raw in parameters.free().items()
        for _ in range(raw.numel())
    ]
    named = [
        (entries[int(column.abs().argmax())], part, scale)
        for column, part, scale in zip(chain.mT, direction.tolist(), scales, strict=True)
        if abs(part) > NAMED
    ]
    names = list(dict.fromkeys(entry for entry, _, _ in named))
    if early:
        return f"{', '.join(names)}: the tuning ended before their best values, give it more steps"
    if len(names) == 1:
        return f"{names[0]}: the data do not determine it, or push it to its bound"
    together = " and ".join([", ".join(names[:-1]), names[-1]])
    if len(named) == 2 and all(scale for _, _, scale in named):
        kind = "ratio" if named[0][1] * named[1][1] > 0.0 else "product"
        return f"{together}: the data determine them only as a {kind}"
    return f"{together}: the data do not determine them all, only in combination"
