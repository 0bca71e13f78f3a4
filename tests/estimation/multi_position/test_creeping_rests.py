"""A rest in which the unit goes on turning: gravity is that next to the move; and clocks that a file rounds."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.estimation.multi_position.gravity import gravity_of
from pipeline.estimation.multi_position.moves import regular_time
from pipeline.estimation.multi_position.rests import rests_of
from pipeline.records import Recording, SensorCalibration

NOISE = 5e-4


def set_down(creep_deg: float, seed: int = 3) -> Recording:
    """Rest 5 s level, be moved by 90 deg in 2 s with some shaking, then rest 6 s while settling by some angle."""
    rng, step = np.random.default_rng(seed), 0.01
    settling = creep_deg * (1.0 - np.exp(-np.arange(600) * step / 1.5))
    angle = np.radians(np.concatenate([np.zeros(500), np.linspace(0.0, 90.0, 200), 90.0 + settling]))
    force = np.column_stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)])
    force[500:700] += 0.05 * np.sin(np.arange(200))[:, None]
    time = np.arange(len(angle)) * 10_000_000
    noisy = force + NOISE * rng.standard_normal(force.shape)
    return Recording("recording", "rests", None, time, accelerometer=noisy, gyroscope=np.zeros_like(noisy))


def test_gravity_after_a_move_is_that_next_to_it_where_the_unit_settles() -> None:
    recording = set_down(0.8)
    felt = rests_of("accelerometer", [recording], {"procedure": {"holdout_every": 0}})
    assert felt is not None
    found = gravity_of([recording], felt, SensorCalibration("accelerometer", converged=True))
    begin = felt.span[1, 0] * 0.01 - 7.0  # s after the move
    near = 90.0 + 0.8 * (1.0 - np.exp(-(begin + 0.25) / 1.5))
    angle = np.degrees(np.arctan2(found.at_start[1, 0], found.at_start[1, 2]))
    assert angle == pytest.approx(near, abs=0.03)
    mean = np.degrees(np.arctan2(found.force[1, 0], found.force[1, 2]))
    assert abs(mean - near) > 0.2
    assert found.creeping.tolist() == [False, True]


def test_the_mean_is_kept_where_the_unit_rests() -> None:
    recording = set_down(0.0)
    felt = rests_of("accelerometer", [recording], {"procedure": {"holdout_every": 0}})
    assert felt is not None
    found = gravity_of([recording], felt, SensorCalibration("accelerometer", converged=True))
    assert not found.creeping.any()
    assert np.array_equal(found.at_start, found.at_end)


def test_a_regular_clock_that_the_file_rounds_is_regular_again() -> None:
    true = 0.009999 * np.arange(40_000)
    rounded = np.round(true, 3)
    assert np.diff(rounded).min() < 0.0095
    assert np.abs(regular_time(rounded) - true).max() < 2e-4
    assert np.abs(np.diff(regular_time(rounded)) - 0.009999).max() < 1e-8


@pytest.mark.parametrize("kind", ["jitter", "gap"])
def test_irregular_stamps_stay_as_they_are(kind: str) -> None:
    time = 0.01 * np.arange(2000)
    if kind == "jitter":
        time += 2e-4 * np.random.default_rng(1).standard_normal(2000)
    else:
        time[1000:] += 0.05
    assert regular_time(time) is time
