"""Values and constants are two things: mixing them up is one clear line, and a type error."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from helpers import STATIONS, tensor

import difffilter as df
from difffilter.core.beliefs import Measurement
from difffilter.errors import InputError
from difffilter.parameters.values import Constants

FILTER = df.Filter(df.ConstantVelocity(), (df.TDOA(stations=STATIONS),))
PLACE = tensor([500.0, 700.0])


def test_a_sensor_that_is_given_values_says_what_it_wants() -> None:
    (sensor,) = FILTER.sensors
    with pytest.raises(InputError, match=r"constants: found a dict, expected what prepare"):
        sensor.measure(PLACE, {}, {})  # type: ignore[arg-type, attr-defined]
    with pytest.raises(InputError, match=r"constants: found a dict"):
        sensor.noise(PLACE, {}, FILTER.published())  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"found no tdoa.stations, .* \(found none\)"):
        sensor.measure(PLACE, {}, Constants())  # type: ignore[attr-defined]
    state = FILTER.start(torch.zeros(4).double(), torch.eye(4).double())
    row = Measurement(torch.zeros(6).double(), tensor(1.0))
    with pytest.raises(InputError, match=r"constants: found a dict"):
        df.step(FILTER, FILTER.published(), state, row)  # type: ignore[arg-type]


def test_a_filter_that_is_given_constants_says_what_it_wants() -> None:
    with pytest.raises(InputError, match="values: found the constants of a run"):
        FILTER.prepare(FILTER.prepare())  # type: ignore[arg-type]


def test_constants_pass_through_torch_transforms_by_name() -> None:
    constants = FILTER.prepare()
    doubled = torch.func.vmap(lambda c: c | {"twice": 2 * c["tdoa.sigma"]})(
        Constants({"tdoa.sigma": tensor([1.0, 2.0])})
    )
    assert doubled["twice"].tolist() == [2.0, 4.0]
    assert dict(constants | {"a": PLACE}).keys() == {*constants, "a"}
    assert constants.get("temperature") is None


def test_a_type_checker_tells_them_apart(tmp_path: Path) -> None:
    script = tmp_path / "mixed.py"
    script.write_text(
        "import difffilter as df\n"
        "f = df.Filter(df.ConstantVelocity(), (df.Position(),))\n"
        "constants = f.prepare(f.published())\n"
        "f.prepare(constants)\n"
        "f.motion.prepare(constants)\n"
        "f.sensors[0].noise(constants['motion.factor'], {}, f.published())\n"
    )
    root = Path(__file__).parents[2]
    command = [sys.executable, "-m", "mypy", "--strict", "--config-file=", str(script)]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
    found = re.findall(r"mixed.py:(\d+): error: .*incompatible type", done.stdout)
    assert found == ["4", "5", "6"], done.stdout
