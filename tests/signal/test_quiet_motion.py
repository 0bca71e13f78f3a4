"""Rests in which the unit tilts steadily (creep), or turns about the vertical while the accelerometer is quiet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hand_simulator import Drawn, Hand, draw
from unit_settings import with_noise

from pipeline.core.records import Recording
from pipeline.estimation.accelerometer import nonlinear_least_squares
from pipeline.estimation.gyroscope import rests_and_moves
from pipeline.estimation.noise import estimate_noise
from pipeline.estimation.stages import StageInput
from pipeline.physics.signal.quiet_motion import (
    DIFFERENCE_BLOCK,
    before_slow_motion,
    creep_of_readings,
    posterior_creep_rates,
    step_and_noise,
)
from pipeline.physics.signal.rests import Rest, find_rests
from tests.published import validate

QUIET = {"accelerometer": 3e-4, "gyroscope": 0.01}  # white noise of a sample, g and deg/s


def test_step_and_noise_leave_out_missing_rows_and_are_kept_with_another_source() -> None:
    reading = np.round(np.random.default_rng(5).normal(0.0, 0.04, (400, 3)), 2)
    missing = np.insert(reading, 100, np.nan, axis=0)
    recording = Recording("r", "rests", None, np.arange(401) * 10**7, accelerometer=missing)
    step, noise = step_and_noise(recording, "accelerometer")
    assert step == pytest.approx(np.full(3, 0.01))
    count = 399 // DIFFERENCE_BLOCK
    blocks = np.split(np.diff(reading, axis=0)[: count * DIFFERENCE_BLOCK], count)
    quartile = np.quantile([np.mean(block**2, axis=0) for block in blocks], 0.25, axis=0)
    assert noise == pytest.approx(np.sqrt(quartile / 2.0))
    renamed = recording.with_source({"file": "a.csv"})
    assert (renamed.source, recording.source) == ({"file": "a.csv"}, {})
    assert step_and_noise(renamed, "accelerometer")[1] is noise


def test_the_rate_of_a_steady_tilt_is_told_across_gravity_alone() -> None:
    rng = np.random.default_rng(4)
    rate, time = np.radians([0.2, -0.1, 0.25]), np.arange(500) * 0.01
    up = np.array([0.3, 0.5, np.sqrt(0.66)])
    angle = np.outer(time, rate)
    force = up - np.cross(angle, up) + 0.5 * np.cross(angle, np.cross(angle, up))  # du/dt = -omega x u
    found = creep_of_readings(time, force + 5e-4 * rng.standard_normal(force.shape))
    across = np.degrees(rate - (rate @ up) * up)
    assert found.uncertainty == pytest.approx(np.degrees(5e-4 * np.sqrt(12 / 500) / 4.99), rel=0.05)
    assert np.abs(found.rate - across).max() < 4.0 * found.uncertainty
    turned = np.linalg.norm(np.cross(rate, up)) * 4.99
    assert found.shortening == pytest.approx(turned**2 / 24, rel=0.05)
    assert np.sqrt(found.squares.sum() / (3 * found.freedom)) == pytest.approx(5e-4, rel=0.05)


def test_a_unit_that_stands_still_creeps_in_one_rest_of_a_thousand() -> None:
    rng, time = np.random.default_rng(5), np.arange(300) * 0.01
    found = [
        creep_of_readings(time, np.array([0.6, 0.0, 0.8]) + 2e-3 * rng.standard_normal((300, 3))) for _ in range(1000)
    ]
    assert sum(bool(c.rate.any()) for c in found) <= 3
    rate, error, about = posterior_creep_rates(found)
    assert not (rate.any())
    assert not (error.any())
    assert not about


def test_a_creeping_unit_has_the_floor_and_the_errors_of_one_that_stands_still() -> None:
    figures: dict[float, list[float]] = {}
    for creep in (0.0, 0.15):
        drawn = draw(Hand(creep_dps=creep, white=QUIET), 6)
        found = nonlinear_least_squares.fit(
            StageInput("accelerometer", with_noise([drawn.recording], drawn.settings), None, drawn.settings)
        )
        noise = estimate_noise("accelerometer", [drawn.recording], drawn.settings.sensor.accelerometer)
        part = validate(found, [drawn.recording], noise, drawn.settings)
        low, high = part["expected_rms_error"]
        assert low < part["steps"][-1]["rms_error"] < high
        figures[creep] = [part["noise_floor"], part["steps"][-1]["rms_error"], float(noise.white.mean())]
        rests = found.stages[-1].details.rests_used
        assert sum(rest.creep_dps > 0.0 for rest in rests) == (len(rests) if creep else 0)
    assert figures[0.15][0] < 1.5 * figures[0.0][0]
    assert figures[0.15][1] < 1.5 * figures[0.0][1]
    assert figures[0.15][2] == pytest.approx(figures[0.0][2], rel=0.03)


def test_the_rate_of_a_creeping_unit_is_no_error_of_its_gyroscope() -> None:
    drawn = draw(Hand(creep_dps=0.1), 7)
    found = rests_and_moves.fit(
        StageInput("gyroscope", with_noise([drawn.recording], drawn.settings), None, drawn.settings)
    )
    assert found.covariance is not None
    error = np.concatenate([found.bias - drawn.bias["gyroscope"], (found.matrix - drawn.matrix["gyroscope"]).ravel()])
    assert np.mean(error**2 / np.diag(found.covariance)) < 2.2  # 12 parameters: 1.2 chance in 1000 beyond
    noise = estimate_noise("gyroscope", [drawn.recording], drawn.settings.sensor.gyroscope)
    part = validate(found, [drawn.recording], noise, drawn.settings)
    low, high = part["expected_rms_error"]
    assert low < part["steps"][-1]["rms_error"] < high
    assert part["steps"][-1]["rms_error"] < 2.0 * part["noise_floor"]


def moving_rate(drawn: Drawn, rests: list[Rest]) -> float:
    """Return the largest true-rate error of a rest's mean, deg/s: what its moving samples add to it."""
    gyroscope = drawn.recording.gyroscope
    assert gyroscope is not None
    means = []
    for rest in rests:
        inside = np.arange(rest.start, rest.stop)
        resting = inside[drawn.still[inside]]
        means.append(gyroscope[inside].mean(axis=0) - gyroscope[resting].mean(axis=0))
    return float(np.abs(means).max())


