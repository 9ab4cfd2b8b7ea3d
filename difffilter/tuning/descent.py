"""Descent on unconstrained parameters, judged on the frozen form."""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from difffilter.engine.choice import eager_seconds, settled
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.logs.log import Log
from difffilter.parameters.parameters import ParameterSet, Values
from difffilter.running.batch import run
from difffilter.running.objectives import objective, sum_losses
from difffilter.running.problem import Problem
from difffilter.scenario.estimation import lean, started
from difffilter.scenario.scenario import Scenario
from difffilter.scenario.settings import TuneSettings
from difffilter.scenario.simulation import simulate
from difffilter.scoring.losses import LossContext
from difffilter.scoring.metrics import position_error
from difffilter.seeds import stream
from difffilter.tuning.board import Board
from difffilter.tuning.curvature import Expansion, expand
from difffilter.tuning.data import Batch, Trajectories, Windows, shuffled
from difffilter.tuning.diagnose import gradient_error
from difffilter.tuning.optimisers import Optimiser, chosen, optimiser_for
from difffilter.tuning.processes import Ranks
from difffilter.tuning.search import SEARCHES
from difffilter.tuning.standard_errors import Certainty, certainty
from difffilter.tuning.state import load_state, read_state, save_state

__all__ = ["Descent"]


@dataclass
class Spent:
    """Filter runs, as ``TuneSettings.runs`` counts them, and the seconds that they took."""

    runs: float = 0.0
    seconds: float = 0.0


