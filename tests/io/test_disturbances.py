"""Glitches of the bus and knocks at the bench are left out and said; what noise, motion and delays do is kept."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.core.records import Note, Recording
from pipeline.ingest.disturbances import disturbed, leave_out_disturbances

INTERVAL = 0.05
NOISE = {"accelerometer": 1e-3, "gyroscope": 0.02}


def note(code: str, rows: np.ndarray, detail: str) -> Note:
    return Note(code, int(rows.size), int(rows[0]), int(rows[-1]), detail)


def turn(seed: int, *, late: float = 0.0, role: str = "accelerometer") -> Recording:
    """Return a stop-and-go turn about x: 60 rests of 1 s, steps of 6 deg in 0.3 s; the sensor may be late."""
    time = np.arange(0.0, 78.0, INTERVAL)

    def angle_at(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        step, within = np.floor(t / 1.3), np.mod(t, 1.3) - 1.0
        return 6.0 * (step + np.clip(within / 0.3, 0.0, 1.0)), np.where((within > 0) & (within < 0.3), 20.0, 0.0)

    angle, rate = angle_at(time)
    seen, seen_rate = angle_at(np.maximum(time - late, 0.0))
    rng = np.random.default_rng(seed)
    force = (
        np.stack([0 * seen, np.sin(np.radians(seen)), np.cos(np.radians(seen))], 1) @ np.diag([1, 1.02, 0.97]) + 0.05
    )
    omega = np.stack([1.02 * seen_rate, 0.01 * seen_rate, 0 * seen], 1) - 1.0
    return Recording(
        "accel_x",
        role,
        "x",
        np.round(time * 1e9).astype(np.int64),
        force + NOISE["accelerometer"] * rng.standard_normal(force.shape),
        omega + NOISE["gyroscope"] * rng.standard_normal(omega.shape),
        table_angle=angle,
        table_rate=rate,
    )


def spoilt(recording: Recording, sensor: str, rows: list[int], axis: int, by: float) -> Recording:
    values = np.array(recording.reading(sensor))
    values[rows, axis] += by
    return replace(recording, **{sensor: values})


@pytest.mark.parametrize("sensor", ["accelerometer", "gyroscope"])
def test_each_glitch_is_left_out_and_nothing_else(sensor: str) -> None:
    rows = [101, 417, 420, 902, 1303]
    recording = spoilt(turn(1), sensor, rows, 1, {"accelerometer": 0.8, "gyroscope": -70.0}[sensor])
    kept = leave_out_disturbances(recording, note, 0.02)
    assert sorted(set(recording.time_ns) - set(kept.time_ns)) == sorted(recording.time_ns[rows])
    assert [(n.code, n.count) for n in kept.notes] == [("N-DISTURBED", 5)]
    assert f"{sensor} y" in kept.notes[0].detail
    assert kept.flags is not None
    assert np.count_nonzero(kept.flags & 1) == 5
    unchanged = np.setdiff1d(np.arange(recording.samples), rows)
    np.testing.assert_array_equal(kept.reading(sensor), np.array(recording.reading(sensor))[unchanged])


def test_a_knock_at_rest_goes_as_a_whole() -> None:
    rng = np.random.default_rng(2)
    recording = turn(2, role="static")
    still = replace(
        recording,
        accelerometer=np.array([0.1, 0.2, 0.98]) + 1e-3 * rng.standard_normal((recording.samples, 3)),
        gyroscope=0.02 * rng.standard_normal((recording.samples, 3)),
        table_angle=None,
        table_rate=None,
    )
    values = np.array(still.accelerometer)
    ringing = np.arange(20)
    values[700:720] += (0.4 * np.exp(-ringing / 6.0) * np.cos(2.0 * ringing))[:, None]
    kept = leave_out_disturbances(replace(still, accelerometer=values), note, 0.02)
    left = set(still.time_ns[700:718])
    assert not left & set(kept.time_ns)
    assert still.samples - kept.samples <= 26
    assert kept.accelerometer is not None
    assert np.abs(kept.accelerometer - [0.1, 0.2, 0.98]).max() < 0.02


@pytest.mark.parametrize("late", [0.0, 0.04, 0.1, 0.3])
def test_noise_and_late_sensors_disturb_nothing(late: float) -> None:
    for seed in range(20):
        excess, _ = disturbed(turn(seed, late=late))
        assert not np.any(excess)


def test_a_bench_that_is_always_restless_keeps_its_samples_and_is_noted() -> None:
    recording = turn(3)
    rows = list(range(30, recording.samples, 25))
    kept = leave_out_disturbances(spoilt(recording, "accelerometer", rows, 2, 0.9), note, 0.02)
    assert kept.samples == recording.samples
    assert [n.code for n in kept.notes] == ["N-RESTLESS"]


def test_a_share_of_zero_keeps_everything_unsaid() -> None:
    recording = spoilt(turn(4), "accelerometer", [500], 0, 1.0)
    assert leave_out_disturbances(recording, note, 0.0) is recording


def test_turns_by_hand_are_never_taken_for_glitches() -> None:
    by_hand = replace(turn(5, role="rests"), table_angle=None, table_rate=None, axis=None)
    excess, _ = disturbed(by_hand)
    assert not np.any(excess)
    resting = np.flatnonzero(np.mod(by_hand.time, 1.3) < 0.9)[5]
    found, where = disturbed(spoilt(by_hand, "gyroscope", [int(resting)], 0, 15.0))
    assert not np.any(found[:, [i for i, (s, _) in enumerate(where) if s == "gyroscope"]])
