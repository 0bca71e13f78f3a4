"""Write a calibration in the formats of other programs. Each ``templates/*.j2`` defines one format.

A template has two parts, separated by a line ``---``: a declaration (``Format``: quantities and units of the format,
and how ``convert`` reads it), and the text of the file in Jinja2. The text has the variables

    accelerometer, gyroscope   ``sensors.ExportedSensor`` in the units of the format, None if it is not calibrated
    sensors                    the calibrated sensors, by name
    remarks                    convention, omitted quantities, the remaining error, the held-out errors
    unit, document             name of the unit, its calibration
    gravity_g                  local gravity, g
    noise                      ``sensors.noise``, of a format with ``noise: true``

the functions of ``sensors.TEMPLATE_FUNCTIONS``, and the filters ``comment``, ``json``, ``yaml``, ``numbers``. The name
of the template without ``.j2`` is the name of the format and, by default, of its file.

``calibration.h`` has the effects as C expressions (``plan_of``). It performs the operations of
``pipeline.physics.compensation`` for one sample, in the same order. Double precision without fused operations and
without functions of the C library then gives the same last bit. Effects of only time and temperature (``steady``) are
subtracted once. Effects of the motion (``moving``) are subtracted by a fixed-point iteration if they depend on the
calibrated reading of the same sensor, also through the other sensor (``circular_sensors``).
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, replace
from dataclasses import fields as dataclass_fields
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any, Literal

import yaml
from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template

from pipeline.core.compiled_templates import Templates
from pipeline.core.errors import ConfigurationError
from pipeline.core.files import JSON, Check, WrongValueError, each, fields, one_of
from pipeline.core.records import SENSORS, FittedEffect, Quantities, Reduced, SensorCalibration, as_json
from pipeline.core.settings import Settings
from pipeline.output.exports.sensors import (
    TEMPLATE_FUNCTIONS,
    UNIT_FACTORS,
    ExportedSensor,
    SensorFigures,
    before_use,
    noise,
    noise_figures,
)
from pipeline.physics.compensation import OF_THE_PAST, RATE_SMOOTHING_S, SMOOTHING_S, Steps, circular
from pipeline.physics.effects import effect_of
from pipeline.physics.effects.base import REFERENCE_TEMPERATURE
from pipeline.physics.formula import c_number
from pipeline.physics.measurement import FIELDS_OF_SIGNALS, sensor_effects

TEMPLATES = Path(__file__).parent / "templates"
# of the fixed point: each gains about two digits, and a relative error of 1e-13 is the goal
FIXED_POINT_ITERATIONS = 12
IN_C = set(FIELDS_OF_SIGNALS) - {"specific_force_rate"}
END_OF_HEADER = "\n---\n"  # of the file of a format
YAML = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
CALL = re.compile(r"(\w+)\(")  # of a function in C


@dataclass(frozen=True, kw_only=True)
class Format:
    """The declaration of a format: the keys above the line ``---`` of a template."""

    consumer: str  # program that reads the file
    equation: str  # by which the consumer corrects a reading
    source: str  # documentation of the equation
    file: str = ""  # name of the file, with {unit} for the name of the unit; default: name of the template
    units: dict[str, Literal["g", "m/s^2", "deg/s", "rad/s"]]  # of readings; the format has only sensors with a unit
    sensor_endings: dict[str, str] = field(default_factory=dict)  # of file names, if each sensor has a separate file
    required: list[str] = field(default_factory=list)  # sensors that must be calibrated; "board": the reference chip
    required_counts: list[str] = field(default_factory=list)  # sensors whose counts per unit must be known
    matrix: dict[str, Literal["full", "diagonal", "none"]] = field(default_factory=dict)  # part in the format; full
    effects: list[str] = field(default_factory=list)  # in the format; "all": the text contains or names all of them
    effects_in_part: dict[str, str] = field(default_factory=dict)  # approximated effect to the accuracy, in words
    opening_remarks: list[str]  # the first remarks; with {unit}, {sensor}, {counts[...]}, {sensors[0]...}
    closing_remarks: list[str] = field(default_factory=list)  # after the remarks on omitted quantities
    temperature_remarks: list[str] = field(default_factory=list)  # only if a bias depends on the temperature
    noise: bool = False  # whether it has noise parameters: remarks state their origin, interval, effective density
    error_sentence: str | None = None  # {}: a held-out error; default: of the export or of the full calibration
    read_back: JSON = field(default_factory=dict)  # how ``convert`` reads it (``reading``); empty: no calibration


class _Texts(FileSystemLoader):
    """The texts of templates, for formats those below their declaration."""

    def get_source(self, environment: Environment, template: str) -> tuple[str, str, Callable[[], bool]]:
        text, file, unchanged = super().get_source(environment, template)
        return text.partition(END_OF_HEADER)[2] if template.endswith(".j2") else text, file, unchanged


@cache
def _environment() -> Templates:
    kept = {"keep_trailing_newline": True, "undefined": StrictUndefined, "extensions": ["jinja2.ext.do"]}
    environment = Templates("exports", FileSystemLoader(TEMPLATES), **kept)  # no HTML; a comment filter closes comments
    environment.filters |= {"comment": _comment, "json": _json, "yaml": _yaml, "numbers": _numbers}
    environment.globals |= {**TEMPLATE_FUNCTIONS, "plan_of": plan_of}
    return environment


def text_of(name: str, **values: Any) -> str:  # noqa: ANN401
    """Render a template that is not a format."""
    return _environment().get_template(name).render(values)


@cache
def formats() -> dict[str, tuple[Format, Template]]:
    """Return declaration and text of every format, by name, in alphabetical order.

    Raises ``ConfigurationError`` for a missing or unknown key of a declaration, an unknown unit, or one file of two.
    """
    keys = dataclass_fields(Format)
    required = [key.name for key in keys if key.default is MISSING and key.default_factory is MISSING]
    checks: dict[str, Check] = {key.name: lambda value: value for key in keys}
    check = fields(checks | {"units": each(one_of(*UNIT_FACTORS))}, required)
    formats_by_name: dict[str, tuple[Format, Template]] = {}
    environment = _environment().overlay(loader=_Texts(TEMPLATES))
    for template in sorted(TEMPLATES.glob("*.j2")):
        header, _, _ = template.read_text(encoding="utf-8").partition(END_OF_HEADER)
        try:
            declared = Format(**{"file": template.stem, **check(yaml.load(header, YAML))})  # noqa: S506  (safe)
        except WrongValueError as wrong:
            raise ConfigurationError(f"{template}: {wrong}. CONTRIBUTING.md names an example") from None
        same = [name for name, (other, _) in formats_by_name.items() if other.file == declared.file]
        if same:
            raise ConfigurationError(
                f"{template}: file: {declared.file} is also the file of {same[0]}.j2: name another"
            )
        formats_by_name[template.stem] = declared, environment.get_template(template.name)
    environment.get_template("remarks.txt")  # compiled with the formats, whose texts hold it
    return formats_by_name


@dataclass(frozen=True)
class ExportedUnit:
    """A unit to export: its documents, as in ``exports``, and quantities that several formats need."""

    document: JSON
    sheets: Mapping[str, SensorFigures]  # by sensor, without those of unknown sensors
    gravity_g: float = 1.0
    validation: JSON | None = None
    diagnosis: JSON | None = None
    made: Quantities = field(default_factory=Quantities)  # sensors by what formats hold

    @cached_property
    def calibrations(self) -> dict[str, SensorCalibration]:
        """Calibrations of the calibrated sensors."""
        return {s: SensorCalibration.from_json(s, self.document[s]) for s in SENSORS if self.document.get(s)}

    @cached_property
    def of_sensors(self) -> dict[str, frozenset[str]]:
        """Names of the effects that each calibrated sensor causes."""
        return {s: frozenset(e.name for e in sensor_effects(c)) for s, c in self.calibrations.items()}

    @cached_property
    def before_use(self) -> list[str]:
        """Remarks of all formats before the use of the file."""
        return before_use(self.document)

    @cached_property
    def noise_figures(self) -> dict[str, JSON]:
        """Noise parameters of each sensor, with their origin and intervals."""
        return {s: noise_figures(s, self.sheets.get(s), self.document) for s in SENSORS}

    def sensors(self, declared: Format) -> dict[str, ExportedSensor]:
        """Return the calibrated sensors in the units of a format."""
        found, included = {}, {*declared.effects, *declared.effects_in_part}
        for s, own in self.of_sensors.items():
            if s in declared.units:
                key = s, declared.units[s], declared.matrix.get(s, "full"), own if "all" in included else own & included
                found[s] = self.made.once(key, partial(self._sensor, *key))
        return found

    def _sensor(self, sensor: str, unit: str, part: str, kept: frozenset[str]) -> ExportedSensor:
        """Return a sensor with this part of the matrix and these effects: formats that hold the same share it."""
        entries = ((self.validation or {}).get(sensor) or {}).get("reduced", ())
        held = next((e for e in entries if e["part"] == part and {*e["effects"]} == kept), None)
        reduced = held and Reduced(**held)
        return ExportedSensor(self.calibrations[sensor], unit, self.sheets.get(sensor), reduced)

    def held_out_errors(self, *, less: bool) -> dict[tuple[str, str], float]:
        """Return the held-out rms error of each sensor and file; ``less``: of those that hold less alone."""
        errors = {}
        for declared, _ in formats().values():
            for name, sensor in self.sensors(declared).items():
                steps = ((self.validation or {}).get(name) or {}).get("steps") or [{}]
                error = sensor.held.rms_error if sensor.held else steps[-1].get("rms_error")
                if error and (sensor.held or not less):
                    errors[name, declared.file] = error
        return errors


def exports(
    calibration: JSON, settings: Settings, validation: JSON | None = None, diagnosis: JSON | None = None
) -> dict[str, str]:
    """Return the texts of a unit's published documents in every format, by file name."""
    sheets = {s: SensorFigures.of(settings.sensor.of(s)) for s in SENSORS}
    exported = ExportedUnit(calibration, sheets, settings.table.gravity_g, validation, diagnosis)
    return {file: text for format_name in formats() for file, text in export(format_name, exported).items()}


