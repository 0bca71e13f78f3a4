"""What the residuals of a fit say of their noise, and what that noise does to an estimate.

The noise of a channel is white noise plus a bias wander; residuals of a fit that ignores the wander are correlated, and
``sigma^2 (X^T X)^-1`` would claim far too little. In means over short blocks of samples,

    r_b = w_b + e_b,   var e_b = s^2 / n_b,   cov(w_b, w_c) = s^2 q R_bc,   R_bc ~ exp(-|t_b - t_c| / tau)

where

    n_b : samples of block b, a stretch of one recording
    s   : standard deviation of white noise, per sample and channel
    q   : variance of the wander over that of a white sample, common to the channels
    tau : correlation time of the wander, s

An estimate that is linear in the readings, ``beta = A y``, then has the covariance

    C(q, tau) = s^2 (A A^T + q a R a^T)

where ``a`` holds the columns of A summed over each block. One run of recordings does not determine q and tau well, so
they are not picked: each point of a grid is weighted by its restricted likelihood (Patterson & Thompson, Biometrika 58,
1971) times a prior about the data sheet or, sharper, about what a static recording says, and C is averaged
(``pipeline.estimation.averaged_covariance``).

On a table whose stated accuracies are worse than the noise, the residuals show its errors, which have lines of their
own in the budget. So the directions in which they exceed white noise are taken out of all channels together before.

One eigendecomposition of R, projected on what the fit cannot reach, gives the likelihood of a tau at every q.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import NotObservableError
from pipeline.records import noise_of_steps
from pipeline.signal.noise import noise_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.sample_blocks import Blocks
    from pipeline.records import Recording

DEFAULT_TIME_S = 100.0
TIMES = (0.25, 0.5, 1.0, 2.0, 4.0)  # of the correlation time that is believed
TIME_PRIOR = (0.1, 0.2, 0.4, 0.2, 0.1)
RATIOS = np.append(0.0, 10.0 ** np.arange(-2.4, 0.85, 0.1))  # of the wander's standard deviation to a white sample's
SURE = 9.0  # odds of no wander at all where none is stated; 0 where one is
NEGLIGIBLE = 1e-6
AVERAGED_OUT = 1e-3
SHEET_WIDTH = float(np.log(3.0))
SHARPEST_WIDTH = 0.15
FARTHEST = 3.0  # widths; beyond, the residuals alone decide


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

    def log_belief(self, wander: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the logarithm of what is believed of standard deviations, the first of them 0, but for a constant.

        Where none is stated, that there is none at all is believed ``SURE`` times as much as all others together.

        Parameters
        ----------
        wander : (m,) array, unit of the sensor
        """
        if self.wander <= 0.0:
            return np.append(np.log(SURE * (len(wander) - 1)), np.zeros(len(wander) - 1))
        far = np.abs(np.log(wander[1:] / self.wander)) / self.width
        return np.append(-np.inf, -0.5 * np.minimum(far, FARTHEST) ** 2)


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
    found = noise_of(sensor, recordings, settings) if static and sheet else None
    if found and found.source == "static":
        width = float(np.clip(np.sqrt(found.correlation_time / found.length), SHARPEST_WIDTH, SHEET_WIDTH))
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
    belief : (m,) array
        Logarithm of what was believed of each candidate before the residuals were seen, but for a constant.
    spare : int
        Blocks less parameters.
    correlation : dict of float to (b, b) array
        R of each tau.
    """

    blocks: Blocks
    weight: NDArray[np.float64]
    ratio: NDArray[np.float64]
    time: NDArray[np.float64]
    white_variance: NDArray[np.float64]
    belief: NDArray[np.float64]
    spare: int
    correlation: dict[float, NDArray[np.float64]]

    @property
    def white(self) -> NDArray[np.float64]:
        """Standard deviation of a white sample: (3,) array."""
        return np.sqrt(self.weight @ self.white_variance)

    @property
    def wander(self) -> NDArray[np.float64]:
        """Standard deviation of the bias wander: (3,) array."""
        return np.sqrt((self.weight * self.ratio) @ self.white_variance)

    def expected_correlation(self, prior: Prior) -> NDArray[np.float64]:
        """Return R of the correlation time that is believed: (b, b) array."""
        return self.correlation[prior.time]

    def draws(self, rng: np.random.Generator, number: int) -> Iterator[NDArray[np.float64]]:
        """Yield noise of the likeliest candidate at each sample, (n, 3) arrays; wander is even over a block."""
        best = int(np.argmax(self.weight))
        e, U = np.linalg.eigh(self.correlation[float(self.time[best])])
        root = np.sqrt(self.ratio[best]) * U * np.sqrt(np.clip(e, 0.0, None))
        for _ in range(number):
            wander = root @ rng.standard_normal((len(e), 3))
            samples = rng.standard_normal((len(self.blocks.label), 3))
            yield np.sqrt(self.white_variance[best]) * (samples + wander[self.blocks.label])

    def covariances(self, A: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the covariance of ``A y`` under each candidate, for white noise of variance 1: (m, p, p) array.

        That of a channel is ``white_variance[:, channel, None, None]`` times this.

        Parameters
        ----------
        A : (p, n) array
            The estimate's weights of the samples.
        """
        a = self.blocks.sums(A.T)
        kinds, which = np.unique(self.time, return_inverse=True)
        wander = np.stack([a.T @ self.correlation[tau] @ a for tau in kinds.tolist()])
        covariances: NDArray[np.float64] = A @ A.T + self.ratio[:, None, None] * wander[which]
        return covariances


