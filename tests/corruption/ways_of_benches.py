"""Corruptions of bench, files and settings: seats, rests, held-out motion, exchanged files, configuration."""

from __future__ import annotations

import numpy as np
from good_bench import SENSORS, good_unit
from unit_copy import (
    ANGLE,
    ATTITUDE,
    COLUMNS,
    RATE,
    TEMPERATURE,
    TIME,
    Copy,
    NotApplicableError,
    Table,
    add,
    put,
    rows_of,
    values,
)

from pipeline.simulation.trajectory import rotation_about


def seats(copy: Copy, scope: str, degrees: float, *, each: bool = False, gyroscope_alone: bool = False) -> None:
    """Seat the unit askew: once for the recordings of each axis, or in each recording anew; rotations of that size."""
    turns = {}
    for name in copy.recordings(scope):
        key = name if each else name[-1]
        if key not in turns:
            axis = copy.rng.standard_normal(3)
            turns[key] = rotation_about(axis / np.linalg.norm(axis), np.array([degrees]))[0]
        for sensor in SENSORS[1:] if gyroscope_alone else SENSORS:
            truth = copy.truth[sensor]
            turned = copy.body(name, sensor) @ turns[key].T
            put(copy.tables[name], COLUMNS[sensor], truth.bias + turned @ np.linalg.inv(truth.matrix).T)
    copy.causes |= {"mounting", "table_axis_nonorthogonality", "encoder_zero"}


def turned_sensor(copy: Copy, degrees: float) -> None:
    """Turn the whole unit in its seat, alike in all recordings: the frame of the table is what is calibrated."""
    axis = copy.rng.standard_normal(3)
    turn = rotation_about(axis / np.linalg.norm(axis), np.array([degrees]))[0]
    for sensor in SENSORS:
        truth = copy.truth[sensor]
        back = np.linalg.inv(truth.matrix)
        for name in copy.tables:
            put(copy.tables[name], COLUMNS[sensor], truth.bias + copy.body(name, sensor) @ turn.T @ back.T)
        truth.matrix = turn.T @ truth.matrix


def tilted_table(copy: Copy, scope: str, degrees: float) -> None:
    """Tilt gravity against the turn axes in the recordings: a table that is not level."""
    for name in copy.recordings(scope):
        table, truth = copy.tables[name], copy.truth["accelerometer"]
        if ANGLE not in table:
            raise NotApplicableError("no angle")
        heading = copy.rng.uniform(0.0, 360.0)
        axis = "xyz".index(name[-1])
        tilt = rotation_about(
            np.roll([0.0, np.cos(np.radians(heading)), np.sin(np.radians(heading))], axis), np.array([degrees])
        )[0]
        a = rotation_about(np.eye(3)[axis], -table[ANGLE])
        up = np.eye(3)[2 if axis < 2 else 0]
        change = np.einsum("nij,j->ni", a, tilt @ up - up)
        add(table, "accelerometer", change @ np.linalg.inv(truth.matrix).T)
    copy.causes |= {"table_tilt", "mounting", "encoder_zero", "table_axis_nonorthogonality"}


def static(copy: Copy, how: str, size: float = 0.0) -> None:
    """Let the long rest not be one, or be another one's."""
    if "static" not in copy.tables:
        raise NotApplicableError("no static")
    table = copy.tables["static"]
    n = len(table[TIME])
    if how in _COURSES:
        axis = copy.rng.standard_normal(3)
        _move(copy, table, axis / np.linalg.norm(axis), size * _COURSES[how](table[TIME] - table[TIME][0], copy.rng))
    elif how == "motion":
        moving = copy.tables["validation"]
        copy.tables["static"] = {c: np.resize(moving[c], n) for c in table if c in moving} | {TIME: table[TIME]}
    elif how == "another_model":
        copy.tables["static"] = good_unit("stim" if copy.model == "mpu6050" else "steps", 77).tables["static"]
    elif how == "another_unit":
        copy.tables["static"] = copy.other.tables["static"]
    elif how == "turns":
        copy.tables["static"] = {c: v for c, v in copy.tables["gyro_x"].items() if c != ANGLE}
    elif how == "noise":
        for sensor in SENSORS:
            readings = values(table, COLUMNS[sensor])
            mean = readings.mean(axis=0)
            put(table, COLUMNS[sensor], mean + size * (readings - mean))
    elif how == "short":
        copy.tables["static"] = rows_of(table, np.arange(n) < int(size))


_COURSES = {  # of the angle of a rest that moves, over time, for a size of 1
    "turning": lambda t, rng: t,  # noqa: ARG005
    "creeping": lambda t, rng: t / t[-1],  # noqa: ARG005
    "swinging": lambda t, rng: np.sin(2.0 * np.pi * t / 7.0),  # noqa: ARG005
    "walking": lambda t, rng: np.cumsum(rng.standard_normal(len(t))) / np.sqrt(len(t)),
    "half_moving": lambda t, rng: np.clip(t - t[-1] / 2.0, 0.0, None),  # noqa: ARG005
}


def _move(copy: Copy, table: Table, axis: np.ndarray, angle: np.ndarray) -> None:
    """Turn the resting unit about a body axis by so many degrees over time."""
    rate = np.gradient(angle, table[TIME])
    turns = rotation_about(axis, -angle)
    up = copy.body("static", "accelerometer").mean(axis=0)
    for sensor, change in (("accelerometer", turns @ up - up), ("gyroscope", rate[:, None] * axis)):
        back = np.linalg.inv(copy.truth[sensor].matrix)
        add(table, sensor, change @ back.T)


