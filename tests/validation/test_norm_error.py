from __future__ import annotations

import numpy as np
import pytest

from pipeline.evaluation.held_out.samples import squared_norm_errors

MATRIX = np.array([[1.03, 0.02, -0.01], [-0.015, 0.97, 0.03], [0.01, -0.02, 1.05]])
VARIANCE = np.array([0.9, 1.2, 2.5]) ** 2


@pytest.mark.parametrize("size", [0.0, 0.3, 1.0, 3.0, 10.0, 29.0, 31.0, 300.0])
def test_expected_squared_norm_error_is_that_of_a_brute_force_simulation(size: float) -> None:
    rng = np.random.default_rng(0)
    truth = size * np.array([0.48, -0.6, 0.64])
    noise = rng.standard_normal((1_000_000, 3)) * np.sqrt(VARIANCE) @ MATRIX.T
    error = np.linalg.norm(truth + noise, axis=1) - size
    found = squared_norm_errors(truth[None], MATRIX, VARIANCE[None])[0]
    assert np.sqrt(found) == pytest.approx(np.sqrt(np.mean(error**2)), rel=0.004)


def test_at_zero_the_squared_error_is_the_trace() -> None:
    found = squared_norm_errors(np.zeros((1, 3)), MATRIX, VARIANCE[None])[0]
    assert found == pytest.approx(np.trace(MATRIX * VARIANCE @ MATRIX.T), rel=1e-9)


def test_near_and_far_formulas_meet() -> None:
    direction = np.array([0.48, -0.6, 0.64])
    size = 30.0 * np.sqrt(np.trace(MATRIX * VARIANCE @ MATRIX.T))
    near, far = squared_norm_errors(
        np.array([0.999 * size, 1.001 * size])[:, None] * direction, MATRIX, np.tile(VARIANCE, (2, 1))
    )
    assert near == pytest.approx(far, rel=2e-3)


def test_samples_of_different_variance_are_kept_apart() -> None:
    truth = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    variance = np.array([[1e-6] * 3, [4e-6] * 3, [9e-6] * 3])
    assert squared_norm_errors(truth, np.eye(3), variance) == pytest.approx([1e-6, 12e-6, 9e-6], rel=1e-6)


def test_no_noise_gives_no_error() -> None:
    assert squared_norm_errors(np.zeros((2, 3)), MATRIX, np.zeros((2, 3))).tolist() == [0.0, 0.0]
