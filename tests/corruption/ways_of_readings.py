"""Corruptions of the sensor's own columns: units, scale, signs, order, stuck, spiked, stepped, drifting, noisy, coarse.

A function changes a ``Copy`` in place. ``scope`` names recordings as ``Copy.recordings`` takes it.
"""

from __future__ import annotations

import numpy as np
from good_bench import SENSORS
from unit_copy import ANGLE, COLUMNS, RATE, TEMPERATURE, TIME, Copy, NotApplicableError, add, put, values

SIZE = {"accelerometer": 1.0, "gyroscope": 100.0}  # g and deg/s: what a recording typically spans
WHITE = {
    ("mpu6050", "accelerometer"): 8e-4,  # g, white noise of a sample at 0.12 s: the sensor file's density
    ("mpu6050", "gyroscope"): 0.0102,
    ("stim300", "accelerometer"): 2.9e-4,
    ("stim300", "gyroscope"): 7.2e-3,
}


def scaled(copy: Copy, scope: str, sensor: str, factor: float) -> None:
    """Multiply all axes of a sensor: a wrong unit or range."""
    copy.map_readings(scope, sensor, factor * np.eye(3))
    if factor < 0.0 and sensor == "accelerometer" and "recording" in copy.tables:
        copy.unseen = "by hand neither the magnitude of gravity nor the way in which it turns shows its sign"


def scaled_axis(copy: Copy, scope: str, sensor: str, factor: float) -> None:
    """Multiply one axis."""
    diagonal = np.ones(3)
    diagonal[_axis(copy)] = factor
    copy.map_readings(scope, sensor, np.diag(diagonal))


def reordered(copy: Copy, scope: str, sensor: str, order: tuple[int, int, int]) -> None:
    """Exchange columns of a sensor."""
    copy.map_readings(scope, sensor, np.eye(3)[list(order)])


def exchanged_sensors(copy: Copy, scope: str) -> None:
    """Put the accelerometer's numbers into the gyroscope's columns and the other way round."""
    for table in copy.chosen(scope):
        accelerometer, gyroscope = (values(table, COLUMNS[s]) for s in SENSORS)
        put(table, COLUMNS["accelerometer"], gyroscope)
        put(table, COLUMNS["gyroscope"], accelerometer)


def offset(copy: Copy, scope: str, sensor: str, size: float) -> None:
    """Add a constant to all axes of some recordings: another bias there."""
    for table in copy.chosen(scope):
        added = size * SIZE[sensor] * copy.rng.choice([-1.0, 1.0], 3)
        add(table, sensor, added)


def spiked(copy: Copy, scope: str, channel: str, size: float, rows: int = 1) -> None:
    """Replace some rows of one column by other numbers: its value plus or minus ``size``."""
    for name in copy.recordings(scope):
        table = copy.tables[name]
        column = _column(copy, channel)
        if column not in table:
            raise NotApplicableError(f"no {column} in {name}")
        first = int(copy.rng.integers(0, len(table[column]) - rows))
        copy.said |= {"column": column, "rows": [first, first + rows]}
        changed = table[column].copy()
        changed[first : first + rows] += size * copy.rng.choice([-1.0, 1.0])
        table[column] = changed


def scattered_spikes(copy: Copy, scope: str, channel: str, size: float, share: float) -> None:
    """Spike rows here and there."""
    for name in copy.recordings(scope):
        table, column = copy.tables[name], _column(copy, channel)
        if column not in table:
            raise NotApplicableError(f"no {column} in {name}")
        hit = copy.rng.random(len(table[column])) < share
        table[column] = table[column] + hit * size * copy.rng.standard_normal(len(hit))
        copy.said |= {"column": column, "rows": int(hit.sum())}


def stuck(copy: Copy, scope: str, channel: str, share: float = 1.0) -> None:
    """Let one column stay at a value, for a share of each recording."""
    column = _column(copy, channel)
    copy.said["column"] = column
    for table in copy.chosen(scope):
        if column not in table:
            continue
        n = len(table[column])
        length = max(2, int(share * n))
        first = int(copy.rng.integers(0, n - length + 1))
        copy.said["rows"] = [first, first + length]
        held = table[column].copy()
        held[first : first + length] = held[first]
        table[column] = held


