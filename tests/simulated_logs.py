"""Simulated recordings beside a table's log, and their truth."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from imu_logs.log import Log
from imu_logs.units import ATTITUDE, TRIADS
from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import UnitDescription

if TYPE_CHECKING:
    from pipeline.core.records import Recording

COURSE = {"step_deg": 30.0, "validation_s": 60.0, "static_s": 20.0}


def beside_a_table(seed: int = 0, interval_s: float = 0.02, **table_log: Any) -> tuple[dict[str, Recording], Any]:
    """Return a unit's recordings and the table's logs, ``accel_x`` and ``accel_x_table``, and the truth."""
    unit = UnitDescription("U", course=COURSE, interval_s=interval_s, table_log={"kind": "file", **table_log})
    recordings, truth = simulate_unit(unit, seed, 0)
    return {r.name: r for r in recordings}, truth


def as_table(recording: Recording) -> Log:
    """Return a recording as a reader hands it on."""
    values = {}
    for channels, readings in (
        (TRIADS["accelerometer"], recording.accelerometer),
        (TRIADS["gyroscope"], recording.gyroscope),
        (ATTITUDE, recording.table_attitude),
    ):
        values |= {} if readings is None else dict(zip(channels, readings.T, strict=True))
    for name in ("table_angle", "table_rate"):
        if getattr(recording, name) is not None:
            values[name] = getattr(recording, name)
    return Log(recording.name, recording.time_ns, values, {}, np.arange(recording.samples))


def clock_errors(
    aligned: Log | Recording, recording: Recording, truth: dict[str, Any]
) -> tuple[float, float, float, float]:
    """Return offset (s) and drift (ppm) found minus hidden, each with its standard uncertainty."""
    clock, hidden = aligned.source["table_clock"], truth["table_clock"]
    at = float(recording.time[0]) + clock["at_s"]
    offset = clock["offset_s"] - (hidden["offset_s"] + 1e-6 * hidden["drift_ppm"] * at)
    drift = clock["drift_ppm"] - hidden["drift_ppm"]
    return offset, clock["offset_uncertainty_s"], drift, clock["drift_uncertainty_ppm"]
