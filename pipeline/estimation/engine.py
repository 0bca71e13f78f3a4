"""Compute the uncertainty of an estimate from the residuals of its fit, also by a Monte Carlo method.

Every fit is linear in the readings near its solution, ``d beta = sum over channels c of J_c A_c dy_c`` (``LinearMap``).
Under one hypothesis about the noise (``pipeline.estimation.gauss_markov``) the estimate has the covariance

    V = sum_c s_c^2 J_c (A_c diag(1/n) A_c^T + q a_c B(tau) a_c^T) J_c^T

where ``a`` is A summed over the rows of each block, and n the number of samples of a row. One calibration does not
determine q and tau well. So each hypothesis of the prior's grid has the weight of its restricted likelihood times its
prior (Patterson & Thompson, Biometrika 58, 1971), and the error of a parameter is distributed as a mixture over all
hypotheses (``ErrorMixture``). The mixture is approximated by a scaled Student's t that has the same probabilities
within one and within two standard uncertainties:

    P(|e| < x) = sum_i p_i (2 Phi(x / sigma_i) - 1),    x_P: P(|e| < x_P) = P
    t_95(nu) / t_68(nu) = x_95 / x_68,    u = x_95 / t_95(nu)

A Student's t of the same variance and kurtosis fails if the hypothesis without bias instability has nine tenths of the
weight: a hypothesis with a large instability and little weight then determines both, but not the ends of the interval.

Stated accuracies of the bench (type B) are propagated by the same map. They are nuisance parameters with a normal prior
that the estimator does not fit (consider parameters; Schmidt 1966), and add ``J A Z diag(u^2) Z^T A^T J^T``.

Linear least squares ``x = argmin |y - A x|^2``: columns are scaled to unit norm d, so that units do not matter, and
factorised as ``A = Q U diag(s) V^T diag(d)``; the singular values s show which combinations the data determine. The
certificate of a minimum is the largest cosine between the residual and a column of the Jacobian, which is zero at a
minimum (Bates & Watts, Nonlinear Regression Analysis, 1988, section 2.2.3).

``with_trials`` propagates distributions by a Monte Carlo method, in addition to the law of propagation (JCGM 101:2008):

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

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
import scipy
from numpy.typing import ArrayLike

from pipeline.core.errors import NotObservableError
from pipeline.core.records import (
    AFTER_BASE,
    BIAS,
    MATRIX,
    Contribution,
    Convergence,
    Index,
    MonteCarlo,
    SensorCalibration,
    Values,
    noise_of_steps,
)
from pipeline.estimation.gauss_markov import Blocks, GaussMarkov, Setting, WanderPrior, on_ratios, restricted_on_grid

ONE_SIGMA, COVERED = 0.6827, 0.95  # probabilities at which the mixture and Student's t agree
MIN_DEGREES_OF_FREEDOM = 2.0  # degrees of freedom: Student's t has no variance below
MAX_NEWTON_STEPS, SMALL_QUANTILE_STEP = 60, 1e-3  # of Newton's method for a quantile; relative: 1e-7 is left after it
# weight of a hypothesis, relative to the largest: without those below it u changes by less than 0.01 % (96 fits)
NEGLIGIBLE_HYPOTHESIS_WEIGHT = 1e-4
MIN_EIGENVALUE_SHARE = 1e-12  # of the eigenvalues of a scaled matrix: the rounding of a double, with a margin
AVERAGED_OUT = 1e-3  # share of a column's size in block means, below which it does not absorb their noise
RANK_TOLERANCE = 1e-11  # of the largest singular value of unit columns: 1e5 times the rounding of a double
PART_OF_NULL_SPACE = 1e-3  # component of a unit vector of it, above which a parameter is named as not determined
PART_OF_SMALL = 0.2  # the same for the vectors of small eigenvalues, which noise turns
ROW_SUM_RIDGE = 1e-9  # 1e7 times the rounding of a double, for sums over many rows; 3e-5 of a standard deviation
Draw = Callable[[np.random.Generator, int], Values]
SEED = 101  # any number
INTERVAL_COVERAGE = 0.95  # probability of an interval
BATCH = 500  # trials drawn at a time, which bounds the memory
TWO_DIGITS = 1_000_000  # trials
NEWTONS = 6  # each squares the relative error of a step; one by a wide prior starts at some 0.5
# of the largest singular value of unit columns, the root of 1e-13: the rounding of their products
MIN_SINGULAR_VALUE_SHARE = 3e-7


@dataclass(frozen=True)
class LinearMap:
    """The linear map from small changes of the readings to the parameters of a solved fit."""

    # of each channel, (q, n): A, from its readings to its q fitted values; may be one array for all channels
    weights: tuple[Values, ...]
    # of each channel, (p, q): J, derivative of the parameters by its fitted values
    derivative: tuple[Values, ...]

    @property
    def parameters(self) -> int:
        """Number of parameters."""
        return int(self.derivative[0].shape[0])

    def first(self) -> LinearMap:
        """Return the map to the fitted values of all channels, one after the other."""
        sizes = [len(A) for A in self.weights]
        return LinearMap(self.weights, tuple(np.split(np.eye(sum(sizes)), np.cumsum(sizes)[:-1], axis=1)))

    def results(self, kept: slice) -> LinearMap:
        """Return the map to some of the parameters."""
        return LinearMap(self.weights, tuple(J[kept] for J in self.derivative))

    def rows(self, rows: slice) -> LinearMap:
        """Return the map from some consecutive readings."""
        return LinearMap(tuple(A[:, rows] for A in self.weights), self.derivative)

    def of(self, change: Values) -> Values:
        """Return the change of the parameters by a change of the readings, (n, 3): (p,) array."""
        channels = zip(self.derivative, self.weights, change.T, strict=True)
        return np.asarray(np.sum([J @ (A @ dy) for J, A, dy in channels], axis=0))

    def of_groups(self, change: Values, group: Index, count: int) -> Values:
        """Return the change of the parameters by the change of each of ``count`` groups of readings: (p, count) array.

        ``change``: (n, 3). ``group``: (n,), 0 .. count - 1.
        """
        total = np.zeros((self.parameters, count))
        for J, A, dy in zip(self.derivative, self.weights, change.T, strict=True):
            total += J @ np.array([np.bincount(group, row * dy, count) for row in A]).reshape(len(A), count)
        return total


@dataclass(frozen=True)
class ErrorMixture:
    """The error of an estimate: a mixture of normal distributions, one for each hypothesis about the noise."""

    weight: Values  # (k,); they sum to 1
    covariances: Values  # (k, p, p); under each hypothesis
    spare: float  # degrees of freedom of the scale of the noise

    def averaged(self) -> tuple[Values, Values]:
        """Return the covariance, (p, p), and the degrees of freedom, (p,), which are infinite without uncertainty."""
        mean = np.tensordot(self.weight, self.covariances, 1)
        average = np.diag(mean)
        known = average > 0.0
        size, inverse = np.ones(len(average)), np.zeros(len(average))
        variances = np.clip(np.diagonal(self.covariances, axis1=1, axis2=2)[:, known], 0.0, None)
        sigma = np.sqrt(variances / average[known])
        inner, outer = _within(self.weight, sigma, np.array([ONE_SIGMA, COVERED]))
        inverses, ratio, quantile = _quantiles()
        inverse[known] = np.interp(outer / inner, ratio, inverses)
        size[known] = outer / np.interp(inverse[known], inverses, quantile)
        freedom = np.where(known, 1.0 / np.maximum(1.0 / self.spare + inverse, 1e-300), np.inf)
        return mean * np.outer(size, size), freedom

    def draw(self, rng: np.random.Generator, count: int) -> Values:
        """Return (count, p) errors."""
        chosen = rng.choice(len(self.weight), count, p=self.weight)
        out = np.empty((count, self.covariances.shape[1]))
        for k in np.unique(chosen):
            out[chosen == k] = draw_normal(rng, self.covariances[k], int(np.count_nonzero(chosen == k)))
        if np.isfinite(self.spare):
            out *= np.sqrt(self.spare / rng.chisquare(self.spare, count))[:, None]
        return out


def scaled_inverse(matrix: Values) -> Values:
    """Return the pseudo-inverse of a (p, p) symmetric matrix whose parameters have different units and sizes.

    Rows and columns are scaled to a unit diagonal, so that rounding of a large parameter loses no small one.
    """
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scale = np.outer(size, size)
    return np.asarray(np.linalg.pinv(matrix / scale, rcond=MIN_EIGENVALUE_SHARE, hermitian=True) / scale, np.float64)


def draw_normal(rng: np.random.Generator, covariance: Values, count: int) -> Values:
    """Return (count, p) normal errors, also of a singular covariance."""
    return rng.standard_normal((count, len(covariance))) @ root_of(covariance).T


def root_of(covariance: Values) -> Values:
    """Return A with ``A A^T`` a covariance that may be singular: (p, p) array."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.clip(values, 0.0, None)))


