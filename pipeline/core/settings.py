"""The settings of a unit: names, types and ranges, as functions read them.

Comments in ``configs/`` explain each key. Unknown keys are refused, except in column maps of ``ingest`` and in limits
of effects, whose keys are names of channels and effects. A step of the chain has the sections that ``STEPS`` in
``pipeline.unit`` names; an access to another section raises ``AttributeError``.

In a sensor's file, ``ranges`` maps a full scale to counts per unit; the override ``sensor.accelerometer.range=6`` sets
``full_scale`` and ``counts_per_unit`` of that range. ``completed`` takes figures that are null or absent from
``generic``, and lists their names in ``assumed``; full scale and counts only for a sensor that the chip does not have.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from math import sqrt
from typing import Annotated, Any, Generic, Literal, Self, TypeVar

from pydantic import BaseModel, ConfigDict, Field

from imu_logs.profile import Profile
from imu_logs.units import SENSORS
from pipeline.core.errors import ConfigurationError

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
AxisName = Literal["x", "y", "z"]
SignedAxis = Literal["+x", "-x", "+y", "-y", "+z", "-z"]
AxisMap = Annotated[list[SignedAxis], Field(min_length=3, max_length=3)]
Sense = Literal[1, -1]
FileKind = Literal["rest", "attitudes", "turn", "moves", "slow", "soak", "table"]  # in the sheet of recordings
Finite = Annotated[float, Field(allow_inf_nan=False)]
SettingOfSensor = TypeVar("SettingOfSensor")
AnySection = TypeVar("AnySection", bound="Section")
OfAxes = Annotated[list[Finite], Field(min_length=3, max_length=3)]  # x, y, z
OF_BENCH = ("seat_deg", "time_offset_s", "clock_accuracy_ppm", "lag_s")  # keys of a table: priors in configs/effect
Text = Annotated[str, Field(min_length=1)] | None
Date = Annotated[str, Field(pattern=r"^\d{4}-\d{2}-\d{2}$")] | None
REQUIRED_FIGURES = ("noise_density", "bias_wander", "wander_time_s", "bias", "scale_factor", "cross_axis", "effects")


class BySensor(Generic[SettingOfSensor]):
    """Settings with one of each sensor."""

    def of(self, name: str) -> SettingOfSensor:
        """Return the setting of the accelerometer or the gyroscope."""
        found: SettingOfSensor = getattr(self, name)
        return found


class Section(BaseModel):
    """A part of the configuration: strict types, no unknown keys."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    def replaced(self, **values: object) -> Self:
        """Return a copy with other values, which are not checked."""
        known = {name: self.__dict__[name] for name in type(self).model_fields if name in self.__dict__}
        return _constructed(type(self), known | values)

    @cached_property
    def json_value(self) -> dict[str, Any]:
        """The settings as a JSON value, which must not be changed; computed once, as units share sections."""
        return self.model_dump(mode="json")


def _constructed(model: type[AnySection], values: Mapping[str, Any]) -> AnySection:
    """Return a section with these values alone: others are missing, and not their defaults."""
    made = model.model_construct(**values)
    for name in made.__dict__.keys() - values.keys():
        del made.__dict__[name]
    return made


def _partial(model: type[AnySection], content: Mapping[str, Any]) -> AnySection:
    """Return a section from JSON values that ``Section.json_value`` made, of all its settings or of some."""
    fields = model.model_fields
    if all(name in content for name, field in fields.items() if field.is_required()):
        return model.model_validate(content, strict=False)
    kinds: dict[str, Any] = {name: fields[name].annotation for name in content}
    sections = {n: k for n, k in kinds.items() if isinstance(k, type) and issubclass(k, Section)}
    return _constructed(model, {n: _partial(sections[n], v) if n in sections else v for n, v in content.items()})


class KnownTemperature(Section):
    """Known coefficients of temperature of one sensor, for the method ``known_temperature``."""

    bias: OfAxes | None = None
    scale_factor: OfAxes | None = None
    reference_degc: Finite = 25.0


