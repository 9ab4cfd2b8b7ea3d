"""Models made in Python go the road of scenarios: tuned, saved, loaded, compared."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from cli_helpers import environment, process
from torch import Tensor

import difffilter as df
from difffilter.errors import CheckpointError, InputError
from difffilter.parameters.constraints import Positive
from difffilter.scenario.own import made

SMALL = {"trajectories": 8, "validation": 6, "test": 6, "batch": 8, "steps": 4,
         "evaluate_every": 2, "optimiser": "adam", "learning_rate": 0.3}  # fmt: skip
#: A tank: level and inflow, seen by a pressure gauge. No scenario can say it.
TANK = '''
"""A tank: level and inflow, a pressure gauge."""

import torch
from difffilter import Filter, FunctionMotion, FunctionSensor, Log, Parameter, Start
from difffilter.parameters.constraints import Positive

DRIFT = Parameter("tank.drift", 1.0, Positive(), "m/s^1.5", meaning="of the inflow", noise=True)


def fill(s, dt, inputs, v):
    return torch.stack([s[..., 0] + dt * s[..., 1], s[..., 1]], -1)


def noise(dt, v):
    q = v["tank.drift"] * dt.sqrt()
    return torch.stack([torch.zeros_like(q), q], -1).unsqueeze(-1)


def make(channel="level"):
    gauge = FunctionSensor((channel,), lambda s, i, v: s[..., :1], 4.0, name="gauge")
    return Filter(FunctionMotion(("x", "inflow"), fill, noise, (DRIFT,)), (gauge,), start_sigma=2.0)


def simulate(seed, count, steps=30):
    draw = torch.randn(3, steps, count, 1, generator=torch.Generator().manual_seed(seed)).double()
    inflow = 1.0 + 0.1 * draw[0].cumsum(0)
    level = inflow.cumsum(0) + 5.0
    time = torch.arange(1, steps + 1).double()
    start = Start(torch.tensor([5.0, 1.0], dtype=torch.float64).expand(count, 2), None, 0.0)
    return Log(("level",), time, level + draw[1], level, ("x",), start=start)
'''


@pytest.fixture
def tank(tmp_path: Path) -> Path:
    path = tmp_path / "tank.py"
    path.write_text(TANK)
    return path


@pytest.fixture
def model(tank: Path) -> df.Model:
    module = df.load_models(tank)
    return df.Model(module.make(), "tank", simulate=module.simulate, factory="tank:make")


def same(a: df.Checkpoint, b: df.Checkpoint) -> bool:
    return all(torch.equal(a.values[name], b.values[name]) for name in a.values)


def test_a_model_is_tuned_saved_loaded_and_compared(model: df.Model, tmp_path: Path) -> None:
    out = tmp_path / "tank.json"
    result = df.tune(model, tuned=["tank.*", "gauge.sigma"], settings=SMALL, out=out)
    assert result.held_out is not None
    assert result.held_out.row("tank", "tuned").ratio < 0.99
    moved = {n for n, v in result.checkpoint.values.items() if v.tolist() != published(model, n)}
    assert moved == {"tank.drift", "gauge.sigma"}
    loaded = df.load(out, recipe=model.recipe)
    assert same(loaded, result.checkpoint)
    assert loaded.as_dict()["parameters"] == result.checkpoint.as_dict()["parameters"]
    again = df.compare(model, {"published": None, "tuned": loaded}, 6, 0)
    assert again.row("tank", "tuned").rmse == result.held_out.row("tank", "tuned").rmse
    assert json.loads(out.read_text())["document"]["model"]["factory"] == "tank:make"


def published(model: df.Model, name: str) -> object:
    return model.recipe.published()[name].tolist()


def test_a_function_logs_and_files_train_alike(model: df.Model, tmp_path: Path) -> None:
    assert model.simulate is not None
    bare = model.recipe
    settings = {**SMALL, "window": 10}
    drawn = df.tune(bare, model.simulate, tuned=["gauge.sigma"], settings=settings)
    named = df.tune(model, tuned=["gauge.sigma"], settings=settings)
    assert {n: v.tolist() for n, v in drawn.checkpoint.values.items()} == {
        n: v.tolist() for n, v in named.checkpoint.values.items()
    }
    paths, logs = [], []
    for seed in (1, 2):
        batch = model.simulate(seed, 1)
        assert batch.truth is not None
        single = replace(batch, z=batch.z[:, 0], truth=batch.truth[:, 0], start=None)
        paths.append(tmp_path / f"run{seed}.csv")
        df.write_log(paths[-1], single)
        logs.append(single)
    start = df.Start(torch.tensor([5.0, 1.0], dtype=torch.float64))
    own = replace(model, simulate=None, start=start)
    histories = [
        repr(df.tune(own, train, tuned=["gauge.sigma"], settings=settings).history)
        for train in (paths, logs)
    ]
    assert histories[0] == histories[1]


def test_what_is_held_back_is_said_and_is_not_trained_on(model: df.Model) -> None:
    """Other measurements in the last fifth leave the steps as they are, and judge them anew."""
    assert model.simulate is not None
    log = replace(
        model.simulate(3, 2), start=df.Start(torch.tensor([[5.0, 1.0]] * 2, dtype=torch.float64))
    )
    settings = {**SMALL, "window": 8, "patience": 9}
    result = df.tune(model, log, tuned=["gauge.sigma"], settings=settings)
    told = result.checkpoint.training["validation"]
    assert told == "held back: the last 6 of 30 rows, from 25 s"
    z = log.z.clone()
    z[24:] += 3.0
    other = df.tune(model, replace(log, z=z), tuned=["gauge.sigma"], settings=settings)
    assert [e.values for e in other.history] == [e.values for e in result.history]
    assert [e.validation for e in other.history] != [e.validation for e in result.history]
    six = model.simulate(3, 6)
    many = df.tune(model, six, tuned=["gauge.sigma"], settings=settings).checkpoint.training
    assert many["validation"].startswith("held back: ")
    given = df.tune(model, log, validation=log, tuned=["gauge.sigma"], settings=settings)
    assert "validation" not in given.checkpoint.training


REFUSED: dict[str, tuple[dict[str, object], str]] = {
    "nothing": ({}, r"no parameter of tank has tuned = true, expected .*tuned=\[\.\.\.\]\) among"),
    "no name": ({"tuned": []}, "tuned: found no name"),
    "unknown": ({"tuned": ["gauge.*", "radar.*"]}, r"tuned: found 'radar\.\*', expected names"),
    "setting": ({"tuned": ["gauge.sigma"], "settings": {"step": 1}}, "tuning.step: unknown key"),
    "loss": ({"tuned": ["gauge.sigma"], "loss": {"wild": 1.0}}, "expected a loss among position"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_tuned_is_an_input_error(model: df.Model, name: str) -> None:
    options, message = REFUSED[name]
    with pytest.raises(InputError, match=message):
        df.tune(model, **options)  # type: ignore[arg-type]


def test_a_checkpoint_of_another_recipe_is_one_clear_line(
    model: df.Model, tank: Path, tmp_path: Path
) -> None:
    out = tmp_path / "tank.json"
    df.tune(model, tuned=["gauge.sigma"], settings=SMALL | {"steps": 0}, out=out)
    module = df.load_models(tank)
    with pytest.raises(CheckpointError, match=r"tank\.json: channels: found \['level'\], expected"):
        df.load(out, recipe=module.make("depth"))
    wider = df.Parameter("tank.leak", 0.1, Positive())
    motion = replace(model.recipe.motion, parameters=(*model.recipe.motion.parameters, wider))  # type: ignore[type-var, attr-defined]
    with pytest.raises(CheckpointError, match=r"tank\.json: digest: found values of another"):
        df.load(out, recipe=replace(model.recipe, motion=motion))
    with pytest.raises(CheckpointError, match="holds a scenario of its own, expected no recipe"):
        df.load(_scenarios_own(tmp_path), recipe=model.recipe)


def _scenarios_own(tmp_path: Path) -> Path:
    scenario = df.load_scenario("gate-lockout", {"world.steps": 10})
    filter = scenario.system("gated")
    values: dict[str, Tensor] = filter.published()
    path = tmp_path / "scenario.json"
    df.save(df.Checkpoint(scenario, "gated", values), path)
    return path


def test_loading_imports_nothing_by_itself(tank: Path, tmp_path: Path) -> None:
    out = tmp_path / "tank.json"
    script = f"""
