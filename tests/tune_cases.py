"""Small tuning runs: a short airport, and recorded range logs made on the spot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from helpers import tensor

from difffilter.logs.log import Log
from difffilter.logs.logfile import write_log
from difffilter.scenario.recorded import load_logs, scenario_of_run
from difffilter.scenario.scenario import Scenario, load_scenario

#: Settings that every test starts from: seconds become tenths.
FEW: dict[str, Any] = {
    "trajectories": 10,
    "validation": 8,
    "test": 4,
    "batch": 5,
    "steps": 6,
    "evaluate_every": 2,
    "optimiser": "adam",
}


def airport(steps: int = 12, **overrides: object) -> Scenario:
    """NLOS now and then; a system that is tuned in a short time."""
    keys = {key.replace("__", "."): value for key, value in overrides.items()}
    base = {"world.steps": steps, "systems.m-ekf.iterations": 2, "faults.nlos.probability": 0.2}
    return load_scenario("airport-mlat-intermittent", base | keys)


def ranges_log(run: str, steps: int, seed: int) -> Log:
    """Somebody walks in a circle near the anchors of a recorded run."""
    scenario = scenario_of_run(load_scenario("uwb-ranges"), run)
    generator = torch.Generator().manual_seed(seed)
    time = 0.1 * torch.arange(steps, dtype=torch.float64)
    angle = 0.4 * time + seed
    truth = torch.stack([-3.0 + 4.0 * angle.cos(), 4.0 + 4.0 * angle.sin()], dim=-1)
    sensor = scenario.sensors["range"].model
    constants = sensor.prepare({p.name: p.tensor() for p in sensor.parameters})
    z = sensor.predict(torch.nn.functional.pad(truth, (0, 2)), {}, constants)
    z = z + 0.1 * torch.randn(z.shape, generator=generator, dtype=torch.float64)
    draw = torch.rand(z.shape, generator=generator, dtype=torch.float64)
    z = torch.where(draw < 0.1, z + 5.0, z)
    z = torch.where(draw > 0.9, tensor(torch.nan), z)
    return Log(scenario.channels, time, z, truth, ("x", "y"))


def recorded(folder: Path, steps: tuple[int, int] = (47, 30)) -> Log:
    """Two runs of different lengths and geometry, through log files."""
    paths = []
    for seed, (run, count) in enumerate(zip(("los_A1", "nlos_A2"), steps, strict=True)):
        paths.append(folder / f"{run}.csv")
        write_log(paths[-1], ranges_log(run, count, seed))
    return load_logs(load_scenario("uwb-ranges"), paths)
