"""The encoder of a table in an unknown log: its column, its counts a turn, and the gyroscope's unit by it.

Gravity in the sensor's axes turns with the table, f = c + a cos(2 pi n / N) + b sin(2 pi n / N), with N counts a turn;
about a vertical shaft, the gyroscope tells N to within its scale factor.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import minimize_scalar

from pipeline.io.units import UNITS
from pipeline.profile_detection.columns import NO_SENSOR, stated_unit, words_of
from pipeline.profile_detection.unit_guesses import (
    CLOSE_BY_TABLE,
    FOLLOWED,
    SLOWEST,
    even_steps,
    rate_unit_by_table,
    slope,
    whole,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.profile_detection.columns import Columns
    from pipeline.profile_detection.unit_guesses import Guess
    from pipeline.records import Values

CENTIDEGREES = "cdeg"  # in the name of a table's angle
NO_ENCODER = NO_SENSOR | {"roll", "pitch", "yaw", "heading", "tilt", "angle", "quat"}  # a sensor's own estimate
# Counts a turn of encoders: 8 to 20 bits, and usual numbers of lines, once, twice and four times.
ENCODERS = (
    *(2**bits for bits in range(8, 21)),
    *(k * n for n in (500, 600, 900, 1000, 1250, 2500, 9000) for k in (1, 2, 4)),
)
CLOSE_TURN = 0.01  # half of the least distance of two of them, but 4000 and 4096
LEFT_BY_GRAVITY = 0.1  # share of the force's rms: axes lean, and the log lags by some ms
SHORTEST_TURN = 0.9  # of a turn; over half of one, other columns pass for an angle
SEARCHED = 0.1  # about a usual number of counts, for one between them
MOST_FITTED = 20_000  # rows; bounds the cost


def find_encoder(
    parts: Sequence[Columns], force: Values | None, rate_dps: Values | None, time_s: Values | None
) -> None:
    """Find the counts a turn of an encoder that is named, or else the column that counts the turns of the readings."""
    for columns in parts:
        numbers, names = columns.log.numbers, columns.log.names
        named = columns.others.get("table_angle")
        if columns.turn or (named is not None and stated_unit(names[named], "table_angle")[0]):
            continue
        if named is not None and (turn := counts_a_turn(numbers[named])):
            columns.turn = turn, f"starts again after {turn} counts"
            continue
        free = [i for i in columns.free() if not set(words_of(names[i])) & NO_ENCODER]
        found = ((i, _encoder_turn(numbers[i], force, rate_dps, time_s)) for i in (free if named is None else [named]))
        index, columns.turn = next(((i, turn) for i, turn in found if turn), (named, None))
        if columns.turn and index is not None:
            columns.others["table_angle"] = index
            what = f"{names[index]} is taken as the table's encoder by its numbers" if named is None else names[index]
            columns.remarks.append(f"{what}: check counts and sign, and add offset, the count at angle 0")


def unit_by_table(columns: Columns, rate: Values, time_s: Values | None) -> Guess | None:
    """Return what the table's rate, or the slope of its angle, in the same rows says of the gyroscope's unit."""
    channel = next((c for c in ("table_rate", "table_angle") if c in columns.others), None)
    if channel is None or (channel == "table_angle" and not columns.steady):
        return None
    index = columns.others[channel]
    stated, _ = stated_unit(columns.log.names[index], channel)
    multiplier, divisor = UNITS[channel][stated or {"table_rate": "deg/s", "table_angle": "deg"}[channel]]
    if CENTIDEGREES in words_of(columns.log.names[index]):
        divisor *= 100
    values = columns.log.numbers[index]
    if channel == "table_angle" and stated is None and columns.turn:
        divisor *= columns.turn[0] / 360.0
    values = values * multiplier / divisor
    if channel == "table_angle":
        if time_s is None:
            return None
        values = np.gradient(np.unwrap(values, period=360.0), time_s)
    return rate_unit_by_table(rate, values)


def counts_a_turn(values: Values) -> int | None:
    """Return the counts a turn of an encoder that starts again at each turn; None where it shows no such count."""
    steps = np.abs(np.diff(values))
    wraps = np.flatnonzero(steps[1:-1] > np.ptp(values) / 2.0) + 1
    if not wraps.size or not whole(values):
        return None
    turn = float(np.median(steps[wraps] + (steps[wraps - 1] + steps[wraps + 1]) / 2.0))
    usual = min((n for n in ENCODERS if n > np.ptp(values)), key=lambda n: abs(np.log(n / turn)), default=0)
    return usual if usual and abs(turn / usual - 1.0) < CLOSE_TURN else None


def _encoder_turn(
    counts: Values, force: Values | None, rate_dps: Values | None, time_s: Values | None
) -> tuple[float, str] | None:
    """Return the counts a turn of an encoder and how they show; None where they do not, or it is no encoder.

    They show by a start again at each turn; by gravity, f = c + a cos(2 pi n / N) + b sin(2 pi n / N); or by the
    slope of the counts over the turn of the gyroscope, (n, 3) in deg/s, to within its scale factor.
    """
    if not whole(counts) or even_steps(counts) or not np.any(np.diff(counts)):
        return None
    if force is not None:
        return _turn_by_gravity(counts, force)
    if rate_dps is None or time_s is None or not np.all(np.diff(time_s) > 0):
        return None
    size = slope(rate_dps, np.gradient(counts, time_s))
    if size is None or size * np.std(np.gradient(counts, time_s)) < SLOWEST:
        return None
    usual = sorted(ENCODERS, key=lambda n: abs(np.log(n * size / 360.0)))
    near = [n for n in usual if abs(n * size / 360.0 - 1.0) < CLOSE_BY_TABLE]
    seen = f"the gyroscope turns once in {360.0 / size:.4g} counts"
    others = f" (check it: or {' or '.join(map(str, near[1:]))})" if len(near) > 1 else ""
    return (near[0], f"{seen}{others}") if near else (float(f"{360.0 / size:.4g}"), f"{seen} (no usual number)")


def _turn_by_gravity(counts: Values, force: Values) -> tuple[float, str] | None:
    step = -(-len(counts) // MOST_FITTED)
    counts, force = counts[::step] - counts[0], force[::step]
    power = float(np.sum((force - force.mean(axis=0)) ** 2))
    if power < FOLLOWED**2 * float(np.sum(force**2)):
        return None  # gravity does not turn

    def left(turn: float) -> float:
        phase = 2.0 * np.pi * counts / turn
        A = np.column_stack([np.ones(len(phase)), np.cos(phase), np.sin(phase)])
        return float(np.sqrt(np.sum((force - A @ np.linalg.lstsq(A, force, rcond=None)[0]) ** 2) / power))

    usual = min((n for n in ENCODERS if n * SHORTEST_TURN < np.ptp(counts)), key=left, default=None)
    if usual is None:
        return None
    bounds = (usual * (1.0 - SEARCHED), usual * (1.0 + SEARCHED))
    measured = float(minimize_scalar(left, bounds=bounds, method="bounded").x)
    if min(left(measured), left(usual)) > LEFT_BY_GRAVITY:
        return None
    seen = f"gravity turns once in {measured:.4g} counts, to within {left(measured):.1%}"
    if left(usual) < LEFT_BY_GRAVITY and abs(measured / usual - 1.0) < CLOSE_TURN:
        return usual, f"{seen}; {usual} is the usual number near it"
    return float(f"{measured:.4g}"), f"{seen} (no usual number)"
