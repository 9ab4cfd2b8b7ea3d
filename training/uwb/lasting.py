"""Errors that last, on recorded ranges: tuned on three runs, tested on the fourth, in rotation.

Three filters: white range errors; one Gauss-Markov error that all ranges share; and one of each
range's own beside it. All are tuned by position error and by consistency along both principal
directions of the position's covariance. Prints RMSE, NEES along both, and the values.

Run: ``python -m training.uwb.lasting path/to/los_A1.csv ...``.
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch
from torch import Tensor

import difffilter as df

#: RMSE (m) of the filter with white errors, tuned by squared error and consistency: what errors
#: that last may cost 3 % of.
TODAY = {"los_A1": 0.757, "los_A2": 0.626, "nlos_A1": 0.760, "nlos_A2": 0.897}
LOSS = {"position": 1.0, "direction-consistency": 0.1}
STEPS, RATE = 80, 0.1
#: Published values of errors before tuning: (sigma in m, time in s).
COMMON, OWN = (0.2, 1.4), (0.05, 5.0)
MODELS = {
    "white": {},
    "common": {"common": COMMON},
    "common and own": {"common": COMMON, "own": OWN},
}


def lasting(base: df.Filter, **errors: tuple[float, float]) -> df.Filter:
    """The filter with errors that last around its ranges, everything but biases tuned."""
    ranges = df.Lasting(base.sensors[0], **errors) if errors else base.sensors[0]
    names = ["motion.acceleration", "range.sigma", "imq.k"]
    if errors:
        names += ["range.*_error", "range.*_time"]
    return df.Filter(
        base.motion, (ranges,), base.weight, standardise=base.standardise,
        start_sigma=(2.0, 2.0, 1.0, 1.0), tuned=names,
    )  # fmt: skip


def tuned(recipe: df.Filter, log: df.Log, score: df.Score | str) -> dict[str, Tensor]:
    """Values of least loss over the log's trajectories, from the declared ones."""
    problem = df.Problem(
        recipe, log, LOSS, context=df.LossContext(score), temperature=0.02, engine="fused"
    )
    parameters = df.ParameterSet(recipe.declarations)
    search = torch.optim.Adam(parameters.parameters(), lr=RATE)
    slower = torch.optim.lr_scheduler.CosineAnnealingLR(search, STEPS)
    for _ in range(STEPS):
        search.zero_grad()
        loss, _ = df.objective(problem, parameters.values())
        loss.backward()
        search.step()
        slower.step()
    return parameters.frozen_values()


def main(paths: list[str]) -> None:
    """Print a line for each filter and run left out."""
    scenario = df.load_scenario("uwb-ranges")
    base = scenario.system("robust")
    assert isinstance(base, df.Filter)
    by_run = {Path(path).stem: path for path in paths}
    print("| errors | left out | RMSE (m) | of white's | NEES, long axis | short axis | values |")
    print("|---|---|---|---|---|---|---|")
    for name, errors in MODELS.items():
        recipe = lasting(base, **errors)
        for held in by_run:
            others = [path for run, path in by_run.items() if run != held]
            train, test = (
                df.started(scenario, base, df.load_logs(scenario, part))
                for part in (others, [by_run[held]])
            )
            values = tuned(recipe, train, scenario.score)
            track = df.run(recipe, test, values)
            nees = df.mean_directions(test, track, df.scored_rows(test, track, scenario.score))
            axes = [f"{x:.2f}" for key, x in nees.items() if key.startswith("position")]
            rmse = float(df.rmse(test, track, scenario.score))
            found = [f"{n} {values[n]:.3g}" for n, p in recipe.declarations.items() if p.tuned]
            ratio = f"{rmse / TODAY[held]:.3f}"
            print("|", " | ".join([name, held, f"{rmse:.3f}", ratio, *axes, ", ".join(found)]), "|",
                  flush=True)  # fmt: skip


if __name__ == "__main__":
    main(sys.argv[1:])
