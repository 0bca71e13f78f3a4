from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hand_simulator import Hand, draw

from pipeline.core.records import Recording
from pipeline.physics.signal.rests import (
    Rest,
    assess_rests,
    find_rests,
    rests_from_table,
    runs,
    settling_of,
    still_samples,
)

DATA = Path(__file__).parents[2] / "../shared/data"
needs_data = pytest.mark.skipif(not DATA.exists(), reason="reference data not beside the repository")
MPU_COUNTS_PER_DPS = 131.0


def _recording(force: np.ndarray, rate: np.ndarray | None = None, interval: float = 0.01, **more: Any) -> Recording:
    time_ns = np.arange(len(force)) * round(interval * 1e9)
    return Recording("recording", "rests", None, time_ns, accelerometer=force, gyroscope=rate, **more)


def _xsens() -> Recording:
    force = np.loadtxt(DATA / "xsens_mti_multi_position/accelerometer.txt")
    rate = np.loadtxt(DATA / "xsens_mti_multi_position/gyroscope.txt")
    return Recording(
        "recording",
        "rests",
        None,
        np.round(force[:, 0] * 1e9).astype(np.int64),
        accelerometer=(force[:, 1:] - 32768.0) / 4070.0,
        gyroscope=(rate[:, 1:] - 32768.0) / 83.2,
    )


def _mpu6050() -> Recording:
    counts = np.loadtxt(DATA / "mpu6050_multi_position/example_data_calibration.csv", delimiter=",", skiprows=5)
    return _recording(counts[:, :3] / 16384.0, counts[:, 3:] / MPU_COUNTS_PER_DPS)


def _rests_and_moves(
    orientations: int = 8, rest_s: float = 5.0, move_s: float = 1.5, noise: float = 2e-3, seed: int = 1
) -> tuple[np.ndarray, np.ndarray, list[tuple[int, int]]]:
    """Readings at 100 Hz, angular rate, and where the rests truly lie."""
    rng = np.random.default_rng(seed)
    up = rng.normal(size=(orientations, 3))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    force, rate, truth = [], [], []
    for k in range(orientations):
        rest, move = round(rest_s * 100), round(move_s * 100)
        begin = sum(len(f) for f in force)
        truth.append((begin, begin + rest))
        force.append(np.tile(up[k], (rest, 1)))
        rate.append(np.zeros((rest, 3)))
        if k + 1 < orientations:
            blend = np.linspace(0.0, 1.0, move)[:, None]
            shake = 0.1 * np.sin(2 * np.pi * np.arange(move) / 25.0)[:, None]
            force.append(up[k] * (1 - blend) + up[k + 1] * blend + shake)
            rate.append(np.full((move, 3), 60.0))
    f, w = np.concatenate(force), np.concatenate(rate)
    return f + noise * rng.normal(size=f.shape), w + 0.05 * rng.normal(size=w.shape), truth


def test_runs_are_the_stretches_of_true() -> None:
    assert runs(np.array([True, True, False, True, False, False, True])) == [(0, 2), (3, 4), (6, 7)]
    assert runs(np.zeros(3, bool)) == []


def test_a_rest_settles_unless_the_recording_begins_with_it() -> None:
    time = np.arange(10) * 0.1
    rate = np.array([0, 0, 5, 5, 0.01, 0.01, 0.01, 0.01, 0.01, 5.0])
    assert still_samples(time, rate).tolist() == [True, True, *[False] * 5, True, True, False]


def test_the_table_log_gives_the_rests_by_rate_or_by_angle() -> None:
    angle = np.concatenate([np.zeros(20), np.linspace(0, 10, 11)[1:], np.full(20, 10.0)])
    rate = np.concatenate([np.zeros(20), np.full(10, 10.0), np.zeros(20)])
    by_rate = _recording(np.zeros((50, 3)), interval=0.1, table_rate=rate)
    assert rests_from_table(by_rate) == [Rest(0, 20), Rest(33, 50)]
    by_angle = _recording(np.zeros((50, 3)), interval=0.1, table_angle=angle)
    assert rests_from_table(by_angle) == [Rest(0, 19), Rest(33, 50)]
    assert rests_from_table(_recording(np.zeros((50, 3)))) == []


def test_a_filter_delays_the_beginning_of_a_rest() -> None:
    rate = np.concatenate([np.full(10, 5.0), np.zeros(30)])
    filtered = _recording(np.zeros((40, 3)), interval=0.1, table_rate=rate, filter={"name": "x", "delay_s": 0.5})
    assert rests_from_table(filtered) == [Rest(18, 40)]


