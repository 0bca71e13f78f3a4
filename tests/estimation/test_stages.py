"""The contract of a fit stage: covariance and budget by ``StageOutput``, against the truth of simulated units."""

from __future__ import annotations

import doctest
from dataclasses import replace

import numpy as np
import pytest

from pipeline.core.errors import NotObservableError
from pipeline.core.records import BIAS_NAMES, LIMIT, MATRIX, Recording, SensorCalibration
from pipeline.estimation import stages
from pipeline.estimation.rest_means import Rests, rests_of
from pipeline.estimation.stages import StageInput, StageOutput
from pipeline.simulation.description import shipped_settings
from tests.unit_settings import settings_of, with_noise

SHIPPED = shipped_settings(sensor="mpu6050", table="hand", procedure="multi_position")
STEADY = {f"sensor.{sensor}.bias_wander": 1e-9 for sensor in ("accelerometer", "gyroscope")}
SETTINGS = settings_of(SHIPPED, **{"table.gravity_g": 1.0, "table.gravity_accuracy_g": 1e-4, **STEADY})
BIAS = np.array([0.05, -0.02, 0.01])
UP = np.concatenate([np.eye(3), -np.eye(3), [[0.6, 0.8, 0.0], [0.0, -0.6, 0.8], [0.8, 0.0, -0.6], [-0.6, -0.8, 0.0]]])


def task(seed: int, matrix: np.ndarray | None = None, up: np.ndarray = UP, gyroscope_bias: float = 1.0) -> StageInput:
    """A unit in ten rests of 5 s at 50 Hz, with white noise, and moves of 1.5 s."""
    rng, K = np.random.default_rng(seed), np.eye(3) if matrix is None else np.linalg.inv(matrix)
    force, rate = [], []
    for k, one in enumerate(up):
        blend = np.linspace(0.0, 1.0, 75)[:, None]
        move = one * (1 - blend) + up[min(k + 1, len(up) - 1)] * blend + 0.1 * np.sin(np.arange(75) / 2.0)[:, None]
        force += [np.tile(one, (250, 1)), move]
        rate += [np.zeros((250, 3)), 40.0 * np.sin(np.pi * blend) * [1.0, -1.0, 0.5]]
    truth = np.concatenate(force)
    reading = BIAS + truth @ K.T + 3e-3 * rng.normal(size=truth.shape)
    turning = gyroscope_bias + np.concatenate(rate) + 0.03 * rng.normal(size=truth.shape)
    time = np.arange(len(truth)) * 20_000_000
    recording = Recording("r", "rests", None, time, accelerometer=reading, gyroscope=turning)
    return StageInput("accelerometer", with_noise([recording], SETTINGS), None, SETTINGS, "accelerometer_bias")


def by_length(given: StageInput) -> StageOutput:
    """The example of ``StageOutput``."""
    rests, g, bias = given.rests, given.settings.table.gravity_g, np.zeros(3)
    for _ in range(10):
        force = rests.reading - bias
        length = np.linalg.norm(force, axis=1, keepdims=True)
        residual, direction = length[:, 0] - g, force / length
        bias = bias + np.linalg.lstsq(direction, residual)[0]
    return StageOutput(
        estimated=BIAS_NAMES, bias=bias, rests=rests, residual=residual, jacobian=-direction, by_reading=direction,
        by_gravity=np.full(len(residual), -1.0),
    )  # fmt: skip


def mean_of_rests(given: StageInput, rests: Rests | None = None) -> StageOutput:
    """The bias of the gyroscope: three equations for each rest."""
    rests = rests or given.rests
    bias, m = rests.reading.mean(axis=0), len(rests.time)
    return StageOutput(
        estimated=BIAS_NAMES, bias=bias, rests=rests, residual=(rests.reading - bias).ravel(),
        jacobian=np.tile(-np.eye(3), (m, 1)), by_reading=np.tile(np.eye(3), (m, 1)), row=np.repeat(np.arange(m), 3),
    )  # fmt: skip


def test_the_example_of_the_contract_runs() -> None:
    globs = vars(stages) | {"BIAS_NAMES": BIAS_NAMES, "task": task(0)}
    example = doctest.DocTestFinder(recurse=False).find(StageOutput, "StageOutput", globs=globs)
    assert sum(doctest.DocTestRunner().run(each).failed for each in example) == 0