def stepped(copy: Copy, scope: str, channel: str, size: float) -> None:
    """Add a constant to one column from a random row on."""
    for name in copy.recordings(scope):
        table, column = copy.tables[name], _column(copy, channel)
        if column not in table:
            raise NotApplicableError(f"no {column} in {name}")
        n = len(table[column])
        first = int(copy.rng.integers(n // 5, 4 * n // 5))
        copy.said |= {"column": column, "from_row": first}
        table[column] = table[column] + size * copy.rng.choice([-1.0, 1.0]) * (np.arange(n) >= first)


def knocked(copy: Copy, scope: str, size: float) -> None:
    """Knock at the bench: a decaying swing of a few samples in both sensors."""
    for table in copy.chosen(scope):
        n = len(table[TIME])
        first = int(copy.rng.integers(0, n - 10))
        copy.said["from_row"] = first
        later = np.clip(np.arange(n) - first, 0, None)
        swing = (later > 0) * np.exp(-later / 4.0) * np.cos(1.7 * later)
        for sensor in SENSORS:
            kick = size * SIZE[sensor] * copy.rng.standard_normal(3)
            add(table, sensor, swing[:, None] * kick)


def drifting(copy: Copy, scope: str, sensor: str, size: float) -> None:
    """Add a line in time to all axes of some recordings, from 0 to ``size``."""
    for table in copy.chosen(scope):
        line = np.linspace(0.0, size * SIZE[sensor], len(table[TIME]))
        added = line[:, None] * copy.rng.choice([-1.0, 1.0], 3)
        add(table, sensor, added)
    copy.causes |= {"bias_drift"}


def noisy(copy: Copy, scope: str, sensor: str, factor: float, share: float = 1.0) -> None:
    """Add white noise of ``factor`` times the sensor's, to a share of each recording."""
    for table in copy.chosen(scope):
        n = len(table[TIME])
        length = int(share * n)
        first = int(copy.rng.integers(0, n - length + 1))
        inside = (np.arange(n) >= first) & (np.arange(n) < first + length)
        sigma = factor * WHITE[copy.model, sensor] * np.sqrt(0.12 / copy.interval_s)
        added = sigma * copy.rng.standard_normal((n, 3)) * inside[:, None]
        add(table, sensor, added)


def coarse(copy: Copy, scope: str, sensor: str, step: float) -> None:
    """Round the readings: fewer bits than declared."""
    for table in copy.chosen(scope):
        put(table, COLUMNS[sensor], np.round(values(table, COLUMNS[sensor]) / step) * step)


def clipped(copy: Copy, scope: str, sensor: str, at: float) -> None:
    """Clip the readings at a share of their largest: a smaller range than declared."""
    for table in copy.chosen(scope):
        readings = values(table, COLUMNS[sensor])
        top = at * float(np.abs(readings).max())
        put(table, COLUMNS[sensor], np.clip(readings, -top, top))


def lagging(copy: Copy, scope: str, columns: str, tau: float) -> None:
    """Pass columns through a first-order low pass of time constant ``tau`` (s)."""
    wanted = {**COLUMNS, "rate": [RATE], "angle": [ANGLE], "table": [ANGLE, RATE]}[columns]
    for table in copy.chosen(scope):
        gain = 1.0 - np.exp(-np.diff(table[TIME], prepend=table[TIME][0]) / tau)
        for column in (c for c in wanted if c in table):
            out, state = np.empty(len(gain)), table[column][0]
            for row, (share, new) in enumerate(zip(gain, table[column], strict=True)):
                state += share * (new - state)
                out[row] = state
            table[column] = out
    copy.causes |= {"low_pass_lag", "time_offset"}


def hidden_curve(copy: Copy, sensor: str, of: str, *, size: float, axes: int = 3, scope: str = "all") -> None:
    """Add physics that no catalogue holds: a random smooth function of what another quantity says, to some axes."""
    name_axis = {"force": 0, "rate": 1}
    chosen = copy.rng.choice(3, axes, replace=False)
    phase, frequency = copy.rng.uniform(0.0, 6.28, (3, 4)), copy.rng.uniform(0.5, 3.0, (3, 4))
    weight = copy.rng.standard_normal((3, 4)) / 2.0
    span = {"force": 1.0, "rate": 60.0, "angle": 60.0, "temperature": 3.0, "time": 300.0}[of]
    start = min(float(t[TIME][0]) for t in copy.tables.values())
    for name in copy.recordings(scope):
        table = copy.tables[name]
        if of in name_axis:
            x = copy.body(name, SENSORS[name_axis[of]]) / span
        else:
            column = {"angle": ANGLE, "temperature": TEMPERATURE, "time": TIME}[of]
            if column not in table:
                continue
            base = table[column] - (start if of == "time" else 25.0 if of == "temperature" else 0.0)
            x = np.repeat(base[:, None] / span, 3, axis=1)
        curve = np.zeros_like(x)
        for axis in chosen:
            waves = np.sin(np.outer(x[:, axis], frequency[axis]) + phase[axis]) - np.sin(phase[axis])
            curve[:, axis] = waves @ weight[axis]
        added = size * SIZE[sensor] * curve
        add(table, sensor, added)
    copy.causes |= {
        "force": {"quadratic_nonlinearity", "cubic_nonlinearity", "scale_factor_asymmetry", "cross_axis_nonlinearity"},
        "rate": {"quadratic_nonlinearity", "cubic_nonlinearity", "scale_factor_asymmetry", "rate_dependence"},
        "angle": set(),
        "temperature": {"bias_temperature", "bias_temperature_quadratic"},
        "time": {"bias_drift", "warm_up"},
    }[of]


def _axis(copy: Copy) -> int:
    found = int(copy.rng.integers(3))
    copy.said["axis"] = "xyz"[found]
    return found


def _column(copy: Copy, channel: str) -> str:
    """Return a column: one of a sensor's at random, or the one that is named."""
    return COLUMNS[channel][int(copy.rng.integers(3))] if channel in COLUMNS else channel