def export(format_name: str, exported: ExportedUnit, file: str | None = None) -> dict[str, str]:
    """Return the texts of one format by file name; empty if a sensor that the format requires is missing.

    ``file``: name of the file, by default from the declaration; the ending of a sensor with a separate file is added.
    """
    declared, template = formats()[format_name]
    path = Path(declared.file.replace("{unit}", exported.document["unit"]) if file is None else file)
    endings = declared.sensor_endings.items()
    parts = {f"{path.stem}{ending}{path.suffix}": _of_sensor(format_name, s) for s, ending in endings}
    parts = parts or {path.name: declared}
    texts = {name: _rendered(part, template, exported) for name, part in parts.items()}
    return {name: text for name, text in texts.items() if text is not None}


@cache
def _of_sensor(format_name: str, sensor: str) -> Format:
    """Return the declaration of the file of one sensor."""
    declared, _ = formats()[format_name]
    return replace(declared, units={sensor: declared.units[sensor]}, required=[sensor])


def _rendered(declared: Format, template: Template, exported: ExportedUnit) -> str | None:
    """Return the text of a file, None if a required sensor or its counts are missing."""
    sensors = exported.sensors(declared)
    without_counts = [s for s in declared.required_counts if s in sensors and not sensors[s].counts]
    available = {*sensors, "board"} if (exported.document.get("board") or {}).get("chips") else set(sensors)
    if without_counts or not set(declared.required) <= available:
        return None
    about = {key: getattr(exported, key) for key in ("document", "gravity_g")}
    about |= {"noise": noise(exported.noise_figures) if declared.noise else None, "sensors": sensors}
    about |= {"unit": exported.document["unit"], "remarks": _remarks(declared, sensors, exported)}
    return template.render(**{s: sensors.get(s) for s in SENSORS}, **about)