class DataSheet(Section):
    """The figures of one sensor: accelerometer or gyroscope."""

    full_scale: Positive
    counts_per_unit: Positive
    noise_density: Positive
    bias_wander: NonNegative
    wander_time_s: Positive
    bias: Positive
    scale_factor: Positive
    cross_axis: Positive
    effects: dict[str, Positive]
    ranges: dict[float, Positive] = {}
    assumed: list[str] = []
    axis_map: AxisMap | None = None
    repeatability_bias: NonNegative | None = None
    repeatability_scale_factor: NonNegative | None = None
    known_temperature: KnownTemperature = KnownTemperature()
    accept_implausible: bool = False

    def stated(self, name: str) -> float | None:
        """Return a figure that the sensor's file states; None for a figure of ``generic``."""
        found: float | None = None if name in self.assumed else getattr(self, name)
        return found

    def white(self, interval: float) -> float:
        """Return the standard deviation of one sample's white noise; ``interval``: between samples, s."""
        return self.noise_density * sqrt(0.5 / interval)


class Sensor(Section, BySensor[DataSheet]):
    """A sensor model."""

    name: str
    axis_map: AxisMap
    temperature_accuracy_degc: NonNegative | None = None
    accelerometer: DataSheet
    gyroscope: DataSheet


class Table(Section):
    """A rate table, or none."""

    name: str
    motion: Literal["logged", "commanded", "none"]
    gravity_g: Annotated[float, Field(gt=0.9, lt=1.1)]
    latitude_deg: Annotated[float, Field(ge=-90, le=90)] | None
    azimuth_deg: Annotated[float, Field(ge=-360, le=360)] | None
    azimuth_of: Literal["level_x", "turn_axis"] = "level_x"
    angle_accuracy_deg: NonNegative
    rate_accuracy: NonNegative
    orthogonality_deg: NonNegative
    sense: Sense = 1
    zero_deg: Finite = 0.0
    wobble_deg: NonNegative | None = None
    levelling_deg: NonNegative | None = None
    gravity_accuracy_g: NonNegative | None = None
    azimuth_accuracy_deg: NonNegative | None = None
    clock_accuracy_ppm: NonNegative | None = None
    time_offset_s: Positive | None = None
    lag_s: Positive | None = None
    seat_deg: Annotated[float, Field(gt=0, le=10)] | None = None


class ProgramRest(Section):
    """A rest in the program of a table."""

    rest_s: NonNegative


class ProgramTurn(Section):
    """A turn in the program of a table, with trapezoidal rate."""

    turn_deg: float
    rate_dps: Positive
    acceleration_dps2: Positive


class Repeated(Section):
    """Repeated steps in the program of a table."""

    repeat: Annotated[int, Field(ge=1)]
    steps: list[ProgramRest | ProgramTurn]


class Window(Section):
    """A part of one long recording, in s from its first sample."""

    role: Literal["accelerometer", "gyroscope", "rests", "validation", "static"]
    axis: AxisName | None = None
    start_s: NonNegative
    stop_s: Positive


class RecordingFile(Section):
    """One recording of a procedure."""

    file: str
    role: Literal["accelerometer", "gyroscope", "rests", "validation", "static", "session"]
    axis: AxisName | None
    optional: bool
    up: SignedAxis | None = None
    sense: Sense | None = None
    zero_deg: Finite | None = None
    setup: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")] | None = None
    program: list[ProgramRest | ProgramTurn | Repeated] | None = None
    windows: list[Window] | None = None
    session: Annotated[int, Field(ge=1)] | None = None
    kind: FileKind | None = None
    direction: OfAxes | None = None
    angle_deg: Finite | None = None
    angle_accuracy_deg: Positive | None = None


class FacesByHand(Section):
    """Faces that are placed up by hand."""

    accuracy_deg: Positive