def _within(weight: Values, sigma: Values, probability: Values) -> Values:
    """Return the x with ``P(|e| < x)`` each of l probabilities, of each mixture: (l, p) array.

    The probability is concave in x, so that Newton's method from below stays below. It is concave in 1 / sigma, too:
    the mean of these gives a start from below (Jensen's inequality).
    """
    quantile, inverse = scipy.special.ndtri(0.5 + probability / 2.0)[:, None], 1.0 / np.maximum(sigma, 1e-9)
    x, largest = quantile / (weight @ inverse), quantile / inverse.min(axis=0)
    for _ in range(MAX_NEWTON_STEPS):
        ratio = x[:, None] * inverse
        density = weight @ (np.exp(-0.5 * ratio**2) * inverse) * np.sqrt(2.0 / np.pi)
        step = (probability[:, None] + 1.0 - 2.0 * (weight @ scipy.special.ndtr(ratio))) / np.maximum(density, 1e-300)
        x = np.minimum(x + step, largest)
        if (np.abs(step) <= SMALL_QUANTILE_STEP * x).all():
            break
    return np.asarray(x, np.float64)


@cache
def _quantiles() -> tuple[Values, Values, Values]:
    """Return 1 / nu, the ratio of both quantiles of Student's t, and the outer one: (k,) arrays."""
    inverse = np.linspace(0.0, 1.0 / MIN_DEGREES_OF_FREEDOM, 101)
    special, levels = scipy.special, (0.5 + ONE_SIGMA / 2.0, 0.5 + COVERED / 2.0)
    inner, outer = (np.append(special.ndtri(p), special.stdtrit(1.0 / inverse[1:], p)) for p in levels)
    return inverse, np.asarray(outer / inner, np.float64), np.asarray(outer, np.float64)


