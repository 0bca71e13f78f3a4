from __future__ import annotations

import dataclasses
import json
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest
from bench_session import gauss_markov
from unit_settings import filter_of, settings_of, with_noise

from pipeline.core.errors import CannotCalibrateError, ConfigurationError, NotObservableError
from pipeline.core.records import Recording, SensorCalibration, UnitRecordings, coverage_factor
from pipeline.core.records.calibration import corrected
from pipeline.estimation.gyroscope.cholesky_lu import factorise, fit
from pipeline.estimation.stages import StageInput, fit_stage

if TYPE_CHECKING:
    from pipeline.core.settings import Settings

INTERVAL = 0.12
S = np.array([1.01, 0.98, 1.03])
T = np.array([[1.0, 0.0, 0.0], [0.01, 1.0, 0.0], [-0.008, 0.006, 1.0]])


def _rotation(*degrees: float) -> np.ndarray:
    total = np.eye(3)
    for axis, angle in enumerate(np.radians(degrees)):
        j, k = (axis + 1) % 3, (axis + 2) % 3
        turn = np.eye(3)
        turn[j, j] = turn[k, k] = np.cos(angle)
        turn[k, j], turn[j, k] = np.sin(angle), -np.sin(angle)
        total = turn @ total
    return total


M = _rotation(1.5, -1.0, 2.0)
FORWARD = S[:, None] * T @ M
BIAS = np.array([1.2, -0.7, 0.4])
SETTINGS = settings_of(sensor={"gyroscope": {"bias_wander": 3e-3}})
AS_PRINTED = settings_of(SETTINGS, method={"as_printed": True})


def _turns(
    axis: str, rates: tuple[float, ...], rng: np.random.Generator | None, start: int = 0, rest_s: float = 10.0
) -> Recording:
    """A turn of 360 deg at each rate with ramps of 0.6 s, rests between; without a generator there is no noise."""
    ramp, rest = np.linspace(0.0, 1.0, 6), np.zeros(round(rest_s / INTERVAL))
    pieces = [rest]
    for rate in rates:
        steady = np.ones(round((360.0 / abs(rate) - 0.6) / INTERVAL))
        pieces += [rate * ramp, rate * steady, rate * ramp[::-1], rest]
    speed = np.concatenate(pieces)
    angle = np.concatenate([[0.0], np.cumsum(0.5 * INTERVAL * (speed[1:] + speed[:-1]))])
    truth = np.zeros((len(speed), 3))
    truth[:, "xyz".index(axis)] = speed
    reading = BIAS + truth @ FORWARD.T
    if rng is not None:
        wander = gauss_markov(rng, len(reading), INTERVAL / 100.0)
        reading = reading + 0.05 * rng.normal(size=reading.shape) + 3e-3 * wander
    return Recording(
        f"gyro_{axis}",
        "gyroscope",
        axis,
        (start + np.arange(len(speed))) * 120_000_000,
        gyroscope=reading,
        table_angle=angle,
        table_rate=speed,
    )


def _campaign(
    rng: np.random.Generator | None = None, rates: tuple[float, ...] = (20.0, 60.0, -20.0)
) -> list[Recording]:
    return [_turns(axis, rates, rng, 2000 * k) for k, axis in enumerate("xyz")]


def _fit(recordings: list[Recording], settings: Settings = SETTINGS) -> SensorCalibration:
    unit = with_noise(recordings, settings)
    return fit(StageInput("gyroscope", unit, fit_stage("gyroscope", "bias", unit, None, settings), settings))


@cache
def _repeat(seed: int) -> SensorCalibration:
    return _fit(_campaign(np.random.default_rng(seed)))


def _values(calibration: SensorCalibration) -> dict[str, float]:
    return {name: p.value for name, p in calibration.stages[-1].parameters.items()}


