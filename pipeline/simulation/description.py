"""Read the description of a simulation, ``simulation.yaml``, and plan the recordings of its procedures.

    seed: 2019                       # every number follows from it
    defaults: {...}                  # keys of a unit, for all units
    units:
      - unit: U1                     # with count: 100, U1 is a prefix: U1001 .. U1100
        sensor: mpu6050              # configs/sensor
        table: acutronic             # configs/table
        procedure: three_axis_turns
        ...
    variants:                        # every unit again, with the same recordings and other columns
      - {suffix: -staged, columns: {method: staged, filter: rc_low_pass}}
    rows: [...]                      # further rows of units.csv, for units that use the recordings of another unit

Parameters that are not stated are drawn at random from the sensor file. The keys of a unit are the attributes of
``UnitDescription``.

A recording has the program of the table, or the attitudes and moves by hand. The procedures:

``three_axis_turns`` and ``thermal_ramp`` (Sudsanguan 2019, chapter 4): about each axis, stop-and-go or continuous turns
for the accelerometer, turns at one or several rates between rests for the gyroscope; then held-out random motion and a
long rest. ``orientations_24`` (Sudsanguan 2018): eight rests 45 deg apart about each axis. ``six_positions``: each axis
up and down. ``multi_position``: rests in random attitudes. ``ferraris``: six faces up, then turns about each axis.
``listed``: the ``kinds`` of the course: a rest, rests and moves as in ``multi_position``, two turns about each axis,
one of them held out, and soaks in a thermal chamber, each in another attitude.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import field, fields, replace
from functools import cache
from itertools import pairwise, product
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import ConfigDict, Field, ModelWrapValidatorHandler, ValidationError, model_validator
from pydantic.dataclasses import dataclass

from imu_logs.yaml_file import read_yaml
from pipeline.core.errors import ConfigurationError, MissingInputError
from pipeline.core.files import CONFIGS
from pipeline.core.records import AXES, Values
from pipeline.core.settings import SECTIONS, Settings, completed
from pipeline.ingest.clock_alignment import Program
from pipeline.ingest.files import wrong_name
from pipeline.simulation import REST_BY_HAND_S
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

ONE_RECORDING, FERRARIS = "one_recording", "ferraris"
AGAIN = 0.1  # of a face's tilt: difference between two rests on the same face
TRANSIT = "transit"  # name and role of a move between recordings
TRANSIT_RATE_DPS = 20.0  # as between stops
LEAST_ANGLE_DEG = 1e-6  # below it nothing moves: rounding
OF_A_SHEET = "listed"  # the procedure
TABLE_PROCEDURES = ("three_axis_turns", "thermal_ramp", ONE_RECORDING)
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
STEPS_DEG = (1.0, 2.0, 3.0, 5.0, 10.0, 15.0, 30.0, 45.0, 90.0)  # divisors of a turn
FORMATS = ("csv", "mcap")
DESCRIPTION_KINDS = ("rows", "file", "program")
_, BY_FILE, BY_PROGRAM = DESCRIPTION_KINDS
UNITS_OF_A_LOT = 25  # for units that are described by a count: a round number
SAMPLING_BY_HAND_S = 0.1  # docs/record.md: 10 Hz or more, to find rests
RECORDED = ("sensor", "table", "procedure", "samples", "interval_s", "lost")


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
    thermal_ramp_degc: NonNegative = 15.0  # amplitude of the chamber's ramp in thermal_ramp and in each soak
    kinds: tuple[Literal["rest", "moves", "turn", "soak"], ...] = ("rest", "moves", "turn", "soak")  # of listed
    soaks: Annotated[int, Field(ge=1)] = 1  # attitudes in which listed soaks the unit
    soak_s: Positive = 3600.0  # length of each: up by the ramp, down below the room, and back
    turn_error_deg: NonNegative = 3.0  # by hand in ferraris, standard deviation of the total angle of each turn
    turn_axis_error_deg: NonNegative = 1.5  # and of each of the two angles between a body axis and the turns about it

    @property
    def signs(self) -> tuple[float, ...]:
        """Directions of the turns at each rate."""
        return (1.0, -1.0)[: 1 + self.both_directions]


def plan(procedure: str, course: Course, rng: np.random.Generator, hand_accuracy: float = 0.0) -> list[Planned]:
    """Return the recordings of a procedure, in the order in which they are made.

    ``hand_accuracy``: of attitudes without a table, standard deviation, deg. ``ConfigurationError``: no such procedure.
    """
    if procedure in TABLE_PROCEDURES:
        planned = _turns(course)
        if course.validation_s > 0.0:
            motion = random_gimbals(course.validation_s, course.validation_rate_dps, rng)
            planned.append(Planned("validation", "validation", None, motion))
        planned += _static(course)
        return _with_transits(planned, course) if procedure == ONE_RECORDING else planned
    if procedure == OF_A_SHEET:
        return _listed(course, rng, hand_accuracy)
    moves: dict[str, Callable[[], RestsAndMoves]] = {
        "orientations_24": lambda: _rests(orientations_24(), course, rng, hand_accuracy),
        "six_positions": lambda: _rests(six_positions(), course, rng, hand_accuracy),
        "multi_position": lambda: _rests(random_attitudes(course.positions, rng), course, rng, hand_accuracy),
        FERRARIS: lambda: _faces_and_turns(course, rng, hand_accuracy),
    }
    if procedure not in moves:
        known = ", ".join((*TABLE_PROCEDURES, *moves, OF_A_SHEET))
        raise ConfigurationError(f"no procedure is called {procedure!r}; known: {known}")
    planned = [Planned("recording", "rests", None, moves[procedure]())]
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
        names = ("dwell_s", "rest_s", "warm_up_rest_s", "validation_s", "static_s", "soak_s")
        stretch = {name: factor * getattr(course, name) for name in names}
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
    both = (("accel", "accelerometer", accelerometer), ("gyro", "gyroscope", gyroscope))
    return [Planned(f"{prefix}_{AXES[t.axis]}", role, t.axis, t) for prefix, role, turns in both for t in turns]


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


def _listed(course: Course, rng: np.random.Generator, accuracy: float) -> list[Planned]:
    """Return the recordings of a sheet: those of the course's ``kinds``."""
    planned, short = _static(course), replace(course, warm_up_rest_s=0.0)
    found = [replace(p, name="still", role="rests", row="rest") for p in planned if "rest" in course.kinds]
    if "moves" in course.kinds:
        moves = _rests(random_attitudes(course.positions, rng), short, rng, accuracy)
        found.append(Planned("moves", "rests", None, moves, "moves"))
    for axis, held_out in product(range(3), (False, True)) if "turn" in course.kinds else ():
        angle, off = 360.0 * course.turns, np.radians(course.turn_axis_error_deg) * rng.standard_normal(3)
        about = np.eye(3)[axis] + np.where(np.arange(3) == axis, 0.0, off)
        true = angle + course.turn_error_deg * float(rng.standard_normal())
        moved = turn(true, course.rates_dps[0], course.acceleration_dps2)
        steps = Program([rest(course.dwell_s), moved, rest(course.dwell_s)])
        trajectory = RestsAndMoves(steps, about[None] / np.linalg.norm(about), random_attitudes(1, rng)[0])
        row = f"turn,{AXES[axis]},{angle:g},{course.turn_error_deg or ''},{'yes' if held_out else ''}"
        name = f"turn_{AXES[axis]}{'_held_out' if held_out else ''}"
        found.append(Planned(name, "validation" if held_out else "rests", None, trajectory, row))
    soaked = six_positions()[: course.soaks] if course.soaks <= 6 else random_attitudes(course.soaks, rng)
    for number, attitude in enumerate(soaked if "soak" in course.kinds else (), 1):
        still = RestsAndMoves(Program([rest(course.soak_s)]), np.eye(3)[:1], attitude)
        found.append(Planned(f"soak_{number}", "rests", None, still, "soak"))
    return found


