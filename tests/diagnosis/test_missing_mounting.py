"""A unit that was mounted anew for each turn on a table that states one mounting: named, added, explained."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pipeline.app.one_unit import unit_of_recordings
from pipeline.core.records import SENSORS, Estimate, Recording, SensorCalibration, SensorDiagnosis
from pipeline.core.verdicts import Verdict
from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import UnitDescription
from tests.published import candidate, diagnose

COURSE: dict[str, Any] = {
    "validation_s": 60.0, "static_s": 60.0, "warm_up_rest_s": 15.0, "step_deg": 15.0, "dwell_s": 1.5,
    "rates_dps": (50.0,), "both_directions": True,
}  # fmt: skip
TURNS = [f"{kind}_{axis}" for kind in ("accel", "gyro") for axis in "xyz"]


LAYERS = ["sensor=stim300", "method=reference_least_squares"]  # one mounting for all turns


def simulated(effects: dict[str, Any] | None = None, **bench: Any) -> list[Recording]:
    """Return the recordings of a unit."""
    unit = UnitDescription("u", sensor="stim300", course=COURSE, imperfections=bench, effects=effects or {})
    return simulate_unit(unit, 8, 0)[0]


def judged(recordings: list[Recording], *layers: str) -> dict[str, tuple[dict[str, Any], float]]:
    """Return of each sensor the diagnosis and the held-out error over the noise floor."""
    state = unit_of_recordings(recordings, [*LAYERS, *layers]).run_to("diagnose")
    assert state.validation is not None
    assert state.diagnosis is not None
    held = {sensor: state.validation[sensor] for sensor in SENSORS}
    over_floor = {s: part["steps"][-1]["rms_error"] / part["noise_floor"] for s, part in held.items()}
    return {sensor: (state.diagnosis[sensor], over_floor[sensor]) for sensor in SENSORS}


def test_mountings_are_named_for_both_sensors_and_explain_the_error_once_added() -> None:
    rng = np.random.default_rng(4)
    recordings = simulated(mounting_deg={name: rng.standard_normal(3).tolist() for name in TURNS})
    for sensor, (said, over_floor) in judged(recordings).items():
        assert said["verdict"] == "missing_effect", sensor
        assert said["selected"] == ["mounting"]
        assert said["override"] == f"effects.{sensor}=[mounting]"
        assert over_floor > 5.0
    added = (f"effects.{sensor}=[mounting]" for sensor in SENSORS)
    for sensor, (said, over_floor) in judged(recordings, *added).items():
        assert said["verdict"] == "nothing_missing", sensor
        assert over_floor < 1.1
        hidden = {entry["effect"] for entry in said["not_observable"]}
        assert "table_axis_nonorthogonality" in hidden  # the mountings contain it


@pytest.mark.parametrize("added", ["", "table_axis_nonorthogonality"])
def test_a_gyroscope_is_doubted_where_gravity_shows_that_its_turn_axes_lean(added: str) -> None:
    lean = {"table_axis_nonorthogonality": [0.05, -0.04, 0.06, 0.03, -0.05, 0.04]}
    recordings = [replace(r, table_attitude=None) for r in simulated(lean)]  # it would contradict the matrix as well
    found = {s: said for s, (said, _) in judged(recordings, f"effects.accelerometer=[{added}]").items()}
    assert found["accelerometer"]["verdict"] == ("nothing_missing" if added else "missing_effect")
    assert found["gyroscope"]["verdict"] == "reference_in_doubt"
    told = found["gyroscope"]["reason"].partition("table_axis_nonorthogonality the turn axes lean by up to ")[2]
    assert float(told.split()[0]) == pytest.approx(0.06, abs=0.01)


@pytest.mark.parametrize(("of_uncertainty", "verdict"), [(0.5, "nothing_missing"), (2.0, "reference_in_doubt")])
def test_a_lean_within_the_uncertainty_of_the_gyroscopes_matrix_is_no_doubt(
    of_uncertainty: float, verdict: str
) -> None:
    unit = unit_of_recordings(simulated(), LAYERS)
    state = unit.run_to("fit")
    fit = state.fits["gyroscope"]
    assert isinstance(fit, SensorCalibration)
    assert fit.covariance is not None
    assert state.recordings is not None
    U = np.degrees(2.0 * np.sqrt(np.max(np.diag(fit.covariance)[3:12])))  # deg; 1e-3 of a matrix are 0.057 deg
    lean = candidate("table_axis_nonorthogonality", parameters={"x_y": Estimate(of_uncertainty * U, "deg")})
    gravity = SensorDiagnosis(Verdict.MISSING_EFFECT, [], selected=[lean.effect], ranking=[lean])
    noise = state.recordings.noises["gyroscope"]
    found = diagnose(fit, state.recordings.filtered, noise, unit.row.config, gravity=gravity)
    assert found["verdict"] == verdict, found["reason"]


def test_a_zero_in_the_accelerometers_model_leaves_the_gyroscope_its_diagnosis() -> None:
    found = judged(simulated(zero_deg={"accel_y": 1.5}), "effects.accelerometer=[encoder_zero]")
    assert {sensor: said["verdict"] for sensor, (said, _) in found.items()} == dict.fromkeys(SENSORS, "nothing_missing")


@pytest.mark.parametrize("turn", [(0.0, 90.0, 0.0), (0.0, 0.0, 180.0)])
def test_a_unit_on_another_face_is_calibrated_and_its_attitude_log_turned(turn: tuple[float, float, float]) -> None:
    everywhere = {name: list(turn) for name in [*TURNS, "static", "validation"]}
    zeros = dict.fromkeys(TURNS, 37.0)
    recordings = simulated(mounting_deg=everywhere, zero_deg=zeros, sense=-1)
    for sensor, (said, over_floor) in judged(recordings).items():
        assert said["verdict"] == "nothing_missing", (sensor, said["reason"])
        assert over_floor < 1.1
    checked, plain = (unit_of_recordings(each, LAYERS).run_to("ingest").checked for each in (recordings, simulated()))
    assert {n.code for r in checked or () for n in r.notes if r.name in (*TURNS, "validation")} == {"N-FOUND"}
    assert not [n for r in plain or () for n in r.notes]
