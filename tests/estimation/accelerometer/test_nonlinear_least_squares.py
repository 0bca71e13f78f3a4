from __future__ import annotations

import json
import time as clock
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from bench_session import gauss_markov
from scipy.optimize import least_squares
from scipy.stats import t as student
from unit_settings import settings_of, with_noise

from pipeline.app.guide import derivative_of
from pipeline.core.errors import CannotCalibrateError, NotObservableError
from pipeline.core.records import Recording, SensorCalibration, StageResult, coverage_factor
from pipeline.core.records.calibration import corrected
from pipeline.estimation.accelerometer.nonlinear_least_squares import fit, triangle
from pipeline.estimation.gauss_markov import WanderPrior
from pipeline.estimation.multi_position.accelerometer import AccelerometerModel
from pipeline.estimation.multi_position.fit import SMALL_LAST_STEP
from pipeline.estimation.multi_position.fit import fit as fit_model
from pipeline.estimation.multi_position.model import State, prior_hypotheses
from pipeline.estimation.rest_means import gathered, held_out_rests, rest_means
from pipeline.estimation.stages import StageInput
from pipeline.physics.signal.rests import Rest
from pipeline.physics.statements import not_determined

if TYPE_CHECKING:
    from pipeline.core.settings import Settings

DATA = Path(__file__).parents[3] / "../shared/data"
needs_data = pytest.mark.skipif(not DATA.exists(), reason="reference data not beside the repository")
PADUA_G = 9.81744 / 9.80665
COUNTS_PER_G = 4070.0

BIAS = np.array([0.05, -0.03, 0.12])
MATRIX = np.array([[1.01, 0.0, 0.0], [0.004, 0.985, 0.0], [-0.006, 0.003, 1.02]])
FITTED = [0, 1, 2, 3, 6, 7, 9, 10, 11]  # of bias and matrix, without the upper triangle


def _settings(holdout_every: int = 0, gravity_g: float = 1.0, wander: float = 1e-4) -> Settings:
    return settings_of(
        table={"gravity_g": gravity_g},
        procedure={"holdout_every": holdout_every},
        sensor={"accelerometer": {"bias_wander": wander, "cross_axis": 0.02}},
    )


def _spread(orientations: int) -> np.ndarray:
    """Directions spread evenly over the sphere (a spherical spiral)."""
    z = 1.0 - (2.0 * np.arange(orientations) + 1.0) / orientations
    turn = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(orientations)
    return np.column_stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z])


def _by_hand(
    up: np.ndarray, rng: np.random.Generator, noise: float = 4e-3, between: float = 0.0, gravity_g: float = 1.0
) -> Recording:
    """Rests of 5 s in the given directions, with moves of 1.5 s, at 50 Hz."""
    force, offset = [], []
    for k, direction in enumerate(up):
        following = up[min(k + 1, len(up) - 1)]
        blend = np.linspace(0.0, 1.0, 75)[:, None]
        shake = 0.1 * np.sin(np.arange(75) / 2.0)[:, None]
        force += [np.tile(direction, (250, 1)), direction * (1 - blend) + following * blend + shake]
        offset.append(np.tile(between * rng.normal(size=3), (325, 1)))
    truth = gravity_g * np.concatenate(force)
    reading = BIAS + np.linalg.solve(MATRIX, truth.T).T + np.concatenate(offset) + noise * rng.normal(size=truth.shape)
    return Recording("recording", "rests", None, np.arange(len(truth)) * 20_000_000, accelerometer=reading)


def _on_table(axis: str, angle: np.ndarray, rate: np.ndarray, start: int, rng: np.random.Generator) -> Recording:
    """A turn by the table angle: the up vector turned by minus the angle; 4 mg noise and 0.1 mg bias wander."""
    s, c, o = np.sin(np.radians(angle)), np.cos(np.radians(angle)), np.zeros(len(angle))
    force = np.column_stack({"x": [o, s, c], "y": [-s, o, c], "z": [c, -s, o]}[axis])
    wander = gauss_markov(rng, len(force), 0.12 / 100.0)
    reading = BIAS + np.linalg.solve(MATRIX, force.T).T + 4e-3 * rng.normal(size=force.shape) + 1e-4 * wander
    return Recording(
        f"accel_{axis}",
        "accelerometer",
        axis,
        (start + np.arange(len(angle))) * 120_000_000,
        accelerometer=reading,
        table_angle=angle,
        table_rate=rate,
    )