def assess_noise(
    residuals: NDArray[np.float64],
    design: NDArray[np.float64],
    blocks: Blocks,
    prior: Prior,
    disturbance: NDArray[np.float64] | None = None,
) -> SerialNoise:
    """Weight candidate noises by the residuals of a fit.

    Parameters
    ----------
    residuals : (n, 3) array
    design : (n, p) array
        Columns that were fitted; those of one channel may be more than its own.
    blocks : Blocks
    prior : Prior
    disturbance : (3 b, 3 b) array, optional
        Covariance that the table's stated errors give the sums over the blocks, channel by channel.

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
    root = np.sqrt(blocks.count)[:, None]
    Q = _complement(root * (blocks.sums(design) / blocks.count[:, None]), design)
    z = Q.T @ (blocks.sums(residuals) / root)
    size, seen = np.sqrt(np.mean(residuals**2, axis=0)), None
    if disturbance is not None:
        size = noise_of_steps(np.abs(np.diff(residuals, axis=0)))
        scale = np.outer(size, root).ravel()
        every = np.asarray(np.kron(np.eye(3), Q), np.float64)
        seen = _undisturbed(every, disturbance / np.outer(scale, scale))
        z = seen.T @ (z / size).T.reshape(-1, 1)
        spare = len(z)
    belief = prior.log_belief(RATIOS * float(np.sqrt(np.mean(size**2))))
    correlation = {factor * prior.time: blocks.correlation(factor * prior.time) for factor in TIMES}
    scores, variances = [], []
    for R, believed in zip(correlation.values(), TIME_PRIOR, strict=True):
        E = Q.T @ (root * R * root.T) @ Q
        if seen is None:
            score, variance = _restricted_likelihood(z, E)
        else:
            score, variance = _restricted_likelihood(z, seen.T @ np.kron(np.eye(3), E) @ seen)
            variance = variance * size**2
        scores.append(score + belief + np.log(believed))
        variances.append(variance)
    weight = np.exp(np.concatenate(scores) - np.max(scores))
    kept = weight > NEGLIGIBLE
    return SerialNoise(
        blocks,
        weight[kept] / weight[kept].sum(),
        np.tile(RATIOS**2, len(TIMES))[kept],
        np.repeat(list(correlation), len(RATIOS))[kept],
        np.concatenate(variances)[kept],
        (np.tile(belief, len(TIMES)) + np.repeat(np.log(TIME_PRIOR), len(RATIOS)))[kept],
        spare,
        correlation,
    )


def _complement(means: NDArray[np.float64], design: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return an orthonormal basis of what fitted columns do not reach in block means: (b, b - q) array.

    Columns that average out within the blocks reach nothing there.
    """
    size = np.sqrt(np.mean(design**2, axis=0))
    U, s, _ = np.linalg.svd(means / np.where(size > 0, size, 1.0), full_matrices=True)
    return U[:, int(np.sum(s > AVERAGED_OUT * s[0])) :]


def _undisturbed(Q: NDArray[np.float64], disturbance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return an orthonormal basis of all channels' block means in which a table's errors are below white noise.

    Parameters
    ----------
    Q : (3 b, 3 k) array
        Basis of what the fit does not reach.
    disturbance : (3 b, 3 b) array
        Their covariance, over the variance of white noise.

    Returns
    -------
    (3 k, r) array
    """
    variance, directions = np.linalg.eigh(Q.T @ disturbance @ Q)
    return np.asarray(directions[:, : max(int(np.sum(variance <= 1.0)), 1)])


def _restricted_likelihood(
    z: NDArray[np.float64], E: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the log likelihood at each ratio, maximised over s^2 of each channel, and these s^2.

    ``z ~ N(0, s^2 (I + q E))``.
    """
    e, U = np.linalg.eigh(E)
    spectrum = 1.0 + np.outer(RATIOS**2, np.clip(e, 0.0, None))
    variance = np.maximum((1.0 / spectrum) @ (U.T @ z) ** 2 / len(e), np.finfo(float).tiny)
    score = -0.5 * (z.shape[1] * np.log(spectrum).sum(axis=1) + len(e) * np.log(variance).sum(axis=1))
    return score, variance
