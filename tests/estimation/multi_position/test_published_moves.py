"""The published recording of an Xsens MTi, calibrated in-process, against its certificate and against itself."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from unit_settings import settings_of, with_noise

from pipeline.estimation.accelerometer import nonlinear_least_squares
from pipeline.estimation.effects import fit as fit_effects
from pipeline.estimation.gyroscope import rests_and_moves
from pipeline.estimation.noise import estimate_noise
from pipeline.estimation.rest_means import split_rests
from pipeline.estimation.stages import StageInput
from pipeline.evaluation.held_out.attitude import gravity_direction
from pipeline.ingest.read import read_recordings
from pipeline.physics.measurement import compensate
from pipeline.simulation.description import shipped_settings

if TYPE_CHECKING:
    from pipeline.core.records import Recording, SensorCalibration

DATA = Path(__file__).parents[4] / "shared" / "data" / "xsens_mti_multi_position"
BY_HAND_DEG = 6.1  # the most that turns of 360 deg by hand depart in a session of the same laboratory
STATIC = slice(0, 5000)  # the first 50 s
SETTINGS = settings_of(
    sensor="generic",
    table="hand",
    procedure="multi_position",
    ingest="xsens_mti_multi_position",
    effects={"gyroscope": ["g_sensitivity"]},
    **{"table.gravity_g": 9.81744 / 9.80665},
)


@pytest.fixture(scope="module")
def recordings() -> list[Recording]:
    if not DATA.is_dir():
        pytest.skip("reference data not beside the repository")
    return read_recordings(SETTINGS.procedure, SETTINGS.ingest, SETTINGS.sensor, DATA)


@pytest.fixture(scope="module")
def fitted(recordings: list[Recording]) -> dict[str, SensorCalibration]:
    plain = rests_and_moves.fit(StageInput("gyroscope", with_noise(recordings, SETTINGS), None, SETTINGS))
    return {
        "accelerometer": nonlinear_least_squares.fit(
            StageInput("accelerometer", with_noise(recordings, SETTINGS), None, SETTINGS)
        ),
        "gyroscope": plain,
        "with g": fit_effects(StageInput("gyroscope", with_noise(recordings, SETTINGS), plain, SETTINGS)),
    }


def static_mean(recordings: list[Recording]) -> tuple[np.ndarray, np.ndarray]:
    """Return the gyroscope's mean of the first 50 s and its standard uncertainty, by the means of whole seconds."""
    assert recordings[0].gyroscope is not None
    seconds = recordings[0].gyroscope[STATIC].reshape(50, 100, 3).mean(axis=1)
    return seconds.mean(axis=0), seconds.std(axis=0, ddof=1) / np.sqrt(50)


def test_the_scale_agrees_with_the_certificate_to_half_a_percent(fitted: dict[str, SensorCalibration]) -> None:
    for name in ("gyroscope", "with g"):
        scale = np.degrees(83.2) * np.linalg.norm(np.linalg.inv(fitted[name].matrix), axis=1)  # counts per rad/s
        assert np.abs(scale / [4778, 4758, 4766] - 1).max() < 0.005, name


def test_bias_and_g_sensitivity_give_the_mean_of_the_first_50_s_within_their_uncertainty(
    recordings: list[Recording], fitted: dict[str, SensorCalibration]
) -> None:
    found = fitted["with g"]
    assert recordings[0].accelerometer is not None
    assert found.covariance is not None
    mean, u_mean = static_mean(recordings)
    still = recordings[0].accelerometer[STATIC].mean(axis=0, keepdims=True)
    force = compensate(fitted["accelerometer"], still, None, ())[0]
    J = np.zeros((3, 12 + 9))
    J[:, :3], J[:, 12:] = np.eye(3), np.kron(np.eye(3), force)
    predicted = found.bias + found.effects[0].values.reshape(3, 3) @ force
    u = np.sqrt(u_mean**2 + np.diag(J @ found.covariance @ J.T))
    assert np.all(np.abs(predicted - mean) < 2.0 * u)
    assert u.max() < 0.02


def test_the_bias_alone_differs_from_the_first_50_s_by_no_more_than_orientations_do(
    recordings: list[Recording], fitted: dict[str, SensorCalibration]
) -> None:
    recording = recordings[0]
    assert recording.gyroscope is not None
    mean, _ = static_mean(recordings)
    rests = split_rests(recording, 0).used
    own = np.std([recording.gyroscope[r.start : r.stop].mean(axis=0) for r in rests], axis=0, ddof=1)
    off = np.abs(fitted["gyroscope"].bias - mean)
    covariance = fitted["gyroscope"].covariance
    assert covariance is not None
    assert np.all(off < 2.0 * np.sqrt(own**2 + np.diag(covariance)[:3]))
    assert off.max() > 5.0 * np.abs(static_mean(recordings)[1]).max()  # the first 50 s alone are no measure of it


def test_held_out_moves_end_where_gravity_is_felt(
    recordings: list[Recording], fitted: dict[str, SensorCalibration]
) -> None:
    noise = estimate_noise("gyroscope", recordings, SETTINGS.sensor.gyroscope)
    plain, with_g = (
        gravity_direction(fitted["accelerometer"], fitted[name], recordings, noise, SETTINGS.procedure)
        for name in ("gyroscope", "with g")
    )
    assert plain["moves"] == with_g["moves"] == 13
    assert plain["mean_deg"]["after"] < 0.1 * plain["mean_deg"]["before"]
    assert with_g["mean_deg"]["after"] < 0.35 * plain["mean_deg"]["after"]
    assert with_g["mean_deg"]["after"] < 0.17
    assert 0.08 < with_g["noise_floor_deg"] < 0.09  # 0.033 deg/s/sqrt(Hz) over 4.7 s
    assert with_g["creeping_rests"] == 7


def test_whole_turns_of_a_ferraris_session_are_360_degrees_to_a_hands_accuracy(tmp_path: Path) -> None:
    session = DATA.parent / "ferraris_wearable" / "example_ferraris_session.csv"
    if not session.is_file():
        pytest.skip("reference data not beside the repository")
    (tmp_path / "recording.csv").write_bytes(session.read_bytes())
    plain = shipped_settings(ingest="canonical_csv").ingest
    columns: dict[str, Any] = dict.fromkeys(plain.csv["columns"])
    for channel, short, unit in (("accel", "acc", "m/s^2"), ("gyro", "gyr", "deg/s")):
        columns |= {f"{channel}_{axis}": {"column": f"{short}_{axis}", "unit": unit} for axis in "xyz"}
    ingest = plain.replaced(csv=plain.csv | {"columns": columns, "rate_hz": 102.4})
    sheets = {name: {"full_scale": 2000.0} for name in ("accelerometer", "gyroscope")}
    settings = settings_of(SETTINGS, sensor=sheets, procedure={"holdout_every": 0})
    recordings = read_recordings(SETTINGS.procedure, ingest, settings.sensor, tmp_path)
    found = rests_and_moves.fit(StageInput("gyroscope", with_noise(recordings, settings), None, settings))
    assert recordings[0].gyroscope is not None
    calibrated = (recordings[0].gyroscope - found.bias) @ found.matrix.T / 102.4
    for axis, start, stop in ((0, 6728, 7141), (1, 8037, 8426), (2, 9161, 9559)):  # about x, y and z, between rests
        assert abs(abs(calibrated[start:stop, axis].sum()) - 360.0) < BY_HAND_DEG
    raw = (recordings[0].gyroscope[6728:7141, 0] - found.bias[0]).sum() / 102.4
    assert abs(raw) - 360.0 > BY_HAND_DEG