import sys
import difffilter as df
sys.path.insert(0, {str(tank.parent)!r})
try:
    df.load({str(out)!r})
except df.CheckpointError as error:
    print(error, "tank" in sys.modules)
"""
    module = df.load_models(tank)
    model = df.Model(module.make(), "tank", simulate=module.simulate, factory="tank:make")
    df.tune(model, tuned=["gauge.sigma"], settings=SMALL | {"steps": 0}, out=out)
    words = [sys.executable, "-c", script]
    done = subprocess.run(words, capture_output=True, text=True, env=environment(), check=True)
    assert re.search(r"tank:make, a model.*--models tank\.py, or load\(\.\.\., recipe", done.stdout)
    assert done.stdout.endswith("False\n")


def test_the_command_line_takes_models_of_ones_own(tank: Path, tmp_path: Path) -> None:
    """Tune from a file, run, compare; as from Python to the last digit."""
    module = df.load_models(tank)
    batch = module.simulate(4, 1, 60)
    single = replace(batch, z=batch.z[:, 0], truth=batch.truth[:, 0], start=None)
    df.write_log(tmp_path / "log.csv", single)
    with tank.open("a") as file:
        file.write(
            "\n\ndef plant():\n"
            "    from difffilter import Model\n"
            "    at = Start(torch.tensor([5.0, 1.0], dtype=torch.float64))\n"
            "    return Model(make(), 'plant', start=at)\n"
        )
    sets = [f"--set=tuning.{k}={v}" for k, v in (SMALL | {"window": 12}).items()]
    words = ["tune", "tank:plant", "--models", "tank.py", "--log", "log.csv", "--tuned",
             "gauge.sigma", "--test-log", "log.csv", *sets, "--out", "plant.json"]  # fmt: skip
    done = process(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "validated on what was held back: the last 12 of 60 rows, from 49 s" in done.stdout
    assert "warning: ended at its cap of 4 steps" in done.stdout
    plant = df.load_models(tank).plant()
    other = df.tune(
        replace(plant, factory="tank:plant"),
        single,
        tuned=["gauge.sigma"],
        settings=SMALL | {"window": 12},
    )
    assert same(df.load(tmp_path / "plant.json"), other.checkpoint)
    told = process("run", "plant.json", "log.csv", "--out", "o.csv", cwd=tmp_path)
    assert told.returncode == 2
    assert told.stderr.count("\n") == 1
    assert "--models tank.py" in told.stderr
    more = ["--models", "tank.py"]
    done = process("run", "plant.json", "log.csv", "--out", "o.csv", *more, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    done = process("compare", "tank:plant", "--log", "log.csv", "--values", "published",
                   "--values", "plant.json", *more, cwd=tmp_path)  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "| plant | plant.json |" in done.stdout
    done = process("export", "plant.json", "--to", "c", "--out", "c", *more, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "c" / "plant.c").is_file()


def test_a_factory_that_fails_is_one_line_with_its_place(tmp_path: Path) -> None:
    """The user's own mistake, named with the line of the user's own file."""
    path = tmp_path / "broken.py"
    path.write_text("def make():\n    return [][3]\n")
    df.load_models(path)
    with pytest.raises(InputError) as caught:
        made("broken:make")
    said = f"broken:make: IndexError: list index out of range (line 2 of {path})"
    assert str(caught.value) == said
    path.write_text("x = 1\ny = 1 / 0\n")
    with pytest.raises(InputError, match=r"ZeroDivisionError: division by zero \(line 2 of"):
        df.load_models(path)
