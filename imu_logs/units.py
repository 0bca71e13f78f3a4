"""Define the channels of a recording and the units in which they may be logged.

    value in house unit = value * multiplier / divisor,   value = (count - offset) / counts_per_unit

House units are g, deg/s, deg, degC and integer ns. The ingest profile states the unit of a column; it is never guessed.
"""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

STANDARD_GRAVITY = 9.80665  # m/s^2
SECOND_NS = 1_000_000_000
SINCE_1970_NS = 100_000_000 * SECOND_NS  # 3 years: a larger time does not count from power-on
DEGREES = 180.0 / math.pi
COUNTS = "counts"
TABLE_TIME = "table_time"  # the time of the table's clock, in the rows of the sensor

AXES = ("x", "y", "z")
SENSORS = ("accelerometer", "gyroscope")
SENSOR_UNITS = {"accelerometer": "g", "gyroscope": "deg/s"}
ACCELEROMETER = ("accel_x", "accel_y", "accel_z")
GYROSCOPE = ("gyro_x", "gyro_y", "gyro_z")
ATTITUDE = ("table_qw", "table_qx", "table_qy", "table_qz")
SCALARS = ("temperature", "table_angle", "table_rate")
CHANNELS = (*ACCELEROMETER, *GYROSCOPE, *SCALARS, *ATTITUDE)
TABLE_CHANNELS = ("table_angle", "table_rate", *ATTITUDE)
TRIADS = {"accelerometer": ACCELEROMETER, "gyroscope": GYROSCOPE}

# Per quantity: unit to (multiplier, divisor); two numbers, because 1001.5 mg / 1000 is exact and times 0.001 is not.
_FORCE = {
    "g": (1.0, 1.0), "mg": (1.0, 1000.0), "ug": (1.0, 1e6), "m/s^2": (1.0, STANDARD_GRAVITY),
    "mm/s^2": (1.0, STANDARD_GRAVITY * 1000.0), COUNTS: (1.0, 1.0),
}  # fmt: skip
_RATE = {
    "deg/s": (1.0, 1.0),
    "mdps": (1.0, 1000.0),
    "mrad/s": (DEGREES, 1000.0),
    "rad/s": (DEGREES, 1.0),
    COUNTS: (1.0, 1.0),
}
_ANGLE = {"deg": (1.0, 1.0), "rad": (DEGREES, 1.0), COUNTS: (1.0, 1.0)}
_TEMPERATURE = {"degC": (1.0, 1.0), COUNTS: (1.0, 1.0)}
_RATIO = {"1": (1.0, 1.0)}
FORCE_UNITS = {unit: divisor for unit, (_, divisor) in _FORCE.items() if unit != COUNTS}  # how many are one g
_TIME = {"s": (1e9, 1.0), "ms": (1e6, 1.0), "us": (1e3, 1.0), "ns": (1.0, 1.0)}

UNITS: dict[str, dict[str, tuple[float, float]]] = {
    "time": _TIME,
    "table_time": _TIME,
    **dict.fromkeys(ACCELEROMETER, _FORCE),
    **dict.fromkeys(GYROSCOPE, _RATE),
    "temperature": _TEMPERATURE,
    "table_angle": _ANGLE,
    "table_rate": _RATE,
    **dict.fromkeys(ATTITUDE, _RATIO),
}

# Names of the columns in a canonical CSV, each in its house unit, the first of ``UNITS``.
CANONICAL = {
    "time": "time_s",
    **{c: f"{c}_g" for c in ACCELEROMETER},
    **{c: f"{c}_dps" for c in GYROSCOPE},
    "temperature": "temperature_degc",
    "table_angle": "table_angle_deg",
    "table_rate": "table_rate_dps",
    **{c: c for c in ATTITUDE},
}

# In the names of columns: spellings of units in brackets, in lower case and without blanks; units at the end of a name,
# as words; and words by their meaning.
NAMES = json.loads((Path(__file__).parent / "names.json").read_text(encoding="utf-8"))
SPELLINGS = {spelling: unit for unit, spellings in NAMES["units"].items() for spelling in spellings.split()}
BRACKETS = re.compile(r"[\[(]([^\])]*)[\])]\s*$")


def unit_spelt(text: str) -> str | None:
    """Return the unit that a text spells; None for any other text."""
    return SPELLINGS.get(text.strip().lower().removeprefix("in ").replace(" ", ""))


def unit_in_brackets(name: str) -> str | None:
    """Return the unit in brackets at the end of a column's name; None if there is none."""
    found = BRACKETS.search(name)
    return unit_spelt(found.group(1)) if found else None
