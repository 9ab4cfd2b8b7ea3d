"""Sensors by name: what scenario files call them, and what makes each."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from difffilter.registry import Registry
from difffilter.sensors.builtin import TDOA, Bearing, Position, Range
from difffilter.sensors.sensor import Sensor

__all__ = ["SENSORS", "sensor"]

Factory = TypeVar("Factory", bound=Callable[..., Sensor])

#: Class or function that makes each kind of sensor. Its keyword arguments are the keys of
#: ``[sensors.NAME]`` and fields of ``[parameters.NAME]``, see :func:`sensor`.
SENSORS: Registry[Callable[..., Sensor]] = Registry("sensor")
for _name, _built_in in (
    ("tdoa", TDOA), ("range", Range), ("bearing", Bearing), ("position", Position),
):  # fmt: skip
    SENSORS.add(_name, _built_in)


def sensor(name: str) -> Callable[[Factory], Factory]:
    """Decorator: enters a class or function that makes a sensor in :data:`SENSORS`.

    It is called with those of these keywords that it takes: ``name``, ``axes``, ``sigma`` and
    ``bias`` of the scenario, and its own. An own keyword is a key of ``[sensors.NAME]`` by its
    type: ``float``, ``int``, ``bool`` and ``str`` are what they are in TOML, ``Literal`` one of
    its texts, ``tuple[str, ...]`` names, ``Sequence[Sequence[float]]`` points. The value of
    ``[parameters.NAME.FIELD]`` is the keyword FIELD. Sensors have ``name`` and ``unit``.

    Raises:
        InputError: the name is taken, or is no name.
    """

    def enter(factory: Factory) -> Factory:
        SENSORS.add(name, factory)
        return factory

    return enter
