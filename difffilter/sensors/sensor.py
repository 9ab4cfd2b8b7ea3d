"""What a filter asks of a sensor model, the parameters all share, and the user's own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from difffilter.core.jacobian import jacobian_times
from difffilter.core.linalg import semidefinite_cholesky
from difffilter.errors import InputError
from difffilter.parameters.constraints import Covariance, Positive, Real
from difffilter.parameters.parameters import Number, Parameter, Values, as_number
from difffilter.parameters.values import Constants

__all__ = ["Difference", "FunctionSensor", "Noise", "Sensor", "difference", "wrap"]

Inputs = Mapping[str, Tensor]
Difference = Callable[[Tensor, Tensor], Tensor]


class Noise(NamedTuple):
    """R = diag(independent) + common common^T: (..., m) and (..., m, u).

    With a full R everything stands in ``common`` and ``independent`` is zero; ``total``
    is the diagonal of R.
    """

    independent: Tensor
    common: Tensor
    total: Tensor

    def times(self, factor: Tensor) -> Noise:
        """The noise of errors that are factor (..., m) times as large."""
        square = factor.square()
        common = self.common * factor.unsqueeze(-1) if self.common.shape[-1] else self.common
        return Noise(self.independent * square, common, self.total * square)


class Sensor(Protocol):
    """What a filter asks of a sensor model with m channels."""

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the m channels, as in logs."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Declared parameters."""

    def prepare(self, values: Values) -> Constants:
        """Constants of a run, from the physical values."""

    def predict(self, state: Tensor, inputs: Inputs, constants: Constants) -> Tensor:
        """h(x): (..., n) -> (..., m)."""

    def observe(
        self, state: Tensor, deviations: Tensor, inputs: Inputs, constants: Constants
    ) -> tuple[Tensor, Tensor]:
        """h(x) and H X with H the Jacobian of h at x: (..., m) and (..., m, k)."""

    def residual(self, z: Tensor, predicted: Tensor) -> Tensor:
        """Measurement minus prediction, elementwise (angles wrap here)."""

    def noise(self, mean: Tensor, inputs: Inputs, constants: Constants) -> Noise:
        """Measurement noise, nominal, of the state (..., n) and the row's known inputs.

        Its parts broadcast with the measurement: (m,) where the noise is always the same,
        (..., m) where it depends on state or inputs.
        """


def difference(z: Tensor, predicted: Tensor) -> Tensor:
    """z - predicted."""
    return z - predicted


def wrap(z: Tensor, predicted: Tensor) -> Tensor:
    """z - predicted wrapped to [-pi, pi)."""
    return torch.remainder(z - predicted + torch.pi, 2 * torch.pi) - torch.pi


