from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from table_turns import Bench, run_stages, settings
from unit_settings import filter_of

from pipeline.core.errors import CannotCalibrateError, NotObservableError
from pipeline.core.records import Recording, SensorCalibration, UnitRecordings, attitude_matrix, coverage_factor
from pipeline.estimation.reference_least_squares import fit
from pipeline.estimation.stages import StageInput
from pipeline.physics.kinematics import reference_motion
from pipeline.physics.signal.filters import apply_filter

if TYPE_CHECKING:
    from pipeline.core.settings import Filter

K = np.eye(3) + np.array([[0.004, 0.011, -0.006], [-0.009, -0.012, 0.003], [0.007, -0.002, 0.018]])
MATRIX = np.linalg.solve(K, np.eye(3))
ACCELEROMETER = {"sensor": "accelerometer", "bias": [0.049, -0.013, -0.127], "K": K}
GYROSCOPE = {"sensor": "gyroscope", "bias": [-3.837, 0.003, 0.255], "K": K}
RC = filter_of("rc_low_pass", cutoff_hz=1.0, time_constant_s=None, zero_phase=False)
BUTTERWORTH = filter_of("low_pass", cutoff_hz=1.0, order=2, zero_phase=False)


def calibrate(sensor: str, recordings: list[Recording], **table: float) -> SensorCalibration:
    return run_stages(sensor, ["reference_least_squares"], recordings, settings(**table))


def assert_exact(found: SensorCalibration, bench: Bench, tolerance: float = 1e-10) -> None:
    assert np.allclose(found.bias, bench.bias, rtol=0, atol=tolerance)
    assert np.allclose(found.matrix, MATRIX, rtol=0, atol=tolerance)


@pytest.mark.parametrize("motion", ["stop_and_go", "continuous", "two_axes", "part_of_a_turn"])
def test_bias_and_full_matrix_of_the_accelerometer_are_recovered_exactly(motion: str) -> None:
    bench = Bench(**ACCELEROMETER)
    recordings = {
        "stop_and_go": bench.stop_and_go,
        "continuous": lambda: bench.continuous(5.0),
        "two_axes": lambda: bench.stop_and_go(axes="xy"),
        "part_of_a_turn": lambda: bench.stop_and_go(stop=90.0),
    }[motion]()
    assert_exact(calibrate("accelerometer", recordings), bench)


@pytest.mark.parametrize("rates", [[60.0], [60.0, -200.0]], ids=["one_direction", "both_directions"])
def test_bias_and_full_matrix_of_the_gyroscope_are_recovered_exactly(rates: list[float]) -> None:
    bench = Bench(**GYROSCOPE)
    assert_exact(calibrate("gyroscope", bench.turns_at(rates)), bench, 1e-9)


def test_a_rate_that_is_not_logged_is_taken_from_the_angle_without_its_ramps() -> None:
    bench = Bench(**GYROSCOPE)
    recordings = [replace(r, table_rate=None) for r in bench.turns_at([60.0, -60.0])]
    found = calibrate("gyroscope", recordings)
    assert_exact(found, bench, 1e-4)
    assert found.stages[0].details.samples_left_out > 0


def test_an_attitude_log_is_a_reference_too() -> None:
    time = np.arange(0.0, 120.0, 0.12)
    axis = np.column_stack([np.sin(0.11 * time), np.cos(0.07 * time), np.sin(0.05 * time + 1.0)])
    half = 0.3 * time[:, None] * axis / np.linalg.norm(axis, axis=1, keepdims=True)
    size = np.linalg.norm(half, axis=1, keepdims=True)
    q = np.hstack([np.cos(size), np.sinc(size / np.pi) * half])
    bench = Bench(**ACCELEROMETER)
    up = attitude_matrix(q)[:, 2, :]
    time_ns = np.arange(len(time)) * 120_000_000
    recording = Recording("sphere", "accelerometer", None, time_ns, accelerometer=bench.reading(up), table_attitude=q)
    assert_exact(calibrate("accelerometer", [recording]), bench)