class HandTurns(Section):
    """Turns by hand of a stated total angle."""

    angle_deg: Positive
    accuracy_deg: Positive
    axis_accuracy_deg: Positive
    holdout_every: Annotated[int, Field(ge=0)]


class Procedure(Section):
    """The recordings of a calibration."""

    name: str
    table: str
    method: str | None = None
    folder: str
    recordings: dict[str, RecordingFile]
    sheet: str | None = None
    holdout_every: Annotated[int, Field(ge=0)]
    holdout_from: Annotated[int, Field(ge=0)] = 0
    mounting_tolerance_deg: Positive = 5.0
    faces: FacesByHand | None = None
    turns: HandTurns | None = None


class Stages(Section, BySensor[list[str] | None]):
    """The stages of a method, per sensor."""

    accelerometer: list[str] | None = None
    gyroscope: list[str] | None = None


class Method(Section, BySensor[str | None]):
    """The method for each sensor."""

    name: str
    accelerometer: str | None
    gyroscope: str | None
    as_printed: bool
    file: Annotated[str, Field(min_length=1)] | None = None
    format: Annotated[str, Field(min_length=1)] | None = None
    stages: Stages
    given: dict[str, Any] | None = None  # of ``method=given``: the calibration that was read (``with_given``)
    known: dict[str, list[dict[str, Any]]] | None = None  # effects that stages of a sensor know, name and parameters


class Filter(Section):
    """The filter before the fit."""

    name: Literal["none", "rc_low_pass", "low_pass", "high_pass", "band_pass", "band_stop"]
    cutoff_hz: Positive | None
    time_constant_s: Positive | None
    low_hz: Positive | None
    high_hz: Positive | None
    order: Annotated[int, Field(ge=1, le=10)] | None
    zero_phase: bool


class OfSensors(Section, BySensor[SettingOfSensor], Generic[SettingOfSensor]):
    """A setting of each sensor."""

    accelerometer: SettingOfSensor
    gyroscope: SettingOfSensor


class Effects(OfSensors[list[str] | Literal["auto"]]):
    """The effects of each sensor that are fitted with bias and matrix."""


class Uncertainty(Section):
    """Settings of the uncertainty computation."""

    monte_carlo: Annotated[int, Field(ge=0, le=10_000_000)]


class DiagnosisSettings(Section):
    """Settings of the diagnosis."""

    depth: Literal["standard", "full"]


class SensorLimits(Section):
    """Limits that a unit must keep to pass; None is not checked."""

    held_out_rms_error: Positive | None
    held_out_mean_abs_error: Positive | None
    held_out_max_abs_error: Positive | None
    bias: Positive | None
    scale_factor: Positive | None


class LimitsOfSensors(OfSensors[SensorLimits]):
    """The limits of each sensor."""


class Ingest(Section, Profile):
    """The format of recordings (``imu_logs.Profile``)."""


class Organisation(Section):
    """A laboratory or a customer."""

    name: Text = None
    address: Text = None
    contact: Text = None


class Item(Section):
    """The calibrated item."""

    manufacturer: Text = None
    description: Text = None
    condition: Text = None


class Performed(Section):
    """First and last day of the calibration."""

    begin: Date = None
    end: Date = None


class Person(Section):
    """The person who authorises a report."""

    name: Text = None
    role: Text = None


class MethodStated(Section):
    """The procedure of the laboratory."""

    document: Text = None
    deviations: Text = None


class Equipment(Section):
    """A reference that was used."""

    name: str
    identification: Text = None
    certificate: Text = None
    used_for: Text = None


class Conformity(Section):
    """The subject of a statement of conformity."""

    specification: Text = None
    decision_rule: Text = None