class Descent:
    """Data, loss and optimiser of one tuning run.

    Attributes:
        seconds: spent by the steps before each entry of the history of :meth:`search`.
    """

    def __init__(
        self,
        scenario: Scenario,
        filter: Filter,
        settings: TuneSettings,
        seed: int,
        log: Log | None,
        engine: str = "auto",
        ranks: Ranks | None = None,
    ) -> None:
        self.ranks = ranks or Ranks()
        # Nothing is isolated in simulated trajectories of built-in sensors.
        filter = filter.centralised if log is None else lean(filter, log.only(filter.channels))
        self.scenario, self.filter, self.settings, self.seed = scenario, filter, settings, seed
        self.context = LossContext(
            scenario.score,
            tuple((scene.first, scene.last) for scene in scenario.scenes),
            settings.degrees,
        )
        self.data: Trajectories | Windows
        if log is None:
            train = simulate(scenario, settings.trajectories, seed, "train")
            train = self.referred(started(scenario, filter, train))
            check = simulate(scenario, settings.validation, seed, "validation")
            self.check = self.referred(started(scenario, filter, check))
            assert train.start is not None
            self.data = Trajectories(train, train.start)
        else:
            self.check = started(scenario, filter, _timed(log))
            assert self.check.start is not None
            rows = min(settings.window, log.steps)
            self.data = Windows(self.check, self.check.start, rows, settings.refresh)
        # The first process chooses for all: others would take other steps.
        self.engine = self.ranks.told(self._pick(engine).encode()).decode()
        self.optimiser = chosen(settings, self.engine)
        #: What a mean over the data counts: the prior's weight is one of these.
        self.count = self.data.count
        if isinstance(self.data, Windows):
            self.data.engine = self.engine
            if self.optimiser in SEARCHES:  # the loss is that of the whole logs
                assert self.check.start is not None
                self.data = Trajectories(self.check, self.check.start)
        #: Filter runs and seconds of all steps so far; validation is not among them.
        self.spent = Spent()

    def referred(self, log: Log) -> Log:
        """The log with the published filter's squared errors, where the loss compares."""
        if "scenes" not in self.settings.loss:
            return log
        with torch.no_grad():
            squared = position_error(log, run(self.filter, log, engine="torch"))
        return replace(log, inputs={**log.inputs, "reference.squared": squared})

    def fingerprint(self) -> str:
        """Identifies the run for resuming: everything that its result depends on."""
        digest = hashlib.sha256(json.dumps(self.scenario.document, sort_keys=True).encode())
        digest.update(
            json.dumps([asdict(self.settings), self.seed, self.optimiser], sort_keys=True).encode()
        )
        check = self.check
        for part in (check.z, check.time, check.truth, *check.inputs.values()):
            if part is not None:
                digest.update(part.contiguous().numpy().tobytes())
        return digest.hexdigest()

    def search(
        self, state_file: Path | None, resume: bool, board: Board, progress: bool
    ) -> tuple[dict[str, Any], list[dict[str, Any]]]:
        """All starts; returns the best frozen values and the history."""
        state: dict[str, Any] | None = None
        if resume:
            if state_file is None:
                raise InputError("resume: expected out, beside which the state stands")
            content = read_state(state_file) if self.ranks.first else None
            state = load_state(state_file, self.fingerprint(), self.ranks.told(content))
        best = state["best"] if state else {"loss": math.inf}
        history: list[dict[str, Any]] = state["history"] if state else []
        self.seconds: list[float] = state["seconds"] if state else []
        first = state["start"] if state else 0
        done = first * self.settings.steps + (state["step"] if state else 0)
        with tqdm(
            total=self.settings.starts * self.settings.steps, initial=done, desc="tune",
            unit="step", delay=2.0, disable=not progress,
        ) as bar:  # fmt: skip
            for start in range(first, self.settings.starts):
                resumed = state if state and start == first else None
                best = self._descend(start, resumed, best, history, state_file, board, bar)
        return best, history

    def _descend(
        self,
        start: int,
        resumed: dict[str, Any] | None,
        best: dict[str, Any],
        history: list[dict[str, Any]],
        state_file: Path | None,
        board: Board,
        bar: Any,
    ) -> dict[str, Any]:
        """One start of the optimiser, with early stopping."""
        settings = self.settings
        parameters = self._initial(start)
        free = list(parameters.free().values())
        optimiser = optimiser_for(
            self.optimiser, settings, parameters, self.ranks, self.seed + start
        )
        self.spent = Spent()
        own_best, stale, loss, at = math.inf, 0, math.nan, 0
        if resumed is not None:
            with torch.no_grad():
                for tensor, saved in zip(free, resumed["raw"], strict=True):
                    tensor.copy_(saved)
            optimiser.restore(resumed["optimiser"])
            own_best, stale, at = resumed["own_best"], resumed["stale"], resumed["step"]
            self.spent = Spent(*resumed["spent"])
            self.data.restore(resumed["beliefs"])
        for step in range(at, settings.steps + 1):
            last = step == settings.steps or optimiser.converged
            last = last or 0.0 < settings.runs <= self.spent.runs
            if (step % optimiser.every == 0 or last) and not (resumed and step == at):
                # To the digit as published where nothing has moved yet.
                untouched = start == 0 and step == 0
                values = self.filter.published() if untouched else parameters.frozen_values()
                score = self._validate(values)
                entry = {"start": start, "step": step, "training": loss, "validation": score,
                         "runs": self.spent.runs}  # fmt: skip
                self.seconds.append(self.spent.seconds)
                plain = {name: value.tolist() for name, value in values.items()}
                history.append(entry | {"values": plain})
                board.validation(
                    start * settings.steps + step,
                    score,
                    values,
                    self.filter.declarations,
                    partial(run, self.filter, self.check, values, engine=self.engine),
                    self.check,
                )
                stale = 0 if score < own_best else stale + 1
                own_best = min(own_best, score)
                if score < best["loss"]:
                    best = {"loss": score, "values": values, "step": step, "start": start}
                if state_file is not None and self.ranks.first:
                    save_state(
                        state_file,
                        {
                            "fingerprint": self.fingerprint(),
                            "start": start,
                            "step": step,
                            "raw": [tensor.detach().clone() for tensor in free],
                            "optimiser": optimiser.state(),
                            "best": best,
                            "own_best": own_best,
                            "stale": stale,
                            "spent": [self.spent.runs, self.spent.seconds],
                            "seconds": self.seconds,
                            "history": history,
                            "beliefs": self.data.keep(),
                        },
                    )
            if last or (stale >= settings.patience and not optimiser.patient):
                bar.update(settings.steps - step)
                break
            loss = self._step(parameters, optimiser, start, step, board)
            bar.update()
            bar.set_postfix_str(f"loss {loss:.4f}, best {best['loss']:.4f}", refresh=False)
        return best

    def _step(
        self,
        parameters: ParameterSet,
        optimiser: Optimiser,
        start: int,
        step: int,
        board: Board,
    ) -> float:
        """One step of the optimiser; the loss before it."""
        settings = self.settings
        free = list(parameters.free().values())
        changed = self.data.refresh(self.filter, parameters.frozen_values(), step)
        if optimiser.full:
            index = torch.arange(self.data.count)
        else:
            index = shuffled(self.data.count, settings.batch, self.seed + start, step)
        batch = self.data.batch(self.ranks.share(index))
        temperatures: list[float | None] = []
        size = batch.log.trajectories * batch.log.steps / self.check.steps
        numbers = sum(x.numel() for x in free)

        def evaluate(temperature: float | None) -> tuple[Tensor, Mapping[str, Tensor]]:
            temperatures.append(temperature)
            self.spent.runs += size * (1 + numbers * torch.is_grad_enabled())
            loss, terms = self.loss(parameters.values(), batch, temperature)
            prior = parameters.negative_log_prior() / self.count
            # Gradients of all processes are added: each brings its share of the prior's.
            among = self.ranks.size
            return loss + prior / among + (1.0 - 1.0 / among) * prior.detach(), terms

        def expanded(temperature: float) -> Expansion:
            temperatures.append(temperature)
            self.spent.runs += size * (1 + numbers)
            return self.expand(parameters, batch, temperature)

        began = time.perf_counter()
        moved = optimiser.step(step, evaluate, expanded, changed)
        self.spent.seconds += time.perf_counter() - began
        self.ranks.agree(free)
        if not math.isfinite(moved.norm):
            raise gradient_error(self.problem(batch, temperatures[-1]), parameters.values())
        board.gradient(start * settings.steps + step, moved.loss, moved.terms, moved.norm)
        return moved.loss

    def loss(
        self, values: Values, batch: Batch, temperature: float | None
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss and terms of a batch, differentiable."""
        return objective(
            self.problem(batch, temperature), values, reduce=self.ranks.differentiable_sum
        )

    def problem(self, batch: Batch, temperature: float | None) -> Problem:
        """What the loss of a batch is a function of values for."""
        return Problem(
            self.filter,
            batch.log,
            self.settings.loss,
            start=batch.start,
            context=self.context,
            temperature=temperature,
            engine=self.engine,
        )

    def expand(
        self, parameters: ParameterSet, batch: Batch, temperature: float | None
    ) -> Expansion:
        """Loss of a batch to second order."""
        sums = sum_losses(self.problem(batch, temperature), parameters.values())
        return expand(self.settings.loss, sums, parameters, 1.0 / self.count, self.ranks)

    def certainty(self, values: Values) -> Certainty | None:
        """How well the training data determine the values; None with torch: too slow there."""
        if self.engine == "torch":
            return None
        parameters = ParameterSet(self.filter.declarations, values)
        self.data.refresh(self.filter, values, 0)
        batch = self.data.batch(self.ranks.share(torch.arange(self.data.count)))
        cold = self.settings.temperature[1]
        return certainty(parameters, partial(self.expand, parameters, batch, cold))

    def _pick(self, engine: str) -> str:
        """The engine for all of this run: ``auto`` tries the compiled one on a few trajectories."""
        settings = self.settings
        seconds = 5.0 * settings.starts * settings.steps * eager_seconds(self.check)
        few = self.check.select(list(range(min(8, self.check.trajectories))))
        problem = Problem(
            self.filter,
            few,
            settings.loss,
            context=self.context,
            temperature=settings.temperature[0],
            engine="fused",
        )
        values = ParameterSet(self.filter.declarations).values()
        return settled(engine, lambda: sum_losses(problem, values), seconds)

    def _validate(self, values: Values) -> float:
        """Loss of the frozen, hard form on the validation data."""
        own = self.check
        if self.ranks.size > 1:
            own = own.select(self.ranks.share(torch.arange(own.trajectories)))
        assert own.start is not None
        with torch.no_grad():
            loss, _ = self.loss(values, Batch(own, own.start), None)
        loss = torch.as_tensor(loss)
        self.ranks.agree([loss])
        if not bool(torch.isfinite(loss)):
            raise InputError("validation: the loss is not finite; has the data any row to score?")
        return float(loss)

    def _initial(self, start: int) -> ParameterSet:
        """Published values, or for later starts values scattered around them."""
        parameters = ParameterSet(self.filter.declarations)
        if start:
            generator = stream(self.seed, "start", start)
            with torch.no_grad():
                for tensor in parameters.free().values():
                    noise = torch.randn(tensor.shape, generator=generator, dtype=tensor.dtype)
                    tensor.add_(self.settings.scatter * noise)
        return parameters


def _timed(log: Log) -> Log:
    """The log with a time per trajectory, as windows need it."""
    if log.z.dim() != 3:
        raise InputError("logs: found one without the trajectory dimension, see stack_logs")
    time = log.time if log.time.dim() > 1 else log.time.unsqueeze(1).expand(log.z.shape[:2])
    return replace(log, time=time)
