"""Exported C of filters with errors that last, delays and noise laws repeats the filter."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

import difffilter as df

CC = shutil.which("cc") or shutil.which("gcc")
BEACONS = [(0.0, 0.0), (120.0, 0.0), (0.0, 90.0)]
ROWS = 80


def ranges() -> df.Range:
    return df.Range(stations=BEACONS, sigma=0.5, name="range")


def fix() -> df.Position:
    return df.Position(sigma=1.0, name="fix")


SENSORS: dict[str, Callable[[], tuple[df.Sensor, ...]]] = {
    "all at once": lambda: (
        df.Lasting(ranges(), own=(0.3, 9.0), common=(1.0, 5.0)),
        df.Varying(df.Delayed(fix(), delay=0.3), "times", "hdop"),
    ),
    "common error": lambda: (df.Lasting(ranges(), common=(1.0, 5.0)), fix()),
}


def simulate(recipe: df.Filter, seed: int, count: int) -> df.Log:
    """Along a line; the start tells of position and velocity alone."""
    draw = torch.Generator().manual_seed(seed)
    time = 0.5 * torch.arange(1, ROWS + 1, dtype=torch.float64)
    place = torch.stack([20.0 + 1.5 * time, 30.0 + 0.5 * time], -1)
    stations = torch.tensor(BEACONS, dtype=torch.float64)
    exact = torch.cat([(place[:, None] - stations).norm(dim=-1), place], -1)[:, None]
    z = exact + torch.randn(ROWS, count, 5, generator=draw, dtype=torch.float64)
    begin = torch.tensor([20.0, 30.0, 0.0, 0.0], dtype=torch.float64)
    start = df.Start(begin, 4.0 * torch.eye(4).double(), 0.0)
    hdop = 1.0 + torch.rand(ROWS, count, generator=draw, dtype=torch.float64)
    return df.Log(recipe.channels, time, z, inputs={"hdop": hdop}, start=start)


@pytest.mark.skipif(CC is None, reason="no C compiler")
@pytest.mark.parametrize(
    ("case", "simulated"),
    [("all at once", False), ("common error", True), ("common error", False)],
)
def test_the_self_test_passes(case: str, simulated: bool, tmp_path: Path) -> None:
    recipe = df.Filter(df.ConstantVelocity(acceleration=0.3), SENSORS[case](), start_sigma=3.0)
    source = (lambda seed, count: simulate(recipe, seed, count)) if simulated else None
    model = df.Model(recipe, "tractor", simulate=source, factory="tractor:make")
    checkpoint = df.Checkpoint(model, "tractor", recipe.published())
    df.export_c(checkpoint, tmp_path)
    command = [str(CC), "-std=c99", "-O1", "tractor.c", "tractor_test.c", "-o", "check", "-lm"]
    assert subprocess.run(command, cwd=tmp_path, check=False).returncode == 0
    done = subprocess.run(["./check"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
