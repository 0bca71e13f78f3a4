"""Propagate distributions by a Monte Carlo method, in addition to the law of propagation (JCGM 101:2008).

    parameters_r = f(z + e_r),    e_r = e_noise + sum over sources of type B e_s,    r = 1 .. M

where

    z       : linear functions of the readings that a fit computes first (coefficients of a sinusoid, response to the
              rate, lengths of gravity at the rests, directions of moves); to draw these instead of readings is exact
    f       : all further computation, without linearisation
    e_noise : normal under each hypothesis of the noise; the hypotheses are drawn by their weight
    e_s     : normal; also the sum of many rounding errors is normal

The law of propagation is confirmed if both ends of its interval ``y +- U`` are within ``delta = 10^l / 2`` of the ends
of the Monte Carlo interval, with ``u = c 10^l`` and c an integer of the stated digits (8.1): one digit below a million
trials, else two, because the ends of a Monte Carlo interval scatter by 2.7 u / sqrt(M).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from pipeline.core.records import AFTER_BASE, BIAS, MATRIX, Contribution, MonteCarlo, SensorCalibration, Values
from pipeline.estimation.engine import ErrorMixture, draw_normal

Draw = Callable[[np.random.Generator, int], Values]

SEED = 101  # any number
INTERVAL_COVERAGE = 0.95  # probability of an interval
BATCH = 500  # trials drawn at a time, which bounds the memory
TWO_DIGITS = 1_000_000  # trials
NEWTONS = 6  # each squares the relative error of a step; one by a wide prior starts at some 0.5
# of the largest singular value of unit columns, the root of 1e-13: the rounding of their products
MIN_SINGULAR_VALUE_SHARE = 3e-7


def numerical_tolerance(standard_uncertainty: ArrayLike, digits: int = 2) -> Values:
    """Return delta for standard uncertainties that are stated to some significant digits: (n,) array (7.9.2)."""
    u = np.atleast_1d(np.asarray(standard_uncertainty, float))
    exponent = np.floor(np.log10(np.maximum(u, np.finfo(float).tiny))) - digits + 1.0
    exponent += np.round(u / 10.0**exponent) >= 10.0**digits  # 0.0996 is 10 x 10^-2 to two digits
    return np.asarray(0.5 * 10.0**exponent)


def compared(results: ArrayLike, estimate: ArrayLike, expanded: ArrayLike, *, digits: int = 2) -> MonteCarlo:
    """Compare ``y +- U`` of n parameters by the law of propagation with the 95 % interval of (M, n) drawn results.

    The interval has as much probability below as above (7.7). A parameter without an uncertainty is confirmed.
    """
    values, y = np.sort(np.asarray(results, float), axis=0), np.atleast_1d(np.asarray(estimate, float))
    U, u = np.atleast_1d(np.asarray(expanded, float)), values.std(axis=0, ddof=1)
    M, known = len(values), U > 0.0
    inside = round(INTERVAL_COVERAGE * M)
    first = (M - inside) // 2
    low, high = values[first], values[min(first + inside, M - 1)]
    tolerance = numerical_tolerance(np.minimum(u, U), digits)
    d_low, d_high = np.abs(y - U - low), np.abs(y + U - high)
    return MonteCarlo(
        trials=M,
        seed=SEED,
        digits=digits,
        estimate=y,
        expanded_uncertainty=U,
        mean=values.mean(axis=0),
        standard_uncertainty=u,
        low=low,
        high=high,
        tolerance=np.where(known, tolerance, 0.0),
        d_low=d_low,
        d_high=d_high,
        validated=((d_low <= tolerance) & (d_high <= tolerance)) | ~known,
    )


def through(posterior: ErrorMixture, stated: Sequence[Values], results: Callable[[Values], Values]) -> Draw:
    """Return a function that draws parameters.

    ``posterior``: of the noise of q linear functions of the readings. ``stated``: (q, q), covariances by stated
    accuracies. ``results``: errors (t, q) to parameters (t, p).
    """

    def draw(rng: np.random.Generator, count: int) -> Values:
        errors = posterior.draw(rng, count)
        for covariance in stated:
            errors += draw_normal(rng, covariance, count)
        return results(errors)

    return draw


def with_trials(
    calibration: SensorCalibration, draw: Draw, trials: int, direct: Sequence[Contribution] = ()
) -> SensorCalibration:
    """Return a calibration whose budget also has the Monte Carlo run and its comparison.

    ``calibration``: with its budget. ``draw``: generator and t to (t, p) parameters. ``trials``: M. ``direct``: sources
    of type B that act on the parameters themselves.
    """
    rng, drawn = np.random.default_rng(SEED), []
    for start in range(0, trials, BATCH):
        values = draw(rng, min(BATCH, trials - start))
        for source in direct:
            values = values + draw_normal(rng, source.covariance, len(values))
        drawn.append(values)
    assert calibration.budget is not None  # noqa: S101  (see above)
    parameters, digits = calibration.parameters, 2 if trials >= TWO_DIGITS else 1
    run = compared(np.concatenate(drawn), parameters.values, parameters.expanded_uncertainty, digits=digits)
    return replace(calibration, budget=replace(calibration.budget, monte_carlo=run))


def quadratic_results(columns: Values, curvature: Values, inverse: Values) -> Callable[[Values], Values]:
    """Return the step of a least-squares fit as a function of the equations' errors, to second order of the model.

        g(d) = J^T W (X d + d^T H d / 2 - e) = 0,   J = X + H d

    ``columns``: (n, p), X. ``curvature``: (n, p, p), H, symmetric in its last two. ``inverse``: (n, n), W, the weights
    of the fit. The function takes (t, n) errors e and returns (t, p) steps d, by Gauss-Newton with the J of each draw:
    if a prior is wide, H d is as large as X.
    """
    w, V = np.linalg.eigh(inverse)
    root = (V * np.sqrt(np.maximum(w, 0.0))).T
    size = np.linalg.norm(root @ columns, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    X = root @ columns / size
    n, p = X.shape
    flat = (np.einsum("mn,npq->mpq", root, curvature) / np.outer(size, size)).reshape(n * p, p)

    def step(e: Values) -> Values:
        white = e @ root.T
        d = white @ np.linalg.pinv(X, rcond=MIN_SINGULAR_VALUE_SHARE).T
        for _ in range(NEWTONS):
            bent = (d @ flat.T).reshape(len(d), n, p)
            J = X + bent
            gradient = np.einsum("tnp,tn->tp", J, d @ X.T + 0.5 * np.einsum("tnp,tp->tn", bent, d) - white)
            normal = np.linalg.pinv(J.transpose(0, 2, 1) @ J, rcond=MIN_SINGULAR_VALUE_SHARE**2, hermitian=True)
            d = d - np.einsum("tpq,tq->tp", normal, gradient)
        return np.asarray(d / size)

    return step


def with_matrix(values: Values) -> Values:
    """Return (t, 12 + p) parameters with the matrix instead of K."""
    K = values[:, MATRIX].reshape(-1, 3, 3)
    matrix = np.linalg.solve(K, np.broadcast_to(np.eye(3), K.shape)).reshape(-1, 9)
    return np.concatenate([values[:, BIAS], matrix, values[:, AFTER_BASE]], axis=1)