def _stop_and_go(rng: np.random.Generator) -> list[Recording]:
    angle = np.repeat(np.arange(0.0, 361.0, 5.0), 20)
    rate = np.where(np.diff(angle, prepend=0.0) > 0, 5.0 / 0.12, 0.0)
    return [_on_table(axis, angle, rate, 3000 * k, rng) for k, axis in enumerate("xyz")]


def _continuous(rng: np.random.Generator) -> list[Recording]:
    angle = np.arange(0.0, 360.0, 0.36)
    return [_on_table(axis, angle, np.full(len(angle), 3.0), 3000 * k, rng) for k, axis in enumerate("xyz")]


def _xsens() -> Recording:
    force = np.loadtxt(DATA / "xsens_mti_multi_position/accelerometer.txt")
    return Recording(
        "recording",
        "rests",
        None,
        np.round(force[:, 0] * 1e9).astype(np.int64),
        accelerometer=(force[:, 1:] - 32768.0) / COUNTS_PER_G,
    )


def _vector(calibration: SensorCalibration) -> np.ndarray:
    return np.concatenate([calibration.bias, calibration.matrix.ravel()])[FITTED]


def _uncertainty(calibration: SensorCalibration) -> np.ndarray:
    assert calibration.covariance is not None
    return np.sqrt(np.diag(calibration.covariance))[FITTED]


TRUTH = np.concatenate([BIAS, MATRIX.ravel()])[FITTED]


def test_the_derivative_equals_central_differences() -> None:
    rng = np.random.default_rng(1)
    y = rng.normal(size=(7, 3))
    values = np.concatenate([BIAS, MATRIX[np.tril_indices(3)]])
    numeric = np.empty((7, 9))
    for k in range(9):
        ends = (values + 1e-6 * np.eye(9)[k], values - 1e-6 * np.eye(9)[k])
        up, down = (np.linalg.norm((y - v[:3]) @ triangle(v).T, axis=1) for v in ends)
        numeric[:, k] = (up - down) / 2e-6
    assert derivative_of(y, values) == pytest.approx(numeric, abs=1e-8)


@pytest.mark.parametrize("gravity_g", [1.0, 0.9976])
def test_nine_parameters_are_exact_without_noise(gravity_g: float) -> None:
    recording = _by_hand(_spread(24), np.random.default_rng(2), noise=0.0, gravity_g=gravity_g)
    calibration = fit(
        StageInput(
            "accelerometer",
            with_noise([recording], _settings(gravity_g=gravity_g)),
            None,
            _settings(gravity_g=gravity_g),
        )
    )
    assert _vector(calibration) == pytest.approx(TRUTH, abs=1e-9)
    assert calibration.converged


@cache
def _repeat(seed: int, between: float) -> SensorCalibration:
    settings = _settings(wander=between)
    recording = _by_hand(_spread(24), np.random.default_rng(seed), between=between)
    return fit(StageInput("accelerometer", with_noise([recording], settings), None, settings))


@pytest.mark.parametrize("between", [0.0, 3e-4])
def test_the_truth_lies_within_the_expanded_uncertainty_in_its_share_of_hand_held_recordings(between: float) -> None:
    inside = []
    for seed in range(25):
        calibration = _repeat(seed, between)
        factors = coverage_factor(calibration.freedom[FITTED])
        inside.append(np.abs(_vector(calibration) - TRUTH) < factors * _uncertainty(calibration))
    assert 0.90 < np.mean(inside) < 0.99


@pytest.mark.parametrize("record", [_stop_and_go, _continuous])
def test_the_truth_lies_within_the_expanded_uncertainty_in_its_share_of_table_turns(record: Any) -> None:
    inside, errors, claimed = [], [], []
    for seed in range(16):
        settings = _settings(holdout_every=3)
        calibration = fit(
            StageInput("accelerometer", with_noise(record(np.random.default_rng(seed)), settings), None, settings)
        )
        factor = coverage_factor(calibration.degrees_of_freedom)
        error, uncertainty = _vector(calibration) - TRUTH, _uncertainty(calibration)
        inside.append(np.abs(error) < factor * uncertainty)
        errors.append(error)
        claimed.append(uncertainty)
    assert 0.88 < np.mean(inside) <= 1.0
    assert 0.6 < np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(claimed))) < 1.5


