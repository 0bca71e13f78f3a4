"""What cannot be true of a recording, and what has to be marked in it.

Refused: time that does not increase, specific force far from gravity, readings that the sensor cannot give, an attitude
that is no rotation. Each is nearly always a wrong unit or column, and would calibrate without complaint.

Marked in ``flags``: a gap before a sample (its interval is longer than 1.5 times the median), and readings at full
scale. Nothing is filled in.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import InputError
from pipeline.formats.units import ATTITUDE, TRIADS
from pipeline.records import Note

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from pipeline.formats.channel_table import ChannelTable

GAP, CLIPPED = np.uint16(1), np.uint16(2)
GAP_INTERVALS = 1.5
FORCE_RANGE_G = (0.3, 3.0)
FULL_SCALE_MARGIN = 1.2
RAIL = 1e-4  # relative; the top code of 16 bits lies 3e-5 below full scale
BEYOND = 1e-3  # relative; with nominal counts per unit the top code lies up to so far above
QUATERNION_TOLERANCE = 0.01
UNIT_NAMES = {"accelerometer": "g", "gyroscope": "deg/s"}


def examine(table: ChannelTable, sensor: Mapping[str, Any]) -> tuple[NDArray[np.uint16] | None, list[Note]]:
    """Refuse what cannot be true, mark gaps and clipped readings.

    Parameters
    ----------
    table : ChannelTable
    sensor : mapping
        Section of the unit's configuration; its full scales may be absent.

    Returns
    -------
    flags : (n,) array of uint16, or None
        None where nothing is marked.
    notes : list of Note

    Raises
    ------
    InputError
    """
    _check_whole(table)
    _check_times(table)
    _check_force(table)
    _check_attitude(table)
    flags = np.zeros(len(table.time_ns), np.uint16)
    notes = _mark_gaps(table, flags)
    for name in TRIADS:
        full_scale = (sensor.get(name) or {}).get("full_scale")
        if full_scale is not None:
            notes += _mark_clipped(table, name, float(full_scale), flags)
    return (flags if flags.any() else None), notes


def _check_whole(table: ChannelTable) -> None:
    for channels in (*TRIADS.values(), ATTITUDE):
        missing = [c for c in channels if c not in table.values]
        if 0 < len(missing) < len(channels):
            raise InputError(
                f"{', '.join(missing)} missing; {', '.join(channels)} come together or not at all", table.path
            )


def _check_times(table: ChannelTable) -> None:
    time = table.time_ns
    if len(time) < 2:
        raise InputError(f"{len(time)} data rows; at least 2 are needed", table.path)
    steps = np.diff(time)
    back = np.flatnonzero(steps <= 0)
    if back.size:
        row = int(back[0]) + 1
        what = "repeats" if steps[row - 1] == 0 else "goes back to"
        raise InputError(
            f"time {what} {time[row] / 1e9:.9g} s after {time[row - 1] / 1e9:.9g} s ({back.size} such samples); time "
            "has to increase: a log that was restarted belongs in two files",
            table.place(row),
        )


def _check_force(table: ChannelTable) -> None:
    if "accel_x" not in table.values:
        return
    squares = sum(table.values[c] ** 2 for c in TRIADS["accelerometer"])
    median = float(np.sqrt(np.median(squares)))
    low, high = FORCE_RANGE_G
    if low <= median <= high:
        return
    hint = "is the unit or the scale right?"
    for factor, unit in ((9.80665, "m/s^2"), (1000.0, "mg"), (1 / 9.80665, "g that were declared as m/s^2")):
        if 0.7 < median / factor < 1.4:
            hint = f"the numbers look like {unit}"
    if median > 1500.0:
        hint = "the numbers look like raw counts, which need counts_per_unit"
    raise InputError(
        f"median specific force is {median:.4g} g, and a log of rests and turns has about 1 g (allowed {low} to "
        f"{high}): {hint}; correct the units in ingest.csv.columns",
        table.path,
    )


def _check_attitude(table: ChannelTable) -> None:
    if ATTITUDE[0] not in table.values:
        return
    norm = np.sqrt(sum(table.values[c] ** 2 for c in ATTITUDE))
    wrong = np.flatnonzero(np.abs(norm - 1.0) > QUATERNION_TOLERANCE)
    if wrong.size:
        row = int(wrong[0])
        raise InputError(
            f"the table's quaternion has the length {norm[row]:.4g} at {table.time_ns[row] / 1e9:.9g} s "
            f"({wrong.size} such samples); 1 is expected",
            table.place(row),
        )


def _mark_gaps(table: ChannelTable, flags: NDArray[np.uint16]) -> list[Note]:
    steps = np.diff(table.time_ns)
    median = float(np.median(steps))
    rows = np.flatnonzero(steps > GAP_INTERVALS * median) + 1
    if rows.size == 0:
        return []
    flags[rows] |= GAP
    lengths = steps[rows - 1]
    lost = float(np.sum(lengths - median)) / float(table.time_ns[-1] - table.time_ns[0])
    detail = (
        f"gaps longer than {GAP_INTERVALS} times the median interval of {median / 1e6:.6g} ms; "
        f"the longest lasts {lengths.max() / 1e9:.6g} s, {lost:.3%} of the time is missing"
    )
    return [_note("N-GAP", table, rows, detail)]


def _mark_clipped(table: ChannelTable, sensor: str, full_scale: float, flags: NDArray[np.uint16]) -> list[Note]:
    notes = []
    for channel in TRIADS[sensor]:
        if channel not in table.values:
            continue
        size = np.abs(table.values[channel])
        if size.max() > FULL_SCALE_MARGIN * full_scale:
            row = int(np.argmax(size > FULL_SCALE_MARGIN * full_scale))
            raise InputError(
                f"{channel} is {table.values[channel][row]:.6g} {UNIT_NAMES[sensor]} at {table.time_ns[row] / 1e9:.9g} "
                f"s, beyond {FULL_SCALE_MARGIN} times the full scale of {full_scale:g}; correct the column's unit or "
                f"sensor.{sensor}.full_scale",
                table.place(row),
            )
        count = abs(table.encodings[channel].scale) if channel in table.encodings else 0.0
        rows = np.flatnonzero(_at_rail(size, full_scale, count))
        if rows.size:
            flags[rows] |= CLIPPED
            detail = f"{channel} reaches the full scale of {full_scale:g} {UNIT_NAMES[sensor]} and may be clipped"
            notes.append(_note("N-CLIP", table, rows, detail))
    return notes


def _at_rail(size: NDArray[np.float64], full_scale: float, count: float) -> NDArray[np.bool_]:
    """Return which sizes lie at full scale, or at a largest value beyond it that occurs more than once.

    Many sensors read on past their nominal range (131 counts per deg/s reach 250.1 deg/s), some by a fifth.
    """
    clipped = (size >= full_scale - max(1.5 * count, RAIL * full_scale)) & (size <= (1.0 + BEYOND) * full_scale)
    largest = size.max()
    if largest > full_scale:
        at_largest = size >= largest - 1.5 * count
        if at_largest.sum() > 1:
            clipped |= at_largest
    return np.asarray(clipped)


def _note(code: str, table: ChannelTable, rows: NDArray[np.intp], detail: str) -> Note:
    return Note(code, int(rows.size), table.line_of(int(rows[0])), table.line_of(int(rows[-1])), detail)
