"""The compiled functions around a step: blocks of trajectories, the time loop inside."""

from __future__ import annotations

from difffilter.engine.emit import Step
from difffilter.engine.functions import FUNCTIONS
from difffilter.engine.trace import Layout, Traced

__all__ = ["WIDTH", "run_source", "sums_source", "width_for"]

#: Trajectories side by side, at most.
WIDTH = 8

_HEAD = """\
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#define W {width}
#define C {c}
#define H {h}
#define S {s}
#define R {r}
#define T {t}
#define O {o}
"""

_RUN = """
static void setup(const double *c, double *h)
{{
{setup}
}}

static void step(const double *restrict c, const double *restrict h, double (*restrict s)[W],
                 double (*restrict r)[W], double (*restrict t)[W], double (*restrict o)[W])
{{
{step}
}}

void run(long steps, long trajectories, const double *c, const double *start,
         const double *const *in, const long *along, const long *across,
         double *states, double *outputs)
{{
    double h[H];
    setup(c, h);
#pragma omp parallel for schedule(static) if (trajectories > W)
    for (long block = 0; block < (trajectories + W - 1) / W; block++) {{
        double s[S][W], r[R][W], t[T][W], o[O][W];
        long first = block * W;
        long here = trajectories - first < W ? trajectories - first : W;
        for (long i = 0; i < {states}; i++)
            for (long l = 0; l < W; l++)
                s[i][l] = start[(first + (l < here ? l : 0)) * {states} + i];
        for (long k = 0; k < steps; k++) {{
            for (long l = 0; l < W; l++) {{
                long b = first + (l < here ? l : 0);
{load}
            }}
            step(c, h, s, r, t, o);
            memcpy(s, o, {states} * sizeof s[0]);
            double *state = states + (k * trajectories + first) * {states};
            double *output = outputs + (k * trajectories + first) * {results};
            for (long l = 0; l < here; l++) {{
                for (long i = 0; i < {states}; i++)
                    state[l * {states} + i] = s[i][l];
                for (long i = 0; i < {results}; i++)
                    output[l * {results} + i] = o[{states} + i][l];
            }}
        }}
    }}
}}
"""

_ONE = """
void constants(const double *c, double *h)
{{
    setup(c, h);
}}

/* One step of one belief: 0, or 1 + the place of the first number that is not finite (the
   belief stays as it was then). The record's last two fields are truth values; behind the others
   comes the new belief. */
long one(const double *c, const double *h, double *state, const double *const *in,
         double *output, unsigned char *flags)
{{
    double (*s)[W] = (double (*)[W])state, r[R][W], t[T][W], o[O][W];
    const long l = 0;
{one}
    step(c, h, s, r, t, o);
    memcpy(output, o + {states}, {numbers} * sizeof *output);
    for (long i = {numbers}; i < {results}; i++)
        flags[i - {numbers}] = o[{states} + i][0] != 0.0;
    for (long i = 0; i < {belief}; i++)
        if (!isfinite(o[i][0]))
            return i + 1;
    memcpy(state, o, {states} * sizeof *state);
    memcpy(output + {numbers}, o, {states} * sizeof *state);
    return 0;
}}
"""

