"""Corruptions of the table's channels and of the clock: units, signs, zeros, order, offsets in time, attitude."""

from __future__ import annotations

import numpy as np
from unit_copy import ANGLE, ATTITUDE, RATE, TEMPERATURE, TIME, Copy, NotApplicableError, Table, put, rows_of, values

TABLE_COLUMNS = [ANGLE, RATE, *ATTITUDE]


def column_scaled(copy: Copy, scope: str, column: str, factor: float, added: float = 0.0) -> None:
    """Replace a column by ``factor`` times it plus ``added``."""
    for table in _with(copy, scope, column):
        table[column] = factor * table[column] + added


def gyroscope_and_rate_scaled(copy: Copy, scope: str, factor: float) -> None:
    """Multiply the gyroscope and the table's rate: both in another unit."""
    copy.map_readings(scope, "gyroscope", factor * np.eye(3))
    column_scaled(copy, copy.said.get("recording", scope), RATE, factor)


def sense(copy: Copy, scope: str) -> None:
    """Count angle and rate the other way round."""
    for table in _with(copy, scope, ANGLE):
        table[ANGLE], table[RATE] = -table[ANGLE], -table[RATE]


def zero(copy: Copy, scope: str, degrees: float) -> None:
    """Move the zero of the angle by so much, either way."""
    sign = float(copy.rng.choice([-1.0, 1.0]))
    column_scaled(copy, scope, ANGLE, 1.0, sign * degrees)
    copy.said["zero_deg"] = sign * degrees
    copy.causes |= {"encoder_zero", "mounting", "table_tilt"} if degrees <= 5.0 else set()


def face(copy: Copy, scope: str, degrees: float, *, backwards: bool = False) -> None:
    """Put another face up at angle 0, or clamp the unit the other way round on the axis."""
    column_scaled(copy, scope, ANGLE, 1.0, degrees)
    if backwards:
        sense(copy, copy.said.get("recording", scope))


def wrapped(copy: Copy, scope: str, *, symmetric: bool = False) -> None:
    """Log the angle from 0 to 360 deg, or from -180 to 180 deg."""
    for table in _with(copy, scope, ANGLE):
        table[ANGLE] = np.mod(table[ANGLE] + 180.0, 360.0) - 180.0 if symmetric else np.mod(table[ANGLE], 360.0)
    copy.harmless = True


def dropped_column(copy: Copy, scope: str, column: str) -> None:
    """Leave a column out."""
    for table in _with(copy, scope, column):
        for each in ATTITUDE if column == ATTITUDE[0] else [column]:
            table.pop(each)


def column_noise(copy: Copy, scope: str, column: str, sigma: float) -> None:
    """Add white noise to a column."""
    for table in _with(copy, scope, column):
        table[column] = table[column] + sigma * copy.rng.standard_normal(len(table[column]))


def column_rounded(copy: Copy, scope: str, column: str, step: float) -> None:
    """Round a column."""
    for table in _with(copy, scope, column):
        table[column] = np.round(table[column] / step) * step


def column_of_another(copy: Copy, column: str) -> None:
    """Take a column of one recording from another one of its role."""
    role = str(copy.rng.choice(["accelerometer", "gyroscope"]))
    to, source = copy.rng.choice(copy.recordings(role), 2, replace=False).tolist()
    copy.said |= {"from": source, "to": to}
    found, table = copy.tables[source], copy.tables[to]
    if column not in found or column not in table:
        raise NotApplicableError(f"no {column}")
    table[column] = np.resize(found[column], len(table[column]))


def shifted(copy: Copy, scope: str, rows: float, columns: str = "table") -> None:
    """Log the table's columns later than the sensor's by a number of rows (also a fraction), within the rows."""
    wanted = {"table": TABLE_COLUMNS, "rate": [RATE], "angle": [ANGLE]}[columns]
    for table in copy.chosen(scope):
        at = np.arange(len(table[TIME])) - rows
        for column in (c for c in wanted if c in table):
            table[column] = np.interp(at, np.arange(len(at)), table[column])
        if ATTITUDE[0] in table:
            q = values(table, ATTITUDE)
            put(table, ATTITUDE, q / np.linalg.norm(q, axis=1, keepdims=True))
    copy.causes |= {"time_offset"}


def fast_clock(copy: Copy, scope: str, ppm: float) -> None:
    """Let the time column run fast against the table: the rates in it stay what they were."""
    for table in copy.chosen(scope):
        table[TIME] = table[TIME] * (1.0 + 1e-6 * ppm)
    copy.causes |= {"clock_rate"}


def slow_table(copy: Copy, scope: str, ppm: float) -> None:
    """Let the table's log run slow against the sensor's rows."""
    for table in copy.chosen(scope):
        n = len(table[TIME])
        at = np.arange(n) * (1.0 - 1e-6 * ppm)
        for column in (c for c in (ANGLE, RATE) if c in table):
            table[column] = np.interp(at, np.arange(n), table[column])
    copy.causes |= {"clock_rate", "time_offset"}


def time_unit(copy: Copy, scope: str, factor: float) -> None:
    """Write the times in another unit under the same name."""
    for name in copy.recordings(scope):
        copy.tables[name][TIME] = copy.tables[name][TIME] * factor


def slow_motion(copy: Copy, factor: float) -> None:
    """Stretch all times, with the gyroscope and all rates of the table divided: a wrong second in all of them."""
    for table in copy.tables.values():
        table[TIME] = table[TIME] * factor
        if RATE in table:
            table[RATE] = table[RATE] / factor
    copy.map_readings("all", "gyroscope", np.eye(3) / factor)
    copy.unseen = "time, table rate and gyroscope agree in a second of another length"


