"""ATen operations on arrays of scalar expressions: every tensor becomes its entries."""

from __future__ import annotations

import math
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from difffilter.engine.program import Program
from difffilter.errors import EngineError

__all__ = ["Lowering"]

Array = np.ndarray[Any, Any]
LIBRARY = Path(__file__).resolve().parent.parent
TORCH, PYTHON = Path(torch.__file__).resolve().parent, Path(traceback.__file__).resolve().parent


class Lowering:
    """Turns torch operations into expressions, as they are called.

    Args:
        program: where the expressions go.
    """

    def __init__(self, program: Program) -> None:
        self.program = program

    def run(
        self, function: Callable[..., Sequence[torch.Tensor]], given: Sequence[tuple[Any, Array]]
    ) -> list[Array]:
        """Arrays of what a function of tensors returns.

        Args:
            given: tensors to call it with (shapes are all that counts), and their arrays.

        Raises:
            EngineError: names an operation that has no rule, and the line that calls it.
        """
        # Copies: one tensor in two places would be one input.
        tensors = [tensor.detach().clone() for tensor, _ in given]
        calls = _Calls(self)
        for tensor, (_, array) in zip(tensors, given, strict=True):
            calls.bind(tensor, array)
        with torch.no_grad(), calls:
            found = function(*tensors)
            return [calls.array(tensor) for tensor in found]

    def rule(self, name: str) -> Callable[..., Any] | None:
        """The rule of an operation, or None."""
        return getattr(self, "op_" + name.strip("_"), None)

    # Making arrays

    def constant(self, value: Any) -> Array:
        """Numbers as an array of constant nodes."""
        if isinstance(value, torch.Tensor):
            value = value.detach().to(torch.float64).numpy()
        numbers = np.asarray(value, dtype=float)
        return _array(np.frompyfunc(self.program.const, 1, 1)(numbers))

    def of(self, value: Any) -> Array:
        """An array, made of a number where needed."""
        return value if isinstance(value, np.ndarray) else self.constant(value)

    def map(self, op: str, *args: Any) -> Array:
        """An operation on every entry, broadcasting."""
        made = np.frompyfunc(lambda *nodes: self.program.make(op, *nodes), len(args), 1)
        return _array(made(*(self.of(a) for a in args)))

    def fold(self, op: str, x: Array, dims: Any, keepdim: bool) -> Array:
        """An operation from entry to entry along dimensions, in order."""
        axes = range(x.ndim) if dims is None else ([dims] if isinstance(dims, int) else dims)
        axes = sorted(a % max(x.ndim, 1) for a in axes)
        for axis in reversed(axes):
            parts = np.moveaxis(x, axis, 0)
            total = _array(parts[0]) if len(parts) else self.constant(np.zeros(parts.shape[1:]))
            for part in parts[1:]:
                total = self.map(op, total, _array(part))
            x = np.expand_dims(_array(total), axis) if keepdim else _array(total)
        return x

    # Elementwise

    def op_add(self, a: Any, b: Any, alpha: float = 1) -> Array:
        return self.map("add", a, b if alpha == 1 else self.map("mul", b, alpha))

    def op_sub(self, a: Any, b: Any, alpha: float = 1) -> Array:
        return self.map("sub", a, b if alpha == 1 else self.map("mul", b, alpha))

    def op_rsub(self, a: Any, b: Any, alpha: float = 1) -> Array:
        return self.op_sub(b, a, alpha)

    def op_mul(self, a: Any, b: Any) -> Array:
        return self.map("mul", a, b)

    op_mul_ = op_mul

    def op_div(self, a: Any, b: Any) -> Array:
        return self.map("div", a, b)

    def op_addcmul(self, a: Any, b: Any, c: Any, value: float = 1) -> Array:
        product = self.map("mul", b, c)
        if value == -1:
            return self.map("sub", a, product)
        return self.map("add", a, product if value == 1 else self.map("mul", product, value))

    def op_pow(self, a: Any, b: Any) -> Array:
        if not isinstance(b, np.ndarray):
            if b == 2:
                return self.map("mul", a, a)
            if b == 0.5:
                return self.map("sqrt", a)
            if b == -1:
                return self.map("div", 1.0, a)
        return self.map("exp", self.map("mul", b, self.map("log", a)))

    def op_remainder(self, a: Any, b: Any) -> Array:
        whole = self.map("floor", self.map("div", a, b))
        return self.map("sub", a, self.map("mul", whole, b))

    def op_where(self, c: Any, a: Any, b: Any) -> Array:
        return self.map("select", c, a, b)

    def op_clamp(self, x: Any, low: Any = None, high: Any = None) -> Array:
        x = x if low is None else self.map("max", x, low)
        return x if high is None else self.map("min", x, high)

    def op_clamp_min(self, x: Any, low: Any) -> Array:
        return self.map("max", x, low)

    def op_clamp_max(self, x: Any, high: Any) -> Array:
        return self.map("min", x, high)

    def op_maximum(self, a: Any, b: Any) -> Array:
        return self.map("max", a, b)

    def op_minimum(self, a: Any, b: Any) -> Array:
        return self.map("min", a, b)

    def op_rsqrt(self, x: Any) -> Array:
        return self.map("div", 1.0, self.map("sqrt", x))

    def op_reciprocal(self, x: Any) -> Array:
        return self.map("div", 1.0, x)

    def op_sigmoid(self, x: Any) -> Array:
        half = self.map("tanh", self.map("mul", x, 0.5))
        return self.map("add", 0.5, self.map("mul", 0.5, half))

    def op_softplus(self, x: Any, beta: float = 1, threshold: float = 20) -> Array:
        scaled = self.map("mul", x, beta)
        soft = self.map("div", self.map("log1p", self.map("exp", scaled)), beta)
        return self.map("select", self.map("gt", scaled, threshold), x, soft)

    def op_sinc(self, x: Any) -> Array:
        angle = self.map("mul", x, math.pi)
        zero = self.map("eq", x, 0.0)
        ratio = self.map("div", self.map("sin", angle), self.map("select", zero, 1.0, angle))
        return self.map("select", zero, 1.0, ratio)

    def op_sign(self, x: Any) -> Array:
        return self.map("sub", self.map("gt", x, 0.0), self.map("lt", x, 0.0))

    def op_bitwise_and(self, a: Any, b: Any) -> Array:
        return self.map("and", a, b)

    def op_bitwise_or(self, a: Any, b: Any) -> Array:
        return self.map("or", a, b)

    def op_bitwise_not(self, a: Any) -> Array:
        return self.map("not", a)

    op_logical_not = op_bitwise_not

    def op_nan_to_num(
        self, x: Any, nan: Any = None, posinf: Any = None, neginf: Any = None
    ) -> Array:
        largest = float(np.finfo(np.float64).max)
        x = self.map("select", self.map("isnan", x), 0.0 if nan is None else nan, x)
        x = self.map("select", self.map("eq", x, np.inf), posinf or largest, x)
        return self.map("select", self.map("eq", x, -np.inf), neginf or -largest, x)

    # Reductions

    def op_sum(self, x: Array, dim: Any = None, keepdim: bool = False, dtype: Any = None) -> Array:
        return self.fold("add", x, dim, keepdim)

    def op_mean(self, x: Array, dim: Any = None, keepdim: bool = False, dtype: Any = None) -> Array:
        total = self.fold("add", x, dim, keepdim)
        return self.map("div", total, float(x.size // max(total.size, 1)))

    def op_amax(self, x: Array, dim: Any = None, keepdim: bool = False) -> Array:
        return self.fold("max", x, dim or None, keepdim)

    def op_amin(self, x: Array, dim: Any = None, keepdim: bool = False) -> Array:
        return self.fold("min", x, dim or None, keepdim)

    def op_max(self, x: Array) -> Array:
        return self.fold("max", x, None, False)

    def op_any(self, x: Array, dim: Any = None, keepdim: bool = False) -> Array:
        return self.fold("or", x, dim, keepdim)

    def op_all(self, x: Array, dim: Any = None, keepdim: bool = False) -> Array:
        return self.fold("and", x, dim, keepdim)

    def op_softmax(self, x: Array, dim: int, half: bool = False) -> Array:
        top = self.fold("max", x, dim, True)
        grown = self.map("exp", self.map("sub", x, top))
        return self.map("div", grown, self.fold("add", grown, dim, True))

    def op_mm(self, a: Array, b: Array) -> Array:
        return self.fold(
            "add", self.map("mul", a[..., None], b[..., None, :, :]), a.ndim - 1, False
        )

    op_bmm = op_mm

    def op_mv(self, a: Array, b: Array) -> Array:
        return self.fold("add", self.map("mul", a, b), 1, False)

    def op_dot(self, a: Array, b: Array) -> Array:
        return self.fold("add", self.map("mul", a, b), 0, False)

    def op_nanmedian(self, x: Array, dim: int, keepdim: bool = False) -> tuple[Array, Array]:
        """The lower median of what is not NaN: a sorting network with NaN last."""
        rows = [_array(row) for row in np.moveaxis(x, dim, 0)]
        count = self.constant(0.0)
        for row in rows:
            count = self.map("add", count, self.map("not", self.map("isnan", row)))
        rows = [self.map("select", self.map("isnan", r), np.inf, r) for r in rows]
        for i in range(len(rows)):
            for j in range(i % 2, len(rows) - 1, 2):
                low = self.map("min", rows[j], rows[j + 1])
                rows[j + 1] = self.map("max", rows[j], rows[j + 1])
                rows[j] = low
        found = self.constant(np.full(rows[0].shape, np.nan))
        for i, row in enumerate(rows):  # entry (count - 1) // 2
            inside = self.map(
                "and", self.map("ge", count, 2.0 * i + 1.0), self.map("le", count, 2.0 * i + 2.0)
            )
            found = self.map("select", inside, row, found)
        found = np.expand_dims(found, dim) if keepdim else found
        return found, found

    # Small linear algebra

    def op_linalg_solve_triangular(
        self, a: Array, b: Array, *, upper: bool, left: bool = True, unitriangular: bool = False
    ) -> Array:
        n = a.shape[-1]
        order = range(n - 1, -1, -1) if upper else range(n)
        rows: list[Any] = [None] * n
        for i in order:
            right = b[..., i, :]
            for j in range(n):
                if rows[j] is not None:
                    right = self.map("sub", right, self.map("mul", a[..., i, j, None], rows[j]))
            rows[i] = self.map("div", right, a[..., i, i, None])
        return np.stack(rows, axis=-2)

    def op_linalg_solve_ex(self, a: Array, b: Array, **_: Any) -> tuple[Any, ...]:
        """Elimination without pivoting: for positive definite matrices."""
        n, vector = a.shape[-1], b.ndim == a.ndim - 1
        a, b = a.copy(), (b[..., None] if vector else b).copy()
        for i in range(n):
            for j in range(i + 1, n):
                factor = self.map("div", a[..., j, i], a[..., i, i])[..., None]
                a[..., j, :] = self.map("sub", a[..., j, :], self.map("mul", factor, a[..., i, :]))
                b[..., j, :] = self.map("sub", b[..., j, :], self.map("mul", factor, b[..., i, :]))
        x = self.op_linalg_solve_triangular(a, b, upper=True)
        return (x[..., 0] if vector else x), None, None, None

    def op_linalg_cholesky_ex(
        self, a: Array, *, upper: bool = False, check_errors: bool = False
    ) -> tuple[Array, Array]:
        """L, and whether a pivot was not above zero (LAPACK tells which one was first)."""
        n = a.shape[-1]
        made = self.constant(np.zeros(a.shape))
        failed = self.constant(np.zeros(a.shape[:-2]))
        for j in range(n):
            for i in range(j, n):
                left = a[..., i, j]
                for k in range(j):
                    product = self.map("mul", made[..., i, k], made[..., j, k])
                    left = self.map("sub", left, product)
                if i == j:
                    failed = self.map("or", failed, self.map("not", self.map("gt", left, 0.0)))
                    made[..., j, j] = self.map("sqrt", left)
                else:
                    made[..., i, j] = self.map("div", left, made[..., j, j])
        return (np.swapaxes(made, -1, -2) if upper else made), failed

    def op_linalg_check_errors(self, *_: Any, **__: Any) -> None:
        return None

    # Shape

    def op_slice(
        self, x: Array, dim: int = 0, start: Any = None, end: Any = None, step: int = 1
    ) -> Array:
        where: list[Any] = [slice(None)] * x.ndim
        where[dim] = slice(start, end, step)
        return _array(x[tuple(where)])

    def op_select(self, x: Array, dim: int, index: int) -> Array:
        # A view, so that a later write through it is seen.
        where: list[Any] = [slice(None)] * (dim % x.ndim)
        return _array(x[(*where, index)])

    def op_unsqueeze(self, x: Array, dim: int) -> Array:
        return np.expand_dims(x, dim if dim >= 0 else dim + x.ndim + 1)

    def op_squeeze(self, x: Array, dim: Any = None) -> Array:
        axes = range(x.ndim) if dim is None else ([dim] if isinstance(dim, int) else dim)
        return np.squeeze(x, tuple(a for a in axes if x.shape[a] == 1))

    def op_expand(self, x: Array, size: Sequence[int], implicit: bool = False) -> Array:
        lead = len(size) - x.ndim
        full = [x.shape[i - lead] if s == -1 else s for i, s in enumerate(size)]
        return np.broadcast_to(x, full)

    def op_permute(self, x: Array, dims: Sequence[int]) -> Array:
        return np.transpose(x, [d % x.ndim for d in dims])

    def op_transpose(self, x: Array, a: int, b: int) -> Array:
        return np.swapaxes(x, a, b)

    def op_t(self, x: Array) -> Array:
        return x.T

    def op_view(self, x: Array, size: Sequence[int]) -> Array:
        return x.reshape(size)

    op_reshape = op_view
    op_unsafe_view = op_view

    def op_cat(self, parts: Sequence[Array], dim: int = 0) -> Array:
        return np.concatenate([p for p in parts if p.shape != (0,)], axis=dim)

    def op_stack(self, parts: Sequence[Array], dim: int = 0) -> Array:
        return np.stack(parts, axis=dim)

    def op_unbind(self, x: Array, dim: int = 0) -> list[Array]:
        return [_array(part) for part in np.moveaxis(x, dim, 0)]

    def op_alias(self, x: Array, *_: Any, **__: Any) -> Array:
        return x

    op_clone = op_alias
    op_detach = op_alias
    op_lift_fresh = op_alias
    op_lift_fresh_copy = op_alias
    op_to_copy = op_alias
    op_contiguous = op_alias

    def op_diagonal(self, x: Array, offset: int = 0, dim1: int = 0, dim2: int = 1) -> Array:
        return np.diagonal(x, offset, dim1, dim2)

    def op_diag_embed(self, x: Array, offset: int = 0, dim1: int = -2, dim2: int = -1) -> Array:
        n = x.shape[-1]
        made = self.constant(np.zeros((*x.shape, n)))
        for i in range(n):
            made[..., i, i] = x[..., i]
        return made

    def op_block_diag(self, blocks: Sequence[Array]) -> Array:
        made = self.constant(np.zeros(np.sum([b.shape for b in blocks], axis=0)))
        row = column = 0
        for block in blocks:
            rows, columns = block.shape
            made[row : row + rows, column : column + columns] = block
            row, column = row + rows, column + columns
        return made

    def op_constant_pad_nd(self, x: Array, pad: Sequence[int], value: float = 0) -> Array:
        widths = [(0, 0)] * x.ndim
        for i in range(len(pad) // 2):
            widths[x.ndim - 1 - i] = (pad[2 * i], pad[2 * i + 1])
        filler = self.program.const(value)
        made = self.constant(
            np.zeros([n + a + b for n, (a, b) in zip(x.shape, widths, strict=True)])
        )
        made[...] = filler
        made[tuple(slice(a, a + n) for n, (a, _) in zip(x.shape, widths, strict=True))] = x
        return made

    def op_index(self, x: Array, indices: Sequence[Any]) -> Array:
        numbers: list[Any] = []
        for index in indices:
            if index is None:
                numbers.append(slice(None))
                continue
            values = np.frompyfunc(self.program.value, 1, 1)(index)
            if any(v is None for v in np.ravel(values)):
                return self._chosen(x, indices)
            numbers.append(np.asarray(values, dtype=float).astype(int))
        return _array(x[tuple(numbers)])

    def _chosen(self, x: Array, indices: Sequence[Any]) -> Array:
        """One index that is itself computed: a chain of choices."""
        if len(indices) != 1:
            raise EngineError("engine: no rule for several computed indices")
        index = indices[0].reshape(*indices[0].shape, *[1] * (x.ndim - 1))
        made = _array(np.broadcast_to(_array(x[0]), np.shape(indices[0]) + x.shape[1:]))
        for i in range(1, x.shape[0]):
            made = self.map("select", self.map("eq", index, float(i)), _array(x[i]), made)
        return made

    def op_index_put(self, x: Array, indices: Sequence[Any], value: Any, *_: Any) -> Array:
        places = tuple(
            slice(None) if index is None
            else np.frompyfunc(self.program.value, 1, 1)(index).astype(float).astype(int)
            for index in indices
        )  # fmt: skip
        x[places] = value
        return x

    def op_copy(self, x: Array, value: Array, *_: Any) -> Array:
        x[...] = value
        return x

    # Factories

    def op_zeros_like(self, x: Array, **_: Any) -> Array:
        return self.constant(np.zeros(x.shape))

    def op_ones_like(self, x: Array, **_: Any) -> Array:
        return self.constant(np.ones(x.shape))

    def op_full_like(self, x: Array, value: float, **_: Any) -> Array:
        return self.constant(np.full(x.shape, value))

    def op_zeros(self, size: Sequence[int], **_: Any) -> Array:
        return self.constant(np.zeros(size))

    op_efficientzerotensor = op_zeros
    op_empty = op_zeros

    def op_ones(self, size: Sequence[int], **_: Any) -> Array:
        return self.constant(np.ones(size))

    def op_full(self, size: Sequence[int], value: float, **_: Any) -> Array:
        return self.constant(np.full(size, value))

    def op_new_zeros(self, x: Array, size: Sequence[int], **_: Any) -> Array:
        return self.constant(np.zeros(size))

    def op_new_ones(self, x: Array, size: Sequence[int], **_: Any) -> Array:
        return self.constant(np.ones(size))

    def op_new_full(self, x: Array, size: Sequence[int], value: float, **_: Any) -> Array:
        return self.constant(np.full(size, value))

    def op_eye(self, n: int, m: int | None = None, **_: Any) -> Array:
        return self.constant(np.eye(n, n if not isinstance(m, int) else m))

    def op_scalar_tensor(self, value: float, **_: Any) -> Array:
        return self.constant(value)

    def op_arange(self, *args: float, **_: Any) -> Array:
        return self.constant(np.arange(*args))


def _unary(op: str) -> Callable[[Lowering, Any], Array]:
    return lambda self, x: self.map(op, x)


def _binary(op: str) -> Callable[[Lowering, Any, Any], Array]:
    return lambda self, a, b: self.map(op, a, b)


for _name in ("neg", "sqrt", "abs", "exp", "log", "log1p", "tanh", "sin", "cos", "floor", "isnan"):
    setattr(Lowering, f"op_{_name}", _unary(_name))
for _name in ("lt", "le", "gt", "ge", "eq", "ne", "atan2"):
    setattr(Lowering, f"op_{_name}", _binary(_name))


def _array(value: Any) -> Array:
    return np.asarray(value, dtype=object)


class _Calls(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Sees every operation that torch calls, and what is known of its tensors."""

    def __init__(self, lowering: Lowering) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.lowering = lowering
        # Tensors are kept: the number of one that is gone could be another's.
        self.known: dict[int, tuple[torch.Tensor, Array]] = {}

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """Nothing is compiled by torch here; to import its compiler takes a second."""
        return False

    def bind(self, tensor: torch.Tensor, array: Array) -> None:
        """Note the array of a tensor."""
        self.known[id(tensor)] = (tensor, array)

    def array(self, tensor: torch.Tensor) -> Array:
        """The array of a tensor; one that nobody has called for is a constant."""
        if id(tensor) not in self.known:
            self.bind(tensor, self.lowering.constant(tensor))
        return self.known[id(tensor)][1]

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = str(func).split(".")[1]
        rule = self.lowering.rule(name)
        if name == "_local_scalar_dense":
            if self._constant(self.array(args[0])):
                return func(*args)
            raise EngineError(f"engine: a branch on a value that is not known before{_caller()}")
        if rule is None:
            with self:  # an operation that is made of others
                parts = func.decompose(*args, **(kwargs or {}))
            if parts is NotImplemented:
                raise EngineError(f"engine: no rule for {name}{_caller()}")
            return parts
        made = rule(*self._mapped(args), **self._mapped(kwargs or {}))
        if name.endswith("_") and made is not None:  # in place: views of it change too
            target = self.array(args[0])
            if target is not made:
                target[...] = made
            made = target
        result = func(*args, **(kwargs or {}))
        if isinstance(result, torch.Tensor):
            self.bind(result, made)
        elif isinstance(result, (tuple, list)):
            for tensor, part in zip(result, made, strict=True):
                if part is not None:
                    self.bind(tensor, part)
        return result

    def _constant(self, array: Array) -> bool:
        value = self.lowering.program.value
        return all(value(int(node)) is not None for node in array.reshape(-1))

    def _mapped(self, tree: Any) -> Any:
        if isinstance(tree, torch.Tensor):
            return self.array(tree)
        if isinstance(tree, (list, tuple)):
            return [self._mapped(item) for item in tree]
        if isinstance(tree, dict):
            return {key: self._mapped(item) for key, item in tree.items()}
        return tree


def _caller() -> str:
    """File and line of the user's model that calls an operation, else of the library."""
    stack = traceback.extract_stack()
    frames = [f for f in stack if TORCH not in (others := Path(f.filename).parents)
              and others[0] != PYTHON]  # fmt: skip
    own = [f for f in frames if LIBRARY in Path(f.filename).parents]
    frames = frames[frames.index(own[0]) :] if own else frames
    models = [f for f in frames if LIBRARY not in Path(f.filename).parents]
    engine = [f for f in own if Path(f.filename).parent.name != "engine"]
    frame = (models or engine or frames)[-1]
    return f", used at {frame.filename}:{frame.lineno}: {frame.line}"
