"""Guess the units of the numbers in an unknown log from its motion, each with its evidence (``imu_logs.guesses``).

specific force : |f| at rest is 1 in g, 9.8 in m/s^2, 1000 in mg; in counts, it is the number of counts per g
angular rate   : the unit in which the integrated rates rotate gravity from rest to rest (``axis_maps``)
encoder        : gravity turns with the table, f = c + a cos(2 pi n / N) + b sin(2 pi n / N), with N counts per turn,
                 360 for degrees; about a vertical shaft, the gyroscope determines N to within its scale factor
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from imu_logs import proposal
from imu_logs.columns import LOW_COST_ERROR, NO_SENSOR, OFFSETS, Columns, UnknownLog, stated_unit, whole, words_of
from imu_logs.guesses import (
    ASSUMED_HZ,
    CENTIDEGREES,
    OF_SENSOR,
    TO_DECIDE,
    TURN_OF,
    Evidence,
    Guess,
    even_steps,
    force_by_size,
    rate_by_size,
    unit_of_turn,
)
from imu_logs.proposal import Proposal
from imu_logs.units import COUNTS, DEGREES, FORCE_UNITS, UNITS
from imu_logs.yaml_file import read_yaml
from pipeline.core.files import CONFIGS
from pipeline.core.records import Values
from pipeline.core.settings import Sensor
from pipeline.ingest.quality_flags import MoveByHand, interval_of, misfit_deg, moves_of, rests_of

CLOSE_BY_TABLE = 0.05  # scale factor of a low-cost sensor (MPU-6050: 3 %), and misalignment on the table
SLOWEST = 1.0  # deg/s rms of a table: below, noise and bias wander are larger
LARGEST_RESIDUAL = 0.3  # rms of the rates after the fit of the table's rate, of before: misalignment and noise
CLOSE_BY_TURNS = 0.2  # bias and scale factor of both sensors, in few moves
# 2, 4, 8, 16 g in 16 bits, and 12 or 10 bits; Empatica's E4 has 8 bits.
USUAL_COUNTS_PER_G = (16384.0, 8192.0, 4096.0, 2048.0, 1024.0, 256.0, 64.0)
# 16 bits for 250, 500, 1000, 2000, 4000 deg/s (InvenSense, Bosch); whole mdps (drivers of STMicroelectronics).
USUAL_COUNTS_PER_DPS = (131.0, 65.5, 32.8, 16.4, 8.2, 1000.0)
LARGEST_COUNT = 2.0**23  # of converters with 24 bits
COUNT_GRID = np.geomspace(1.0, 1000.0, 481)  # grid of counts per deg/s, in steps of 1.4 %
# A known factor is taken in place of the fitted one up to this misfit, or times that of the fitted one: a scale factor
# that is off by 3 % (MPU-6050) turns gravity by 5 deg too much in half a turn.
USUAL_FITS_DEG, USUAL_FITS = 5.0, 2.0
SAME_FACTOR = 0.01  # relative: 131 and 131.2, as data sheets round 32768 / 250
CONVINCING_DEG = 12.0  # below half of the residual angle of the next usual scale in a quarter turn
FLATTEST = 0.1  # smallest over largest extent of rests in a plane: misalignment and scale factors are some percent
FEWEST_RESTS_FOR_A_SPHERE = 9  # twice the four unknowns, and one

NO_ENCODER = NO_SENSOR | {"roll", "pitch", "yaw", "heading", "tilt", "quat"}  # estimates of a sensor, as angle_x
# Counts per turn of encoders: 8 to 20 bits, and usual numbers of lines, once, twice and four times.
ENCODERS = (
    *(2**bits for bits in range(8, 21)),
    *(k * n for n in (500, 600, 900, 1000, 1250, 2500, 9000) for k in (1, 2, 4)),
)
CLOSE_TURN = 0.01  # half of the least relative distance between two of them, except 4000 and 4096
LARGEST_MISFIT = 0.1  # of the fit of gravity, of the force's rms: misalignment, and a lag of the log by some ms
SHORTEST_TURN = 0.9  # of a turn; with half a turn, other columns could fit as an angle
SEARCHED = 0.1  # relative range about a usual number of counts, for numbers between them
MOST_FITTED = 20_000  # rows; limits the time


def force_unit(force: Values, interval_s: float) -> Guess:
    """Return the unit of an (n, 3) specific force."""
    rests = rests_of(force, interval_s)
    means = np.array([force[a:b].mean(axis=0) for a, b in rests])
    at_rest = np.concatenate([force[a:b] for a, b in rests]) if rests else force
    size = float(np.median(np.linalg.norm(at_rest, axis=1)))  # of samples: a slow turn can be detected as a rest
    where = f"|a| is {size:.4g} at rest" if rests else f"|a| is {size:.4g} on the whole"
    centre, radius = np.zeros(3), size
    if len(rests) >= FEWEST_RESTS_FOR_A_SPHERE:
        spread = np.linalg.svd(means - means.mean(axis=0), compute_uv=False)
        if spread[2] > FLATTEST * spread[0]:  # rests of turns about one axis lie in a plane, on many spheres
            centre, radius = sphere(means)
    counts = whole(force)
    guess = _counts_per_g(len(rests), centre, radius, size, where) if counts else force_by_size(size, where)
    return replace(guess, centre=centre)


def _counts_per_g(rests: int, centre: Values, radius: float, size: float, where: str) -> Guess:
    """Return the entry in counts per g: with a usual offset, with a close usual number, or with the median |a|."""
    middle = float(np.mean(centre))
    offset = min((0.0, *OFFSETS), key=lambda o: abs(middle - o))
    if offset and abs(middle - offset) > 0.5 * radius:
        offset = 0.0
    if offset:
        entry = {"unit": COUNTS, "counts_per_unit": float(f"{radius:.3g}"), "offset": offset}
        spread = f"{rests} rests lie on a sphere of radius {radius:.0f} about {middle:.0f}"
        return Guess(entry, f"whole numbers; {spread}, so counts with an offset of {offset:.0f}")
    usual = min((*USUAL_COUNTS_PER_G, FORCE_UNITS["mg"]), key=lambda c: abs(np.log(size / c)))
    if usual == FORCE_UNITS["mg"] and abs(size / usual - 1) < LOW_COST_ERROR:
        return Guess({"unit": "mg"}, f"whole numbers, {where}, so mg, or counts, 1024 a g")
    if abs(size / usual - 1) < LOW_COST_ERROR:
        entry = {"unit": COUNTS, "counts_per_unit": usual}
        return Guess(entry, f"whole numbers, {where}: counts, near the usual {usual:g} a g")
    if size > LARGEST_COUNT:
        entry = {"unit": COUNTS, "counts_per_unit": TO_DECIDE}
        return Guess(entry, f"whole numbers, {where}: more than 24 bits; did the numbers lose their decimal separator?")
    entry = {"unit": COUNTS, "counts_per_unit": float(f"{size:.3g}")}
    return Guess(entry, f"whole numbers, {where}: counts, {size:.3g} a g (no usual number)")


def sphere(points: Values) -> tuple[Values, float]:
    """Return centre and radius of the sphere through points, by linear least squares."""
    A = np.column_stack([2 * points, np.ones(len(points))])
    solution = np.linalg.lstsq(A, np.sum(points**2, axis=1), rcond=None)[0]
    centre = solution[:3]
    return centre, float(np.sqrt(max(solution[3] + centre @ centre, 0.0)))


def rate_unit(rate: Values, moves: Sequence[MoveByHand], why_none: str, *, timed: bool, guessed: bool) -> Guess:
    """Return the unit of (n, 3) angular rates from the ``moves`` between rests in which gravity turns.

    ``why_none``: the reason if there are no moves. Without a time (``timed`` False) an interval of 1 / ``ASSUMED_HZ``
    is assumed, and only the product of scale and sampling rate can be determined. ``guessed``: no name says that
    they are rates.
    """
    largest = float(np.abs(rate - np.median(rate, axis=0)).max())
    if whole(rate):
        offset = {"offset": 32768.0} if abs(float(np.median(rate)) - 32768.0) < 2000 else {}
        guess = _counts_per_dps(moves, f"whole numbers up to {largest:.4g}: counts; {why_none}", timed=timed)
        return replace(guess, entry=guess.entry | offset)
    if moves and timed:
        misfit = misfit_deg(moves, (1.0, DEGREES))
        best = int(np.argmin(misfit))
        unit = ("deg/s", "rad/s")[best]
        text = f"taken as {unit} they turn gravity to within {misfit[best]:.1f} deg over {len(moves)} moves"
        if misfit[best] > CONVINCING_DEG:
            return Guess({"unit": TO_DECIDE}, f"{text}, and no better otherwise: not convincing")
        return Guess({"unit": unit}, f"{text} (the other unit misses by {misfit[1 - best]:.0f} deg)")
    return rate_by_size(largest, why_none or "the time is not known", guessed=guessed)


def rate_unit_by_table(rate: Values, table_rate: Values) -> Guess | None:
    """Return the unit of (n, 3) angular rates from the table's rate, deg/s, in the same rows; None if they differ."""
    size = slope(rate, table_rate)
    if size is None or np.std(table_rate) < SLOWEST:
        return None
    seen = f"{size:.4g} a deg/s of the table's rate in the same rows"
    if whole(rate):
        entry, taken = _usual_counts(size, CLOSE_BY_TABLE)
        return Guess(entry, f"counts, {seen}{taken}")
    units = {"deg/s": 1.0, "rad/s": 1.0 / DEGREES}
    unit = next((u for u, one in units.items() if abs(size / one - 1) < CLOSE_BY_TABLE), TO_DECIDE)
    return Guess({"unit": unit}, f"{seen}, " + ("neither deg/s nor rad/s" if unit == TO_DECIDE else f"so {unit}"))


