"""Mountings of a unit in each turn, and zeros of the table's angle, against turns made by rotation matrices alone."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from unit_settings import settings_of

from pipeline.app.one_unit import unit_row
from pipeline.checks.mounting import check_mounting
from pipeline.core.records import Coefficient, FittedEffect, Noise, Recording, SensorCalibration, UnitRecordings
from pipeline.estimation.effects import fit
from pipeline.estimation.reference_least_squares import fit as fit_to_reference
from pipeline.estimation.stages import StageInput
from pipeline.physics.effects import effect, effect_of
from pipeline.physics.kinematics import reference_motion

sys.path.insert(0, str(Path(__file__).parents[1] / "preprocessing"))
from benches import BIAS, K, Setup, recordings_of
from benches import settings_of as bench_settings

if TYPE_CHECKING:
    from pipeline.core.settings import Settings

TURNS = [(role, axis) for role in ("accelerometer", "gyroscope") for axis in "xyz"]
SEAT_DEG = 2.0


WHITE = {"accelerometer": 8e-4, "gyroscope": 0.01}  # of benches.py
NOISES = {s: Noise(np.full(3, w), np.zeros(3), 100.0, "rests") for s, w in WHITE.items()}


def seated_anew(seed: int, seat_deg: float) -> tuple[list[Recording], np.ndarray]:
    """Return a unit mounted anew in each turn, and its rotations: (6, 3) array, deg."""
    seats = seat_deg * np.random.default_rng([seed, 1]).standard_normal((len(TURNS), 3))
    made = [Setup(a, seat=s).recording(role, seed) for (role, a), s in zip(TURNS, seats, strict=True)]
    return made, seats


def settings(**table: Any) -> Settings:
    """Return settings of a table on which the unit is mounted anew for each turn."""
    table = {"angle_accuracy_deg": 0.0, "rate_accuracy": 0.0, "seat_deg": SEAT_DEG} | table
    quiet = [f"sensor.{s}.bias_wander=0" for s in K]  # the turns are made with white noise alone
    row = unit_row(["sensor=mpu6050", *(f"table.{key}={value}" for key, value in table.items()), *quiet])
    return row.config


def errors_over_u(found: SensorCalibration, seats: np.ndarray) -> np.ndarray:
    """Return errors of bias and matrix over their standard uncertainties, in the frame of the mean mounting."""
    frame = Rotation.from_rotvec(seats.mean(axis=0), degrees=True).as_matrix()
    matrix = frame @ np.linalg.inv(K[found.sensor])
    error = np.concatenate([found.bias - BIAS[found.sensor], (found.matrix - matrix).ravel()])
    assert found.covariance is not None
    return np.asarray(error / np.sqrt(np.diag(found.covariance)[:12]))


def test_gravity_determines_the_mountings_of_both_sensors_to_their_uncertainty() -> None:
    found: dict[str, list[np.ndarray]] = {sensor: [] for sensor in K}
    for seed in range(4):
        recordings, seats = seated_anew(seed, 1.0)
        for sensor, z in found.items():
            calibrated = fit(StageInput(sensor, UnitRecordings(recordings, NOISES), None, settings()))
            z.append(errors_over_u(calibrated, seats))
            (mounting,) = calibrated.effects
            assert mounting.name == "mounting"
            assert np.allclose(mounting.values.reshape(-1, 3), seats - seats.mean(axis=0), atol=0.12)
            assert calibrated.covariance is not None
            assert np.sqrt(np.diag(calibrated.covariance)[3:12]).max() < 3e-3  # 1 deg of a mounting is 17e-3
    for sensor, z in found.items():
        assert 0.7 < np.sqrt(np.mean(np.square(z))) < 1.3, sensor  # 48 values: four standard errors
        assert np.abs(z).max() < 4.0


def test_recordings_of_one_setup_share_a_mounting_and_the_gyroscope_is_better_known() -> None:
    seats = np.tile(np.random.default_rng(7).standard_normal((3, 3)), (2, 1))
    made = [Setup(a, seat=s).recording(role, 5) for (role, a), s in zip(TURNS, seats, strict=True)]
    clamped = [replace(r, setup=f"on_{axis}") for r, (_, axis) in zip(made, TURNS, strict=True)]
    u = {}
    for name, recordings in (("apart", made), ("shared", clamped)):
        found = fit(StageInput("gyroscope", UnitRecordings(recordings, NOISES), None, settings()))
        assert np.abs(errors_over_u(found, seats)).max() < 4.0
        assert found.covariance is not None
        u[name] = np.sqrt(np.diag(found.covariance)[3:12].reshape(3, 3)[~np.eye(3, dtype=bool)])
    (mounting,) = found.effects
    assert list(mounting.parameters) == [f"on_{a}_{b}" for a in "xyz" for b in "xyz"]
    assert np.allclose(mounting.values.reshape(-1, 3), seats[:3] - seats.mean(axis=0), atol=0.12)
    assert np.all(u["shared"] < u["apart"])


def test_a_mounting_is_as_uncertain_for_the_gyroscope_as_gravity_leaves_it() -> None:
    recordings, _ = seated_anew(0, 3.0)
    by_gravity = fit(StageInput("accelerometer", UnitRecordings(recordings, NOISES), None, settings()))
    found = fit(StageInput("gyroscope", UnitRecordings(recordings, NOISES), None, settings()))
    assert by_gravity.covariance is not None
    of_turns = np.sqrt(np.diag(by_gravity.covariance)[12:]).reshape(6, 3)[3:]
    across = ~np.eye(3, dtype=bool)  # a rotation about the turn axis does not change the rate
    (line,) = (
        entry for entry in found.to_json()["uncertainty_budget"]["contributions"] if entry["source"] == "mounting"
    )
    of_matrix = np.array(line["contribution"][3:12]).reshape(3, 3)[across]
    assert of_matrix.max() < 1.2 * np.radians(of_turns[across].max())
    assert of_matrix.min() > 0.5 * np.radians(of_turns[across].min())


@pytest.mark.parametrize(("azimuth_of", "held"), [("turn_axis", True), ("level_x", False)])
def test_the_tilt_that_looks_like_a_zero_of_one_shaft_does_not_widen_the_matrix(azimuth_of: str, *, held: bool) -> None:
    recordings, seats = seated_anew(0, 1.0)
    whole = settings(azimuth_of=azimuth_of)
    plain = fit(StageInput("accelerometer", UnitRecordings(recordings, NOISES), None, whole))
    whole = settings_of(whole, effects={"accelerometer": ["table_tilt"]})
    tilted = fit(StageInput("accelerometer", UnitRecordings(recordings, NOISES), None, whole))
    assert plain.covariance is not None
    assert tilted.covariance is not None
    u, wider = (np.sqrt(np.diag(found.covariance)) for found in (plain, tilted))
    d = tilted.effects[-1].values
    if held:
        assert wider[3:12].max() < 1.1 * u[3:12].max()  # 100 times with that part of the tilt free
        assert np.abs(errors_over_u(tilted, seats)).max() < 4.0
        held_part, across = tilted.effects[-1].parameters.values()
        assert (held_part.value, held_part.expanded_uncertainty) == (0.0, None)
        assert across.expanded_uncertainty > 1.9 * wider[-1] > 0.0 == wider[-2]
        assert tilted.stages[-1].parameters["table_tilt.d_x"].standard_uncertainty is None
        why = {line["source"]: line["reason"] for line in tilted.to_json()["uncertainty_budget"]["not_included"]}
        assert why["levelling"].startswith("table_tilt estimates the component across the shaft alone")
        assert abs(d[1]) < 4.0 * wider[-1]  # the part across the shaft is estimated; the truth is 0
        whole = settings_of(whole, table={"levelling_deg": 0.1})
        stated = fit(StageInput("accelerometer", UnitRecordings(recordings, NOISES), None, whole))
        assert stated.covariance is not None
        assert np.sqrt(stated.covariance[-2, -2]) == pytest.approx(0.1, rel=0.01)
    else:
        assert np.abs(d / wider[-2:]).max() < 4.0
        assert wider[-2:].min() > 1e-3  # by the readings, not by a prior


def test_without_mountings_the_same_turns_leave_a_wrong_matrix() -> None:
    recordings, seats = seated_anew(0, 1.0)
    plain = settings(seat_deg="null")
    assert (
        np.abs(
            errors_over_u(
                fit_to_reference(StageInput("gyroscope", UnitRecordings(recordings, NOISES), None, plain)), seats
            )
        ).max()
        > 20.0
    )


def test_without_an_accelerometer_the_mountings_stay_as_uncertain_as_their_prior() -> None:
    recordings = [r for r in seated_anew(0, 1.0)[0] if r.role == "gyroscope"]
    blind = [replace(r, accelerometer=None) for r in recordings]
    whole = settings()
    found = fit(StageInput("gyroscope", UnitRecordings(blind, NOISES), None, whole))
    assert found.covariance is not None
    u = np.sqrt(np.diag(found.covariance)[3:12].reshape(3, 3)[~np.eye(3, dtype=bool)])
    assert np.all(u > 0.5 * np.radians(SEAT_DEG))


def test_a_zero_that_is_found_is_estimated_with_the_matrix() -> None:
    z = []
    for seed in range(4):
        recordings = recordings_of({a: Setup(a, zero=37.0) for a in "xyz"}, seed)
        found = check_mounting(recordings, bench_settings(recordings))
        whole = settings(seat_deg="null")
        calibrated = fit_to_reference(StageInput("accelerometer", UnitRecordings(found, NOISES), None, whole))
        assert [e.name for e in calibrated.effects] == ["encoder_zero"]
        z.append(errors_over_u(calibrated, np.zeros((1, 3))))
    assert 0.7 < np.sqrt(np.mean(np.square(z))) < 1.3
    assert np.abs(z).max() < 4.0


@pytest.mark.parametrize("name", ["mounting", "encoder_zero"])
def test_columns_are_the_derivative_and_the_calibration_carries_the_recordings(name: str) -> None:
    recordings = seated_anew(0, 1.0)[0][:2]
    this = effect(name).of_recordings({r.name: r.setup for r in recordings})
    motion = reference_motion(recordings[1])
    assert motion is not None
    values = 2.0 * np.random.default_rng(3).standard_normal(len(this.parameters("accelerometer")))
    columns = this.regressors("accelerometer", motion, K["accelerometer"], values)
    for j, step in enumerate(1e-4 * np.eye(len(values))):
        ahead, behind = (this.reading("accelerometer", motion, K["accelerometer"], values + s) for s in (step, -step))
        assert np.allclose(columns[:, :, j], (ahead - behind) / 2e-4, atol=1e-9)
    parameters = {p.name: Coefficient(float(v)) for p, v in zip(this.parameters("accelerometer"), values, strict=True)}
    again = effect_of(FittedEffect(name, parameters, this.definition))
    assert np.array_equal(again.moved(motion, values).specific_force, this.moved(motion, values).specific_force)
    other = reference_motion(seated_anew(0, 1.0)[0][2])
    assert other is not None
    assert this.moved(other, values) is other
