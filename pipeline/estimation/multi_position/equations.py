"""The linear form to which rests and moves are brought, and the noise that is in it.

    r = X d + e,    cov e = k C,    C = I + S + sum_j a_j^2 diag(g_j) + c^2 D + q^2 H R H^T

where

r   : (n,) residuals of base and effects, each over the standard deviation that white noise gives it
X   : (n, p) derivatives of the model with respect to its parameters, d the step of these
S   : (n, n) what the reference, the accelerometer, has in common for several equations of the gyroscope
g_j : (n,) scatter of the rests, or of the moves, beyond white noise (tremor, creep), in units of a typical white error;
      a_j is its size
D   : (n, n) what an error of the direction of gravity at each rest does to the two moves that meet there, for errors as
      large as a typical white error of a move; c is their size (a seat that gives way, a hand that leans)
H   : (n, 3 t) what a bias of each axis in each of t stretches of time does to the equations, over its white noise
R   : (t, t) correlation of a bias wander between the stretches, averaged over each, the same for the axes
q   : wander over white noise
k   : at least 1, what is left of the scatter when the noise is chosen from a grid

By hand nobody knows beforehand how firmly a unit rests, so that ``a``, ``c``, ``q`` and ``k`` are free in all
comparisons.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from pipeline.estimation.gauss_markov import SURE, block_covariance, selection_grid

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.gauss_markov import Prior
    from pipeline.records import Noise

    Values = NDArray[np.float64]

UNLIKELY = -4.0
FACTORS = 3.0 ** np.arange(-2.0, 3.0)  # of the wander that is believed
RATIOS = (0.1, 0.3, 1.0)  # of wander to white noise, where nothing is believed of it
BESIDE = (0.0, 3.0)  # scatter of moves with which one of directions is compared
FINE = (0.0, 1.0, 3.0, 9.0, 27.0)  # of rests, and of moves, where noises are not compared for many models
LEVELS = ((0.0, 2.0, 6.0, 20.0), (0.0, 4.0, 16.0))  # of rests, and of moves


@dataclass(frozen=True)
class HandNoise:
    """One noise: wander over white noise, its correlation time in s, scatter of each kind, log weight, and c."""

    ratio: float
    time: float
    scatter: tuple[float, ...]
    belief: float
    direction: float = 0.0
    none: float = 0.0

    @property
    def prior(self) -> float:
        """Prior log weight: that of the wander, and ``none`` for each kind without scatter."""
        return self.belief + self.none * self.scatter.count(0.0)

    @property
    def levels(self) -> tuple[float, ...]:
        """Scatter of each kind, and c."""
        return *self.scatter, self.direction

    def at(self, levels: Sequence[float]) -> HandNoise:
        """Return the noise at other levels."""
        return replace(self, scatter=tuple(levels[:-1]), direction=levels[-1])

    def scaled(self, j: int, factor: float) -> HandNoise:
        """Return the noise with one of its levels multiplied."""
        return self.at([level * (factor if i == j else 1.0) for i, level in enumerate(self.levels)])


@dataclass(frozen=True)
class Equations:
    """The linear form at some parameters.

    Attributes
    ----------
    residual : (n,) array
    base : (n, b) array
        Columns of bias and matrix.
    effects : list of (n, p) array
        Columns of the effects of the model.
    candidates : list of (n, p) array
        Columns of effects that are not in it.
    scatter : (s, n) array
        The g_j.
    wander : (3, n, t) array
        H, axis by axis.
    start, length : (t,) arrays, s
        The stretches of time.
    joined : (t, t) array of bool
        Whether the time between them is known.
    error : (n,) array, g, deg/s or deg
        By how much white noise scatters each equation.
    common, direction : (n, n) array or None
        S and D.
    """

    residual: Values
    base: Values
    effects: list[Values]
    candidates: list[Values]
    scatter: Values
    wander: Values
    start: Values
    length: Values
    joined: NDArray[np.bool_]
    error: Values
    common: Values | None = None
    direction: Values | None = None
    _kernels: dict[float, Values] = field(default_factory=dict, compare=False, repr=False)

    @property
    def columns(self) -> Values:
        """Columns of the model: (n, b + p) array."""
        return np.concatenate([self.base, *self.effects], axis=1)

    def rows(self, count: int) -> Equations:
        """Return the first equations alone."""
        return Equations(
            self.residual[:count],
            self.base[:count],
            [columns[:count] for columns in self.effects],
            [columns[:count] for columns in self.candidates],
            self.scatter[:, :count],
            self.wander[:, :count],
            self.start,
            self.length,
            self.joined,
            self.error[:count],
            None if self.common is None else self.common[:count, :count],
            None if self.direction is None else self.direction[:count, :count],
        )

    def kernel(self, time: float) -> Values:
        """Return ``H R H^T`` for a correlation time: (n, n) array."""
        if time not in self._kernels:
            R = np.where(self.joined, block_covariance(self.start, self.length, time), 0.0)
            self._kernels[time] = np.sum(self.wander @ R @ self.wander.transpose(0, 2, 1), axis=0)
        return self._kernels[time]

    def covariance(self, noise: HandNoise) -> Values:
        """Return C: (n, n) array."""
        C = np.diag(1.0 + np.square(noise.scatter) @ self.scatter)
        if self.common is not None:
            C += self.common
        if self.direction is not None and noise.direction:
            C += noise.direction**2 * self.direction
        return C + noise.ratio**2 * self.kernel(noise.time) if noise.ratio else C

    def whitened(self, noise: HandNoise, values: Values) -> tuple[Values, float]:
        """Return (n, p) values with ``L^-1`` applied, where ``L L^T = C``, and log det C."""
        from scipy.linalg.lapack import dpotrf, dtrtrs  # noqa: PLC0415  (0.1 s that only fits pay)

        L, failed = dpotrf(self.covariance(noise), lower=1)
        assert failed == 0  # noqa: S101
        solved, failed = dtrtrs(L, values, lower=1)
        assert failed == 0  # noqa: S101
        return solved, 2.0 * float(np.sum(np.log(np.diag(L))))


def noises_for(noise: Noise | None, kinds: int) -> list[HandNoise]:
    """Return the noises over which likelihoods are maximised: every wander with every scatter of each kind.

    Parameters
    ----------
    noise : Noise or None
        A static recording pins the wander.
    kinds : int
        Of scatter: that of rests, and that of moves.
    """
    wanders = selection_grid(noise)
    if kinds > 1:  # beside two kinds of scatter, a wander far from that of a static rest tells nothing more
        wanders = [s for s in wanders if s.prior > UNLIKELY]
    levels: Sequence[tuple[float, ...]] = list(product(*LEVELS[:kinds]))
    noises = [HandNoise(s.ratio, s.time, level, s.prior) for s in wanders for level in levels]
    return noises + [
        replace(n, direction=c) for n in noises if kinds > 1 and n.scatter[1] == 0.0 for c in LEVELS[1][1:]
    ]


def noises_about(prior: Prior, white: float, kinds: int) -> list[HandNoise]:
    """Return the noises over which a covariance is averaged: wanders about the one that is believed.

    Parameters
    ----------
    prior : Prior
        What a static recording or a data sheet says of the wander.
    white : float, unit of the sensor
        White noise of a sample.
    kinds : int
    """
    known = prior.wander > 0.0
    wander = np.append(0.0, prior.wander * FACTORS if known else white * np.array(RATIOS))
    pairs = zip((wander / white).tolist(), prior.log_belief(wander).tolist(), strict=True)
    believed = [(ratio, belief) for ratio, belief in pairs if np.isfinite(belief)]
    none = float(np.log(SURE * (len(FINE) - 1)))  # as nobody states a scatter, none at all is believed before any
    levels = list(product(FINE, repeat=kinds))
    noises = [HandNoise(ratio, prior.time, level, b, none=none) for ratio, b in believed for level in levels]
    beside = [n for n in noises if kinds > 1 and n.scatter[1] in BESIDE]
    return noises + [replace(n, direction=c) for n in beside for c in FINE[2:]]
