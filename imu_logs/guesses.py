"""Guess the units of the numbers in an unknown log, each with its evidence.

time           : intervals of sensors are 0.05 to 200 ms long
specific force : the median of |f| is near 1 in g, 9.8 in m/s^2, 1000 in mg
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from imu_logs.columns import LOW_COST_ERROR, SINCE_1970_S, Columns, whole
from imu_logs.log import Values
from imu_logs.units import COUNTS, FORCE_UNITS, UNITS

TO_DECIDE = "???"
OF_SENSOR = "${{sensor.{}.counts_per_unit}}"  # in a profile: a reference to the configuration of the sensor
MPU60X0_TEMPERATURE = {"counts_per_unit": 340.0, "offset": -12420.2}  # MPU-6000/6050 register map 4.2, 4.18
MAX_LINE_DEPARTURE = 0.02  # largest departure from a straight line, of the span
ASSUMED_HZ = 100.0  # if the time is unknown
TOO_FAST_FOR_RADIANS = 40.0  # rad/s, 2300 deg/s: beyond the range of usual sensors
BURST_INTERVAL_DIFFERENCE = 0.1  # relative difference of mean and median interval, from which both are stated
LARGEST_LINEAR = 5.0  # in m/s^2, of a walk
LONGEST_MEAN_S = 1.0  # mean interval of a slow log with a date
RATES_HZ = (5.0, 20_000.0)  # sampling rates of inertial sensors
CENTIDEGREES = "cdeg"  # in the name of a table's angle
TURN_OF = {"deg": 360.0, "rad": 2.0 * np.pi}  # a turn in units of angle


@dataclass(frozen=True)
class Guess:
    """A guess of the unit of a column."""

    entry: dict[str, Any]  # of a profile; ``???`` marks a value that the user must fill in
    evidence: str
    second_s: float | None = None  # length of the unit of a time, s
    centre: Values = field(default_factory=lambda: np.zeros(3))  # of the sphere through the rests: offset and bias


def time_unit(values: Values, stated: str | None, why: str) -> Guess:
    """Return the unit of a time."""
    steps = np.diff(values)
    step = float(np.median(steps[steps > 0])) if np.any(steps > 0) else 0.0
    seconds = {unit: length / 1e9 for unit, (length, _) in UNITS["time"].items() if unit != COUNTS}
    mean = float(np.mean(steps)) if len(steps) and np.all(steps >= 0) else step

    def on_average(second: float) -> str:
        if not step or abs(mean / step - 1.0) < BURST_INTERVAL_DIFFERENCE:
            return ""
        return f" by the median interval and {1 / (mean * second):.4g} Hz on average: rows in bursts, or gaps"

    if stated is not None:
        rate = f", {1 / (step * seconds[stated]):.4g} Hz{on_average(seconds[stated])}" if step else ""
        return Guess({"unit": stated}, why + rate, seconds[stated])
    low, high = RATES_HZ
    suits = [u for u, s in seconds.items() if step and low <= 1 / (step * s) <= high and mean * s * high >= 1]
    dated = [u for u, s in seconds.items() if step and SINCE_1970_S[0] < float(values[0]) * s < SINCE_1970_S[1]]
    since = [u for u in dated if u in suits or not suits]
    if not since and (slow := [u for u in dated if mean * seconds[u] <= LONGEST_MEAN_S]):
        evidence = f"steps of {step:.6g} suit {suits[0]} since power-on, and {slow[0]} since 1970 at"
        return Guess({"unit": TO_DECIDE}, f"{evidence} {1 / (mean * seconds[slow[0]]):.4g} Hz on average")
    for unit in since or suits:
        others = [f", or {u} at {1 / (step * seconds[u]):.4g} Hz" for u in suits if u != unit and not since]
        what = "since 1970, in " if since else ""
        rate = f"{1 / (step * seconds[unit]):.4g} Hz{on_average(seconds[unit])}"
        evidence = f"{what}steps of {step:.6g}, so {unit} at {rate}{''.join(others)}"
        return Guess({"unit": unit}, evidence, seconds[unit])
    return Guess({"unit": TO_DECIDE}, f"steps of {step:g} suit no unit of time: s, ms, us or ns?")


def even_steps(values: Values) -> bool:
    """Return whether numbers grow evenly with the rows, like times and counters."""
    line = np.linspace(values[0], values[-1], len(values))
    return bool(np.ptp(values) > 0.0 and np.abs(values - line).max() < MAX_LINE_DEPARTURE * np.ptp(values))


def temperature_counts(span: str, sensor: str) -> Guess:
    """Return the entry of a temperature in counts; its scale and offset are only in the data sheet of the sensor."""
    known = MPU60X0_TEMPERATURE if sensor.startswith("mpu60") else dict.fromkeys(MPU60X0_TEMPERATURE, TO_DECIDE)
    evidence = (
        f"whole numbers {span}, so counts: degC = (counts - offset) / counts_per_unit, both in the data sheet "
        "(MPU-6000 and MPU-6050: degC = counts / 340 + 36.53, so counts_per_unit: 340, offset: -12420.2)"
    )
    return Guess({"unit": COUNTS, **known}, evidence)


def unit_of_turn(turn: float) -> str:
    """Return the unit of angle in which this is a turn; empty for a number of counts."""
    return next((unit for unit, size in TURN_OF.items() if turn == size), "")


class Evidence:
    """What decides the units that the names of columns do not state: here the size of the numbers alone.

    A subclass that knows more, such as the rotation of gravity, is passed to ``propose``. ``sensor``: name of the
    sensor model, empty if it is not known.
    """

    sensor = ""

    def force_unit(self, force: Values, time_s: Values | None) -> Guess:  # noqa: ARG002  (of subclasses)
        """Return the unit of an (n, 3) specific force; ``time_s``: of its rows, None if it is not known."""
        size = float(np.median(np.linalg.norm(force, axis=1)))
        where = f"|a| is {size:.4g} on the whole"
        if not whole(force):
            return force_by_size(size, where)
        return Guess({"unit": COUNTS, "counts_per_unit": TO_DECIDE}, f"whole numbers, {where}: counts of the sensor")

    def rate_unit(self, parts: Sequence[Columns], force: Values | None, rate: Values, time_s: Values | None) -> Guess:  # noqa: ARG002
        """Return the unit of (n, 3) angular rates; ``force``: in the same rows, without its offset."""
        largest = float(np.abs(rate - np.median(rate, axis=0)).max())
        if whole(rate):
            unknown = {"unit": COUNTS, "counts_per_unit": TO_DECIDE}
            return Guess(unknown, f"whole numbers up to {largest:.4g}: counts of the sensor")
        return rate_by_size(largest, "nothing shows the unit", guessed=any(c.guessed for c in parts))

    def find_encoder(
        self, parts: Sequence[Columns], force: Values | None, rate_dps: Values | None, time_s: Values | None
    ) -> None:
        """Find the column of a table's encoder in ``parts``, whose columns of channels it may add to."""

    def remarks(self, force: Guess) -> list[str]:  # noqa: ARG002  (of subclasses)
        """Return remarks on the unit of the specific force."""
        return []


def force_by_size(size: float, where: str) -> Guess:
    """Return the unit of a specific force that is no whole number, by its size; ``where``: the size in words."""
    for unit, gravity in FORCE_UNITS.items():
        if abs(size / gravity - 1) < LOW_COST_ERROR:
            return Guess({"unit": unit}, f"{where}, so {unit}")
    return Guess({"unit": TO_DECIDE}, f"{where}, which is neither 1 (g), 9.8 (m/s^2) nor 1000 (mg)")


def rate_by_size(largest: float, otherwise: str, *, guessed: bool) -> Guess:
    """Return the unit of angular rates that are no whole numbers, by the largest of them.

    ``guessed``: whether the columns may hold something else, such as angles.
    """
    if largest > TOO_FAST_FOR_RADIANS and not guessed:
        return Guess({"unit": "deg/s"}, f"up to {largest:.4g}, too fast for rad/s, so deg/s")
    return Guess({"unit": TO_DECIDE}, f"up to {largest:.4g}; {otherwise}: deg/s or rad/s?")
