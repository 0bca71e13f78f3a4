"""Plan the recordings of a procedure: the program of the table, or the attitudes and moves by hand, for each.

``three_axis_turns`` and ``thermal_ramp`` (Sudsanguan 2019, chapter 4): about each axis, stop-and-go or continuous turns
for the accelerometer, turns at one or several rates between rests for the gyroscope; then held-out random motion and a
long rest. ``orientations_24`` (Sudsanguan 2018): eight rests 45 deg apart about each axis. ``six_positions``: each axis
up and down. ``multi_position``: rests in random attitudes. ``ferraris``: six faces up, then turns about each axis.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise, product
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import ConfigurationError
from pipeline.io.commanded_motion import Program
from pipeline.records import AXES
from pipeline.simulation.rate_table import rest, turn, turn_with_plateau
from pipeline.simulation.trajectory import (
    Gimbals,
    Moves,
    Planned,
    Turn,
    axis_and_angle,
    orientations_24,
    random_attitudes,
    random_gimbals,
    rotation_by,
    six_positions,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pipeline.records import Values


ONE_RECORDING, FERRARIS = "one_recording", "ferraris"
AGAIN = 0.1  # of a face's tilt: difference between two rests on the same face
TRANSIT = "transit"  # name and role of a move between recordings
TRANSIT_RATE_DPS = 20.0  # as between stops
LEAST_ANGLE_DEG = 1e-6  # below it nothing moves: rounding
TABLE_PROCEDURES = ("three_axis_turns", "thermal_ramp", ONE_RECORDING)
ABOVE_ZERO = (
    "step_deg", "dwell_s", "accelerometer_rates_dps", "rates_dps", "turns", "acceleration_dps2", "step_rate_dps",
    "validation_rate_dps",
)  # fmt: skip
ZERO_OR_MORE = (
    "warm_up_rest_s", "rest_s", "validation_s", "static_s", "pause_s", "thermal_ramp_degc",
    "turn_error_deg", "turn_axis_error_deg",
)  # fmt: skip
STEPS_DEG = (1.0, 2.0, 3.0, 5.0, 10.0, 15.0, 30.0, 45.0, 90.0)  # divisors of a turn


@dataclass(frozen=True)
class Course:
    """How a procedure is run."""

    step_deg: float = 5.0  # of stop-and-go
    dwell_s: float = 1.0  # rest at each stop, orientation or position
    accelerometer_rates_dps: tuple[float, ...] = ()  # continuous turns instead of stop-and-go
    rates_dps: tuple[float, ...] = (60.0,)  # of the gyroscope's turns
    both_directions: bool = False  # each turn of the gyroscope and each continuous one is also made backwards
    turns: int = 1  # whole turns at each rate
    warm_up_rest_s: float = 30.0  # before the first turn of a recording for the gyroscope
    rest_s: float = 3.0  # after each turn
    acceleration_dps2: float = 100.0  # of the table
    step_rate_dps: float = 20.0  # of the table between stops
    validation_s: float = 120.0  # length of held-out motion; 0: none
    validation_rate_dps: float = 40.0  # largest |rate| in it
    static_s: float = 120.0  # length of the long rest; 0: none
    pause_s: float = 30.0  # between recordings, and before the first
    positions: int = 40  # rests of multi_position
    thermal_ramp_degc: float = 15.0  # amplitude of the chamber's ramp in thermal_ramp
    turn_error_deg: float = 3.0  # by hand in ferraris, standard deviation of the total angle of each turn
    turn_axis_error_deg: float = 1.5  # and of each of the two angles between a body axis and the turns about it

    def __post_init__(self) -> None:
        for name in ABOVE_ZERO:
            value = getattr(self, name)
            if not all(v > 0.0 for v in (value if isinstance(value, tuple) else (value,))):
                raise ConfigurationError(f"course: {name} is {value}; it must be above 0")
        for name in ZERO_OR_MORE:
            if not getattr(self, name) >= 0.0:
                raise ConfigurationError(f"course: {name} is {getattr(self, name)}; it cannot be below 0")
        if not self.rates_dps or self.positions < 2 or self.step_deg > 360.0:
            raise ConfigurationError(
                "course: give at least one rate in rates_dps, 2 positions, and steps up to 360 deg"
            )

    @property
    def signs(self) -> tuple[float, ...]:
        """Directions of the turns at each rate."""
        return (1.0, -1.0)[: 1 + self.both_directions]


def plan(procedure: str, course: Course, rng: np.random.Generator, hand_accuracy: float = 0.0) -> list[Planned]:
    """Return the recordings of a procedure, in the order in which they are made.

    Without a table, attitudes are set with the standard deviation ``hand_accuracy``, deg. Raises ``ConfigurationError``
    if there is no such procedure.
    """
    if procedure in TABLE_PROCEDURES:
        planned = _turns(course) + _heldout(course, rng)
        return _with_transits(planned, course) if procedure == ONE_RECORDING else planned
    attitudes: dict[str, Callable[[], Values]] = {
        "orientations_24": orientations_24,
        "six_positions": six_positions,
        "multi_position": lambda: random_attitudes(course.positions, rng),
    }
    if procedure not in {*attitudes, FERRARIS}:
        known = ", ".join((*TABLE_PROCEDURES, *attitudes, FERRARIS))
        raise ConfigurationError(f"no procedure is called {procedure!r}; known: {known}")
    if procedure == FERRARIS:
        motion = _faces_and_turns(course, rng, hand_accuracy)
    else:
        motion = _rests(attitudes[procedure](), course, rng, hand_accuracy)
    planned = [Planned("recording", "rests", None, motion)]
    if course.validation_s > 0.0:
        count = max(2, int(course.validation_s / (course.dwell_s + 2.0)))
        held_out = _rests(random_attitudes(count, rng), replace(course, warm_up_rest_s=0.0), rng, 0.0)
        planned.append(Planned("validation", "validation", None, held_out))
    return planned + _static(course)


@cache
def fit_to_samples(procedure: str, course: Course, samples: int, interval: float, *, keep_step: bool) -> Course:
    """Scale the dwells, rests and held-out motion of a course so that a unit has about ``samples`` rows.

    Unless ``keep_step``, a short recording may use a larger step of stop-and-go. ``interval``: s. Raises
    ``ConfigurationError`` if the procedure cannot be run in so few samples.
    """
    target = samples * interval

    def stretched(step: float, factor: float) -> Course:
        stretch = {
            name: factor * getattr(course, name)
            for name in ("dwell_s", "rest_s", "warm_up_rest_s", "validation_s", "static_s")
        }
        return replace(course, step_deg=step, **stretch)

    def length(candidate: Course) -> float:
        return sum(p.trajectory.duration for p in plan(procedure, candidate, np.random.default_rng(0)))

    least = float("inf")
    for step in (course.step_deg,) if keep_step else [s for s in STEPS_DEG if s >= course.step_deg]:
        low, high = (length(stretched(step, f)) for f in (0.5, 1.0))
        factor = 1.0 + (target - high) / (2.0 * (high - low))
        least = min(least, low)
        if factor >= 0.5:
            return stretched(step, factor)
    raise ConfigurationError(
        f"{procedure} cannot be recorded in {samples} samples at {interval} s; "
        f"ask for at least {int(np.ceil(least / interval))}, or for larger steps or higher rates"
    )


def _turns(course: Course) -> list[Planned]:
    accelerometer = [Planned(f"accel_{a}", "accelerometer", i, _accelerometer(i, course)) for i, a in enumerate(AXES)]
    turns = [_continuous(i, course, course.warm_up_rest_s, course.rates_dps) for i in range(3)]
    gyroscope = [Planned(f"gyro_{a}", "gyroscope", i, t) for i, (a, t) in enumerate(zip(AXES, turns, strict=True))]
    return accelerometer + gyroscope


def _accelerometer(axis: int, course: Course) -> Turn:
    if course.accelerometer_rates_dps:
        return _continuous(axis, course, course.rest_s, course.accelerometer_rates_dps)
    stay, step = rest(course.dwell_s), turn(course.step_deg, course.step_rate_dps, course.acceleration_dps2)
    return Turn(axis, Program([stay, *[step, stay] * round(360.0 / course.step_deg)]))


def _continuous(axis: int, course: Course, before_s: float, rates: Sequence[float]) -> Turn:
    """Return turns at full rates about an axis, after a rest of ``before_s``."""
    steps = [rest(before_s)]
    for rate, sign in product(rates, course.signs):
        steps += [turn_with_plateau(sign * 360.0 * course.turns, rate, course.acceleration_dps2), rest(course.rest_s)]
    return Turn(axis, Program(steps))


def _heldout(course: Course, rng: np.random.Generator) -> list[Planned]:
    if course.validation_s <= 0.0:
        return _static(course)
    motion = random_gimbals(course.validation_s, course.validation_rate_dps, rng)
    return [Planned("validation", "validation", None, motion), *_static(course)]


def _static(course: Course) -> list[Planned]:
    if course.static_s <= 0.0:
        return []
    return [Planned("static", "static", None, Moves(Program([rest(course.static_s)]), np.eye(3)[:1]))]


def _rests(attitudes: Values, course: Course, rng: np.random.Generator, accuracy: float) -> Moves:
    """Return rests in the attitudes, with a setting error of ``accuracy`` deg, and the shortest moves between them."""
    attitudes = attitudes @ rotation_by(accuracy * rng.standard_normal((len(attitudes), 3)))
    steps, axes = [rest(max(course.warm_up_rest_s, course.dwell_s))], []
    for before, after in pairwise(attitudes):
        axis, angle = axis_and_angle(before.T @ after)
        steps += [turn(angle, course.step_rate_dps, course.acceleration_dps2), rest(course.dwell_s)]
        axes.append(axis)
    return Moves(Program(steps), np.array(axes), attitudes[0])


def _with_transits(planned: Sequence[Planned], course: Course) -> list[Planned]:
    """Insert transits between recordings: half a pause, the move to the start of the next one, half a pause.

    Held-out motion begins and ends at rest here; in a separate file it begins and ends in motion.
    """
    planned = [replace(p, trajectory=p.trajectory.eased()) if isinstance(p.trajectory, Gimbals) else p for p in planned]
    out = [planned[0]]
    for one, two in pairwise(planned):
        ends = (one.trajectory, one.trajectory.duration), (two.trajectory, 0.0)
        before, after = (motion.pose(np.array([time])).level[0] for motion, time in ends)
        axis, angle = axis_and_angle(before.T @ after)
        steps = [rest(course.pause_s / 2)]
        if angle > LEAST_ANGLE_DEG:
            steps += [turn(angle, TRANSIT_RATE_DPS, course.acceleration_dps2), rest(course.pause_s / 2)]
        out += [Planned(TRANSIT, TRANSIT, None, Moves(Program(steps), axis[None], before)), two]
    return out


def _faces_and_turns(course: Course, rng: np.random.Generator, accuracy: float) -> Moves:
    """Return rests on six faces, then turns about each axis with its face up; with fixed errors of each."""
    positions, tilt = six_positions(), accuracy * rng.standard_normal((6, 3))
    off = np.radians(course.turn_axis_error_deg) * rng.standard_normal((3, 3)) * (1.0 - np.eye(3))
    acceleration, stay = course.acceleration_dps2, rest(course.dwell_s)
    steps = [rest(max(course.warm_up_rest_s, course.dwell_s))]
    axes: list[Values] = []
    start = attitude = positions[0] @ rotation_by(tilt[0])
    upward = [int(np.argmax(positions[:, 2, axis])) for axis in range(3)]
    for face, axis in [*((f, None) for f in range(1, 6)), *zip(upward, range(3), strict=True)]:
        target = positions[face] @ rotation_by(tilt[face] + AGAIN * accuracy * rng.standard_normal(3))
        about, angle = axis_and_angle(attitude.T @ target)
        steps += [turn(angle, course.step_rate_dps, acceleration), stay]
        axes += [about] * bool(angle)
        attitude = target
        for rate, sign in product(course.rates_dps, course.signs) if axis is not None else ():
            about = (np.eye(3)[axis] + off[axis]) / np.linalg.norm(np.eye(3)[axis] + off[axis])
            angle = sign * 360.0 * course.turns + course.turn_error_deg * float(rng.standard_normal())
            steps += [turn(angle, rate, acceleration), stay]
            axes.append(about)
            attitude = attitude @ rotation_by(angle * about)
    return Moves(Program(steps), np.array(axes), start)
