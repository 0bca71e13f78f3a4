"""The noise model of every fit, white noise plus a Gauss-Markov bias, with likelihoods in O(n).

The readings of a channel are cut into m blocks of consecutive samples. Their means have the covariance

    s^2 C,    C = diag(v) + q B(tau),    B_jk = exp(-gap_jk / tau) h_j h_k  (j != k),   h(x) = (1 - exp(-x)) / x

where

    s   : standard deviation of the white noise of one sample
    v   : (m,) variance of a block's mean by white noise of unit variance: 1 / samples without a filter
    q   : variance of the bias over s^2 (``Setting.ratio`` is its root)
    tau : correlation time of the bias, s
    B   : covariance of the averages of a unit first-order Gauss-Markov process over the blocks, ``x = length / tau``;
          0 between blocks whose distance in time is unknown

The differences ``w_k = y_k / h_k - phi_k y_(k-1) / h_(k-1)`` with ``phi_k = exp(-(start_k - start_(k-1)) / tau)`` are
correlated with their neighbours only. Their covariance T is tridiagonal and positive definite for every q. So one
factorisation of T (LAPACK ``pttrf``) gives ``A^T C^-1 A`` and ``log det C``, for all settings of a grid in one call.
Block means and the scatter within the blocks are independent. Products over samples are therefore the sum of the
products within the blocks, which no setting changes, and of the products of the means.

Sources: IEEE Std 952-1997, annex C (the process); Rybicki & Press, Phys. Rev. Lett. 74, 1995 (its inverse); Patterson &
Thompson, Biometrika 58, 1971 (restricted likelihood).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
import scipy

from pipeline.core.records import Index, Integers, Noise, Values

DEFAULT_TIME_S = 100.0  # correlation time if the sensor file gives none: of MEMS sensors, by IEEE Std 952 examples
STATED_WIDTH = float(np.log(3.0))  # of the logarithm of a bias instability that a sensor file gives: a factor of three
SHARPEST_WIDTH = 0.15  # of the same logarithm, however long the static recording
STATIC_WIDTH = (0.35, 1.1)  # the same for the coarse grid of ``selection_grid``, whose steps are factors of two
MAX_PRIOR_WIDTHS = 3.0  # widths of the prior beyond which the residuals alone decide
NO_INSTABILITY_ODDS = 9.0  # odds of no bias instability at all if none is stated
TIME_FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0)  # correlation times of the grid, over that of the prior
TIME_PRIOR = (0.1, 0.2, 0.4, 0.2, 0.1)  # their probabilities, alike on both sides of the stated time
BIAS_RATIO_GRID = np.append(0.0, 10.0 ** np.arange(-2.4, 0.85, 0.1))  # of bias to white noise of a sample
OVERLAP_S = 1e-6  # blocks that follow each other overlap by less, from rounding
RANDOM_WALK = 8.0  # correlation time over the measured one, with the same variance of short differences
# A random walk of the bias: factors on ratio and time of a setting, and its share of that setting's prior. Of 80
# simulated random walks 17 showed an invented effect without it, and 6 with it.
WALK_RATIO, WALK_TIME, WALK_SHARE = 8.0, 64.0, 0.3
LARGEST_SPAN = 1e9  # of variances that a factorisation resolves: 1e7 times the rounding of a double
# share of white noise's spectrum, see ``constant_bias_s``: right answers as with 0.05 in the blind study
SLOW_SPECTRUM_SHARE = 0.3
# correlation time below which ``information`` replaces the model, because its blocks last seconds
MIN_MODELLED_TIME_S = 25.0
# between the logarithms of ratios at which ``on_ratios`` computes a likelihood: of 24 units on a table, no
# expanded uncertainty changes by more than 0.05 %
KNOT_STEP = 0.55
CACHED = 16384  # numbers of ``GaussMarkov.squares`` that stay in the processor's cache: 128 kB


class Setting(NamedTuple):
    """One noise hypothesis: ratio of bias to white noise, correlation time in s, and prior log weight."""

    ratio: float
    time: float
    prior: float = 0.0


WHITE_SETTING = Setting(0.0, 1.0)


@dataclass(frozen=True)
class WanderPrior:
    """The prior of the bias instability."""

    wander: float = 0.0  # unit of the sensor; its standard deviation; 0: unknown
    time: float = DEFAULT_TIME_S  # s; its correlation time
    width: float = STATED_WIDTH  # standard deviation of the logarithm of ``wander``
    stated: WanderPrior | None = None  # the prior without the static recording
    # of a static recording: wanders, (w,), and its log likelihood at them, (t, w), by ``TIME_FACTORS``
    seen: tuple[Values, Values] | None = None

    def log_belief(self, wander: Values) -> Values:
        """Return the log prior, up to a constant, of (m,) standard deviations of which the first is 0.

        If no wander is stated, the first has ``NO_INSTABILITY_ODDS`` times the weight of all others together.
        """
        if self.wander <= 0.0:
            return np.append(np.log(NO_INSTABILITY_ODDS * (len(wander) - 1)), np.zeros(len(wander) - 1))
        far = np.abs(np.log(wander[1:] / self.wander)) / self.width
        return np.append(-np.inf, -0.5 * np.minimum(far, MAX_PRIOR_WIDTHS) ** 2)

    def grid(self, white: float) -> list[Setting]:
        """Return the hypotheses over which a covariance is averaged, for white noise of ``white`` per sample."""
        wander = BIAS_RATIO_GRID * white
        belief = np.tile((self.stated or self).log_belief(wander), (len(TIME_FACTORS), 1))
        if self.seen is not None:
            belief += [np.interp(wander, self.seen[0], row) for row in self.seen[1]]
        weights = (belief + np.log(TIME_PRIOR)[:, None]).tolist()
        return [
            Setting(ratio, factor * self.time, weight)
            for factor, row in zip(TIME_FACTORS, weights, strict=True)
            for ratio, weight in zip(BIAS_RATIO_GRID.tolist(), row, strict=True)
            if math.isfinite(weight)
        ]


def selection_grid(
    noise: Noise | None, ratios: Sequence[float] = (0.03, 0.1, 0.3, 1.0, 3.0), times: Sequence[float] = (60.0, 600.0)
) -> list[Setting]:
    """Return the hypotheses over which the likelihoods of models are maximised.

    With a static recording they are its ratio, and the half, double and fourfold of it with a log-normal weight. Random
    walks with the same short differences are added: they exceed these hypotheses only over times that are longer than
    the recording. Without one, the hypotheses cover the usual sensors.
    """
    known = _static_ratio(noise)
    if noise is not None and known > 0.0 and not fast(noise):
        factors = np.array([0.5, 1.0, 2.0, 4.0])
        least, most = STATIC_WIDTH
        width = np.clip(np.sqrt(noise.correlation_time / noise.length), least, most) if noise.length > 0 else least
        pairs = list(zip(known * factors, -0.5 * (np.log(factors) / width) ** 2, strict=True))
        walk = RANDOM_WALK**0.5
        return [Setting(r, noise.correlation_time * f, p) for r, p in pairs for f in (0.5, 2.0)] + [
            Setting(r * walk, noise.correlation_time * RANDOM_WALK, p - 1.0) for r, p in pairs
        ]
    return [WHITE_SETTING] + [Setting(ratio, time) for ratio in ratios for time in times]


def random_walks(settings: Iterable[Setting]) -> dict[Setting, Setting]:
    """Return for each ratio the setting of its shortest time, and a random walk with the same short differences."""
    shortest: dict[float, Setting] = {}
    for s in settings:
        if s.ratio > 0.0 and (s.ratio not in shortest or s.time < shortest[s.ratio].time):
            shortest[s.ratio] = s
    share = float(np.log(WALK_SHARE))
    return {s: Setting(s.ratio * WALK_RATIO, s.time * WALK_TIME, s.prior + share) for s in shortest.values()}


def fast(noise: Noise | None) -> bool:
    """Return whether a static recording shows noise correlated over seconds: fewer samples are then independent."""
    return noise is not None and noise.source == "static" and noise.correlation_time < MIN_MODELLED_TIME_S


def _static_ratio(noise: Noise | None) -> float:
    """Return the ratio of bias wander to white noise by a static recording, mean of the axes; 0 if it shows none."""
    if noise is None or noise.source != "static" or not np.all(noise.white > 0):
        return 0.0
    return float(np.sqrt(np.mean((noise.wander / noise.white) ** 2)))


def information(noise: Noise | None, interval: float) -> float:
    """Return the effective information per sample, relative to white noise: ``1 / (1 + 2 q tau / dt)``.

    ``interval``: s, dt.
    """
    if noise is None or not fast(noise):
        return 1.0
    return 1.0 / (1.0 + 2.0 * _static_ratio(noise) ** 2 * noise.correlation_time / interval)


def constant_bias_s(noise: Noise | None, interval: float) -> float:
    """Return the time over which a bias is assumed constant, s: L with ``2 q L^2 / (pi^2 tau) = S dt``.

    At the frequency 1 / (2 L) its spectrum, ``2 q tau / (2 pi f tau)^2``, is S = ``SLOW_SPECTRUM_SHARE`` times that of
    white noise, dt. At higher frequencies white noise is larger still. Without a static recording that shows slow
    wander, L is infinite. ``interval``: s, dt.
    """
    ratio = _static_ratio(noise)
    if noise is None or ratio == 0.0 or fast(noise):
        return float("inf")
    return float(np.pi / ratio * np.sqrt(0.5 * SLOW_SPECTRUM_SHARE * noise.correlation_time * interval))


def variance_of_average(length: Values, tau: float | Values) -> Values:
    """Return the variance of a unit Gauss-Markov process averaged over ``length``: ``2 (x - 1 + exp(-x)) / x^2``."""
    x = length / tau
    large = np.where(x < 1e-3, 1.0, x)  # the series errs by x^3 / 60, the closed form by rounding / x^2
    return np.where(x < 1e-3, 1.0 - x / 3.0 + x * x / 12.0, 2.0 * (large + np.expm1(-large)) / large**2)


def _half_average(length: Values, tau: float | Values) -> Values:
    """Return ``h(x) = (1 - exp(-x)) / x`` with ``x = length / tau``."""
    x = np.maximum(length / tau, 1e-12)
    return -np.expm1(-x) / x


def block_covariance(start: Values, length: Values, tau: float | Values) -> Values:
    """Return B of blocks, all on one clock: (m, m) array, or (t, m, m) for (t,) correlation times.

    For blocks [a, b] and [c, d] that overlap, ``B = (F(b - c) - F(a - c) - F(b - d) + F(a - d)) / ((b - a) (d - c))``
    with ``F(x) = tau^2 (exp(-|x| / tau) - 1) + tau |x|``, whose second derivative is the autocorrelation.
    """
    tau = np.asarray(tau)[..., None]
    half, each = _half_average(length, tau), np.arange(len(start))
    centre = start + length / 2.0
    gap = np.abs(centre[:, None] - centre) - (length[:, None] + length) / 2.0
    B: Values = np.exp(-np.maximum(gap, 0.0) / tau[..., None]) * half[..., :, None] * half[..., None, :]
    gap[each, each] = 0.0
    if (overlapping := gap < -OVERLAP_S).any():
        rows, columns = np.nonzero(overlapping)
        one, two = (np.array([start[k], start[k] + length[k]]) for k in (rows, columns))
        x = np.abs(one[:, None] - two) / tau[..., None, None]
        F = (np.expm1(-x) + x) * np.array([[-1.0, 1.0], [1.0, -1.0]])[..., None]
        B[..., rows, columns] = tau**2 * F.sum(axis=(-3, -2)) / (length[rows] * length[columns])
    B[..., each, each] = variance_of_average(length, tau)
    return B


@dataclass(frozen=True)
class Blocks:
    """Blocks of consecutive rows."""

    first: Index  # (m,); first row of each; a block ends where the next begins
    weight: Values  # (m,); samples of each, ``1 / v``
    # each (m,), s; a block of length 0 counts as one instant: the bias does not change within it
    start: Values
    length: Values
    clock: Integers  # (m,); blocks of the same number have a known distance in time
    _models: dict[tuple[Setting, ...], GaussMarkov] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def of_rows(cls, rows: Sequence[tuple[Values, Values]], clocks: Sequence[int], length: float) -> Blocks:
        """Return stretches of time in which the bias is assumed constant, separate for each recording.

        ``rows``: times (n,), s, and samples (n,) of the rows of each recording. ``clocks``: of each recording.
        ``length``: s.
        """
        labels = [np.floor((time - time[0]) / length) for time, _ in rows]
        time, samples = (np.concatenate(each) for each in zip(*rows, strict=True))
        first = np.flatnonzero(np.concatenate([np.diff(label, prepend=-1.0) for label in labels]))
        clock = np.repeat(clocks, [len(label) for label in labels])[first]
        weight = np.add.reduceat(samples, first)
        middle = np.add.reduceat(samples * time, first) / weight
        return cls(first, weight, middle, np.zeros(len(middle)), clock)

    @cached_property
    def order(self) -> Index:
        """Return the blocks in the order of time on each clock."""
        return np.lexsort((self.start, self.clock))

    def model(self, settings: tuple[Setting, ...]) -> GaussMarkov:
        """Return C of the blocks at some settings; it is factorised once."""
        if settings not in self._models:
            self._models[settings] = GaussMarkov(self, settings)
        return self._models[settings]

    def label(self, rows: int) -> Index:
        """Return the block of each of n rows: (n,) array."""
        return np.repeat(np.arange(len(self.first)), np.diff(np.append(self.first, rows)))

    def sums(self, columns: Values) -> Values:
        """Return the sums of (n, p) columns over each block: (m, p) array."""
        ends = np.append(self.first, len(columns))
        of_rows = scipy.sparse.csr_array((np.ones(len(columns)), np.arange(len(columns)), ends))  # faster than reduceat
        return np.asarray(of_rows @ columns)

    def covariance(self, tau: float | Values) -> Values:
        """Return B: (m, m) array, or (t, m, m) for (t,) correlation times."""
        return np.asarray(block_covariance(self.start, self.length, tau) * (self.clock[:, None] == self.clock))


class GaussMarkov:
    """C at the settings of a grid: solutions, products, log determinant and draws.

    ``variance``: (m,), v; without it ``1 / weight``.
    """

    def __init__(self, blocks: Blocks, settings: Sequence[Setting], variance: Values | None = None) -> None:
        self._order = order = blocks.order
        v = (1.0 / blocks.weight if variance is None else variance)[order]
        start, length, clock = blocks.start[order], blocks.length[order], blocks.clock[order]
        q = np.array([s.ratio for s in settings])[:, None] ** 2
        times = sorted({s.time for s in settings})  # a grid repeats each time
        tau, at = np.array(times)[:, None], [times.index(s.time) for s in settings]
        of_time = _half_average(length, tau)
        same, step = clock[1:] == clock[:-1], np.maximum(np.diff(start), length[:-1])
        near = np.where(same, np.exp(-(step - length[:-1]) / tau), 0.0)[at]
        self._phi = phi = np.where(same, np.exp(-step / tau), 0.0)[at]
        self._half = h = of_time[at]
        average = variance_of_average(length, tau)[at]

        def factor(v: Values) -> tuple[Values, Values, int]:
            own = (v + q * average) / h**2
            diagonal = own.copy()
            diagonal[:, 1:] += phi * (phi * own[:, :-1] - 2.0 * q * near)
            neighbour = np.zeros_like(own)
            neighbour[:, :-1] = q * near - phi * own[:, :-1]
            return scipy.linalg.lapack.dpttrf(diagonal.ravel(), neighbour.ravel()[:-1])

        self._d, self._e, info = factor(v)
        if info:  # variances so large that their rounding exceeds the smallest: such blocks tell nothing
            self._d, self._e, info = factor(np.minimum(v, LARGEST_SPAN * max(v.min(), q.max())))
        assert info == 0  # noqa: S101  (T is a covariance)
        self.log_determinant: Values = np.sum(np.log(self._d.reshape(h.shape)) + 2.0 * np.log(of_time)[at], axis=1)

    def products(self, columns: Values) -> Values:
        """Return ``A^T C^-1 A`` of (m, p) columns: (g, p, p) array."""
        whitened = self.whitened(columns)
        return np.asarray(whitened @ whitened.transpose(0, 2, 1))

    def whitened(self, columns: Values) -> Values:
        """Return ``R A`` with ``R^T R = C^-1`` of (m, p) columns, blocks last and in order: (g, p, m) array.

        In ``z_k = own_k a_k + past_k a_(k-1) - carried_k z_(k-1)`` each factor is of one setting and block.
        """
        # blocks first, then settings and columns: numpy is fast if the last axis is long and contiguous
        axis = 2 if columns.shape[1] > len(self._half) else 1  # of the columns
        both, carried = self._factors
        pairs = np.zeros((len(columns), 2, columns.shape[1]))  # of each block, with the one before it
        pairs[:, 0] = columns[self._order]
        pairs[1:, 1] = pairs[:-1, 0]
        z = both.transpose(0, 2, 1) @ pairs if axis == 2 else pairs.transpose(0, 2, 1) @ both
        rows, part = [*z.reshape(len(z), -1)], np.empty(z[0].size)
        factors = np.broadcast_to(np.expand_dims(carried, axis), z[1:].shape)  # faster than to broadcast each
        for before, row, factor in zip(rows, rows[1:], factors.reshape(len(carried), -1), strict=False):
            np.subtract(row, np.multiply(factor, before, part), row)
        return z.transpose(3 - axis, axis, 0)

    @cached_property
    def _factors(self) -> tuple[Values, Values]:
        """The factors of ``whitened``: (m, 2, g) of a block and the one before it, (m - 1, g) of the last result."""
        root = np.sqrt(self._d.reshape(self._half.shape))
        below = np.append(self._e, 0.0).reshape(root.shape)[:, :-1]  # subdiagonal of L; T = L D L^T
        both = np.zeros((len(root.T), 2, len(root)))
        both[:, 0] = 1.0 / (self._half * root).T
        both[1:, 1] = -(self._phi / (self._half[:, :-1] * root[:, 1:])).T
        return both, np.ascontiguousarray((below * root[:, :-1] / root[:, 1:]).T)

    def squares(self, columns: Values) -> Values:
        """Return ``a^T C^-1 a`` of each of (m, p) columns: (g, p) array, without keeping what ``whitened`` returns."""
        own, past, carried = (v[..., None] for v in (*self._factors[0].swapaxes(0, 1), self._factors[1]))
        found: Values = np.empty((len(self._half), columns.shape[1]))
        size = max(1, CACHED // len(found))
        for at in (slice(first, first + size) for first in range(0, columns.shape[1], size)):
            ordered = np.ascontiguousarray(columns[self._order, at])
            z = own[0] * ordered[0]
            total, part = z * z, np.empty_like(z)
            for k in range(1, len(ordered)):
                np.multiply(carried[k - 1], z, out=z)
                np.subtract(np.multiply(own[k], ordered[k], out=part), z, out=z)
                np.add(z, np.multiply(past[k], ordered[k - 1], out=part), out=z)
                np.add(total, np.multiply(z, z, out=part), out=total)
            found[:, at] = total
        return found

    def solve(self, columns: Values) -> Values:
        """Return ``C^-1 A`` of (m, p) columns: (g, m, p) array."""
        w = columns.T[:, None, self._order] / self._half
        w[:, :, 1:] -= self._phi * w[:, :, :-1]
        solved, info = scipy.linalg.lapack.dpttrs(self._d, self._e, w.reshape(len(w), -1).T)
        assert info == 0  # noqa: S101
        solved = np.asarray(solved.T).reshape(w.shape)
        solved[:, :, :-1] -= self._phi * solved[:, :, 1:]
        return np.ascontiguousarray((solved / self._half)[:, :, np.argsort(self._order)].transpose(1, 2, 0))

    def restricted(self, design: Values, values: Values) -> tuple[Values, Values]:
        """Return the terms of the restricted likelihood of (m, c) values given the columns of a design.

        ``design``: (m, p), of full rank, see ``orthonormal``. ``values``: (m, c). Returns ``log_determinant`` (g,):
        ``log det C + log det(X^T C^-1 X)``; ``squares`` (g, c): ``y^T P y``, the weighted sum of squared residuals of
        each channel.
        """
        p = design.shape[1]
        products = self.products(np.concatenate([design, values], axis=1))
        inner, cross = products[:, :p, :p], products[:, :p, p:]
        squares = np.einsum("gcc->gc", products[:, p:, p:]) - np.sum(cross * np.linalg.solve(inner, cross), axis=1)
        logarithm: Values = self.log_determinant + np.linalg.slogdet(inner)[1]
        return logarithm, np.maximum(squares, 0.0)

    def draw(self, rng: np.random.Generator, count: int) -> Values:
        """Return block means drawn from C at the first setting: (m, count) array."""
        m = self._half.shape[1]
        own = np.sqrt(self._d[:m, None]) * rng.standard_normal((m, count))
        drawn = own.copy()
        drawn[1:] += self._e[: m - 1, None] * own[:-1]
        for k in range(1, m):
            drawn[k] += self._phi[0, k - 1] * drawn[k - 1]
        out: Values = np.empty(drawn.shape)
        out[self._order] = self._half[0, :, None] * drawn
        return out


def restricted_on_grid(
    blocks: Blocks, times: Sequence[float], ratios: Sequence[float], design: Values, values: Values
) -> tuple[Values, Values]:
    """Return ``GaussMarkov.restricted`` at each of t times with each of r rising ratios: (t r,) and (t r, c) arrays."""
    of_blocks = np.stack([blocks.weight, blocks.start, blocks.length, blocks.clock]).tobytes()

    def restricted(some: Sequence[float]) -> tuple[Values, Values]:
        logarithm, squares = _model(of_blocks, tuple(times), tuple(some)).restricted(design, values)
        return logarithm.reshape(len(times), -1), squares.reshape(len(times), len(some), -1)

    logarithm, squares = on_ratios(ratios, restricted)
    return logarithm.ravel(), squares.reshape(-1, squares.shape[-1])


def on_ratios(
    ratios: Sequence[float], restricted: Callable[[Sequence[float]], tuple[Values, Values]]
) -> tuple[Values, Values]:
    """Return log det, (..., r), and squares, (..., r, c), of a restricted likelihood at each of r rising ratios.

    log det and log squares are smooth in log q: C has the spectrum 1 + q e with e >= 0, in units of v. They are
    interpolated where fewer ratios are enough. Both are monotone in q, and so stay between those of the knots.
    """
    knots, weights = _knots(tuple(ratios))
    logarithm, squares = restricted(knots)
    known = np.concatenate([logarithm[..., None], np.log(np.maximum(squares, np.finfo(float).tiny))], axis=-1)
    found = np.clip(weights @ known, known.min(axis=-2, keepdims=True), known.max(axis=-2, keepdims=True))
    return found[..., 0], np.exp(found[..., 1:])


@lru_cache(maxsize=1)  # both sensors of a recording have the same blocks
def _model(of_blocks: bytes, times: tuple[float, ...], ratios: tuple[float, ...]) -> GaussMarkov:
    """Return C at each time with each ratio; ``of_blocks``: weight, start, length and clock of the blocks."""
    columns = np.frombuffer(of_blocks).reshape(4, -1)
    settings = [Setting(ratio, tau) for tau in times for ratio in ratios]
    return GaussMarkov(Blocks(np.arange(columns.shape[1]), *columns), settings)


@lru_cache(maxsize=4)  # grids of ratios
def _knots(ratios: tuple[float, ...]) -> tuple[list[float], Values]:
    """Return k ratios, also 0 if it is one, and the (r, k) weights of the natural quintic spline through them.

    They are the ratios themselves if the spline needs as many.
    """
    x = np.log([ratio for ratio in ratios if ratio > 0.0])
    steps = math.ceil(float(np.ptp(x)) / KNOT_STEP) if len(x) else 0
    if len(x) <= steps + 3:
        return [*ratios], np.eye(len(ratios))
    at = np.linspace(x[0], x[-1], 1 + steps)
    at = np.sort(np.append(at, [at[:2].mean(), at[-2:].mean()]))  # a natural spline bends too little at its ends
    k, zero, both = len(at), len(ratios) - len(x), np.append(at, x)
    basis = np.column_stack([np.abs(both[:, None] - at) ** 5, np.vander(both, 3)])
    conditions = np.vstack([basis[:k], np.pad(basis[:k, k:].T, ((0, 0), (0, 3)))])
    weights = (basis[k:] @ np.linalg.inv(conditions))[:, :k]
    return [0.0] * zero + np.exp(at).tolist(), scipy.linalg.block_diag(np.eye(zero), weights)


class Products:
    """Products of (n, p) columns of samples under every setting.

    ``weight``: (n,), samples of each row. ``columns``: (n, p).
    """

    def __init__(self, blocks: Blocks, weight: Values, columns: Values) -> None:
        self.blocks, self.weight, self.columns = blocks, weight, columns
        weighted = weight[:, None] * columns
        self.white: Values = columns.T @ weighted  # with roots, rounding exceeds what collinear columns leave
        self.means = blocks.sums(weighted) / blocks.weight[:, None]

    def products(self, settings: Sequence[Setting]) -> tuple[Values, Values]:
        """Return ``A^T C^-1 A``, (g, p, p), and ``log det C`` of one channel, (g,), up to that of the weights."""
        products, logarithm = np.empty((len(settings), *self.white.shape)), np.zeros(len(settings))
        wander = np.array([setting.ratio > 0.0 for setting in settings])
        products[~wander] = self.white
        if wander.any():
            model = self.blocks.model(tuple(setting for setting in settings if setting.ratio > 0.0))
            # The difference comes first: in another order, rounding exceeds the remainder of collinear columns.
            within = self.white - self.means.T @ (self.blocks.weight[:, None] * self.means)
            between = model.products(self.means)
            products[wander] = np.add(within, between, out=between)
            logarithm[wander] = model.log_determinant + np.sum(np.log(self.blocks.weight))
        return products, logarithm

    def influence(self, setting: Setting) -> Values:
        """Return ``A^T C^-1``: (p, n) array."""
        return np.asarray((self.weight[:, None] * (self.columns - self.bias(setting))).T)

    def bias(self, setting: Setting) -> Values:
        """Return ``E[bias | columns]`` of each row: (n, p) array."""
        solved = self.blocks.model((setting,)).solve(self.means)[0]
        return np.asarray((self.means - solved / self.blocks.weight[:, None])[self.blocks.label(len(self.weight))])


def orthonormal(design: Values, variance: Values, tolerance: float) -> Values:
    """Return columns that span a design, orthonormal in the metric ``1/variance``: (m, r) array.

    Directions of the unit columns whose singular value is below ``tolerance`` of the largest are left out.
    """
    root = np.sqrt(variance)[:, None]
    scaled = design / root
    u, s, _ = np.linalg.svd(scaled / np.maximum(np.linalg.norm(scaled, axis=0), 1e-300), full_matrices=False)
    return np.asarray(root * u[:, : int(np.sum(s > tolerance * s[0]))])
