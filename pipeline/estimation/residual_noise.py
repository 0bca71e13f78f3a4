"""The noise that the residuals of a fit show, and the covariance that it gives an estimate.

Residuals of a fit that ignores the bias instability are correlated, and ``sigma^2 (X^T X)^-1`` would be far too small.
An estimate that is linear in the readings, ``beta = A y``, has the covariance

    s^2 (A A^T + q a B(tau) a^T)

where s, q, tau and B are the noise of ``pipeline.estimation.gauss_markov`` and ``a`` holds the columns of A summed over
each block. One calibration does not determine q and tau well. So each hypothesis of the prior's grid is weighted by its
restricted likelihood in the block means times its prior, and the covariance is averaged over them
(``pipeline.estimation.averaged_covariance``).

Where the table's stated accuracies are worse than the noise, the residuals show its errors, which have contributions of
their own in the budget. Then the directions in which these errors exceed white noise are projected out of all channels
together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import NotObservableError
from pipeline.estimation.gauss_markov import GaussMarkov, Setting
from pipeline.records import noise_of_steps

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.gauss_markov import Blocks, Prior

    Values = NDArray[np.float64]

NEGLIGIBLE = 1e-6  # weight of a hypothesis, relative to the largest, below which it does not change two digits of u
AVERAGED_OUT = 1e-3  # share of a column's size in block means, below which it does not take up their noise


@dataclass(frozen=True)
class ResidualNoise:
    """Weighted hypotheses about the noise of the residuals.

    Attributes
    ----------
    blocks : Blocks
    settings : list of Setting
        Of k hypotheses.
    weight : (k,) array
        They sum to 1.
    white_variance : (k, 3) array, square of the unit of the readings
        s^2 of each hypothesis and channel.
    spare : int
        Blocks less parameters.
    """

    blocks: Blocks
    settings: list[Setting]
    weight: Values
    white_variance: Values
    spare: int

    @property
    def white(self) -> Values:
        """Standard deviation of a white sample: (3,) array."""
        return np.asarray(np.sqrt(self.weight @ self.white_variance))

    @property
    def wander(self) -> Values:
        """Standard deviation of the bias instability: (3,) array."""
        q = np.array([s.ratio**2 for s in self.settings])
        return np.asarray(np.sqrt((self.weight * q) @ self.white_variance))

    def draws(self, rng: np.random.Generator, number: int) -> Iterator[Values]:
        """Yield noise of the likeliest hypothesis at each sample, (n, 3) arrays; the bias is even over a block."""
        best = int(np.argmax(self.weight))
        setting, rows = self.settings[best], int(self.blocks.weight.sum())
        bias = GaussMarkov(self.blocks, [Setting(1.0, setting.time)], np.zeros(len(self.blocks.weight)))
        label = self.blocks.label(rows)
        for _ in range(number):
            drawn = rng.standard_normal((rows, 3)) + setting.ratio * bias.draw(rng, 3)[label]
            yield np.sqrt(self.white_variance[best]) * drawn

    def covariances(self, A: Values) -> Values:
        """Return the covariance of ``A y`` under each hypothesis, for white noise of variance 1: (k, p, p) array.

        That of a channel is ``white_variance[:, channel, None, None]`` times this.

        Parameters
        ----------
        A : (p, n) array
            The estimate's weights of the samples.
        """
        a = self.blocks.sums(A.T)
        by_time = {tau: a.T @ self.blocks.covariance(tau) @ a for tau in {s.time for s in self.settings}}
        covariances: Values = A @ A.T + np.stack([s.ratio**2 * by_time[s.time] for s in self.settings])
        return covariances


def assess_noise(
    residuals: Values, design: Values, blocks: Blocks, prior: Prior, disturbance: Values | None = None
) -> ResidualNoise:
    """Weight the hypotheses of a prior by the residuals of a fit.

    Parameters
    ----------
    residuals : (n, 3) array
    design : (n, p) array
        Columns that were fitted; those of one channel may be more than its own.
    blocks : Blocks
    prior : Prior
    disturbance : (3 b, 3 b) array, optional
        Covariance that the table's stated errors give the sums over the blocks, channel by channel.

    Raises
    ------
    NotObservableError
        If there are no more samples than parameters.
    """
    count = blocks.weight[:, None]
    spare = len(count) - design.shape[1]
    if spare < 1:
        raise NotObservableError(
            f"{len(count)} samples determine {design.shape[1]} parameters and leave none to tell the noise by: "
            "record more samples"
        )
    size = np.sqrt(np.mean(design**2, axis=0))
    scaled = np.sqrt(count) * (blocks.sums(design) / count / np.where(size > 0, size, 1.0))
    U, s, _ = np.linalg.svd(scaled, full_matrices=disturbance is not None)
    rank = int(np.sum(s > AVERAGED_OUT * s[0]))
    means = blocks.sums(residuals) / count
    if disturbance is None:
        settings = prior.grid(float(np.sqrt(np.mean(residuals**2))))
        logarithm, squares = GaussMarkov(blocks, settings).restricted(U[:, :rank] / np.sqrt(count), means)
        free, logarithm = len(count) - rank, 3.0 * logarithm
        variance = np.maximum(squares / free, np.finfo(float).tiny)
    else:
        white = noise_of_steps(np.abs(np.diff(residuals, axis=0)))
        settings = prior.grid(float(np.sqrt(np.mean(white**2))))
        Q, z = U[:, rank:], (np.sqrt(count) * means / white).T.ravel()
        basis = _undisturbed(Q, disturbance / np.outer(*[np.outer(white, np.sqrt(count)).ravel()] * 2))
        logarithm, squares = _dense(basis, basis.T @ z, blocks, settings)
        free = spare = basis.shape[1]
        variance = np.maximum(squares / free, np.finfo(float).tiny)[:, None]
    score = -0.5 * (logarithm + free * np.log(variance).sum(axis=1)) + np.array([s.prior for s in settings])
    if disturbance is not None:
        variance = variance * white**2
    weight = np.exp(score - score.max())
    kept = np.flatnonzero(weight > NEGLIGIBLE)
    chosen = [settings[k] for k in kept]
    return ResidualNoise(blocks, chosen, weight[kept] / weight[kept].sum(), variance[kept], spare)


def _undisturbed(Q: Values, disturbance: Values) -> Values:
    """Return an orthonormal basis of all channels' block means in which a table's errors are below white noise.

    Parameters
    ----------
    Q : (b, k) array
        Basis of what the fit of one channel does not reach.
    disturbance : (3 b, 3 b) array
        Covariance of the table's errors over the variance of white noise.

    Returns
    -------
    (3 b, r) array
    """
    every = np.asarray(np.kron(np.eye(3), Q), np.float64)
    variance, directions = np.linalg.eigh(every.T @ disturbance @ every)
    return np.asarray(every @ directions[:, : max(int(np.sum(variance <= 1.0)), 1)])


def _dense(basis: Values, z: Values, blocks: Blocks, settings: Sequence[Setting]) -> tuple[Values, Values]:
    """Return log det and weighted squares of ``z ~ N(0, I + q E)`` in a subspace that mixes the channels.

    Parameters
    ----------
    basis : (3 b, r) array
    z : (r,) array
    blocks : Blocks
    settings : sequence of Setting
    """
    root = np.sqrt(blocks.weight)
    logarithm, squares = np.empty(len(settings)), np.empty(len(settings))
    channels = basis.reshape(3, len(root), -1)
    for tau in {s.time for s in settings}:
        R = root[:, None] * blocks.covariance(tau) * root
        e, U = np.linalg.eigh(np.einsum("cbi,cbj->ij", channels, R @ channels, optimize=True))
        own = np.array([k for k, s in enumerate(settings) if s.time == tau])
        spectrum = 1.0 + np.outer([settings[k].ratio ** 2 for k in own], np.clip(e, 0.0, None))
        logarithm[own] = np.log(spectrum).sum(axis=1)
        squares[own] = (1.0 / spectrum) @ (U.T @ z) ** 2
    return logarithm, squares