# By hand, rests are longer and moves faster than on a table, and there is no held-out motion with a reference.
COURSE_BY_HAND = Course(dwell_s=REST_BY_HAND_S, step_rate_dps=60.0, acceleration_dps2=200.0, validation_s=0.0)
# Each turn there and back, the second held out between rests of 4 s or longer; 360 deg in some 3 s.
FACES_AND_TURNS = replace(COURSE_BY_HAND, dwell_s=5.0, rates_dps=(120.0,), both_directions=True)
# From 24 attitudes both sensors are determined. Chambers and freezers: about 60 degC in all.
COURSE_OF_SHEET = replace(FACES_AND_TURNS, positions=24, thermal_ramp_degc=30.0)


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class TableLog(Described):
    """How the table is logged."""

    PART: ClassVar[str] = "table_log"

    # rows: in the sensor's rows; file: in a separate file; program: not at all
    kind: Literal["rows", "file", "program"] = "rows"
    interval_s: Positive = 0.01  # of a file
    offset_s: float | None = None  # of the file's clock; None: at random, 0 to 100 s
    drift_ppm: float | None = None  # of the file's clock; None: at random, standard deviation 50 ppm
    wrapped: bool = False  # whether the encoder restarts at 360 deg


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class UnitDescription(Described):
    """One unit to be simulated."""

    unit: str
    count: Annotated[int, Field(ge=1)] = 1  # above 1, ``unit`` is a prefix
    sensor: str = "mpu6050"
    table: str = "acutronic"
    procedure: str = "three_axis_turns"
    columns: dict[str, Any] = field(default_factory=dict)  # of units.csv: serial, lot, date, method, overrides ...
    course: dict[str, Any] = field(default_factory=dict)  # attributes of ``Course``
    samples: int | None = None  # approximate total number of rows of the recordings
    interval_s: Positive = 0.12
    lost: Annotated[float, Field(ge=0.0, lt=0.9)] = 0.0  # share of the samples that the radio link loses
    format: Literal["csv", "mcap"] = "csv"
    # bias (g or deg/s), matrix, or instead of it scale_factor (of the correction), non_orthogonality_deg (yx, zx, zy),
    # mounting_deg (turns about x, then y, then z); noise_density, bias_wander, wander_time_s replace the sensor file's
    accelerometer: dict[str, Any] = field(default_factory=dict)
    gyroscope: dict[str, Any] = field(default_factory=dict)
    # sensor.effect, or effect alone for both sensors, to null (a typical size, at random), a number (that size, with
    # random signs), the list of the parameters' values, or a new formula (``sensor``)
    effects: dict[str, Any] = field(default_factory=dict)
    # errors of the table: tilt_deg (2,) and the settings of ``trajectory.random_errors``, by default from the
    # accuracies of the table's configuration. And the mounting of the unit: mounting_deg (recording to a rotation
    # vector, body frame), zero_deg (recording to the logged angle at the convention's angle 0), sense (-1: the table
    # counts the other way)
    imperfections: dict[str, Any] = field(default_factory=dict)
    # for held-out motion and long rest on another bench: table, imperfections, accelerometer, gyroscope
    held_out: dict[str, Any] = field(default_factory=dict)
    temperature: dict[str, Any] = field(default_factory=dict)  # ambient, warm_up, drift in degC, if not at random
    copy_of: str | None = None  # unit whose recordings are written again, in another format or table_log
    recordings: list[str] = field(default_factory=list)  # recordings of the procedure to make; empty: all
    motion: int | None = None  # seed of the random motion: units with one seed and course move equally; None: separate
    table_log: dict[str, Any] = field(default_factory=dict)  # attributes of ``TableLog``

    def __post_init__(self) -> None:
        wrong = wrong_name(self.unit)
        if wrong:
            raise ConfigurationError(f"unit is {self.unit[:60]!r}; {wrong}")
        self.whole_course()
        log = self.log.kind
        if log != "rows" and self.format != "csv":
            raise ConfigurationError("a separate table_log is written in csv only")
        if log != "rows" and self.procedure not in TABLE_PROCEDURES:
            raise ConfigurationError(f"procedure {self.procedure} has no table to log")
        if log == BY_PROGRAM and self.procedure == ONE_RECORDING:
            raise ConfigurationError(f"procedure {ONE_RECORDING} has moves that no program describes")

    @property
    def log(self) -> TableLog:
        """How the table is logged."""
        return TableLog(**self.table_log)

    def whole_course(self) -> Course:
        """Return how the procedure is run, with its default lengths."""
        base = {FERRARIS: FACES_AND_TURNS, OF_A_SHEET: COURSE_OF_SHEET}.get(self.procedure, COURSE_BY_HAND)
        return replace(Course() if self.procedure in TABLE_PROCEDURES else base, **self.course)


