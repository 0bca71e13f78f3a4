"""The likelihood of a sum of noise terms, from the cosine transform of evenly sampled readings at rest.

The orthonormal cosine transform (DCT-II) of n samples diagonalises the covariance of white noise plus a random walk of
unknown start exactly, and that of the other terms up to the ends of the recording. With the coefficients y_k, k > 0,

    y_k = sum_d beta_d z_dk + sqrt(S(w_k)) e_k,   w_k = pi k / n,   S = sum_j exp(theta_j) s_j(w)
    -2 log L = sum_k (log S_k + (y_k - z_k beta)^2 / S_k) + log det(sum_k z_k z_k^T / S_k)

where z are the transforms of what is deterministic (ramp, sinusoids, temperature), beta follows by generalised least
squares, and the last term makes the likelihood a restricted one. The mean is k = 0 and drops out. Sums over the
coefficients are formed once, in bins of equal ratio ``RATIO`` of frequency; many settings are fitted side by side by
Fisher scoring with the damping of Levenberg and Marquardt.

Sources: Strang, SIAM Review 41, 1999 (the transform); Whittle 1953; Patterson & Thompson, Biometrika 58, 1971.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from pipeline.estimation.noise_terms import MARKOV, fixed_shapes, markov_shape

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Values = NDArray[np.float64]

RATIO = 1.05  # of the edges of a bin: the spectrum of a random walk changes by a tenth, its mean by 0.2 %
LONGEST_TIME = 0.5  # correlation time, in lengths of the recording, above which a process is a random walk
STEPS = (-4.0, 1.5)  # largest changes of a logarithm in one iteration; a term that is not there falls fast
ITERATIONS, PRECISE = 40, 1e-2  # of -2 log L, promised or gained by the last step; 3.84 is 95 %
LARGEST_DAMPING = 1e4
LOG_LEAST = -690.0  # of a squared coefficient: above the smallest double


@dataclass(frozen=True)
class Spectrum:
    """Coefficients of one axis in bins of frequency.

    Attributes
    ----------
    omega, count : (b,) arrays
        Mean of w in rad a sample, and coefficients, of each bin.
    products : (b, c, c) array
        Sums over each bin of the products of y and the deterministic columns, in this order.
    interval, length : float, s
        Between samples, and of the longest stretch without a gap.
    """

    omega: Values
    count: Values
    products: Values
    interval: float
    length: float

    @cached_property
    def shapes(self) -> Values:
        """Spectra of the terms without a correlation time: (4, b) array."""
        return fixed_shapes(self.omega, self.interval)

    @property
    def size(self) -> float:
        """Number of coefficients."""
        return float(self.count.sum())

    def with_columns(self, columns: Sequence[int]) -> Spectrum:
        """Return the spectrum with only these of the deterministic columns, counted from 1."""
        index = [0, *columns]
        return replace(self, products=self.products[:, index][:, :, index])


def spectrum_of(stretches: Sequence[Values], interval: float) -> Spectrum:
    """Return the spectrum of stretches of samples: (n, c) arrays, readings first, then deterministic columns."""
    from scipy.fft import dct  # noqa: PLC0415  (0.1 s)

    omega, rows = [], []
    for values in stretches:
        n = len(values)
        rows.append(dct(values - values.mean(axis=0), axis=0, norm="ortho")[1:])
        omega.append(np.pi * np.arange(1, n) / n)
    w, y = np.concatenate(omega), np.concatenate(rows)
    if len(stretches) > 1:
        order = np.argsort(w, kind="stable")
        w, y = w[order], y[order]
    bins = np.floor(np.log(w / w[0]) / np.log(RATIO) + 1e-9)
    first = np.flatnonzero(np.diff(bins, prepend=-1.0))
    count = np.diff(np.append(first, len(w))).astype(np.float64)
    products = np.add.reduceat(y[:, :, None] * y[:, None, :], first)
    length = interval * max(len(values) for values in stretches)
    return Spectrum(np.add.reduceat(w, first) / count, count, products, interval, length)


@dataclass(frozen=True)
class Fits:
    """g sums of up to J terms, fitted side by side.

    Attributes
    ----------
    kinds : (g, J) array of int
        Of ``noise_terms.STOCHASTIC``; -1 for none.
    parameters : (g, 2 J) array
        Logarithms of the squared coefficients, then of the correlation times.
    deviance, unrestricted : (g,) arrays
        -2 log L with and without the determinant of the deterministic columns.
    beta, beta_covariance : (g, d), (g, d, d) arrays
        Of the deterministic columns.
    """

    kinds: NDArray[np.int64]
    parameters: Values
    deviance: Values
    unrestricted: Values
    total: Values  # (g, b), S
    power: Values  # (g, b), its estimate by the data times ``count``
    slopes: Values  # (g, 2 J, b), of log S by each parameter
    beta: Values
    beta_covariance: Values

    def rows(self, index: NDArray[np.int64] | NDArray[np.bool_]) -> Fits:
        """Return some of the fits."""
        return Fits(**{f.name: getattr(self, f.name)[index] for f in fields(Fits)})

    def replace(self, index: NDArray[np.int64], others: Fits) -> None:
        """Put other fits in the place of some."""
        for f in fields(Fits):
            getattr(self, f.name)[index] = getattr(others, f.name)

    def information(self, count: Values) -> Values:
        """Return the Fisher information of the parameters: (g, 2 J, 2 J) array; 1 on the diagonal for absent ones."""
        found = 0.5 * (self.slopes * count) @ self.slopes.transpose(0, 2, 1)
        absent = ~active(self.kinds)
        found[:, range(found.shape[1]), range(found.shape[1])] += np.where(absent, 1.0, 1e-12)
        return found

    def covariance(self, count: Values) -> Values:
        """Return the covariance of the parameters: (g, 2 J, 2 J) array."""
        return np.asarray(np.linalg.inv(self.information(count)), np.float64)


def active(kinds: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which parameters of (g, J) terms there are: (g, 2 J) array."""
    return np.concatenate([kinds >= 0, kinds == MARKOV], axis=1)


