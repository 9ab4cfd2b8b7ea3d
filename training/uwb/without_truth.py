"""Tuned without truth, scored with it: UWB ranges, three runs against the fourth, four times.

Each rotation is tuned by each loss, with white range errors and with one that all ranges share
and that lasts (a Gauss-Markov state). The first loss knows the truth: what the others are held
against. Prints RMSE filtered and smoothed, and NEES along both axes of P, of the run left out.

Run: ``python -m training.uwb.without_truth path/to/los_A1.csv ...``.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

import difffilter as df

TRUTH = {"position": 1.0, "consistency": 0.1}
FREE = {"likelihood": 1.0}
BOTH = {"likelihood": 1.0, "innovation-consistency": 1.0}
#: By name: what is hidden, and the loss.
WAYS = {
    "with truth": ("", TRUTH),
    "likelihood": ("", FREE),
    "hide channels": ("channels", FREE),
    "hide channels, consistent": ("channels", BOTH),
    "hide ahead, 1 s": ("ahead", FREE),
}
STEPS = 100


def lasting(base: df.Filter) -> df.Filter:
    """The filter with a range error that all channels share: Gauss-Markov, sigma and time."""
    ranges = base.sensors[0]

    def ahead(x: Tensor, dt: Tensor, inputs: object, values: dict[str, Tensor]) -> Tensor:
        step = dt.unsqueeze(-1) if dt.dim() else dt
        moved = x[..., :2] + step * x[..., 2:4]
        kept = x[..., 4:5] * torch.exp(-step / values["common.time"])
        return torch.cat([moved, x[..., 2:4], kept], -1)

    def noise(dt: Tensor, values: dict[str, Tensor]) -> Tensor:
        a, none = values["motion.acceleration"], torch.zeros_like(dt)
        share = (1.0 - torch.exp(-2.0 * dt / values["common.time"])).clamp_min(1e-12).sqrt()
        columns = [
            torch.stack([a * dt**2 / 2.0, none, a * dt, none, none], -1),
            torch.stack([none, a * dt**2 / 2.0, none, a * dt, none], -1),
            torch.stack([none, none, none, none, values["common.sigma"] * share], -1),
        ]
        return torch.stack(columns, -1)

    def seen(x: Tensor, inputs: dict[str, Tensor], values: dict[str, Tensor]) -> Tensor:
        return ranges.predict(x[..., :4], inputs, values) + x[..., 4:5]

    states = ("x", "y", "vx", "vy", "error")
    declared = (
        df.Parameter("motion.acceleration", 3.0, df.Positive(), "m/s^2", tuned=True),
        df.Parameter("common.sigma", 0.2, df.Positive(), "m", tuned=True),
        df.Parameter("common.time", 1.4, df.Positive(), "s", tuned=True),
    )
    motion = df.FunctionMotion(states, ahead, noise, declared)
    sensor = df.FunctionSensor(ranges.channels, seen, 0.1, name="range")
    found = df.Filter(
        motion,
        (sensor,),
        base.weight,
        standardise=base.standardise,
        start_sigma=(2.0, 2.0, 1.0, 1.0, 0.2),
    )
    names = ("range.sigma", *(p.name for p in base.weight.parameters))
    free = {n: replace(found.declarations[n], tuned=True) for n in names}
    return replace(found, overrides=free)


def tuned(
    recipe: df.Filter, logs: list[df.Log], way: str, score: df.Score | str
) -> dict[str, Tensor]:
    """Values of least loss over the logs, from the declared ones."""
    hide, loss = WAYS[way]
    context = df.LossContext(score)
    problems = []
    for log in logs:
        hidden = {"channels": df.hide_channels, "ahead": lambda x: df.hide_ahead(x, 1.0)}.get(hide)
        runner = recipe if hidden is None else df.Hiding(recipe)
        asked = log if hidden is None else hidden(log)
        problems.append(df.Problem(runner, asked, loss, context=context, temperature=0.02))
    parameters = df.ParameterSet(recipe.declarations)
    search = torch.optim.LBFGS(
        parameters.parameters(),
        max_iter=STEPS,
        line_search_fn="strong_wolfe",
        tolerance_change=1e-6,
    )

    def closure() -> Tensor:
        search.zero_grad()
        total = torch.stack([df.objective(p, parameters.values())[0] for p in problems]).mean()
        total.backward()
        return total

    search.step(closure)
    return parameters.frozen_values()


def main(paths: list[str]) -> None:
    """Print a line for each model, loss and run left out."""
    scenario = df.load_scenario("uwb-ranges")
    base = scenario.system("robust")
    assert isinstance(base, df.Filter)
    logs = {Path(p).stem: df.started(scenario, base, df.load_logs(scenario, [p])) for p in paths}
    print("| model | tuned by | left out | RMSE (m) | smoothed | NEES, long axis | short axis |")
    print("|---|---|---|---|---|---|---|")
    for model, recipe in (("white", base), ("lasting", lasting(base))):
        for way in WAYS:
            for held in logs:
                ready = {n: _extended(log, recipe) for n, log in logs.items()}
                others = [log for n, log in ready.items() if n != held]
                values = tuned(recipe, others, way, scenario.score)
                log = ready[held]
                track = df.run(recipe, log, values)
                smooth = df.smooth(recipe, log, values)
                nees = df.mean_directions(log, track, df.scored_rows(log, track, scenario.score))
                axes = [f"{x:.2f}" for name, x in nees.items() if name.startswith("position")]
                rmse = [f"{float(df.rmse(log, x, scenario.score)):.3f}" for x in (track, smooth)]
                print("|", " | ".join([model, way, held, *rmse, *axes]), "|", flush=True)


def _extended(log: df.Log, recipe: df.Filter) -> df.Log:
    """The log's start with what the recipe has beyond it: 0."""
    assert log.start is not None
    more = len(recipe.states) - log.start.mean.shape[-1]
    mean = torch.nn.functional.pad(log.start.mean, (0, more))
    return replace(log, start=replace(log.start, mean=mean, covariance=None))


if __name__ == "__main__":
    main(sys.argv[1:])
