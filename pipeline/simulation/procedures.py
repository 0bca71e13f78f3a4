"""Plan the recordings of a procedure: the program of the table, or the attitudes and moves by hand, for each.

``three_axis_turns`` and ``thermal_ramp`` (Sudsanguan 2019, chapter 4): about each axis, stop-and-go or continuous turns
for the accelerometer, turns at one or several rates between rests for the gyroscope; then held-out random motion and a
long rest. ``orientations_24`` (Sudsanguan 2018): eight rests 45 deg apart about each axis. ``six_positions``: each axis
up and down. ``multi_position``: rests in random attitudes. ``ferraris``: six faces up, then turns about each axis.
"""

from __future__ import annotations

from dataclasses import fields, replace
from functools import cache
from itertools import pairwise, product
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import ConfigDict, Field, ModelWrapValidatorHandler, ValidationError, model_validator
from pydantic.dataclasses import dataclass

from pipeline.core.errors import ConfigurationError
from pipeline.core.records import AXES
from pipeline.ingest.commanded_motion import Program
from pipeline.simulation.trajectory import (
    CommandedTurns,
    Gimbals,
    Planned,
    RestsAndMoves,
    axis_and_angle,
    orientations_24,
    random_attitudes,
    random_gimbals,
    rest,
    rotation_by,
    six_positions,
    turn,
    turn_with_plateau,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pipeline.core.records import Values


ONE_RECORDING, FERRARIS = "one_recording", "ferraris"
AGAIN = 0.1  # of a face's tilt: difference between two rests on the same face
TRANSIT = "transit"  # name and role of a move between recordings
TRANSIT_RATE_DPS = 20.0  # as between stops
LEAST_ANGLE_DEG = 1e-6  # below it nothing moves: rounding
TABLE_PROCEDURES = ("three_axis_turns", "thermal_ramp", ONE_RECORDING)
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
STEPS_DEG = (1.0, 2.0, 3.0, 5.0, 10.0, 15.0, 30.0, 45.0, 90.0)  # divisors of a turn


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Described:
    """A part of the description of a simulation; an invalid value raises ``ConfigurationError``."""

    PART: ClassVar[str] = ""  # its name in messages

    @model_validator(mode="wrap")
    @classmethod
    def _refuse(cls, given: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:  # noqa: ANN401
        try:
            return handler(given)
        except ValidationError as errors:
            error = errors.errors()[0]
        key, where = ".".join(map(str, error["loc"])), cls.PART and f"{cls.PART}: "
        if error["type"] == "unexpected_keyword_argument":
            known = ", ".join(sorted(f.name for f in fields(cls)))
            raise ConfigurationError(f"{where}{key} is not known; known: {known}")
        if error["type"] == "missing":
            raise ConfigurationError(f"{where}{key} is missing")
        reason = error["msg"].replace("Input should be", "it must be")
        raise ConfigurationError(f"{where}{key} is {error['input']!r}; {reason[0].lower()}{reason[1:]}")


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Course(Described):
    """How a procedure is run."""

    PART: ClassVar[str] = "course"

    step_deg: Annotated[Positive, Field(le=360.0)] = 5.0  # of stop-and-go
    dwell_s: Positive = 1.0  # rest at each stop, orientation or position
    accelerometer_rates_dps: tuple[Positive, ...] = ()  # continuous turns instead of stop-and-go
    rates_dps: Annotated[tuple[Positive, ...], Field(min_length=1)] = (60.0,)  # of the gyroscope's turns
    both_directions: bool = False  # each turn of the gyroscope and each continuous one is also made backwards
    turns: Annotated[int, Field(ge=1)] = 1  # whole turns at each rate
    warm_up_rest_s: NonNegative = 30.0  # before the first turn of a recording for the gyroscope
    rest_s: NonNegative = 3.0  # after each turn
    acceleration_dps2: Positive = 100.0  # of the table
    step_rate_dps: Positive = 20.0  # of the table between stops
    validation_s: NonNegative = 120.0  # length of held-out motion; 0: none
    validation_rate_dps: Positive = 40.0  # largest |rate| in it
    static_s: NonNegative = 120.0  # length of the long rest; 0: none
    pause_s: NonNegative = 30.0  # between recordings, and before the first
    positions: Annotated[int, Field(ge=2)] = 40  # rests of multi_position
    thermal_ramp_degc: NonNegative = 15.0  # amplitude of the chamber's ramp in thermal_ramp
    turn_error_deg: NonNegative = 3.0  # by hand in ferraris, standard deviation of the total angle of each turn
    turn_axis_error_deg: NonNegative = 1.5  # and of each of the two angles between a body axis and the turns about it

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
        planned = _turns(course)
        if course.validation_s > 0.0:
            motion = random_gimbals(course.validation_s, course.validation_rate_dps, rng)
            planned.append(Planned("validation", "validation", None, motion))
        planned += _static(course)
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
        moves = _faces_and_turns(course, rng, hand_accuracy)
    else:
        moves = _rests(attitudes[procedure](), course, rng, hand_accuracy)
    planned = [Planned("recording", "rests", None, moves)]
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
    """Return the turns about each axis: for the accelerometer, then for the gyroscope."""
    stay, step = rest(course.dwell_s), turn(course.step_deg, course.step_rate_dps, course.acceleration_dps2)
    stops = Program([stay, *[step, stay] * round(360.0 / course.step_deg)])
    rates = course.accelerometer_rates_dps
    accelerometer = [
        _continuous(i, course, course.rest_s, rates) if rates else CommandedTurns(i, stops) for i in range(3)
    ]
    gyroscope = [_continuous(i, course, course.warm_up_rest_s, course.rates_dps) for i in range(3)]
    return [
        Planned(f"{prefix}_{AXES[turn.axis]}", role, turn.axis, turn)
        for prefix, role, turns in (("accel", "accelerometer", accelerometer), ("gyro", "gyroscope", gyroscope))
        for turn in turns
    ]


def _continuous(axis: int, course: Course, before_s: float, rates: Sequence[float]) -> CommandedTurns:
    """Return turns at full rates about an axis, after a rest of ``before_s``."""
    steps = [rest(before_s)]
    for rate, sign in product(rates, course.signs):
        steps += [turn_with_plateau(sign * 360.0 * course.turns, rate, course.acceleration_dps2), rest(course.rest_s)]
    return CommandedTurns(axis, Program(steps))


def _static(course: Course) -> list[Planned]:
    if course.static_s <= 0.0:
        return []
    return [Planned("static", "static", None, RestsAndMoves(Program([rest(course.static_s)]), np.eye(3)[:1]))]


def _rests(attitudes: Values, course: Course, rng: np.random.Generator, accuracy: float) -> RestsAndMoves:
    """Return rests in the attitudes, with a setting error of ``accuracy`` deg, and the shortest moves between them."""
    attitudes = attitudes @ rotation_by(accuracy * rng.standard_normal((len(attitudes), 3)))
    steps, axes = [rest(max(course.warm_up_rest_s, course.dwell_s))], []
    for before, after in pairwise(attitudes):
        axis, angle = axis_and_angle(before.T @ after)
        steps += [turn(angle, course.step_rate_dps, course.acceleration_dps2), rest(course.dwell_s)]
        axes.append(axis)
    return RestsAndMoves(Program(steps), np.array(axes), attitudes[0])


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
        out += [Planned(TRANSIT, TRANSIT, None, RestsAndMoves(Program(steps), axis[None], before)), two]
    return out


def _faces_and_turns(course: Course, rng: np.random.Generator, accuracy: float) -> RestsAndMoves:
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
    return RestsAndMoves(Program(steps), np.array(axes), start)
