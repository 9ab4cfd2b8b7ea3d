"""The steps of a tuning run: validated on the frozen form, stopped early, resumable."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from difffilter.errors import InputError
from difffilter.parameters.parameters import Values
from difffilter.tuning.board import Board
from difffilter.tuning.curvature import Expansion
from difffilter.tuning.data import shuffled
from difffilter.tuning.diagnose import gradient_error
from difffilter.tuning.history import Best, Course, Entry, Spent
from difffilter.tuning.optimisers import Optimiser, optimiser_for
from difffilter.tuning.state import load_state, read_state, save_state, sound
from difffilter.tuning.task import Task

__all__ = ["Descent", "descend"]


def descend(
    task: Task,
    state_file: Path | None = None,
    resume: bool = False,
    board: Board | None = None,
    progress: bool = False,
) -> Course:
    """All starts of a task's optimiser.

    Args:
        state_file: where the resumable state is kept; None keeps none.
        resume: go on from it.

    Raises:
        InputError: resume without a state file; CheckpointError: its state is damaged, or of
            another run.
    """
    state: dict[str, Any] | None = None
    if resume:
        if state_file is None:
            raise InputError("resume: expected out, beside which the state stands")
        content = read_state(state_file) if task.ranks.first else None
        state = load_state(state_file, task.fingerprint, task.ranks.told(content))
    settings, course = task.settings, Course(Best())
    first = done = 0
    if state is not None and state_file is not None:
        with sound(state_file):
            course = Course.restored(state["course"])
            first = int(state["start"])
            done = first * settings.steps + int(state["step"])
    with tqdm(
        total=settings.starts * settings.steps, initial=done, desc="tune",
        unit="step", delay=2.0, disable=not progress,
    ) as bar:  # fmt: skip
        for start in range(first, settings.starts):
            one = Descent(task, start, course, state_file, board or Board(None), bar)
            course = one.run(state if start == first else None)
    return course


class Descent:
    """One start of an optimiser.

    Args:
        start: which one; course: what was found before.
        bar: shows how far it is.
    """

    def __init__(
        self,
        task: Task,
        start: int,
        course: Course,
        state_file: Path | None,
        board: Board,
        bar: Any,
    ) -> None:
        self.task, self.start, self.course = task, start, course
        self.state_file, self.board, self.bar = state_file, board, bar
        self.parameters = task.initial(start)
        self.free = list(self.parameters.free().values())
        self.optimiser: Optimiser = optimiser_for(
            task.optimiser, task.settings, self.parameters, task.ranks, task.seed + start
        )
        self.spent = Spent()
        self.own_best, self.stale, self.loss = math.inf, 0, math.nan

    def run(self, resumed: Mapping[str, Any] | None = None) -> Course:
        """Steps until an end; what was found by then."""
        settings = self.task.settings
        at = 0
        if resumed is not None and self.state_file is not None:
            with sound(self.state_file):
                at = self._restore(resumed)
        for step in range(at, settings.steps + 1):
            end = self._end(step)
            due = step % self.optimiser.every == 0 or end
            if due and not (resumed is not None and step == at):
                self._validate(step)
            if not end and self.stale >= settings.patience and not self.optimiser.patient:
                end = "patience"
            if end:
                self.bar.update(settings.steps - step)
                break
            self.loss = self._step(step)
            self.bar.update()
            best = self.course.best.loss
            self.bar.set_postfix_str(f"loss {self.loss:.4f}, best {best:.4f}", refresh=False)
        return self.course._replace(ends=(*self.course.ends, end), spent=self.spent)

    def _end(self, step: int) -> str:
        """Why this step is not made, but for patience; empty where it is made."""
        settings = self.task.settings
        if self.optimiser.converged:
            return "converged"
        if 0.0 < settings.runs <= self.spent.runs:
            return "runs"
        return "steps" if step == settings.steps else ""

    def _validate(self, step: int) -> None:
        """Judge the frozen form, and keep what a resumed run needs."""
        task, start = self.task, self.start
        # To the digit as published where nothing has moved yet.
        untouched = start == 0 and step == 0
        values = task.filter.published() if untouched else self.parameters.frozen_values()
        score = task.validate(values)
        plain = {name: value.tolist() for name, value in values.items()}
        entry = Entry(start, step, self.loss, score, self.spent.runs, plain)
        self.course = self.course.validated(entry, values, self.spent.seconds)
        self.stale = 0 if score < self.own_best else self.stale + 1
        self.own_best = min(self.own_best, score)
        self.board.validation(
            start * task.settings.steps + step,
            score,
            values,
            task.filter.declarations,
            partial(task.track, values),
            task.check.log,
        )
        if self.state_file is not None and task.ranks.first:
            save_state(self.state_file, self._state(step))

    def _state(self, step: int) -> dict[str, Any]:
        return {
            "fingerprint": self.task.fingerprint,
            "start": self.start,
            "step": step,
            "raw": [tensor.detach().clone() for tensor in self.free],
            "optimiser": self.optimiser.state(),
            "own_best": self.own_best,
            "stale": self.stale,
            "spent": list(self.spent),
            "course": self.course.plain(),
            "beliefs": self.task.data.keep(),
        }

    def _restore(self, state: Mapping[str, Any]) -> int:
        with torch.no_grad():
            for tensor, saved in zip(self.free, state["raw"], strict=True):
                tensor.copy_(saved)
        self.optimiser.restore(state["optimiser"])
        self.own_best, self.stale = state["own_best"], state["stale"]
        self.spent = Spent(*state["spent"])
        self.task.data.restore(state["beliefs"])
        return int(state["step"])

    def _step(self, step: int) -> float:
        """One step of the optimiser; the loss before it."""
        task, settings, parameters = self.task, self.task.settings, self.parameters
        changed = task.data.refresh(task.runner, parameters.frozen_values(), step)
        if self.optimiser.full:
            index = torch.arange(task.count)
        else:
            index = shuffled(task.count, settings.batch, task.seed + self.start, step)
        batch = task.data.batch(task.ranks.share(index))
        temperatures: list[float | None] = []
        size = batch.log.trajectories * batch.log.steps / task.parts[0].steps
        numbers, runs = sum(x.numel() for x in self.free), self.spent.runs

        def evaluate(temperature: float | None) -> tuple[Tensor, Mapping[str, Tensor]]:
            nonlocal runs
            temperatures.append(temperature)
            runs += size * (1 + numbers * torch.is_grad_enabled())
            loss, terms = task.loss(parameters.values(), batch, temperature)
            prior = parameters.negative_log_prior() / task.count
            # Gradients of all processes are added: each brings its share of the prior's.
            among = task.ranks.size
            return loss + prior / among + (1.0 - 1.0 / among) * prior.detach(), terms

        def expanded(temperature: float) -> Expansion:
            nonlocal runs
            temperatures.append(temperature)
            runs += size * (1 + numbers)
            return task.expand(parameters, batch, temperature)

        began = time.perf_counter()
        moved = self.optimiser.step(step, evaluate, expanded, changed)
        self.spent = Spent(runs, self.spent.seconds + time.perf_counter() - began)
        task.ranks.agree(self.free)
        if not math.isfinite(moved.norm):
            values: Values = parameters.values()
            raise gradient_error(task.problem(batch, temperatures[-1]), values)
        at = self.start * settings.steps + step
        self.board.gradient(at, moved.loss, moved.terms, moved.norm)
        return moved.loss
