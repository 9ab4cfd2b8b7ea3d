"""Units of measurements: factors to metres, radians, metres per second and so on."""

from __future__ import annotations

import difflib
import math

from difffilter.errors import InputError, shown

__all__ = ["UNITS", "factor"]

KNOT = 1852.0 / 3600.0

#: Factor to the SI unit of a measurement, by that unit and by the name in a file. Times in a
#: measurement of length are those of light.
UNITS = {
    "m": {
        "m": 1.0, "km": 1e3, "cm": 1e-2, "mm": 1e-3, "ft": 0.3048, "nmi": 1852.0, "mi": 1609.344,
        "us": 299.792458, "ns": 0.299792458,
    },
    "rad": {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180.0},
    "m/s": {"m/s": 1.0, "km/h": 1.0 / 3.6, "kn": KNOT, "mph": 0.44704, "ft/s": 0.3048},
    "m/s^2": {"m/s^2": 1.0, "g": 9.80665},
    "rad/s": {"rad/s": 1.0, "deg/s": math.pi / 180.0},
    "1": {"1": 1.0, "%": 1e-2},
}  # fmt: skip


def factor(unit: str, where: str, base: str = "") -> float:
    """Factor of a unit to the SI unit of what it measures; of ``base`` alone where given.

    Raises:
        InputError: names ``where``, the unit and those that are known.
    """
    bases = [base] if base else list(UNITS)
    for known in bases:
        if unit in UNITS[known]:
            return UNITS[known][unit]
    names = [name for known in bases for name in UNITS[known]]
    close = difflib.get_close_matches(str(unit), names, n=1)
    hint = f"; did you mean {close[0]}?" if close else ""
    raise InputError(f"{where}: found {shown(unit)}, expected one of {', '.join(names)}{hint}")
