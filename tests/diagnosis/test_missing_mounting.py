"""A unit that was mounted anew for each turn on a table that states one mounting: named, added, explained."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pipeline.diagnosis.diagnose import diagnose
from pipeline.estimation.noise import noise_of
from pipeline.estimation.stages import fit_stage
from pipeline.preprocessing.checks import check_recordings
from pipeline.records import SENSORS
from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import UnitDescription
from pipeline.study.run import settings_of
from pipeline.validation.heldout import validate

COURSE: dict[str, Any] = {
    "validation_s": 60.0, "static_s": 60.0, "warm_up_rest_s": 15.0, "step_deg": 15.0, "dwell_s": 1.5,
    "rates_dps": (50.0,), "both_directions": True,
}  # fmt: skip
TURNS = [f"{kind}_{axis}" for kind in ("accel", "gyro") for axis in "xyz"]


def simulated(effects: dict[str, Any] | None = None, **bench: Any) -> tuple[list[Any], dict[str, Any]]:
    """Return the recordings of a unit, and settings of a table with one mounting."""
    unit = UnitDescription("u", sensor="stim300", course=COURSE, imperfections=bench, effects=effects or {})
    return simulate_unit(unit, 8, 0)[0], settings_of("stim300", "reference_least_squares")


def judged(recordings: list[Any], settings: dict[str, Any]) -> dict[str, tuple[dict[str, Any], float]]:
    """Return of each sensor the diagnosis and the held-out error over the noise floor, as a run does."""
    checked = check_recordings(recordings, settings)
    noises = {s: noise_of(s, checked, settings) for s in SENSORS}
    fits, found = {}, {}
    for sensor in SENSORS:
        fit = None
        for stage in ("reference_least_squares", "effects"):
            fit = fit_stage(sensor, stage, checked, fit, settings | {"noise": noises})
        assert fit is not None
        fits[sensor] = fit
        held = validate(fit, checked, noises[sensor], settings)
        gravity = found["accelerometer"][0] if found else None
        said = diagnose(fit, checked, noises[sensor], settings, fits["accelerometer"], validation=held, gravity=gravity)
        found[sensor] = said, held["steps"][-1]["rms_error"] / held["noise_floor"]
    return found


def test_mountings_are_named_for_both_sensors_and_explain_the_error_once_added() -> None:
    rng = np.random.default_rng(4)
    recordings, settings = simulated(mounting_deg={name: rng.standard_normal(3).tolist() for name in TURNS})
    for sensor, (said, over_floor) in judged(recordings, settings).items():
        assert said["verdict"] == "missing_effect", sensor
        assert said["selected"] == ["mounting"]
        assert said["override"] == f"effects.{sensor}=[mounting]"
        assert over_floor > 5.0
    added = {**settings, "effects": {s: ["mounting"] for s in SENSORS}}
    for sensor, (said, over_floor) in judged(recordings, added).items():
        assert said["verdict"] == "nothing_missing", sensor
        assert over_floor < 1.1
        hidden = {entry["effect"] for entry in said["not_observable"]}
        assert "table_axis_nonorthogonality" in hidden  # the mountings contain it


@pytest.mark.parametrize("added", [[], ["table_axis_nonorthogonality"]])
def test_a_gyroscope_is_doubted_where_gravity_shows_that_its_turn_axes_lean(added: list[str]) -> None:
    lean = {"table_axis_nonorthogonality": [0.05, -0.04, 0.06, 0.03, -0.05, 0.04]}
    recordings, settings = simulated(lean)
    recordings = [replace(r, table_attitude=None) for r in recordings]  # which would contradict the matrix as well
    settings = {**settings, "effects": {"accelerometer": added, "gyroscope": []}}
    found = {sensor: said for sensor, (said, _) in judged(recordings, settings).items()}
    assert found["accelerometer"]["verdict"] == ("nothing_missing" if added else "missing_effect")
    assert found["gyroscope"]["verdict"] == "reference_in_doubt"
    told = found["gyroscope"]["reason"].partition("table_axis_nonorthogonality the turn axes lean by up to ")[2]
    assert float(told.split()[0]) == pytest.approx(0.06, abs=0.01)


@pytest.mark.parametrize(("of_uncertainty", "verdict"), [(0.5, "nothing_missing"), (2.0, "reference_in_doubt")])
def test_a_lean_within_the_uncertainty_of_the_gyroscopes_matrix_is_no_doubt(
    of_uncertainty: float, verdict: str
) -> None:
    recordings, settings = simulated()
    checked = check_recordings(recordings, settings)
    noise = noise_of("gyroscope", checked, settings)
    fit = fit_stage("gyroscope", "reference_least_squares", checked, None, settings | {"noise": {"gyroscope": noise}})
    assert fit.covariance is not None
    U = np.degrees(2.0 * np.sqrt(np.max(np.diag(fit.covariance)[3:12])))  # deg; 1e-3 of a matrix are 0.057 deg
    lean = {"effect": "table_axis_nonorthogonality", "parameters": {"x_y": {"value": of_uncertainty * U}}}
    gravity = {"verdict": "missing_effect", "selected": [lean["effect"]], "ranking": [lean]}
    found = diagnose(fit, checked, noise, settings, gravity=gravity)
    assert found["verdict"] == verdict, found["reason"]


def test_a_zero_in_the_accelerometers_model_leaves_the_gyroscope_its_diagnosis() -> None:
    recordings, settings = simulated(zero_deg={"accel_y": 1.5})
    found = judged(recordings, {**settings, "effects": {"accelerometer": ["encoder_zero"], "gyroscope": []}})
    assert {sensor: said["verdict"] for sensor, (said, _) in found.items()} == dict.fromkeys(SENSORS, "nothing_missing")


@pytest.mark.parametrize("turn", [(0.0, 90.0, 0.0), (0.0, 0.0, 180.0)])
def test_a_unit_on_another_face_is_calibrated_and_its_attitude_log_turned(turn: tuple[float, float, float]) -> None:
    everywhere = {name: list(turn) for name in [*TURNS, "static", "validation"]}
    zeros = dict.fromkeys(TURNS, 37.0)
    recordings, settings = simulated(mounting_deg=everywhere, zero_deg=zeros, sense=-1)
    for sensor, (said, over_floor) in judged(recordings, settings).items():
        assert said["verdict"] == "nothing_missing", (sensor, said["reason"])
        assert over_floor < 1.1
    checked = check_recordings(recordings, settings)
    assert {n.code for r in checked for n in r.notes if r.name in (*TURNS, "validation")} == {"N-FOUND"}
    plain = [replace(r) for r in simulated()[0]]
    assert not [n for r in check_recordings(plain, settings) for n in r.notes]
