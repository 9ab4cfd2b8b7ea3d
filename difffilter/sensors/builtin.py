"""The built-in sensors, all with analytic gradients.

The user's own: :mod:`difffilter.sensors.sensor`.
"""

from difffilter.sensors.bearing import Bearing
from difffilter.sensors.position import Position, PositionSensor
from difffilter.sensors.stations import TDOA, Range, StationSensor

__all__ = ["TDOA", "Bearing", "Position", "PositionSensor", "Range", "StationSensor"]
