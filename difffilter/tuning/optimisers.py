"""What moves the tuned values: Adam, L-BFGS, or Gauss-Newton with Levenberg's damping."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Protocol

import torch
from torch import Tensor

from difffilter.parameters.parameters import ParameterSet
from difffilter.scenario.settings import TuneSettings
from difffilter.tuning.curvature import Expansion, known
from difffilter.tuning.moved import Evaluate, Expand, Moved
from difffilter.tuning.processes import Ranks
from difffilter.tuning.search import SEARCHES, Search

__all__ = ["Adam", "GaussNewton", "Lbfgs", "Optimiser", "chosen", "optimiser_for"]


class Optimiser(Protocol):
    """Moves the unconstrained numbers of a parameter set, one step at a time.

    Attributes:
        full: whether a step wants all trajectories instead of a batch.
        every: steps between validations.
        converged: whether further steps would change nothing.
        patient: whether it goes on however long nothing gets better.
    """

    full: bool
    every: int
    converged: bool
    patient: bool

    def step(self, step: int, evaluate: Evaluate, expand: Expand, changed: bool) -> Moved:
        """Move once; ``changed`` tells that the data are others than at the step before."""

    def state(self) -> dict[str, Any]:
        """Tensors and plain data to resume from, beside the numbers themselves."""

    def restore(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state`."""


def chosen(settings: TuneSettings, engine: str) -> str:
    """Name of the optimiser; ``auto`` chooses by losses and engine."""
    if settings.optimiser != "auto":
        return settings.optimiser
    return "gauss-newton" if known(settings.loss) and engine == "fused" else "adam"


def optimiser_for(
    name: str, settings: TuneSettings, parameters: ParameterSet, among: Ranks, seed: int = 0
) -> Optimiser:
    """The optimiser of that name.

    Args:
        among: processes whose gradients are added.
        seed: of a search that draws its points.
    """
    if name in SEARCHES:
        return Search(name, parameters, seed)
    if name == "adam":
        return Adam(settings, parameters, among)
    if name == "lbfgs":
        return Lbfgs(settings, parameters, among)
    return GaussNewton(settings, parameters)


def _temperature(settings: TuneSettings, share: float) -> float:
    """Geometric from the first to the last temperature."""
    hot, cold = settings.temperature
    return float(hot * (cold / hot) ** min(share, 1.0))


def _add_gradients(free: list[torch.nn.Parameter], among: Ranks) -> None:
    for x in free:
        if x.grad is not None:
            x.grad = among.add(x.grad)


class Adam:
    """Stochastic gradients; the rate falls along a cosine to a twentieth."""

    full, converged, patient = False, False, False

    def __init__(self, settings: TuneSettings, parameters: ParameterSet, among: Ranks) -> None:
        self.among = among
        self.settings, self.every = settings, settings.evaluate_every
        self.free = list(parameters.free().values())
        self.adam = torch.optim.Adam(self.free, lr=settings.learning_rate, betas=(0.9, 0.98))

    def step(self, step: int, evaluate: Evaluate, expand: Expand, changed: bool) -> Moved:
        settings = self.settings
        progress = step / max(settings.steps - 1, 1)
        for group in self.adam.param_groups:
            fall = 0.05 + 0.95 * 0.5 * (1.0 + math.cos(math.pi * progress))
            group["lr"] = settings.learning_rate * fall
        self.adam.zero_grad()
        loss, terms = evaluate(_temperature(settings, progress))
        loss.backward()  # type: ignore[no-untyped-call]
        _add_gradients(self.free, self.among)
        norm = torch.nn.utils.clip_grad_norm_(self.free, settings.clip)
        if bool(torch.isfinite(norm)):
            self.adam.step()
        return Moved(float(loss.detach()), terms, float(norm))

    def state(self) -> dict[str, Any]:
        return self.adam.state_dict()

    def restore(self, state: dict[str, Any]) -> None:
        self.adam.load_state_dict(state)


#: Steps over which the methods that take few of them cool down.
COOLING = 8


