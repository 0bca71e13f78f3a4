"""The prior of a lot against Bayes' theorem in its information form, and against drawn lots with known parameters."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.core.records import coverage_factor
from pipeline.estimation.lot_prior import MIN_SIBLINGS, LotPrior, Prediction, lot_priors, with_prior
from pipeline.estimation.uncertainty_budget import effective_degrees_of_freedom

KIND = np.array([0, 0, 0, 1, 1, 1])
P = len(KIND)
FREEDOM = 40.0


def covariance(rng: np.random.Generator) -> np.ndarray:
    """Return the covariance of an estimate with unit variances and correlations of some tenths."""
    root = np.eye(P) + 0.4 * np.tril(rng.normal(size=(P, P)), -1)
    size = np.sqrt(np.diag(root @ root.T))
    return root @ root.T / np.outer(size, size)


def drawn(rng: np.random.Generator, units: int, tau: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return truth, estimates and stated covariances, of 40 degrees of freedom, of a lot."""
    C, mean = covariance(rng), 3.0 * rng.normal(size=P)
    truth = mean + tau * rng.normal(size=(units, P))
    stated = C * rng.chisquare(FREEDOM, (units, 1, 1)) / FREEDOM
    return truth, truth + rng.multivariate_normal(np.zeros(P), C, units), stated


def priors(x: np.ndarray, own: np.ndarray, device: np.ndarray | None = None) -> LotPrior:
    known = np.arange(len(x)) if device is None else device
    return lot_priors(x, own, np.full(x.shape, FREEDOM), np.ones(len(x), bool), (known, KIND))


def of(lots: LotPrior, i: int) -> Prediction:
    return Prediction(*(values[i] for values in lots.predicted))


def test_with_a_known_lot_it_is_bayes_theorem() -> None:
    rng = np.random.default_rng(2)
    C, x, mean, variance = covariance(rng), rng.normal(size=P), rng.normal(size=P), rng.uniform(0.2, 4.0, P)
    known = np.array([True, True, False, True, False, True])  # two parameters without a prior follow the others
    found = with_prior(x, C, Prediction(mean[known], variance[known], np.full(4, 9.0)), known)
    weight = np.where(known, 1.0 / variance, 0.0)
    posterior = np.linalg.inv(np.linalg.inv(C) + np.diag(weight))
    assert found.values == pytest.approx(posterior @ (np.linalg.solve(C, x) + weight * mean), abs=1e-12)
    assert found.own + found.lot == pytest.approx(posterior, abs=1e-12)
    assert np.all(found.lot_freedom >= 9.0)


def test_a_large_lot_shows_its_mean_and_spread() -> None:
    rng, tau = np.random.default_rng(3), np.array([0.3, 0.3, 0.3, 2.0, 2.0, 2.0])
    C, mean, noise = covariance(rng), rng.normal(size=P), rng.uniform(0.5, 2.0, 800)  # units of different noise
    x = mean + tau * rng.normal(size=(800, P))
    x += noise[:, None] * rng.multivariate_normal(np.zeros(P), C, 800)
    lots = priors(x, noise[:, None, None] ** 2 * C)
    assert lots.predicted.mean[0] == pytest.approx(mean, abs=0.25)
    assert np.sqrt(lots.predicted.variance[0]) == pytest.approx(tau, rel=0.25)


def test_no_unit_is_its_own_sibling_nor_another_calibration_of_its_device() -> None:
    rng = np.random.default_rng(4)
    _, x, own = drawn(rng, 30, 2.0)
    device = np.arange(30)
    device[7] = 3
    lots = priors(x, own, device)
    assert set(lots.siblings) == {28}
    changed = x.copy()
    changed[3] += 0.3
    again = priors(changed, own, device)
    for i in (3, 7):
        assert again.predicted.mean[i] == pytest.approx(lots.predicted.mean[i], abs=1e-6)  # the grid moves a little
        assert again.predicted.variance[i] == pytest.approx(lots.predicted.variance[i], rel=1e-6)
    assert np.all(np.abs(again.predicted.mean[0] - lots.predicted.mean[0]) > 1e-3)


def test_units_of_measurement_do_not_matter() -> None:
    rng, size = np.random.default_rng(5), np.array([1e-7, 1e-7, 1e-7, 1e5, 1e5, 1e5])
    _, x, own = drawn(rng, 20, 1.0)
    one, other = priors(x, own), priors(x * size, own * np.outer(size, size))
    assert other.predicted.mean == pytest.approx(one.predicted.mean * size, rel=1e-6)
    assert other.probability == pytest.approx(one.probability, rel=1e-6)


@pytest.mark.parametrize("tau", [0.6, 2.0, 6.0])
def test_the_error_falls_and_the_intervals_hold(tau: float) -> None:
    rng, inside, without, after = np.random.default_rng(6), [], [], []
    for _ in range(15):
        truth, x, own = drawn(rng, 40, tau)
        lots = priors(x, own)
        for i in np.flatnonzero(~lots.outlier):
            found = with_prior(x[i], own[i], of(lots, i), np.ones(P, bool))
            u = np.sqrt(np.stack([np.diag(found.own), np.diag(found.lot)]))
            nu = effective_degrees_of_freedom(u, np.stack([np.full(P, FREEDOM), found.lot_freedom]))
            inside.append(np.abs(found.values - truth[i]) <= coverage_factor(nu) * np.hypot(*u))
            without.append((x[i] - truth[i]) ** 2)
            after.append((found.values - truth[i]) ** 2)
    expected = tau**2 / (tau**2 + 1.0)  # of the variance, with mean and spread of the lot known
    assert expected - 0.05 < np.mean(after) / np.mean(without) < expected + 0.12
    assert 0.93 < np.mean(inside) < 0.97  # 3600 intervals, of 15 lots: 95 % within two standard errors over lots


def test_outliers_beyond_five_standard_deviations_are_found_and_are_no_siblings() -> None:
    rng, found, others, spreads = np.random.default_rng(8), [], [], []
    for _ in range(10):
        truth, x, own = drawn(rng, 40, 3.0)
        which = rng.integers(0, P, 4)
        moved = truth.mean(axis=0)[which] + 3.0 * rng.uniform(5.0, 8.0, 4) * rng.choice([-1.0, 1.0], 4)
        x[np.arange(4), which] += moved - truth[np.arange(4), which]
        lots = priors(x, own)
        found.append(lots.outlier[:4])
        others.append(lots.outlier[4:])
        spreads.append(np.sqrt(lots.predicted.variance).mean())
    assert np.mean(found) >= 0.95
    assert np.mean(others) <= 0.05
    assert np.mean(spreads) == pytest.approx(3.0, rel=0.15)


def test_a_lot_of_few_units_is_not_used_up_by_its_own_test() -> None:
    _, x, own = drawn(np.random.default_rng(9), MIN_SIBLINGS + 1, 1.0)
    assert priors(x, own).siblings.min() >= MIN_SIBLINGS - 1
