"""Rates that bend between two samples, against angles in closed form, and uncertainties against simulated truth."""

from __future__ import annotations

import numpy as np
import pytest
from hand_session import hand_held
from unit_settings import settings_of

from pipeline.core.records import Recording
from pipeline.estimation.multi_position.moves import moves_of
from pipeline.estimation.rest_means import rests_of

INTERVAL_S, RATE_DPS, RAMP_S, MOVE_S, PERIOD_S = 0.12, 60.0, 0.3, 2.0, 8.0
NOISE_DPS = 1e-4


def _recording(seed: int, rate: np.ndarray, angle: np.ndarray) -> Recording:
    """Return turns about x, which is level."""
    rng = np.random.default_rng(seed)
    turned = np.radians(angle)
    force = np.stack([np.zeros(len(rate)), np.sin(turned), np.cos(turned)], axis=1)
    gyroscope = np.zeros((len(rate), 3))
    gyroscope[:, 0] = rate
    noise = rng.standard_normal((2, *force.shape))
    time_ns = (np.arange(len(rate)) * INTERVAL_S * 1e9).astype(np.int64)
    return Recording("recording", "rests", None, time_ns, force + 1e-5 * noise[0], gyroscope + NOISE_DPS * noise[1])


def _angles(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Return the angle of each move, as it is used and by the raw readings."""
    rests = rests_of("gyroscope", [recording], settings_of().procedure)
    assert rests is not None
    moves = moves_of([recording], rests)
    assert moves is not None
    assert recording.gyroscope is not None
    x = recording.gyroscope[:, 0]
    spans = zip(rests.span[moves.before, 1] - 1, rests.span[moves.after, 0] + 1, strict=True)
    raw = np.array([np.trapezoid(x[a:b], dx=INTERVAL_S) for a, b in spans])
    return np.sum(moves.weight * moves.reading[:, :, 0], axis=1), raw


def test_the_angle_of_a_move_is_that_of_its_ramps_wherever_they_begin_between_samples() -> None:
    starts = 5.0 + PERIOD_S * np.arange(12) + np.random.default_rng(3).uniform(0.0, INTERVAL_S, 12)
    time = np.arange(round((starts[-1] + PERIOD_S) / INTERVAL_S)) * INTERVAL_S
    ramps = np.minimum(time - starts[:, None], starts[:, None] + MOVE_S - time) / RAMP_S
    rate = RATE_DPS * np.clip(ramps, 0.0, 1.0).sum(axis=0)
    found, raw = _angles(_recording(1, rate, np.cumsum(rate) * INTERVAL_S))
    true = RATE_DPS * (MOVE_S - RAMP_S)
    assert len(found) == len(starts)
    assert np.sqrt(np.mean((raw - true) ** 2)) > 0.1
    assert found == pytest.approx(true, abs=1e-3)


def test_a_smooth_rate_is_integrated_as_before() -> None:
    starts = 5.0 + PERIOD_S * np.arange(9)
    time = np.arange(round((starts[-1] + PERIOD_S) / INTERVAL_S)) * INTERVAL_S
    rate = (RATE_DPS * np.sin(np.pi * np.clip((time - starts[:, None]) / MOVE_S, 0.0, 1.0)) ** 4).sum(axis=0)
    found, raw = _angles(_recording(2, rate, np.cumsum(rate) * INTERVAL_S))
    assert raw == pytest.approx(RATE_DPS * MOVE_S * 3.0 / 8.0, abs=2e-3)
    assert np.abs(found - raw).max() < 0.02


def test_sparse_samples_cost_the_matrix_nothing_beside_noise() -> None:
    unit = hand_held("stim300", 3)
    found = unit.calibrated("gyroscope")
    details = found.stages[-1].details
    assert details.direction_error_rms_deg < 0.02
    assert details.scatter_of_rests == 0.0
    assert np.abs(found.matrix - unit.true_matrix("gyroscope")).max() < 3e-4


def test_uncertainties_by_hand_are_those_of_the_errors_over_simulated_units() -> None:
    z = []
    for seed in range(20, 30):
        unit = hand_held("mpu6050", seed, holdout_every=0)
        found = unit.calibrated("gyroscope")
        assert found.covariance is not None
        off = [found.bias - unit.truth["gyroscope"]["bias"], (found.matrix - unit.true_matrix("gyroscope")).ravel()]
        z.append(np.concatenate(off) / np.sqrt(np.diag(found.covariance)))
    square = np.mean(np.square(z), axis=1)  # of each unit; 1 on average
    assert abs(square.mean() - 1.0) < 3.0 * square.std() / np.sqrt(len(square)) + 0.05
    assert square.std() / np.sqrt(len(square)) < 0.3