def slope(rate: Values, table: Values) -> float | None:
    """Return the length of (n, 3) rates per unit of the table's rate; None if they are not proportional to it."""
    table, centred = table - table.mean(), rate - rate.mean(axis=0)
    if not np.any(table):
        return None
    slopes = table @ centred / (table @ table)
    residual = centred - np.outer(table, slopes)
    if np.sum(residual**2) > LARGEST_RESIDUAL**2 * np.sum(centred**2):
        return None
    return float(np.linalg.norm(slopes))


def _usual_counts(measured: float, close: float) -> tuple[dict[str, Any], str]:
    """Return the entry of a gyroscope in counts, with the usual counts per deg/s if they are close, and a remark."""
    tables = factors_of_sensors(), USUAL_COUNTS_PER_DPS
    known, usual = (min(counts, key=lambda c: abs(np.log(measured / c))) for counts in tables)
    usual = usual if abs(usual / known - 1) < SAME_FACTOR else known
    if abs(measured / usual - 1) < close:
        return {"unit": COUNTS, "counts_per_unit": usual}, f"; {usual:g} is the usual number near it"
    return {"unit": COUNTS, "counts_per_unit": float(f"{measured:.3g}")}, ""


@cache
def factors_of_sensors() -> tuple[float, ...]:
    """Return the counts per deg/s of all ranges of the shipped sensors, and the usual ones."""
    found = set(USUAL_COUNTS_PER_DPS)
    for file in (CONFIGS / "sensor").glob("*.yaml"):
        figures = read_yaml(file).get("gyroscope") or {}
        found |= {float(counts) for counts in (figures.get("ranges") or {}).values() if counts}
    return tuple(sorted(found))


