"""A rest in which the unit goes on turning: gravity is that next to the move; and clocks that a file rounds."""

from __future__ import annotations

import numpy as np
import pytest
from unit_settings import settings_of

from pipeline.core.records import Recording, SensorCalibration
from pipeline.estimation.multi_position.moves import clocks_of, gravity_of
from pipeline.estimation.rest_means import rests_of

NOISE = 5e-4
TICK = 0.00996  # s; rounded to ms, one step in 25 is 9 ms and the others 10 ms


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
    felt = rests_of("accelerometer", [recording], settings_of().procedure)
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
    felt = rests_of("accelerometer", [recording], settings_of().procedure)
    assert felt is not None
    found = gravity_of([recording], felt, SensorCalibration("accelerometer", converged=True))
    assert not found.creeping.any()
    assert np.array_equal(found.at_start, found.at_end)


def turning(time: np.ndarray) -> np.ndarray:
    """Return the readings of a turn at 100 deg/s that swells and fades with the true time, and white noise."""
    noise = NOISE * np.random.default_rng(2).standard_normal((len(time), 3))
    return np.outer(100.0 * np.sin(np.pi * time / time[-1]) ** 2, [1.0, 0.5, 0.0]) + noise


@pytest.mark.parametrize("kind", ["rounded", "late", "irregular", "dropped"])
def test_the_readings_tell_whether_stamps_or_a_regular_clock_are_right(kind: str) -> None:
    rng, regular = np.random.default_rng(1), TICK * np.arange(400)
    true = regular + 2e-3 * rng.random(400) if kind == "irregular" else regular
    true = np.delete(true, 200) if kind == "dropped" else true
    late = 3e-3 * rng.random(len(true)) * (np.arange(len(true)) % 3 != 2)
    stamps = {"rounded": np.round(true, 3), "late": true + late}.get(kind, true)
    (found,) = clocks_of(stamps, turning(true), [slice(0, len(true))], np.full(3, NOISE))
    if kind in {"irregular", "dropped"}:
        assert np.array_equal(found, stamps)
    else:
        assert np.abs(np.diff(found) - TICK).max() < 1e-5


def test_where_the_readings_do_not_tell_only_stamps_that_a_file_rounds_are_regular() -> None:
    rng, regular = np.random.default_rng(1), TICK * np.arange(400)
    resting = NOISE * rng.standard_normal((400, 3))
    late = regular + 3e-3 * rng.random(400) * (np.arange(400) % 3 != 2)
    for stamps, expected in ((np.round(regular, 3), regular), (late, late)):
        (found,) = clocks_of(stamps, resting, [slice(0, 400)], np.full(3, NOISE))
        assert np.abs(np.diff(found) - np.diff(expected)).max() < 1e-5


def test_a_rest_lasts_from_its_first_sample_to_the_interval_after_its_last() -> None:
    felt = rests_of("accelerometer", [set_down(0.0)], settings_of().procedure)
    assert felt is not None
    assert felt.length == pytest.approx(0.01 * np.diff(felt.span)[:, 0])