def course_of(unit: UnitDescription) -> Course:
    """Return how the unit's procedure is run, with lengths that give its number of samples."""
    course = unit.whole_course()
    if unit.samples is None:
        return course
    return fit_to_samples(unit.procedure, course, unit.samples, unit.interval_s, keep_step="step_deg" in unit.course)


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Variant(Described):
    """Every unit again: the suffix of their names, and changed columns of ``units.csv``."""

    PART: ClassVar[str] = "variants"

    suffix: Annotated[str, Field(min_length=1)]
    columns: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Description(Described):
    """A campaign to simulate; ``rows``: further rows of ``units.csv``."""

    seed: int = 0
    defaults: dict[str, Any] | None = None
    units: tuple[UnitDescription, ...] = ()
    rows: tuple[dict[str, Any], ...] | None = None
    variants: tuple[Variant, ...] | None = None


def read_description(path: Path) -> Description:
    """Read a ``simulation.yaml``; ``MissingInputError``: there is none; ``ConfigurationError``: it is wrong."""
    return description_from(_read_mapping(path), str(path))


def description_from(data: dict[str, Any], origin: str) -> Description:
    """Return the description from a mapping; ``origin`` is named in messages."""
    units, defaults = [], data.get("defaults") or {}
    entries = data.get("units") or []
    if not isinstance(defaults, dict) or not isinstance(entries, list) or not all(isinstance(e, dict) for e in entries):
        raise ConfigurationError(f"{origin}: defaults is a mapping of the keys of a unit, and units a list of them")
    for entry in entries:
        merged = {str(key): value for key, value in {**defaults, **entry}.items()}
        if "unit" not in merged:
            raise ConfigurationError(f"{origin}: a unit has no name; give it one with the key unit")
        try:
            units += _units_of_entry(UnitDescription(**merged))
        except ConfigurationError as error:
            raise ConfigurationError(f"{origin}: unit {merged['unit']}: {error.message}") from None
    try:
        description = Description(**{str(key): value for key, value in data.items()} | {"units": units})
    except ConfigurationError as error:
        raise ConfigurationError(f"{origin}: {error.message}") from None
    if not units or len({u.unit for u in units}) < len(units):
        raise ConfigurationError(f"{origin}: there must be at least one unit, and each needs a unique name")
    return description


