"""Read the printed figures, and the results of a run of the campaign, by device, procedure and method."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from pipeline.pack import Pack, read_published
from pipeline.records import Noise, Recording, Values
from pipeline.stages.unit_files import recordings_of
from pipeline.validation.samples import samples_of_motion

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path


JSON = dict[str, Any]
AXES = "xyz"
DEVICES = {"mpu6050-1": "MPU6050 (1)", "mpu6050-2": "MPU6050 (2)", "stim300": "STIM300"}
TABLES = {"acutronic": "precise table", "mark2": "home-made table"}
STOPS = ("stop-1s", "stop-5s", "stop-10s")
CONTINUOUS = tuple(f"continuous-{rate}dps" for rate in ("0.5", "1", "5", "10", "30"))
RATES = tuple(f"gyro-{rate}dps" for rate in (20, 60, 80, 100, 200))
SILENT = Noise(np.zeros(3), np.zeros(3), 100.0, "none")  # mean errors do not depend on the noise


def read_printed(folder: Path, name: str) -> pd.DataFrame:
    """Read a file of printed figures, with a row for each line of a printed table.

    Devices are named as in the campaign; ``procedure`` and ``set`` name the recordings of a row.
    """
    rows = pd.read_csv(folder / f"{name}.csv", dtype={"table": str, "error_table": str})
    if "device" in rows:
        rows["device"] = rows["device"].str.lower()
    if "rate_table" in rows:
        kinds = rows["procedure"] if "procedure" in rows else ["gyro_rate"] * len(rows)
        rows["procedure"] = [
            f"stop-{row['dwell_s']:g}s" if kind == "stop" else f"{kind.removesuffix('_rate')}-{row['speed_dps']:g}dps"
            for kind, row in zip(kinds, rows.to_dict("records"), strict=True)
        ]
        table = rows["rate_table"].map({"acutronic": "-", "mark2": "-mark2-"})
        rows["set"] = rows["device"] + table + rows["procedure"]
    return rows


def in_words(procedure: str) -> str:
    """Return a procedure in words."""
    kind, _, value = procedure.partition("-")
    return f"{kind} {value.removesuffix('dps')} deg/s" if value.endswith("dps") else f"{kind} {value[:-1]} s"


@dataclass(frozen=True)
class Results:
    """The results of one run, in ``folder``. A unit is named ``<set of recordings>-<method>``."""

    folder: Path

    def fit(self, unit: str, sensor: str) -> JSON | None:
        """Return a sensor's part of a unit's calibration; None where the unit failed."""
        part: JSON | None = _read(self.folder / "calibrations" / f"{unit}.json").get(sensor)
        return part

    def calibration(self, unit: str, sensor: str) -> tuple[Values, Values]:
        """Return bias and matrix of a sensor, NaN where the unit failed."""
        fit = self.fit(unit, sensor) or {"bias": [np.nan] * 3, "matrix": [[np.nan] * 3] * 3}
        return np.array(fit["bias"]), np.array(fit["matrix"])

    def parameter(self, unit: str, sensor: str, stage: str, name: str) -> float:
        """Return a parameter that a stage estimated, or NaN."""
        for found in (self.fit(unit, sensor) or {}).get("stages", ()):
            if found["name"] == stage and name in found["parameters"]:
                return float(found["parameters"][name]["value"])
        return np.nan

    def correction(self, unit: str, sensor: str) -> JSON | None:
        """Return the correction of readings after the last stage of a fit."""
        stages = (self.fit(unit, sensor) or {}).get("stages", ())
        return stages[-1]["correction"] if stages else None

    def errors(self, unit: str, sensor: str, metric: str = "mean_abs_error") -> tuple[float, float, float]:
        """Return a held-out error before calibration, after the last stage, and the change in percent, or NaN."""
        steps = (_read(self.folder / "validations" / f"{unit}.json").get(sensor) or {}).get("steps", ())
        before, after = (
            float(np.array([np.nan, *(s[metric] for s in steps if s["name"].startswith(kind))], float)[-1])
            for kind in ("raw", "stage:")
        )
        return before, after, 100.0 * (before - after) / before

    def recordings(self, unit: str, role: str) -> list[Recording]:
        """Return the filtered recordings of a role; none where the unit failed."""
        for file in self.folder.glob("batches/*/filter.zip"):
            packs = {stage: Pack(file.with_name(f"{stage}.zip")) for stage in ("ingest", "filter")}
            if f"{unit}.noise.json" in packs["filter"]:
                return [r for r in recordings_of(packs, unit) if r.role == role]
        return []

    def with_printed(self, name: str, sensor: str, parameters: Mapping[str, float]) -> float:
        """Return the mean |e| on the held-out motion of a set of recordings with printed parameters, or NaN.

        ``S (O M a - b)`` for the accelerometer (eq. 3.2), ``(g - b) M S`` for the gyroscope (3.45).
        """
        held_out = self.recordings(f"{name}-printed", "validation")
        if not held_out:
            return np.nan
        samples = samples_of_motion(sensor, held_out[0], SILENT, {"gravity_g": 1.0})
        assert samples is not None  # noqa: S101  (the table logs its rate)
        if sensor == "accelerometer":
            O, M, S, b = (values(parameters, pattern) for pattern in ("O_{}", "M_{}", "S_{}", "b_{}_g"))
            corrected = S * (O * M * samples.reading - b)
        else:
            matrix, S, b = matrix_of(parameters, "M"), values(parameters, "S_{}"), values(parameters, "b_{}_dps")
            corrected = (samples.reading - b) @ matrix * S
        return float(np.mean(np.abs(np.linalg.norm(corrected, axis=1) - samples.magnitude)))


def values(row: Mapping[str, float], pattern: str) -> Values:
    """Return the printed values of x, y and z from the columns ``pattern``: (3,) array."""
    return np.array([row[pattern.format(axis)] for axis in AXES])


def matrix_of(row: Mapping[str, float], letter: str) -> Values:
    """Return a printed matrix from the columns ``<letter>11`` to ``<letter>33``: (3, 3) array."""
    return np.array([[row[f"{letter}{i}{j}"] for j in (1, 2, 3)] for i in (1, 2, 3)])


@cache
def _read(path: Path) -> JSON:
    try:
        found: JSON = json.loads(read_published(path))
    except FileNotFoundError:
        return {}
    return found
