"""Detection limits: the smallest size of each effect that a selection would find, without recording anything.

An effect of size a adds a signal whose whitened sum of squares, beside the base, is ``a^2 lambda_t`` under the noise
setting t. With the expected sum of squares T_t of noise alone, the likelihood that the selection maximises is

    log L_t(a) = -N/2 log [(T_t + a^2 lambda_t) / N] - penalty_t,    T_t = s^-2 tr(C_t^-1 C)

and the gain in 2 log L that the effect brings when it is added follows, to a good approximation, a noncentral chi^2
with k degrees of freedom and noncentrality

    g(a) = 2 [max_t log L_t(0) - max_t log L_t(a)]

so that a wander which can explain the effect takes it. The effect is found where the gain passes the gate,

    P(found) = P(chi^2_k(g) > max(k log N + 10, quantile of chi^2_k at 1 - 0.01/m))

and named where no look-alike i, which leaves the share r_i of the signal, has the better BIC: their difference is
normal with mean ``g_i - (k - k_i) (log N - 1)`` and variance ``4 g_i``, g_i the gain over the look-alike, as g above.

where

N   : readings, three axes together
C   : covariance of the noise by the data sheet; C_t that of noise setting t; s the white noise
k   : parameters of the effect, as far as the motion excites them
m   : number of candidates

The parameters are in proportion to their limits, all with random signs: every probability is the mean over the signs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.estimation.gauss_markov import GaussMarkov, Setting
from pipeline.estimation.ranking import RIDGE
from pipeline.estimation.selection import ALIKE, DELAYS, GATE_BIC, GATE_P

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.gauss_markov import Blocks
    from pipeline.estimation.ranking import Ranking
    from pipeline.estimation.selection import Selection
    from pipeline.model.effects.base import Effect
    from pipeline.records import Noise

    Values = NDArray[np.float64]

STEPS = 14  # of bisection: a factor of 1e11 to 0.2 %
LEAST, LARGEST = 1e-8, 1e3  # share of the limits
ALMOST_SURE = 0.95  # share of the cases in which the size ``sure`` is found
PARTLY = 0.3  # share of a signal below which an effect cannot be preferred for having fewer parameters
MOST_SIGNS = 32  # patterns of signs; the mean over them is then within 0.1 of that over all (standard error of a share)
ROUNDING = 1e-6  # share of a signal below which what is left of it is rounding
TIED = 1e-3  # deviation of a difference in 2 log L below which two effects are the same to the selection


@dataclass(frozen=True)
class Detection:
    """What a procedure would find of one effect; sizes as shares of its limits."""

    effect: str
    unit_sizes: Values  # (p,), size of each parameter at share 1; 0 for time constants, which are fixed
    found: float  # where half of the cases pass the gate; infinite where none does
    sure: float  # where 95 % do
    named: float  # where half of the cases pass it and no look-alike is preferred
    taken_for: str | None  # the look-alike that is preferred at the size ``found``
    look_alikes: dict[str, float]  # effect to the share of the signal that it reproduces, largest first


def smallest(probability: Callable[[float], Values], wanted: float) -> float:
    """Return the smallest share at which a probability, averaged over the signs, is reached; infinite if none."""
    low, high = np.log(LEAST), np.log(LARGEST)
    if np.mean(probability(LARGEST)) < wanted:
        return float("inf")
    for _ in range(STEPS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if np.mean(probability(float(np.exp(middle)))) >= wanted else (middle, high)
    return float(np.exp(high))


def limits_or_none(effects: Iterable[Effect], sensor: str, limits: Mapping[str, Values]) -> dict[str, Values]:
    """Return the limits of every effect's parameters, (p,) each, infinite where an effect (a user's own) has none."""
    return {this.name: limits.get(this.name, np.full(len(this.parameters(sensor)), np.inf)) for this in effects}


@dataclass(frozen=True)
class _Rivals:
    """The r effects that reproduce a part of a signal."""

    names: list[str]
    parameters: Values  # (r,)
    left: Values  # (t, r, s): what they leave of the signal of each pattern of signs, under each noise setting
    first: NDArray[np.bool_]  # (r,): whether the selection prefers them where they are exactly alike


class Expectation:
    """What a selection is expected to find.

    Parameters
    ----------
    selection : Selection
        Before its first round.
    noise : Noise
        Of the readings.
    """

    def __init__(self, selection: Selection, noise: Noise) -> None:
        self.ranking: Ranking = selection.ranking
        kinds = [term.effect for term in self.ranking.candidates]
        self.limits = limits_or_none(kinds, selection.observations.sensor, selection.limits)
        true = Setting(float(np.sqrt(np.mean((noise.wander / noise.white) ** 2))), noise.correlation_time)
        blocks, samples = selection.observations.blocks, selection.observations.samples
        self.noise_sum = 3.0 * noise_sums(blocks, samples, self.ranking.settings, true)
        self._solved: dict[int, Values] = {}
        self.names = list(dict.fromkeys(term.effect.name for term in self.ranking.candidates))
        at_rest = self._log_likelihood(np.zeros(len(self.noise_sum)))
        self.setting = int(np.argmax(at_rest[1:])) + 1
        self.before = float(at_rest[self.setting])

    def _log_likelihood(self, added: Values) -> Values:
        """Return the expected log L under each noise setting with a signal in the residual: (t, ...) array."""
        shape = (-1,) + (1,) * (added.ndim - 1)
        total = self.noise_sum.reshape(shape) + added
        n = self.ranking.samples
        found: Values = -0.5 * n * np.log(total / n) - self.ranking.penalty.reshape(shape)
        return found

    def gain(self, signal: Values) -> Values:
        """Return g of signals, (t, ...), over a model without them."""
        without = self._log_likelihood(signal)[1:].max(axis=0)
        found: Values = np.maximum(2.0 * (self.before - without), 0.0)
        return found

    def detection(self, name: str, *, half_only: bool = False) -> Detection | None:
        """Return what would be found of an effect; None where the motion does not excite it.

        Parameters
        ----------
        name : str
        half_only : bool
            Leave out ``sure`` and ``named``, which are then infinite.
        """
        places = self.ranking.indices(name)
        if not places:
            return None
        j = min(places, key=self._far_from_typical)
        signs, sizes = self._signs(j), self._unit_sizes(j)
        q = self._reduced(j, sizes, signs)
        place = self.ranking.places[j]
        inner = self.ranking.products[:, place[:, None], place]
        signal = np.einsum("sk,tkl,sl->ts", q, inner, q)
        rivals = self._rivals(j, q, signal)
        k = self._parameters(j)

        def found(share: float) -> Values:
            return self._passes(self.gain(share**2 * signal), k)

        def named(share: float) -> Values:
            ahead: Values = np.min(self._ahead(rivals, share, k), axis=0, initial=1.0)
            return found(share) * ahead

        half = smallest(found, 0.5)
        ahead = np.mean(self._ahead(rivals, half, k), axis=1) if np.isfinite(half) else np.ones(len(rivals.names))
        return Detection(
            name,
            sizes,
            half,
            np.inf if half_only else smallest(found, ALMOST_SURE),
            np.inf if half_only else smallest(named, 0.5),
            rivals.names[int(np.argmin(ahead))] if np.any(ahead < 0.5) else None,
            self._alike(rivals, signal),
        )

    def _alike(self, rivals: _Rivals, signal: Values) -> dict[str, float]:
        at, shares = self.setting, dict[str, float]()
        for name, left in zip(rivals.names, rivals.left[at], strict=True):
            share = 1.0 - float(np.sum(left) / np.sum(signal[at]))
            shares[name] = max(share, shares.get(name, 0.0))
        return {n: s for n, s in sorted(shares.items(), key=lambda item: -item[1]) if s > ALIKE}

    def _parameters(self, j: int) -> int:
        """Return the parameters that the BIC counts."""
        this = self.ranking.candidates[j].effect
        return len(self.ranking.places[j]) + (0 if this.moves else len(this.nonlinear))

    def _far_from_typical(self, j: int) -> float:
        """Return how far a start's time constant is from half its limit, as a logarithm."""
        term = self.ranking.candidates[j]
        linear = self._linear(j)
        if linear == len(term.values) or term.effect.moves:
            return 0.0
        typical = 0.5 * self.limits[term.effect.name][linear:]
        return float(np.sum(np.abs(np.log(term.values[linear:] / typical))))

    def _linear(self, j: int) -> int:
        _, starts, ends = self.ranking.unreduced
        return int(ends[j] - starts[j])

    def _unit_sizes(self, j: int) -> Values:
        """Return the limits of a candidate's linear parameters, 1 where there is none: (p,) array."""
        term = self.ranking.candidates[j]
        sizes = np.zeros(len(term.values))
        limits = self.limits[term.effect.name][: self._linear(j)]
        sizes[: self._linear(j)] = np.where(np.isfinite(limits), limits, 1.0)
        return sizes

    def _signs(self, j: int) -> Values:
        """Return patterns of signs of the linear parameters, up to a common one: (s, p) array."""
        count = self._linear(j)
        if 2 ** (count - 1) <= MOST_SIGNS:
            bits = np.arange(2 ** (count - 1))[:, None] >> np.arange(count)
            return np.where(bits & 1, -1.0, 1.0)
        return np.random.default_rng(count).choice([-1.0, 1.0], (MOST_SIGNS, count))

    def _reduced(self, j: int, sizes: Values, signs: Values) -> Values:
        """Return the patterns in the candidate's own reduced columns, which are orthonormal under white noise."""
        products, starts, ends = self.ranking.unreduced
        block = slice(starts[j], ends[j])
        values = signs * sizes[: self._linear(j)]
        found: Values = values @ products[0, block, block] @ self.ranking.blocks[j]
        return found

    def _rivals(self, j: int, q: Values, signal: Values) -> _Rivals:
        """Return the effects that reproduce a part of the signals of candidate j."""
        names, parameters, lefts = [], [], []
        own_name = self.ranking.candidates[j].effect.name
        least = PARTLY * float(np.sum(signal[self.setting]))
        for i, term in enumerate(self.ranking.candidates):
            if term.effect.name == own_name or not len(self.ranking.places[i]):
                continue
            if self._explained(i, j, q, slice(self.setting, self.setting + 1)).sum() > least:
                names.append(term.effect.name)
                parameters.append(self._parameters(i))
                left = signal - self._explained(i, j, q, slice(None))
                lefts.append(np.where(left > ROUNDING * signal, left, 0.0))
        order = sorted(self.names, key=lambda name: (name in DELAYS[1:], self.names.index(name)))
        first = np.array([order.index(name) < order.index(own_name) for name in names], bool)
        stacked = np.stack(lefts, axis=1) if lefts else np.zeros((len(signal), 0, signal.shape[1]))
        return _Rivals(names, np.array(parameters, float), stacked, first)

    def _explained(self, i: int, j: int, q: Values, settings: slice) -> Values:
        """Return what candidate i explains of the signals of candidate j under some settings: (t, s) array."""
        at, place, products = self.ranking.places[i], self.ranking.places[j], self.ranking.products
        if i not in self._solved:
            own = products[:, at[:, None], at]
            own = own + RIDGE * np.einsum("tii->ti", own)[:, :, None] * np.eye(len(at))
            self._solved[i] = np.linalg.solve(own, products[:, at, :])
        cross = products[settings][:, at[:, None], place] @ q.T
        found: Values = np.sum(cross * (self._solved[i][settings][:, :, place] @ q.T), axis=1)
        return found

    def _passes(self, gain: Values, k: int) -> Values:
        """Return the probability that a gain passes the gate."""
        from scipy.special import chdtri, chndtr  # noqa: PLC0415  (0.1 s that only plans pay)

        bic = GATE_BIC + k * float(np.log(self.ranking.samples))
        gate = max(bic, float(chdtri(k, GATE_P / len(self.names))))
        found: Values = 1.0 - chndtr(gate, k, gain)
        return found

    def _ahead(self, rivals: _Rivals, share: float, k: int) -> Values:
        """Return the probability that the effect has a better BIC than each look-alike: (r, s) array."""
        from scipy.special import ndtr  # noqa: PLC0415  (as in _passes)

        if not rivals.names:
            return np.ones((0, rivals.left.shape[2]))
        more = (k - rivals.parameters)[:, None]
        over = self.gain(share**2 * rivals.left)
        mean = over - more * (float(np.log(self.ranking.samples)) - 1.0)
        deviation = np.sqrt(4.0 * over + 2.0 * np.abs(more))
        tie = np.where(rivals.first, 0.0, 1.0)[:, None]
        found: Values = np.where(deviation < TIED, tie, ndtr(mean / np.maximum(deviation, TIED)))
        return found


def noise_sums(blocks: Blocks, samples: float, settings: Sequence[Setting], true: Setting) -> Values:
    """Return ``tr(C_t^-1 C) s^2`` of one channel: that of the block means, and one for each sample beyond: (t,) array.

    Parameters
    ----------
    blocks : Blocks
    samples : float
        Of one channel.
    settings : sequence of Setting
        Those of C_t.
    true : Setting
        That of C.
    """
    trace = GaussMarkov(blocks, settings).trace_with(GaussMarkov(blocks, [true]))
    return np.asarray(samples - len(blocks.weight) + trace)