class Certificate(Section):
    """Statements of a laboratory in its calibration report; None is not stated."""

    name: str
    number: Text = None
    title: str = "Calibration report"
    laboratory: Organisation = Organisation()
    place: Text = None
    country: Annotated[str, Field(pattern="^[A-Z]{2}$")] | None = None
    customer: Organisation = Organisation()
    item: Item = Item()
    received: Date = None
    performed: Performed = Performed()
    issued: Date = None
    authorised_by: Person = Person()
    method: MethodStated = MethodStated()
    environment: Text = None
    equipment: list[Equipment] = []
    traceability: Text = None
    conformity: Conformity = Conformity()
    sampling: Text = None
    external_results: Text = None
    opinions: Text = None
    adjusted: Text = None
    next_date: Date = None

    def number_of(self, unit: str, serial: str) -> str | None:
        """Return the number of a unit's report."""
        return self.number and self.number.replace("{unit}", unit).replace("{serial}", serial or "?")


class Unit(Section):
    """The whole configuration of one unit, as its overrides state it."""

    sensor: Sensor
    table: Table
    procedure: Procedure
    method: Method
    filter: Filter
    ingest: Ingest
    effects: Effects
    uncertainty: Uncertainty
    diagnosis: DiagnosisSettings
    limits: LimitsOfSensors
    certificate: Certificate


class UserEffectFiles(Section):
    """The effects that the user defines: content of effect files, and path and SHA-256 of Python files."""

    formulas: list[dict[str, Any]]
    python: list[dict[str, str]]


class Board(Section):
    """A board with several chips; the first is the reference."""

    name: str
    chips: list[str]


class Stated(Section):
    """What results state about a unit and its run, and what depends on other units."""

    config_sha256: str = ""
    row: dict[str, str] = {}  # of ``units.csv``
    run: dict[str, Any] = {}  # settings of ``snakemake --config``
    overrides: dict[str, str] = {}
    sections: dict[str, str] = {}  # digest of each section of the configuration
    compared: bool = False  # whether the campaign's page compares the unit with others
    lot_prior: bool = False  # whether the unit contributes to the prior of its lot
    board: Board | None = None


class Settings(Unit):
    """The settings of a unit: its configuration, and what is stated about it."""

    unit: str
    user_effects: UserEffectFiles | None = None
    stated: Stated = Stated()

    @property
    def configuration(self) -> dict[str, Any]:
        """The configuration of the unit as dictionaries."""
        sections = {name: getattr(self, name).model_dump() for name in Unit.model_fields}
        of_user = {"user_effects": self.user_effects.model_dump()} if self.user_effects else {}
        return {"unit": self.unit, **sections, **of_user}

    def only(self, sections: Iterable[str]) -> dict[str, Any]:
        """Return sections as JSON values; ``effects.gyroscope`` is the part of one sensor."""
        found: dict[str, Any] = {}
        for path in sections:
            section, _, part = path.partition(".")
            value = getattr(self, section).json_value
            if part:
                found.setdefault(section, {})[part] = value[part]
            else:
                found[section] = value
        return found

    @classmethod
    def with_sections(cls, **sections: Section) -> Self:
        """Return settings of these sections alone."""
        return _constructed(cls, sections)

    @classmethod
    def of_sections(cls, sections: Mapping[str, Any]) -> Self:
        """Return the settings that ``only`` selected; an access to another section raises ``AttributeError``."""
        return _partial(cls, sections)


class RunSettings(Section):
    """Settings of a run, from ``campaign.yaml`` or the command line. Error messages quote a description."""

    batch_size: Literal["auto"] | Annotated[int, Field(ge=1)] = Field(description="auto or a whole number from 1 on")
    combine: Literal["serial", "lot"] | None = Field(description="serial, lot or null")
    publish_limit: int = Field(ge=0, description="a whole number from 0 on")


SECTIONS: dict[str, type[Section]] = {
    name: field.annotation
    for name, field in Unit.model_fields.items()
    if isinstance(field.annotation, type) and issubclass(field.annotation, Section)
}


