"""Comparisons in every world of a family: of a scenario, and of logs of one's own."""

from __future__ import annotations

import math

import pytest
import torch

from difffilter import (
    Checkpoint,
    ConstantVelocity,
    Contestant,
    Family,
    Filter,
    Log,
    Member,
    Position,
    compare,
    compare_family,
    compare_worlds,
    load_scenario,
)
from difffilter.cli.main import main
from difffilter.errors import InputError

KEYS = {
    "world.steps": 20,
    "worlds": [
        {"name": "quiet", "overrides": {"faults.nlos.probability": 0.0}},
        {"name": "loud", "times": {"faults.nlos.probability": 3.0}, "role": "tune"},
    ],
}


def test_every_world_of_a_scenario_has_a_comparison_of_its_own() -> None:
    scenario = load_scenario("airport-mlat-intermittent", KEYS)
    filter = scenario.system("m-ekf")
    values = filter.published() | {"tdoa.sigma": torch.tensor(9.0, dtype=torch.float64)}
    tuned = Checkpoint(scenario, "m-ekf", values)
    found = compare_worlds(scenario, {"published": None, "mine": tuned}, 6, 3, engine="torch")
    assert list(found.comparisons) == ["base", "quiet", "loud"]
    # The base world's figures are those of a plain comparison of the same trajectories.
    plain = compare(
        scenario, {"published": None, "mine": tuned}, 6, 3, systems=("m-ekf",), engine="torch"
    )
    for label in ("published", "mine"):
        assert found.comparisons["base"].row("m-ekf", label) == plain.row("m-ekf", label)
    ratios = {name: one.row("m-ekf", "mine").ratio for name, one in found.comparisons.items()}
    assert found.worst("m-ekf", "mine")[0] == max(ratios, key=lambda name: ratios[name])
    rows = [line.split(" | ") for line in found.markdown().splitlines()[2:]]
    assert [row[0].strip("| ") for row in rows] == ["base"] * 2 + ["quiet"] * 2 + ["loud"] * 2
    assert [world["role"] for world in found.as_dict()["worlds"]] == ["tune", "guard", "tune"]


def test_a_family_of_ones_own_logs_needs_no_scenario() -> None:
    filter = Filter(ConstantVelocity(1), (Position(axes=1, sigma=2.0),), start_sigma=(9.0, 3.0))
    time = torch.arange(40, dtype=torch.float64)
    truth = torch.stack([time, torch.ones_like(time)], dim=-1).unsqueeze(1).expand(-1, 8, -1)

    def draw(sigma: float):  # type: ignore[no-untyped-def]
        def log(trajectories: int, seed: int, purpose: str) -> Log:
            noise = torch.Generator().manual_seed(seed)
            z = truth[:, :trajectories, :1] + sigma * torch.randn(
                (40, trajectories, 1), generator=noise, dtype=torch.float64
            )
            return Log(filter.channels, time, z, truth[:, :trajectories], ("x", "vx"))

        return log

    worlds = Family((Member("calm", draw(2.0)), Member("storm", draw(20.0), role="guard")))
    slow = filter.published() | {"motion.acceleration": torch.full((1,), 1e-6).double()}
    slow = {name: value.reshape(filter.published()[name].shape) for name, value in slow.items()}
    who = [Contestant("cv", "published", filter), Contestant("cv", "stiff", filter, slow)]
    found = compare_family(worlds, who, 4, engine="torch")
    calm, storm = (found.comparisons[name] for name in ("calm", "storm"))
    assert calm.trajectories == 4
    assert storm.row("cv").rmse > 4.0 * calm.row("cv").rmse
    # A filter that knows that nothing accelerates wins where nothing does.
    assert calm.row("cv", "stiff").ratio < 0.8
    assert math.isfinite(found.worst("cv", "stiff")[1].ratio)
    blind = Family((Member("blind", Log(filter.channels, time, truth[..., :1] * 1.0)),))
    with pytest.raises(InputError, match="world blind: needs truth"):
        compare_family(blind, who)
    with pytest.raises(InputError, match="found nobody"):
        compare_family(worlds, [])


def test_the_command_shows_every_world(capsys: pytest.CaptureFixture[str]) -> None:
    sets = ["--set", "world.steps=8", "--set", "worlds=[{ name = 'quiet', overrides = "
            "{ 'faults.nlos.probability' = 0.0 } }]"]  # fmt: skip
    command = ["compare", "airport-mlat-intermittent", "--worlds", "--trajectories", "3"]
    assert main([*command, "--values", "published", "--system", "ekf", *sets, "--quiet"]) == 0
    out = capsys.readouterr().out
    assert "| base | ekf | published |" in out
    assert "| quiet | ekf | published |" in out
