"""Read the description of a simulation, ``simulation.yaml``.

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
"""

from __future__ import annotations

import os
from dataclasses import field, fields, replace
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from imu_logs.yaml_file import read_yaml
from pipeline.core.errors import ConfigurationError, MissingInputError
from pipeline.core.files import CONFIGS
from pipeline.core.settings import SECTIONS, Settings
from pipeline.ingest.files import wrong_name
from pipeline.physics.sensor_file import completed
from pipeline.simulation import REST_BY_HAND_S
from pipeline.simulation.procedures import (
    FERRARIS,
    ONE_RECORDING,
    TABLE_PROCEDURES,
    Course,
    Described,
    Positive,
    fit_to_samples,
)

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping
    from pathlib import Path

FORMATS = ("csv", "mcap")
DESCRIPTION_KINDS = ("rows", "file", "program")
_, BY_FILE, BY_PROGRAM = DESCRIPTION_KINDS
UNITS_OF_A_LOT = 25  # for units that are described by a count: a round number
SAMPLING_BY_HAND_S = 0.1  # docs/record.md: 10 Hz or more, to find rests
# By hand, rests are longer and moves faster than on a table, and there is no held-out motion with a reference.
COURSE_BY_HAND = Course(dwell_s=REST_BY_HAND_S, step_rate_dps=60.0, acceleration_dps2=200.0, validation_s=0.0)
# Each turn there and back, the second held out between rests of 4 s or longer; 360 deg in some 3 s.
FACES_AND_TURNS = replace(COURSE_BY_HAND, dwell_s=5.0, rates_dps=(120.0,), both_directions=True)
RECORDED = ("sensor", "table", "procedure", "samples", "interval_s", "lost")


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class TableLog(Described):
    """How the table is logged."""

    PART: ClassVar[str] = "table_log"

    kind: Literal["rows", "file", "program"] = (
        "rows"  # rows: in the sensor's rows; file: in a separate file; program: not at all
    )
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
    course: dict[str, Any] = field(default_factory=dict)  # attributes of ``procedures.Course``
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
        base = FACES_AND_TURNS if self.procedure == FERRARIS else COURSE_BY_HAND
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
    """Read a ``simulation.yaml``.

    Raises ``MissingInputError`` if there is none, ``ConfigurationError`` if a key is unknown.
    """
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
    """Read a YAML file that holds a mapping."""
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
    return [
        replace(entry, unit=name, count=1, columns=lot | entry.columns) for name, lot in zip(names, lots, strict=True)
    ]


def add_recording_options(parser: argparse.ArgumentParser) -> None:
    """Add the options for the bench and the procedure to a parser with ``argument_default=argparse.SUPPRESS``.

    ``simulate`` and ``plan`` share them: a planned procedure can be simulated with the same options.
    """
    add = parser.add_argument
    add("--sensor", metavar="NAME", help="configs/sensor (mpu6050)")
    add("--table", metavar="NAME", help="configs/table (acutronic; hand for procedures without a table)")
    add("--procedure", metavar="NAME", help="configs/procedure (three_axis_turns)")
    add("--samples", type=int, metavar="N", help="approximate rows of a unit; scales rests and held-out motion")
    add(
        "--interval",
        dest="interval_s",
        type=float,
        metavar="S",
        help="sampling interval in s (0.12; by hand 0.1)",
    )
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
        help="of thermal_ramp: up and down (15)")  # fmt: skip
    add(
        "--turn-error", dest="turn_error_deg", type=float, metavar="DEG", help="of a hand's total angle in ferraris (3)"
    )
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