def leaked(copy: Copy, source: str, how: str) -> None:
    """Make the held-out motion of a recording that a fit uses."""
    table, rng = dict(copy.tables[source]), copy.rng
    n = len(table[TIME])
    kept = {
        "less_a_row": np.arange(n) != int(rng.integers(n)),
        "head_cut": np.arange(n) >= int(rng.integers(5, n // 4)),
        "thinned": np.arange(n) % 2 == 0,
        "half": np.arange(n) >= n // 2,
    }
    if how in kept:
        table = rows_of(table, kept[how])
    elif how == "later":
        table[TIME] = table[TIME] + float(np.round(rng.uniform(500.0, 3000.0), 3))
    elif how == "rows_moved":
        table = {c: v if c == TIME else np.roll(v, int(n / 3)) for c, v in table.items()}
    elif how == "resampled":
        table = {c: np.interp(np.arange(n - 1) + 0.5, np.arange(n), v) for c, v in table.items()}
    elif how == "rounded":
        for sensor in SENSORS:
            put(table, COLUMNS[sensor], np.round(values(table, COLUMNS[sensor]), 3))
    elif how == "mixed":
        table = _mixed(copy, table)
    table.pop(ANGLE, None)
    table[RATE] = np.abs(table[RATE])
    copy.tables["validation"] = table
    copy.leaked = True


def _mixed(copy: Copy, table: Table) -> Table:
    """Return held-out motion in which a block of a fit's rows stands."""
    own = copy.tables["validation"]
    n = len(own[TIME]) // 4
    first = int(copy.rng.integers(0, len(table[TIME]) - n))
    at = int(copy.rng.integers(0, len(own[TIME]) - n))
    return {
        c: v
        if c == TIME or c not in table
        else np.r_[
            v[:at], np.abs(table[c][first : first + n]) if c == RATE else table[c][first : first + n], v[at + n :]
        ]
        for c, v in own.items()
        if c not in ATTITUDE
    }


def other_validation(copy: Copy, how: str) -> None:
    """Take the held-out motion, or parts of it, from another unit."""
    own, other = copy.tables["validation"], copy.other.tables["validation"]
    if how == "unit":
        copy.tables["validation"] = other
    elif how == "attitude":
        put(own, ATTITUDE, values(other, ATTITUDE))
    elif how == "readings":
        for sensor in SENSORS:
            put(own, COLUMNS[sensor], values(other, COLUMNS[sensor]))
    elif how == "resting":
        static_rows = copy.tables["static"]
        times = own[TIME]
        copy.tables["validation"] = {c: np.resize(v, len(times)) for c, v in static_rows.items()} | {
            TIME: times,
            RATE: np.zeros(len(times)),
        }
        copy.leaked = True


def exchanged_files(copy: Copy, first: str, second: str) -> None:
    """Exchange two files."""
    if absent := [name for name in (first, second) if name not in copy.tables]:
        raise NotApplicableError(f"no {' and '.join(absent)}")
    copy.tables[first], copy.tables[second] = copy.tables[second], copy.tables[first]


def file_of_another_unit(copy: Copy, scope: str) -> None:
    """Take recordings from another unit of the model."""
    for name in copy.recordings(scope):
        copy.tables[name] = copy.other.tables[name]


def copied_file(copy: Copy, first: str, second: str) -> None:
    """Write one recording under a second name as well, with a row less."""
    copy.tables[second] = rows_of(copy.tables[first], np.arange(len(copy.tables[first][TIME])) > 0)


def setting(copy: Copy, override: str, *causes: str, harmless: bool = False, unseen: str = "") -> None:
    """Configure something that is not so."""
    copy.overrides.append(override)
    copy.causes |= set(causes)
    copy.harmless = harmless
    copy.unseen = unseen


def column_group(copy: Copy, **columns: str) -> None:
    """Name another configuration in the unit's row."""
    copy.row |= columns


def wrong_sensor(copy: Copy) -> None:
    """Name the other sensor model."""
    copy.row["sensor"] = "stim300" if copy.model == "mpu6050" else "mpu6050"


def gravity(copy: Copy, value: float) -> None:
    """State another local gravity: the accelerometer's readings are scaled by it, which nothing in a log tells."""
    setting(copy, f"table.gravity_g={value}", unseen="the size of gravity is stated, not measured")


def mapped(copy: Copy, axes: str) -> None:
    """State another axis map: readings are turned (or mirrored) at ingest, and the truth is that of the turned ones."""
    signs = np.zeros((3, 3))
    for column, axis in enumerate(axes.split(",")):
        signs["xyz".index(axis[1]), column] = 1.0 if axis[0] == "+" else -1.0
    copy.overrides.append(f"sensor.axis_map=[{axes}]")
    for sensor in SENSORS:
        truth = copy.truth[sensor]
        truth.bias, truth.matrix = signs @ truth.bias, truth.matrix @ np.linalg.inv(signs)


def shaken(copy: Copy, scope: str, size: float, hertz: float) -> None:
    """Let the bench vibrate at one frequency during some recordings."""
    for table in copy.chosen(scope):
        wave = np.sin(2.0 * np.pi * hertz * table[TIME] + copy.rng.uniform(0.0, 6.28))
        kick = size * copy.rng.standard_normal(3)
        add(table, "accelerometer", wave[:, None] * kick)


def warmer(copy: Copy, scope: str, degrees: float) -> None:
    """Let the temperature column of some recordings be that of a sensor elsewhere: so many degrees off."""
    for table in copy.chosen(scope):
        if TEMPERATURE in table:
            table[TEMPERATURE] = table[TEMPERATURE] + degrees
    copy.harmless = copy.base != "hidden"
