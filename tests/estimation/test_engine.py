"""The covariance under a noise that is only known by weighted candidates, against distributions in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr, stdtrit

from pipeline.estimation.engine import Posterior, assess_noise
from pipeline.estimation.gauss_markov import Blocks, Prior


def test_one_candidate_keeps_its_covariance_and_its_degrees_of_freedom() -> None:
    covariance = np.array([[4.0, 1.0], [1.0, 9.0]])
    found, freedom = Posterior(np.ones(1), covariance[None], 30.0).averaged()
    np.testing.assert_allclose(found, covariance, rtol=1e-4)
    np.testing.assert_allclose(freedom, 30.0, rtol=1e-2)


@pytest.mark.parametrize("nu", [3.0, 6.0, 20.0])
def test_variances_by_inverse_chi_squared_make_the_student_distribution_that_they_are(nu: float) -> None:
    from scipy.special import gammaincinv  # noqa: PLC0415

    share = (np.arange(4000) + 0.5) / 4000
    variance = nu / (2.0 * gammaincinv(nu / 2.0, share))
    found, freedom = Posterior(np.full(4000, 1.0 / 4000), 7.0 * variance[:, None, None], np.inf).averaged()
    assert found[0, 0] == pytest.approx(7.0, rel=0.01)
    assert freedom[0] == pytest.approx(nu, rel=0.03)


@pytest.mark.parametrize("rare", [0.02, 0.1, 0.3])
def test_the_interval_holds_95_percent_where_a_large_wander_is_believed_a_little(rare: float) -> None:
    weight, sigma = np.array([1.0 - rare, rare]), np.array([1.0, 5.0])
    found, freedom = Posterior(weight, (sigma**2)[:, None, None], np.inf).averaged()
    inside = np.sqrt(found[0, 0]) * stdtrit(min(freedom[0], 1e9), 0.975)
    assert weight @ (2.0 * ndtr(inside / sigma) - 1.0) == pytest.approx(0.95, abs=1e-3)


def test_a_parameter_without_uncertainty_stays_without() -> None:
    found, freedom = Posterior(
        np.array([0.5, 0.5]), np.array([np.diag([0.0, 1.0]), np.diag([0.0, 2.0])]), 10.0
    ).averaged()
    assert found[0, 0] == 0.0
    assert np.isinf(freedom[0])
    assert freedom[1] < 10.0


def test_white_noise_is_not_underestimated_where_most_blocks_are_used_up_by_parameters() -> None:
    rng, blocks, each, sigma = np.random.default_rng(11), 12, 20, 0.3
    time = np.repeat(40.0 * np.arange(blocks), each) + np.tile(np.arange(each), blocks)
    of_blocks = Blocks.of_rows([(time, np.ones(len(time)))], [0], 40.0)
    assert len(of_blocks.weight) == blocks
    design = np.repeat(rng.standard_normal((blocks, 8)), each, axis=0)
    basis = np.linalg.qr(design)[0]
    seen = []
    for _ in range(60):
        y = sigma * rng.standard_normal((len(time), 3))
        noise = assess_noise(y - basis @ (basis.T @ y), design, of_blocks, Prior())
        seen.append(float(np.mean(noise.white**2)))
    # four contrasts a channel: the relative standard deviation of a mean of 180 is sqrt(2 / 4 / 180), 5 %
    assert np.mean(seen) == pytest.approx(sigma**2, rel=0.2)
