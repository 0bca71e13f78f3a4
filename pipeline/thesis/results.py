"""What a run of the campaign found, by device, procedure and method."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.io.parquet import load_recordings
from pipeline.records import Noise
from pipeline.validation.samples import samples_of_motion

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.records import Recording

JSON = dict[str, Any]
DEVICES = {"mpu6050-1": "MPU6050 (1)", "mpu6050-2": "MPU6050 (2)", "stim300": "STIM300"}
TABLES = {"acutronic": "precise table", "mark2": "home-made table"}
STOPS = ("stop-1s", "stop-5s", "stop-10s")
CONTINUOUS = tuple(f"continuous-{rate}dps" for rate in ("0.5", "1", "5", "10", "30"))
RATES = tuple(f"gyro-{rate}dps" for rate in (20, 60, 80, 100, 200))


@dataclass(frozen=True)
class Results:
    """The results of one run.

    Attributes
    ----------
    folder : Path
        ``results/thesis``.
    """

    folder: Path

    def fit(self, unit: str, sensor: str) -> JSON | None:
        """Return a sensor's part of a unit's calibration; None where the unit failed."""
        part: JSON | None = _read(self.folder / "calibrations" / f"{unit}.json").get(sensor)
        return part

    def parameter(self, unit: str, sensor: str, stage: str, name: str) -> float | None:
        """Return what a stage found, or None."""
        for found in (self.fit(unit, sensor) or {}).get("stages", ()):
            if found["name"] == stage and name in found["parameters"]:
                return float(found["parameters"][name]["value"])
        return None

    def correction(self, unit: str, sensor: str) -> JSON | None:
        """Return how the last stage of a fit corrects readings."""
        stages = (self.fit(unit, sensor) or {}).get("stages", ())
        return stages[-1]["correction"] if stages else None

    def step(self, unit: str, sensor: str, name: str) -> JSON:
        """Return a step of a unit's held-out errors: ``raw``, or ``last`` for the last stage's."""
        steps = (_read(self.folder / "validations" / f"{unit}.json").get(sensor) or {}).get("steps", ())
        stages = [s for s in steps if s["name"].startswith("stage:")]
        if name == "last":
            return stages[-1] if stages else {}
        return next((s for s in steps if s["name"] == name), {})

    def error(self, unit: str, sensor: str, name: str = "last") -> float | None:
        """Return the mean |e| of a step."""
        value: float | None = self.step(unit, sensor, name).get("mean_abs_error")
        return value

    def recordings(self, unit: str) -> list[Recording]:
        """Return a unit's recordings behind its filter; none where it failed."""
        files = list(self.folder.glob(f"batches/*/filter/{unit}.parquet"))
        return load_recordings(files[0]) if files else []

    def with_printed(self, name: str, sensor: str, parameters: Mapping[str, str]) -> float | None:
        """Return the mean |e| that printed parameters leave on the held-out motion of a set of recordings.

        ``S (O M a - b)`` for the accelerometer (eq. 3.2), ``(g - b) M S`` for the gyroscope (3.45).
        """
        held_out = next((r for r in self.recordings(f"{name}-printed") if r.role == "validation"), None)
        if held_out is None:
            return None
        silent = Noise(np.zeros(3), np.zeros(3), 100.0, "none")
        samples = samples_of_motion(sensor, held_out, silent, {"gravity_g": 1.0})
        assert samples is not None  # noqa: S101  (the table logs its rate)

        def vector(pattern: str) -> NDArray[np.float64]:
            return np.array([float(parameters[pattern.format(axis)]) for axis in "xyz"])

        if sensor == "accelerometer":
            corrected = vector("S_{}") * (vector("O_{}") * vector("M_{}") * samples.reading - vector("b_{}_g"))
        else:
            matrix = np.array([[float(parameters[f"M{i}{j}"]) for j in (1, 2, 3)] for i in (1, 2, 3)])
            corrected = (samples.reading - vector("b_{}_dps")) @ matrix * vector("S_{}")
        return float(np.mean(np.abs(np.linalg.norm(corrected, axis=1) - samples.magnitude)))


@cache
def _read(path: Path) -> JSON:
    found: JSON = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    return found


def procedure_of(row: Mapping[str, str]) -> str:
    """Return the procedure of a row of a printed table, as the campaign's units name it."""
    if row.get("dwell_s"):
        return f"stop-{float(row['dwell_s']):g}s"
    kind = "gyro" if "M11" in row or row.get("procedure") == "gyro_rate" else "continuous"
    return f"{kind}-{float(row['speed_dps']):g}dps"


def set_of(device: str, table: str, procedure: str) -> str:
    """Return the name of a set of recordings."""
    return f"{device.lower()}-{'mark2-' if table == 'mark2' else ''}{procedure}"


def in_words(procedure: str) -> str:
    """Return a procedure as a reader says it."""
    kind, _, value = procedure.partition("-")
    return f"{kind} {value.removesuffix('dps')} deg/s" if value.endswith("dps") else f"{kind} {value[:-1]} s"
