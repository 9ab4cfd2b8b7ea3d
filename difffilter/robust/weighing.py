"""Weigh and condition: once from the innovation, or iteratively from residuals (M-EKF)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from difffilter.core.beliefs import Record
from difffilter.core.conditioning import condition
from difffilter.core.cubature import doubled
from difffilter.core.equations import Conditioned
from difffilter.core.linearised import Linearised
from difffilter.errors import InputError
from difffilter.parameters.constraints import Interval
from difffilter.parameters.parameters import Parameter, Values
from difffilter.parameters.values import Constants
from difffilter.robust.federation import Federation
from difffilter.robust.gate import Gate
from difffilter.robust.mad import mad_scale
from difffilter.robust.residuals import STANDARDISATIONS, GateTest, Residuals, Scales
from difffilter.weights.registry import plain
from difffilter.weights.weight import Weight

__all__ = ["STANDARDISATIONS", "Weighing"]


@dataclass(frozen=True, kw_only=True)
class Weighing:
    """What weight each channel gets, and the belief conditioned with these weights.

    Attributes:
        weight, standardise, iterations, weigh_prior, mad, distance, gate: as for
            :class:`difffilter.Filter`.
        groups: indices of the channels that share one weight and one gate; None where each
            channel is by itself.
        federation: the local filters that condition, or None.

    Raises:
        InputError: options that are unknown or do not fit together.
    """

    weight: Weight = plain
    standardise: str = "innovation"
    iterations: int = 0
    weigh_prior: bool = False
    mad: bool = False
    groups: tuple[tuple[int, ...], ...] | None = None
    distance: str = "rms"
    gate: Gate | None = None
    federation: Federation | None = None

    def __post_init__(self) -> None:
        _ = self.residuals  # checked when it is made
        if self.iterations < 0:
            raise InputError(f"iterations: found {self.iterations}, expected 0 or more")
        if (self.weigh_prior or self.mad) and not self.iterations:
            raise InputError("weigh_prior and mad: expected iterations of 1 or more with them")
        if self.mad and self.groups is not None:
            raise InputError("mad: expected scope channel with it")

    @cached_property
    def residuals(self) -> Residuals:
        """What weights and gates see of a step."""
        return Residuals(self.standardise, self.distance, self.groups)

    @property
    def floor(self) -> tuple[Parameter, ...]:
        """``prior.floor``, where the prior's rows are weighed."""
        if not self.weigh_prior:
            return ()
        meaning = "least weight of a prior row"
        return (Parameter("prior.floor", 1e-4, Interval(), source="paper 3", meaning=meaning),)

    def prepare(self, values: Values) -> dict[str, Tensor]:
        """Constants of weight, gate and local filters."""
        dtype = next(iter(values.values())).dtype if values else torch.float64
        constants = dict(self.weight.prepare(values))
        if self.gate is not None:
            most = max(map(len, self.groups or ((0,),)))
            constants.update(self.gate.prepare(values, most))
        if self.federation is not None:
            constants.update(self.federation.prepare(dtype))
        return constants

    def condition(
        self,
        constants: Constants,
        linear: Linearised,
        present: Tensor,
        widening: Tensor | None = None,
    ) -> tuple[Conditioned, Record]:
        """The belief's shift and deviations, and the record.

        ``widening`` (..., m) divides every NIS that gate and weight see (see ``recovery``).
        """
        how = self._reweighed if self.iterations else self._weighed_once
        return how(constants, linear, present, widening)

    def weights(self, constants: Constants, linear: Linearised, present: Tensor) -> Tensor:
        """(..., m), the weights that :meth:`condition` ends with."""
        if self.iterations:
            return self._reweighed(constants, linear, present, None)[1].weight
        return self._once(constants, linear, present, None)[1]

    def _weighed_once(
        self,
        constants: Constants,
        linear: Linearised,
        present: Tensor,
        widening: Tensor | None,
    ) -> tuple[Conditioned, Record]:
        """Weights from the nominal innovation, one conditioning."""
        s, weight, gate = self._once(constants, linear, present, widening)
        conditioned = self._condition(constants, linear, linear.deviations, linear.observed, weight)
        prior_weight = torch.ones_like(linear.deviations[..., : linear.size, 0])
        return conditioned, _record(linear, s, weight, prior_weight, gate, present)

    def _once(
        self, constants: Constants, linear: Linearised, present: Tensor, widening: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Residuals in sigmas, weights and gates from the nominal innovation, each (..., m)."""
        scales = self.residuals.scales(linear, widening)
        s = self.residuals.distances(linear, linear.innovation, present, scales)
        weight = self.weight(s, constants, constants.get("temperature"))
        test = self._test(linear, present, scales)
        weight, gate = self._gated(constants, weight, test)
        return s, weight * present, gate

    def _reweighed(
        self,
        constants: Constants,
        linear: Linearised,
        present: Tensor,
        widening: Tensor | None,
    ) -> tuple[Conditioned, Record]:
        """M-EKF: iteratively reweighted regression of [prediction; measurement].

        Paper 3, eqs. (15)-(27). Weighing the prediction scales the columns of the deviations
        by 1/sqrt(w_x); the shift of identity rows is minus the whitened prior residual, so that
        no system is solved.
        """
        n = linear.size
        weight = present.to(linear.mean.dtype)
        gate = torch.ones_like(weight)
        prior_weight = torch.ones_like(linear.deviations[..., : linear.size, 0])
        s = linear.innovation
        temperature = constants.get("temperature")
        scales = self.residuals.scales(linear, widening)
        test = self._test(linear, present, scales)  # of the innovation: the same throughout
        # Until the weights are final only residuals count: rows that carry them stand for X.
        rows, split = self._residual_rows(linear)
        conditioned = self._condition(constants, linear, rows, linear.observed, weight)
        for i in range(self.iterations):
            residual = conditioned.residual
            if linear.common:
                residual = linear.innovation - conditioned.shift[..., split:]
            s = self.residuals.distances(linear, residual, present, scales)
            prior_s = -conditioned.shift[..., :split]
            if self.mad:
                scale = mad_scale(torch.cat([torch.where(present, s, torch.nan), prior_s], dim=-1))
                s, prior_s = s / scale, prior_s / scale
            weight = self.weight(s, constants, temperature)
            weight, gate = self._gated(constants, weight, test)
            weight = weight * present
            rows = linear.deviations if i + 1 == self.iterations else rows
            deviations, observed = rows, linear.observed
            if self.weigh_prior:
                floor = constants["prior.floor"]
                prior_weight = floor + (1.0 - floor) * self.weight(prior_s, constants, temperature)
                ones = torch.ones_like(linear.deviations[..., 0, linear.own :])
                root = [prior_weight.rsqrt()] * (linear.own // n)
                columns = torch.cat([*root, ones], dim=-1).unsqueeze(-2)
                deviations, observed = rows * columns, observed * columns
            conditioned = self._condition(constants, linear, deviations, observed, weight)
        return conditioned, _record(linear, s, weight, prior_weight, gate, present)

    def _residual_rows(self, linear: Linearised) -> tuple[Tensor, int]:
        """Rows whose shifts tell the residuals, and how many of them tell the prior's.

        Identity rows: minus the whitened prior residual. With common noise also the rows of
        H X without it: H (x - m), which the measurement's own rows do not tell.
        """
        n, k = linear.size, linear.deviations.shape[-1]
        rows = linear.deviations[..., :0, :]
        if self.weigh_prior:
            unit = torch.eye(n, dtype=rows.dtype, device=rows.device)
            if linear.own > n:  # cubature: both halves
                unit = doubled(unit)
            white = torch.nn.functional.pad(unit, (0, k - linear.own))
            rows = white.expand(*linear.mean.shape[:-1], n, k)
        split = rows.shape[-2]
        if linear.common:
            own = linear.observed[..., : linear.own]
            own = torch.nn.functional.pad(own, (0, linear.common))
            rows = torch.cat([rows, own], dim=-2)
        return rows, split

    def _condition(
        self,
        constants: Constants,
        linear: Linearised,
        deviations: Tensor,
        observed: Tensor,
        weight: Tensor,
    ) -> Conditioned:
        """Condition so that a weight means R_ii -> R_ii / w, also for the common part of R."""
        noise = linear.independent
        if linear.common:
            noise = noise + (1.0 - weight) * (linear.total - linear.independent)
        if self.federation is not None:
            return self.federation.condition(
                deviations, observed, linear.innovation, weight, noise, constants
            )
        return condition(deviations, observed, linear.innovation, weight, noise)

    def _test(self, linear: Linearised, present: Tensor, scales: Scales) -> GateTest | None:
        return None if self.gate is None else self.residuals.test(linear, present, scales)

    def _gated(
        self, constants: Constants, weight: Tensor, test: GateTest | None
    ) -> tuple[Tensor, Tensor]:
        """Weight and gate of each channel."""
        if self.gate is None or test is None:
            return weight, torch.ones_like(weight)
        temperature = constants.get("temperature")
        return self.gate.weigh(weight, test.nis, test.degrees, constants, temperature, test.share)


def _record(
    linear: Linearised, s: Tensor, weight: Tensor, prior: Tensor, gate: Tensor, present: Tensor
) -> Record:
    return Record(
        innovation=linear.innovation,
        observed=linear.observed,
        noise=linear.independent,
        standardised=s,
        weight=weight,
        prior_weight=prior,
        gate=gate,
        modes=s[..., :0],
        present=present,
        isolated=torch.zeros_like(present),
    )
