"""A unit that tilts steadily in a rest: the tilt is told, used and told apart from a bias wander."""

from __future__ import annotations

import numpy as np
import pytest
from hand_simulator import Hand, draw

from pipeline.estimation.accelerometer import nonlinear_least_squares
from pipeline.estimation.gyroscope import rests_and_moves
from pipeline.estimation.noise import estimate_noise
from pipeline.signal.quiet_motion import believed_rates, creep_of
from pipeline.validation.heldout import validate

QUIET = {"accelerometer": 3e-4, "gyroscope": 0.01}  # white noise of a sample, g and deg/s


def test_the_rate_of_a_steady_tilt_is_told_across_gravity_alone() -> None:
    rng = np.random.default_rng(4)
    rate, time = np.radians([0.2, -0.1, 0.25]), np.arange(500) * 0.01
    up = np.array([0.3, 0.5, np.sqrt(0.66)])
    angle = np.outer(time, rate)
    force = up - np.cross(angle, up) + 0.5 * np.cross(angle, np.cross(angle, up))  # du/dt = -omega x u
    found = creep_of(time, force + 5e-4 * rng.standard_normal(force.shape))
    across = np.degrees(rate - (rate @ up) * up)
    assert found.uncertainty == pytest.approx(np.degrees(5e-4 * np.sqrt(12 / 500) / 4.99), rel=0.05)
    assert np.abs(found.rate - across).max() < 4.0 * found.uncertainty
    turned = np.linalg.norm(np.cross(rate, up)) * 4.99
    assert found.shortening == pytest.approx(turned**2 / 24, rel=0.05)
    assert np.sqrt(found.squares.sum() / (3 * found.freedom)) == pytest.approx(5e-4, rel=0.05)


def test_a_unit_that_stands_still_creeps_in_one_rest_of_a_thousand() -> None:
    rng, time = np.random.default_rng(5), np.arange(300) * 0.01
    found = [creep_of(time, np.array([0.6, 0.0, 0.8]) + 2e-3 * rng.standard_normal((300, 3))) for _ in range(1000)]
    assert sum(bool(c.rate.any()) for c in found) <= 3
    rate, error, about = believed_rates(found)
    assert not (rate.any())
    assert not (error.any())
    assert not about


def test_a_creeping_unit_has_the_floor_and_the_errors_of_one_that_stands_still() -> None:
    figures: dict[float, list[float]] = {}
    for creep in (0.0, 0.15):
        drawn = draw(Hand(creep_dps=creep, white=QUIET), 6)
        found = nonlinear_least_squares.fit([drawn.recording], None, drawn.settings)
        noise = estimate_noise("accelerometer", [drawn.recording], drawn.settings["sensor"]["accelerometer"])
        part = validate(found, [drawn.recording], noise, drawn.settings)
        low, high = part["expected_rms_error"]
        assert low < part["steps"][-1]["rms_error"] < high
        figures[creep] = [part["noise_floor"], part["steps"][-1]["rms_error"], float(noise.white.mean())]
        rests = found.stages[-1].details["rests_used"]
        assert sum(rest["creep_dps"] > 0.0 for rest in rests) == (len(rests) if creep else 0)
    assert figures[0.15][0] < 1.5 * figures[0.0][0]
    assert figures[0.15][1] < 1.5 * figures[0.0][1]
    assert figures[0.15][2] == pytest.approx(figures[0.0][2], rel=0.03)


def test_the_rate_of_a_creeping_unit_is_no_error_of_its_gyroscope() -> None:
    drawn = draw(Hand(creep_dps=0.1), 7)
    found = rests_and_moves.fit([drawn.recording], None, drawn.settings)
    assert found.covariance is not None
    error = np.concatenate([found.bias - drawn.bias["gyroscope"], (found.matrix - drawn.matrix["gyroscope"]).ravel()])
    assert np.mean(error**2 / np.diag(found.covariance)) < 2.2  # 12 parameters: 1.2 chance in 1000 beyond
    noise = estimate_noise("gyroscope", [drawn.recording], drawn.settings["sensor"]["gyroscope"])
    part = validate(found, [drawn.recording], noise, drawn.settings)
    low, high = part["expected_rms_error"]
    assert low < part["steps"][-1]["rms_error"] < high
    assert part["steps"][-1]["rms_error"] < 2.0 * part["noise_floor"]