def _counts_per_dps(moves: Sequence[MoveByHand], otherwise: str, *, timed: bool) -> Guess:
    unknown = {"unit": COUNTS, "counts_per_unit": TO_DECIDE}
    if not moves:
        return Guess(unknown, otherwise)
    misfit = misfit_deg(moves, (1 / COUNT_GRID).tolist())
    best = int(np.argmin(misfit))
    measured, angle = float(COUNT_GRID[best]), misfit[best]
    if angle > CONVINCING_DEG:
        return Guess(unknown, f"counts; at best they turn gravity to within {angle:.0f} deg: not convincing")
    seen = f"so gravity turns to within {angle:.1f} deg over {len(moves)} move{'s'[: len(moves) > 1]}"
    if not timed:
        product = measured * ASSUMED_HZ
        listed = " or ".join(f"{c:g} at {product / c:.3g} Hz" for c in USUAL_COUNTS_PER_DPS if 50 < product / c < 1100)
        return Guess(unknown, f"counts_per_unit times the sampling rate in Hz is near {product:.3g} ({listed}), {seen}")
    entry, taken = _usual_counts(measured, CLOSE_BY_TURNS)
    usual = entry["counts_per_unit"]
    if taken and (missed := float(misfit_deg(moves, [1 / usual])[0])) > max(USUAL_FITS_DEG, USUAL_FITS * angle):
        entry, taken = {"unit": COUNTS, "counts_per_unit": float(f"{measured:.3g}")}, ""
        seen += f" (with the nearest factor of a known sensor, {usual:g}, to within {missed:.1f} deg)"
    return Guess(entry, f"counts, {measured:.3g} a deg/s, {seen}{taken}")


