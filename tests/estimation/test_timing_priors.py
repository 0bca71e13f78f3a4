"""Offset, rate and lag between table and sensor as parameters with priors, on simulated units whose truth is known."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from imu_research.study.bench import recordings_of
from imu_research.study.cases import draw
from imu_research.study.run import diagnose_case
from pipeline.app.one_unit import unit_of_recordings
from pipeline.core.records import SensorCalibration
from pipeline.core.settings import OF_BENCH, Table
from pipeline.physics.effects import bench_priors
from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import UnitDescription

if TYPE_CHECKING:
    from pipeline.core.records import Recording

COURSE: dict[str, Any] = {
    "validation_s": 40.0, "static_s": 30.0, "warm_up_rest_s": 15.0, "step_deg": 30.0, "dwell_s": 1.5,
    "rates_dps": (60.0,), "both_directions": True,
}  # fmt: skip
HIDDEN = {"time_offset": [0.008], "low_pass_lag": [0.004], "clock_rate": [90.0]}
STATED = {"time_offset_s": 0.005, "lag_s": 0.005, "clock_accuracy_ppm": 100.0}
UNIT = UnitDescription(
    "u", course=COURSE, effects={f"{s}.{n}": v for s in ("accelerometer", "gyroscope") for n, v in HIDDEN.items()}
)


def logged(recording: Recording, rate: bool) -> Recording:  # noqa: FBT001  (a case of a test)
    """Return a turn whose table logs the angle, with its rate or without; held-out motion has an attitude."""
    return recording if rate or recording.role == "validation" else replace(recording, table_rate=None)


@pytest.mark.parametrize(("sensor", "rate"), [("gyroscope", False), ("accelerometer", True)])
def test_stated_timing_is_estimated_whatever_the_table_logs(sensor: str, rate: bool) -> None:  # noqa: FBT001
    recordings, truth = simulate_unit(UNIT, 3, 0)
    layers = ["sensor=mpu6050", *(f"table.{key}={value}" for key, value in STATED.items())]
    state = unit_of_recordings([logged(r, rate) for r in recordings], layers).run_to("diagnose")
    found = state.fits[sensor]
    assert isinstance(found, SensorCalibration)
    assert found.covariance is not None
    assert state.validation is not None
    assert state.diagnosis is not None
    u = np.sqrt(np.diag(found.covariance))
    assert {e.name for e in found.effects} == set(HIDDEN)
    error = np.concatenate([found.bias - truth[sensor]["bias"], (found.matrix - truth[sensor]["matrix"]).ravel()])
    assert np.abs(error / u[:12]).max() < 4.0
    size = np.concatenate([HIDDEN[e.name] for e in found.effects])
    values = np.concatenate([e.values for e in found.effects])
    assert np.abs((values - size) / u[12:]).max() < 4.0
    held, said = state.validation[sensor], state.diagnosis[sensor]
    low, high = held["expected_rms_error"]
    assert low <= held["steps"][-1]["rms_error"] <= high
    assert said["verdict"] == "nothing_missing"
    assert not set(HIDDEN) & {entry["effect"] for entry in said["ranking"]}


def test_a_slow_clock_is_found_beside_effects_that_could_take_its_signal() -> None:
    """At 1400 s the clock is wrong by 0.36 s, longer than the ramps of the turns: one linear step is of no use."""
    case = draw("pairs_wander", 5, 84)
    assert set(case.hidden) == {"clock_rate", "table_rate_ripple"}
    names = ", ".join([*case.hidden, "scale_factor_temperature"])
    layers = [f"sensor={case.model}", f"effects.gyroscope=[{names}]"]
    fit = unit_of_recordings(recordings_of(case), layers).run_to("fit").fits["gyroscope"]
    assert isinstance(fit, SensorCalibration)
    found = {e.name: e.values for e in fit.effects}
    assert found["clock_rate"] == pytest.approx(case.hidden["clock_rate"], abs=0.1)
    assert found["table_rate_ripple"][:4] == pytest.approx(case.hidden["table_rate_ripple"][:4], abs=2e-5)


def test_a_slow_clock_alone_is_all_that_is_selected() -> None:
    """The readings at the corners of ramps come 0.48 s late: these rows, not those logged there, are not explained."""
    case = draw("lost", 12, 84)
    assert list(case.hidden) == ["clock_rate"]
    _, state = diagnose_case(case)
    assert state.diagnosis is not None
    assert state.diagnosis["gyroscope"]["selected"] == ["clock_rate"]


def test_rests_leave_the_offset_as_uncertain_as_its_prior() -> None:
    recordings, _ = simulate_unit(replace(UNIT, effects={}), 3, 0)
    unit = unit_of_recordings(recordings, ["sensor=mpu6050", "table.time_offset_s=0.005"])
    state = unit.run_to("filter")
    assert state.recordings is not None
    rests = []
    for recording in (r for r in state.recordings.filtered if r.role == "accelerometer"):
        assert recording.accelerometer is not None
        assert recording.table_rate is not None
        moving = np.abs(recording.table_rate)[:, None] > 1e-9
        rests.append(replace(recording, accelerometer=np.where(moving, np.nan, recording.accelerometer)))
    state.recordings = replace(state.recordings, filtered=rests)
    found = unit.run_to("fit", first="fit", state=state).fits["accelerometer"]
    assert isinstance(found, SensorCalibration)
    assert found.covariance is not None
    assert np.sqrt(found.covariance[12, 12]) == pytest.approx(0.005, rel=0.02)


def test_priors_of_the_catalogue_are_settings_of_a_table() -> None:
    assert sorted(bench_priors().values()) == sorted(OF_BENCH)
    assert set(OF_BENCH) <= set(Table.model_fields)
