"""Noise laws on a column of the log or the distance."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

import difffilter as df
from difffilter.errors import InputError, LogError

COEFFICIENTS = {"times": None, "root": 0.7, "linear": 0.4, "exponential": 3.0}
FORMULAS = {
    "times": lambda c: 0.2 * c,
    "root": lambda c: math.sqrt(0.2**2 + (0.7 * c) ** 2),
    "linear": lambda c: 0.2 + 0.4 * c,
    "exponential": lambda c: 0.2 * math.exp(-c / 3.0),
}


def recipe(law: str, column: str = "accuracy") -> df.Filter:
    fix = df.Varying(df.Position(name="fix", sigma=0.2), law, column, COEFFICIENTS[law])
    return df.Filter(df.ConstantVelocity(2), (fix,), start_sigma=3.0)


@pytest.mark.parametrize("law", FORMULAS)
def test_sigma_follows_the_column(law: str) -> None:
    filter = recipe(law)
    c = torch.tensor([0.5, 2.0, 7.0], dtype=torch.float64)
    state = torch.zeros(3, 4).double()
    noise = filter.sensors[0].noise(state, {"accuracy": c}, filter.prepare())
    expected = torch.tensor([FORMULAS[law](float(x)) ** 2 for x in c], dtype=torch.float64)
    assert torch.allclose(noise.total, expected[:, None].expand(3, 2), rtol=1e-12)
    assert torch.equal(noise.independent, noise.total)


@pytest.mark.parametrize("law", FORMULAS)
def test_missing_column_is_a_missing_measurement_and_engine_equals_torch(law: str) -> None:
    filter = recipe(law)
    draw = torch.Generator().manual_seed(1)
    z = torch.randn(20, 2, generator=draw).double()
    column = 0.1 + torch.rand(20, generator=draw).double()
    column[9] = torch.nan
    time = torch.arange(20).double()
    start = df.Start(torch.zeros(4).double())
    log = df.Log(filter.channels, time, z, inputs={"accuracy": column})
    plain = df.run(filter, log, start=start, engine="torch")
    assert plain.record.present[9].tolist() == [False, False]
    fused = df.run(filter, log, start=start, engine="fused")
    assert torch.allclose(plain.mean, fused.mean, atol=1e-12)
    z[9] = torch.nan
    column[9] = 1.0
    same = df.Log(filter.channels, time, z, inputs={"accuracy": column})
    assert torch.equal(df.run(filter, same, start=start, engine="torch").mean, plain.mean)


def test_distance_and_one_column_per_channel() -> None:
    stations = [(0.0, 0.0), (30.0, 40.0)]
    grows = df.Varying(df.Range(stations=stations, sigma=0.1), "linear", coefficient=0.01)
    filter = df.Filter(df.ConstantVelocity(2), (grows,), start_sigma=1.0)
    state = torch.tensor([30.0, 40.0, 0.0, 0.0], dtype=torch.float64)
    noise = filter.sensors[0].noise(state, {}, filter.prepare())
    assert torch.allclose(noise.total.sqrt(), torch.tensor([0.6, 0.1], dtype=torch.float64))
    each = df.Varying(df.Range(stations=stations), "times", ("a", "b"))
    filter = df.Filter(df.ConstantVelocity(2), (each,), start_sigma=1.0)
    assert filter.inputs == ("a", "b")
    row = {"a": torch.tensor(2.0, dtype=torch.float64), "b": torch.tensor(3.0, dtype=torch.float64)}
    assert filter.sensors[0].noise(state, row, filter.prepare()).total.tolist() == [4.0, 9.0]


def test_covariance_scales_as_a_whole() -> None:
    fix = df.Varying(df.Position(name="fix", sigma=((4.0, 1.0), (1.0, 9.0))), "times", "hdop")
    filter = df.Filter(df.ConstantVelocity(2), (fix,), start_sigma=1.0)
    noise = filter.sensors[0].noise(
        torch.zeros(4).double(), {"hdop": torch.tensor(2.0, dtype=torch.float64)}, filter.prepare()
    )
    expected = torch.tensor([[16.0, 4.0], [4.0, 36.0]], dtype=torch.float64)
    assert torch.allclose(noise.common @ noise.common.T, expected)


def test_impossible_columns_are_refused() -> None:
    filter, time = recipe("times"), torch.arange(3).double()
    start, z = df.Start(torch.zeros(4).double()), torch.zeros(3, 2).double()
    with pytest.raises(InputError, match="found no input accuracy, expected the column of fix"):
        df.run(filter, df.Log(filter.channels, time, z), start=start)
    column = torch.tensor([1.0, -2.0, 1.0], dtype=torch.float64)
    log = df.Log(filter.channels, time, z, inputs={"accuracy": column})
    with pytest.raises(LogError, match="input accuracy, row 2: found -2, expected a number above"):
        df.run(filter, log, start=start)


@pytest.mark.parametrize(
    ("law", "column", "coefficient", "message"),
    [
        ("quadratic", "c", 1.0, "found law 'quadratic', expected one of times, root"),
        ("root", "c", None, "expected a coefficient, fix.slope"),
        ("times", "c", 1.0, "coefficient with law 'times': expected none"),
        ("linear", (), 1.0, "found no column, expected one: distances are those of sensors"),
        ("times", ("a", "b", "c"), None, "found 3 columns, expected one, or one for each of 2"),
    ],
)
def test_laws_that_do_not_fit(
    law: str, column: str | tuple[str, ...], coefficient: float | None, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        df.Varying(df.Position(name="fix"), law, column, coefficient)


def test_a_model_reads_the_column_from_files(tmp_path: Path) -> None:
    filter = recipe("times")
    begin = df.Start(torch.zeros(4).double(), torch.eye(4).double(), 0.0)
    model = df.Model(filter, "fixes", start=begin)
    assert model.inputs == ("accuracy",)
    path = tmp_path / "drive.csv"
    path.write_text(
        "time,fix_1,fix_2,accuracy,truth_x,truth_y\n"
        "1,0.1,0.2,3,0,0\n2,0.3,0.1,1,0,0\n3,0.2,0.2,2,0,0\n"
    )
    found = df.compare(model, log=[path]).rows[0].rmse
    log = df.read_log(path, filter.channels, ["accuracy"])
    track = df.run(filter, log, start=begin)
    assert found == pytest.approx(float(track.mean[:, :2].square().sum(-1).mean().sqrt()))