@pytest.mark.parametrize(
    "hand",
    [Hand(vertical=0.4), Hand(tail_dps=(0.7, 3.0)), Hand(vertical=0.3, tail_dps=(0.7, 3.0), creep_dps=0.1, jitter=0.3)],
    ids=["vertical", "tails", "all"],
)
def test_no_rest_holds_a_vertical_turn_or_the_end_of_a_move(hand: Hand) -> None:
    for seed in range(3):
        drawn = draw(hand, seed)
        rests = [rest for rest in find_rests(drawn.recording) if rest.accepted]
        assert len(rests) == hand.rests
        noise = 0.035 / np.sqrt(400)
        assert moving_rate(drawn, rests) < 3.0 * noise
        without = replace(drawn.recording, gyroscope=None)  # by the accelerometer alone they do
        assert moving_rate(drawn, [r for r in find_rests(without) if r.accepted]) > 10.0 * noise


def test_stamps_in_bursts_do_not_shorten_the_windows() -> None:
    drawn = draw(Hand(rests=12), 2)
    time = drawn.recording.time_ns
    number = np.minimum(np.arange(len(time)) // 5 * 5 + 4, len(time) - 1)
    late = time[number] + (np.arange(len(time)) % 5) * 200_000  # five samples arrive together, 0.2 ms apart
    found, burst = (find_rests(replace(drawn.recording, time_ns=t)) for t in (time, late))
    assert [(r.start, r.stop) for r in burst] == [(r.start, r.stop) for r in found]


def test_a_lone_turn_about_the_vertical_has_a_rest_at_either_end() -> None:
    """Nothing but the turn is recorded: the accelerometer feels no change, and most of the samples turn."""
    rng = np.random.default_rng(5)
    still, turning = 250, 600
    rate = np.zeros((2 * still + turning, 3))
    rate[still:-still, 2] = 60.0
    rate += [1.5, -3.0, 0.4] + 0.03 * rng.standard_normal(rate.shape)
    force = [0.01, 0.0, 1.0] + 0.002 * rng.standard_normal(rate.shape)
    time = np.round(1e9 * np.arange(len(rate)) / 100.0).astype(np.int64)
    found = find_rests(Recording("z_rot", "rests", "z", time, accelerometer=force, gyroscope=rate))
    assert [r.accepted for r in found] == [True, True]
    assert found[0].stop == pytest.approx(still, abs=25)
    assert found[1].start == pytest.approx(still + turning, abs=25)


def test_the_slow_begin_of_a_turn_is_no_rest() -> None:
    """A turn of 35 s begins with 0.1 to 1.5 deg/s from 0.5 to 2.1 s; a rest there moved a bias by 0.35 deg/s."""
    rng, time = np.random.default_rng(0), np.arange(3500) / 100.0
    noise = 0.035 * rng.normal(size=(len(time), 3))
    turn = np.outer(720.0 / 35.0 * (1.0 - np.cos(2.0 * np.pi * time / 35.0)), [0.0, 0.0, 1.0])
    assert before_slow_motion(noise + turn, [(50, 210)], 0.01, 100) == []
    assert before_slow_motion(noise, [(50, 210)], 0.01, 100) == [(50, 210)]
