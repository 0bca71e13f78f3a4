from dataclasses import replace

import numpy as np
import pytest

from pipeline.model.effects import effect
from pipeline.records import Motion
from pipeline.simulation.description import read_config
from pipeline.simulation.sensor import Scene, SimulatedSensor, bias_wander, decimals_of
from pipeline.simulation.trajectory import random_gimbals

SHEETS = read_config("sensor", "mpu6050")

# Sudsanguan 2019, tables 5.1 to 5.6 (biases, medians) and 5.23 (scale factors), as restated with the before-errors
# that random attitudes give with them, g; the thesis prints 0.069, 0.023, 0.021 for its own motion.
DEVICES = {
    "MPU6050 (1)": ((0.049, -0.013, -0.1285), (1.001, 0.994, 0.980), 0.071),
    "MPU6050 (2)": ((0.041, -0.017, -0.001), (0.993, 0.996, 0.986), 0.024),
    "STIM300": ((-0.009, -0.0455, -0.009), (1.002, 1.003, 0.998), 0.023),
}


def a_motion() -> Motion:
    return Scene(random_gimbals(60.0, 40.0, np.random.default_rng(4))).motion(np.linspace(0.0, 60.0, 200))


def test_a_reading_is_bias_plus_the_inverse_matrix_times_the_truth_plus_effects() -> None:
    matrix = np.array([[1.02, 0.01, 0.0], [-0.02, 0.98, 0.03], [0.0, 0.01, 1.01]])
    sensitivity = np.random.default_rng(1).normal(0.0, 0.1, 9)
    sensor = SimulatedSensor(
        "gyroscope",
        SHEETS["gyroscope"],
        np.array([1.0, -2.0, 0.5]),
        matrix,
        {"g_sensitivity": (effect("g_sensitivity"), sensitivity)},
    )
    motion = a_motion()
    added = motion.specific_force @ sensitivity.reshape(3, 3).T
    restored = (sensor.exact(motion) - sensor.bias - added) @ matrix.T
    np.testing.assert_allclose(restored, motion.angular_rate, atol=1e-12)


def test_white_noise_has_the_density_of_the_data_sheet_up_to_the_nyquist_frequency() -> None:
    sensor = SimulatedSensor("gyroscope", SHEETS["gyroscope"], np.zeros(3), np.eye(3))
    assert sensor.white(0.01) == pytest.approx(0.005 * np.sqrt(50.0))
    assert sensor.white(0.12) == pytest.approx(0.0102062, abs=1e-7)


def test_readings_are_whole_counts_and_stop_at_full_scale() -> None:
    sensor = SimulatedSensor("accelerometer", SHEETS["accelerometer"], np.zeros(3), np.eye(3))
    counts = sensor.quantised(np.array([[0.1, -5.0, 5.0]])) * 16384.0
    assert counts.tolist() == [[1638.0, -32768.0, 32767.0]]
    assert decimals_of(sensor.sheet) == 6  # half a unit of the last digit is 0.008 counts


def test_wander_has_unit_variance_and_its_correlation_time_within_recordings_and_across_pauses() -> None:
    rng = np.random.default_rng(11)
    values, later, across = [], [], []
    sessions = [np.arange(0.0, 60.0, 1.0), np.arange(110.0, 170.0, 1.0)]
    for _ in range(1500):
        first, second = bias_wander(sessions, 100.0, rng)
        values.append(first[0])
        later.append(first[50])
        across.append(second[0])
    start = np.ravel(values)
    # 4500 draws: the standard error of a variance is sqrt(2/4500) = 0.021, that of a correlation about 0.015
    for sample in (start, np.ravel(later), np.ravel(across)):
        assert np.var(sample) == pytest.approx(1.0, abs=0.063)
    assert np.mean(start * np.ravel(later)) == pytest.approx(np.exp(-0.5), abs=0.045)
    assert np.mean(start * np.ravel(across)) == pytest.approx(np.exp(-1.1), abs=0.045)


def test_wander_of_a_long_rest_has_the_allan_variance_of_a_gauss_markov_process() -> None:
    tau, step = 20.0, 0.5
    (process,) = bias_wander([np.arange(0.0, 40000.0, step)], tau, np.random.default_rng(3))
    for window in (5.0, 20.0, 80.0):
        m = round(window / step)
        means = process[: len(process) // m * m].reshape(-1, m, 3).mean(1)
        allan = 0.5 * np.mean(np.diff(means, axis=0) ** 2)
        x = window / tau  # IEEE Std 952-2020, annex C: exponentially correlated noise of unit variance
        expected = (2.0 / x) * (1.0 - (1.0 / (2.0 * x)) * (3.0 - 4.0 * np.exp(-x) + np.exp(-2.0 * x)))
        assert allan == pytest.approx(expected, rel=4.0 * np.sqrt(1.5 / means.size) + 0.01)


@pytest.mark.parametrize("device", DEVICES)
def test_random_attitudes_with_the_published_parameters_give_the_published_error(device: str) -> None:
    bias, scale, published = DEVICES[device]
    sensor = SimulatedSensor("accelerometer", SHEETS["accelerometer"], np.array(bias), np.diag(scale))
    attitudes = np.random.default_rng(8).normal(size=(40000, 3))
    attitudes /= np.linalg.norm(attitudes, axis=1, keepdims=True)
    motion = replace(a_motion(), specific_force=attitudes)
    error = np.mean(np.abs(np.linalg.norm(sensor.exact(motion), axis=1) - 1.0))
    assert error == pytest.approx(published, abs=0.0011)