@dataclass(frozen=True)
class ResidualNoise:
    """Weighted hypotheses about the noise of the readings."""

    blocks: Blocks
    settings: list[Setting]  # of k hypotheses
    weight: Values  # (k,); they sum to 1
    white_variance: Values  # (k, 3), square of the unit of the readings; s^2 of each hypothesis and channel
    spare: float  # degrees of freedom of s^2
    row_weight: Values | None = None  # (n,); samples of each row; None: rows are samples

    @classmethod
    def of(  # noqa: PLR0917  (what a restricted likelihood is)
        cls,
        blocks: Blocks,
        settings: Sequence[Setting],
        logarithm: Values,
        variance: Values,
        free: float,
        row_weight: Values | None = None,
    ) -> ResidualNoise:
        """Weight hypotheses by the restricted likelihood, maximised over s^2, times their prior.

        ``logarithm``: (g,), ``log det C + log det(X^T C^-1 X)`` of all channels. ``variance``: (g, c), s^2 of each of c
        scales. ``free``: values of each scale less its parameters. ``row_weight``: (n,).
        """
        score = -0.5 * (logarithm + free * np.log(variance).sum(axis=1)) + np.array([s.prior for s in settings])
        weight = np.exp(score - score.max())
        kept = np.flatnonzero(weight > NEGLIGIBLE_HYPOTHESIS_WEIGHT)
        chosen = [settings[k] for k in kept.tolist()]
        return cls(blocks, chosen, weight[kept] / weight[kept].sum(), variance[kept], free, row_weight)

    @property
    def white(self) -> Values:
        """Standard deviation of the white noise of a sample: (3,) array."""
        return np.asarray(np.sqrt(self.weight @ self.white_variance))

    @property
    def wander(self) -> Values:
        """Standard deviation of the bias instability: (3,) array."""
        q = np.array([s.ratio**2 for s in self.settings])
        return np.asarray(np.sqrt((self.weight * q) @ self.white_variance))

    def draws(self, rng: np.random.Generator, number: int) -> Iterator[Values]:
        """Yield simulated noise of the likeliest hypothesis, (n, 3) arrays; the bias is constant over a block."""
        best = int(np.argmax(self.weight))
        setting, rows = self.settings[best], int(self.blocks.weight.sum())
        bias = GaussMarkov(self.blocks, [Setting(1.0, setting.time)], np.zeros(len(self.blocks.weight)))
        label = self.blocks.label(rows)
        for _ in range(number):
            drawn = rng.standard_normal((rows, 3)) + setting.ratio * bias.draw(rng, 3)[label]
            yield np.sqrt(self.white_variance[best]) * drawn

    def posterior(self, fit: LinearMap) -> ErrorMixture:
        """Return the error of a fit's parameters."""
        times, at = np.unique([s.time for s in self.settings], return_inverse=True)
        of_time = np.array([s.ratio**2 for s in self.settings])[:, None] * (at[:, None] == np.arange(len(times)))
        share, total = np.column_stack([of_time, np.ones(len(at))]), np.zeros((len(at), *(fit.parameters,) * 2))
        for J, s2, each in zip(fit.derivative, self.white_variance.T, self._products(fit, times.tolist()), strict=True):
            total += np.tensordot(s2[:, None] * share, J @ each @ J.T, 1)
        return ErrorMixture(self.weight, total, self.spare)

    def variances(self, fit: LinearMap, prior: WanderPrior) -> tuple[Values, Values]:
        """Return the variances by the estimated white noise, and by the bias instability of a prior: (p,) arrays."""
        pairs = zip(fit.derivative, self._products(fit, [prior.time]), strict=True)
        each = np.stack([np.einsum("pi,tij,pj->tp", J, products, J) for J, products in pairs])
        return self.white**2 @ each[:, 1], prior.wander**2 * each[:, 0].sum(axis=0)

    def _products(self, fit: LinearMap, times: Sequence[float]) -> list[Values]:
        """Return ``a B(tau) a^T`` at each time, then ``A diag(1/n) A^T``, of each channel: (t + 1, q, q) arrays."""
        B, products = self.blocks.covariance(np.array(times)), dict[int, Values]()
        for key, A in {id(A): A for A in fit.weights}.items():
            a = self.blocks.sums(A.T)
            white = (A if self.row_weight is None else A / self.row_weight) @ A.T
            products[key] = np.concatenate([a.T @ B @ a, white[None]])
        return [products[id(A)] for A in fit.weights]


