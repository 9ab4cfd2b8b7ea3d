"""Tuned without truth, scored with it: UWB ranges, three runs against the fourth, four times.

Each rotation is tuned by each loss, with white range errors and with one that all ranges share
and that lasts (a Gauss-Markov state). The first loss knows the truth: what the others are held
against. Prints RMSE filtered and smoothed, and NEES along both axes of P, of the run left out.

Run: ``python -m training.uwb.without_truth path/to/los_A1.csv ...``.
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch
from torch import Tensor

import difffilter as df
from training.uwb.lasting import COMMON, lasting

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
    for model, recipe in (("white", base), ("lasting", lasting(base, common=COMMON))):
        for way in WAYS:
            for held in logs:
                others = [log for n, log in logs.items() if n != held]
                values = tuned(recipe, others, way, scenario.score)
                log = logs[held]
                track = df.run(recipe, log, values)
                smooth = df.smooth(recipe, log, values)
                nees = df.mean_directions(log, track, df.scored_rows(log, track, scenario.score))
                axes = [f"{x:.2f}" for name, x in nees.items() if name.startswith("position")]
                rmse = [f"{float(df.rmse(log, x, scenario.score)):.3f}" for x in (track, smooth)]
                print("|", " | ".join([model, way, held, *rmse, *axes]), "|", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
