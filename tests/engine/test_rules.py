"""Each rule of the engine against torch: value and derivative, over its whole domain."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from rule_cases import compiled, disagreements, expected
from torch import Tensor

from difffilter.engine.build import compiler
from difffilter.engine.rules import RULES
from difffilter.errors import EngineError

pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler")

D = torch.float64
SPECIAL = [
    0.0, -0.0, 1.0, -1.0, 0.5, -0.5, 2.0, -2.0, 3.0, -3.0, torch.inf, -torch.inf, torch.nan,
    1e-310, -1e-310, 1e-200, 1e200, -1e200, 20.0, 40.0, -40.0, 710.0, -745.0, 1.5, 2.5, -2.5,
]  # fmt: skip

#: Of one number.
ONE: dict[str, Callable[[Tensor], Tensor]] = {
    "neg": torch.neg, "abs": torch.abs, "floor": torch.floor, "ceil": torch.ceil,
    "trunc": torch.trunc, "frac": torch.frac, "round": torch.round, "sign": torch.sign,
    "reciprocal": torch.reciprocal, "square": torch.square, "sqrt": torch.sqrt,
    "rsqrt": torch.rsqrt, "exp": torch.exp, "exp2": torch.exp2, "expm1": torch.expm1,
    "log": torch.log, "log2": torch.log2, "log10": torch.log10, "log1p": torch.log1p,
    "sin": torch.sin, "cos": torch.cos, "tan": torch.tan, "asin": torch.asin,
    "acos": torch.acos, "atan": torch.atan, "sinh": torch.sinh, "cosh": torch.cosh,
    "tanh": torch.tanh, "asinh": torch.asinh, "acosh": torch.acosh, "atanh": torch.atanh,
    "erf": torch.erf, "erfc": torch.erfc, "sigmoid": torch.sigmoid, "softplus": F.softplus,
    "softplus-2": lambda x: F.softplus(x, beta=2.0, threshold=5.0), "logsigmoid": F.logsigmoid,
    "relu": F.relu, "leaky_relu": F.leaky_relu, "elu": F.elu, "silu": F.silu, "gelu": F.gelu,
    "gelu-tanh": lambda x: F.gelu(x, approximate="tanh"), "hardtanh": F.hardtanh,
    "clamp": lambda x: x.clamp(0.0, 1.0), "clamp_min": lambda x: x.clamp_min(-0.5),
    "clamp_max": lambda x: x.clamp_max(0.5), "nan_to_num": torch.nan_to_num,
    "nan_to_num-0": lambda x: torch.nan_to_num(x, 7.0, 0.0, 0.0),
    "isnan": lambda x: torch.isnan(x).double(), "isinf": lambda x: torch.isinf(x).double(),
    "isfinite": lambda x: torch.isfinite(x).double(),
    "not": lambda x: torch.logical_not(x).double(),
    "deg2rad": torch.deg2rad, "rad2deg": torch.rad2deg, "sinc": torch.sinc,
    "long": lambda x: x.clamp(-99.0, 99.0).nan_to_num().long().double(),
    "bool": lambda x: x.bool().double(),
    **{f"pow {n:g}": (lambda x, n=n: x**n)
       for n in (-7, -4, -3, -2, -1, -0.5, 0, 0.5, 1, 2, 3, 4, 5, 8, 13, 2.5, -1.5, 1 / 3, 25)},
    "2 to the": lambda x: 2.0**x,
    "remainder 3": lambda x: torch.remainder(x, 3.0), "remainder -3": lambda x: x % -3.0,
    "fmod 3": lambda x: torch.fmod(x, 3.0), "floor_divide 3": lambda x: x.detach() // 3.0,
    "where": lambda x: torch.where(x > 0.5, x * x, 2.0 * x),
}  # fmt: skip

#: Of two numbers.
TWO: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "add": torch.add, "sub": torch.sub, "mul": torch.mul, "div": torch.div,
    "rsub": lambda a, b: torch.rsub(a, b, alpha=3), "pow": torch.pow, "atan2": torch.atan2,
    "hypot": torch.hypot, "maximum": torch.maximum, "minimum": torch.minimum,
    "fmax": torch.fmax, "fmin": torch.fmin, "remainder": torch.remainder, "fmod": torch.fmod,
    "copysign": torch.copysign, "lerp": lambda a, b: torch.lerp(a, b, 0.3),
    "xlogy": torch.xlogy, "logaddexp": torch.logaddexp,
    "lt": lambda a, b: (a < b).double(), "le": lambda a, b: (a <= b).double(),
    "gt": lambda a, b: (a > b).double(), "ge": lambda a, b: (a >= b).double(),
    "eq": lambda a, b: (a == b).double(), "ne": lambda a, b: (a != b).double(),
    "and": lambda a, b: ((a > 0) & (b > 0)).double(),
    "or": lambda a, b: ((a > 0) | (b > 0)).double(),
    "xor": lambda a, b: ((a > 0) ^ (b > 0)).double(),
    "logical_and": lambda a, b: torch.logical_and(a, b).double(),
    "addcmul": lambda a, b: torch.addcmul(a, a, b, value=-1),
    "addcdiv": lambda a, b: torch.addcdiv(a, a, b, value=2),
    "div floor": lambda a, b: torch.div(a, b, rounding_mode="floor"),
    "div trunc": lambda a, b: torch.div(a, b, rounding_mode="trunc"),
    "two divided": lambda a, b: a / b + (a + 1.0) / b + 1.0 / b,
}  # fmt: skip


#: What is left out: no number of the code's domain is lost there.
LEFT_OUT: dict[str, Callable[..., Tensor]] = {
    # A quotient's derivative multiplies by 1 / b, which is infinite for a subnormal b; a
    # remainder has no digit left beyond 2^53 periods.
    "div": lambda a, b: small(b),
    "addcdiv": lambda a, b: small(b) | a.isinf(),
    "two divided": lambda a, b: small(b) | (b == 0) | a.isinf(),
    **dict.fromkeys(
        ("remainder", "fmod", "div floor", "div trunc"),
        lambda a, b: (
            small(a)
            | small(b)
            | ((a / b).abs() > 2.0**53)
            | b.isinf()
            | a.isinf()
            | ((a != 0) & ((a / b).abs() < 1e-300))
        ),
    ),
    **dict.fromkeys(
        ("remainder 3", "remainder -3", "fmod 3", "floor_divide 3"), lambda a: a.abs() > 3 * 2.0**53
    ),
    "sinc": lambda a: (a.abs() < 1e-2) | (a.abs() > 1e150),  # torch itself loses its digits
    "atan2": lambda a, b: small(a.hypot(b)) | (a.hypot(b) == 0),
    "copysign": lambda a, b: a.isinf() | (a == 0),  # torch divides inf by inf
    "logaddexp": lambda a, b: a.isinf() & b.isinf(),
    "xlogy": lambda a, b: (a == 0) & ~(b > 1e-300) | b.isinf() | (b.abs() < 1e-300),
}


def small(x: Tensor) -> Tensor:
    """So small that the square is lost."""
    return (x != 0) & (x.abs() < 1e-150)


def padded(rows: Tensor) -> Tensor:
    """As many rows as fill whole blocks of eight."""
    return torch.cat([rows, rows[-1:].expand(-len(rows) % 8, -1)])


def randoms(count: int, size: int, seed: int) -> Tensor:
    """Of every magnitude and sign."""
    generator = torch.Generator().manual_seed(seed)
    plain = torch.randn(count, size, generator=generator, dtype=D)
    spread = torch.pow(10.0, 8.0 * torch.rand(count, size, generator=generator, dtype=D) - 4.0)
    return torch.cat([plain, plain * spread])


def check(
    functions: dict[str, Callable[..., Tensor]],
    rows: Tensor,
    entrywise: bool = True,
    slack: float = 1e-15,
) -> None:
    """Values and derivatives; the message names what differs, and where."""
    wrong = []
    for name, (values, slopes) in compiled(functions, rows).items():
        value, slope = expected(functions[name], rows, entrywise)
        for what, got, wanted in (("value", values, value), ("slope", slopes, slope)):
            differs = disagreements(got, wanted, atol=1e-300 if what == "value" else slack)
            if what == "slope":  # of what is no number anyway
                differs &= ~np.isnan(value)
            if name in LEFT_OUT:
                differs &= ~LEFT_OUT[name](*rows.T).numpy()
            bad = np.argwhere(differs)
            for place in bad[:3]:
                row = rows[place[0 if what == "value" else 1]].tolist()
                wrong.append(
                    f"{name} {what} at {row}: {got[tuple(place)]}, torch {wanted[tuple(place)]}"
                )
    assert not wrong, "\n" + "\n".join(wrong)


def test_operations_of_one_number() -> None:
    rows = torch.cat([torch.tensor(SPECIAL, dtype=D)[:, None], randoms(60, 1, 1)])
    check({name: lambda x, f=f: f(x[0]) for name, f in ONE.items()}, padded(rows))


def test_operations_of_two_numbers() -> None:
    special = torch.tensor(SPECIAL, dtype=D)
    rows = torch.cat([torch.cartesian_prod(special, special), randoms(150, 2, 2)])
    check({name: lambda x, f=f: f(x[0], x[1]) for name, f in TWO.items()}, padded(rows))


M = torch.tensor([[1.0, 2.0, -1.0], [0.5, -1.0, 3.0], [2.0, 0.0, 1.0]], dtype=D)


def square(x: Tensor) -> Tensor:
    """A general matrix (its first pivot may be the smallest) of nine numbers."""
    return x[:9].reshape(3, 3)


def definite(x: Tensor) -> Tensor:
    return square(x) @ square(x).mT + torch.eye(3, dtype=D)


def norm(order: float) -> Callable[[Tensor], Tensor]:
    return lambda x: torch.linalg.vector_norm(x[:4], order)


#: Of twelve numbers.
MANY: dict[str, Callable[[Tensor], Tensor]] = {
    "solve": lambda x: torch.linalg.solve(square(x), x[9:]),
    "solve-matrix": lambda x: torch.linalg.solve(square(x), M * x[9]),
    "solve-right": lambda x: torch.linalg.solve(square(x), M * x[9], left=False),
    "solve-exchanged": lambda x: torch.linalg.solve(torch.stack([x[1:4] * 0, x[4:7], x[7:10]]) + M
                                                    - torch.diag(M.diagonal()), x[9:]),
    "inv": lambda x: torch.linalg.inv(square(x)), "det": lambda x: torch.linalg.det(square(x)),
    "slogdet": lambda x: torch.linalg.slogdet(square(x)).logabsdet,
    "cholesky": lambda x: torch.linalg.cholesky(definite(x)),
    "cholesky-upper": lambda x: torch.linalg.cholesky(definite(x), upper=True),
    "solve_triangular": lambda x: torch.linalg.solve_triangular(
        torch.linalg.cholesky(definite(x)), x[9:, None], upper=False),
    "cholesky_solve": lambda x: torch.cholesky_solve(
        x[9:, None], torch.linalg.cholesky(definite(x))),
    "einsum": lambda x: torch.einsum("ij,...j->...i", M, x.reshape(4, 3)),
    "einsum-2": lambda x: torch.einsum("bi,bj->ij", x.reshape(4, 3), x.reshape(4, 3)),
    "matmul": lambda x: x[:3] @ M, "mv": lambda x: M @ x[:3], "mm": lambda x: square(x) @ M,
    "dot": lambda x: x[:3] @ x[3:6], "linear": lambda x: F.linear(x[:3], M, M[0]),
    "linear-batch": lambda x: F.linear(x.reshape(4, 3), M, x[:3]),
    "cross": lambda x: torch.linalg.cross(x[:3], x[3:6]),
    "outer": lambda x: torch.outer(x[:2], x[2:4]),
    "norm-2": norm(2.0), "norm-1": norm(1.0), "norm-3": norm(3.0), "norm-inf": norm(torch.inf),
    "norm": lambda x: x.reshape(4, 3).norm(dim=-1, keepdim=True),
    "normalize": lambda x: F.normalize(x[:3], dim=-1),
    "roll": lambda x: x.roll(1), "roll-2": lambda x: x.reshape(4, 3).roll((1, 2), (0, 1)),
    "flip": lambda x: x.flip(-1), "split": lambda x: torch.cat(torch.split(x, [5, 7])[::-1]),
    "chunk": lambda x: x.chunk(3)[1], "repeat": lambda x: x[:2].repeat(3),
    "tril": lambda x: square(x).tril(), "triu": lambda x: square(x).triu(1),
    "trace": lambda x: square(x).trace(), "diagonal": lambda x: square(x).diagonal(1),
    "diag_embed": lambda x: torch.diag_embed(x[:2], 1), "block_diag": lambda x: torch.block_diag(
        square(x), x[:2]),
    "sum": lambda x: x.reshape(4, 3).sum(0), "mean": lambda x: x.reshape(4, 3).mean((0, 1)),
    "prod": lambda x: x[:4].prod(), "cumsum": lambda x: x.cumsum(0),
    "cumprod": lambda x: x.cumprod(0),
    "var": lambda x: x.var(), "std": lambda x: x.reshape(4, 3).std(-1), "amax": lambda x: x.amax(),
    "max": lambda x: x.reshape(4, 3).max(-1).values, "min": lambda x: x.reshape(4, 3).min(0).values,
    "softmax": lambda x: x[:4].softmax(0), "log_softmax": lambda x: x[:4].log_softmax(0),
    "logsumexp": lambda x: x[:4].logsumexp(0), "index": lambda x: x[[3, 0]],
    "stack": lambda x: torch.stack([x, 2 * x], -1),
    "pad": lambda x: F.pad(x[:2], (1, 2), value=3.0),
    "jacfwd": lambda x: torch.func.jacfwd(lambda y: y[:3].sin() * y[:2].prod())(x),
    "unfold": lambda x: x.unfold(0, 4, 2), "movedim": lambda x: x.reshape(2, 3, 2).movedim(0, -1),
    "constant-inverse": lambda x: torch.linalg.pinv(M) @ x[:3],
    "written": lambda x: torch.zeros(3, dtype=D).index_put((torch.tensor([1]),), x[:1]),
}  # fmt: skip


def test_operations_of_many_numbers() -> None:
    rows = torch.randn(8, 12, generator=torch.Generator().manual_seed(3), dtype=D)
    check(MANY, rows, entrywise=False, slack=1e-10)


def test_the_norm_of_nothing_has_a_derivative_of_zero() -> None:
    names = ("norm", "norm-2", "norm-1", "norm-inf", "std")
    check({name: MANY[name] for name in names}, torch.zeros(8, 12, dtype=D), entrywise=False)


def test_the_smallest_pivot_first() -> None:
    rows = torch.randn(8, 12, generator=torch.Generator().manual_seed(4), dtype=D)
    rows[:, 0] = 0.0
    names = ("solve", "solve-matrix", "solve-right", "inv", "det")
    check({name: MANY[name] for name in names}, rows, entrywise=False, slack=1e-10)


def test_every_rule_has_a_name_of_torch() -> None:
    known = {
        str(name).split("::")[1].split(".")[0].strip("_")
        for name in torch._C._dispatch_get_all_op_names()
    }
    assert set(RULES) <= known


def test_unknown_dtypes_and_computed_branches_are_refused() -> None:
    wrong: dict[str, Callable[[Tensor], Tensor]] = {
        "conversion to torch.float32": lambda x: x.float().double(),
        "complex": lambda x: torch.complex(x, x).abs(),
        "no rule for lgamma, used at .*test_rules.py": lambda x: torch.lgamma(x),
        "a branch on a value": lambda x: x if x[0] > 0 else -x,
    }
    for message, function in wrong.items():
        with pytest.raises(EngineError, match=message):
            compiled({"wrong": function}, torch.ones(8, 2, dtype=D))