def _remarks(declared: Format, sensors: dict[str, ExportedSensor], exported: ExportedUnit) -> list[str]:
    """Return the remarks in the file, each a sentence or a line."""
    included = [*declared.effects, *declared.effects_in_part]
    about = {key: getattr(exported, key) for key in ("document", "validation", "diagnosis")}
    about |= {"declared": declared, "before_use": exported.before_use, "sensors": sensors}
    about |= {"counts": {s: sensor.counts for s, sensor in sensors.items()}}
    every, figures = "all" in included, exported.noise_figures if declared.noise else {}
    lost = {s: [n for n in sensor.effects if n not in included and not every] for s, sensor in sensors.items()}
    follows = any(sensor.follows_temperature for sensor in sensors.values())
    return text_of("remarks.txt", **about, lost=lost, follows_temperature=follows, figures=figures).splitlines()


def _comment(lines: list[str], mark: str = "# ", end: str = "\n", *, escape: tuple[str, str] = ("", "")) -> str:
    """Return lines as comments; line ends within a line become blanks, and ``escape`` replaces an end of comment."""
    texts = (" ".join(line.splitlines()) for line in lines)
    return "".join(f"{mark}{text.replace(*escape) if escape[0] else text}{end}" for text in texts)


def _json(content: Any, indent: int = 2) -> str:  # noqa: ANN401
    return json.dumps(as_json(content), indent=indent, allow_nan=False)