def counts_of_sensor(guess: Guess, name: str, sensor: Sensor | None) -> Guess:
    """Return a guess of counts that refers to the configuration of the sensor, if one is stated."""
    figure = OF_SENSOR.format(name)
    if sensor is None:
        text = f'{guess.evidence}; "{figure}" takes counts_per_unit from the configuration of the sensor and its range'
        return Guess(guess.entry, text)
    text = f"{guess.evidence}; counts_per_unit is that of sensor={sensor.name}, {sensor.of(name).counts_per_unit:g}:"
    text += f" sensor.{name}.range must be the range that the logger sets"
    return Guess({**guess.entry, "counts_per_unit": figure}, text)


def _is_estimate(words: Sequence[str]) -> bool:
    """Return whether a name is that of an angle which was computed from the readings, such as AngleX."""
    return bool(set(words) & NO_ENCODER) or ("angle" in words and bool(set(words) & {*"xyz"}))


def unit_by_table(columns: Columns, rate: Values, time_s: Values | None) -> Guess | None:
    """Return the unit of the gyroscope from the table's rate, or the slope of its angle, in the same rows."""
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
    """Return the counts per turn of an encoder that starts again at each turn; None if they cannot be determined."""
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
    """Return the counts per turn of an encoder, or a turn in deg or rad, and the evidence; None if undetermined.

    They follow from gravity, f = c + a cos(2 pi n / N) + b sin(2 pi n / N), or from the slope of the counts over the
    rate of the gyroscope, (n, 3) in deg/s, to within its scale factor.
    """
    if even_steps(counts) or not np.any(np.diff(counts)):
        return None
    if force is not None:
        return _turn_by_gravity(counts, force)
    if rate_dps is None or time_s is None or not np.all(np.diff(time_s) > 0):
        return None
    for turn in TURN_OF.values():
        speed = np.gradient(np.unwrap(counts, period=turn), time_s)
        size = slope(rate_dps, speed)
        if size and size * np.std(speed) > SLOWEST and abs(turn * size / 360.0 - 1.0) < CLOSE_BY_TABLE:
            return turn, f"the gyroscope turns once in {360.0 / size:.4g} {unit_of_turn(turn)}"
    speed = np.gradient(counts, time_s)
    size = slope(rate_dps, speed) if whole(counts) else None
    if size is None or size * np.std(speed) < SLOWEST:
        return None
    usual = sorted(ENCODERS, key=lambda n: abs(np.log(n * size / 360.0)))
    near = [n for n in usual if abs(n * size / 360.0 - 1.0) < CLOSE_BY_TABLE]
    seen = f"the gyroscope turns once in {360.0 / size:.4g} counts"
    others = f" (check it: or {' or '.join(map(str, near[1:]))})" if len(near) > 1 else ""
    return (near[0], f"{seen}{others}") if near else (float(f"{360.0 / size:.4g}"), f"{seen} (no usual number)")


