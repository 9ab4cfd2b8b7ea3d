"""What is tuned, on what data, by which loss: everything but the steps."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial

import torch
from torch import Tensor

from difffilter.engine.choice import eager_seconds, settled
from difffilter.errors import InputError
from difffilter.filters.hiding import Hiding
from difffilter.filters.recipe import Recipe
from difffilter.logs.family import Family
from difffilter.logs.log import Log
from difffilter.logs.track import Track
from difffilter.parameters.parameters import ParameterSet, Values
from difffilter.running.batch import run
from difffilter.running.objectives import asks_smoother, objective, sum_losses
from difffilter.running.problem import Problem
from difffilter.running.smoothing import check_smoothable
from difffilter.scenario.case import Case
from difffilter.scenario.estimation import lean, started
from difffilter.scenario.families import family
from difffilter.scenario.scenario import Scenario
from difffilter.scenario.settings import TuneSettings
from difffilter.scenario.simulation import simulate
from difffilter.scoring.losses import LossContext
from difffilter.scoring.metrics import squared_error
from difffilter.seeds import stream
from difffilter.tuning.curvature import Expansion, expand
from difffilter.tuning.data import Batch, Trajectories, Windows
from difffilter.tuning.guards import Held, held_to
from difffilter.tuning.held_back import Check, hold_back
from difffilter.tuning.hidden import hidden
from difffilter.tuning.optimisers import chosen
from difffilter.tuning.processes import Ranks
from difffilter.tuning.search import SEARCHES
from difffilter.tuning.standard_errors import Certainty, certainty
from difffilter.tuning.worlds import drawn_worlds

__all__ = ["Task"]


@dataclass(frozen=True)
class Task:
    """A recipe, the data to tune it on and to validate on, and the loss.

    Attributes:
        case: what the recipe belongs to: it says how logs start and which rows count.
        recipe: the filter; settings, seed: of the run.
        train: recorded logs, cut into windows; simulated trajectories if None.
        validation: logs to validate on; where None, simulated ones, or a part of the recorded
            ones that is held back.
        asked: engine, as for :func:`difffilter.run`; ranks: the processes of the run.
    """

    case: Case
    recipe: Recipe
    settings: TuneSettings
    seed: int = 0
    train: Log | None = None
    validation: Log | None = None
    asked: str = "auto"
    ranks: Ranks = field(default_factory=Ranks)

    @cached_property
    def filter(self) -> Recipe:
        """The recipe without local filters, where nothing can be isolated."""
        if self.train is None:  # nothing is isolated in simulated trajectories
            return self.recipe.centralised
        return lean(self.recipe, self.train.only(self.recipe.channels))

    @property
    def runner(self) -> Recipe:
        """What runs: the filter, or the filter without what is hidden from it."""
        hide = self.settings.hide
        if hide == "windows":
            check_smoothable(self.filter)
        return self.filter if hide == "nothing" else Hiding(self.filter, hide == "windows")

    def hidden(self, log: Log) -> Log:
        """The log, as often as there are ways to hide a part of it."""
        return hidden(log, self.settings, self.filter, self.seed)

    @cached_property
    def context(self) -> LossContext:
        """What the losses need beside track and log."""
        scenes = tuple((scene.first, scene.last) for scene in self.case.scenes)
        return LossContext(self.case.score, scenes, self.settings.degrees)

    @cached_property
    def parts(self) -> tuple[Log, Check]:
        """Started logs to train on, and what validates; both with what is hidden of them."""
        train, check = self._parts
        before = None if check.before is None else self.hidden(check.before)
        return self.hidden(train), check._replace(log=self.hidden(check.log), before=before)

    @property
    def _parts(self) -> tuple[Log, Check]:
        if self.train is None:
            train = self._drawn(self.settings.trajectories, "train")
            own = self.validation
            check = self._drawn(self.settings.validation, "validation") if own is None else own
            return train, Check(self.referred(self._started(check)), "")
        train = self._started(_timed(self.train))
        if self.validation is not None:
            return train, Check(self._started(_timed(self.validation)), "")
        return hold_back(train, self.filter)

    @property
    def check(self) -> Check:
        """What validates."""
        return self.parts[1]

    @cached_property
    def data(self) -> Trajectories | Windows:
        """What a gradient's batch is taken from."""
        log = self.parts[0]
        assert log.start is not None
        if self.train is None or self.optimiser in SEARCHES:  # a search: the loss of whole logs
            return Trajectories(log, log.start)
        settings = self.settings
        rows = min(settings.window, log.steps)
        return Windows(log, log.start, rows, settings.refresh, engine=self.engine)

    @cached_property
    def count(self) -> int:
        """What a mean over the data counts: the prior's weight is one of these."""
        return self.data.count

    @cached_property
    def engine(self) -> str:
        """For all of this run; the first process chooses for all: others would take other steps."""
        return self.ranks.told(self._pick().encode()).decode()

    @cached_property
    def optimiser(self) -> str:
        """Name of the optimiser."""
        return chosen(self.settings, self.engine)

    @property
    def fingerprint(self) -> str:
        """Identifies the run for resuming: everything that its result depends on."""
        plain = [self.case.document, asdict(self.settings), self.seed, self.optimiser]
        digest = hashlib.sha256(json.dumps(plain, sort_keys=True).encode())
        for log in (self.parts[0], self.check.log):
            for part in (log.z, log.time, log.truth, *log.inputs.values()):
                if part is not None:
                    digest.update(part.contiguous().numpy().tobytes())
        return digest.hexdigest()

    def referred(self, log: Log) -> Log:
        """The log with the published filter's squared errors, where the loss compares."""
        if "scenes" not in self.settings.loss:
            return log
        with torch.no_grad():
            squared = squared_error(log, run(self.filter, log, engine="torch"), self.case.score)
        return replace(log, inputs={**log.inputs, "reference.squared": squared})

    def initial(self, start: int) -> ParameterSet:
        """Published values, or for later starts values scattered around them."""
        parameters = ParameterSet(self.filter.declarations)
        if start:
            generator = stream(self.seed, "start", start)
            with torch.no_grad():
                for tensor in parameters.free().values():
                    noise = torch.randn(tensor.shape, generator=generator, dtype=tensor.dtype)
                    tensor.add_(self.settings.scatter * noise)
        return parameters

    def problem(self, batch: Batch, temperature: float | None) -> Problem:
        """What the loss of a batch is a function of values for."""
        return Problem(
            self.runner,
            batch.log,
            self.settings.loss,
            start=batch.start,
            context=self.context,
            temperature=temperature,
            engine=self.engine,
        )

    def loss(
        self, values: Values, batch: Batch, temperature: float | None
    ) -> tuple[Tensor, Mapping[str, Tensor]]:
        """Loss and terms of a batch, differentiable."""
        reduce = self.ranks.differentiable_sum
        return objective(self.problem(batch, temperature), values, reduce=reduce)

    def expand(
        self, parameters: ParameterSet, batch: Batch, temperature: float | None
    ) -> Expansion:
        """Loss of a batch to second order."""
        sums = sum_losses(self.problem(batch, temperature), parameters.values())
        share, inputs = 1.0 / self.count, batch.log.inputs
        return expand(self.settings.loss, sums, parameters, share, self.ranks, inputs)

    def validate(self, values: Values) -> float:
        """Loss of the frozen, hard form on the validation data."""
        check = self.check
        if self.ranks.size > 1:
            check = check.select(self.ranks.share(torch.arange(check.log.trajectories)))
        with torch.no_grad():
            loss, _ = self.loss(values, check.batch(self.runner, values, self.engine), None)
        loss = torch.as_tensor(loss)
        self.ranks.agree([loss])
        if not bool(torch.isfinite(loss)):
            raise InputError("validation: the loss is not finite; has the data any row to score?")
        return float(loss)

    def track(self, values: Values) -> Track:
        """The frozen form over the validation data."""
        batch = self.check.batch(self.runner, values, self.engine)
        return run(self.runner, batch.log, values, batch.start, engine=self.engine)

    def held_to_guards(self, values: Values) -> Held:
        """The values, or as much of them as every member of the family allows."""
        return held_to(
            self.family, self.filter, values, self.seed, score=self.case.score, engine=self.engine
        )

    @property
    def family(self) -> Family:
        """The case's worlds.

        Raises:
            InputError: a case without any.
        """
        if not isinstance(self.case, Scenario) or not self.case.worlds:
            raise InputError("loss worlds: found no [[worlds]], expected some in a scenario")
        return family(self.case)

    def certainty(self, values: Values, capped: bool) -> Certainty | None:
        """How well the training data determine the values; None with torch: too slow there.

        Args:
            capped: whether the tuning ended before it converged.
        """
        if self.engine == "torch":
            return None
        parameters = ParameterSet(self.filter.declarations, values)
        self.data.refresh(self.runner, values, 0)
        batch = self.data.batch(self.ranks.share(torch.arange(self.data.count)))
        cold = self.settings.temperature[1]
        return certainty(
            parameters, partial(self.expand, parameters, batch, cold), self.data.count, capped
        )

    def _drawn(self, count: int, purpose: str) -> Log:
        if "worlds" in self.settings.loss:
            return drawn_worlds(
                self.family, self.filter, count, self.seed, purpose, self.case.score
            )
        return self.referred(self._started(simulate(self.case, count, self.seed, purpose)))

    def _started(self, log: Log) -> Log:
        return started(self.case, self.filter, log)

    def _pick(self) -> str:
        """``auto`` tries the compiled engine on a few trajectories."""
        settings, log = self.settings, self.check.log
        if asks_smoother(self.runner):
            if self.asked == "fused":
                raise InputError(f"hide {settings.hide}: found engine fused, expected torch")
            return "torch"
        seconds = 5.0 * settings.starts * settings.steps * eager_seconds(log)
        few = Problem(
            self.runner,
            self.parts[0].select(list(range(min(8, self.parts[0].trajectories)))),
            settings.loss,
            context=self.context,
            temperature=settings.temperature[0],
            engine="fused",
        )
        values = ParameterSet(self.filter.declarations).values()
        return settled(self.asked, lambda: sum_losses(few, values), seconds)


def _timed(log: Log) -> Log:
    """The log with a time per trajectory, as windows need it."""
    if log.z.dim() != 3:
        raise InputError("logs: found one without the trajectory dimension, see stack_logs")
    time = log.time if log.time.dim() > 1 else log.time.unsqueeze(1).expand(log.z.shape[:2])
    return replace(log, time=time)
