"""Block means and scatter of rests, and the restricted likelihood of their noise.

    mean_b = d_b beta + white sqrt(v_b) e_b + bias m_b
    S      = sum of squares about the block means,   E S = white^2 sum n_b (r_0 - v_b + ratio^2 (1 - B_bb))

where

    white, ratio, tau, B : the noise model of ``pipeline.estimation.gauss_markov``
    r    : autocovariance of the filter's output for white noise of variance 1; v_b: variance of its mean over a block
    d_b  : a constant for each rest, and what a rest cannot separate from the bias: temperature and warm-up
    beta : nuisance parameters, projected out, so that they do not bias the estimate of the noise

    -2 log L = log det C + log det(d^T C^-1 d) + nu log(E S) + (N - p + nu) log white^2

with ``nu`` degrees of freedom of S. White noise is at its maximum at every ratio and correlation time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.estimation.gauss_markov import Blocks, GaussMarkov, Setting, orthonormal, variance_of_average
from pipeline.signal.filters import variance_of_mean

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

BLOCKS = 60
RATIOS = np.concatenate([[0.0], np.geomspace(2e-3, 5.0, 40)])  # of the bias to white noise: a step is 22 %
WEAKEST_DIRECTION = 1e-3  # of unit columns, below which two nuisance columns count as one


@dataclass(frozen=True)
class Rest:
    """Times, s, and readings of a rest, and the number of its clock: rests of one number share their time."""

    time: NDArray[np.float64]
    reading: NDArray[np.float64]
    clock: int = 0


@dataclass(frozen=True)
class RestBlocks:
    """Block means and scatter of rests."""

    # each (b,), s; first sample time and duration of each block
    start: NDArray[np.float64]
    length: NDArray[np.float64]
    count: NDArray[np.int64]  # (b,); samples of each
    mean: NDArray[np.float64]  # (b, 3); less the mean of its rest
    rest: NDArray[np.int64]  # (b,); the rest that each belongs to
    clock: NDArray[np.int64]  # (b,); blocks of the same number have a known distance in time
    # (b,); whether its rest holds two blocks or more; the mean of a single one does not show the bias move
    cut: NDArray[np.bool_]
    scatter: NDArray[np.float64]  # (3,); sum of squares about the block means


@dataclass(frozen=True)
class Likelihood:
    """The likelihood over a grid, and white noise at each of its points."""

    log_likelihood: NDArray[np.float64]  # (t, r, 3); at each correlation time, by ``RATIOS``, by axis
    white: NDArray[np.float64]  # (t, r, 3); the estimate at each point


def blocks_of(rests: Sequence[Rest], shortest: int) -> RestBlocks:
    """Cut rests into blocks.

    ``shortest``: fewest samples of a block in a rest that is cut.
    """
    sizes = np.array([len(rest.time) for rest in rests])
    size = max(shortest, int(np.ceil(sizes.sum() / BLOCKS)))
    if not np.any(sizes >= 2 * size):  # many rests, all short: cut each in two rather than none
        size = max(shortest, int(sizes.max()) // 2)
    pieces = np.maximum(1, sizes // size)
    cuts = {(n, k): np.diff(np.linspace(0, n, k + 1).astype(int)) for n, k in set(zip(sizes, pieces, strict=True))}
    counts = np.concatenate([cuts[n, k] for n, k in zip(sizes, pieces, strict=True)])
    rest = np.repeat(np.arange(len(rests)), pieces)
    time = np.concatenate([r.time for r in rests])
    values = np.concatenate([r.reading for r in rests])
    clock = np.array([r.clock for r in rests])[rest]
    means = np.add.reduceat(values, np.concatenate([[0], np.cumsum(sizes)[:-1]])) / sizes[:, None]
    values = values - np.repeat(means, sizes, axis=0)
    first = np.concatenate([[0], np.cumsum(counts)[:-1]])
    mean = np.add.reduceat(values, first) / counts[:, None]
    scatter = np.maximum(np.sum(values * values, axis=0) - np.sum(counts[:, None] * mean * mean, axis=0), 0.0)
    length = (time[first + counts - 1] - time[first]) * counts / np.maximum(counts - 1, 1)
    return RestBlocks(time[first], length, counts, mean, rest, clock, pieces[rest] > 1, scatter)


def with_scatter(blocks: RestBlocks, more: RestBlocks) -> RestBlocks:
    """Return the blocks with the scatter of others added where it agrees with theirs; nothing else of them counts.

    Scatters agree where the estimates of white noise differ by less than 3 standard deviations on every axis.
    """
    nu = np.array([np.sum(b.count - 1) for b in (blocks, more)], float)
    if np.any(nu < 1) or np.any(blocks.scatter == 0) or np.any(more.scatter == 0):
        return blocks
    log_ratio = np.log(blocks.scatter / nu[0]) - np.log(more.scatter / nu[1])
    if np.any(np.abs(log_ratio) > 3.0 * np.sqrt(2.0 / nu[0] + 2.0 / nu[1])):
        return blocks

    def joined(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(blocks, name), getattr(more, name)])

    return RestBlocks(
        start=joined("start"),
        length=joined("length"),
        count=joined("count"),
        mean=joined("mean"),
        rest=np.concatenate([blocks.rest, blocks.rest.max() + 1 + more.rest]),
        clock=joined("clock"),
        cut=np.concatenate([blocks.cut, np.zeros(len(more.cut), bool)]),
        scatter=blocks.scatter + more.scatter,
    )


def likelihood(
    blocks: RestBlocks,
    design: NDArray[np.float64],
    covariance: NDArray[np.float64],
    correlation_times: NDArray[np.float64],
) -> Likelihood:
    """Return the likelihood of white noise and bias over the grid.

    ``design``: (c, p), the nuisance columns d, at the c blocks that are ``cut``. ``covariance``: (l,), the filter's
    autocovariance r. ``correlation_times``: (t,), s.
    """
    v = variance_of_mean(covariance, blocks.count)
    within = float(np.sum(blocks.count * (covariance[0] - v)))
    correlated = covariance[0] ** 2 / (covariance[0] ** 2 + 2.0 * np.sum(covariance[1:] ** 2))
    nu = max(float(np.sum(blocks.count - 1)) * correlated, 1e-9)
    cut = blocks.cut
    chosen = Blocks(np.arange(cut.sum()), 1.0 / v[cut], blocks.start[cut], blocks.length[cut], blocks.clock[cut])
    settings = [Setting(float(ratio), float(tau)) for tau in correlation_times for ratio in RATIOS]
    basis = orthonormal(design, v[cut], WEAKEST_DIRECTION)
    log_determinant, squares = GaussMarkov(chosen, settings).restricted(basis, blocks.mean[cut])
    inner = [np.sum(blocks.count * (1.0 - variance_of_average(blocks.length, tau))) for tau in correlation_times]
    expected = within + np.outer(inner, RATIOS**2).ravel()
    free = len(chosen.weight) - basis.shape[1] + nu
    variance = np.maximum((squares + nu * blocks.scatter / expected[:, None]) / free, 1e-18)
    penalty = log_determinant + nu * np.log(expected)
    log_likelihood = -0.5 * (penalty[:, None] + free * np.log(variance))
    shape = (len(correlation_times), len(RATIOS), -1)
    return Likelihood(log_likelihood.reshape(shape), np.sqrt(variance).reshape(shape))
