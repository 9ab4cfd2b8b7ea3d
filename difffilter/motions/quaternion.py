"""Unit quaternions as an attitude: four numbers (w, x, y, z) with a tangent space of three.

q turns the body's axes to the reference's: v_reference = q v_body q*. Shifts are rotation
vectors in the body's axes, rad: q exp(s / 2) (Sola, "Quaternion kinematics for the error-state
Kalman filter", 2017, eqs. 99-105, 158-161). Everything differentiates at the identity too.
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["exponential", "local", "product", "retract", "rotate", "rotate_back"]

#: Added to a squared angle, so that its root has a gradient at 0: below rounding elsewhere.
TINY = 1e-30


def product(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product (..., 4) of two quaternions (..., 4)."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        dim=-1,
    )


def conjugate(q: Tensor) -> Tensor:
    """The inverse of a unit quaternion (..., 4)."""
    return torch.cat([q[..., :1], -q[..., 1:]], dim=-1)


def exponential(vector: Tensor) -> Tensor:
    """The unit quaternion (..., 4) of a rotation vector (..., 3), rad."""
    half = 0.5 * (vector.square().sum(-1, keepdim=True) + TINY).sqrt()
    return torch.cat([half.cos(), 0.5 * vector * half.sin() / half], dim=-1)


def retract(q: Tensor, shift: Tensor) -> Tensor:
    """q turned by a rotation vector (..., 3) in the body's axes, of unit length again."""
    turned = product(q, exponential(shift))
    return turned * turned.square().sum(-1, keepdim=True).rsqrt()


def local(a: Tensor, b: Tensor) -> Tensor:
    """The rotation vector (..., 3), of at most pi, that turns a to b."""
    between = product(conjugate(a), b)
    # q and -q are the same attitude.
    between = torch.where(between[..., :1] < 0.0, -between, between)
    w, vector = between[..., :1], between[..., 1:]
    length = (vector.square().sum(-1, keepdim=True) + TINY).sqrt()
    return 2.0 * vector * torch.atan2(length, w) / length


def rotate(q: Tensor, vector: Tensor) -> Tensor:
    """A vector (..., 3) of the body's axes in the reference's."""
    w, x, y, z = q.unbind(-1)
    a, b, c = vector.unbind(-1)
    # v + 2 w (u x v) + 2 u x (u x v), u the vector part.
    s, t, r = 2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)
    return torch.stack(
        [
            a + w * s + y * r - z * t,
            b + w * t + z * s - x * r,
            c + w * r + x * t - y * s,
        ],
        dim=-1,
    )


def rotate_back(q: Tensor, vector: Tensor) -> Tensor:
    """A vector (..., 3) of the reference's axes in the body's."""
    return rotate(conjugate(q), vector)