_SUMS = """
#define Q {q}
#define E {e}

static void setup(const double *c, double *h, long p, const double (*dc)[C], double (*dh)[H])
{{
{setup}
}}

static void step(const double *restrict c, const double *restrict h, double (*restrict s)[W],
                 double (*restrict r)[W], double (*restrict t)[W], double (*restrict o)[W],
                 long p, const double (*restrict dc)[C], const double (*restrict dh)[H],
                 double (*restrict ds)[S][W], double (*restrict dt)[T][W],
                 double (*restrict dx)[O][W])
{{
{step}
}}

/* Per trajectory: sums, their tangents (p, Q), J^T J (p, p), the first step that is not finite */
int sums(long steps, long trajectories, const double *c, const double *start,
         const double *const *in, const long *along, const long *across,
         long p, const double (*dc)[C], const double *dstart,
         double *total, double *dtotal, double *gram, long *bad)
{{
    double h[H];
    double (*dh)[H] = calloc(p + 1, sizeof *dh);
    if (dh == NULL)
        return 1;
    setup(c, h, p, dc, dh);
    int failed = 0;
#pragma omp parallel if (trajectories > W)
    {{
        double s[S][W], r[R][W], t[T][W], o[O][W], acc[Q][W];
        double (*ds)[S][W] = calloc(p + 1, sizeof *ds), (*dt)[T][W] = calloc(p + 1, sizeof *dt);
        double (*dx)[O][W] = calloc(p + 1, sizeof *dx), (*dacc)[Q][W] = calloc(p + 1, sizeof *dacc);
        double (*jtj)[W] = calloc(p * p + 1, sizeof *jtj);
        int lack = !ds || !dt || !dx || !dacc || !jtj;
        if (lack) {{
#pragma omp atomic write
            failed = 1;
        }}
#pragma omp for schedule(static)
        for (long block = 0; block < (trajectories + W - 1) / W; block++) {{
            if (lack)
                continue;
            long first = block * W, wrong[W];
            long here = trajectories - first < W ? trajectories - first : W;
            memset(acc, 0, sizeof acc);
            memset(dacc, 0, (p + 1) * sizeof *dacc);
            memset(jtj, 0, (p * p + 1) * sizeof *jtj);
            memset(ds, 0, (p + 1) * sizeof *ds);
            for (long l = 0; l < W; l++) {{
                long b = first + (l < here ? l : 0);
                wrong[l] = -1;
                for (long i = 0; i < {states}; i++)
                    s[i][l] = start[b * {states} + i];
                for (long d = 0; dstart != NULL && d < p; d++)
                    for (long i = 0; i < {states}; i++)
                        ds[d][i][l] = dstart[(d * trajectories + b) * {states} + i];
            }}
            for (long k = 0; k < steps; k++) {{
                for (long l = 0; l < W; l++) {{
                    long b = first + (l < here ? l : 0);
{load}
                }}
                step(c, h, s, r, t, o, p, dc, dh, ds, dt, dx);
                memcpy(s, o, {states} * sizeof s[0]);
                double finite[W] = {{0}};
                for (long i = 0; i < {belief}; i++) /* mean and deviations; not memory */
                    for (long l = 0; l < W; l++)
                        finite[l] += s[i][l] * 0.0;
                for (long l = 0; l < W; l++)
                    if (finite[l] != 0.0 && wrong[l] < 0)
                        wrong[l] = k;
                for (long i = 0; i < {q}; i++)
                    for (long l = 0; l < W; l++)
                        acc[i][l] += o[{states} + i][l];
                for (long d = 0; d < p; d++) {{
{advance}
                    for (long i = 0; i < {q}; i++)
                        for (long l = 0; l < W; l++)
                            dacc[d][i][l] += dx[d][{states} + i][l];
                    for (long e = 0; e <= d && {e}; e++)
                        for (long i = 0; i < {e}; i++)
                            for (long l = 0; l < W; l++)
                                jtj[d * p + e][l] += dx[d][{states} + {q} + i][l]
                                                     * dx[e][{states} + {q} + i][l];
                }}
            }}
            for (long l = 0; l < here; l++) {{
                long b = first + l;
                bad[b] = wrong[l];
                for (long i = 0; i < {q}; i++)
                    total[b * {q} + i] = acc[i][l];
                for (long d = 0; d < p; d++) {{
                    for (long i = 0; i < {q}; i++)
                        dtotal[(b * p + d) * {q} + i] = dacc[d][i][l];
                    for (long e = 0; e <= d; e++)
                        gram[(b * p + d) * p + e] = gram[(b * p + e) * p + d] = jtj[d * p + e][l];
                }}
            }}
        }}
        free(ds); free(dt); free(dx); free(dacc); free(jtj);
    }}
    free(dh);
    return failed;
}}
"""


def width_for(trajectories: int) -> int:
    """Lanes for a job: none stays empty where there are few trajectories."""
    return next(width for width in (1, 2, 4, WIDTH) if width >= min(trajectories, WIDTH))


def run_source(traced: Traced, width: int = WIDTH) -> str:
    """C source of ``run``: states and records of every step."""
    step = Step(traced.program, [*traced.next_state, *traced.results])
    parts = {
        "setup": step.setup(),
        "step": step.step(),
        "load": _load(traced.row, step.read),
        "one": _load(traced.row, step.read, "x{a} = in[{a}]"),
        "states": traced.state.size,
        "belief": _belief(traced),
        "results": traced.output.size,
        "numbers": traced.output.size - 2 * traced.row.count(traced.row.shapes["z"]),
    }
    text = _head(traced, step, width) + _RUN.format(**parts)
    return text + _ONE.format(**parts) if width == 1 else text


def sums_source(
    traced: Traced, active: set[int] | None, states: set[int], width: int = WIDTH
) -> str:
    """C source of ``sums``: sums of the losses' rows and their tangents, nothing kept per step.

    Args:
        active: places of the constants that have tangents; states: of the start's.
    """
    added = [node for loss in traced.sums for node in loss]
    outputs = [*traced.next_state, *added, *traced.residuals]
    step = Step(traced.program, outputs, active, states, traced.state.size)
    count = traced.state.size
    moving = [i for i in step.moving if i < count]
    advance = "\n".join(
        f"                    memcpy(ds[d][{i}], dx[d][{i}], sizeof s[0]);" for i in moving
    )
    still = [i for i in sorted(states) if i not in moving]
    advance += "".join(f"\n                    memset(ds[d][{i}], 0, sizeof s[0]);" for i in still)
    return _head(traced, step, width) + _SUMS.format(
        setup=step.setup(),
        step=step.step(),
        load=_load(traced.row, step.read),
        advance=advance,
        states=count,
        belief=_belief(traced),
        q=len(added),
        e=len(traced.residuals),
    )


def _belief(traced: Traced) -> int:
    """How many numbers mean and deviations are; they come first."""
    shapes = traced.state.shapes
    return traced.state.count(shapes["mean"]) + traced.state.count(shapes["deviations"])


def _head(traced: Traced, step: Step, width: int) -> str:
    sizes = {
        "c": max(traced.constants.size, 1),
        "s": max(traced.state.size, 1),
        "r": max(traced.row.size, 1),
    }
    return _HEAD.format(width=width, **sizes, **step.counts) + FUNCTIONS


def _load(
    row: Layout, read: list[int], place: str = "x{a} = in[{a}] + k * along[{a}] + b * across[{a}]"
) -> str:
    """Statements that fetch the entries of a row that the step reads."""
    lines, at = [], 0
    for a, shape in enumerate(row.shapes.values()):
        count = row.count(shape)
        here = [i for i in read if at <= i < at + count]
        if here:
            lines.append(f"    const double *{place.format(a=a)};")
            lines += [f"    r[{i}][l] = x{a}[{i - at}];" for i in here]
        at += count
    return "\n".join("                " + line for line in lines)
