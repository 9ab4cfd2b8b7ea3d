"""An attitude by gyros (inputs wx, wy, wz) and two known fields seen in the body's axes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from helpers import tensor
from torch import Tensor

from difffilter import Filter, FunctionMotion, FunctionSensor, Parameter
from difffilter.motions import quaternion


def attitude(
    fields: Mapping[str, Sequence[float]],
    gyro: float,
    sigmas: Sequence[float],
    linearise: str = "taylor",
) -> Filter:
    """The filter: a quaternion, its errors three small turns; sensors named as their fields."""

    def turned(q: Tensor, dt: Tensor, inputs: dict[str, Tensor], values: object) -> Tensor:
        rate = torch.stack([inputs["wx"], inputs["wy"], inputs["wz"]], dim=-1)
        return quaternion.retract(q, rate * dt.unsqueeze(-1))

    def noise(q: Tensor, dt: Tensor, inputs: object, values: dict[str, Tensor]) -> Tensor:
        unit = torch.eye(3).double() * values["gyro.sigma"]
        return dt.sqrt()[..., None, None] * unit

    motion = FunctionMotion(
        ("qw", "qx", "qy", "qz"),
        turned,
        noise,
        (Parameter("gyro.sigma", gyro),),
        tangent=("rx", "ry", "rz"),
        retract_function=quaternion.retract,
        local_function=quaternion.local,
    )
    sensors = [
        FunctionSensor(
            tuple(f"{name}{axis}" for axis in "xyz"),
            lambda q, i, v, field=field: quaternion.rotate_back(q, tensor(field)),
            sigma=sigma,
            name=name,
        )
        for (name, field), sigma in zip(fields.items(), sigmas, strict=True)
    ]
    return Filter(motion, tuple(sensors), linearise=linearise)  # type: ignore[arg-type]