def _read_mapping(path: Path) -> dict[str, Any]:
    if not os.path.lexists(path):
        raise MissingInputError("this file does not exist", str(path))
    data = read_yaml(path)
    if not isinstance(data, dict):
        raise ConfigurationError("expected a mapping of settings", str(path))
    return data


@cache
def shipped_settings(**options: str) -> Settings:
    """Return the settings of shipped options of groups, ``sensor="mpu6050"``, with the default of every other setting.

    Raises ``ConfigurationError`` if a group has no such option.
    """
    defaults = _read_mapping(CONFIGS / "config.yaml")
    chosen = {group: name for entry in defaults["defaults"] if isinstance(entry, dict) for group, name in entry.items()}
    content = {group: {"name": name, **_config(group, name)} for group, name in (chosen | options).items()}
    content |= {name: defaults[name] for name in SECTIONS if name not in content}
    return Settings.with_sections(**{name: section.model_validate(content[name]) for name, section in SECTIONS.items()})


@cache
def _config(group: str, name: str) -> dict[str, Any]:
    found = read_option(group, name)
    return completed(found, read_option(group, "generic")) if group == "sensor" else found


def read_option(group: str, name: str) -> dict[str, Any]:
    """Read one configuration file of a group; raise ``ConfigurationError`` if there is none of that name."""
    path = CONFIGS / group / f"{name}.yaml"
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in path.parent.glob("*.yaml")))
        raise ConfigurationError(f"no {group} is called {name!r}; known: {known}")
    return _read_mapping(path)


