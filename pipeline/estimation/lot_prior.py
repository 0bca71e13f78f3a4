"""Estimate a prior of a unit's parameters from the other units of its lot, and apply it after the fits.

    x_i = theta_i + b + e_i,    cov(e_i) = A_i,    theta_i ~ N(mu, diag(tau^2)) within a lot
    theta_i = x_i - G (x_i - m),    G = A_i (A_i + V)^-1,    cov = (1 - G) A_i (1 - G)^T + G V G^T + cov(b)

x_i is the published estimate of unit i, A_i its covariance by the noise of the unit. b is the error of the table, which
is the same for the units of a lot: both m and x_i contain it, so that no G reduces it, and cov(b) is added. If b is not
shared, the spread of the estimates contains it, and the result is wider than necessary.

m and V (diagonal) are mean and variance of the prediction of a unit from the other units of the lot, its siblings. mu
and tau have flat densities (Gelman, Bayesian Analysis 1 (2006) 515); mu is integrated in closed form, tau on a grid.
The degrees of freedom of V are those of Student's t with the kurtosis of the prediction.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from pipeline.core.records import MEDIAN_SIZE, Index, Mask, Values
from pipeline.estimation.engine import scaled_inverse
from pipeline.estimation.uncertainty_budget import effective_degrees_of_freedom

MIN_SIBLINGS = 8  # siblings; docs/fleet.md has the errors and intervals in lots of 12 units
# largest share of a lot without the prior by chance, without harm: measured 0.8 to 2.4 % (benchmarks/lot_prior.py)
MAX_FALSE_PRIOR_SHARE = 0.05
FAR_LEVEL = 0.001  # below it a unit is no sibling of others; 0.05 would exclude 4 % of a lot and narrow its spread
GRID = np.geomspace(0.01, 10.0, 64)  # of tau, over the spread of the estimates; steps of 12 %
OMEGA = 0.5  # standard deviation of log tau within a kind: axes differ by a factor of 1.6 (assumption)
HETEROGENEITY_PRIOR = np.exp(-0.5 * (np.log(GRID[:, None] / GRID) / OMEGA) ** 2)
HETEROGENEITY_PRIOR /= HETEROGENEITY_PRIOR.sum(axis=1, keepdims=True)  # (common tau of the kind, tau of a parameter)
FAR_AT_FIRST = 5.0  # robust standard deviations, beyond which a unit is at first no sibling; all are tested again
MAX_SIBLING_ITERATIONS = 20  # at most, until the siblings stay the same; two sets that alternate end here


class Prediction(NamedTuple):
    """Mean, variance and degrees of freedom of parameters, predicted from siblings: (p,) or (n, p) arrays."""

    mean: Values
    variance: Values
    freedom: Values


class LotPrior(NamedTuple):
    """The prior of each of n units of a lot with p parameters, and the test of each unit against its own prior.

    ``predicted``: (n, p) arrays; ``siblings``: (n,), their number; ``deviation``: (n, p), estimate less prediction over
    the standard uncertainty of the difference; ``probability``: (n,), of a difference as large as the unit's.
    """

    predicted: Prediction
    siblings: Index
    deviation: Values
    probability: Values

    @property
    def outlier(self) -> Mask:
        """Whether a unit differs from its siblings, ``probability < LEVEL``: (n,) array."""
        return self.probability < MAX_FALSE_PRIOR_SHARE


class WithPrior(NamedTuple):
    """An estimate with its prior: values (p,), and the contributions of readings and lot to its covariance.

    ``lot_freedom``: (p,), degrees of freedom of the lot's part; ``share``: (p,), of the prior in each value.
    """

    values: Values
    own: Values
    lot: Values
    lot_freedom: Values
    share: Values


def lot_priors(x: Values, own: Values, freedom: Values, able: Mask, numbers: tuple[Index, Index]) -> LotPrior:
    """Return the prior of each unit of a lot, from siblings that are no outliers.

    ``x``: (n, p), estimates. ``own``: (n, p, p), A_i; the degrees of freedom of its diagonals are ``freedom``, (n, p).
    ``able``: (n,), whether a unit may be a sibling. ``numbers``: (n,) of the device of each unit: of several
    calibrations of a device the first counts, and none for the others; (p,) of the kind of each parameter: the tau of
    one kind are alike.
    """
    device, kind = numbers
    _, first = np.unique(np.where(able, device, -1), return_index=True)
    able = able & np.isin(np.arange(len(x)), first)
    away = np.abs(x - np.median(x[able], axis=0))
    near = able & np.all(away <= FAR_AT_FIRST * MEDIAN_SIZE * np.median(away[able], axis=0), axis=1)
    siblings = near if near.sum() > MIN_SIBLINGS else able
    for _ in range(MAX_SIBLING_ITERATIONS):
        of_device = np.full(int(device.max()) + 1, -1)
        of_device[device[siblings]] = np.flatnonzero(siblings)
        itself = of_device[device]
        predicted = _predicted(x, np.diagonal(own, axis1=1, axis2=2), siblings, itself, kind)
        z, probability = _tested(x, own, freedom, predicted)
        found = LotPrior(predicted, siblings.sum() - (itself >= 0), z, probability)
        remaining = able & (probability >= FAR_LEVEL)
        if np.array_equal(remaining, siblings) or remaining.sum() <= MIN_SIBLINGS:
            break
        siblings = remaining
    return found


def _predicted(x: Values, v: Values, siblings: Mask, itself: Index, kind: Index) -> Prediction:
    """Return the prediction of each unit; ``itself``: the sibling that is the unit's own device, or -1."""
    found = Prediction(*(np.empty(x.shape) for _ in range(3)))
    for each in np.unique(kind):
        columns = np.flatnonzero(kind == each)
        y = x[:, columns] - np.median(x[siblings][:, columns], axis=0)
        tau2 = (max(float(np.std(y[siblings])), 1e-300) * GRID) ** 2
        given = [_given_tau(y[:, [k]], v[:, [j]], siblings, itself, tau2) for k, j in enumerate(columns)]
        of_kind = [np.log(likelihood @ HETEROGENEITY_PRIOR.T) for *_, likelihood in given]
        for k, j in enumerate(columns):
            others = np.sum([m for i, m in enumerate(of_kind) if i != k], axis=0) + np.log(GRID)
            means, variances, likelihood = given[k]
            tau = _normalized(others) @ HETEROGENEITY_PRIOR * likelihood
            tau /= tau.sum(axis=1, keepdims=True)
            mean = np.sum(tau * means, axis=1, keepdims=True)
            off = (means - mean) ** 2
            variance = np.sum(tau * (variances + off), axis=1)
            fourth = np.sum(tau * (3.0 * variances**2 + 6.0 * variances * off + off**2), axis=1)
            found.mean[:, j] = mean[:, 0] + np.median(x[siblings, j])
            found.variance[:, j] = variance
            found.freedom[:, j] = 4.0 + 6.0 / np.maximum(fourth / variance**2 - 3.0, 1e-6)
    return found