@pytest.mark.parametrize("noise", [0.0, 1e-4, 8e-3])
def test_rests_are_found_within_their_true_limits_at_any_noise(noise: float) -> None:
    force, rate, truth = _rests_and_moves(noise=noise)
    rests = find_rests(_recording(force, rate))
    assert len(rests) == len(truth)
    for rest, (start, stop) in zip(rests, truth, strict=True):
        assert rest.accepted
        assert start <= rest.start < rest.stop <= stop
        assert rest.stop - rest.start > 350  # of 500


def test_rests_are_found_at_the_sampling_rate_of_a_slow_logger() -> None:
    force, rate, truth = _rests_and_moves(rest_s=9.0)
    slow = _recording(force, rate).select(slice(0, None, 12))
    assert [rest.accepted for rest in find_rests(slow)] == [True] * len(truth)


@pytest.mark.parametrize(("slow_s", "rest_s", "clear"), [(0.3, 4.0, False), (0.3, 2.0, True)])
def test_rests_begin_when_a_slow_filter_has_settled(slow_s: float, rest_s: float, *, clear: bool) -> None:
    """The truth is the same motion without the filter: means agree, or the settling is named."""
    steady, slow = (draw(Hand(rests=16, rest_s=rest_s, slow_s=value), 5).recording for value in (0.0, slow_s))
    assert settling_of(steady) is None
    settling = settling_of(slow)
    assert settling is not None
    assert settling.time_s == pytest.approx(slow_s, rel=0.15)
    assert settling.clear == clear
    rests = find_rests(slow)
    assert steady.accelerometer is not None
    assert slow.accelerometer is not None
    before = np.array([steady.accelerometer[r.start : r.stop].mean(axis=0) for r in rests])
    errors = np.array([slow.accelerometer[r.start : r.stop].mean(axis=0) for r in rests]) - before  # the same noise
    apart = before[:-1] - before[1:]
    off = np.mean(np.sum(errors[1:] * apart, axis=1) / np.linalg.norm(apart, axis=1))
    assert off == pytest.approx(settling.left_g, rel=0.5, abs=2e-5)  # 0.02 mg: the noise of all means together


def test_a_rest_that_turns_slowly_is_refused() -> None:
    force, _, truth = _rests_and_moves()
    start, stop = truth[3]
    across = np.cross(force[start], [0.3, -0.5, 0.8])
    across /= np.linalg.norm(across)
    force[start:stop] += np.radians(4.0) * np.linspace(-0.5, 0.5, stop - start)[:, None] * across
    rests = find_rests(_recording(force))
    assert [rest.accepted for rest in rests] == [k != 3 for k in range(8)]
    assert "direction of the specific force moves by" in rests[3].reason


def test_a_rest_whose_rate_stands_off_its_neighbours_is_refused() -> None:
    force, rate, truth = _rests_and_moves()
    rate[slice(*truth[5])] += [0.0, 0.0, 1.2]  # about gravity: the specific force does not show it
    rests = find_rests(_recording(force, rate))
    assert [rest.accepted for rest in rests] == [k != 5 for k in range(8)]
    assert "angular rate is 1.2" in rests[5].reason


def test_a_bias_that_wanders_with_the_temperature_is_no_motion() -> None:
    force, rate, _ = _rests_and_moves(orientations=20)
    rate = rate + np.linspace(0.0, 3.0, len(rate))[:, None]
    assert [rest.accepted for rest in find_rests(_recording(force, rate))] == [True] * 20


def test_a_quiet_sensor_may_settle_by_a_tenth_of_a_degree() -> None:
    force, _, truth = _rests_and_moves(noise=5e-5)
    start, stop = truth[3]
    force[start:stop, 0] += np.radians(0.1) * np.linspace(-0.5, 0.5, stop - start)
    assert [rest.accepted for rest in find_rests(_recording(force))] == [True] * 8


def test_a_rest_that_shakes_is_refused() -> None:
    force, rate, truth = _rests_and_moves()
    start, stop = truth[2]
    force[start:stop] += 7e-3 * np.random.default_rng(7).normal(size=(stop - start, 3))
    rests = assess_rests(_recording(force, rate), [(a + 50, b - 50) for a, b in truth], 3 * 2e-3**2)
    assert [rest.accepted for rest in rests] == [k != 2 for k in range(8)]
    assert "times the noise" in rests[2].reason