@pytest.mark.parametrize(
    "applied", [RC, BUTTERWORTH, RC.replaced(zero_phase=True)], ids=["rc", "butterworth", "zero_phase"]
)
def test_a_filter_on_the_readings_changes_neither_scale_nor_misalignment(applied: Filter) -> None:
    for parameters, recordings in (
        (ACCELEROMETER, lambda bench: bench.continuous(30.0, stop=720.0)),
        (GYROSCOPE, lambda bench: bench.turns_at([60.0, -60.0])),
    ):
        bench = Bench(**parameters)
        filtered = [apply_filter(r, applied) for r in recordings(bench)]
        assert_exact(calibrate(bench.sensor, filtered), bench, 1e-9)


def test_only_settled_rests_count_where_the_table_stops_and_goes() -> None:
    bench = Bench(**ACCELEROMETER)
    recordings = []
    for recording in bench.stop_and_go():
        still = reference_motion(recording).still
        disturbed = recording.accelerometer + 0.5 * ~still[:, None]
        recordings.append(replace(recording, accelerometer=disturbed))
    found = calibrate("accelerometer", recordings)
    assert_exact(found, bench)
    assert found.stages[0].details.samples_left_out > 0


def test_clipped_and_stuck_samples_are_left_out_and_counted_but_gaps_are_not() -> None:
    bench = Bench(**GYROSCOPE)
    recordings = []
    for recording in bench.turns_at([60.0, -60.0]):
        flags = np.zeros(recording.samples, np.uint16)
        flags[20:25], flags[50:53], flags[60:90] = 0b10, 0b100, 0b1
        reading = recording.gyroscope.copy()
        reading[(flags & 0b110) != 0] = 250.0
        recordings.append(replace(recording, gyroscope=reading, flags=flags))
    found = calibrate("gyroscope", recordings)
    assert_exact(found, bench, 1e-9)
    assert found.stages[0].details.samples_left_out == 3 * 8


def test_the_column_that_two_turns_of_a_gyroscope_leave_open_is_named() -> None:
    recordings = Bench(**GYROSCOPE).turns_at({"x": [60.0], "y": [60.0]})
    with pytest.raises(NotObservableError, match="do not determine matrix column z: record a turn about each"):
        calibrate("gyroscope", recordings)
    with pytest.raises(NotObservableError, match="do not determine matrix column z"):
        calibrate("gyroscope", recordings, latitude_deg=45.0, azimuth_deg=10.0)


def test_one_turn_of_an_accelerometer_leaves_the_column_of_its_axis_open() -> None:
    recordings = Bench(**ACCELEROMETER).stop_and_go(axes="y")
    with pytest.raises(NotObservableError, match="do not determine matrix column y"):
        calibrate("accelerometer", recordings)


def test_a_gyroscope_that_was_never_turned_says_so() -> None:
    still = Bench(**GYROSCOPE).turns_at([0.0])
    with pytest.raises(NotObservableError, match="the table never moved"):
        calibrate("gyroscope", still)


def test_without_a_table_log_there_is_no_reference() -> None:
    recordings = [replace(r, table_angle=None) for r in Bench(**ACCELEROMETER).stop_and_go()]
    with pytest.raises(CannotCalibrateError, match="reference_least_squares needs the table's motion"):
        calibrate("accelerometer", recordings)


def test_recordings_of_the_other_sensor_and_held_out_ones_are_not_used() -> None:
    bench = Bench(**ACCELEROMETER)
    recordings = bench.stop_and_go()
    wrong = replace(recordings[0], accelerometer=recordings[0].accelerometer + 1.0)
    others = [replace(wrong, role=role) for role in ("gyroscope", "validation", "rests")]
    assert_exact(calibrate("accelerometer", [*recordings, *others]), bench)