def _given_tau(y: Values, v: Values, siblings: Mask, itself: Index, tau2: Values) -> tuple[Values, Values, Values]:
    """Return mean and variance of each unit's prediction for each tau, and the likelihood of tau: (n, k) arrays."""
    total = np.maximum(v + tau2, 1e-12 * tau2[-1])
    w, log = siblings[:, None] / total, np.where(siblings[:, None], np.log(total), 0.0)
    terms = (w, w * y, w * y**2, log)
    s = [t.sum(axis=0) - np.where(itself[:, None] >= 0, t[itself], 0.0) for t in terms]  # without the unit itself
    mean = s[1] / s[0]
    return mean, tau2 + 1.0 / s[0], _normalized(-0.5 * (s[3] + np.log(s[0]) + s[2] - s[1] * mean))


def _normalized(log: Values) -> Values:
    """Return values proportional to exp(log), with a maximum of 1 in each row."""
    return np.asarray(np.exp(log - np.max(log, axis=-1, keepdims=True)))


def _tested(x: Values, own: Values, freedom: Values, predicted: Prediction) -> tuple[Values, Values]:
    """Return the deviations of each unit, and their probability: the smaller p of two tests, times two.

    The tests are of the largest deviation by Student's t, times the number of parameters, and of all deviations by
    Hotelling's form of F.
    """
    mean, variance, predicted_freedom = predicted
    v, size = np.diagonal(own, axis1=1, axis2=2), x.shape[1]
    u = np.sqrt(v + variance)
    parts = np.sqrt(np.stack([v, variance])).reshape(2, -1)
    nu = effective_degrees_of_freedom(parts, np.stack([freedom, predicted_freedom]).reshape(2, -1)).reshape(x.shape)
    z = (x - mean) / u
    one = size * 2.0 * scipy.special.stdtr(np.minimum(nu, 1e9), -np.abs(z)).min(axis=1)
    correlation = (own + variance[:, :, None] * np.eye(size)) / (u[:, :, None] * u[:, None, :])
    squared = np.einsum("ij,ij->i", z, np.linalg.solve(correlation, z[..., None])[..., 0])
    together = scipy.special.fdtrc(size, 1.0 / np.maximum(np.mean(1.0 / nu, axis=1), 1e-9), squared / size)
    return z, np.minimum(1.0, 2.0 * np.minimum(one, together))


def with_prior(x: Values, own: Values, predicted: Prediction, known: Mask) -> WithPrior:
    """Return an estimate, ``x`` (p,) of covariance ``own`` (p, p), with its prior.

    ``known``: (p,), the q parameters that are ``predicted``, (q,) arrays; the others follow by their correlation.
    """
    mean, variance, freedom = predicted
    gain = own[:, known] @ scaled_inverse(own[np.ix_(known, known)] + np.diag(variance))
    rest = np.eye(len(x))
    rest[:, known] -= gain
    share, lot_freedom = np.zeros(len(x)), effective_degrees_of_freedom(np.abs(gain * np.sqrt(variance)).T, freedom)
    share[known] = np.diag(gain[known])
    values, by_own, by_lot = x - gain @ (x[known] - mean), rest @ own @ rest.T, (gain * variance) @ gain.T
    return WithPrior(values, by_own, by_lot, lot_freedom, share)
