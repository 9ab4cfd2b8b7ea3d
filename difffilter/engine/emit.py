"""One step of a scalar program as C: lanes of trajectories side by side, loop by loop."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from difffilter.engine.derivative import tangent
from difffilter.engine.functions import CALLS
from difffilter.engine.program import Program
from difffilter.engine.schedule import Schedule, active_nodes, schedule
from difffilter.engine.text import expression, is_number, number

__all__ = ["Step"]

_LOOP = "    for (int l = 0; l < W; l++) {"
_SIMD = "#pragma omp simd\n" + _LOOP


class Step:
    """C text of ``setup`` (what depends on constants alone, once) and ``step``.

    Args:
        outputs: nodes of what a step gives, in the order of the array ``o``.
        active: places of the constants that have tangents; None without tangents.
        states: places of the states that have tangents at the start.
        following: how many of the first outputs are the next state.

    Attributes:
        moving: the outputs that have tangents.
    """

    def __init__(
        self,
        program: Program,
        outputs: Sequence[int],
        active: set[int] | None = None,
        states: set[int] | None = None,
        following: int = 0,
    ) -> None:
        self.program, self.outputs = program, list(outputs)
        self.plan: Schedule = schedule(program, outputs)
        self.gradient = active is not None
        self.active: set[int] = set()
        moved = set(states or ())
        while active is not None:
            self.active = active_nodes(program, outputs, active, moved)
            more = moved | {i for i in range(following) if outputs[i] in self.active}
            if more == moved:
                break
            moved = more
        self.moving = [i for i, node in enumerate(outputs) if node in self.active]
        self.read = sorted(
            {
                int(str(rest[1]))
                for node in program.live(outputs)
                for op, *rest in [program.nodes[node]]
                if op == "input" and rest[0] == "r"
            }
        )

    @property
    def counts(self) -> dict[str, int]:
        """Sizes of the arrays: h (kept constants), t (places between loops), o (outputs)."""
        return {
            "h": max(len(self.plan.kept), 1),
            "t": max(self.plan.size, 1),
            "o": max(len(self.outputs), 1),
        }

    def setup(self) -> str:
        """Statements that fill h, and dh for each direction."""
        body = []
        for node in self.plan.setup:
            body.append(f"    const double v{node} = {self._expression(node, -1)};")
        for node, place in self.plan.kept.items():
            body.append(f"    h[{place}] = v{node};")
        if self.gradient:
            body += self._tangents_of_setup()
        return "\n".join(body)

    def _tangents_of_setup(self) -> list[str]:
        kept: dict[str, str] = {}

        def keep(text: str) -> str:
            return kept.setdefault(text, f"u{len(kept)}")

        lines = [
            f"        const double d{node} = {self._tangent(node, -1, keep)};"
            for node in self.plan.setup
            if node in self.active
        ]
        lines += [
            f"        dh[d][{place}] = d{node};"
            for node, place in self.plan.kept.items()
            if node in self.active
        ]
        head = [f"    const double {name} = {text};" for text, name in kept.items()]
        return [*head, "    for (long d = 0; d < p; d++) {", *lines, "    }"] if lines else []

    def step(self) -> str:
        """Statements that fill o, and do for each direction."""
        body: list[str] = []
        where: dict[int, list[int]] = {}
        for i, node in enumerate(self.outputs):
            where.setdefault(node, []).append(i)
        for i, segment in enumerate(self.plan.segments):
            body += self._segment(i, segment, where)
        rest = [(i, n) for i, n in enumerate(self.outputs) if n not in self.plan.home]
        if rest:
            body.append(_SIMD)
            body += [f"        o[{i}][l] = {self._value(n, -2)};" for i, n in rest]
            body.append("    }")
            moved = [(i, n) for i, n in rest if n in self.active]
            if moved:
                body += ["    for (long d = 0; d < p; d++) {", _SIMD]
                body += [f"        dx[d][{i}][l] = {self._moved(n, -2)};" for i, n in moved]
                body.append("    }}")
        return "\n".join(body)

    def _segment(self, i: int, segment: list[int], where: dict[int, list[int]]) -> list[str]:
        kept: dict[str, str] = {}

        def keep(text: str) -> str:
            if text not in kept:
                kept[text] = f"u[{len(kept)}][l]"
            return kept[text]

        changes = []
        for node in segment:
            if node in self.active:
                changes.append(f"        const double d{node} = {self._tangent(node, i, keep)};")
                changes += self._stores(node, f"d{node}", "dt[d]", "dx[d]", where)
        loop = _SIMD if self._simple(segment) else _LOOP
        lines = [loop]
        for node in segment:
            lines.append(f"        const double v{node} = {self._expression(node, i)};")
            lines += self._stores(node, f"v{node}", "t", "o", where)
        lines += [f"        {name} = {text};" for text, name in kept.items()]
        lines.append("    }")
        if changes:
            lines = [f"    {{ double u[{max(len(kept), 1)}][W];", *lines]
            lines += ["    for (long d = 0; d < p; d++) {", _SIMD, *changes, "    }}}"]
        return lines

    def _stores(
        self, node: int, name: str, kept: str, out: str, where: dict[int, list[int]]
    ) -> list[str]:
        lines = [f"        {out}[{j}][l] = {name};" for j in where.get(node, ())]
        if node in self.plan.places:
            lines.append(f"        {kept}[{self.plan.places[node]}][l] = {name};")
        return lines

    def _simple(self, segment: Sequence[int]) -> bool:
        return all(self.program.nodes[n][0] not in CALLS for n in segment)

    def _value(self, node: int, segment: int) -> str:
        """The value of a node, read from a segment (-1: setup)."""
        op, *rest = self.program.nodes[node]
        if op == "const":
            return number(self.program.value(node))
        if op == "input":
            group, at = rest
            return f"c[{at}]" if group == "c" else f"{group}[{at}][l]"
        if segment == -1 or self.plan.home.get(node, -3) == segment:
            return f"v{node}"
        if node in self.plan.kept:
            return f"h[{self.plan.kept[node]}]"
        return f"t[{self.plan.places[node]}][l]"

    def _moved(self, node: int, segment: int) -> str:
        """The tangent of an active node, read from a segment."""
        op, *rest = self.program.nodes[node]
        if op == "input":
            group, at = rest
            return f"dc[d][{at}]" if group == "c" else f"ds[d][{at}][l]"
        if segment == -1 or self.plan.home.get(node, -3) == segment:
            return f"d{node}"
        if node in self.plan.kept:
            return f"dh[d][{self.plan.kept[node]}]"
        return f"dt[d][{self.plan.places[node]}][l]"

    def _expression(self, node: int, segment: int) -> str:
        op = str(self.program.nodes[node][0])
        return expression(op, [self._value(a, segment) for a in self.program.arguments(node)])

    def _tangent(self, node: int, segment: int, keep: Callable[[str], str]) -> str:
        args = self.program.arguments(node)
        moved = {a: self._moved(a, segment) for a in args if a in self.active}
        op = str(self.program.nodes[node][0])

        def value(n: int) -> str:
            return self._value(n, segment)

        def simple(text: str) -> str:
            # Numbers and what stands in memory anyway need no copy.
            there = text.endswith("]") and " " not in text and text[0] != "-"
            return text if there or is_number(text) else keep(text)

        inverse = self.program.reciprocal(node)
        beside = inverse is not None and self.plan.home.get(inverse, -3) == segment
        return tangent(
            op=op,
            node=node,
            args=args,
            value=value,
            keep=simple,
            moved=moved,
            inverse=value(inverse) if inverse and beside else None,
        )
