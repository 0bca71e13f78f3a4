"""The covariance under a noise that is only known by weighted candidates, against distributions in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import null_space
from scipy.special import ndtr, stdtrit
from scipy.stats import multivariate_normal

from pipeline.estimation.engine import ErrorMixture, assess_noise, noise_outside_known_errors
from pipeline.estimation.gauss_markov import Blocks, Setting, WanderPrior


def test_one_candidate_keeps_its_covariance_and_its_degrees_of_freedom() -> None:
    covariance = np.array([[4.0, 1.0], [1.0, 9.0]])
    found, freedom = ErrorMixture(np.ones(1), covariance[None], 30.0).averaged()
    np.testing.assert_allclose(found, covariance, rtol=1e-4)
    np.testing.assert_allclose(freedom, 30.0, rtol=1e-2)


@pytest.mark.parametrize("nu", [3.0, 6.0, 20.0])
def test_variances_by_inverse_chi_squared_make_the_student_distribution_that_they_are(nu: float) -> None:
    from scipy.special import gammaincinv  # noqa: PLC0415

    share = (np.arange(4000) + 0.5) / 4000
    variance = nu / (2.0 * gammaincinv(nu / 2.0, share))
    found, freedom = ErrorMixture(np.full(4000, 1.0 / 4000), 7.0 * variance[:, None, None], np.inf).averaged()
    assert found[0, 0] == pytest.approx(7.0, rel=0.01)
    assert freedom[0] == pytest.approx(nu, rel=0.03)


@pytest.mark.parametrize("rare", [0.02, 0.1, 0.3])
def test_the_interval_holds_95_percent_where_a_large_wander_is_believed_a_little(rare: float) -> None:
    weight, sigma = np.array([1.0 - rare, rare]), np.array([1.0, 5.0])
    found, freedom = ErrorMixture(weight, (sigma**2)[:, None, None], np.inf).averaged()
    inside = np.sqrt(found[0, 0]) * stdtrit(min(freedom[0], 1e9), 0.975)
    assert weight @ (2.0 * ndtr(inside / sigma) - 1.0) == pytest.approx(0.95, abs=1e-3)


def test_a_parameter_without_uncertainty_stays_without() -> None:
    found, freedom = ErrorMixture(
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
        noise = assess_noise(y - basis @ (basis.T @ y), design, of_blocks, WanderPrior())
        seen.append(float(np.mean(noise.white**2)))
    # four contrasts a channel: the relative standard deviation of a mean of 180 is sqrt(2 / 4 / 180), 5 %
    assert np.mean(seen) == pytest.approx(sigma**2, rel=0.2)


@pytest.mark.parametrize(("size", "hidden"), [(1e4, 5), (30.0, 5), (0.3, 4), (0.03, 0)])
def test_hypotheses_have_the_weight_of_the_density_in_directions_without_known_errors(size: float, hidden: int) -> None:
    """Against the normal density of the readings in an explicit basis of those directions."""
    rng, m = np.random.default_rng(5), 9
    count, start = rng.integers(3, 9, m).astype(float), 20.0 * np.arange(m)
    blocks = Blocks(np.zeros(m, np.intp), count, start, np.full(m, 15.0), np.repeat([0, 1], [5, 4]))
    settings = [Setting(r, tau, p) for tau in (5.0, 60.0) for r, p in ((0.0, -1.0), (0.3, 0.0), (2.0, 0.5))]
    white, root = np.array([1.0, 2.0, 0.5]), np.sqrt(count)
    scale = np.outer(white, root).ravel()
    columns = rng.standard_normal((3, m, 4))
    columns[:, :, 3] = columns[:, :, 0]  # a column that others explain
    errors = size * scale[:, None] * rng.standard_normal((3 * m, 5))
    means = rng.standard_normal((m, 3)) * white + (errors @ rng.standard_normal(5) / scale**2).reshape(3, m).T * white
    noise = noise_outside_known_errors(columns, means, blocks, settings, white, errors)

    basis = null_space(columns.reshape(3 * m, 4)[:, :3].T)
    inside = np.linalg.svd(basis.T @ (errors / scale[:, None]))
    assert np.count_nonzero(inside[1] > 1.0) == hidden
    basis = basis @ inside[0][:, hidden:]
    z = basis.T @ (means.T / white[:, None] * root).ravel()
    score = []
    for setting in settings:
        one = np.eye(m) + setting.ratio**2 * np.outer(root, root) * blocks.covariance(setting.time)
        covariance = basis.T @ np.kron(np.eye(3), one) @ basis
        variance = float(z @ np.linalg.solve(covariance, z)) / len(z)
        score.append((multivariate_normal(cov=variance * covariance).logpdf(z) + setting.prior, variance))
    density, variances = np.array(score).T
    weight = np.exp(density - density.max())
    assert noise.settings == settings
    np.testing.assert_allclose(noise.weight, weight / weight.sum(), rtol=1e-9)
    np.testing.assert_allclose(noise.white_variance, np.outer(variances, white**2), rtol=1e-9)
    assert noise.spare == len(z)


def test_one_direction_is_left_where_known_errors_exceed_the_noise_in_all() -> None:
    m = 4
    blocks = Blocks(np.arange(m), np.ones(m), np.arange(m, dtype=float), np.zeros(m), np.zeros(m, int))
    means = np.random.default_rng(2).standard_normal((m, 3))
    columns = np.eye(3 * m)[:, :2].reshape(3, m, 2)
    errors = np.diag(np.arange(2.0, 2.0 + 3 * m))
    noise = noise_outside_known_errors(columns, means, blocks, [Setting(0.0, 1.0)], np.ones(3), errors)
    assert noise.spare == 1
    np.testing.assert_allclose(noise.white_variance, means[2, 0] ** 2)  # the third reading has the smallest known error
