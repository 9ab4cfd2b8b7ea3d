"""Numbers in a wrong unit are found when a log is read; right ones never are."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from difffilter import LogError, load_logs, load_scenario, simulate
from difffilter.cli.main import main
from difffilter.scenario.plausibility import check_units

TRACKER = """\
schema = 1
name = "tracker"
title = "A vehicle among beacons"
[sensors]
fix = { kind = "position" }
reach = { kind = "range", stations = [[0.0, 0.0], [400.0, 0.0], [0.0, 400.0], [400.0, 400.0]] }
sight = { kind = "bearing", platform = ["platform_x", "platform_y"] }
[parameters]
motion.acceleration = { value = 0.5 }
fix.sigma = { value = 3.0 }
reach.sigma = { value = 2.0 }
sight.sigma = { value = 0.5, unit = "deg" }
start.sigma = { value = [10.0, 10.0, 20.0, 20.0] }
[systems.ekf]
sensors = SENSORS
[systems.all]
"""
FIX = ("fix_1", "fix_2")
REACH = ("reach_1", "reach_2", "reach_3", "reach_4")


def world(seed: int = 0) -> dict[str, Any]:
    """A vehicle in a town, 200 rows, 0.5 s apart; far off one looks at it, within 6 degrees."""
    rng = np.random.default_rng(seed)
    time = 0.5 * np.arange(200)
    x, y = 60.0 + 2.5 * time, 150.0 + 60.0 * np.sin(time / 15.0)
    stations = np.array([[0.0, 0.0], [400.0, 0.0], [0.0, 400.0], [400.0, 400.0]])
    px, py = -1500.0 + 3.0 * time, 150.0 + 30.0 * np.cos(time / 9.0)
    found = {"time": time, "platform_x": px, "platform_y": py, "truth_x": x, "truth_y": y}
    found |= {n: v + 3.0 * rng.normal(size=200) for n, v in zip(FIX, (x, y), strict=True)}
    for name, (a, b) in zip(REACH, stations, strict=True):
        found[name] = np.hypot(x - a, y - b) + 2.0 * rng.normal(size=200)
    found["sight"] = np.arctan2(y - py, x - px) + np.radians(0.5) * rng.normal(size=200)
    return found


def read(folder: Path, columns: dict[str, Any], sensors: str, log: str = "") -> Any:
    text = TRACKER.replace("SENSORS", sensors) + log
    (folder / "tracker.toml").write_text(text)
    names = list(columns)
    rows = "\n".join(",".join(map(repr, map(float, row))) for row in zip(*columns.values()))  # noqa: B905
    (folder / "log.csv").write_text(",".join(names) + "\n" + rows + "\n")
    return load_logs(load_scenario(folder / "tracker.toml"), [folder / "log.csv"])


def without_truth(columns: dict[str, Any]) -> dict[str, Any]:
    return {name: values for name, values in columns.items() if not name.startswith("truth")}


ALL = '["fix", "reach", "sight"]'
WRONG = [
    ("degrees", ("sight",), 180.0 / math.pi, "deg", ALL),
    ("kilometres of one sensor", REACH, 1e-3, "km", ALL),
    ("kilometres, positions alone", FIX, 1e-3, "km", '["fix"]'),
    ("kilometres, ranges alone", REACH, 1e-3, "km", '["reach"]'),
    ("feet of one sensor", FIX, 1 / 0.3048, "ft", ALL),
    ("feet, ranges alone", REACH, 1 / 0.3048, "ft", '["reach"]'),
    ("milliseconds", ("time",), 1e3, "ms", ALL),
    ("milliseconds, positions alone", ("time",), 1e3, "ms", '["fix"]'),
]


@pytest.mark.parametrize("truth", [True, False])
@pytest.mark.parametrize(("what", "columns", "scale", "unit", "sensors"), WRONG)
def test_a_wrong_unit_is_found(
    tmp_path: Path, what: str, columns: tuple[str, ...], scale: float, unit: str, sensors: str,
    truth: bool,
) -> None:  # fmt: skip
    log = world()
    for name in columns:
        log[name] = log[name] * scale
    wanted = f"{columns[0]}.*{unit}"
    with pytest.raises(LogError, match=wanted):
        read(tmp_path, log if truth else without_truth(log), sensors)
    said = f'[log]\nformat = "{unit}"\n' if columns == ("time",) else (
        "[log.units]\n" + "".join(f'{name} = "{unit}"\n' for name in columns)
    )  # fmt: skip
    assert read(tmp_path, log if truth else without_truth(log), sensors, said).steps == 200


@pytest.mark.parametrize("truth", [True, False])
@pytest.mark.parametrize("seed", [1, 2])
def test_right_units_pass(tmp_path: Path, seed: int, truth: bool) -> None:
    log = world(seed) if truth else without_truth(world(seed))
    for sensors in (ALL, '["fix"]'):
        assert read(tmp_path, log, sensors).steps == 200


@pytest.mark.parametrize(("sigma", "acceleration"), [(0.05, 0.01), (300.0, 20.0)])
def test_poor_values_are_no_wrong_unit(tmp_path: Path, sigma: float, acceleration: float) -> None:
    read(tmp_path, without_truth(world()), ALL)
    scenario = load_scenario(
        tmp_path / "tracker.toml",
        {"parameters.fix.sigma.value": sigma, "parameters.reach.sigma.value": sigma,
         "parameters.motion.acceleration.value": acceleration},
    )  # fmt: skip
    for sensors in (["fix"], ["reach"]):
        changed = scenario.with_overrides({"systems.ekf.sensors": sensors})
        assert load_logs(changed, [tmp_path / "log.csv"]).steps == 200


def test_said_units_are_not_doubted(tmp_path: Path) -> None:
    log = without_truth(world())
    for name in FIX:
        log[name] = log[name] / 1000.0
    units = "".join(f'{name} = "m"\n' for name in FIX)
    assert read(tmp_path, log, '["fix"]', f"[log.units]\n{units}").z[0, 0, 0] < 1.0


def test_one_of_several_logs_is_named(tmp_path: Path) -> None:
    read(tmp_path, world(), ALL)
    scenario = load_scenario(tmp_path / "tracker.toml")
    right = (tmp_path / "log.csv").rename(tmp_path / "right.csv")
    log = world()
    for name in REACH:
        log[name] = log[name] / 1000.0
    read_wrong = pytest.raises(LogError, match=r"column reach_1, reach_2, .* in km alone")
    with read_wrong:
        read(tmp_path, log, ALL)
    with pytest.raises(LogError, match=r"^log: column reach_1"):
        load_logs(scenario, [right, tmp_path / "log.csv", right])


def test_commands_stop_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = world()
    for name in FIX:
        log[name] = log[name] / 0.3048
    with pytest.raises(LogError):
        read(tmp_path, log, ALL)
    toml, path, out = (str(tmp_path / n) for n in ("tracker.toml", "log.csv", "out.csv"))
    assert main(["run", toml, path, "--out", out]) == 2
    assert main(["import", toml, path, "--out", out]) == 2
    lines = capsys.readouterr().err.strip().split("\n")
    assert len(lines) == 2
    assert all('[log] units = { fix_1 = "ft" }' in line for line in lines)
    assert not Path(out).exists()
    assert main(["inspect", path, toml]) == 0  # tells it, and the rest
    assert "fix_1" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["airport-mlat", "uwb-simulated", "airborne-bearing"])
def test_simulated_logs_pass(name: str) -> None:
    scenario = load_scenario(name)
    check_units(scenario, simulate(scenario, 4, seed=5))