def assess_noise(  # noqa: PLR0917  (what a fit is)
    residuals: Values,
    design: Values,
    blocks: Blocks,
    prior: WanderPrior,
    disturbance: Values | None = None,
    row_weight: Values | None = None,
) -> ResidualNoise:
    """Weight the hypotheses of a prior by the residuals of a fit.

    If the stated accuracies of the table are worse than the noise, the residuals contain errors of the table, which
    have separate lines in the budget. The directions in which these errors exceed white noise are then projected out
    of all channels.

    ``residuals``: (n, 3), of samples. ``design``: (k, p), the fitted columns of all channels. ``row_weight``: (k,),
    samples of each row of the design, one after the other; None: one. ``disturbance``: (3 m, r), channel by
    channel: change of the sums over the blocks by r independent errors of the table, each of standard uncertainty 1.
    Raises ``NotObservableError`` if there are no more samples than parameters.
    """
    count, spare = blocks.weight[:, None], len(blocks.weight) - design.shape[1]
    if spare < 1:
        problem = f"{len(count)} samples determine {design.shape[1]} parameters and leave none to determine the noise"
        raise NotObservableError(f"{problem}: record more samples")
    weight = np.ones(len(design)) if row_weight is None else row_weight
    size = np.sqrt(weight @ design**2 / weight.sum())
    scaled = np.sqrt(count) * (blocks.sums(weight[:, None] * design) / count / np.where(size > 0, size, 1.0))
    first = blocks.first if row_weight is None else np.rint(np.cumsum(blocks.weight) - blocks.weight).astype(np.intp)
    means = np.add.reduceat(residuals, first, axis=0) / count
    if disturbance is not None:
        white = noise_of_steps(np.abs(np.diff(residuals, axis=0)))
        settings = prior.grid(float(np.sqrt(np.mean(white**2))))
        columns = np.asarray(np.kron(np.eye(3), scaled).reshape(3, len(count), -1), np.float64)
        return noise_outside_known_errors(columns, means, blocks, settings, white, disturbance, row_weight)
    U, s, _ = np.linalg.svd(scaled, full_matrices=False)
    basis = U[:, s > AVERAGED_OUT * s[0]]
    settings = prior.grid(float(np.sqrt(np.mean(residuals**2))))
    times, ratios = ([*dict.fromkeys(values)] for values in zip(*((s.time, s.ratio) for s in settings), strict=True))
    logarithm, squares = restricted_on_grid(blocks, times, ratios, basis / np.sqrt(count), means)
    free = len(count) - basis.shape[1]
    variance = np.maximum(squares / free, np.finfo(float).tiny)
    return replace(ResidualNoise.of(blocks, settings, 3.0 * logarithm, variance, free, row_weight), spare=spare)


