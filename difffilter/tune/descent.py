"""Gradient descent on unconstrained parameters, judged on the frozen form."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from difffilter.errors import InputError
from difffilter.estimate import lean, started
from difffilter.filter import Filter
from difffilter.log import Log
from difffilter.losses import LossContext, total_loss
from difffilter.metrics import position_error
from difffilter.parameters import ParameterSet, Values
from difffilter.run import Track, run
from difffilter.scenario.scenario import Scenario
from difffilter.seeds import stream
from difffilter.simulate import simulate
from difffilter.tune.board import Board
from difffilter.tune.data import Trajectories, Windows, shuffled
from difffilter.tune.diagnose import gradient_error
from difffilter.tune.settings import TuneSettings
from difffilter.tune.state import load_state, save_state

__all__ = ["Descent"]


class Descent:
    """Data, loss and optimiser of one tuning run."""

    def __init__(
        self,
        scenario: Scenario,
        filter: Filter,
        settings: TuneSettings,
        seed: int,
        log: Log | None,
    ) -> None:
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
            train = self._referred(started(scenario, filter, train))
            check = simulate(scenario, settings.validation, seed, "validation")
            self.check = self._referred(started(scenario, filter, check))
            assert train.start is not None
            self.data = Trajectories(train, train.start)
        else:
            self.check = started(scenario, filter, _timed(log))
            assert self.check.start is not None
            rows = min(settings.window, log.steps)
            self.data = Windows(self.check, self.check.start, rows, settings.refresh)

    def _referred(self, log: Log) -> Log:
        """The log with the published filter's squared errors, where the loss compares."""
        if "scenes" not in self.settings.loss:
            return log
        with torch.no_grad():
            squared = position_error(log, run(self.filter, log))
        return replace(log, inputs={**log.inputs, "reference.squared": squared})

    def fingerprint(self) -> str:
        """Identifies the run for resuming: everything that its result depends on."""
        digest = hashlib.sha256(json.dumps(self.scenario.document, sort_keys=True).encode())
        digest.update(json.dumps([asdict(self.settings), self.seed], sort_keys=True).encode())
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
            state = load_state(state_file, self.fingerprint())
        best = state["best"] if state else {"loss": math.inf}
        history: list[dict[str, Any]] = state["history"] if state else []
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
        """One start of Adam, with early stopping."""
        settings = self.settings
        parameters = self._initial(start)
        free = list(parameters.free().values())
        optimiser = torch.optim.Adam(free, lr=settings.learning_rate, betas=(0.9, 0.98))
        own_best, stale, loss, at = math.inf, 0, math.nan, 0
        if resumed is not None:
            with torch.no_grad():
                for tensor, saved in zip(free, resumed["raw"], strict=True):
                    tensor.copy_(saved)
            optimiser.load_state_dict(resumed["optimiser"])
            own_best, stale, at = resumed["own_best"], resumed["stale"], resumed["step"]
            self.data.restore(resumed["beliefs"])
        for step in range(at, settings.steps + 1):
            last = step == settings.steps
            if (step % settings.evaluate_every == 0 or last) and not (resumed and step == at):
                # To the digit as published where nothing has moved yet.
                untouched = start == 0 and step == 0
                values = self.filter.published() if untouched else parameters.frozen_values()
                score, track = self._validate(values)
                entry = {"start": start, "step": step, "training": loss, "validation": score}
                plain = {name: value.tolist() for name, value in values.items()}
                history.append(entry | {"values": plain})
                at_board = start * settings.steps + step
                board.validation(
                    at_board, score, values, self.filter.declarations, track, self.check
                )
                stale = 0 if score < own_best else stale + 1
                own_best = min(own_best, score)
                if score < best["loss"]:
                    best = {"loss": score, "values": values, "step": step, "start": start}
                if state_file is not None:
                    save_state(
                        state_file,
                        {
                            "fingerprint": self.fingerprint(),
                            "start": start,
                            "step": step,
                            "raw": [tensor.detach().clone() for tensor in free],
                            "optimiser": optimiser.state_dict(),
                            "best": best,
                            "own_best": own_best,
                            "stale": stale,
                            "history": history,
                            "beliefs": self.data.keep(),
                        },
                    )
            if last or stale >= settings.patience:
                bar.update(settings.steps - step)
                break
            loss = self._gradient_step(parameters, optimiser, start, step, board)
            bar.update()
            bar.set_postfix_str(f"loss {loss:.4f}, best {best['loss']:.4f}", refresh=False)
        return best

    def _gradient_step(
        self,
        parameters: ParameterSet,
        optimiser: torch.optim.Optimizer,
        start: int,
        step: int,
        board: Board,
    ) -> float:
        settings = self.settings
        progress = step / max(settings.steps - 1, 1)
        hot, cold = settings.temperature
        temperature = hot * (cold / hot) ** progress
        for group in optimiser.param_groups:
            fall = 0.05 + 0.95 * 0.5 * (1.0 + math.cos(math.pi * progress))
            group["lr"] = settings.learning_rate * fall
        values = parameters.values()
        self.data.refresh(self.filter, values, step)
        index = shuffled(self.data.count, settings.batch, self.seed + start, step)
        batch = self.data.batch(index)
        optimiser.zero_grad()
        track = run(self.filter, batch.log, values, batch.start, temperature=temperature)
        loss, terms = total_loss(settings.loss, track, batch.log, self.context)
        loss = loss + parameters.negative_log_prior() / self.data.count
        loss.backward()  # type: ignore[no-untyped-call]
        free = list(parameters.free().values())
        norm = torch.nn.utils.clip_grad_norm_(free, settings.clip)
        if not bool(torch.isfinite(norm)):
            raise gradient_error(
                self.filter, values, batch, settings.loss, self.context, temperature
            )
        optimiser.step()
        board.gradient(start * settings.steps + step, float(loss.detach()), terms, float(norm))
        return float(loss.detach())

    def _validate(self, values: Values) -> tuple[float, Track]:
        """Loss of the frozen, hard form on the validation data."""
        with torch.no_grad():
            track = run(self.filter, self.check, values)
            loss, _ = total_loss(self.settings.loss, track, self.check, self.context)
        if not bool(torch.isfinite(loss)):
            raise InputError("validation: the loss is not finite; has the data any row to score?")
        return float(loss), track

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
