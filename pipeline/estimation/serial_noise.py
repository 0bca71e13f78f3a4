"""What the residuals of a fit say of their noise, and what that noise does to an estimate.

The noise of a channel is white noise plus a bias wander; residuals of a fit that ignores the wander are correlated, and
``sigma^2 (X^T X)^-1`` would claim far too little. In means over short blocks of samples,

    r_b = w_b + e_b,   var e_b = s^2 / n_b,   cov(w_b, w_c) = s^2 q R_bc,   R_bc = exp(-|t_b - t_c| / tau)

where

    n_b : samples of block b, a stretch of one recording
    s   : standard deviation of white noise, per sample and channel
    q   : variance of the wander over that of a white sample, common to the channels
    tau : correlation time of the wander, s

An estimate that is linear in the readings, ``beta = A y``, then has the covariance

    C(q, tau) = s^2 (A A^T + q a R a^T)

where ``a`` holds the columns of A summed over each block. One run of recordings does not determine q and tau well, so
they are not picked: each point of a grid is weighted by its restricted likelihood (Patterson & Thompson, Biometrika 58,
1971) times a prior about the data sheet or, sharper, about what a static recording says, and C is averaged. How much C
varies over the grid gives its degrees of freedom: a variance with a scaled inverse chi-square distribution of nu
degrees has ``var / mean^2 = 2 / (nu - 4)`` and ``mean = scale nu / (nu - 2)``.

R^-1 is tridiagonal (``pipeline.estimation.sample_blocks``), so everything is linear in the number of blocks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import NotObservableError
from pipeline.estimation.sample_blocks import cholesky, solve

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.sample_blocks import Blocks
    from pipeline.records import Recording

DEFAULT_TIME_S = 100.0
TIMES = (0.25, 0.5, 1.0, 2.0, 4.0)  # of the correlation time that is believed
TIME_PRIOR = (0.1, 0.2, 0.4, 0.2, 0.1)
# Exponents of ten of the ratio of the standard deviations of wander and white noise: first all, then about the best.
COARSE = np.arange(-2.4, 0.9, 0.4)
FINE = np.array([-0.3, -0.2, -0.1, 0.1, 0.2, 0.3])
NEGLIGIBLE = 1e-6
SHEET_WIDTH = float(np.log(3.0))
SHARPEST_WIDTH = 0.15
FARTHEST = 3.0  # widths; beyond, the residuals alone decide
NO_NOISE = 1e-13  # a residual below this share of the readings is rounding


@dataclass(frozen=True)
class Prior:
    """What is believed of the wander before the residuals are seen.

    Attributes
    ----------
    wander : float, unit of the sensor
        Its standard deviation; 0 where nothing is known.
    time : float, s
        Its correlation time.
    width : float
        Standard deviation of the logarithm of ``wander``.
    """

    wander: float = 0.0
    time: float = DEFAULT_TIME_S
    width: float = SHEET_WIDTH

    def log_density(self, wander: float) -> float:
        """Return the logarithm of what is believed of a standard deviation, but for a constant."""
        if wander <= 0 or self.wander <= 0:
            return 0.0
        return -0.5 * min(abs(float(np.log(wander / self.wander))) / self.width, FARTHEST) ** 2


def prior_of(sensor: str, recordings: Sequence[Recording], settings: Mapping[str, Any]) -> Prior:
    """Return what a static recording says of the wander, or else the data sheet.

    Parameters
    ----------
    sensor : str
    recordings : sequence of Recording
    settings : mapping
        Section ``sensor``.

    Notes
    -----
    A standard deviation from a rest of length T, about ``T / (2 tau)`` independent values, has the relative uncertainty
    ``sqrt(tau / T)``.
    """
    sheet = settings.get("sensor", {}).get(sensor) or {}
    static = [r for r in recordings if r.role == "static" and r.reading(sensor) is not None and r.samples > 1]
    if static and sheet:
        from pipeline.signal.noise import estimate_noise  # noqa: PLC0415  (only a static recording needs it)

        found = estimate_noise(sensor, static, sheet)
        length = sum(float(r.time[-1] - r.time[0]) for r in static)
        width = float(np.clip(np.sqrt(found.correlation_time / length), SHARPEST_WIDTH, SHEET_WIDTH))
        return Prior(float(np.sqrt(np.mean(found.wander**2))), found.correlation_time, width)
    return Prior(float(sheet.get("bias_wander") or 0.0), float(sheet.get("wander_time_s") or DEFAULT_TIME_S))


@dataclass(frozen=True)
class SerialNoise:
    """What residuals say of their noise: weighted candidates.

    Attributes
    ----------
    blocks : Blocks
    weight : (m,) array
        Weight of each candidate; they sum to 1.
    ratio : (m,) array
        q of each candidate.
    time : (m,) array, s
        tau of each candidate.
    white_variance : (m, 3) array, square of the unit of the readings
        s^2 of each candidate and channel.
    spare : int
        Blocks less parameters.
    """

    blocks: Blocks
    weight: NDArray[np.float64]
    ratio: NDArray[np.float64]
    time: NDArray[np.float64]
    white_variance: NDArray[np.float64]
    spare: int

    @property
    def white(self) -> NDArray[np.float64]:
        """Standard deviation of a white sample: (3,) array."""
        return np.sqrt(self.weight @ self.white_variance)

    @property
    def wander(self) -> NDArray[np.float64]:
        """Standard deviation of the bias wander: (3,) array."""
        return np.sqrt((self.weight * self.ratio) @ self.white_variance)

    def draw(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """Return noise of the likeliest candidate at each sample: (n, 3) array; wander is even over a block."""
        best = int(np.argmax(self.weight))
        step = np.exp(-np.diff(self.blocks.time) / self.time[best]) * self.blocks.joined
        wander = rng.standard_normal((len(self.blocks.count), 3))
        for b, keep in enumerate(step, start=1):
            wander[b] = keep * wander[b - 1] + np.sqrt(1.0 - keep**2) * wander[b]
        samples = (
            rng.standard_normal((len(self.blocks.label), 3)) + np.sqrt(self.ratio[best]) * wander[self.blocks.label]
        )
        noise: NDArray[np.float64] = np.sqrt(self.white_variance[best]) * samples
        return noise

    def covariances(self, A: NDArray[np.float64], channel: int) -> NDArray[np.float64]:
        """Return the covariance of ``A y`` under each candidate: (m, p, p) array.

        Parameters
        ----------
        A : (p, n) array
            The estimate's weights of the samples.
        channel : int
        """
        white = A @ A.T
        a = self.blocks.sums(A.T)
        wander = {tau: a.T @ solve(cholesky(self.blocks.precision(tau)), a) for tau in np.unique(self.time)}
        stacked: NDArray[np.float64] = np.stack(
            [white + q * wander[tau] for q, tau in zip(self.ratio, self.time, strict=True)]
        )
        stacked *= self.white_variance[:, channel, None, None]
        return stacked


def assess_noise(
    residuals: NDArray[np.float64], design: NDArray[np.float64], blocks: Blocks, prior: Prior
) -> SerialNoise:
    """Weight candidate noises by the residuals of a fit.

    Parameters
    ----------
    residuals : (n, 3) array
    design : (n, p) array
        Columns that were fitted; those of one channel may be more than its own.
    blocks : Blocks
    prior : Prior

    Returns
    -------
    SerialNoise

    Raises
    ------
    NotObservableError
        If there are no more samples than parameters.
    """
    spare = len(blocks.count) - design.shape[1]
    if spare < 1:
        raise NotObservableError(
            f"{len(blocks.count)} samples determine {design.shape[1]} parameters and leave none to tell the noise by: "
            "record more samples"
        )
    likelihood = _Likelihood(blocks.sums(residuals) / blocks.count[:, None], _basis(blocks, design), blocks)
    white = float(np.sqrt(np.mean(residuals**2)))
    weights, ratios, times, variances = [], [], [], []
    for factor, belief in zip(TIMES, TIME_PRIOR, strict=True):
        ratio, score, variance = likelihood.along(factor * prior.time, lambda r: prior.log_density(r * white))
        weights.append(score + np.log(belief * np.gradient(np.log(ratio))))
        ratios.append(ratio**2)
        times.append(np.full(len(ratio), factor * prior.time))
        variances.append(variance)
    weight = np.concatenate(weights)
    weight = np.exp(weight - weight.max())
    kept = weight > NEGLIGIBLE
    return SerialNoise(
        blocks,
        weight[kept] / weight[kept].sum(),
        np.concatenate(ratios)[kept],
        np.concatenate(times)[kept],
        np.concatenate(variances)[kept],
        spare,
    )


def combine(noise: SerialNoise, covariances: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Average the covariances of an estimate over the candidates.

    Parameters
    ----------
    noise : SerialNoise
    covariances : (m, p, p) array
        Under each candidate.

    Returns
    -------
    covariance : (p, p) array
    degrees_of_freedom : float
        Smallest over the parameters.
    """
    mean = np.tensordot(noise.weight, covariances, 1)
    variance = np.diagonal(covariances, axis1=1, axis2=2)
    average = np.diag(mean)
    known = average > 0
    if not np.any(known):
        return mean, float("inf")
    spread = noise.weight @ (variance[:, known] - average[known]) ** 2 / average[known] ** 2
    relative = float(np.max(spread))
    grid = 4.0 + 2.0 / relative if relative > 0 else np.inf
    shrink = (grid - 2.0) / grid if np.isfinite(grid) else 1.0
    return mean * shrink, 1.0 / (1.0 / noise.spare + 1.0 / grid)


