"""Rules of the engine, evaluated by the compiled code on many arguments at once."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping

import numpy as np
import torch
from torch import Tensor

from difffilter.engine.build import build
from difffilter.engine.emit import Step
from difffilter.engine.functions import FUNCTIONS
from difffilter.engine.lower import Lowering
from difffilter.engine.program import Program

Function = Callable[..., Tensor]

SOURCE = """
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#define W 8
#define C 1
#define H {h}
#define S {s}
#define T {t}
#define O {o}
{functions}
static void setup(const double *c, double *h, long p, const double (*dc)[C], double (*dh)[H])
{{
{setup}
}}
static void step(const double *c, const double *h, double (*s)[W], double (*r)[W], double (*t)[W],
                 double (*o)[W], long p, const double (*dc)[C], const double (*dh)[H],
                 double (*ds)[S][W], double (*dt)[T][W], double (*dx)[O][W])
{{
{step}
}}
void rules(long blocks, double *in, double *out, double *dout)
{{
    double c[1] = {{0}}, h[H], r[1][W], t[T][W], dc[S][C] = {{{{0}}}};
    static double dh[S][H], ds[S][S][W], dt[S][T][W];
    for (long d = 0; d < S; d++)
        for (long l = 0; l < W; l++)
            ds[d][d][l] = 1.0;
    setup(c, h, S, dc, dh);
    for (long k = 0; k < blocks; k++)
        step(c, h, (void *)(in + k * S * W), r, t, (void *)(out + k * O * W), S, dc, dh, ds, dt,
             (void *)(dout + k * S * O * W));
}}
"""


def compiled(
    functions: Mapping[str, Function], arguments: Tensor
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Values (n, ...) and derivatives (S, n, ...) of functions of rows (n, S), n a multiple of 8.

    Each function maps one row (S,) to a tensor.
    """
    program, size = Program(), arguments.shape[1]
    nodes = np.array([program.input("s", i) for i in range(size)], dtype=object)
    found = {
        name: Lowering(program).run(lambda x, f=f: [f(x)], [(arguments[0], nodes)])[0]
        for name, f in functions.items()
    }
    outputs = [int(node) for made in found.values() for node in np.ravel(made)]
    step = Step(program, outputs, set(), set(range(size)), 0)
    library = build(SOURCE.format(functions=FUNCTIONS, s=size, setup=step.setup(), step=step.step(),
                                  **step.counts))  # fmt: skip
    blocks, count = len(arguments) // 8, len(outputs)
    given = np.ascontiguousarray(arguments.numpy().reshape(blocks, 8, size).swapaxes(1, 2))
    values, slopes = np.zeros((blocks, count, 8)), np.zeros((blocks, size, count, 8))
    library.rules(ctypes.c_long(blocks), *(x.ctypes.data_as(ctypes.c_void_p)
                                           for x in (given, values, slopes)))  # fmt: skip
    values = values.swapaxes(1, 2).reshape(-1, count)
    slopes = slopes.transpose(1, 0, 3, 2).reshape(size, -1, count)
    moving, at, made = set(step.moving), 0, {}
    slopes[:, :, [i for i in range(count) if i not in moving]] = 0.0
    for name, array in found.items():
        here, shape = slice(at, at + array.size), np.shape(array)
        made[name] = (
            values[:, here].reshape(-1, *shape),
            slopes[:, :, here].reshape(size, -1, *shape),
        )
        at += array.size
    return made


def expected(function: Function, arguments: Tensor, entrywise: bool) -> tuple[np.ndarray, ...]:
    """The same by torch, in forward mode; ``entrywise``: all rows at once, as (S, n)."""
    size = arguments.shape[1]
    if not entrywise:
        values = torch.stack([function(row) for row in arguments])
        slopes = torch.stack([torch.func.jacfwd(function)(row) for row in arguments])
        return values.double().numpy(), slopes.movedim(-1, 0).double().numpy()
    made = []
    for column in torch.eye(size, dtype=torch.float64):
        along = column[:, None].expand(size, len(arguments))
        values, slope = torch.func.jvp(function, (arguments.T,), (along,))
        made.append(slope)
    return values.double().numpy(), torch.stack(made).double().numpy()


def disagreements(
    got: np.ndarray, wanted: np.ndarray, rtol: float = 1e-9, atol: float = 0.0
) -> np.ndarray:
    """Places where two arrays differ; NaN and infinities must be the same."""
    with np.errstate(all="ignore"):
        close = np.abs(got - wanted) <= atol + rtol * np.abs(wanted)
    return ~(close | (got == wanted) | (np.isnan(got) & np.isnan(wanted)))
