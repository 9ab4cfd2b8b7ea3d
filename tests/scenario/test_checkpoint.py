"""Frozen filters: what is saved is what is loaded, atomically, with no pickle anywhere."""

from __future__ import annotations

import ast
import json
import math
from pathlib import Path

import pytest
import torch
from helpers import tensor

import difffilter
from difffilter.errors import InputError
from difffilter.files import write_atomically
from difffilter.filters.recipe import Recipe
from difffilter.running.batch import run
from difffilter.scenario.checkpoint import Checkpoint, load, save
from difffilter.scenario.scenario import Scenario, load_scenario
from difffilter.scenario.simulation import simulate

VALUES = {
    "tdoa.sigma": tensor(0.1 + 0.2),
    "tanh.ab": tensor([1.1234567890123457, math.pi]),
    "motion.acceleration": tensor([1e-3, 7.7]),
}


def small(**overrides: object) -> Scenario:
    keys = {key.replace("__", "."): value for key, value in overrides.items()}
    return load_scenario("airport-mlat-intermittent", {"world.steps": 15} | keys)


def frozen(
    scenario: Scenario, system: str = "m-ekf", temperature: float | None = None
) -> Checkpoint:
    filter = scenario.system(system)
    assert isinstance(filter, Recipe)
    known = {name: value for name, value in VALUES.items() if name in filter.declarations}
    values = filter.published() | known
    return Checkpoint(scenario, system, values, temperature, {"seed": 3}, {"rows": [1, 2.5, None]})


FILTERS = ["ekf", "adaptive-ekf", "huber", "m-ekf", "m-ekf-all-rows", "m-ekf-mad", "clairvoyant"]


@pytest.mark.parametrize("system", FILTERS)
def test_a_loaded_filter_gives_the_output_of_the_saved_one(tmp_path: Path, system: str) -> None:
    before = frozen(small(), system)
    save(before, tmp_path / "x.json")
    after = load(tmp_path / "x.json")
    log = simulate(after.scenario, 3, seed=2)
    expected = run(before.published_filter, log, before.values)
    by_values = run(after.published_filter, log, after.values)
    declared = run(after.filter, log)
    assert expected.record is not None
    for track in (by_values, declared):
        assert track.record is not None
        assert torch.equal(track.mean, expected.mean)
        assert torch.equal(track.deviations, expected.deviations)
        assert torch.equal(track.record.weight, expected.record.weight)


def test_everything_else_comes_back_too(tmp_path: Path) -> None:
    before = frozen(small(), temperature=0.05)
    save(before, tmp_path / "x.json")
    after = load(tmp_path / "x.json")
    assert (after.system, after.temperature) == ("m-ekf", 0.05)
    assert after.training == {"seed": 3}
    assert after.result == {"rows": [1, 2.5, None]}
    assert after.scenario.document == before.scenario.document
    assert after.scenario.name == before.scenario.name
    assert {n: v.tolist() for n, v in after.values.items()} == {
        n: v.tolist() for n, v in before.values.items()
    }


def test_saving_what_was_loaded_writes_the_same_file(tmp_path: Path) -> None:
    save(frozen(small()), tmp_path / "x.json")
    save(load(tmp_path / "x.json"), tmp_path / "y.json")
    assert (tmp_path / "x.json").read_bytes() == (tmp_path / "y.json").read_bytes()


def test_matrices_and_vectors_are_frozen_too(tmp_path: Path) -> None:
    covariance = [[9.0 * (i == j) + 1.0 for j in range(7)] for i in range(7)]
    scenario = small(
        parameters__tdoa__sigma={"value": covariance},
        parameters__tdoa__bias__value=[0.5 * i for i in range(7)],
    )
    filter = scenario.system("m-ekf")
    assert isinstance(filter, Recipe)
    values = filter.published() | {"tdoa.sigma": tensor(covariance) * 1.5}  # type: ignore[arg-type]
    save(Checkpoint(scenario, "m-ekf", values), tmp_path / "x.json")
    after = load(tmp_path / "x.json")
    assert torch.equal(after.values["tdoa.sigma"], values["tdoa.sigma"])
    assert after.values["tdoa.bias"].tolist() == [0.5 * i for i in range(7)]
    assert after.published_filter.declarations["tdoa.sigma"].tensor()[0, 0] == 10.0