@pytest.mark.parametrize(("wander", "units"), [(1.0, 200), (5.0, 60)])
def test_stated_uncertainty_covers_the_truth_under_bias_wander(wander: float, units: int) -> None:
    # 95 % claimed of 12 parameters; three standard deviations of as many independent units would be 0.046 and 0.085.
    hits, naive = [], []
    for seed in range(units):
        bench = Bench(**ACCELEROMETER, white=8e-4, wander_size=wander * 1e-4, seed=seed)
        found = calibrate("accelerometer", bench.stop_and_go(15.0, 1.2))
        error = np.concatenate([found.bias - bench.bias, (found.matrix - MATRIX).ravel()])
        u = np.sqrt(np.diag(found.covariance))
        hits.append(np.abs(error) <= coverage_factor(found.freedom) * u)
        details = found.stages[0].details
        naive.append(np.abs(error[:3]) <= 1.96 * np.array(details.residual_rms) / np.sqrt(details.samples_used))
    assert 0.92 < np.mean(hits) < 0.985
    assert np.all(np.mean(hits, axis=0) > 0.95 - 4.0 * np.sqrt(0.0475 / units))
    assert np.mean(naive) < 0.7  # what sigma^2 (X^T X)^-1 would claim


def test_white_noise_is_told_from_bias_wander() -> None:
    bench = Bench(**ACCELEROMETER, white=8e-4, wander_size=5e-4, seed=4)
    details = calibrate("accelerometer", bench.stop_and_go(2.0, 1.2)).stages[0].details
    assert details.white_noise == pytest.approx([8e-4] * 3, rel=0.2)
    assert details.bias_wander == pytest.approx([5e-4] * 3, rel=0.5)


def test_a_long_static_recording_narrows_the_uncertainty_of_the_bias() -> None:
    bench = Bench(**ACCELEROMETER, white=8e-4, wander_size=1e-4, seed=2)
    static = replace(
        bench.turn("x", np.zeros(30_000), np.zeros(30_000)), role="static", axis=None, table_angle=None, table_rate=None
    )
    turns = bench.stop_and_go(15.0, 1.2)
    alone, pinned = calibrate("accelerometer", turns), calibrate("accelerometer", [*turns, static])
    assert pinned.degrees_of_freedom > alone.degrees_of_freedom
    assert np.array_equal(pinned.matrix, alone.matrix)


def test_the_result_is_the_same_every_time_and_survives_its_file() -> None:
    recordings = Bench(**GYROSCOPE, white=0.05, wander_size=0.003).turns_at([60.0])
    first, second = calibrate("gyroscope", recordings), calibrate("gyroscope", recordings)
    assert first.to_json() == second.to_json()
    back = SensorCalibration.from_json("gyroscope", first.to_json())
    assert back.to_json() == first.to_json()
    assert list(first.stages[0].parameters) == list(first.parameters.names)


def test_a_fit_without_details_has_the_same_matrix_covariance_and_degrees_of_freedom() -> None:
    recordings = Bench(**GYROSCOPE, white=0.05, wander_size=0.003).turns_at([60.0])
    task = StageInput("gyroscope", UnitRecordings(recordings, {"gyroscope": None}), None, settings())
    whole, alone = fit(task), fit(task, details=False)
    assert np.array_equal(alone.matrix, whole.matrix)
    assert np.array_equal(alone.covariance, whole.covariance)
    assert np.array_equal(alone.parameters.degrees_of_freedom, whole.parameters.degrees_of_freedom)
    assert [line.source for line in alone.lines] == [line.source for line in whole.lines]


def test_the_covariance_of_the_matrix_is_that_of_its_inverse_by_simulation() -> None:
    errors, stated = [], []
    for seed in range(100):
        bench = Bench(**GYROSCOPE, white=0.5, seed=seed)
        found = calibrate("gyroscope", bench.turns_at([20.0]))
        errors.append((found.matrix - MATRIX).ravel())
        stated.append(found.covariance[3:, 3:])
    empirical, claimed = np.cov(np.array(errors).T), np.mean(stated, axis=0)
    scale = np.sqrt(np.diag(empirical))
    correlation = empirical / np.outer(scale, scale) - claimed / np.outer(*[np.sqrt(np.diag(claimed))] * 2)
    assert np.max(np.abs(correlation)) < 4.0 / np.sqrt(100)