def _basis(blocks: Blocks, design: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the block means of fitted columns, without what averages out: (b, q) array."""
    means = blocks.sums(design) / blocks.count[:, None]
    size = np.sqrt(np.mean(design**2, axis=0))
    U, s, _ = np.linalg.svd(means / np.where(size > 0, size, 1.0), full_matrices=False)
    return U[:, s > 1e-3 * s[0]]


@dataclass(frozen=True)
class _Likelihood:
    """The restricted likelihood of block means (b, 3), after the fit of the columns of a basis (b, q)."""

    means: NDArray[np.float64]
    basis: NDArray[np.float64]
    blocks: Blocks

    def along(
        self, correlation_time: float, belief: Callable[[float], float]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return ratios, the log likelihood plus belief of each, and s^2: coarsely over all, finely about the best."""
        precision = self.blocks.precision(correlation_time)
        half = float(np.sum(np.log(cholesky(precision)[1])))
        found: dict[float, tuple[float, NDArray[np.float64]]] = {}
        for offsets in (COARSE, FINE):
            centre = max(found, key=lambda r: found[r][0]) if found else 0.0
            for exponent in np.round(centre + offsets, 6).tolist():
                if exponent not in found:
                    score, variance = self.at(precision, 2.0 * half, 10.0 ** (2.0 * exponent))
                    found[exponent] = score + belief(10.0**exponent), variance
        order = sorted(found)
        return (
            10.0 ** np.array(order),
            np.array([found[r][0] for r in order]),
            np.array([found[r][1] for r in order]),
        )

    def at(self, precision: NDArray[np.float64], determinant: float, q: float) -> tuple[float, NDArray[np.float64]]:
        """Return the log likelihood, maximised over s^2 of each channel, and these s^2.

        ``determinant`` is the logarithm of that of R^-1. By Woodbury's identity, with D = diag(n),
        ``(D^-1 + q R)^-1 = D - D (D + R^-1 / q)^-1 D``.
        """
        count = self.blocks.count
        bands = precision / q
        bands[1] += count
        factor = cholesky(bands)
        logarithm = len(count) * np.log(q) - determinant - float(np.sum(np.log(count)))
        logarithm += 2.0 * float(np.sum(np.log(factor[1])))
        together = np.concatenate([self.means, self.basis], axis=1)
        weighted = count[:, None] * together
        gram = together.T @ weighted - weighted.T @ solve(factor, weighted)
        inner, outer = gram[3:, 3:], gram[3:, :3]
        explained = np.sum(outer * np.linalg.solve(inner, outer), axis=0)
        left = len(count) - len(inner)
        variance = np.maximum(np.diag(gram)[:3] - explained, np.finfo(float).tiny) / left
        score = -0.5 * (3.0 * (logarithm + np.linalg.slogdet(inner)[1]) + left * np.sum(np.log(variance)))
        return float(score), variance
