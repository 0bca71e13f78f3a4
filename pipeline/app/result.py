"""The result of ``pipeline.calibrate``: the documents that a run publishes of a unit, and what they are used for."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from imu_logs.units import CANONICAL, SECOND_NS, SINCE_1970_NS, TRIADS
from pipeline.core.errors import InputError
from pipeline.core.files import write_atomically
from pipeline.core.pack import as_bytes
from pipeline.core.records import SENSOR_UNITS, SENSORS, Values
from pipeline.core.verdicts import error_of
from pipeline.ingest.axis_maps import in_body_axes, maps_of_log
from pipeline.physics.compensation import Compensation, compensation_of
from pipeline.unit import Task, UnitState, run_step

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import pandas as pd

    from pipeline.app.one_unit import ConfiguredUnit

DIGITS = 5  # significant, of the figures that are printed
WIDTH = 120  # characters of a printed line


@dataclass(frozen=True, eq=False)
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


@dataclass(frozen=True, eq=False)
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
        """Return a log with calibrated readings: the same columns, in the same order, and the same index.

        Columns are those of the canonical CSV, with the axes of the recordings (``sensor.axis_map``); calibrated
        readings are in body axes. A sensor that the log does not contain, or that is not calibrated, and all other
        columns are unchanged. Raises ``InputError`` where an effect needs a column that is absent, and where nothing
        would be calibrated.
        """
        signals = self._signals(log)
        with self._configured.environment():
            stream = self._compensation.stream()
            try:
                found = stream.apply(**signals)
            except InputError as error:
                lacking = {**{s: TRIADS[s] for s in SENSORS}, "temperature": ["temperature"], "time": ["time"]}
                names = [CANONICAL[c] for s in sorted(stream.needs - set(signals)) for c in lacking[s]]
                raise InputError(f"{error.message}; the log has no column {', '.join(names)}") from None
        out = log.copy()
        for sensor in (s for s in SENSORS if s in signals and self.calibration[s]):
            out[[CANONICAL[channel] for channel in TRIADS[sensor]]] = getattr(found, sensor)
        return out

    def _signals(self, log: pd.DataFrame) -> dict[str, Any]:
        """Return the signals of a log: (n, 3) readings in body axes, (n,) temperature and time."""
        import pandas as pd  # noqa: PLC0415  (who calls this has imported it)

        if not isinstance(log, pd.DataFrame):
            raise InputError(f"a pandas DataFrame is expected; got {type(log).__name__}")
        columns = {s: [CANONICAL[channel] for channel in TRIADS[s]] for s in SENSORS}
        known = {s: names for s, names in columns.items() if set(names) & set(log.columns)}
        scalars = [CANONICAL[signal] for signal in ("temperature", "time")]
        if lacking := [n for names in known.values() for n in names if n not in log]:
            raise InputError(f"the log has no column {', '.join(lacking)}; the three of a sensor are expected")
        used = [n for n in (*columns["accelerometer"], *columns["gyroscope"], *scalars) if n in log]
        for name in used:
            if log.columns.get_loc(name).__class__ is not int:
                raise InputError(f"the log has more than one column {name}")
            if log[name].dtype.kind not in "iuf":
                raise InputError(f"column {name} of the log has the dtype {log[name].dtype}; numbers are expected")
        reasons = [f"{s}: {self.calibration['not_calibrated'].get(s, '')}" for s in known if not self.calibration[s]]
        if len(reasons) == len(known):
            expected = ", ".join(name for s in SENSORS if self.calibration[s] for name in columns[s])
            why = f" (not calibrated: {'; '.join(reasons)})" if reasons else ""
            raise InputError(f"the log has no column of a calibrated sensor; expected {expected}{why}")
        maps = maps_of_log(self.calibration["log"])
        values = {n: log[n].to_numpy(np.float64, na_value=np.nan) for n in used}
        signals = {s: in_body_axes(maps[s], np.column_stack([values[n] for n in names])) for s, names in known.items()}
        temperature, time = (values.get(name) for name in scalars)
        if time is not None and len(time) and time[0] * SECOND_NS > SINCE_1970_NS:
            time = time - time[0]  # as the command apply counts it
        return signals | {k: v for k, v in (("temperature", temperature), ("time", time)) if v is not None}

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
        """Return bias, matrix, effects, held-out error and verdict of each sensor, in at most 16 lines."""
        document = self.calibration
        lines = [f"{document['unit']}: {document['sensor']}, {document['procedure']}, {document['method']}"]
        for sensor in SENSORS:
            part = self._part(sensor)
            if part is None:
                lines.append(f"{sensor}: null, {document['not_calibrated'].get(sensor, '')}")
                continue
            missing = self.diagnosis[sensor]["selected"] if self.diagnosis[sensor] else []
            missing = [name for name in missing if name not in part.effects]
            told = f" ({', '.join(missing)})" if missing else ""
            lines.append(f"{sensor}: {self.verdict.get(sensor, '')}{told}")
            lines.append(f"  bias {_row(part.bias)} {SENSOR_UNITS[sensor]}")
            lines += [f"  {'matrix' if i == 0 else '      '} {_row(row)}" for i, row in enumerate(part.matrix)]
            lines += [f"  effects {', '.join(part.effects)}"] if part.effects else []
            lines.append(f"  held-out error {self._held_out(sensor)}")
        return "\n".join(line if len(line) <= WIDTH else f"{line[: WIDTH - 3]}..." for line in lines)

    def _held_out(self, sensor: str) -> str:
        held_out, unit = self.validation[sensor], SENSOR_UNITS[sensor]
        if not held_out or not held_out["held_out"]:
            return "not known: no held-out motion"
        error = error_of(held_out)
        noise = f", {error.ratio:.3g} times the noise floor" if error.ratio else ""
        return f"of the {error.kind} {error.before:.3g} -> {error.after:.3g} {unit}{noise}"


def _row(values: Values) -> str:
    return " ".join(f"{value: .{DIGITS}g}" for value in values)
