"""What a scenario file says of the truth: world, sensors, faults, start."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

from difffilter.errors import InputError, shown
from difffilter.registry import NAME
from difffilter.scenario.faults import Fault, read_fault
from difffilter.scenario.pooling import pooled_sigma
from difffilter.scenario.sensing import SensorSpec, read_sensor
from difffilter.scenario.starting import StartSpec, read_start
from difffilter.scenario.table import LABEL, Table
from difffilter.scenario.world import World, read_world
from difffilter.sensors.position import Position

__all__ = ["Truth", "read_truth"]


class Truth(NamedTuple):
    """The truth of a scenario, apart from its filters; fields as those of :class:`Scenario`."""

    axes: int
    world: World | None
    sensors: Mapping[str, SensorSpec]
    faults: Mapping[str, Fault]
    start: StartSpec


def read_truth(top: Table) -> Truth:
    """Read ``[world]``, ``[sensors]``, ``[faults]`` and ``[start]``, which must fit together."""
    world = read_world(top.table("world")) if "world" in top else None
    axes = world.axes if world else top.integer("axes", 2, low=1)
    sensors = _read_sensors(top, axes)
    parts = top.table("faults", optional=True).named()
    faults = {name: read_fault(name, part, sensors.values()) for name, part in parts}
    if faults and world is None:
        top.fail("faults", "none in a scenario without [world]")
    _check_platform(top.where, world, sensors)
    for name, sensor in sensors.items():
        if sensor.every > 1 and world is None:
            top.table("sensors").table(name).fail("every", "none in a scenario without [world]")
    start = read_start(top.table("start", optional=True), world is not None, axes, [*sensors])
    return Truth(axes=axes, world=world, sensors=sensors, faults=faults, start=start)


def _read_sensors(top: Table, axes: int) -> dict[str, SensorSpec]:
    sensors = {name: read_sensor(name, part, axes) for name, part in top.table("sensors").named()}
    if not sensors:
        top.fail("sensors", "one sensor or more")
    sensors = {name: _pooled(top, name, sensor, sensors) for name, sensor in sensors.items()}
    channels = [c for sensor in sensors.values() for c in sensor.model.channels]
    for channel in channels:
        if not NAME.fullmatch(channel):
            top.fail("sensors", f"channels with names, not {shown(channel)}: {LABEL}")
    if len(set(channels)) != len(channels):
        top.fail("sensors", "no channel name twice")
    return sensors


def _pooled(
    top: Table, name: str, sensor: SensorSpec, sensors: Mapping[str, SensorSpec]
) -> SensorSpec:
    """A pooled sensor with the noise that its members leave; others as they are."""
    if not sensor.pool:
        return sensor
    part = top.table("sensors").table(name)
    for member in sensor.pool:
        if member not in sensors or sensors[member].pool or member == name:
            part.fail("pool", f"other sensors among {', '.join(sensors)}")
        if len(sensors[member].model.channels) != len(sensor.model.channels):
            part.fail("pool", "sensors of as many channels")
        if not isinstance(sensors[member].model, Position):
            part.fail("pool", "sensors of kind position")
    sigma = pooled_sigma([sensors[member] for member in sensor.pool])
    return replace(sensor, sigma=sigma, model=replace(sensor.model, sigma=sigma))


def _check_platform(where: str, world: World | None, sensors: Mapping[str, SensorSpec]) -> None:
    """A sensor rides the world's platform, and no other."""
    riding = {name: sensor.platform for name, sensor in sensors.items() if sensor.platform}
    if world is None:
        return
    for name, platform in riding.items():
        if platform != world.platform_inputs:
            expected = ", ".join(world.platform_inputs) or "none without [world.platform]"
            raise InputError(
                f"{where}: sensors.{name}.platform: found {list(platform)}, "
                f"expected the inputs of [world.platform]: {expected}"
            )
    if world.platform and not riding:
        raise InputError(f"{where}: world.platform: found one, expected a sensor that rides it")