def test_dwells_are_averaged_in_stop_and_go_and_samples_are_taken_singly_in_a_turn() -> None:
    rng = np.random.default_rng(3)
    stop = (
        fit(StageInput("accelerometer", with_noise(_stop_and_go(rng), _settings()), None, _settings()))
        .stages[-1]
        .details
    )
    turn = (
        fit(StageInput("accelerometer", with_noise(_continuous(rng), _settings()), None, _settings()))
        .stages[-1]
        .details
    )
    assert stop.orientations_used == 3 * 73
    assert turn.orientations_used == turn.samples_used == 3000
    assert stop.white_noise == pytest.approx(4e-3, rel=0.05)


def test_the_matrix_is_lower_triangular_and_its_upper_triangle_has_no_uncertainty() -> None:
    calibration = fit(
        StageInput(
            "accelerometer",
            with_noise([_by_hand(_spread(24), np.random.default_rng(4))], _settings()),
            None,
            _settings(),
        )
    )
    assert calibration.covariance is not None
    for k in (4, 5, 8):
        assert calibration.matrix.ravel()[k - 3] == 0.0
        assert not calibration.covariance[k].any()


def test_scale_factors_and_misalignment_make_up_the_matrix() -> None:
    calibration = fit(
        StageInput(
            "accelerometer",
            with_noise([_by_hand(_spread(24), np.random.default_rng(5))], _settings()),
            None,
            _settings(),
        )
    )
    found = {name: p.value for name, p in calibration.stages[-1].parameters.items()}
    S = np.diag([found[f"scale_factor_{axis}"] for axis in "xyz"])
    T = np.eye(3)
    T[1, 0], T[2, 0], T[2, 1] = (found[f"misalignment_{pair}"] for pair in ("yx", "zx", "zy"))
    assert calibration.matrix == pytest.approx(T @ S, abs=1e-15)


def test_the_uncertainty_of_a_misalignment_is_the_scatter_of_its_repeats() -> None:
    values, claimed = [], []
    for seed in range(60):
        parameters = _repeat(seed, 0.0).stages[-1].parameters
        values.append(parameters["misalignment_zx"].value)
        claimed.append(parameters["misalignment_zx"].standard_uncertainty)
    assert np.std(values) / np.mean(claimed) == pytest.approx(1.0, abs=0.28)  # three standard deviations of a scatter


def test_the_correction_is_the_calibration() -> None:
    recording = _by_hand(_spread(24), np.random.default_rng(6))
    calibration = fit(StageInput("accelerometer", with_noise([recording], _settings()), None, _settings()))
    assert recording.accelerometer is not None
    expected = (recording.accelerometer - calibration.bias) @ calibration.matrix.T
    assert corrected(calibration.stages[-1].correction, recording.accelerometer) == pytest.approx(expected)


def test_earlier_stages_are_kept_and_the_result_survives_its_file() -> None:
    before = SensorCalibration("accelerometer", stages=(StageResult("before", {}),))
    calibration = fit(
        StageInput(
            "accelerometer",
            with_noise([_by_hand(_spread(24), np.random.default_rng(7))], _settings(3)),
            before,
            _settings(3),
        )
    )
    assert [stage.name for stage in calibration.stages] == ["before", "nonlinear_least_squares"]
    again = SensorCalibration.from_json("accelerometer", json.loads(json.dumps(calibration.to_json())))
    assert again.to_json() == calibration.to_json()


