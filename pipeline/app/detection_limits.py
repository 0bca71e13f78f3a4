"""Compute detection limits: the smallest size of each effect that a selection would find, without a recording.

The parameters of an effect are in proportion to their limits, with random signs. Every probability is the mean over the
signs. An effect is found if its gain in 2 log L passes the gate, ``pipeline.estimation.gates.min_gain``. It is named if
no look-alike i, which explains a part of its signal, has the better BIC. With N readings and k parameters:

Turns on a table (``TurntableLimits``), with many readings. Given the base, under the noise setting t, let ``a^2
lambda_t`` be the whitened sum of squares of a signal of size a, and ``T_t = s^-2 tr(C_t^-1 C)`` that of noise alone:

    log L_t(a) = -N/2 log [(T_t + a^2 lambda_t) / N] - penalty_t,    g(a) = 2 [max_t log L_t(0) - max_t log L_t(a)]
    P(found) = P(chi^2_k(g) > min_gain)

with the covariance C of the noise by the sensor file, C_t of setting t and white noise s. So a wander that can explain
the effect takes it up. The difference of two BICs is normal with mean ``g_i - (k - k_i) (log N - 1)`` and variance ``4
g_i``, where g_i is the gain over the look-alike.

Rests and moves (``RestLimits``), with few equations and unknown noise. The likelihoods of the selection are computed
for draws of

    r = a Z d + C^1/2 w,    w standard normal, C the covariance by the sensor file for a unit that rests firmly

with signs d. All sums of squares are polynomials in a, so no size a needs a new simulation.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from pipeline.core.records import Mask, Noise, Values
from pipeline.estimation.design import EffectColumns
from pipeline.estimation.gates import min_gain
from pipeline.estimation.gauss_markov import Blocks, GaussMarkov, Setting
from pipeline.estimation.multi_position import selection as by_hand
from pipeline.estimation.multi_position.fit import log_likelihood, project_out
from pipeline.estimation.multi_position.model import NoiseHypothesis
from pipeline.estimation.ranking import UNIT_COLUMN_RIDGE
from pipeline.estimation.selection import DELAYS, LOOK_ALIKE_SHARE, Selection

BISECTION_STEPS = 14  # of bisection: a factor of 1e11 to 0.2 %
MIN_LIMIT_SHARE, MAX_LIMIT_SHARE = 1e-8, 1e3  # share of the limits
ALMOST_SURE = 0.95  # share of the cases in which the size ``sure`` is found
PARTLY = 0.3  # least share of a signal that a look-alike reproduces to be preferred for having fewer parameters
MOST_SIGNS = 32  # patterns of signs; the mean over them is then within 0.1 of that over all (standard error of a share)
NOISE_DRAWS = 64  # of the noise of rests: the standard error of a share of one half is 0.06
SIGNAL_ROUNDING = 1e-6  # share of a signal: a smaller remainder of it is rounding
TIED = 1e-3  # deviation of a difference in 2 log L: with a smaller one two effects are equal to the selection


@dataclass(frozen=True)
class Detection:
    """The detection limits of one effect; sizes are shares of its limits."""

    effect: str
    unit_sizes: Values  # (p,), size of each parameter at share 1; 0 for time constants, which are fixed
    found: float  # where half of the cases pass the gate; infinite if that is never so
    sure: float  # where 95 % pass
    named: float  # where half of the cases pass and no look-alike is preferred
    taken_for: str | None  # the look-alike that is preferred at the size ``found``
    look_alikes: dict[str, float]  # share of the signal that each reproduces, largest first


@dataclass(frozen=True)
class _Signal:
    """The signal of an effect with s patterns of signs, and its r rivals; both functions are of the share of limits."""

    found: Callable[[float], Values]  # probability that it passes the gate: (s,) array
    ahead: Callable[[float], Values]  # probability that its BIC is better than that of a rival: (r, s) array
    rivals: dict[int, float]  # share of the signal that each candidate reproduces


class DetectionLimits(abc.ABC):
    """The detection limits of a selection's candidates; one effect may have candidates with several time constants."""

    def __init__(self, sensor: str, candidates: Sequence[EffectColumns], limits: Mapping[str, Values]) -> None:
        self.sensor, self.candidates = sensor, candidates
        unlimited = {t.effect.name: np.full(len(t.values), np.inf) for t in candidates}
        self.limits: dict[str, Values] = {name: limits.get(name, none) for name, none in unlimited.items()}
        self.names = list(self.limits)

    @abc.abstractmethod
    def _directions(self, j: int) -> int:
        """Return the number of directions of a candidate that the recordings show."""

    @abc.abstractmethod
    def _signal(self, j: int, sizes: Values) -> _Signal:
        """Return the signal of a candidate with parameters of some sizes and random signs."""

    def detection(self, name: str, *, half_only: bool = False) -> Detection:
        """Return the detection limits of an effect that the recordings show.

        With ``half_only``, ``sure`` and ``named`` are not computed, and are infinite.
        """

        def far_from_typical(j: int) -> float:
            """Return the distance of time constants from half their limits, as a logarithm."""
            fixed = self._fixed(j)
            return float(np.sum(np.abs(np.log(self.candidates[j].values[fixed] / (0.5 * self.limits[name][fixed])))))

        candidates = [j for j, t in enumerate(self.candidates) if t.effect.name == name and self._directions(j)]
        j = min(candidates, key=far_from_typical)
        limits = np.where(np.isfinite(self.limits[name]), self.limits[name], 1.0)
        sizes = np.where(self._fixed(j), 0.0, limits)
        signal = self._signal(j, sizes)

        def named(share: float) -> Values:
            return np.asarray(signal.found(share) * np.min(signal.ahead(share), axis=0, initial=1.0))

        half = _smallest(signal.found, 0.5)
        ahead = np.mean(signal.ahead(half), axis=1) if np.isfinite(half) else np.ones(len(signal.rivals))
        rivals = [self.candidates[i].effect.name for i in signal.rivals]
        largest = {rival: share for share, rival in sorted(zip(signal.rivals.values(), rivals, strict=True))}
        return Detection(
            name,
            sizes,
            half,
            np.inf if half_only else _smallest(signal.found, ALMOST_SURE),
            np.inf if half_only else _smallest(named, 0.5),
            rivals[int(np.argmin(ahead))] if np.any(ahead < 0.5) else None,
            {r: share for r, share in sorted(largest.items(), key=lambda item: -item[1]) if share > LOOK_ALIKE_SHARE},
        )

    def _fixed(self, j: int) -> Mask:
        """Return which parameters of a candidate are time constants: (p,) array."""
        this = self.candidates[j].effect
        return np.array([p.name in this.nonlinear and not this.moves for p in this.parameters(self.sensor)])

    def _parameters(self, j: int) -> int:
        """Return the number of parameters in the BIC of a candidate that the recordings show."""
        return self._directions(j) + int(self._fixed(j).sum())

    def _rivals(self, j: int) -> list[int]:
        """Return the candidates of other effects that the recordings show."""
        name = self.candidates[j].effect.name
        return [i for i, t in enumerate(self.candidates) if t.effect.name != name and self._directions(i)]


