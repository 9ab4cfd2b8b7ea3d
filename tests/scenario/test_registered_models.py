"""A sensor and a motion of the user's own, by name in scenario files."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from typing import Any, Literal

import pytest
import torch
from torch import Tensor

import difffilter as df
from difffilter.errors import InputError
from difffilter.motions.registry import MOTIONS, motion
from difffilter.parameters.values import Constants
from difffilter.scenario.keys import read_keys
from difffilter.scenario.table import Table
from difffilter.sensors.registry import SENSORS, sensor

SEEN: list[dict[str, Any]] = []


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    """A range to a beacon with a scale, and a constant velocity that loses some at each step."""

    @sensor("beacon")
    def beacon(
        *,
        name: str,
        axes: int,
        sigma: float = 1.0,
        at: tuple[float, ...] = (),
        how: Literal["straight", "squared"] = "straight",
        scale: float = 1.0,
    ) -> df.FunctionSensor:
        SEEN.append({"axes": axes, "sigma": sigma, "at": at, "how": how, "scale": scale})
        own = df.Parameter(f"{name}.scale", scale, df.Positive())

        def read(state: Tensor, inputs: object, constants: Constants) -> Tensor:
            apart = state[..., :axes] - torch.tensor(at, dtype=state.dtype)
            return constants[f"{name}.scale"] * apart.square().sum(-1, keepdim=True).sqrt()

        return df.FunctionSensor((name,), read, sigma=sigma, extra=(own,), name=name)

    @motion("lossy")
    class Lossy(df.ConstantVelocity):
        def __init__(self, *, axes: int, acceleration: float, keep: float = 1.0) -> None:
            super().__init__(axes, "discrete", acceleration)
            object.__setattr__(self, "keep", keep)

    yield
    SENSORS.remove("beacon")
    MOTIONS.remove("lossy")


OWN: dict[str, Any] = {
    "world.steps": 20,
    "sensors.b": {"kind": "beacon", "at": [0.0, 9.0], "noise": {"sigma": 2.5}},
    "parameters.b.scale.value": 1.5,
    "motion": {"model": "lossy", "keep": 0.5},
}


def test_a_registered_model_is_made_of_keys_and_published_values() -> None:
    SEEN.clear()
    scenario = df.load_scenario("gate-lockout", deepcopy(OWN))
    filter = scenario.system()
    last = SEEN[-1]
    assert last == {"axes": 2, "sigma": 2.5, "at": (0.0, 9.0), "how": "straight", "scale": 1.5}
    assert filter.channels[-1] == "b"
    assert float(filter.published()["b.scale"]) == 1.5
    assert isinstance(filter, df.Filter)
    assert vars(filter.motion)["keep"] == 0.5
    log = df.simulate(scenario, trajectories=2)
    assert bool(torch.isfinite(df.run(filter, df.started(scenario, filter, log)).mean).all())


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("sensors.b.how", "round", "sensors.b.how: found 'round', expected one of straight, squ"),
        ("sensors.b.att", [1.0], "sensors.b.att: unknown key, did you mean 'at'"),
        ("sensors.b.at", "x", "sensors.b.at: found 'x', expected a list of"),
        ("sensors.b.kind", "beakon", "expected one of tdoa, range, bearing, position, beacon"),
        ("motion.keep", True, "motion.keep: found True, expected a number"),
        ("systems.ls", {"estimator": "taylor-ls"}, "a sensor of more than the position"),
    ],
)
def test_its_keys_are_checked_like_all(key: str, value: object, expected: str) -> None:
    with pytest.raises(InputError) as caught:
        df.load_scenario("gate-lockout", deepcopy(OWN) | {key: value})
    assert expected in str(caught.value)


def test_types_say_how_a_key_is_read() -> None:
    def factory(
        a: float,
        b: int,
        c: bool,
        d: str,
        e: tuple[str, ...],
        f: Sequence[Sequence[float]],
        g: float | None = None,
    ) -> None: ...

    found = {"a": 1, "b": 2, "c": True, "d": "t", "e": ["n"], "f": [[1, 2]], "g": 3}
    read = read_keys(Table(found, "file"), factory, ())
    assert read == {**found, "e": ("n",), "f": ((1.0, 2.0),)}

    def odd(h: Callable[[], None]) -> None: ...

    with pytest.raises(InputError, match="h: found 1, expected no such key"):
        read_keys(Table({"h": 1}, "file"), odd, ())


def test_a_name_is_taken_once() -> None:
    with pytest.raises(InputError, match="sensor tdoa: registered already"):
        sensor("tdoa")(df.Range)