def test_noise_within_a_rest_does_not_lengthen_gravity() -> None:
    """The mean of 4 samples with noise of 0.1 g has the variance 0.0025 along each of both directions across it."""
    mean = np.sqrt(0.998**2 + 2.0 * 0.0025) * _spread(24)
    corners = np.sqrt(0.0075) * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    reading = (mean[:, None] + corners).reshape(-1, 3)
    recording = Recording("recording", "rests", None, np.arange(96) * 20_000_000, accelerometer=reading)
    rests = gathered("accelerometer", [recording], {0: [Rest(4 * k, 4 * k + 4) for k in range(24)]})
    model = AccelerometerModel(rests, np.eye(12)[:, FITTED], 0.998, None)
    assert model.white == pytest.approx([0.1] * 3)
    found = fit_model(model, State(BIAS, MATRIX), prior_hypotheses(WanderPrior(1e-4, 100.0), 0.1, 1), {})
    last_step = SMALL_LAST_STEP * 0.1 * np.sqrt(3.0 / 96.0)  # the fit ends at this part of a standard uncertainty
    assert found.state.matrix == pytest.approx(np.eye(3), abs=last_step)
    assert found.state.bias == pytest.approx(np.zeros(3), abs=last_step)


def test_a_rest_that_contradicts_the_others_is_left_out_with_its_reason() -> None:
    recording = _by_hand(_spread(24), np.random.default_rng(9), noise=5e-4)
    assert recording.accelerometer is not None
    recording.accelerometer[325 * 10 : 325 * 10 + 250] *= 1.01
    calibration = fit(StageInput("accelerometer", with_noise([recording], _settings()), None, _settings()))
    left_out = calibration.stages[-1].details.rests_left_out
    assert [round(rest.time_s / 6.5) for rest in left_out] == [10]
    assert "mg off the length by the other rests" in left_out[0].reason
    assert _vector(calibration) == pytest.approx(TRUTH, abs=5e-4)