@pytest.mark.parametrize("sensor", ["accelerometer", "gyroscope"])
def test_the_covariance_covers_the_errors(sensor: str) -> None:
    z = []
    for seed in range(12):
        given = StageInput(sensor, task(seed).recordings, None, SETTINGS, "bias")
        found = (by_length if sensor == "accelerometer" else mean_of_rests)(given).calibration(given)
        noise = found.lines[0].standard_uncertainty[:3]
        z.append((found.bias - (BIAS if sensor == "accelerometer" else 1.0)) / noise)
    assert 0.3 < np.mean(np.square(z)) < 1.7  # 36 values


def test_what_no_stage_estimates_has_the_limits_of_the_sensor_file_and_widens_the_rest() -> None:
    rng, z = np.random.default_rng(5), []
    sheet = SETTINGS.sensor.accelerometer
    for seed in range(12):
        limits = np.where(np.eye(3) > 0.0, sheet.scale_factor, sheet.cross_axis)
        given = task(seed, np.eye(3) + limits * rng.uniform(-1.0, 1.0, (3, 3)), UP[:9])
        found = by_length(given).calibration(given)
        z.append((found.bias - BIAS) / found.parameters.standard_uncertainty[:3])
        line = next(line for line in found.lines if line.source == LIMIT)
        assert line.standard_uncertainty[MATRIX] == pytest.approx(limits.ravel() / np.sqrt(3.0))
        assert found.by_limit[MATRIX].all()
    assert 0.2 < np.mean(np.square(z)) < 2.0


def test_what_a_stage_before_has_estimated_is_kept_with_its_uncertainty() -> None:
    given, u = task(3), 1e-3
    covariance = np.zeros((12, 12))
    covariance[MATRIX, MATRIX] = u**2 * np.eye(9)
    before = SensorCalibration("accelerometer", matrix=np.eye(3), covariance=covariance)
    given = StageInput(given.sensor, given.recordings, before, SETTINGS, "bias")
    found = by_length(given).calibration(given)
    assert found.parameters.standard_uncertainty[MATRIX] == pytest.approx(u)
    assert [line.source for line in found.lines] == ["noise of the readings", "stages before", "local gravity"]


def test_an_effect_at_its_limit_changes_the_bias_by_what_a_fit_to_it_finds() -> None:
    given = task(4)
    found = by_length(given).calibration(given)
    limit = SETTINGS.sensor.accelerometer.effects["quadratic_nonlinearity"]
    recordings = given.recordings.filtered
    reading = recordings[0].accelerometer + limit * (recordings[0].accelerometer - BIAS) ** 2 * [1.0, 0.0, 0.0]
    bent = recordings[0].with_readings(accelerometer=reading)
    other = StageInput("accelerometer", with_noise([bent], SETTINGS), None, SETTINGS, "bias")
    change = by_length(other).calibration(other).bias - found.bias
    assert found.at_limits["quadratic_nonlinearity"][:3, 0] == pytest.approx(change, abs=0.1 * np.abs(change).max())


def test_effects_at_their_limits_are_those_of_the_force_in_the_rests_of_the_stage() -> None:
    given, rng = task(6), np.random.default_rng(6)
    static = []
    for k in range(len(UP)):  # as many rests as the fit has, all with z up
        time = (np.arange(500) + 100_000 * (k + 1)) * 20_000_000
        force = [0.0, 0.0, 1.0] + 3e-3 * rng.normal(size=(500, 3))
        static.append(
            Recording(f"s{k}", "static", None, time, accelerometer=force, gyroscope=0.03 * rng.normal(size=(500, 3)))
        )
    logged = with_noise([*given.recordings.filtered, *static], SETTINGS)
    limit = SETTINGS.sensor.gyroscope.effects["g_sensitivity"]
    rests = rests_of("gyroscope", logged.filtered, SETTINGS.procedure, role="static")
    assert rests is not None
    assert len(rests.time) == len(given.rests.time)
    for recordings, most in ((logged.filtered, [0.0, 0.0, limit]), ([*map(no_force, logged.filtered)], [limit] * 3)):
        of_static = replace(given, sensor="gyroscope", recordings=replace(logged, filtered=recordings))
        changes = mean_of_rests(of_static, rests).calibration(of_static).at_limits["g_sensitivity"]
        assert np.abs(changes[:3]).sum(axis=0).reshape(3, 3) == pytest.approx(np.tile(most, (3, 1)), abs=0.01 * limit)


def no_force(recording: Recording) -> Recording:
    return recording.with_readings(accelerometer=None) if recording.role == "static" else recording


def test_equations_that_do_not_determine_the_estimates_are_refused() -> None:
    given = task(2)
    flat = by_length(given)
    flat.jacobian[:, 2] = 0.0
    with pytest.raises(NotObservableError, match="bias_z"):
        flat.calibration(given)