def _turn_by_gravity(counts: Values, force: Values) -> tuple[float, str] | None:
    counted = whole(counts)  # any number of counts may be a turn, of an angle in deg or rad only one
    known = (*TURN_OF.values(), *(ENCODERS if counted else ()))
    step = -(-len(counts) // MOST_FITTED)
    counts, force = counts[::step] - counts[0], force[::step]
    power = float(np.sum((force - force.mean(axis=0)) ** 2))
    if power < LARGEST_RESIDUAL**2 * float(np.sum(force**2)):
        return None  # gravity does not turn

    def misfit(turn: float) -> float:
        phase = 2.0 * np.pi * counts / turn
        A = np.column_stack([np.ones(len(phase)), np.cos(phase), np.sin(phase)])
        return float(np.sqrt(np.sum((force - A @ np.linalg.lstsq(A, force, rcond=None)[0]) ** 2) / power))

    usual = min((n for n in known if n * SHORTEST_TURN < np.ptp(counts)), key=misfit, default=None)
    if usual is None:
        return None
    bounds = (usual * (1.0 - SEARCHED), usual * (1.0 + SEARCHED))
    measured = float(minimize_scalar(misfit, bounds=bounds, method="bounded").x)
    if min(misfit(measured), misfit(usual)) > LARGEST_MISFIT:
        return None
    unit = unit_of_turn(usual)
    seen = f"gravity turns once in {measured:.4g} {unit or 'counts'}, to within {misfit(measured):.1%}"
    if misfit(usual) < LARGEST_MISFIT and abs(measured / usual - 1.0) < CLOSE_TURN:
        return (usual, seen) if unit else (usual, f"{seen}; {usual} is the usual number near it")
    if unit or not counted:
        return None
    return float(f"{measured:.4g}"), f"{seen} (no usual number)"


class ByMotion(Evidence):
    """The units by the motion of the log: gravity at rest, its rotation, a table's encoder, and the sensor's file."""

    def __init__(self, model: Sensor | None = None) -> None:
        self.model, self.sensor = model, model.name if model else ""

    def force_unit(self, force: Values, time_s: Values | None) -> Guess:
        """Return the unit of an (n, 3) specific force, from its size at rest."""
        return force_unit(force, interval_of(np.diff(time_s)) if time_s is not None else 1 / ASSUMED_HZ)

    def rate_unit(self, parts: Sequence[Columns], force: Values | None, rate: Values, time_s: Values | None) -> Guess:
        """Return the unit of the rates from the table, from gravity, or, for counts, from the configuration."""
        moves, why_none = list[MoveByHand](), "no accelerometer in the log that determines the unit"
        if force is not None and not parts[0].steady:
            why_none = "the rows are not one series in time, so the turns of gravity do not determine the unit"
        elif force is not None:
            moves = moves_of(force, rate, time_s if time_s is not None else np.arange(len(rate)) / ASSUMED_HZ)
            why_none = "" if moves else "no move between rests rotates gravity, which would show the unit"
        columns = next(c for c in parts if "gyroscope" in c.triads)
        guess = unit_by_table(columns, rate, time_s)
        guess = guess or rate_unit(rate, moves, why_none, timed=time_s is not None, guessed=columns.guessed)
        if guess.entry["unit"] == COUNTS and guess.entry["counts_per_unit"] == TO_DECIDE:
            return counts_of_sensor(guess, "gyroscope", self.model)
        return guess

    def find_encoder(
        self, parts: Sequence[Columns], force: Values | None, rate_dps: Values | None, time_s: Values | None
    ) -> None:
        """Find the counts per turn of the named encoder, else a column that counts the turns of the readings."""
        for columns in parts:
            numbers, names = columns.log.numbers, columns.log.names
            named = columns.others.get("table_angle")
            if columns.turn or (named is not None and stated_unit(names[named], "table_angle")[0]):
                continue
            if named is not None and (turn := counts_a_turn(numbers[named])):
                columns.turn = turn, f"starts again after {turn} counts"
                continue
            free = [i for i in columns.free() if not _is_estimate(words_of(names[i]))]
            free.sort(key=lambda i: not whole(numbers[i]))  # counts are of an encoder, an angle may be an estimate
            turns = (
                (i, _encoder_turn(numbers[i], force, rate_dps, time_s)) for i in (free if named is None else [named])
            )
            index, columns.turn = next(((i, turn) for i, turn in turns if turn), (named, None))
            if columns.turn and index is not None:
                columns.others["table_angle"] = index
                what = names[index] + " is taken as the table's encoder by its numbers" * (named is None)
                remark = "check counts and sign, and add offset, the count at angle 0"
                if unit_of_turn(columns.turn[0]):
                    remark = "check sign and unit, and leave it out if it is an estimate from the same readings"
                columns.remarks.append(f"{what}: {remark}")

    def remarks(self, force: Guess) -> list[str]:
        """Return a remark if the accelerometer's counts differ from those of the stated sensor."""
        seen, stated = force.entry.get("counts_per_unit"), self.model and self.model.accelerometer.counts_per_unit
        if not seen or not stated or abs(seen / stated - 1) < LOW_COST_ERROR:
            return []
        where = "sensor.accelerometer.range, and sensor.gyroscope.range"
        return [f"sensor={self.sensor} states {stated:g} counts a g: set {where}, as the logger does"]


def propose(logs: Sequence[UnknownLog], model: Sensor | None = None) -> list[Proposal]:
    """Return a proposal for each layout among the logs (``imu_logs.proposal``); ``model``: of the sensor, if stated."""
    return proposal.propose(logs, ByMotion(model))