def test_a_rest_is_left_out_only_beyond_what_the_largest_of_all_reaches_by_chance() -> None:
    """The deviation from which on it is left out, by Student's t against a fit of scipy to the others."""
    up, own = _spread(24), 10
    sound = _by_hand(up, np.random.default_rng(9), noise=5e-4, between=3e-4)
    assert sound.accelerometer is not None

    def stretched(factor: float) -> Recording:
        reading = np.array(sound.accelerometer)
        reading[325 * own : 325 * own + 250] *= factor
        return replace(sound, accelerometer=reading)

    low, high = 1.0, 1.02
    for _ in range(9):
        middle = 0.5 * (low + high)
        gone = (
            fit(StageInput("accelerometer", with_noise([stretched(middle)], _settings()), None, _settings()))
            .stages[-1]
            .details.rests_left_out
        )
        low, high = (low, middle) if gone else (middle, high)
    force = stretched(high).accelerometer
    assert force is not None
    means = force.reshape(24, 325, 3)[:, 30:220].mean(axis=1)
    others = np.delete(means, own, axis=0)

    def errors(p: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.linalg.norm((y - p[:3]) @ triangle(p).T, axis=1) - 1.0

    best = least_squares(errors, [0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 1.0], x_scale="jac", args=(others,))
    slope = derivative_of(means[[own]], best.x)[0]
    spread = np.sqrt(2.0 * best.cost / 14.0 * (1.0 + slope @ np.linalg.solve(best.jac.T @ best.jac, slope)))
    limit = float(student.isf(0.5 * 1e-3 / 24.0, 14))  # 5.8; of one rest alone 4.1
    assert errors(best.x, means[[own]])[0] / spread == pytest.approx(limit, rel=0.1)


def test_a_rest_that_turned_is_left_out_with_its_reason() -> None:
    recording = _by_hand(_spread(24), np.random.default_rng(10), noise=5e-4)
    assert recording.accelerometer is not None
    recording.accelerometer[325 * 4 : 325 * 4 + 250, 0] += np.linspace(-0.05, 0.05, 250)
    details = (
        fit(StageInput("accelerometer", with_noise([recording], _settings()), None, _settings())).stages[-1].details
    )
    assert [round(rest.time_s / 6.5) for rest in details.rests_left_out] == [4]
    assert "direction of the specific force moves" in details.rests_left_out[0].reason
    assert details.orientations_used == 23


def test_held_out_rests_are_in_no_fit() -> None:
    recording = _by_hand(_spread(24), np.random.default_rng(11))
    first = fit(StageInput("accelerometer", with_noise([recording], _settings(3)), None, _settings(3)))
    assert first.stages[-1].details.orientations_used == 16
    assert recording.accelerometer is not None
    for rest in held_out_rests([recording], _settings(3).procedure)["recording"]:
        recording.accelerometer[rest.start : rest.stop] *= 1.001
    assert fit(
        StageInput("accelerometer", with_noise([recording], _settings(3)), None, _settings(3))
    ).bias == pytest.approx(first.bias, abs=1e-12)


U_OF_LIMIT = 0.02 * np.sqrt(2.0 / 3.0)  # of the sum of two cross-axis terms, both uniform within 0.02


def test_six_positions_give_bias_and_scale_factors_and_the_limit_of_each_misalignment() -> None:
    faces = np.concatenate([np.eye(3), -np.eye(3)])
    calibration = fit(
        StageInput(
            "accelerometer", with_noise([_by_hand(faces, np.random.default_rng(12))], _settings()), None, _settings()
        )
    )
    stage, part = calibration.stages[-1], calibration.to_json()
    names = ["misalignment_yx", "misalignment_zx", "misalignment_zy"]
    assert stage.details.known_by_limit == pytest.approx(dict.fromkeys(names, U_OF_LIMIT))
    for name in names:
        assert stage.parameters[name].standard_uncertainty == pytest.approx(U_OF_LIMIT, rel=0.02)
    assert (part["convergence"]["rank"], part["convergence"]["parameters"]) == (6, 9)
    assert not_determined(part).startswith(f"the rests do not determine {', '.join(names)} better than")
    (line,) = (c for c in part["uncertainty_budget"]["contributions"] if c["type"] == "B")
    assert line["contribution"][3] > 1e-4  # of S_x, by the square of the misalignments: 0.016^2 / 2
    assert np.all(
        np.abs(_vector(calibration) - TRUTH) < np.array(part["uncertainty_budget"]["expanded_uncertainty"])[FITTED]
    )
    assert np.min(_uncertainty(calibration)[:3]) > 1e-4 / np.sqrt(2.0)  # the bias wander of the sensor file is in it


def test_one_misalignment_alone_may_be_left_undetermined() -> None:
    angle = np.radians(np.arange(0.0, 360.0, 45.0))
    o, s, c = np.zeros(8), np.sin(angle), np.cos(angle)
    turns = np.concatenate([np.column_stack([o, s, c]), np.column_stack([s, o, c]), [[1, 0, 0], [0, 1, 0]]])
    recording = _by_hand(turns, np.random.default_rng(13), noise=1e-3)
    calibration = fit(StageInput("accelerometer", with_noise([recording], _settings()), None, _settings()))
    assert list(calibration.stages[-1].details.known_by_limit) == ["misalignment_yx"]
    assert calibration.convergence.rank == 8
    known = fit(
        StageInput(
            "accelerometer",
            with_noise([_by_hand(_spread(24), np.random.default_rng(13))], _settings()),
            None,
            _settings(),
        )
    )
    assert known.convergence.rank == 9
    assert not_determined(known.to_json()) == ""


def test_misalignments_within_the_limit_are_covered_where_few_rests_do_not_determine_them() -> None:
    """8 to 12 rests near the faces; each axis reads up to 2 % of each other, so that L has twice as much."""
    inside, limited = [], 0
    for seed in range(40):
        rng = np.random.default_rng([77, seed])
        up = np.concatenate([np.eye(3), -np.eye(3)])
        up = np.concatenate([up, up[rng.integers(0, 6, int(rng.integers(2, 7)))]])
        up += np.radians(3.0) * rng.standard_normal(up.shape)
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        K = np.eye(3) + 0.02 * rng.uniform(-1.0, 1.0, (3, 3))
        inverse = np.linalg.inv(K)
        L = np.linalg.cholesky((inverse.T @ inverse)[::-1, ::-1])[::-1, ::-1].T
        recording = _by_hand(up @ K.T @ MATRIX.T, rng, noise=2e-3)  # its readings are those of the matrix MATRIX
        calibration = fit(StageInput("accelerometer", with_noise([recording], _settings()), None, _settings()))
        limited += bool(calibration.stages[-1].details.known_by_limit)
        truth = np.concatenate([BIAS, L.ravel()])[FITTED]
        U = np.array(calibration.to_json()["uncertainty_budget"]["expanded_uncertainty"])[FITTED]
        inside.append(np.abs(_vector(calibration) - truth) < U)
    assert limited > 10
    assert np.mean(inside) > 0.93


def test_too_few_orientations_are_refused_with_their_number() -> None:
    recording = _by_hand(_spread(5), np.random.default_rng(14))
    with pytest.raises(NotObservableError, match=r"5 orientations determine neither.*at least 6 orientations"):
        fit(StageInput("accelerometer", with_noise([recording], _settings()), None, _settings()))


def test_orientations_that_are_too_much_alike_are_refused_and_the_parameters_named() -> None:
    angle = np.radians(np.arange(0.0, 360.0, 30.0))
    about_z = np.column_stack([np.sin(angle), np.cos(angle), np.zeros(12)])
    recording = _by_hand(about_z, np.random.default_rng(15), noise=0.0)
    assert recording.accelerometer is not None
    recording.accelerometer[:, 2] = BIAS[2]
    with pytest.raises(NotObservableError, match=r"12 orientations are too much alike.*bias_z, .*scale_factor_z"):
        fit(StageInput("accelerometer", with_noise([recording], _settings()), None, _settings()))


def test_a_unit_without_rests_cannot_be_calibrated_and_says_what_would_do() -> None:
    gyroscope = Recording("gyro_x", "gyroscope", "x", np.arange(5), gyroscope=np.zeros((5, 3)))
    with pytest.raises(CannotCalibrateError, match="record some 24 rests"):
        fit(StageInput("accelerometer", with_noise([gyroscope], _settings()), None, _settings()))


@needs_data
def test_a_published_recording_gives_the_factory_certificate() -> None:
    recording = _xsens()
    begin = clock.process_time()
    calibration = fit(
        StageInput(
            "accelerometer", with_noise([recording], _settings(gravity_g=PADUA_G)), None, _settings(gravity_g=PADUA_G)
        )
    )
    assert clock.process_time() - begin < 1.0
    stage = calibration.stages[-1]
    assert stage.details.orientations_used == 38
    assert stage.residual_rms is not None
    assert stage.residual_rms < 0.12e-3
    assert calibration.bias * COUNTS_PER_G + 32768.0 == pytest.approx([33123, 33276, 32360], abs=6.0)
    counts_per_mps2 = COUNTS_PER_G / 9.80665 / np.diag(calibration.matrix)
    assert counts_per_mps2 == pytest.approx([415.0, 413.0, 415.0], rel=3e-3)
    assert calibration.converged


@needs_data
def test_a_fit_to_two_thirds_of_a_published_recording_predicts_the_rest() -> None:
    recording, settings = _xsens(), _settings(3, PADUA_G)
    calibration = fit(StageInput("accelerometer", with_noise([recording], settings), None, settings))
    means, _ = rest_means(recording, held_out_rests([recording], settings.procedure)["recording"])
    assert len(means) == 13
    error = np.linalg.norm((means - calibration.bias) @ calibration.matrix.T, axis=1) - PADUA_G
    assert np.sqrt(np.mean(error**2)) < 0.18e-3


@needs_data
def test_a_published_mpu6050_recording_agrees_with_its_authors() -> None:
    counts = np.loadtxt(DATA / "mpu6050_multi_position/example_data_calibration.csv", delimiter=",", skiprows=5)
    recording = Recording(
        "recording",
        "rests",
        None,
        np.arange(len(counts)) * 10_000_000,
        accelerometer=counts[:, :3] / 16384.0,
        gyroscope=counts[:, 3:] / 131.0,
    )
    calibration = fit(StageInput("accelerometer", with_noise([recording], _settings()), None, _settings()))
    assert calibration.stages[-1].details.orientations_used == 10
    # Theirs are no better than that: two of their ten intervals reach into a move.
    assert calibration.bias * 16384.0 == pytest.approx([711.5, -358.5, -1840.1], abs=30.0)
    scale = 9.80665 * np.diag(calibration.matrix) / 16384.0
    assert scale == pytest.approx([6.0201e-4, 5.9684e-4, 5.8592e-4], rel=5e-3)