@dataclass(frozen=True)
class NoiseAndBias:
    """Parameters ``NAME.sigma`` and ``NAME.bias`` that every sensor of m channels has.

    sigma: one standard deviation, one per channel, or a full covariance (m x m).
    bias: one number for all channels or one per channel, added to the prediction.
    """

    name: str
    channels: tuple[str, ...]
    sigma: Number
    bias: Number
    unit: str

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        m, sigma, bias = len(self.channels), as_number(self.sigma), as_number(self.bias)
        shape = torch.tensor(sigma).shape
        if shape not in ((), (m,), (m, m)):
            raise InputError(
                f"{self.name}.sigma: found shape {list(shape)}, expected one number, "
                f"{m} numbers or a {m} x {m} covariance"
            )
        if torch.tensor(bias).shape not in ((), (m,)):
            raise InputError(f"{self.name}.bias: expected one number or {m} numbers")
        full = len(shape) == 2
        spread = torch.tensor(sigma, dtype=torch.float64)
        spread = spread.diagonal().sqrt() if full else spread
        return (
            Parameter(
                f"{self.name}.sigma",
                sigma,
                Covariance() if full else Positive(),
                f"{self.unit}^2" if full else self.unit,
                labels=self.channels if len(shape) == 1 else (),
                meaning="measurement noise: " + ("covariance" if full else "standard deviation"),
                noise=True,
            ),
            Parameter(
                f"{self.name}.bias",
                bias,
                Real(scale=float(spread.max())),
                self.unit,
                labels=self.channels if torch.tensor(bias).dim() else (),
                meaning="measurement bias",
            ),
        )

    def prepare(self, values: Values) -> Constants:
        """Bias (m,), independent variances (m,), common columns (m, u), diagonal of R."""
        m, name, sigma = len(self.channels), self.name, values[f"{self.name}.sigma"]
        if sigma.dim() == 2:
            independent, common = torch.zeros_like(sigma[0]), semidefinite_cholesky(sigma)
            total = sigma.diagonal()
        else:
            independent = total = sigma.square().expand(m)
            common = independent.new_zeros(m, 0)
        return Constants(
            {
                f"{name}.bias": values[f"{name}.bias"].expand(m),
                f"{name}.independent": independent,
                f"{name}.common": common,
                f"{name}.total": total,
            }
        )

    @property
    def common_columns(self) -> int:
        """How many columns of noise common to channels there are: all of R, if it is full."""
        full = torch.tensor(as_number(self.sigma)).dim() == 2
        return len(self.channels) if full else 0

    def noise(self, constants: Constants) -> Noise:
        """Read back what :meth:`prepare` made."""
        keys, constants = ("independent", "common", "total"), Constants.of(constants)
        return Noise(*(constants[f"{self.name}.{key}"] for key in keys))


@dataclass(frozen=True)
class FunctionSensor:
    """A user's sensor: one torch function h, differentiated automatically.

    Attributes:
        channels: names of the m channels.
        function: (state (..., n), inputs, values) -> (..., m); any leading dimensions.
        sigma, bias: as for the built-in sensors; unit: of the measurement.
        residual_function: :func:`difference`, or :func:`wrap` for angles.
        extra: declarations of further values that the functions read.
        name: prefix of the parameters.
        noise_function: (state (..., n), inputs, values) -> factors (..., m) on ``sigma``, where
            the noise depends on the state or on a column of the log; None for 1.
    """

    channels: tuple[str, ...]
    function: Callable[[Tensor, Inputs, Constants], Tensor]
    sigma: Number = 1.0
    bias: Number = 0.0
    unit: str = "m"
    residual_function: Difference = difference
    extra: tuple[Parameter, ...] = ()
    name: str = "sensor"
    noise_function: Callable[[Tensor, Inputs, Constants], Tensor] | None = None

    @property
    def common_columns(self) -> int:
        """How many columns of noise common to channels there are."""
        return self._noise.common_columns

    @property
    def _noise(self) -> NoiseAndBias:
        return NoiseAndBias(self.name, self.channels, self.sigma, self.bias, self.unit)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (*self._noise.parameters, *self.extra)

    def prepare(self, values: Values) -> Constants:
        return self._noise.prepare(values) | {p.name: values[p.name] for p in self.extra}

    def predict(self, state: Tensor, inputs: Inputs, constants: Constants) -> Tensor:
        constants = Constants.of(constants)
        return self.function(state, inputs, constants) + constants[f"{self.name}.bias"]

    def observe(
        self, state: Tensor, deviations: Tensor, inputs: Inputs, constants: Constants
    ) -> tuple[Tensor, Tensor]:
        def h(x: Tensor) -> Tensor:
            return self.predict(x, inputs, constants)

        return h(state), jacobian_times(h, state, deviations)

    def residual(self, z: Tensor, predicted: Tensor) -> Tensor:
        return self.residual_function(z, predicted)

    def noise(self, mean: Tensor, inputs: Inputs, constants: Constants) -> Noise:
        noise = self._noise.noise(constants)
        if self.noise_function is None:
            return noise
        return noise.times(self.noise_function(mean, inputs, constants))
