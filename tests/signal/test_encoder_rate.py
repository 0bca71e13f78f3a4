"""The rate by an encoder of coarse steps: right within the noise that it states, and only where the steps hide it."""

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid

from pipeline.core.records import Recording
from pipeline.physics.signal.encoder_rate import EncoderRate, rate_by_angle

INTERVAL = 0.01


def found(angle: np.ndarray, step: float, gap: slice | None = None) -> EncoderRate:
    time_ns = np.arange(len(angle)) * round(INTERVAL * 1e9)
    kept = np.delete(np.arange(len(angle)), np.arange(len(angle))[gap]) if gap else slice(None)
    rounded = np.rint(angle / step) * step
    rate = rate_by_angle(Recording("turn", "gyroscope", "x", time_ns[kept], table_angle=rounded[kept]))
    assert rate is not None
    return rate


def by_hand(time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A smooth motion to and fro: angle, deg, and rate, deg/s."""
    amplitudes, frequencies = np.array([60.0, 25.0, 8.0]), 2.0 * np.pi * np.array([0.21, 0.53, 1.3])
    phase = frequencies * time[:, None]
    return np.sin(phase) @ amplitudes, np.cos(phase) @ (amplitudes * frequencies)


def test_a_smooth_motion_behind_coarse_steps_is_known_to_the_noise_that_is_stated() -> None:
    time = np.arange(6000) * INTERVAL
    angle, true = by_hand(time)
    rate = found(angle, 0.01)
    inner = slice(20, -20)
    error = float(np.sqrt(np.mean((rate.rate - true)[inner] ** 2)))
    central = float(np.sqrt(np.mean((np.gradient(np.rint(angle / 0.01) * 0.01, time) - true)[inner] ** 2)))
    assert error < 0.4 * central
    assert 0.5 * rate.noise[3000] < error < 1.5 * rate.noise[3000]


def test_a_motor_that_ripples_is_known_to_the_noise_that_is_stated() -> None:
    rng = np.random.default_rng(4)
    true = 30.0 + np.cumsum(rng.normal(0.0, 0.05, 6000))  # a random acceleration, (0.5 deg/s)^2 in a second
    angle = cumulative_trapezoid(true, dx=INTERVAL, initial=0.0)
    rate = found(angle, 0.01)
    error = float(np.sqrt(np.mean((rate.rate - true)[20:-20] ** 2)))
    assert 0.7 * rate.noise[3000] < error < 1.3 * rate.noise[3000]


def test_ramps_do_not_hide_that_a_motor_ripples() -> None:
    rng = np.random.default_rng(5)
    ripple = np.zeros(1400)
    for i in range(1, len(ripple)):  # correlated over 0.1 s
        ripple[i] = 0.9 * ripple[i - 1] + np.sqrt(1.0 - 0.9**2) * rng.normal()
    steps = np.repeat(np.concatenate([np.zeros(100), np.linspace(0, 360, 180), np.full(840, 360.0)]), 10)
    speed = np.concatenate([steps, np.repeat(np.linspace(360, 0, 180), 10), np.zeros(1000)])
    fine = speed * (1.0 + 0.004 * np.interp(np.arange(len(speed)) / 10.0, np.arange(len(ripple)), ripple))
    angle = cumulative_trapezoid(fine, dx=INTERVAL / 10.0, initial=0.0)[::10]
    rate = found(angle, 0.01)
    error = float(np.sqrt(np.mean((rate.rate - fine[::10])[300:1100] ** 2)))
    assert 0.7 * rate.noise[700] < error < 1.3 * rate.noise[700]


def test_a_fine_angle_keeps_its_derivative() -> None:
    angle, true = by_hand(np.arange(3000) * INTERVAL)
    rate = found(angle, 1e-6)
    assert not rate.noise.any()
    assert np.abs(rate.rate - true)[~rate.vague][20:-20].max() < 0.01


def test_a_table_at_rest_has_no_rate_and_no_noise() -> None:
    time = np.arange(4000) * INTERVAL
    angle, _ = by_hand(time)
    angle[2000:] = angle[2000]
    rate = found(angle, 0.01)
    assert not rate.rate[2010:].any()
    assert not rate.noise[2010:].any()


def test_the_samples_beside_a_gap_are_vague() -> None:
    angle, true = by_hand(np.arange(4000) * INTERVAL)
    rate = found(angle, 0.01, slice(1500, 1560))
    assert rate.vague[1496:1504].all()
    assert not rate.vague[:1490].any()
    assert not rate.vague[1510:].any()
    assert np.abs(rate.rate - np.delete(true, np.arange(1500, 1560)))[~rate.vague][20:-20].max() < 0.2


@pytest.mark.parametrize("stamps", ["scatter", "rounded", "true"])
def test_time_stamps_off_the_samples_do_not_change_the_scale_of_the_rate(stamps: str) -> None:
    rng = np.random.default_rng(6)
    fine = np.arange(0.0, 60.0, 1e-3)
    true = np.interp(fine, [0, 10, 10.6, 22, 22.6, 30, 31.2, 43, 44.2, 60], [0, 0, 120, 120, 0, 0, -60, -60, 0, 0])
    angle = cumulative_trapezoid(true, fine, initial=0.0)
    sampled = np.arange(1.0, 59.0, 1.0 / 181.0)
    shown = {
        "scatter": sampled + 3e-4 * rng.normal(size=len(sampled)),
        "rounded": np.round(sampled, 3),
        "true": sampled,
    }
    time_ns = np.round(1e9 * shown[stamps]).astype(np.int64)
    rate = rate_by_angle(Recording("turn", "gyroscope", "x", time_ns, table_angle=np.interp(sampled, fine, angle)))
    assert rate is not None
    known = ~rate.vague
    reading = np.interp(sampled, fine, true)
    assert np.count_nonzero(known & (np.abs(reading) > 50.0)) > 0.9 * np.count_nonzero(np.abs(reading) > 50.0)
    assert np.polyfit(rate.rate[known], reading[known], 1)[0] == pytest.approx(1.0, abs=2e-4)
    assert rate.noise.any() == (stamps != "true")