def test_the_file_stands_alone_without_the_scenario_file(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('schema = 1\nextends = "airport-mlat"\nname = "mine"\ntitle = "t"\n')
    scenario = load_scenario(path)
    save(frozen(scenario, "ekf"), tmp_path / "x.json")
    path.unlink()
    assert load(tmp_path / "x.json").scenario.name == "mine"


def test_the_file_is_strict_json_with_published_values_and_versions(tmp_path: Path) -> None:
    save(frozen(small()), tmp_path / "x.json")
    text = (tmp_path / "x.json").read_text()
    data = json.loads(text, parse_constant=lambda name: pytest.fail(f"found {name}"))
    assert text.endswith("}\n")
    assert (data["format"], data["version"]) == ("difffilter-checkpoint", 1)
    assert data["parameters"]["tanh.ab"]["published"] == [1.5, 4.0]
    assert data["parameters"]["tanh.ab"]["value"] == VALUES["tanh.ab"].tolist()
    assert data["parameters"]["tdoa.sigma"]["unit"] == "m"
    assert data["recipe"]["weight"] == "tanh"
    assert data["versions"]["difffilter"] == difffilter_version()
    assert data["versions"]["torch"] == torch.__version__


def difffilter_version() -> str:
    from importlib.metadata import version

    return version("difffilter")


BAD = {
    "outside its constraint": ("tdoa.sigma", tensor(-1.0), "tdoa.sigma: found -1"),
    "not ordered": ("tanh.ab", tensor([4.0, 1.0]), "0 < a < b"),
    "not finite": ("tdoa.bias", tensor(torch.nan), "tdoa.bias"),
    "of another shape": ("tdoa.sigma", tensor([1.0, 2.0]), r"found shape \[2\]"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_value_that_is_not_admissible_is_never_written(tmp_path: Path, name: str) -> None:
    parameter, value, message = BAD[name]
    good = frozen(small())
    spoiled = Checkpoint(good.scenario, good.system, dict(good.values) | {parameter: value})
    with pytest.raises(InputError, match=message):
        save(spoiled, tmp_path / "x.json")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("what", [{"x": object()}, {"x": {1, 2}}])
def test_what_json_cannot_hold_leaves_the_old_file_whole(
    tmp_path: Path, what: dict[str, object]
) -> None:
    path = tmp_path / "x.json"
    save(frozen(small()), path)
    before = path.read_bytes()
    good = frozen(small())
    with pytest.raises((TypeError, ValueError)):
        save(Checkpoint(good.scenario, good.system, good.values, None, what), path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_result_that_is_not_finite_is_stored_as_null(tmp_path: Path) -> None:
    good = frozen(small())
    what = {"loss": math.nan, "rows": [1.0, math.inf]}
    save(Checkpoint(good.scenario, good.system, good.values, None, what), tmp_path / "x.json")
    assert load(tmp_path / "x.json").training == {"loss": None, "rows": [1.0, None]}


def test_a_write_that_fails_halfway_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    path.write_text("old")

    def fail(file: object) -> None:
        file.write(b"half of it")  # type: ignore[attr-defined]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_atomically(path, fail)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_place_that_cannot_be_written_is_an_input_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"x\.json: cannot be written"):
        save(frozen(small()), tmp_path / "file" / "x.json")
    (tmp_path / "folder.json").mkdir()
    with pytest.raises(InputError, match=r"folder\.json: cannot be written"):
        save(frozen(small()), tmp_path / "folder.json")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder.json"]


def test_a_new_folder_is_made_and_permissions_are_the_usual_ones(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b" / "x.json"
    save(frozen(small()), path)
    plain = tmp_path / "plain"
    plain.write_text("")
    assert path.stat().st_mode == plain.stat().st_mode


def test_a_baseline_has_no_checkpoint() -> None:
    with pytest.raises(InputError, match="chan-ls: is a baseline, expected a filter"):
        _ = Checkpoint(small(), "chan-ls", {}).published_filter


def calls(tree: ast.AST, name: str) -> list[ast.Call]:
    """Calls of ``name`` or ``anything.name``."""
    return [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        and (getattr(node.func, "attr", None) == name or getattr(node.func, "id", None) == name)
    ]


def test_nothing_in_the_library_unpickles() -> None:
    package = Path(difffilter.__file__).parent
    loads = 0
    for path in package.rglob("*.py"):
        tree = ast.parse(path.read_text())
        for call in calls(tree, "load"):
            if ast.unparse(call.func) == "torch.load":
                loads += 1
                given = {keyword.arg: ast.unparse(keyword.value) for keyword in call.keywords}
                assert given.get("weights_only") == "True", path
            if ast.unparse(call.func) == "np.load":
                given = {keyword.arg: ast.unparse(keyword.value) for keyword in call.keywords}
                assert given.get("allow_pickle") == "False", path
            assert not ast.unparse(call.func).startswith(("pickle", "numpy")), path
        assert not calls(tree, "Unpickler"), path
        assert not [c for c in calls(tree, "loads") if "pickle" in ast.unparse(c.func)], path
        assert not calls(tree, "eval"), path
        assert not calls(tree, "exec"), path
    assert loads == 1