def noise_outside_known_errors(  # noqa: PLR0917  (what a restricted likelihood without known errors is)
    columns: Values,
    means: Values,
    blocks: Blocks,
    settings: Sequence[Setting],
    white: Values,
    disturbance: Values,
    row_weight: Values | None = None,
) -> ResidualNoise:
    """Weight hypotheses about the noise by the residuals' block means, in directions without known errors.

    ``columns``: (3, m, p), block means of the fitted columns of each channel, times ``sqrt(samples) / white``, over the
    norm of the column. ``means``: (m, 3), of the residuals. ``white``: (3,), noise of a sample. ``disturbance``: see
    ``assess_noise``; directions in which it exceeds white noise are not used. ``row_weight``: (n,), samples of each
    row.
    """
    root = np.sqrt(blocks.weight)
    scale = np.outer(white, root).ravel()
    U, s, _ = np.linalg.svd(columns.reshape(len(scale), -1), full_matrices=False)
    X = U[:, s > AVERAGED_OUT * s[0]]
    errors = disturbance / scale[:, None]
    errors -= X @ (X.T @ errors)
    # QR iterations: the faster method of numpy did not converge for one in 5,600 units of the blind study
    directions, sizes, _ = scipy.linalg.svd(errors, full_matrices=False, lapack_driver="gesvd")
    known = min(int(np.sum(sizes > 1.0)), len(scale) - X.shape[1] - 1)  # at least one direction is used
    X = np.column_stack([X, directions[:, :known]])
    y = (root * (means / white).T).ravel()
    logarithm, squares = _outside(X, y - X @ (X.T @ y), blocks, settings)
    free = len(scale) - X.shape[1]
    variance = np.maximum(squares / free, np.finfo(float).tiny)[:, None]
    noise = ResidualNoise.of(blocks, settings, logarithm, variance, free, row_weight)
    return replace(noise, white_variance=noise.white_variance * white**2)


