"""White noise and Gauss-Markov wander of rests, by restricted maximum likelihood on block means.

The samples of a rest are cut into blocks. The mean of block b and the scatter within the blocks are

    mean_b  = d_b @ beta + white e_b sqrt(v_b) + wander m_b,    cov(m_a, m_b) = B_ab(tau)
    S       = sum of squares about the block means,   E S = white^2 sum n_b (r_0 - v_b + ratio^2 (1 - B_bb))

where

    white, wander, tau : the noise model (``pipeline.records.Noise``), ``ratio = wander / white``
    r    : autocovariance of the filter's output for white noise of variance 1; v_b = variance of its mean over a block
    B    : the covariance of the averages of a unit Gauss-Markov process over the blocks' times, in closed form
    d_b  : a constant for each rest, and what a rest cannot tell from wander: temperature and warm-up
    beta : nuisance parameters, projected out, which makes the likelihood unbiased by them

One eigendecomposition of the projected B for each tau gives the likelihood at every ratio and for all axes:

    -2 log L = sum log(1 + ratio^2 e_i) + nu log(E S) + (N - p + nu) log white^2

Sources: Patterson & Thompson, Biometrika 58, 1971; for the block averages, IEEE Std 952-1997, annex C.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

BLOCKS = 60
RATIOS = np.concatenate([[0.0], np.geomspace(2e-3, 5.0, 40)])


@dataclass(frozen=True)
class Blocks:
    """Block means and scatter of rests.

    Attributes
    ----------
    start, length : (b,) arrays, s
        First sample time and duration of each block.
    count : (b,) array of int
        Samples of each.
    mean : (b, 3) array
        Less the mean of its rest.
    rest : (b,) array of int
        The rest that each belongs to.
    cut : (b,) array of bool
        Whether its rest holds two blocks or more; the mean of a single one says nothing of wander.
    scatter : (3,) array
        Sum of squares about the block means.
    """

    start: NDArray[np.float64]
    length: NDArray[np.float64]
    count: NDArray[np.int64]
    mean: NDArray[np.float64]
    rest: NDArray[np.int64]
    cut: NDArray[np.bool_]
    scatter: NDArray[np.float64]


@dataclass(frozen=True)
class Likelihood:
    """The likelihood over a grid, and white noise at each of its points.

    Attributes
    ----------
    log_likelihood : (t, r, 3) array
        At each correlation time, by ``RATIOS``, by axis.
    white : (t, r, 3) array
        The estimate at each point.
    """

    log_likelihood: NDArray[np.float64]
    white: NDArray[np.float64]


def blocks_of(rests: list[tuple[NDArray[np.float64], NDArray[np.float64]]], shortest: int) -> Blocks:
    """Cut rests into blocks.

    Parameters
    ----------
    rests : list of ((n,) array of times in s, (n, 3) array of readings)
    shortest : int
        Fewest samples of a block in a rest that is cut.
    """
    sizes = np.array([len(time) for time, _ in rests])
    size = max(shortest, int(np.ceil(sizes.sum() / BLOCKS)))
    if not np.any(sizes >= 2 * size):  # many rests, all short: cut each in two rather than none
        size = max(shortest, int(sizes.max()) // 2)
    pieces = np.maximum(1, sizes // size)
    cuts = {(n, k): np.diff(np.linspace(0, n, k + 1).astype(int)) for n, k in set(zip(sizes, pieces, strict=True))}
    counts = np.concatenate([cuts[n, k] for n, k in zip(sizes, pieces, strict=True)])
    rest = np.repeat(np.arange(len(rests)), pieces)
    time = np.concatenate([t for t, _ in rests])
    values = np.concatenate([v for _, v in rests])
    means = np.add.reduceat(values, np.concatenate([[0], np.cumsum(sizes)[:-1]])) / sizes[:, None]
    values = values - np.repeat(means, sizes, axis=0)
    first = np.concatenate([[0], np.cumsum(counts)[:-1]])
    mean = np.add.reduceat(values, first) / counts[:, None]
    scatter = np.maximum(np.sum(values * values, axis=0) - np.sum(counts[:, None] * mean * mean, axis=0), 0.0)
    length = (time[first + counts - 1] - time[first]) * counts / np.maximum(counts - 1, 1)
    return Blocks(time[first], length, counts, mean, rest, pieces[rest] > 1, scatter)


def with_scatter(blocks: Blocks, more: Blocks) -> Blocks:
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

    return Blocks(
        start=joined("start"),
        length=joined("length"),
        count=joined("count"),
        mean=joined("mean"),
        rest=np.concatenate([blocks.rest, blocks.rest.max() + 1 + more.rest]),
        cut=np.concatenate([blocks.cut, np.zeros(len(more.cut), bool)]),
        scatter=blocks.scatter + more.scatter,
    )


def variance_of_mean(covariance: NDArray[np.float64], count: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the variance of the mean of ``count`` successive samples of a stationary sequence.

    ``v_n = (r_0 + 2 sum_{l<n} (1 - l/n) r_l) / n``.

    Parameters
    ----------
    covariance : (l,) array
        Autocovariance from lag 0; 0 beyond its end.
    count : (b,) array of int
    """
    kinds, which = np.unique(count, return_inverse=True)
    lag = np.arange(len(covariance))
    weight = np.clip(1.0 - lag / kinds[:, None], 0.0, None) * np.where(lag == 0, 1.0, 2.0)
    variance: NDArray[np.float64] = (weight @ covariance / kinds)[which]
    return variance


