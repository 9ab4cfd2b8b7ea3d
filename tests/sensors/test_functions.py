"""The compiled elementary functions against NumPy's, in units in the last place."""

from __future__ import annotations

import ctypes
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from difffilter.engine.build import build, compiler
from difffilter.engine.functions import FUNCTIONS, INLINE

pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler")

#: Of one argument, and of two.
PAIRED = ("hypot", "pow")
SINGLE = [op for op in INLINE if op not in PAIRED]

Array = NDArray[np.float64]
LARGEST, SMALLEST = float(np.finfo(float).max), 5e-324
NORMAL = float(np.finfo(float).tiny)
#: Values around which a function changes its formula, and the ends of the numbers.
EDGES = [0.0, SMALLEST, 1e-310, NORMAL, 1e-300, 1e-17, 2.0**-53, 1e-9, 0.5, 0.625, 2.0**-0.5,
         1.0, 2.0, 20.0, 700.0, 709.0, 1e10, 1e300, LARGEST]  # fmt: skip


@pytest.fixture(scope="module")
def compiled() -> Callable[..., Array]:
    """The functions over arrays, compiled as in a step: in loops for vector code."""
    loops = "".join(
        f"void many_{op}(long n, const double *x, const double *b, double *y)\n"
        "{\n#pragma omp simd\n    for (long i = 0; i < n; i++)\n"
        f"        y[i] = {name}(x[i]{', b[i]' if op in PAIRED else ''});\n}}\n"
        for op, name in INLINE.items()
    )
    head = "".join(f"#include <{name}.h>\n" for name in ("math", "stdint", "stdlib", "string"))
    library = build(head + FUNCTIONS + loops)

    def call(op: str, x: Array, b: Array | None = None) -> Array:
        x = np.ascontiguousarray(x, dtype=float)
        second = np.ascontiguousarray(x if b is None else b, dtype=float)
        y = np.empty_like(x)
        where = [a.ctypes.data_as(ctypes.c_void_p) for a in (x, second, y)]
        getattr(library, f"many_{op}")(ctypes.c_long(x.size), *where)
        return y

    return call


def around(x: Array) -> Array:
    """Numbers and their neighbours."""
    with np.errstate(all="ignore"):
        beside = [np.nextafter(x, np.inf), np.nextafter(x, -np.inf)]
    return np.unique(np.concatenate([x, *beside]))


def arguments(op: str) -> Array:
    """Random numbers over all magnitudes that matter, and the edges with their neighbours."""
    rng = np.random.default_rng(5)
    sign = rng.choice([-1.0, 1.0], 40000)
    wide = sign * 10.0 ** rng.uniform(-20.0, 3.0, 40000)
    edges = np.array([*EDGES, *(-x for x in EDGES)])
    if op == "exp":
        return np.concatenate([rng.uniform(-708.0, 709.7, 40000), wide, around(edges)])
    if op == "log":
        positive = 10.0 ** rng.uniform(-323.0, 308.0, 40000)
        near = 1.0 + rng.uniform(-0.5, 1.0, 40000)
        return np.concatenate([positive, near, around(edges[edges >= 0.0]).clip(0.0)])
    if op == "log1p":
        inside = wide[wide > -1.0]
        below = -1.0 + 10.0 ** rng.uniform(-16.0, 0.0, 10000)
        return np.concatenate([inside, below, around(edges)[around(edges) > -1.0]])
    return np.concatenate([wide, rng.uniform(-1.0, 1.0, 40000), around(edges)])


#: Largest error, in units in the last place of the true value (NumPy's own is below 1).
ULPS = {"exp": 2.0, "log": 2.0, "log1p": 4.0, "tanh": 4.0}


@pytest.mark.parametrize("op", SINGLE)
def test_errors_stay_within_units_in_the_last_place(
    compiled: Callable[..., Array], op: str
) -> None:
    x = arguments(op)
    with np.errstate(all="ignore"):
        exact = getattr(np, op)(x.astype(np.longdouble))
        expected = exact.astype(float)
    found = compiled(op, x)
    normal = np.isfinite(expected) & (np.abs(expected) >= NORMAL)
    unit = np.spacing(np.abs(expected[normal]))
    error = (np.abs(found[normal] - exact[normal]) / unit).astype(float)
    worst = int(error.argmax())
    assert error[worst] <= ULPS[op], f"{error[worst]:.3g} ulp at {x[normal][worst]!r}"
    # Results below the normal numbers: to a few of the smallest.
    rest = np.isfinite(expected) & ~normal
    assert np.abs(found[rest] - expected[rest]).max(initial=0.0) <= 2.0 * SMALLEST
    infinite = np.isinf(expected)
    assert np.array_equal(found[infinite], expected[infinite])