def _outside(X: Values, y: Values, blocks: Blocks, settings: Sequence[Setting]) -> tuple[Values, Values]:
    """Return log det and weighted squares of ``y ~ N(0, I + q E)`` in the directions orthogonal to X.

    They are ``log det C + log det(X^T C^-1 X)`` and ``y^T P y``, of all channels together. E, the covariance of the
    bias, is the same for each channel, so that one decomposition of a correlation time serves all channels and ratios.
    ``X``: (3 m, k), orthonormal. ``y``: (3 m,), orthogonal to X.
    """
    root = np.sqrt(blocks.weight)
    logarithm, squares = np.empty(len(settings)), np.empty(len(settings))
    channels = np.column_stack([X, y]).reshape(3, len(root), -1)
    for tau in {s.time for s in settings}:
        e, V = np.linalg.eigh(root[:, None] * blocks.covariance(tau) * root)
        columns = np.ascontiguousarray((V.T @ channels).transpose(2, 0, 1))
        chosen = [k for k, s in enumerate(settings) if s.time == tau]
        of_tau = on_ratios([settings[k].ratio for k in chosen], partial(_of_spectrum, np.clip(e, 0.0, None), columns))
        logarithm[chosen], squares[chosen] = of_tau[0], of_tau[1][:, 0]
    return logarithm, squares


def _of_spectrum(e: Values, columns: Values, ratios: Sequence[float]) -> tuple[Values, Values]:
    """Return ``_outside`` at r ratios, (r,) and (r, 1), by (m,) eigenvalues of E and (k + 1, 3, m) columns there."""
    spectrum = 1.0 + np.outer(np.square(ratios), e)
    whitened = (columns / np.sqrt(spectrum)[:, None, None, :]).reshape(len(ratios), len(columns), -1)
    products = whitened @ whitened.transpose(0, 2, 1)
    products[:, -1, -1] += np.finfo(float).tiny  # readings without noise
    pivots = np.einsum("gkk->gk", np.linalg.cholesky(products))
    logarithm = 3.0 * np.log(spectrum).sum(axis=1) + 2.0 * np.log(pivots[:, :-1]).sum(axis=1)
    return logarithm, pivots[:, -1:] ** 2


def derivative(function: Callable[[Values], Values], x: Values, step: Values) -> Values:
    """Return the (n, m) derivative of a function of (m,) by central differences with a step for each input."""
    steps = np.diag(step)
    return np.stack([(function(x + h) - function(x - h)) / (2.0 * h.sum()) for h in steps], axis=-1)