def variance_of_average(length: NDArray[np.float64], tau: float) -> NDArray[np.float64]:
    """Return the variance of a unit Gauss-Markov process averaged over times of ``length``: (b,) array.

    ``2 (x - 1 + exp(-x)) / x^2`` with ``x = length / tau``.
    """
    x = np.maximum(length / tau, 1e-4)  # below, the cancellation costs more than the difference from 1
    variance: NDArray[np.float64] = 2.0 * (x + np.expm1(-x)) / (x * x)
    return variance


def block_covariance(start: NDArray[np.float64], length: NDArray[np.float64], tau: float) -> NDArray[np.float64]:
    """Return B: the covariance of a unit Gauss-Markov process averaged over blocks that do not overlap, (b, b) array.

    ``B_ab = exp(-gap_ab / tau) h(x_a) h(x_b)`` with ``h(x) = (1 - exp(-x)) / x``, ``x = length / tau``, and ``gap`` the
    time between the end of the earlier block and the start of the later one.
    """
    x = length / tau
    h = -np.expm1(-x) / x
    centre = start + length / 2.0
    gap = np.abs(centre[:, None] - centre) - (length[:, None] + length) / 2.0
    B: NDArray[np.float64] = np.exp(-np.maximum(gap, 0.0) / tau) * h[:, None] * h
    np.fill_diagonal(B, variance_of_average(length, tau))
    return B


def complement(design: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return an orthonormal basis of what the columns of ``design`` cannot reach: (b, b - rank) array."""
    scaled = design / np.maximum(np.linalg.norm(design, axis=0), 1e-300)
    u, s, _ = np.linalg.svd(scaled, full_matrices=True)
    return u[:, int(np.sum(s > 1e-3 * s[0])) :]


def likelihood(
    blocks: Blocks, design: NDArray[np.float64], covariance: NDArray[np.float64], correlation_times: NDArray[np.float64]
) -> Likelihood:
    """Return the likelihood of white noise and wander over the grid.

    Parameters
    ----------
    blocks : Blocks
    design : (c, p) array
        The nuisance columns d, at the c blocks that are ``cut``.
    covariance : (l,) array
        The filter's autocovariance r.
    correlation_times : (t,) array, s
    """
    v = variance_of_mean(covariance, blocks.count)
    within = float(np.sum(blocks.count * (covariance[0] - v)))
    correlated = covariance[0] ** 2 / (covariance[0] ** 2 + 2.0 * np.sum(covariance[1:] ** 2))
    nu = max(float(np.sum(blocks.count - 1)) * correlated, 1e-9)
    root = np.sqrt(v[blocks.cut])
    places = np.stack([blocks.start[blocks.cut], blocks.length[blocks.cut], root, *design.T])
    Q, spectra = _spectra(places.tobytes(), len(places), correlation_times.tobytes())
    z = Q.T @ (blocks.mean[blocks.cut] / root[:, None])
    squares = RATIOS**2
    shape = (len(correlation_times), len(RATIOS), 3)
    log_likelihood, white = np.empty(shape), np.empty(shape)
    for row, (tau, (e, U)) in enumerate(zip(correlation_times.tolist(), spectra, strict=True)):
        weight = 1.0 / (1.0 + np.outer(squares, np.clip(e, 0.0, None)))
        inner = np.sum(blocks.count * (1.0 - variance_of_average(blocks.length, tau)))
        expected = within + squares * inner
        total = weight @ (U.T @ z) ** 2 + nu * blocks.scatter / expected[:, None]
        variance = np.maximum(total / (len(e) + nu), 1e-18)
        white[row] = np.sqrt(variance)
        penalty = -np.sum(np.log(weight), axis=1) + nu * np.log(expected)
        log_likelihood[row] = -0.5 * (penalty[:, None] + (len(e) + nu) * np.log(variance))
    return Likelihood(log_likelihood, white)


@lru_cache(maxsize=1)  # accelerometer and gyroscope of a unit rest at the same times
def _spectra(
    places: bytes, rows: int, correlation_times: bytes
) -> tuple[NDArray[np.float64], list[tuple[NDArray[np.float64], NDArray[np.float64]]]]:
    """Return the complement Q of the design, and eigenvalues and -vectors of the projected B for each tau.

    Parameters
    ----------
    places : bytes of a (3 + p, c) array
        Start, length and ``sqrt(v)`` of each block, and the design.
    rows : int
        3 + p.
    correlation_times : bytes of a (t,) array
    """
    start, length, root, *design = np.frombuffer(places).reshape(rows, -1)
    Q = complement(np.stack(design, axis=1) / root[:, None])
    covariances = (block_covariance(start, length, tau) for tau in np.frombuffer(correlation_times).tolist())
    return Q, [np.linalg.eigh(Q.T @ (B / root[:, None] / root) @ Q) for B in covariances]
