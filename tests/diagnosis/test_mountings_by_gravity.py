"""A gyroscope whose mountings the accelerometer determines, where the accelerometer hides an effect of its own."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "study"))
from bench_units import drawn, judged
from unit_settings import with_noise

from pipeline.app.one_unit import unit_row
from pipeline.checks.checks import check_recordings
from pipeline.core.records import SensorCalibration, SensorDiagnosis
from pipeline.core.verdicts import Verdict
from pipeline.estimation.effects import mountings_by_gravity
from pipeline.evaluation.diagnosis.diagnose import _doubts_of_gravity
from pipeline.evaluation.diagnosis.findings import DiagnosisInput
from pipeline.simulation.campaign import simulate_unit


def test_an_effect_of_the_accelerometer_is_not_taken_for_mountings() -> None:
    found = judged("seats", 62, 0, 1.0)
    assert found["hidden"] == "accelerometer.scale_factor_asymmetry"
    gyroscope = found["sensors"]["gyroscope"]
    assert gyroscope["verdict"] == "nothing_missing"
    assert np.abs(gyroscope["error_over_U"]).max() < 1.3  # of 12 parameters; 1.47 where the effect is in the mountings


def test_mountings_are_in_doubt_where_the_accelerometer_shows_an_error_of_the_table() -> None:
    found = judged("seats", 62, 19, 1.0)
    assert found["hidden"] == "accelerometer.table_rate_ripple"
    gyroscope = found["sensors"]["gyroscope"]
    assert gyroscope["verdict"] == "reference_in_doubt"
    assert "the accelerometer, which determines the mountings, misses" in gyroscope["reason"]


@pytest.mark.parametrize(("tilt_deg", "doubted"), [(0.01, False), (0.6, True)])
def test_a_tilt_that_shifts_no_mounting_is_no_doubt_about_the_gyroscope(tilt_deg: float, *, doubted: bool) -> None:
    description, _ = drawn("seats", 62, 0, 0.0)
    description = replace(description, effects={"accelerometer.table_tilt": [0.0, tilt_deg]})
    recordings, _ = simulate_unit(description, 62, 0)
    recordings = [replace(r, table_attitude=None) for r in recordings]
    settings = unit_row([f"sensor={description.sensor}", f"table={description.table}"]).config
    recordings = check_recordings(recordings, settings)
    unit = with_noise(recordings, settings)
    by_gravity, noise = mountings_by_gravity(unit, settings), unit.noises["gyroscope"]
    assert noise is not None
    case = DiagnosisInput(SensorCalibration("gyroscope"), recordings, noise, settings, by_gravity, ["mounting"])
    found = _doubts_of_gravity(SensorDiagnosis(Verdict.MISSING_EFFECT, [], selected=["table_tilt"]), case)
    assert bool(found) is doubted
