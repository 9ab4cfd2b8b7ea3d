"""A scalar program as C: blocks of trajectories side by side, the time loop inside."""

from __future__ import annotations

from difffilter.engine.program import Program
from difffilter.engine.trace import Traced

__all__ = ["WIDTH", "source"]

#: Trajectories side by side.
WIDTH = 8
#: Operations in one loop over them: the compiler takes longer over long blocks than its share.
SEGMENT = 150

_INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/"}
_COMPARE = {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!="}
_CALL = ("sqrt", "exp", "log", "log1p", "tanh", "sin", "cos", "floor", "atan2")

_HEAD = """\
#include <math.h>
#include <stddef.h>
#define W {width}
"""

_STEP = """
static void step(const double *restrict c, double (*restrict s)[W], double (*restrict r)[W],
                 double (*restrict t)[W], double (*restrict n)[W], double (*restrict o)[W])
{{
{body}
}}
"""

_RUN = """
void run(long steps, long trajectories, const double *c, const double *start,
         const double *rows, double *states, double *outputs)
{{
#pragma omp parallel for schedule(static)
    for (long block = 0; block < (trajectories + W - 1) / W; block++) {{
        double s[{s}][W], r[{r}][W], t[{t}][W], n[{s}][W], o[{o}][W];
        long first = block * W;
        long here = trajectories - first < W ? trajectories - first : W;
        for (long i = 0; i < {s}; i++)
            for (long l = 0; l < W; l++)
                s[i][l] = start[(first + (l < here ? l : 0)) * {s} + i];
        for (long k = 0; k < steps; k++) {{
            const double *row = rows + (k * trajectories + first) * {r};
            for (long l = 0; l < W; l++)
                for (long i = 0; i < {r}; i++)
                    r[i][l] = row[(l < here ? l : 0) * {r} + i];
            step(c, s, r, t, n, o);
            double *state = states + (k * trajectories + first) * {s};
            double *output = outputs + (k * trajectories + first) * {o};
            for (long i = 0; i < {s}; i++)
                for (long l = 0; l < W; l++)
                    s[i][l] = n[i][l];
            for (long l = 0; l < here; l++) {{
                for (long i = 0; i < {s}; i++)
                    state[l * {s} + i] = s[i][l];
                for (long i = 0; i < {o}; i++)
                    output[l * {o} + i] = o[i][l];
            }}
        }}
    }}
}}
"""


def source(traced: Traced) -> str:
    """C source of ``run``: the filter over trajectories, from packed inputs to packed outputs."""
    program = traced.program
    order = [
        node
        for node in program.live([*traced.next_state, *traced.results])
        if program.nodes[node][0] not in ("const", "input")
    ]
    segments = [order[i : i + SEGMENT] for i in range(0, len(order), SEGMENT)]
    home = {node: i for i, segment in enumerate(segments) for node in segment}
    kept = _crossing(program, segments, home, {*traced.next_state, *traced.results})
    place = {node: i for i, node in enumerate(sorted(kept))}

    def read(node: int, segment: int) -> str:
        op, *rest = program.nodes[node]
        if op == "const":
            return _number(program.value(node))
        if op == "input":
            group, at = rest
            return f"c[{at}]" if group == "c" else f"{group}[{at}][l]"
        return f"v{node}" if home[node] == segment else f"t[{place[node]}][l]"

    body = []
    for i, segment in enumerate(segments):
        body.append("#pragma omp simd\n    for (int l = 0; l < W; l++) {")
        for node in segment:
            op, *args = program.nodes[node]
            texts = [read(int(a), i) for a in args]  # type: ignore[call-overload]
            body.append(f"        const double v{node} = {_expression(str(op), texts)};")
            if node in place:
                body.append(f"        t[{place[node]}][l] = v{node};")
        body.append("    }")
    last = len(segments)
    body.append("#pragma omp simd\n    for (int l = 0; l < W; l++) {")
    for name, nodes in (("n", traced.next_state), ("o", traced.results)):
        body += [f"        {name}[{i}][l] = {read(node, last)};" for i, node in enumerate(nodes)]
    body.append("    }")
    sizes = {
        "s": max(traced.state.size, 1),
        "r": max(traced.row.size, 1),
        "t": max(len(place), 1),
        "o": max(traced.output.size, 1),
    }
    head = _HEAD.format(width=WIDTH)
    return head + _STEP.format(body="\n".join(body)) + _RUN.format(**sizes)


def _crossing(
    program: Program, segments: list[list[int]], home: dict[int, int], outputs: set[int]
) -> set[int]:
    """Nodes that a later segment reads, or that are outputs."""
    kept = {node for node in outputs if node in home}
    for i, segment in enumerate(segments):
        for node in segment:
            for argument in program.nodes[node][1:]:
                if home.get(argument, i) != i:  # type: ignore[call-overload]
                    kept.add(argument)  # type: ignore[arg-type]
    return kept


def _expression(op: str, args: list[str]) -> str:
    if op in _INFIX:
        return f"{args[0]} {_INFIX[op]} {args[1]}"
    if op in _COMPARE:
        return f"{args[0]} {_COMPARE[op]} {args[1]} ? 1.0 : 0.0"
    if op in _CALL:
        return f"{op}({', '.join(args)})"
    if op == "neg":
        return f"-{args[0]}" if not args[0].startswith("-") else f"-({args[0]})"
    if op == "abs":
        return f"fabs({args[0]})"
    if op == "select":
        return f"{args[0]} != 0.0 ? {args[1]} : {args[2]}"
    if op == "and":
        return f"{args[0]} * {args[1]}"
    if op == "or":
        return f"{args[0]} + {args[1]} != 0.0 ? 1.0 : 0.0"
    if op == "not":
        return f"{args[0]} != 0.0 ? 0.0 : 1.0"
    if op == "isnan":
        return f"{args[0]} != {args[0]} ? 1.0 : 0.0"
    a, b = args
    sign = "<" if op == "min" else ">"
    # NaN goes on, as in torch.
    return f"({a} {sign} {b} || {a} != {a}) ? {a} : {b}"


def _number(value: float | None) -> str:
    assert value is not None
    if value != value:
        return "NAN"
    if value in (float("inf"), float("-inf")):
        return "INFINITY" if value > 0 else "(-INFINITY)"
    text = repr(float(value))
    return text if value >= 0 and not text.startswith("-") else f"({text})"