def _matrices(values: dict[str, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    scale = np.array([values[f"S_{a}"] for a in "xyz"])
    lower = np.eye(3)
    lower[1, 0], lower[2, 0], lower[2, 1] = values["T_yx"], values["T_zx"], values["T_zy"]
    return scale, lower, np.array([[values[f"M_{a}{b}"] for b in "xyz"] for a in "xyz"])


def test_the_factors_of_a_matrix_are_diagonal_unit_triangular_and_orthonormal() -> None:
    factors = factorise(FORWARD)
    assert pytest.approx(S, abs=1e-14) == factors.S
    assert pytest.approx(T, abs=1e-14) == factors.T
    assert pytest.approx(M, abs=1e-14) == factors.M


@pytest.mark.parametrize("rates", [(20.0,), (60.0, -60.0), (20.0, 80.0, 200.0, -100.0)])
def test_scale_factors_axes_and_mounting_are_exact_without_noise(rates: tuple[float, ...]) -> None:
    calibration = _fit(_campaign(rates=rates))
    scale, lower, mounting = _matrices(_values(calibration))
    assert scale == pytest.approx(S, abs=1e-10)
    assert lower == pytest.approx(T, abs=1e-10)
    assert mounting == pytest.approx(M, abs=1e-10)
    assert calibration.matrix @ FORWARD == pytest.approx(np.eye(3), abs=1e-10)
    assert calibration.stages[-1].details.turns == 3 * len(rates)


def test_m_is_orthonormal_whatever_the_noise() -> None:
    _, _, mounting = _matrices(_values(_fit(_campaign(np.random.default_rng(1)))))
    assert mounting @ mounting.T == pytest.approx(np.eye(3), abs=1e-14)
    assert np.linalg.det(mounting) == pytest.approx(1.0, abs=1e-14)


def test_as_printed_the_matrix_is_the_inverse_of_the_default() -> None:
    recordings = _campaign(np.random.default_rng(2))
    default, printed = _fit(recordings), _fit(recordings, AS_PRINTED)
    assert printed.matrix @ default.matrix == pytest.approx(np.eye(3), abs=1e-14)
    assert _values(printed) == _values(default)


@pytest.mark.parametrize(
    ("presented", "printed"),
    [
        (
            [[1.017, 0.016, -0.019], [-0.013, 1.001, -0.005], [0.014, 0.005, 0.998]],
            [[0.984, -0.016, 0.019], [0.013, 1.000, 0.005], [-0.014, -0.005, 1.003]],
        ),
        (
            [[0.997, 0.004, 0.002], [-0.005, 0.994, -0.009], [0.024, 0.003, 1.007]],
            [[1.004, -0.004, -0.002], [0.004, 1.008, 0.009], [-0.024, -0.002, 0.994]],
        ),
        (
            [[1.002, 0.005, -0.001], [-0.005, 1.000, 0.000], [0.001, 0.000, 0.999]],
            [[1.000, -0.005, 0.001], [0.005, 1.001, 0.000], [-0.001, -0.001, 1.003]],
        ),
    ],
    ids=["MPU6050 (1)", "MPU6050 (2)", "STIM300"],
)
def test_as_printed_gives_the_printed_tables(presented: list[list[float]], printed: list[list[float]]) -> None:
    """Sudsanguan 2019, table 5.25: what is printed for Cholesky and LU inverts what is presented beside it."""
    forward = np.linalg.solve(presented, np.eye(3))
    recordings = []
    for recording in _campaign():
        truth = np.zeros((recording.samples, 3))
        truth[:, "xyz".index(recording.axis or "x")] = np.asarray(recording.table_rate)
        recordings.append(dataclasses.replace(recording, gyroscope=BIAS + truth @ forward.T))
    # Both are printed to three digits, and were rounded on the way.
    assert _fit(recordings, AS_PRINTED).matrix == pytest.approx(np.array(printed), abs=2.5e-3)
    assert _fit(recordings).matrix == pytest.approx(np.array(presented), abs=1e-9)


def test_the_truth_lies_within_the_expanded_uncertainty_in_its_share_of_repeats() -> None:
    truth = np.concatenate([BIAS, np.linalg.solve(FORWARD, np.eye(3)).ravel()])
    inside, errors, claimed = [], [], []
    for seed in range(25):
        calibration = _repeat(seed)
        assert calibration.covariance is not None
        uncertainty = np.sqrt(np.diag(calibration.covariance))
        error = np.concatenate([calibration.bias, calibration.matrix.ravel()]) - truth
        inside.append(np.abs(error) < coverage_factor(calibration.degrees_of_freedom) * uncertainty)
        errors.append(error)
        claimed.append(uncertainty)
    assert 0.90 < np.mean(inside) < 0.995
    assert 0.75 < np.sqrt(np.mean(np.square(errors)[:, 3:]) / np.mean(np.square(claimed)[:, 3:])) < 1.35


def test_the_uncertainty_of_the_factors_is_the_scatter_of_their_repeats() -> None:
    scatter, claimed = [], []
    for seed in range(25):
        parameters = _repeat(seed).stages[-1].parameters
        scatter.append([p.value for p in parameters.values()])
        claimed.append([p.standard_uncertainty for p in parameters.values()])
    truth = np.concatenate([S, T[np.tril_indices(3, -1)], M.ravel()])
    ratio = np.sqrt(np.mean(np.square(np.array(scatter) - truth), axis=0) / np.mean(np.square(claimed), axis=0))
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.25)
    assert np.max(ratio) < 1.8


def test_a_delay_of_the_readings_hardly_matters_to_integrated_turns() -> None:
    delayed = []
    applied = {**filter_of("rc_low_pass", time_constant_s=0.24).json_value, "delay_s": 0.24}
    for recording in _campaign():
        reading = np.asarray(recording.gyroscope)
        late = np.concatenate([reading[:2], reading[:-2]])  # 0.24 s: 5 deg at 20 deg/s
        delayed.append(dataclasses.replace(recording, gyroscope=late, filter=applied))
    unit = UnitRecordings(delayed, {"gyroscope": None})
    found = fit(StageInput("gyroscope", unit, fit_stage("gyroscope", "bias", unit, None, SETTINGS), SETTINGS))
    assert found.matrix @ FORWARD == pytest.approx(np.eye(3), abs=1e-9)


def test_turns_in_both_directions_without_a_rest_between_count_as_two() -> None:
    def back_and_forth(axis: str, start: int) -> Recording:
        out = _turns(axis, (40.0,), None, start)
        rate = np.asarray(out.table_rate)
        speed = np.concatenate([rate[: -round(10.0 / INTERVAL)], -rate[round(10.0 / INTERVAL) :]])
        truth = np.zeros((len(speed), 3))
        truth[:, "xyz".index(axis)] = speed
        angle = np.concatenate([[0.0], np.cumsum(0.5 * INTERVAL * (speed[1:] + speed[:-1]))])
        return Recording(
            out.name,
            "gyroscope",
            axis,
            (start + np.arange(len(speed))) * 120_000_000,
            gyroscope=BIAS + truth @ FORWARD.T,
            table_angle=angle,
            table_rate=speed,
        )

    calibration = _fit([back_and_forth(axis, 2000 * k) for k, axis in enumerate("xyz")])
    assert calibration.stages[-1].details.turns == 6
    assert calibration.matrix @ FORWARD == pytest.approx(np.eye(3), abs=1e-9)


def test_a_turn_with_clipped_readings_is_left_out_and_counted() -> None:
    recordings = _campaign()
    flags = np.zeros(recordings[0].samples, np.uint16)
    moving = np.flatnonzero(np.abs(np.asarray(recordings[0].table_rate)) > 50.0)
    flags[moving[10]] = 0b10
    reading = np.asarray(recordings[0].gyroscope).copy()
    reading[moving[10]] = 0.0
    recordings[0] = dataclasses.replace(recordings[0], gyroscope=reading, flags=flags)
    calibration = _fit(recordings)
    assert (calibration.stages[-1].details.turns, calibration.stages[-1].details.turns_left_out) == (8, 1)
    assert calibration.matrix @ FORWARD == pytest.approx(np.eye(3), abs=1e-9)


def test_a_recording_whose_every_row_is_clipped_changes_nothing() -> None:
    recordings = _campaign(np.random.default_rng(6))
    clipped = dataclasses.replace(recordings[0], flags=np.full(recordings[0].samples, 0b10, np.uint16))
    alone, both = _fit(recordings), _fit([*recordings, clipped])
    assert both.stages[-1].details.turns_left_out == 3
    assert np.array_equal(alone.matrix, both.matrix)
    assert np.allclose(alone.covariance, both.covariance, rtol=1e-9, atol=0.0)


def test_the_angle_errors_are_a_table_of_turn_axes_by_sensor_axes() -> None:
    stage = _fit(_campaign(np.random.default_rng(3))).stages[-1]
    errors = np.array(stage.details.angle_error_rms_deg, float)
    assert errors.shape == (3, 3)
    assert np.max(errors) < 0.3  # of 360 deg, by noise of 0.05 deg/s and a bias wander of 0.003 deg/s
    assert stage.residual_rms == pytest.approx(0.068, rel=0.15)  # of |w| - rate, at rest and in turns


def test_without_a_rest_the_bias_of_a_static_recording_counts_with_its_uncertainty() -> None:
    rng = np.random.default_rng(4)
    turning = [r.select(np.abs(np.asarray(r.table_rate)) > 1.0) for r in _campaign(rng, rates=(20.0,))]
    reading = BIAS + 0.05 * rng.normal(size=(2000, 3))
    static = Recording("static", "static", None, (9000 + np.arange(2000)) * 120_000_000, gyroscope=reading)
    before = fit_stage("gyroscope", "bias", with_noise([*turning, static], SETTINGS), None, SETTINGS)
    assert before.covariance is not None
    known = fit(StageInput("gyroscope", with_noise([*turning, static], SETTINGS), before, SETTINGS))
    unknown = dataclasses.replace(before, covariance=1e4 * before.covariance)
    vague = fit(StageInput("gyroscope", with_noise([*turning, static], SETTINGS), unknown, SETTINGS))
    assert known.covariance is not None
    assert vague.covariance is not None
    assert vague.covariance[3, 3] > 10.0 * known.covariance[3, 3]
    assert known.matrix @ FORWARD == pytest.approx(np.eye(3), abs=2e-3)


def test_the_correction_is_the_calibration_and_survives_its_file() -> None:
    recordings = _campaign(np.random.default_rng(5))
    calibration = _fit(recordings)
    assert [stage.name for stage in calibration.stages] == ["bias", "cholesky_lu"]
    reading = np.asarray(recordings[0].gyroscope)
    expected = (reading - calibration.bias) @ calibration.matrix.T
    assert corrected(calibration.stages[-1].correction, reading) == pytest.approx(expected, abs=1e-12)
    again = SensorCalibration.from_json("gyroscope", json.loads(json.dumps(calibration.to_json())))
    assert again.to_json() == calibration.to_json()


def test_a_missing_turn_axis_is_named() -> None:
    recordings = _campaign()[:2]
    with pytest.raises(NotObservableError, match=r"not turned about z: record a turn about each of x, y and z"):
        _fit(recordings)


def test_without_a_table_log_the_gyroscope_cannot_be_calibrated_and_the_recording_that_would_do_is_said() -> None:
    bare = [dataclasses.replace(r, table_angle=None, table_rate=None) for r in _campaign()]
    before = SensorCalibration("gyroscope", bias=BIAS)
    with pytest.raises(CannotCalibrateError, match=r"Cholesky and LU method needs the table's motion.*record turns"):
        fit(StageInput("gyroscope", with_noise(bare, SETTINGS), before, SETTINGS))


def test_without_the_bias_stage_it_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="needs bias by an earlier stage"):
        fit_stage("gyroscope", "cholesky_lu", with_noise(_campaign(), SETTINGS), None, SETTINGS)
