"""Exports: a calibration in the formats of the programs that use it. One template in ``templates/`` is one format.

A template has two parts, separated by a line ``---``: a declaration (``Format``: what the format can hold, in which
units, and how ``reading`` reads it back), and the text of the file in Jinja2. The text sees

    accelerometer, gyroscope   ``sensors.ExportedSensor`` in the units of the format, None where it is not calibrated
    sensors                    those of the two that are calibrated, by name
    remarks                    convention, what is left out, the error that remains, the held-out errors
    unit, document, settings   name of the unit, its calibration, the sections ``sensor`` and ``table``

and the functions of ``sensors.FUNCTIONS``. The file has the name of its template without ``.j2``. There is no list to
extend.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Literal

import yaml
from jinja2 import Environment, StrictUndefined, Template

from pipeline.exports.c_effects import plan_of
from pipeline.exports.sensors import FUNCTIONS, ExportedSensor, before_use, final_errors, noise_remarks, plain
from pipeline.records import SENSORS, SensorCalibration

JSON = dict[str, Any]
TEMPLATES = Path(__file__).parent / "templates"


@dataclass(frozen=True, kw_only=True)
class Format:
    """What a format can hold.

    Attributes
    ----------
    consumer, equation, source : str
        Who reads the file, how it corrects a reading, and where that is documented.
    units : dict
        Sensor to the unit of readings: g or m/s^2, deg/s or rad/s. A sensor without a unit is not in the format.
    needs, needs_counts : list of str
        Sensors that must be calibrated (``board``: the unit must be the reference chip of a board), and whose counts
        per unit must be known; without them no file is written.
    matrix : dict
        Sensor to what the format holds of its matrix; ``full`` by default.
    holds : list of str
        Effects that the format carries in addition to bias and matrix; ``any``: the template deals with all of them.
    approximates : dict of str to str
        Effect that the format carries in part, to how well.
    says, adds, adds_with_temperature : list of str
        Remarks: before the others, after what is left out, and there where a bias follows the temperature.
    noise : bool
        Whether the format carries noise parameters: remarks state their origin, interval and the effective density.
    errors : str
        How the held-out errors are introduced; by default as those of the export, or of the full calibration.
    files : dict
        Sensor to file name, where each sensor has a file of its own.
    reads : dict
        How the file is read back (``pipeline.exports.reading``); empty where it holds no calibration.
    """

    consumer: str
    equation: str
    source: str
    says: list[str]
    units: dict[str, Literal["g", "m/s^2", "deg/s", "rad/s"]]
    needs: list[str] = field(default_factory=list)
    needs_counts: list[str] = field(default_factory=list)
    matrix: dict[str, Literal["full", "diagonal", "none"]] = field(default_factory=dict)
    holds: list[str] = field(default_factory=list)
    approximates: dict[str, str] = field(default_factory=dict)
    adds: list[str] = field(default_factory=list)
    adds_with_temperature: list[str] = field(default_factory=list)
    noise: bool = False
    errors: str | None = None
    files: dict[str, str] = field(default_factory=dict)
    reads: JSON = field(default_factory=dict)


@cache
def formats() -> dict[str, tuple[Format, Template]]:
    """Return declaration and text of every format, by the name of the template, in alphabetical order."""
    environment = Environment(
        autoescape=False,  # noqa: S701  (no HTML; each comment filter closes its own comments)
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        undefined=StrictUndefined,
        extensions=["jinja2.ext.do"],
    )
    environment.filters |= {"comment": _comment, "json": _json, "yaml": _yaml, "numbers": _numbers}
    environment.globals |= {**FUNCTIONS, "plan_of": plan_of}
    found = {}
    for file in sorted(TEMPLATES.glob("*.j2")):
        declared, _, text = file.read_text(encoding="utf-8").partition("\n---\n")
        found[file.stem] = Format(**yaml.safe_load(declared)), environment.from_string(text)
    return found


@dataclass(frozen=True)
class Subject:
    """A unit to export: its documents, as in ``exports``, and what several formats need of them."""

    document: JSON
    settings: JSON
    validation: JSON | None = None
    diagnosis: JSON | None = None

    @cached_property
    def calibrations(self) -> dict[str, SensorCalibration]:
        """Of the sensors that are calibrated."""
        return {s: SensorCalibration.from_json(s, self.document[s]) for s in SENSORS if self.document.get(s)}

    @cached_property
    def noise_remarks(self) -> list[str]:
        """Origin and intervals of the noise parameters."""
        return noise_remarks(self.settings, self.document, self.diagnosis)

    def sensors(self, declared: Format) -> dict[str, ExportedSensor]:
        """Return the calibrated sensors in the units of a format."""
        sheets = self.settings.get("sensor") or {}
        units = declared.units
        return {s: ExportedSensor(c, units[s], sheets.get(s) or {}) for s, c in self.calibrations.items() if s in units}


def exports(
    calibration: JSON, settings: JSON, validation: JSON | None = None, diagnosis: JSON | None = None
) -> dict[str, str]:
    """Return the texts of a calibration in every format, by file.

    ``calibration, validation, diagnosis``: as in the published files of the unit; ``settings``: the sections ``sensor``
    and ``table`` of its configuration.
    """
    subject = Subject(calibration, settings, validation, diagnosis)
    return {file: text for name in formats() for file, text in export(name, subject).items()}


def export(name: str, subject: Subject) -> dict[str, str]:
    """Return the files of one format, by name: none where the format can hold nothing of this unit."""
    declared, template = formats()[name]
    parts = {
        file: replace(declared, units={s: declared.units[s]}, needs=[s]) for s, file in declared.files.items()
    } or {name: declared}
    texts = {file: _rendered(part, template, subject) for file, part in parts.items()}
    return {file: text for file, text in texts.items() if text is not None}


def _rendered(declared: Format, template: Template, subject: Subject) -> str | None:
    """Return the text of a file, None where a sensor or its counts are missing."""
    sensors = subject.sensors(declared)
    without_counts = [s for s in declared.needs_counts if s in sensors and not sensors[s].counts]
    known = {*sensors, "board"} if (subject.document.get("board") or {}).get("chips") else set(sensors)
    if without_counts or not set(declared.needs) <= known:
        return None
    return template.render(
        **{s: sensors.get(s) for s in SENSORS},
        sensors=sensors,
        unit=subject.document["unit"],
        document=subject.document,
        settings=subject.settings,
        remarks=_remarks(declared, sensors, subject) + (subject.noise_remarks if declared.noise else []),
    )


def _remarks(declared: Format, sensors: dict[str, ExportedSensor], subject: Subject) -> list[str]:
    """Return what a reader of the file must know, a sentence or a line each."""
    document = subject.document
    counts = {s: sensor.counts for s, sensor in sensors.items()}
    known = {"unit": document["unit"], "sensor": document["sensor"], "counts": counts, "sensors": [*sensors.values()]}
    lines = [line.format(**known) for line in declared.says] + (before_use(document) if declared.units else [])
    if len(declared.units) == len(SENSORS):
        reasons = document.get("not_calibrated") or {}
        absent = [s for s in SENSORS if not document.get(s)]
        lines += [f"Left out: the {s} is not calibrated: {reasons.get(s, 'no reason given')}." for s in absent]
    carried = [*declared.holds, *declared.approximates]
    partly = any(kind != "full" for kind in declared.matrix.values())
    for s, sensor in sensors.items():
        lost = [] if "any" in declared.holds else [name for name in sensor.effects if name not in carried]
        lines += [f"Left out of this format, {s}: {', '.join(lost)}."] if lost else []
        partly = partly or bool(lost)
        lines += [f"Of the bench, not of the {s}: {', '.join(sensor.bench_effects)}."] if sensor.bench_effects else []
    for s, sensor in sensors.items():
        partial = [name for name in sensor.effects if name in declared.approximates]
        lines += [f"{declared.approximates[name]}, {s}: {name}." for name in partial]
        lines += sensor.left_by_matrix(declared.matrix.get(s, "full"))
    lines += declared.adds + (
        declared.adds_with_temperature if any(x.follows_temperature for x in sensors.values()) else []
    )
    errors = declared.errors or ("With all of the calibration: {}." if partly else "The {}.")
    of_these = [line for s in SENSORS for line in final_errors(subject.validation, s) if s in declared.units]
    return lines + [errors.format(line) for line in of_these]


def _comment(lines: list[str], mark: str = "# ", end: str = "\n", *, escape: tuple[str, str] = ("", "")) -> str:
    """Return lines as comments; line ends that users wrote stay inside, and what would end the comment is split."""
    texts = (" ".join(line.splitlines()) for line in lines)
    return "".join(f"{mark}{text.replace(*escape) if escape[0] else text}{end}" for text in texts)


def _json(content: Any, indent: int = 2) -> str:  # noqa: ANN401
    return json.dumps(plain(content), indent=indent, allow_nan=False)


def _yaml(content: Any) -> str:  # noqa: ANN401
    """Return YAML, keys in their order and short lists on one line; by libyaml, which is faster, where there is one."""
    dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
    text: str = yaml.dump(plain(content), Dumper=dumper, sort_keys=False, default_flow_style=None, width=120)
    return text


def _numbers(values: Any, form: str = "%.17g", separator: str = " ") -> str:  # noqa: ANN401
    return separator.join(form % value for value in values)
