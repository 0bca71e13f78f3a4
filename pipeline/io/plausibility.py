"""Recordings that cannot be valid are refused, as they would be calibrated without complaint.

Times that do not increase or keep another rate than is known, specific force far from gravity, readings beyond the
sensor's range, rates that contradict the table or the rotation of gravity, an attitude that is no rotation: the cause
is nearly always a wrong unit or column.

Gaps, clipped and stuck readings are flagged in ``pipeline.io.quality_flags``; the mounting of the unit is checked in
``pipeline.preprocessing.mounting``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import IngestError
from pipeline.io.ingest_settings import Checks
from pipeline.io.quality_flags import flag_clipped, flag_gaps, flag_stuck
from pipeline.io.timestamps import time_error
from pipeline.io.units import ATTITUDE, DEGREES, TRIADS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from pipeline.io.channel_table import ChannelTable
    from pipeline.records import Note

FORCE_RANGE_G = (0.3, 3.0)  # about 1 g at rest; another unit is off by 9.8 or 1000
QUATERNION_TOLERANCE = 0.01  # components rounded to two decimals
RATE_TOLERANCE = 0.2  # another unit of time is off by 1000
ENOUGH = 200_000  # samples that a median is taken of
TURNING_DPS = 5.0  # below, the bias of a low-cost gyroscope is of the same size


def examine(
    table: ChannelTable, sensor: Mapping[str, Any], checks: Checks | None = None
) -> tuple[NDArray[np.uint16] | None, list[Note]]:
    """Return quality flags (None where none is set) and notes; refuse what cannot be valid.

    ``sensor`` is the section of the unit's configuration; its full scales may be absent.
    """
    checks = checks or Checks()
    _check_whole(table)
    _check_times(table)
    _check_rate(table, checks)
    _check_force(table)
    _check_attitude(table)
    flags = np.zeros(len(table.time_ns), np.uint16) if table.flags is None else table.flags.copy()
    notes = flag_gaps(table, flags, checks)
    for name in TRIADS:
        full_scale = (sensor.get(name) or {}).get("full_scale")
        if full_scale is not None:
            notes += flag_clipped(table, name, float(full_scale), flags)
        notes += flag_stuck(table, name, flags)
    _check_turn_rate(table)
    return (flags if flags.any() else None), notes


def _check_whole(table: ChannelTable) -> None:
    for channels in (*TRIADS.values(), ATTITUDE):
        missing = [c for c in channels if c not in table.values]
        if 0 < len(missing) < len(channels):
            message = f"{', '.join(missing)} missing; {', '.join(channels)} come together or not at all"
            raise IngestError(message, table.path, code="missing_column")


def _check_times(table: ChannelTable) -> None:
    time = table.time_ns
    if len(time) < 2:
        raise IngestError(f"{len(time)} data rows; at least 2 are needed", table.path, code="no_rows")
    back = time[1:] <= time[:-1]
    if back.any():
        row = int(np.argmax(back)) + 1
        raise time_error(time, table.place(row), row)


def _check_rate(table: ChannelTable, checks: Checks) -> None:
    if checks.rate_hz is None:
        return
    interval_us = float(np.median(np.diff(table.time_ns))) / 1e3
    ratio = interval_us * checks.rate_hz / 1e6
    if abs(ratio - 1.0) <= RATE_TOLERANCE:
        return
    unit = next((f"; the numbers look like {u}" for f, u in _OTHER_UNITS if abs(ratio * f - 1.0) <= RATE_TOLERANCE), "")
    message = (
        f"the median interval is {interval_us:g} us, and ingest.checks.rate_hz of {checks.rate_hz:g} Hz asks for "
        f"{1e6 / checks.rate_hz:g} us{unit}"
    )
    hint = "correct ingest.csv.columns.time.unit or ingest.checks.rate_hz"
    raise IngestError(message, table.path, code="wrong_rate", hint=hint)


_OTHER_UNITS = (
    (1e-3, "times of a unit a thousand times shorter"),
    (1e3, "times of a unit a thousand times longer"),
    (1e-6, "times of a unit a million times shorter"),
    (1e6, "times of a unit a million times longer"),
    (1e-9, "ns"),
)


def _check_force(table: ChannelTable) -> None:
    if "accel_x" not in table.values:
        return
    stride = -(-len(table.time_ns) // ENOUGH)
    squares = np.asarray(sum(table.values[c][::stride] ** 2 for c in TRIADS["accelerometer"]))
    usual = float(np.sqrt(np.median(squares)))
    low, high = FORCE_RANGE_G
    if low <= usual <= high:
        return
    hint = "is the unit or the scale right?"
    for factor, unit in ((9.80665, "m/s^2"), (1000.0, "mg"), (1 / 9.80665, "g that were declared as m/s^2")):
        if 0.7 < usual / factor < 1.4:
            hint = f"the numbers look like {unit}"
    if usual > 1500.0:
        hint = "the numbers look like raw counts, which need counts_per_unit"
    message = (
        f"median specific force is {usual:.4g} g, and a log of rests and turns has about 1 g (allowed {low} to "
        f"{high}): {hint}; correct ingest.csv.columns.accel_x.unit (accel_y, accel_z)"
    )
    raise IngestError(message, table.path, code="implausible_force")


def _check_attitude(table: ChannelTable) -> None:
    if ATTITUDE[0] not in table.values:
        return
    norm = np.sqrt(sum(table.values[c] ** 2 for c in ATTITUDE))
    wrong = np.flatnonzero(np.abs(norm - 1.0) > QUATERNION_TOLERANCE)
    if wrong.size:
        row = int(wrong[0])
        message = (
            f"the table's quaternion has the length {norm[row]:.4g} at {table.time_ns[row] / 1e9:.9g} s "
            f"({wrong.size} such samples); 1 is expected"
        )
        raise IngestError(message, table.place(row), code="bad_attitude")


def _check_turn_rate(table: ChannelTable) -> None:
    """Refuse rates that are a radian's number of degrees off those of the table, or of the way gravity turns."""
    if "gyro_x" not in table.values:
        return
    stride = -(-len(table.time_ns) // ENOUGH)
    if "table_rate" in table.values:
        rate = np.abs(table.values["table_rate"][::stride])
        turning = rate > max(TURNING_DPS, 0.3 * float(rate.max()))
        if turning.sum() < 20:
            return
        size = np.sqrt(sum(table.values[c][::stride][turning] ** 2 for c in TRIADS["gyroscope"]))
        ratio = float(np.median(size / rate[turning]))
        seen = f"while the table turns the angular rate is {ratio:.3g} times the table's"
    else:
        from pipeline.io.gravity_rotation import declared_scale  # noqa: PLC0415  (imported where there is no table)

        found = declared_scale(table)
        if found is None:
            return
        ratio, seen = found
    for factor, what in ((1 / DEGREES, "rad/s that were declared as deg/s"), (DEGREES, "deg/s declared as rad/s")):
        if 0.7 < ratio / factor < 1.4:
            hint = "correct ingest.csv.columns.gyro_x.unit (gyro_y, gyro_z)"
            raise IngestError(f"{seen}: the numbers look like {what}", table.path, code="implausible_rate", hint=hint)
