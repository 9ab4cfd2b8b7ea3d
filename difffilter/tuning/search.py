"""Searches without derivatives, to compare the gradient with: random, Nelder-Mead, CMA-ES."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from difffilter.errors import InputError, NonFiniteError
from difffilter.parameters.parameters import ParameterSet
from difffilter.seeds import stream
from difffilter.tuning.curvature import Expansion
from difffilter.tuning.moved import Evaluate, Moved

__all__ = ["SEARCHES", "Method", "Search", "available"]

#: How far a search looks around the start, in unconstrained numbers: a factor e of a scale.
REACH = 1.0

#: The loss of a point (p,) of unconstrained numbers; infinite where the filter breaks down.
Function = Callable[[np.ndarray], float]


class Method(Protocol):
    """A search of its own: evaluates some points and remembers what it needs."""

    def generation(self, function: Function) -> bool:
        """Evaluate the next points; whether it has converged."""


class Random:
    """Points drawn from a normal density around the start, ten at a time."""

    def __init__(self, start: np.ndarray, seed: int) -> None:
        self.start, self.generator = start, stream(seed, "random search")

    def generation(self, function: Function) -> bool:
        steps = torch.randn(10, len(self.start), generator=self.generator, dtype=torch.float64)
        for step in steps.numpy():
            function(self.start + REACH * step)
        return False


class NelderMead:
    """The simplex of Nelder and Mead with Gao and Han's coefficients, by SciPy."""

    def __init__(self, start: np.ndarray, seed: int) -> None:
        self.minimize = needed("scipy.optimize", "scipy").minimize
        self.simplex = np.vstack([start, start + REACH * np.eye(len(start))])

    def generation(self, function: Function) -> bool:
        # A vertex that is known costs nothing: ``function`` remembers.
        found = self.minimize(
            function, self.simplex[0], method="Nelder-Mead",
            options={"initial_simplex": self.simplex, "maxiter": 2 * len(self.simplex),
                     "adaptive": True, "xatol": 1e-6, "fatol": 1e-9},
        )  # fmt: skip
        self.simplex = found.final_simplex[0]
        return bool(found.success)


class CmaEs:
    """Hansen's evolution strategy with covariance matrix adaptation, by its package cma."""

    def __init__(self, start: np.ndarray, seed: int) -> None:
        if len(start) < 2:
            raise InputError("optimiser cma-es: found one number to tune, expected two or more")
        generator = np.random.default_rng(seed)
        options = {"verbose": -9, "seed": np.nan, "randn": lambda *n: generator.normal(size=n)}
        self.strategy = needed("cma", "cma").CMAEvolutionStrategy(start, REACH, options)

    def generation(self, function: Function) -> bool:
        points = self.strategy.ask()
        # The strategy ranks losses: an infinite one is the worst.
        self.strategy.tell(points, [min(function(x), 1e300) for x in points])
        return bool(self.strategy.stop())


#: Every search by the name that ``[tuning] optimiser`` gives it.
SEARCHES: dict[str, Callable[[np.ndarray, int], Method]] = {
    "random": Random,
    "nelder-mead": NelderMead,
    "cma-es": CmaEs,
}


class Search:
    """An optimiser that reads nothing but the loss of the frozen, hard form.

    A step is one generation of its method; the numbers then stand at the best point so far.
    """

    full, every, patient = True, 1, True

    def __init__(self, name: str, parameters: ParameterSet, seed: int) -> None:
        self.free = list(parameters.free().values())
        self.start = torch.cat([x.detach().reshape(-1) for x in self.free]).double().numpy()
        self.method = SEARCHES[name](self.start, seed)
        self.known: dict[bytes, float] = {}
        self.generations, self.converged = 0, False
        self.best, self.loss = self.start, float("inf")

    def step(
        self,
        step: int,
        evaluate: Evaluate,
        expand: Callable[[float], Expansion],
        changed: bool,
    ) -> Moved:
        terms: list[dict[str, Tensor]] = [{}]

        def function(x: np.ndarray) -> float:
            key = np.ascontiguousarray(x).tobytes()
            if key not in self.known:
                self._stand(x)
                try:
                    with torch.no_grad():
                        loss, found = evaluate(None)
                    terms[0] = dict(found)
                    self.known[key] = float(loss) if bool(torch.isfinite(loss)) else float("inf")
                except NonFiniteError:
                    self.known[key] = float("inf")
            if self.known[key] < self.loss:
                self.best, self.loss = np.array(x), self.known[key]
            return self.known[key]

        if not self.generations:
            function(self.start)
        self.converged = self.method.generation(function)
        self.generations += 1
        self._stand(self.best)
        return Moved(self.loss, terms[0], 0.0)

    def _stand(self, x: np.ndarray) -> None:
        parts = torch.split(torch.from_numpy(np.array(x)), [y.numel() for y in self.free])
        with torch.no_grad():
            for tensor, part in zip(self.free, parts, strict=True):
                tensor.copy_(part.reshape(tensor.shape))

    def state(self) -> dict[str, Any]:
        keys = np.frombuffer(b"".join(self.known), dtype=np.float64)
        return {
            "generations": self.generations,
            "points": torch.from_numpy(keys.reshape(len(self.known), len(self.start)).copy()),
            "losses": torch.tensor(list(self.known.values()), dtype=torch.float64),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go through the generations again; their losses are known."""
        for x, loss in zip(state["points"].numpy(), state["losses"].tolist(), strict=True):
            self.known[x.tobytes()] = loss

        def unknown(temperature: float | None) -> Any:
            raise InputError("resume: the search asks for another point than it did before")

        for step in range(state["generations"]):
            self.step(step, unknown, unknown, False)


def available(name: str) -> bool:
    """Whether what a search needs is installed."""
    try:
        SEARCHES[name](np.zeros(2), 0)
    except InputError:
        return False
    return True


def needed(module: str, package: str) -> Any:
    """An optional package, or one line that tells how to get it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise InputError(
            f"optimiser: found no package {package}, expected it from "
            "pip install difffilter[search]"
        ) from error
