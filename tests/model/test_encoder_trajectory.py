"""The trajectory between the samples of a log is that of the table's program."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.ingest.clock_alignment import Program
from pipeline.physics.signal.encoder_rate import EncoderTrajectory, nearest_slope
from pipeline.simulation.trajectory import rest, turn_with_plateau


@pytest.fixture(scope="module")
def program() -> Program:
    steps = [rest(3.0)]
    for rate in (30.0, 60.0, -100.0):
        steps += [turn_with_plateau(360.0 * np.sign(rate), abs(rate), 100.0), rest(2.0)]
    return Program(steps)


def log_of(program: Program, interval: float = 0.12) -> EncoderTrajectory:
    time = np.arange(0.0, program.duration, interval)
    angle, rate, _, _ = program.at(time)
    return EncoderTrajectory(time, angle, rate)


def test_ramps_of_a_few_samples_are_followed_exactly_between_them(program: Program) -> None:
    log = log_of(program)
    between = log.time[:-1] + np.random.default_rng(0).uniform(0.0, 0.12, len(log.time) - 1)
    angle, rate, acceleration = log.at(between[log.explained])
    truth = program.at(between[log.explained])
    assert np.mean(log.explained) > 0.99
    np.testing.assert_allclose(angle, truth[0], atol=1e-6)
    np.testing.assert_allclose(rate, truth[1], atol=1e-5)
    assert np.mean(np.abs(acceleration - truth[2]) > 1e-3) < 0.01


@pytest.mark.parametrize("shift", [-0.7, -0.2, 0.05, 0.48])
def test_times_that_are_known_are_followed_however_far_from_the_samples(program: Program, shift: float) -> None:
    time = np.arange(0.0, program.duration, 0.12)
    angle, rate, _, _ = program.at(time)
    knocked = np.abs(time - 12.0) < 0.2  # the log is wrong there
    log = EncoderTrajectory(time, angle + 0.3 * knocked, rate)
    known = log.known_at(time + shift)
    inside = (time + shift > 0.0) & (time + shift < time[-1])
    miss = np.abs(log.at(time + shift)[0] - program.at(time + shift)[0])
    assert miss[known & inside].max() < 1e-5
    assert not known[miss > 0.1].any()
    assert known.mean() > 0.9


def test_a_step_between_two_samples_is_not_claimed_to_be_followed() -> None:
    time = np.arange(0.0, 6.0, 0.12)
    angle = np.where(time < 3.0, 0.0, 1.0)
    log = EncoderTrajectory(time, angle, np.zeros_like(time))
    assert np.flatnonzero(~log.valid).tolist() == [int(np.searchsorted(time, 3.0)) - 1]


@pytest.mark.parametrize(("interval", "step"), [(0.01, 0.1), (0.04, 360.0 / 4096.0), (0.04, 0.1)])
def test_ramps_of_a_rounded_log_are_followed_to_its_rounding(interval: float, step: float) -> None:
    """At constant rates the angles hit the steps alike, so that only the ramps show the rounding."""
    steps = [rest(2.0)]
    for rate in (20.0, 50.0, 100.0, 200.0):
        steps += [turn_with_plateau(360.0, rate, 400.0), rest(2.0)]
    program = Program(steps)
    time = np.arange(0.0, program.duration, interval)
    angle, rate, acceleration, _ = program.at(time)
    log = EncoderTrajectory(time, np.round(angle / step) * step, np.round(rate, 1))
    assert log.valid_samples[np.abs(acceleration) > 1.0].mean() > 0.7  # without the corners
    steady = np.append(np.isclose(np.diff(rate), interval * acceleration[:-1]), False)
    later = steady & log.valid_samples
    np.testing.assert_allclose(log.at(time[later] + 0.002)[1], program.at(time[later] + 0.002)[1], atol=0.05)


def test_smooth_motion_is_interpolated_to_a_hundred_thousandth_of_its_amplitude() -> None:
    time = np.arange(0.0, 20.0, 0.12)
    w = 2 * np.pi * 0.3
    log = EncoderTrajectory(time, 40 * np.sin(w * time), 40 * w * np.cos(w * time))
    at = time[3:-4] + 0.05
    angle, rate, _ = log.at(at)
    np.testing.assert_allclose(angle, 40 * np.sin(w * at), atol=40 * 1e-5)
    np.testing.assert_allclose(rate, 40 * w * np.cos(w * at), atol=40 * w * 1e-4)
    assert log.valid.all()


def test_slope_of_a_quartic_is_exact_at_uneven_times() -> None:
    time = np.cumsum(np.random.default_rng(1).uniform(0.1, 0.3, 30))
    values = np.polynomial.polynomial.polyval(time, [1.0, -2.0, 0.5, 0.3, -0.05])
    expected = np.polynomial.polynomial.polyval(time, [-2.0, 1.0, 0.9, -0.2])
    np.testing.assert_allclose(nearest_slope(time, values), expected, rtol=1e-9, atol=1e-8)


def test_lagged_rate_is_the_convolution_with_an_exponential(program: Program) -> None:
    log, lag = log_of(program), 0.02
    fine = np.arange(0.0, 25 * lag, lag / 400)
    for t in np.arange(4.0, program.duration, 0.7317):
        kernel = np.exp(-fine / lag) / lag
        expected = np.trapezoid(kernel * program.at(np.maximum(t - fine, 0.0))[1], fine)
        value, slope = log.lagged(np.array([t]), lag)
        assert value[0] == pytest.approx(expected, abs=1e-3)
        later = log.lagged(np.array([t + 1e-6]), lag)[0] - log.lagged(np.array([t - 1e-6]), lag)[0]
        assert slope[0] == pytest.approx(later[0] / 2e-6, abs=1e-2)