def _yaml(content: Any) -> str:  # noqa: ANN401
    """Return YAML with keys in their order and short lists on one line, by the faster libyaml if it is available."""
    dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
    return str(yaml.dump(as_json(content), Dumper=dumper, sort_keys=False, default_flow_style=None, width=120))


def _numbers(values: Any, form: str = "%.17g", separator: str = " ") -> str:  # noqa: ANN401
    return separator.join(form % value for value in values)


@dataclass
class SensorPlan:
    """The effects of one sensor as assignments in C, and the omitted effects with the reason."""

    bias: list[str]
    matrix: list[list[str]]
    steady: list[str] = field(default_factory=list)
    moving: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)


def plan_of(sensors: dict[str, ExportedSensor]) -> JSON:
    """Return the contents of ``calibration.h``; the readings of a sensor without a calibration are unchanged."""
    plans: dict[str, SensorPlan] = {}
    steps: dict[str, Steps] = {}
    with_time: set[str] = set()
    for sensor in SENSORS:
        calibration = sensors[sensor].calibration if sensor in sensors else SensorCalibration(sensor)
        matrix = [[c_number(x) for x in row] for row in calibration.matrix.tolist()]
        plan = plans[sensor] = SensorPlan([c_number(b) for b in calibration.bias.tolist()], matrix)
        reasons = {fitted.name: _not_in_c(sensor, fitted) for fitted in sensor_effects(calibration)}
        plan.left_out += [f"{name} ({reason})" for name, reason in reasons.items() if reason]
        step = steps[sensor] = Steps.of(sensor, [e for e in sensor_effects(calibration) if not reasons[e.name]])
        for effects, lines in ((step.steady, plan.steady), (step.moving, plan.moving)):
            for fitted in effects:
                needs_time = bool(step.fields[fitted.name] & ({"time", "temperature_rate"} | OF_THE_PAST))
                condition = "if (!m->alone) " if needs_time else ""
                with_time |= {fitted.name} if needs_time else set()
                terms = effect_of(fitted).in_c(fitted.values) or ()
                lines += [f"{condition}r[{i}] -= {term}; /* {fitted.name} */" for i, term in enumerate(terms)]
    circular_sensors, used = circular(steps), set().union(*(step.used for step in steps.values()))
    past = bool(used & OF_THE_PAST)
    return {
        "sensors": plans,
        "circular_sensors": circular_sensors,
        "past": past,
        "temperature": bool(used & {"temperature", "temperature_rate"}),
        "temperature_rate": "temperature_rate" in used,
        "rate_memory": max(SMOOTHING_S, RATE_SMOOTHING_S),
        "with_time": sorted(with_time),
        "rounds": FIXED_POINT_ITERATIONS if circular_sensors else 1,
        "ends": FIXED_POINT_ITERATIONS if circular_sensors and past else 1,
        "functions": {name for p in plans.values() for line in p.steady + p.moving for name in CALL.findall(line)},
        "memory": SMOOTHING_S,
        "reference": c_number(REFERENCE_TEMPERATURE),
    }


def _not_in_c(sensor: str, fitted: FittedEffect) -> str:
    """Return the reason why the header omits an effect; empty if it contains the effect."""
    if fitted.definition and "python" in fitted.definition:
        return "it is in Python; python -m pipeline apply --python-effect subtracts it"
    effect = effect_of(fitted)
    if effect.in_c(fitted.values) is None:
        return "its equation has no form in C; python -m pipeline apply subtracts it"
    unknown = sorted(effect.fields(sensor, fitted.values) - IN_C)
    return f"it needs {', '.join(unknown)}, which this header does not know" if unknown else ""