SPECIAL: dict[str, list[tuple[float, float]]] = {
    "exp": [(0.0, 1.0), (-0.0, 1.0), (710.0, np.inf), (1e300, np.inf), (np.inf, np.inf),
            (-746.0, 0.0), (-1e300, 0.0), (-np.inf, 0.0), (np.nan, np.nan)],
    "log": [(0.0, -np.inf), (-0.0, -np.inf), (1.0, 0.0), (-1.0, np.nan), (-SMALLEST, np.nan),
            (np.inf, np.inf), (-np.inf, np.nan), (np.nan, np.nan)],
    "log1p": [(0.0, 0.0), (-0.0, -0.0), (-1.0, -np.inf), (-2.0, np.nan), (np.inf, np.inf),
              (-np.inf, np.nan), (np.nan, np.nan), (SMALLEST, SMALLEST)],
    "tanh": [(0.0, 0.0), (-0.0, -0.0), (np.inf, 1.0), (-np.inf, -1.0), (1e300, 1.0),
             (-40.0, -1.0), (np.nan, np.nan), (SMALLEST, SMALLEST)],
}  # fmt: skip


@pytest.mark.parametrize("op", SINGLE)
def test_special_values_are_exact(compiled: Callable[..., Array], op: str) -> None:
    x, expected = (np.array(column) for column in zip(*SPECIAL[op], strict=True))
    found = compiled(op, x)
    for given, a, b in zip(x, found, expected, strict=True):
        assert a == b or (np.isnan(a) and np.isnan(b)), f"{op}({given!r}) is {a!r}, not {b!r}"
        if b == 0.0 and op in ("exp", "log1p"):  # tanh(-0) is +0, which nothing here tells apart
            assert np.signbit(a) == np.signbit(b), f"{op}({given!r}) has the wrong sign"


def test_odd_and_monotonic_where_the_formula_changes(
    compiled: Callable[..., Array],
) -> None:
    x = np.linspace(0.6, 0.65, 4001)
    assert np.array_equal(compiled("tanh", -x), -compiled("tanh", x))
    assert (np.diff(compiled("tanh", x)) > 0.0).all()
    near = np.linspace(0.7, 0.72, 4001)
    assert (np.diff(compiled("log", near)) > 0.0).all()


def test_a_length_is_right_to_units_in_the_last_place(compiled: Callable[..., Array]) -> None:
    rng = np.random.default_rng(6)
    x, y = 10.0 ** rng.uniform(-150.0, 150.0, (2, 20000)) * rng.choice([-1.0, 1.0], (2, 20000))
    x[:10000] = y[:10000] * rng.uniform(-2.0, 2.0, 10000)
    exact = np.hypot(x.astype(np.longdouble), y.astype(np.longdouble))
    error = np.abs(compiled("hypot", x, y) - exact) / np.spacing(exact.astype(float))
    assert float(error.max()) <= 3.0


def test_a_power_is_right_as_far_as_its_logarithm_is(compiled: Callable[..., Array]) -> None:
    rng = np.random.default_rng(7)
    a, b = 10.0 ** rng.uniform(-30.0, 30.0, 20000), rng.uniform(-9.0, 9.0, 20000)
    a[:5000], b[:5000] = -a[:5000], b[:5000].round()
    exact = np.power(a.astype(np.longdouble), b.astype(np.longdouble))
    error = np.abs(compiled("pow", a, b) - exact) / np.spacing(np.abs(exact.astype(float)))
    # The exponent b log a is rounded, twice, before it is raised.
    assert (error.astype(float) <= 3.0 + 2.0 * np.abs(b * np.log(np.abs(a)))).all()


@pytest.mark.parametrize("op", PAIRED)
def test_special_pairs_are_those_of_numpy(compiled: Callable[..., Array], op: str) -> None:
    values = np.array([0.0, -0.0, 1.0, -1.0, 2.0, -2.0, 3.0, 0.5, -0.5, np.inf, -np.inf, np.nan])
    x, y = (grid.reshape(-1) for grid in np.meshgrid(values, values))
    with np.errstate(all="ignore"):
        expected = (np.hypot if op == "hypot" else np.power)(x, y)
    np.testing.assert_allclose(compiled(op, x, y), expected, rtol=1e-15)
