"""Smooth steps and hinges, and their derivatives where torch has an operation for them."""

from __future__ import annotations

import math
from typing import Any

from difffilter.engine.rules.table import Array, Lower, rule

__all__ = ["sigmoid"]


@rule("sigmoid")
def sigmoid(low: Lower, x: Any) -> Array:
    """1 / (1 + exp(-x)), by exp(-|x|): no overflow, and small values to the last digit."""
    positive = low.map("ge", x, 0.0)
    small = low.map("exp", low.map("select", positive, low.map("neg", x), x))
    return low.map("div", low.map("select", positive, 1.0, small), low.map("add", small, 1.0))


@rule("sigmoid_backward")
def _sigmoid_backward(low: Lower, grad: Any, y: Any) -> Array:
    return low.map("mul", grad, low.map("mul", low.map("sub", 1.0, y), y))


@rule("tanh_backward")
def _tanh_backward(low: Lower, grad: Any, y: Any) -> Array:
    return low.map("mul", grad, low.map("sub", 1.0, low.map("mul", y, y)))


@rule("softplus")
def _softplus(low: Lower, x: Any, beta: float = 1, threshold: float = 20) -> Array:
    scaled = low.map("mul", x, beta)
    soft = low.map("div", low.map("log1p", low.map("exp", scaled)), beta)
    return low.map("select", low.map("gt", scaled, threshold), x, soft)


@rule("softplus_backward")
def _softplus_backward(low: Lower, grad: Any, x: Any, beta: float, threshold: float) -> Array:
    scaled = low.map("mul", x, beta)
    slope = low.map("mul", grad, sigmoid(low, scaled))
    return low.map("select", low.map("gt", scaled, threshold), grad, slope)


@rule("log_sigmoid_forward")
def _log_sigmoid(low: Lower, x: Any) -> tuple[Array, Array | None]:
    """min(x, 0) - log(1 + exp(-|x|)), and what its derivative keeps (not used here)."""
    negative = low.map("lt", x, 0.0)
    small = low.map("exp", low.map("select", negative, x, low.map("neg", x)))
    least = low.map("select", negative, x, 0.0)
    return low.map("sub", least, low.map("log1p", small)), None


@rule("log_sigmoid_backward")
def _log_sigmoid_backward(low: Lower, grad: Any, x: Any, buffer: Any) -> Array:
    return low.map("mul", grad, sigmoid(low, low.map("neg", x)))


@rule("relu")
def _relu(low: Lower, x: Any) -> Array:
    return low.map("select", low.map("le", x, 0.0), 0.0, x)


@rule("threshold_backward")
def _threshold_backward(low: Lower, grad: Any, x: Any, threshold: float) -> Array:
    return low.map("select", low.map("le", x, threshold), 0.0, grad)


@rule("hardtanh")
def _hardtanh(low: Lower, x: Any, least: float = -1, most: float = 1) -> Array:
    x = low.map("select", low.map("le", x, least), least, x)
    return low.map("select", low.map("ge", x, most), most, x)


@rule("hardtanh_backward")
def _hardtanh_backward(low: Lower, grad: Any, x: Any, least: float, most: float) -> Array:
    outside = low.map("or", low.map("le", x, least), low.map("ge", x, most))
    return low.map("select", outside, 0.0, grad)


@rule("leaky_relu")
def _leaky_relu(low: Lower, x: Any, slope: float = 0.01) -> Array:
    return low.map("select", low.map("gt", x, 0.0), x, low.map("mul", x, slope))


@rule("leaky_relu_backward")
def _leaky_relu_backward(low: Lower, grad: Any, x: Any, slope: float, _: bool) -> Array:
    return low.map("select", low.map("gt", x, 0.0), grad, low.map("mul", grad, slope))


@rule("elu")
def _elu(low: Lower, x: Any, alpha: float = 1, scale: float = 1, input_scale: float = 1) -> Array:
    soft = low.map("expm1", low.map("mul", x, input_scale))
    soft = low.map("mul", soft, alpha * scale)
    return low.map("select", low.map("le", x, 0.0), soft, low.map("mul", x, scale))


@rule("elu_backward")
def _elu_backward(
    low: Lower, grad: Any, alpha: float, scale: float, input_scale: float, result: bool, x: Any
) -> Array:
    if result:
        soft = low.map("mul", low.map("add", x, alpha * scale), input_scale)
    else:
        grown = low.map("exp", low.map("mul", x, input_scale))
        soft = low.map("mul", grown, alpha * scale * input_scale)
    slope = low.map("select", low.map("le", x, 0.0), soft, scale)
    return low.map("mul", grad, slope)


@rule("silu")
def _silu(low: Lower, x: Any) -> Array:
    return low.map("mul", x, sigmoid(low, x))


@rule("silu_backward")
def _silu_backward(low: Lower, grad: Any, x: Any) -> Array:
    step = sigmoid(low, x)
    rest = low.map("mul", x, low.map("sub", 1.0, step))
    return low.map("mul", grad, low.map("mul", step, low.map("add", 1.0, rest)))


@rule("gelu")
def _gelu(low: Lower, x: Any, approximate: str = "none") -> Array:
    half = low.map("mul", x, 0.5)
    if approximate == "tanh":
        cube = low.map("mul", low.map("mul", low.map("mul", x, x), x), 0.044715)
        inner = low.map("mul", low.map("add", x, cube), math.sqrt(2.0 / math.pi))
        return low.map("mul", half, low.map("add", 1.0, low.map("tanh", inner)))
    error = low.map("erf", low.map("mul", x, math.sqrt(0.5)))
    return low.map("mul", half, low.map("add", 1.0, error))


@rule("gelu_backward")
def _gelu_backward(low: Lower, grad: Any, x: Any, approximate: str = "none") -> Array:
    if approximate == "tanh":
        root = math.sqrt(2.0 / math.pi)
        square = low.map("mul", x, x)
        inner = low.map("add", x, low.map("mul", low.map("mul", square, x), 0.044715))
        bent = low.map("tanh", low.map("mul", inner, root))
        steep = low.map("mul", low.map("add", 1.0, low.map("mul", square, 3 * 0.044715)), root)
        rest = low.map("mul", low.map("sub", 1.0, low.map("mul", bent, bent)), steep)
        rest = low.map("mul", low.map("mul", x, 0.5), rest)
        slope = low.map("add", low.map("mul", low.map("add", 1.0, bent), 0.5), rest)
        return low.map("mul", grad, slope)
    error = low.map("erf", low.map("mul", x, math.sqrt(0.5)))
    share = low.map("mul", low.map("add", 1.0, error), 0.5)
    bell = low.map("exp", low.map("mul", low.map("mul", x, x), -0.5))
    density = low.map("mul", bell, 1.0 / math.sqrt(2.0 * math.pi))
    return low.map("mul", grad, low.map("add", share, low.map("mul", x, density)))