def completed(sensor: Mapping[str, Any], generic: Mapping[str, Any]) -> dict[str, Any]:
    """Return a sensor's file in which figures that are not stated are taken from ``generic``."""
    out = dict(sensor)
    for part in SENSORS:
        data_sheet = dict(sensor.get(part) or {k: generic[part][k] for k in ("full_scale", "counts_per_unit")})
        missing = [key for key in REQUIRED_FIGURES if data_sheet.get(key) is None]
        if missing:
            out[part] = data_sheet | {key: generic[part][key] for key in missing} | {"assumed": missing}
    return out


def range_settings(key: str, value: Any, sensor: Mapping[str, Any]) -> list[tuple[str, Any]]:  # noqa: ANN401  (the user's)
    """Return the settings that an override makes: itself, or the figures of the range that it chooses.

    Raises ``ConfigurationError`` if the sensor's file does not list the range.
    """
    group, _, rest = key.partition(".")
    part, _, leaf = rest.partition(".")
    if group != "sensor" or part not in SENSORS or leaf != "range":
        return [(key, value)]
    ranges = {float(full): counts for full, counts in ((sensor.get(part) or {}).get("ranges") or {}).items()}
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number or float(value) not in ranges:
        known = ", ".join(f"{full:g}" for full in sorted(ranges)) or "none: set full_scale and counts_per_unit"
        raise ConfigurationError(f"{key}={value}: the sensor's file lists the ranges {known}")
    return [(f"sensor.{part}.full_scale", float(value)), (f"sensor.{part}.counts_per_unit", ranges[float(value)])]


def settings_of_ranges(data_sheets: Mapping[str, DataSheet], wanted: Sequence[float | None]) -> list[str]:
    """Return the overrides that set the range of the accelerometer, g, then of the gyroscope, deg/s; None: unchanged.

    ``data_sheets``: of the sensors that the chip has. An override sets ``range`` where the sensor's file lists ranges,
    else full scale and counts per unit. Raises ``ConfigurationError`` if there are more ranges than sensors, one is not
    positive, or the file does not list it.
    """
    if len(wanted) > len(data_sheets) or not all(value is None or value > 0.0 for value in wanted):
        raise ConfigurationError("--range takes the range of the accelerometer in g, then of the gyroscope in deg/s")
    found = []
    for (part, data_sheet), value in zip(data_sheets.items(), wanted, strict=False):
        if value is not None and data_sheet.ranges:
            range_settings(f"sensor.{part}.range", value, {part: data_sheet.json_value})  # refuses an unknown range
            found.append(f"sensor.{part}.range={value:g}")
        elif value is not None:
            counts = data_sheet.counts_per_unit * data_sheet.full_scale / value
            found += [f"sensor.{part}.full_scale={value:g}", f"sensor.{part}.counts_per_unit={counts:.10g}"]
    return found


def assumed_figures(sensor: Sensor) -> str:
    """Return the sentence that lists the figures of a ``completed`` sensor from ``generic``; empty for none."""
    parts = [f"{', '.join(found)} of the {part}" for part in SENSORS if (found := sensor.of(part).assumed)]
    figures = ", and ".join(parts)
    stated = not parts or sensor.name == "generic"
    return "" if stated else f"the file of the sensor {sensor.name} does not state {figures}: generic's are used"


def without_overridden(sensor: dict[str, Any], keys: set[str]) -> dict[str, Any]:
    """Remove figures that an override states (``sensor.gyroscope.bias``) from the ``assumed`` list of a sensor."""
    for part in SENSORS:
        data_sheet = sensor.get(part) if isinstance(sensor, dict) else None
        data_sheet = data_sheet if isinstance(data_sheet, dict) else {}
        assumed = data_sheet.get("assumed")
        remaining = [key for key in assumed or () if f"sensor.{part}.{key}" not in keys]
        if assumed and len(remaining) < len(assumed):
            sensor = {**sensor, part: {**data_sheet, "assumed": remaining}}
    return sensor
