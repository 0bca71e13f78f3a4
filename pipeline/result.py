"""The result of ``pipeline.calibrate``: the documents that a run publishes of a unit, and what they are used for."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import InputError
from pipeline.files import write_atomically
from pipeline.io.units import CANONICAL, TRIADS
from pipeline.model.compensation import Compensation, compensation_of
from pipeline.pack import as_bytes
from pipeline.records import SENSOR_UNITS, SENSORS, Values
from pipeline.unit import Task, UnitState, run_step

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import pandas as pd

    from pipeline.one_unit import ConfiguredUnit

DIGITS = 5  # significant, of the figures that are printed


@dataclass(frozen=True)
class SensorResult:
    """The calibration of one sensor: ``truth = matrix @ (reading - bias - effects)``."""

    unit: str  # g or deg/s
    bias: Values  # (3,), in that unit
    matrix: Values  # (3, 3), dimensionless
    expanded_uncertainty: dict[str, Values]  # of ``bias`` and ``matrix``, 95 %
    effects: dict[str, dict[str, dict[str, Any]]]  # effect to its parameters: value, unit, expanded_uncertainty

    @classmethod
    def of(cls, part: Mapping[str, Any]) -> SensorResult:
        """Return the calibration from a sensor's part of ``calibrations/<unit>.json``."""
        return cls(
            part["unit"],
            np.array(part["bias"]),
            np.array(part["matrix"]),
            {name: np.array(part["expanded_uncertainty"][name]) for name in ("bias", "matrix")},
            {effect["name"]: effect["parameters"] for effect in part["effects"]},
        )


@dataclass(frozen=True)
class UnitResult:
    """A calibrated unit.

    ``calibration``, ``validation`` and ``diagnosis`` are the documents that a run publishes. ``notes``: what the inputs
    showed, and what a run would take from other units.
    """

    calibration: dict[str, Any]
    validation: dict[str, Any]
    diagnosis: dict[str, Any]
    notes: list[str]
    _configured: ConfiguredUnit = field(repr=False)
    _state: UnitState = field(repr=False)

    @classmethod
    def of(cls, configured: ConfiguredUnit, state: UnitState, notes: Sequence[str] = ()) -> UnitResult:
        """Return the result of a unit after its steps."""
        # As read from the published files, in which a tuple is a list and a number of numpy a number.
        documents = (state.calibration, state.validation, state.diagnosis)
        calibration, validation, diagnosis = (json.loads(as_bytes(document)) for document in documents)
        of_inputs = [f"{i['recording']}: {n['detail']}" for i in calibration["inputs"] for n in i["notes"]]
        told = [*notes, *dict.fromkeys(of_inputs)]
        return cls(calibration, validation, diagnosis, told, configured, state)

    @property
    def accelerometer(self) -> SensorResult | None:
        """Calibration of the accelerometer; None if it is not calibrated."""
        return self._part("accelerometer")

    @property
    def gyroscope(self) -> SensorResult | None:
        """Calibration of the gyroscope; None if it is not calibrated."""
        return self._part("gyroscope")

    def _part(self, sensor: str) -> SensorResult | None:
        part = self.calibration[sensor]
        return SensorResult.of(part) if part else None

    @property
    def verdict(self) -> dict[str, str]:
        """Verdict on each calibrated sensor."""
        return {s: self.diagnosis[s]["verdict"] for s in SENSORS if self.calibration[s] and self.diagnosis[s]}

    @cached_property
    def _compensation(self) -> Compensation:
        return compensation_of(self.calibration)

    def apply(self, log: pd.DataFrame) -> pd.DataFrame:
        """Return a log with calibrated readings: the same columns and index.

        Columns are those of the canonical CSV; a sensor without all three columns, or without a calibration, and all
        other columns are unchanged. Raises ``InputError`` where a fitted effect needs a column that is absent.
        """
        columns = {s: [CANONICAL[channel] for channel in TRIADS[s]] for s in SENSORS}
        present = {s: names for s, names in columns.items() if set(names) <= set(log.columns)}
        if not present:
            names = ", ".join(name for names in columns.values() for name in names)
            raise InputError(f"the log has none of the sensors' columns; the three of a sensor are expected: {names}")
        signals: dict[str, Any] = {s: log[names].to_numpy(float) for s, names in present.items()}
        for signal in ("temperature", "time"):
            if CANONICAL[signal] in log:
                signals[signal] = log[CANONICAL[signal]].to_numpy(float)
        with self._configured.environment():
            found = self._compensation.apply(**signals)
        out = log.copy()
        for sensor, columns_of_sensor in present.items():
            if self.calibration[sensor]:
                out[columns_of_sensor] = getattr(found, sensor)
        return out

    def _files(self) -> dict[str, Any]:
        """Return the files that a run publishes of the unit, by their path in a results folder."""
        unit, diagnosed = self.calibration["unit"], self._state.diagnosed
        pages = self._made("report").items()
        return {
            f"calibrations/{unit}.json": self.calibration,
            f"validations/{unit}.json": self.validation,
            f"diagnoses/{unit}.json": self.diagnosis,
            **{f"diagnoses/{name}": text for name, text in diagnosed.effect_files.items()},
            **{f"exports/{unit}/{name}": text for name, text in self._made("export").items()},
            **{name if name.startswith("certificates/") else f"reports/{name}": page for name, page in pages},
        }

    def _made(self, step: str) -> Any:  # noqa: ANN401  (each step has its type)
        task = Task(step)
        with self._configured.environment():
            return run_step(task, self._state, self._configured.settings(task))

    def save(self, folder: str | Path) -> None:
        """Write the files that a run publishes of the unit into a folder, in the layout of a results folder."""
        for name, content in self._files().items():
            path = Path(folder, name)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, as_bytes(content))

    def report(self, path: str | Path) -> None:
        """Write the page of the unit, one HTML file that opens without a network."""
        page = self._made("report")[f"{self.calibration['unit']}.html"]
        write_atomically(Path(path), as_bytes(page))

    def __repr__(self) -> str:
        """Return bias, matrix, held-out error and verdict of each sensor, in at most 16 lines."""
        document = self.calibration
        lines = [f"{document['unit']}: {document['sensor']}, {document['procedure']}, {document['method']}"]
        for sensor in SENSORS:
            part = self._part(sensor)
            if part is None:
                lines.append(f"{sensor}: null, {document['not_calibrated'].get(sensor, '')}"[:150])
                continue
            lines.append(f"{sensor}: {self.verdict.get(sensor, '')}{self._missing(sensor)}")
            lines.append(f"  bias {_row(part.bias)} {SENSOR_UNITS[sensor]}")
            lines += [f"  {'matrix' if i == 0 else '      '} {_row(row)}" for i, row in enumerate(part.matrix)]
            lines.append(f"  held-out rms error {self._held_out(sensor)}")
        return "\n".join(lines)

    def _missing(self, sensor: str) -> str:
        selected = self.diagnosis[sensor]["selected"] if self.diagnosis[sensor] else []
        return f" ({', '.join(selected)})" if selected else ""

    def _held_out(self, sensor: str) -> str:
        held_out, unit = self.validation[sensor], SENSOR_UNITS[sensor]
        if not held_out or not held_out["held_out"]:
            return "not known: no held-out motion"
        before, after = (held_out["steps"][i]["rms_error"] for i in (0, -1))
        floor = held_out["noise_floor"]
        return f"{before:.3g} -> {after:.3g} {unit}" + ("" if floor is None else f", noise floor {floor:.3g} {unit}")


def _row(values: Values) -> str:
    return " ".join(f"{value: .{DIGITS}g}" for value in values)
