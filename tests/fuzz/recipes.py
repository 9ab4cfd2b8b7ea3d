"""Random recipes as plain data, so that a failing one can be written down and made again."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import Any

import torch

from difffilter import (
    TDOA,
    WEIGHTS,
    Bearing,
    Chain,
    ConstantVelocity,
    CoordinatedTurn,
    Filter,
    FunctionMotion,
    FunctionSensor,
    Gate,
    InnovationMatching,
    InputError,
    Mixture,
    MultipleFading,
    Parameter,
    Position,
    PredictionCorrection,
    Range,
    Recovery,
    StrongTracking,
    wrap,
)
from difffilter.adaptation.scaling import InnovationScaling

Spec = dict[str, Any]

STATIONS = ((0.0, 0.0), (400.0, 30.0), (-20.0, 380.0), (350.0, 420.0))
MOTIONS = ("discrete", "continuous", "state", "turn", "own")
SENSORS = ("position", "range", "tdoa", "bearing", "own", "two")
GATES = ("none", "none", "reject", "reweigh", "inflate")
RECOVERIES = ("none", "none", "widen", "inflate")
ADAPTATIONS = (
    "none", "none", "matching", "correction", "matching+correction", "strong", "fading", "scaling",
)  # fmt: skip
SCOPES = ("channel", "sensor", "all", "named")

#: The recipe that a violation is shrunk to.
PLAIN: Spec = {
    "motion": "discrete", "sensors": "position", "weight": "plain", "iterations": 0,
    "weigh_prior": False, "mad": False, "scope": "channel", "distance": "rms",
    "standardise": None, "gate": "none", "recovery": "none", "adaptation": "none",
    "federated": False, "linearise": "taylor", "common": False, "fusion": False, "modes": False,
}  # fmt: skip


def options(spec: Spec) -> list[str]:
    """What a recipe has in it, by name: of a fusion only what it takes."""
    taken = ("motion", "linearise", "fusion") if spec["fusion"] else PLAIN
    return [f"{key} {value}" for key, value in spec.items() if key in taken and key != "noise"]


def draw(rng: random.Random) -> Spec:
    """A recipe; not all of them fit together."""
    return {
        "motion": rng.choice(MOTIONS),
        "sensors": rng.choice(SENSORS),
        "weight": rng.choice(tuple(WEIGHTS)),
        "iterations": rng.choice((0, 0, 0, 1, 3)),
        "weigh_prior": rng.random() < 0.2,
        "mad": rng.random() < 0.15,
        "scope": rng.choice(SCOPES),
        "distance": rng.choice(("rms", "mahalanobis")),
        "standardise": rng.choice((None, "innovation", "noise")),
        "gate": rng.choice(GATES),
        "recovery": rng.choice(RECOVERIES),
        "adaptation": rng.choice(ADAPTATIONS),
        "federated": rng.random() < 0.15,
        "linearise": rng.choice(("taylor", "taylor", "cubature")),
        "common": rng.random() < 0.2,
        "noise": 10.0 ** rng.uniform(-1.0, 1.0),
        "fusion": rng.random() < 0.1,
        "modes": rng.random() < 0.1,
    }


def _drag(state: torch.Tensor, dt: torch.Tensor, inputs: Any, values: Any) -> torch.Tensor:
    position, velocity = state[..., :2], state[..., 2:]
    speed = (velocity**2).sum(-1, keepdim=True)
    slower = velocity / (1.0 + 1e-4 * dt.unsqueeze(-1) * speed)
    return torch.cat([position + dt.unsqueeze(-1) * slower, slower], dim=-1)


def _kick(dt: torch.Tensor, values: Any) -> torch.Tensor:
    zero, one = torch.zeros_like(dt), values["motion.kick"] * torch.sqrt(dt.abs())
    rows = [(zero, zero), (zero, zero), (one, zero), (zero, one)]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def _squares(state: torch.Tensor, inputs: Any, values: Any) -> torch.Tensor:
    x, y = state[..., 0], state[..., 1]
    return torch.stack([(x**2 + y**2 + 1.0).sqrt(), torch.atan2(y, x - 500.0)], dim=-1)


def _mixed(z: torch.Tensor, predicted: torch.Tensor) -> torch.Tensor:
    return torch.cat([(z - predicted)[..., :1], wrap(z, predicted)[..., 1:]], dim=-1)


def _motion(spec: Spec) -> Any:
    if spec["motion"] == "own":
        kick = Parameter("motion.kick", 1.0)
        return FunctionMotion(("x", "y", "vx", "vy"), _drag, _kick, (kick,))
    if spec["motion"] == "turn":
        return CoordinatedTurn(2, "discrete", 0.5, turn_rate=0.05)
    return ConstantVelocity(2, spec["motion"], 0.5)


def _sensors(spec: Spec) -> tuple[Any, ...]:
    sigma = spec["noise"]
    if spec["fusion"]:
        return tuple(Position(name=name, sigma=sigma * (1 + i)) for i, name in enumerate("abc"))
    kind = spec["sensors"]
    if kind == "position":
        return (Position(sigma=sigma),)
    if kind == "range":
        return (Range(stations=STATIONS, sigma=sigma),)
    if kind == "tdoa":
        common = 0.7 * sigma if spec["common"] else None
        return (TDOA(stations=STATIONS, sigma=sigma, common_sigma=common),)
    if kind == "bearing":
        return (Bearing(stations=STATIONS[:3], sigma=0.01 * sigma),)
    if kind == "own":
        return (FunctionSensor(("r", "b"), _squares, (sigma, 0.01 * sigma), unit="1",
                               residual_function=_mixed),)  # fmt: skip
    return (Position(sigma=sigma), Range(stations=STATIONS, sigma=sigma))


def _adaptation(spec: Spec) -> Any:
    weight = WEIGHTS[spec["weight"]]
    made = {
        "matching": InnovationMatching(),
        "correction": PredictionCorrection(2),
        "matching+correction": Chain((InnovationMatching(), PredictionCorrection(2))),
        "strong": StrongTracking(weight),
        "fading": MultipleFading(weight),
        "scaling": InnovationScaling(),
    }
    return made.get(spec["adaptation"])


def build(spec: Spec) -> Any | None:
    """The recipe, or None where the library says in an InputError that it does not fit together."""
    try:
        motion, sensors = _motion(spec), _sensors(spec)
        if spec["fusion"]:
            from difffilter import Fusion

            return Fusion(motion, sensors, linearise=spec["linearise"])
        scope: Any = spec["scope"]
        if scope == "named":
            channels = [name for sensor in sensors for name in sensor.channels]
            scope = {"first": tuple(channels[:2])}
        filter = Filter(
            motion,
            sensors,
            WEIGHTS[spec["weight"]],
            standardise=spec["standardise"],
            iterations=spec["iterations"],
            weigh_prior=spec["weigh_prior"],
            mad=spec["mad"],
            scope=scope,
            distance=spec["distance"],
            gate=None if spec["gate"] == "none" else Gate(spec["gate"]),
            recovery=None if spec["recovery"] == "none" else Recovery(spec["recovery"]),
            federated=spec["federated"],
            adaptation=_adaptation(spec),
            linearise=spec["linearise"],
        )
        if not spec["modes"]:
            return filter
        calm = replace(filter, motion=ConstantVelocity(2, acceleration=0.1))
        turn = replace(filter, motion=CoordinatedTurn(2, acceleration=0.5, turn_rate=0.1))
        return Mixture({"calm": calm, "turn": turn}, rate=0.1)
    except InputError:
        return None
