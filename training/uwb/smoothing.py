"""Smoothed beside filtered: position RMSE of recorded UWB runs, each a log of its own.

Run: ``python -m training.uwb.smoothing uwb-ranges path/to/*.csv``.
"""

from __future__ import annotations

import sys

import difffilter as df


def main(name: str, paths: list[str]) -> None:
    """Print a line for each log: filtered and smoothed RMSE, and their ratio."""
    scenario = df.load_scenario(name)
    recipe = scenario.system()
    for path in paths:
        log = df.started(scenario, recipe, df.load_logs(scenario, [path]))
        filtered = float(df.rmse(log, df.run(recipe, log)))
        smoothed = float(df.rmse(log, df.smooth(recipe, log)))
        print(
            f"{path}: filtered {filtered:.4f} m, smoothed {smoothed:.4f} m, "
            f"ratio {smoothed / filtered:.3f}"
        )


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