def _smallest(probability: Callable[[float], Values], wanted: float) -> float:
    """Return the smallest share at which the mean probability over the signs is reached; infinite if none."""
    low, high = np.log(MIN_LIMIT_SHARE), np.log(MAX_LIMIT_SHARE)
    if np.mean(probability(MAX_LIMIT_SHARE)) < wanted:
        return float("inf")
    for _ in range(BISECTION_STEPS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if np.mean(probability(float(np.exp(middle)))) >= wanted else (middle, high)
    return float(np.exp(high))


class TurntableLimits(DetectionLimits):
    """The detection limits of the first round of a selection, for readings of some noise."""

    def __init__(self, selection: Selection, noise: Noise) -> None:
        self.ranking = selection.ranking
        super().__init__(selection.observations.sensor, self.ranking.candidates, selection.limits)
        true = Setting(float(np.sqrt(np.mean((noise.wander / noise.white) ** 2))), noise.correlation_time)
        blocks, samples = selection.observations.blocks, selection.observations.samples
        self.noise_sum = 3.0 * noise_sums(blocks, samples, self.ranking.settings, true)
        self._solved: dict[int, Values] = {}
        without_effects = self._log_likelihood(np.zeros(len(self.noise_sum)))
        self.setting = int(np.argmax(without_effects[1:])) + 1
        self.before = float(without_effects[self.setting])

    def _directions(self, j: int) -> int:
        return len(self.ranking.places[j])

    def _log_likelihood(self, added: Values) -> Values:
        """Return the expected log L under each noise setting with a signal in the residual: (t, ...) array."""
        shape = (-1,) + (1,) * (added.ndim - 1)
        n = self.ranking.samples
        total = self.noise_sum.reshape(shape) + added
        return np.asarray(-0.5 * n * np.log(total / n) - self.ranking.penalty.reshape(shape))

    def _gain(self, signal: Values) -> Values:
        """Return g of signals, (t, ...), over a model without them."""
        without = self._log_likelihood(signal)[1:].max(axis=0)
        return np.asarray(np.maximum(2.0 * (self.before - without), 0.0))

    def _signal(self, j: int, sizes: Values) -> _Signal:
        q = self._patterns(j, sizes)
        place = self.ranking.places[j]
        signal = np.einsum("sk,tkl,sl->ts", q, self.ranking.products[:, place[:, None], place], q)
        whole, k = float(np.sum(signal[self.setting])), self._parameters(j)
        shares, remainders = {}, [np.zeros((len(signal), 0, signal.shape[1]))]
        for i in self._rivals(j):
            explained = self._explained(i, j, q)
            if explained[self.setting].sum() > PARTLY * whole:
                remainder = signal - explained
                remainders.append(np.where(remainder > SIGNAL_ROUNDING * signal, remainder, 0.0)[:, None])
                shares[i] = 1.0 - float(np.sum(remainders[-1][self.setting])) / whole
        remaining = np.concatenate(remainders, axis=1)
        more = k - np.array([self._parameters(i) for i in shares], float)[:, None]
        order = sorted(self.names, key=lambda name: (name in DELAYS[1:], self.names.index(name)))
        rank = {i: order.index(self.candidates[i].effect.name) for i in (j, *shares)}
        tie = np.array([0.0 if rank[i] < rank[j] else 1.0 for i in shares])[:, None]  # the first of equals is selected
        gate = min_gain(self.candidates[j].effect, self.sensor, k, self.ranking.samples, len(self.names))

        def found(share: float) -> Values:
            return np.asarray(1.0 - scipy.special.chndtr(gate, k, self._gain(share**2 * signal)))

        def ahead(share: float) -> Values:
            over = self._gain(share**2 * remaining)
            mean = over - more * (float(np.log(self.ranking.samples)) - 1.0)
            deviation = np.sqrt(4.0 * over + 2.0 * np.abs(more))
            return np.asarray(np.where(deviation < TIED, tie, scipy.special.ndtr(mean / np.maximum(deviation, TIED))))

        return _Signal(found, ahead, shares)

    def _patterns(self, j: int, sizes: Values) -> Values:
        """Return patterns of signs in a candidate's reduced columns, which are orthonormal under white noise."""
        block = self.ranking.spans[j]
        count = block.stop - block.start
        if 2 ** (count - 1) <= MOST_SIGNS:  # up to a common sign
            bits = np.arange(2 ** (count - 1))[:, None] >> np.arange(count)
            signs = np.where(bits & 1, -1.0, 1.0)
        else:
            signs = np.random.default_rng(count).choice([-1.0, 1.0], (MOST_SIGNS, count))
        return np.asarray(signs * sizes[:count] @ self.ranking.projected[0, block, block] @ self.ranking.blocks[j])

    def _explained(self, i: int, j: int, q: Values) -> Values:
        """Return the part of the signals of candidate j that candidate i explains: (t, s) array."""
        rival, place, products = self.ranking.places[i], self.ranking.places[j], self.ranking.products
        if i not in self._solved:
            inner = products[:, rival[:, None], rival]
            inner = inner + UNIT_COLUMN_RIDGE * np.einsum("tii->ti", inner)[:, :, None] * np.eye(len(rival))
            self._solved[i] = np.linalg.solve(inner, products[:, rival, :])
        cross = products[:, rival[:, None], place] @ q.T
        return np.asarray(np.sum(cross * (self._solved[i][:, :, place] @ q.T), axis=1))


def noise_sums(blocks: Blocks, samples: float, settings: Sequence[Setting], true: Setting) -> Values:
    """Return ``tr(C_t^-1 C) s^2`` of one channel, with C of the setting ``true``: (t,) array.

    It is the sum over the block means, and 1 for each further sample.
    """
    C = np.diag(1.0 / blocks.weight) + true.ratio**2 * blocks.covariance(true.time)
    traces = np.trace(GaussMarkov(blocks, settings).solve(C), axis1=1, axis2=2)
    return np.asarray(samples - len(blocks.weight) + traces)


class RestLimits(DetectionLimits):
    """The detection limits of a selection by hand in a simulated recording, for readings of some noise."""

    def __init__(self, selection: by_hand.SelectionByHand, noise: Noise) -> None:
        model = selection.model
        terms = [EffectColumns(this, v) for this in selection.candidates for v in this.starts(model.sensor)]
        super().__init__(model.sensor, terms, selection.limits)
        equations = model.equations(replace(selection.fits[0].state, terms=()), terms)
        ratio = float(np.sqrt(np.mean(noise.wander**2) / np.mean(noise.white**2)))
        C = equations.covariance(NoiseHypothesis(Setting(ratio, noise.correlation_time), (0.0,) * model.kinds))
        drawn = np.linalg.cholesky(C) @ np.random.default_rng(0).standard_normal((len(C), NOISE_DRAWS))
        together = replace(equations, candidates=[*equations.candidates, drawn])
        self.projected = project_out(together, selection.hypotheses)
        self.drawn, self.equations = self.projected.raw[-1], len(C)
        without_effects = self._scores(np.sum(self.drawn**2, axis=1))
        self.hypothesis = int(np.argmax(np.mean(without_effects, axis=1)))
        self.factors = []  # on the gain of each candidate
        for j in range(len(terms)):
            shown, fixed = self.projected.count(j, self.hypothesis), int(self._fixed(j).sum())
            factor = self.projected.correction(j, self.hypothesis, shown + fixed, equations.scatter) if shown else 0.0
            self.factors.append(factor)
        self._of_draws = [self._along(j, self.drawn) for j in range(len(terms))]

    def _directions(self, j: int) -> int:
        return self.projected.count(j, self.hypothesis) if self.factors[j] > 0.0 else 0

    def _scores(self, rss: Values) -> Values:
        return log_likelihood(rss, self.drawn.shape[1], self.projected.log_determinant[:, None])

    def _signal(self, j: int, sizes: Values) -> _Signal:
        signs = np.random.default_rng(1).choice([-1.0, 1.0], (NOISE_DRAWS, len(sizes)))
        signal = self.projected.raw[j] @ (signs * sizes).T
        total = _squares(self.drawn, signal)
        explained = {i: _squares(self._of_draws[i], self._along(i, signal)) for i in (j, *self._rivals(j))}
        power = float(np.sum(total[2][self.hypothesis]))
        shares = {i: float(np.sum(squares[2][self.hypothesis])) / power for i, squares in explained.items() if i != j}
        shares = {i: min(share, 1.0) for i, share in shares.items() if share > PARTLY}
        k, log_n = self._parameters(j), float(np.log(self.equations))
        gate = min_gain(self.candidates[j].effect, self.sensor, k, self.equations, len(self.names))

        def bic(share: float, i: int) -> Values:
            rss, drop = (a + 2.0 * share * b + share**2 * c for a, b, c in (total, explained[i]))
            gain = self._scores(rss - drop).max(axis=0) - self._scores(rss).max(axis=0)
            return np.asarray(2.0 * self.factors[i] * gain - self._parameters(i) * log_n)

        def found(share: float) -> Values:
            return np.asarray(bic(share, j) + k * log_n > gate, float)

        def ahead(share: float) -> Values:
            delta = bic(share, j)
            return np.array([delta >= bic(share, i) for i in shares], float).reshape(-1, NOISE_DRAWS)

        return _Signal(found, ahead, shares)

    def _along(self, i: int, columns: Values) -> Values:
        """Return draws or signals, (t, n, s), along the directions of candidate i: (t, p, s) array."""
        projected = self.projected
        return np.asarray(projected.orthonormal[i].transpose(0, 2, 1) @ (projected.raw[i].transpose(0, 2, 1) @ columns))


def _squares(draws: Values, signal: Values) -> tuple[Values, Values, Values]:
    """Return the squares of draws, their products with signals, and the squares of signals: each (t, s)."""
    return np.sum(draws**2, axis=1), np.sum(draws * signal, axis=1), np.sum(signal**2, axis=1)