@dataclass(frozen=True)
class ScaledColumns:
    """The factors of (n, p) columns: ``basis`` Q U, ``singular`` s (falling), ``Vt`` V^T and ``scale`` d."""

    basis: Values
    singular: Values
    Vt: Values
    scale: Values
    tolerance: float  # share of the largest singular value, below which a combination is not determined

    @classmethod
    def of(cls, A: Values, tolerance: float = RANK_TOLERANCE, scale: Values | None = None) -> ScaledColumns:
        """Factorise (n, p) columns, in units of their norms unless ``scale`` states others; n may be smaller than p."""
        n, p = A.shape
        scale = np.linalg.norm(A, axis=0) if scale is None else scale
        scale = np.where(scale == 0, 1.0, scale)
        Q, R = np.linalg.qr(A / scale)
        U, s, Vt = np.linalg.svd(R, full_matrices=n < p)
        singular, basis = np.zeros(p), np.zeros((n, p))
        singular[: len(s)] = s
        basis[:, : len(s)] = Q @ U
        return cls(basis, singular, Vt, scale, tolerance)

    @property
    def rank(self) -> int:
        """Number of determined combinations of parameters."""
        return int(np.sum(self.singular > self.tolerance * self.singular[0]))

    @property
    def condition(self) -> float:
        """Condition number of the scaled columns."""
        return float(self.singular[0] / self.singular[-1]) if self.singular[-1] > 0 else float("inf")

    def solve(self, y: Values) -> Values:
        """Return the x of least norm that minimises ``|y - A x|``: (n,) or (n, m) to (p,) or (p, m)."""
        keep = slice(self.rank)
        x: Values = ((self.Vt[keep].T / self.singular[keep]) @ (self.basis.T @ y)[keep]).T / self.scale
        return x.T

    def weights(self) -> Values:
        """Return the pseudo-inverse for full rank, ``solve(y) = weights @ y``: (p, n) array."""
        return (self.Vt.T / self.singular / self.scale[:, None]) @ self.basis.T

    def undetermined(self, names: Sequence[str], share: float = PART_OF_NULL_SPACE) -> list[str]:
        """Return the names of the parameters with at least ``share`` in undetermined combinations."""
        parts = np.linalg.norm(self.Vt[self.rank :], axis=0)
        return [name for name, part in zip(names, parts, strict=True) if part > share]

    def require_full_rank(self, names: Sequence[str]) -> None:
        """Raise ``NotObservableError``, with the names of the parameters, if the data do not determine some."""
        if self.rank < len(self.scale):
            raise NotObservableError(
                f"the data determine {self.rank} of {len(self.scale)} parameters; not determined, or only in "
                f"combination with each other: {', '.join(self.undetermined(names))}. Record motion that changes these "
                "independently, or fix some of them"
            )


def undetermined_columns(products: Values, least: float) -> Values:
    """Return which columns of (p, p) products of unit columns take part in combinations of a smaller eigenvalue."""
    values, vectors = np.linalg.eigh(products)
    return np.asarray(np.linalg.norm(vectors[:, values < least], axis=1) > PART_OF_SMALL)


def cholesky(matrix: Values) -> Values:
    """Return the lower Cholesky factor of covariance matrices: (..., n, n) array.

    Their elements may differ by more than the digits of a double, as those of stated errors and tiny white noise do.
    Where rounding leaves no positive definite matrix, the diagonal is increased by the share ``ROW_SUM_RIDGE`` of
    itself.
    """
    try:
        return np.asarray(np.linalg.cholesky(matrix), np.float64)
    except np.linalg.LinAlgError:
        diagonal = np.einsum("...kk->...k", matrix)[..., None] * np.eye(matrix.shape[-1])
        return np.asarray(np.linalg.cholesky(matrix + ROW_SUM_RIDGE * diagonal), np.float64)


def linear_convergence(A: Values, residual: Values, condition: float, rank: int) -> Convergence:
    """Return the evidence that a linear estimate is a minimum; ``condition``: of the scaled columns.

    ``A``: (n, p), columns, the same for each channel. ``residual``: (n,) or (n, m), of m channels.
    """
    products = np.abs(A.T @ residual)
    size = np.multiply.outer(np.linalg.norm(A, axis=0), np.linalg.norm(residual, axis=0))
    cosine = np.divide(products, size, out=np.zeros_like(products), where=size > 0.0)
    return Convergence(float(cosine.max()), condition, rank, A.shape[1])


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
    validated = ((d_low <= tolerance) & (d_high <= tolerance)) | ~known
    mean, tolerance = values.mean(axis=0), np.where(known, tolerance, 0.0)
    return MonteCarlo(M, SEED, digits, y, U, mean, u, low, high, tolerance, d_low, d_high, validated)


def through(posterior: ErrorMixture, stated: Sequence[Values], results: Callable[[Values], Values]) -> Draw:
    """Return a function that draws parameters; ``results``: errors (t, q) to parameters (t, p).

    ``posterior``: of the noise of q linear functions of the readings. ``stated``: (q, q), by stated accuracies.
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