def evaluate(spectrum: Spectrum, kinds: NDArray[np.int64], parameters: Values) -> Fits:
    """Return likelihood and derivatives at parameters."""
    terms = kinds.shape[1]
    theta, log_time = parameters[:, :terms], parameters[:, terms:]
    shapes = np.where((kinds >= 0)[:, :, None], spectrum.shapes[np.clip(kinds, 0, MARKOV - 1)], 0.0)
    by_time = np.zeros_like(shapes)
    markov = kinds == MARKOV
    if markov.any():
        shapes[markov], by_time[markov] = markov_shape(spectrum.omega, spectrum.interval, log_time[markov])
    size = np.exp(theta)[:, :, None]
    total = np.sum(size * shapes, axis=1)
    slopes = np.concatenate([size * shapes, size * by_time], axis=1) / total[:, None, :]
    products, weight = spectrum.products, 1.0 / total
    d, g = products.shape[1] - 1, len(kinds)
    power, determinant = np.tile(products[:, 0, 0], (g, 1)), np.zeros(g)
    beta, inverse = np.zeros((g, d)), np.zeros((g, d, d))
    restricted = power
    if d:
        sums = (weight @ products.reshape(len(products), -1)).reshape(g, d + 1, d + 1)
        inner = sums[:, 1:, 1:]
        inverse, determinant = np.linalg.inv(inner), np.linalg.slogdet(inner)[1]
        beta = np.einsum("gij,gj->gi", inverse, sums[:, 1:, 0])
        signed = np.concatenate([np.ones((g, 1)), -beta], axis=1)
        outer = (signed[:, :, None] * signed[:, None, :]).reshape(g, -1)
        power = np.maximum(outer @ products.reshape(len(products), -1).T, 0.0)
        restricted = power + inverse.reshape(g, -1) @ products[:, 1:, 1:].reshape(len(products), -1).T
    unrestricted = np.log(total) @ spectrum.count + np.sum(power * weight, axis=1)
    return Fits(kinds, parameters, unrestricted + determinant, unrestricted, total, restricted, slopes, beta, inverse)


def maximised(
    spectrum: Spectrum, kinds: NDArray[np.int64], start: Values, held: NDArray[np.bool_] | None = None
) -> Fits:
    """Maximise the restricted likelihood of g sums of terms.

    ``start``: (g, 2 J), see ``Fits.parameters``; ``held``: (g, 2 J), parameters that keep their start.
    """
    terms = kinds.shape[1]
    low = np.log(spectrum.interval)
    high = max(np.log(LONGEST_TIME * spectrum.length), low + 1e-6)
    free = active(kinds) if held is None else active(kinds) & ~held
    best = evaluate(spectrum, kinds, start)
    damping, running = np.full(len(kinds), 1e-2), np.arange(len(kinds))
    diagonal = np.arange(2 * terms)
    for _ in range(ITERATIONS):
        now, here = best if len(running) == len(kinds) else best.rows(running), free[running]
        gradient = 0.5 * np.sum(now.slopes * (spectrum.count - now.power / now.total)[:, None, :], axis=2)
        information = 0.5 * (now.slopes * spectrum.count) @ now.slopes.transpose(0, 2, 1)
        information *= here[:, :, None] & here[:, None, :]
        own = information[:, diagonal, diagonal]
        information[:, diagonal, diagonal] += np.where(here, damping[running, None] * own + 1e-9, 1.0)
        gradient = np.where(here, gradient, 0.0)
        step = np.clip(-np.linalg.solve(information, gradient[:, :, None])[:, :, 0], *STEPS)
        tried = now.parameters + step
        tried[:, :terms] = np.maximum(tried[:, :terms], LOG_LEAST)
        tried[:, terms:] = np.where(here[:, terms:], np.clip(tried[:, terms:], low, high), tried[:, terms:])
        new = evaluate(spectrum, kinds[running], tried)
        gain = now.deviance - new.deviance
        better = gain > 0
        best.replace(running[better], new.rows(better))
        damping[running] *= np.where(better, 0.2, 8.0)
        promised = -np.sum(gradient * step, axis=1)
        slow = better & (gain < PRECISE) & (damping[running] < 1.0)
        running = running[(promised > PRECISE) & ~slow & (damping[running] < LARGEST_DAMPING)]
        if not running.size:
            break
    return best
