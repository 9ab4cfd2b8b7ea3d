"""The built-in sensors, all with analytic gradients. The user's own: :mod:`difffilter.sensor`."""

from difffilter.bearing import Bearing
from difffilter.position_sensor import Position, PositionSensor
from difffilter.station_sensor import TDOA, Range, StationSensor

__all__ = ["TDOA", "Bearing", "Position", "PositionSensor", "Range", "StationSensor"]