def _units_of_entry(entry: UnitDescription) -> list[UnitDescription]:
    """Return the units of an entry; with a count, its name is the prefix of their names."""
    if entry.count == 1:
        return [entry]
    digits = max(3, len(str(entry.count)))
    names = [f"{entry.unit}{number:0{digits}d}" for number in range(1, entry.count + 1)]
    lots = [{"serial": name, "lot": f"L{k // UNITS_OF_A_LOT + 1}"} for k, name in enumerate(names)]
    return [replace(entry, unit=n, count=1, columns=lot | entry.columns) for n, lot in zip(names, lots, strict=True)]


def add_recording_options(parser: argparse.ArgumentParser) -> None:
    """Add the options for bench and procedure of ``simulate`` and ``plan`` to a parser whose default is SUPPRESS."""
    add = parser.add_argument
    add("--sensor", metavar="NAME", help="configs/sensor (mpu6050)")
    add("--table", metavar="NAME", help="configs/table (acutronic; hand for procedures without a table)")
    add("--procedure", metavar="NAME", help="configs/procedure (three_axis_turns)")
    add("--samples", type=int, metavar="N", help="approximate rows of a unit; scales rests and held-out motion")
    add("--interval", dest="interval_s", type=float, metavar="S", help="sampling interval in s (0.12; by hand 0.1)")
    add("--table-log", choices=DESCRIPTION_KINDS,
        help="where the table is logged: in the sensor's rows (the default), in a file with a separate clock, or not "
        "at all: then its program is known")  # fmt: skip
    add("--lost", type=float, metavar="SHARE", help="share of the samples that the radio link loses (0)")
    add = parser.add_argument_group("how the procedure is run").add_argument
    add("--dwell", dest="dwell_s", type=float, metavar="S", help="rest at each stop (1; without a table 4)")
    add("--step", dest="step_deg", type=float, metavar="DEG", help="of stop-and-go (5)")
    add("--accelerometer-rate", dest="accelerometer_rates_dps", type=float, nargs="+", metavar="DPS",
        help="continuous turns for the accelerometer instead of stop-and-go")  # fmt: skip
    add("--rate", "--rates", dest="rates_dps", type=float, nargs="+", metavar="DPS", help="gyroscope turns (60)")
    add("--both-directions", action="store_true", help="make each turn backwards too")
    add("--turns", type=int, metavar="N", help="whole turns at each rate (1)")
    add("--positions", type=int, metavar="N", help="rests of multi_position (40)")
    add("--validation", dest="validation_s", type=float, metavar="S", help="length of held-out motion (120; 0: none)")
    add("--validation-rate", dest="validation_rate_dps", type=float, metavar="DPS", help="largest rate in it (40)")
    add("--static", dest="static_s", type=float, metavar="S", help="length of the long rest (120; 0: none)")
    add("--pause", dest="pause_s", type=float, metavar="S", help="between recordings (30)")
    add("--thermal-ramp", dest="thermal_ramp_degc", type=float, metavar="DEGC",
        help="of thermal_ramp (15) and of each soak (30): up and down")  # fmt: skip
    add("--kinds", nargs="+", metavar="KIND", help="recordings of listed: rest, moves, turn, soak (all)")
    add("--soaks", type=int, metavar="N", help="attitudes in which listed soaks the unit in a thermal chamber (1)")
    add("--soak", dest="soak_s", type=float, metavar="S", help="length of each (3600)")
    add("--turn-error", dest="turn_error_deg", type=float, metavar="DEG", help="of a hand's total angle (3)")
    add("--turn-axis-error", dest="turn_axis_error_deg", type=float, metavar="DEG", help="of its turn axis (1.5)")


def described(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys of a unit of ``simulation.yaml`` from the parsed options; other options are ignored."""
    procedure = arguments.get("procedure", "three_axis_turns")
    by_hand = {"table": "hand", "interval_s": SAMPLING_BY_HAND_S}
    unit: dict[str, Any] = {"table": "acutronic"} if procedure in TABLE_PROCEDURES else by_hand
    unit |= {name: arguments[name] for name in RECORDED if name in arguments}
    unit |= {"table_log": {"kind": arguments["table_log"]}} if "table_log" in arguments else {}
    course = {f.name: arguments[f.name] for f in fields(Course) if f.name in arguments}
    return {**unit, "course": course} if course else unit