def test_clipped_samples_and_gaps_end_a_rest() -> None:
    force, rate, truth = _rests_and_moves(orientations=4)
    flags = np.zeros(len(force), np.uint16)
    middle = sum(truth[1]) // 2
    flags[middle] = 0b10
    rests = find_rests(_recording(force, rate, flags=flags))
    assert len(rests) == 5
    assert not any(rest.start <= middle < rest.stop for rest in rests)
    time_ns = np.arange(len(force)) * 10_000_000 + np.where(np.arange(len(force)) >= middle, 5_000_000_000, 0)
    gap = Recording("recording", "rests", None, time_ns, accelerometer=force, gyroscope=rate)
    assert not any(rest.start < middle < rest.stop for rest in find_rests(gap))


def test_a_slow_continuous_turn_holds_no_sound_rest() -> None:
    angle = np.radians(np.arange(6000) * 0.05)  # 5 deg/s at 100 Hz
    force = np.column_stack([np.zeros(6000), np.sin(angle), np.cos(angle)])
    force += 2e-3 * np.random.default_rng(8).normal(size=force.shape)
    assert not any(rest.accepted for rest in find_rests(_recording(force)))


def test_too_few_samples_hold_no_rest() -> None:
    assert find_rests(_recording(np.zeros((1, 3)))) == []
    assert find_rests(_recording(np.zeros((60, 3)))) == []


@needs_data
@pytest.mark.parametrize("keep_every", [1, 4, 12])
def test_all_38_rests_of_a_published_hand_held_recording_are_found(keep_every: int) -> None:
    rests = find_rests(_xsens().select(slice(0, None, keep_every)))
    assert len(rests) == 38
    assert all(rest.accepted for rest in rests)


@needs_data
def test_the_ten_rests_of_a_published_mpu6050_recording_are_found() -> None:
    recording = _mpu6050()
    rests = find_rests(recording)
    assert len(rests) == 10
    assert recording.gyroscope is not None
    for rest in rests:  # -427 counts at rest
        assert abs(recording.gyroscope[rest.start : rest.stop, 0].mean() * MPU_COUNTS_PER_DPS + 427.0) < 45.0


@needs_data
@pytest.mark.parametrize(("number", "mean_rate_x"), [(3, -321.9), (6, -631.3)])
def test_the_published_intervals_that_reach_into_a_move_are_refused(number: int, mean_rate_x: float) -> None:
    recording = _mpu6050()
    assert recording.gyroscope is not None
    rests = find_rests(replace(recording, gyroscope=None))  # their intervals begin where the accelerometer is quiet
    intervals = [(rest.start, rest.stop) for rest in rests]
    start, stop = intervals[number - 1]
    # Their limits are not published, their mean rate is: go on into the next move until it is that.
    means = [MPU_COUNTS_PER_DPS * recording.gyroscope[start:end, 0].mean() for end in range(stop, stop + 150)]
    reach = int(np.argmin(np.abs(np.array(means) - mean_rate_x)))
    assert means[reach] == pytest.approx(mean_rate_x, abs=3.0)
    intervals[number - 1] = (start, stop + reach)
    noise = float(np.var(recording.accelerometer[:3500], axis=0).sum())  # type: ignore[index]
    assessed = assess_rests(recording, intervals, noise)
    assert [rest.accepted for rest in assessed] == [k != number - 1 for k in range(10)]
    assert assessed[number - 1].reason


@pytest.mark.parametrize(("sensor", "counts"), [("gyroscope", 16.384), ("accelerometer", 256.0)])
def test_readings_coarser_than_their_noise_lose_no_rest(sensor: str, counts: float) -> None:
    drawn = draw(Hand(rests=20, rate_hz=10.0, white={"accelerometer": 6e-4, "gyroscope": 0.01}), 4)
    fine = find_rests(drawn.recording)
    assert len(fine) == 20
    reading = drawn.recording.reading(sensor)
    coarse = replace(drawn.recording, **{sensor: np.round(reading * counts) / counts})
    assert np.mean(np.diff(coarse.reading(sensor)[drawn.still], axis=0) == 0.0) > 0.6
    found = [rest for rest in find_rests(coarse) if rest.accepted]
    assert len(found) == 20
    inside = [np.mean(drawn.still[rest.start : rest.stop]) for rest in found]
    assert min(inside) > 0.95