class Lbfgs:
    """Quasi-Newton over all trajectories, with a line search."""

    full, converged, patient = True, False, False

    def __init__(self, settings: TuneSettings, parameters: ParameterSet, among: Ranks) -> None:
        self.among = among
        self.settings, self.every = settings, max(settings.evaluate_every // 5, 1)
        self.free = list(parameters.free().values())
        self._fresh()

    def _fresh(self) -> None:
        self.lbfgs = torch.optim.LBFGS(
            self.free, lr=1.0, max_iter=1, max_eval=6, line_search_fn="strong_wolfe"
        )

    def step(self, step: int, evaluate: Evaluate, expand: Expand, changed: bool) -> Moved:
        if changed or step <= COOLING:  # another function: what was learnt of the last one is void
            self._fresh()
        last: list[tuple[Tensor, Mapping[str, Tensor], float]] = []

        def closure() -> Tensor:
            self.lbfgs.zero_grad()
            loss, terms = evaluate(_temperature(self.settings, step / COOLING))
            loss.backward()  # type: ignore[no-untyped-call]
            _add_gradients(self.free, self.among)
            square = sum(
                (x.grad.square().sum() for x in self.free if x.grad is not None), torch.zeros(())
            )
            last.append((loss.detach(), terms, float(torch.as_tensor(square).sqrt())))
            return loss

        before = [x.detach().clone() for x in self.free]
        self.lbfgs.step(closure)  # type: ignore[no-untyped-call]
        loss, terms, norm = last[0]
        still = all(torch.equal(a, b.detach()) for a, b in zip(before, self.free, strict=True))
        self.converged = still and step > COOLING
        return Moved(float(loss), terms, norm)

    def state(self) -> dict[str, Any]:
        return {"lbfgs": self.lbfgs.state_dict(), "converged": self.converged}

    def restore(self, state: dict[str, Any]) -> None:
        self.lbfgs.load_state_dict(state["lbfgs"])
        self.converged = state["converged"]


class GaussNewton:
    """Levenberg-Marquardt over all trajectories, with Nielsen's damping.

    Each step solves (H + mu D) d = -g with D the diagonal of H, moves no unconstrained number
    by more than one (a factor e of a scale), and is taken back if the loss does not fall.
    """

    full, patient = True, False

    def __init__(self, settings: TuneSettings, parameters: ParameterSet) -> None:
        self.settings, self.every = settings, max(settings.evaluate_every // 5, 1)
        self.free = list(parameters.free().values())
        self.damping, self.growth, self.converged = 1e-2, 2.0, False
        self.last: Expansion | None = None

    def step(self, step: int, evaluate: Evaluate, expand: Expand, changed: bool) -> Moved:
        temperature = _temperature(self.settings, step / COOLING)
        if self.last is None or changed or step <= COOLING:
            self.last = expand(temperature)
        now = self.last
        norm = float(now.gradient.norm())
        if not math.isfinite(norm):
            return Moved(now.loss, now.terms, norm)
        move = self._move(now)
        fall = -float(now.gradient @ move + 0.5 * move @ now.curvature @ move)
        before = [x.detach().clone() for x in self.free]
        self._shift(move)
        trial = expand(temperature)
        gain = (now.loss - trial.loss) / fall if fall > 0.0 else -1.0
        if gain > 0.0 and math.isfinite(trial.loss):
            self.last = trial
            self.damping *= max(1.0 / 5.0, 1.0 - (2.0 * gain - 1.0) ** 3)
            self.damping, self.growth = max(self.damping, 1e-7), 2.0
        else:
            with torch.no_grad():
                for x, old in zip(self.free, before, strict=True):
                    x.copy_(old)
            self.damping, self.growth = self.damping * self.growth, 2.0 * self.growth
        flat = fall < 1e-6 and self.damping < 1.0
        self.converged = step > COOLING and (flat or self.damping > 1e6)
        return Moved(now.loss, now.terms, norm)

    def _move(self, now: Expansion) -> Tensor:
        """The damped step; damped further until no number moves by more than one."""
        diagonal = now.curvature.diagonal()
        # A direction that the data hardly determine must not run away.
        scale = torch.diag(diagonal.clamp_min(1e-2 * float(diagonal.max()) + 1e-12))
        while True:
            lower = torch.linalg.cholesky(now.curvature + self.damping * scale)
            move = torch.cholesky_solve(-now.gradient[:, None], lower)[:, 0]
            if float(move.abs().max()) <= 1.0:
                return move
            self.damping *= 2.0

    def _shift(self, move: Tensor) -> None:
        with torch.no_grad():
            parts = torch.split(move, [x.numel() for x in self.free])
            for x, part in zip(self.free, parts, strict=True):
                x.add_(part.reshape(x.shape))

    def state(self) -> dict[str, Any]:
        return {
            "damping": self.damping,
            "growth": self.growth,
            "converged": self.converged,
            "last": None if self.last is None else self.last._asdict(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        self.damping, self.growth = state["damping"], state["growth"]
        self.last = None if state["last"] is None else Expansion(**state["last"])
        self.converged = state["converged"]