def jitter(copy: Copy, scope: str, share: float) -> None:
    """Let the stamps scatter by a share of the interval."""
    for table in copy.chosen(scope):
        moved = table[TIME] + share * copy.interval_s * copy.rng.uniform(-1.0, 1.0, len(table[TIME]))
        table[TIME] = np.sort(moved)


def time_reset(copy: Copy, scope: str) -> None:
    """Start the clock again at a random row."""
    for table in copy.chosen(scope):
        row = int(copy.rng.integers(len(table[TIME]) // 5, 4 * len(table[TIME]) // 5))
        copy.said["row"] = row
        table[TIME] = np.where(np.arange(len(table[TIME])) < row, table[TIME], table[TIME] - table[TIME][row])


def own_zeros(copy: Copy) -> None:
    """Start each recording at 0."""
    for table in copy.tables.values():
        table[TIME] = table[TIME] - table[TIME][0]
    copy.harmless = True


def later(copy: Copy, scope: str, seconds: float) -> None:
    """Add a constant to the times of recordings."""
    for table in copy.chosen(scope):
        table[TIME] = table[TIME] + seconds
    copy.harmless = True


def rows(copy: Copy, scope: str, how: str, size: float = 0.0) -> None:
    """Drop, double or turn round rows."""
    for name in copy.recordings(scope):
        table = copy.tables[name]
        n, rng = len(table[TIME]), copy.rng
        if how == "dropped":
            copy.tables[name] = rows_of(table, rng.random(n) >= size)
        elif how == "block_dropped":
            first = int(rng.integers(0, int(n * (1.0 - size))))
            keep = (np.arange(n) < first) | (np.arange(n) >= first + int(size * n))
            copy.tables[name] = rows_of(table, keep)
        elif how == "cut_off":
            copy.tables[name] = rows_of(table, np.arange(n) < int((1.0 - size) * n))
        elif how == "doubled":
            copy.tables[name] = rows_of(table, np.sort(np.append(np.arange(n), rng.integers(0, n, int(size * n)))))
        elif how == "repeated_later":
            copy.tables[name] = _repeated(table, size, rng)
        else:
            copy.tables[name] = {c: v if c == TIME else v[::-1].copy() for c, v in table.items()}


def _repeated(table: Table, share: float, rng: np.random.Generator) -> Table:
    """Write a block of rows once more, with times that go on: a buffer that was sent twice."""
    n = len(table[TIME])
    length = int(share * n)
    first = int(rng.integers(0, n - length))
    order = np.r_[0 : first + length, first:n]
    out = rows_of(table, order)
    step = float(np.median(np.diff(table[TIME])))
    out[TIME] = np.r_[table[TIME][: first + length], table[TIME][first:] + length * step]
    return out


def attitude(copy: Copy, how: str, degrees: float = 0.0) -> None:
    """Write the attitude of the held-out motion by another convention, or turned."""
    table = copy.tables["validation"]
    q = values(table, ATTITUDE)
    axis = copy.rng.standard_normal(3)
    axis /= np.linalg.norm(axis)
    if how == "conjugated":
        q = q * [1.0, -1.0, -1.0, -1.0]
    elif how == "order":
        q = q[:, [1, 2, 3, 0]]
    elif how == "one_sign":
        q = q * [1.0, 1.0, -1.0, 1.0]
    elif how == "signs":
        q = q * copy.rng.choice([-1.0, 1.0], (len(q), 1))
        copy.harmless = True
    elif how == "unnormalised":
        q = 1.1 * q
    elif how == "body":
        q = _product(q, _turn(axis, degrees))
    elif how == "level":
        q = _product(_turn(axis, degrees), q)
    elif how == "heading":
        q = _product(_turn(np.array([0.0, 0.0, 1.0]), degrees), q)
        copy.harmless = True
    elif how == "constant":
        q = np.repeat(q[:1], len(q), axis=0)
    put(table, ATTITUDE, q)


def temperature(copy: Copy, scope: str, how: str) -> None:
    """Write the temperature in another unit, or that of something else."""
    for table in _with(copy, scope, TEMPERATURE):
        t = table[TEMPERATURE]
        table[TEMPERATURE] = {
            "kelvin": lambda t: t + 273.15,
            "fahrenheit": lambda t: 1.8 * t + 32.0,
            "reversed": lambda t: t[::-1].copy(),
            "negated": lambda t: -t,
            "constant": lambda t: np.full_like(t, 25.0),
            "noise": lambda t: t + 2.0 * copy.rng.standard_normal(len(t)),
            "rounded": np.round,
        }[how](t)
    copy.harmless = copy.base != "hidden"


def stamps(copy: Copy, kind: str, seconds: float) -> None:
    """Stamp one kind of message of an MCAP file later than the others."""
    if copy.format != "mcap":
        raise NotApplicableError("no MCAP")
    copy.log_stamps[kind] = seconds
    copy.causes |= {"time_offset"}


def _product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the Hamilton product of quaternions w, x, y, z."""
    p, q = np.broadcast_arrays(np.atleast_2d(p), np.atleast_2d(q))
    w = p[:, 0] * q[:, 0] - np.sum(p[:, 1:] * q[:, 1:], axis=1)
    v = p[:, :1] * q[:, 1:] + q[:, :1] * p[:, 1:] + np.cross(p[:, 1:], q[:, 1:])
    return np.column_stack([w, v])


def _turn(axis: np.ndarray, degrees: float) -> np.ndarray:
    half = np.radians(degrees) / 2.0
    return np.concatenate([[np.cos(half)], np.sin(half) * axis])


def _with(copy: Copy, scope: str, column: str) -> list[Table]:
    """Return the tables of those recordings that hold a column."""
    found = [table for table in copy.chosen(scope) if column in table]
    if not found:
        raise NotApplicableError(f"no {column} in {scope}")
    return found
