"""Detection limits: the smallest size of each effect that a selection would find, without recording anything.

The parameters of an effect are in proportion to their limits, with random signs; every probability is the mean over the
signs. An effect is found where the gain in 2 log L that it brings passes the gate of the selection, and named where no
look-alike i, which leaves a part of its signal, has the better BIC. N readings, k parameters, m candidates:

Turns on a table (``TurntableLimits``), whose readings are many. With the whitened sum of squares ``a^2 lambda_t`` of a
signal of size a, given the base, and that of noise alone, ``T_t = s^-2 tr(C_t^-1 C)``, under the noise setting t,

    log L_t(a) = -N/2 log [(T_t + a^2 lambda_t) / N] - penalty_t,    g(a) = 2 [max_t log L_t(0) - max_t log L_t(a)]
    P(found) = P(chi^2_k(g) > max(k log N + 10, quantile of chi^2_k at 1 - 0.01/m))

so that a wander which can explain the effect takes it (C: covariance of the noise by the sensor file, C_t that of
setting t, s the white noise). The difference of two BICs is normal with mean ``g_i - (k - k_i) (log N - 1)`` and
variance ``4 g_i``, g_i the gain over the look-alike.

Rests and moves (``RestLimits``), whose equations are few and whose noise is not known beforehand. Draws of

    r = a Z d + C^1/2 w,    w standard normal, C the covariance by the sensor file, and a unit that rests firmly

go with signs d through the likelihoods of the selection, at any size a without a new simulation, as all sums of squares
are polynomials in a.
"""

from __future__ import annotations

import abc
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy

from pipeline.estimation.design import Term
from pipeline.estimation.gauss_markov import Blocks, GaussMarkov, Setting
from pipeline.estimation.multi_position.model import NoiseHypothesis, log_likelihood, project_out
from pipeline.estimation.ranking import RIDGE
from pipeline.estimation.selection import ALIKE, DELAYS, GATE_BIC, GATE_P, Selection

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from pipeline.estimation.multi_position import selection as by_hand
    from pipeline.records import Mask, Noise, Values

    Squares = tuple[Values, Values, Values]  # of draws, of draws with signals, of signals

STEPS = 14  # of bisection: a factor of 1e11 to 0.2 %
LEAST, LARGEST = 1e-8, 1e3  # share of the limits
ALMOST_SURE = 0.95  # share of the cases in which the size ``sure`` is found
PARTLY = 0.3  # share of a signal below which an effect cannot be preferred for having fewer parameters
MOST_SIGNS = 32  # patterns of signs; the mean over them is then within 0.1 of that over all (standard error of a share)
DRAWS = 64  # of the noise of rests: the standard error of a share of one half is 0.06
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


@dataclass(frozen=True)
class _Signal:
    """One effect with s patterns of signs, and r rivals that reproduce a part of it."""

    found: Callable[[float], Values]  # share of the limits to the probability that it passes the gate: (s,) array
    ahead: Callable[[float], Values]  # and to the probability that its BIC is better than a rival's: (r, s) array
    rivals: dict[int, float]  # candidate to the share of the signal that it reproduces


class DetectionLimits(abc.ABC):
    """What a selection is expected to find of its candidates; one effect may be there at several time constants."""

    def __init__(self, sensor: str, candidates: Sequence[Term], limits: Mapping[str, Values]) -> None:
        self.sensor, self.candidates = sensor, candidates
        self.names = list(dict.fromkeys(term.effect.name for term in candidates))
        none = {t.effect.name: np.full(len(t.values), np.inf) for t in candidates}
        self.limits: dict[str, Values] = {name: limits.get(name, none[name]) for name in self.names}

    @abc.abstractmethod
    def _directions(self, j: int) -> int:
        """Return how many directions of a candidate the recordings show."""

    @abc.abstractmethod
    def _signal(self, j: int, sizes: Values) -> _Signal:
        """Return what a candidate of some sizes adds, with random signs."""

    def detection(self, name: str, *, half_only: bool = False) -> Detection | None:
        """Return what would be found of an effect; None where the recordings do not show it.

        With ``half_only``, ``sure`` and ``named`` are left out, and infinite.
        """
        places = [j for j, t in enumerate(self.candidates) if t.effect.name == name and self._directions(j)]
        if not places:
            return None
        j = min(places, key=self._far_from_typical)
        limits = np.where(np.isfinite(self.limits[name]), self.limits[name], 1.0)
        sizes = np.where(self._fixed(j), 0.0, limits)
        signal = self._signal(j, sizes)

        def named(share: float) -> Values:
            return np.asarray(signal.found(share) * np.min(signal.ahead(share), axis=0, initial=1.0))

        half = _smallest(signal.found, 0.5)
        ahead = np.mean(signal.ahead(half), axis=1) if np.isfinite(half) else np.ones(len(signal.rivals))
        rivals = [self.candidates[i].effect.name for i in signal.rivals]
        return Detection(
            name,
            sizes,
            half,
            np.inf if half_only else _smallest(signal.found, ALMOST_SURE),
            np.inf if half_only else _smallest(named, 0.5),
            rivals[int(np.argmin(ahead))] if np.any(ahead < 0.5) else None,
            _alike(rivals, signal.rivals.values()),
        )

    def _fixed(self, j: int) -> Mask:
        """Return which parameters of a candidate are time constants: (p,) array."""
        this = self.candidates[j].effect
        return np.array([p.name in this.nonlinear and not this.moves for p in this.parameters(self.sensor)])

    def _far_from_typical(self, j: int) -> float:
        """Return how far a candidate's time constants are from half their limits, as a logarithm."""
        fixed, term = self._fixed(j), self.candidates[j]
        return float(np.sum(np.abs(np.log(term.values[fixed] / (0.5 * self.limits[term.effect.name][fixed])))))

    def _parameters(self, j: int) -> int:
        """Return the parameters that the BIC counts; 0 where the recordings do not show the candidate."""
        shown = self._directions(j)
        return shown + int(self._fixed(j).sum()) if shown else 0

    def _rivals(self, j: int) -> list[int]:
        """Return the candidates that are another effect and that the recordings show."""
        name = self.candidates[j].effect.name
        return [i for i, t in enumerate(self.candidates) if t.effect.name != name and self._directions(i)]


def _alike(names: Sequence[str], shares: Iterable[float]) -> dict[str, float]:
    """Return the largest share of each look-alike, largest first."""
    largest = {name: share for share, name in sorted(zip(shares, names, strict=True)) if share > ALIKE}
    return dict(sorted(largest.items(), key=lambda item: -item[1]))


def _smallest(probability: Callable[[float], Values], wanted: float) -> float:
    """Return the smallest share at which a probability, averaged over the signs, is reached; infinite if none."""
    low, high = np.log(LEAST), np.log(LARGEST)
    if np.mean(probability(LARGEST)) < wanted:
        return float("inf")
    for _ in range(STEPS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if np.mean(probability(float(np.exp(middle)))) >= wanted else (middle, high)
    return float(np.exp(high))


class TurntableLimits(DetectionLimits):
    """What is expected of a selection before its first round, for readings of some noise."""

    def __init__(self, selection: Selection, noise: Noise) -> None:
        self.ranking = selection.ranking
        super().__init__(selection.observations.sensor, self.ranking.candidates, selection.limits)
        true = Setting(float(np.sqrt(np.mean((noise.wander / noise.white) ** 2))), noise.correlation_time)
        blocks, samples = selection.observations.blocks, selection.observations.samples
        self.noise_sum = 3.0 * noise_sums(blocks, samples, self.ranking.settings, true)
        self._solved: dict[int, Values] = {}
        at_rest = self._log_likelihood(np.zeros(len(self.noise_sum)))
        self.setting = int(np.argmax(at_rest[1:])) + 1
        self.before = float(at_rest[self.setting])

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
        shares, lefts = {}, [np.zeros((len(signal), 0, signal.shape[1]))]
        for i in self._rivals(j):
            explained = self._explained(i, j, q)
            if explained[self.setting].sum() > PARTLY * whole:
                left = signal - explained
                lefts.append(np.where(left > ROUNDING * signal, left, 0.0)[:, None])
                shares[i] = 1.0 - float(np.sum(lefts[-1][self.setting])) / whole
        left_of = np.concatenate(lefts, axis=1)
        more = k - np.array([self._parameters(i) for i in shares], float)[:, None]
        order = sorted(self.names, key=lambda name: (name in DELAYS[1:], self.names.index(name)))
        rank = {i: order.index(self.candidates[i].effect.name) for i in (j, *shares)}
        tie = np.array([0.0 if rank[i] < rank[j] else 1.0 for i in shares])[:, None]  # the first of equals is selected

        def found(share: float) -> Values:
            return self._passes(self._gain(share**2 * signal), k)

        def ahead(share: float) -> Values:
            over = self._gain(share**2 * left_of)
            mean = over - more * (float(np.log(self.ranking.samples)) - 1.0)
            deviation = np.sqrt(4.0 * over + 2.0 * np.abs(more))
            return np.asarray(np.where(deviation < TIED, tie, scipy.special.ndtr(mean / np.maximum(deviation, TIED))))

        return _Signal(found, ahead, shares)

    def _patterns(self, j: int, sizes: Values) -> Values:
        """Return patterns of signs in the candidate's own reduced columns, which are orthonormal under white noise."""
        block = self.ranking.spans[j]
        count = block.stop - block.start
        if 2 ** (count - 1) <= MOST_SIGNS:  # up to a common sign
            bits = np.arange(2 ** (count - 1))[:, None] >> np.arange(count)
            signs = np.where(bits & 1, -1.0, 1.0)
        else:
            signs = np.random.default_rng(count).choice([-1.0, 1.0], (MOST_SIGNS, count))
        return np.asarray(signs * sizes[:count] @ self.ranking.beside[0, block, block] @ self.ranking.blocks[j])

    def _explained(self, i: int, j: int, q: Values) -> Values:
        """Return what candidate i explains of the signals of candidate j: (t, s) array."""
        at, place, products = self.ranking.places[i], self.ranking.places[j], self.ranking.products
        if i not in self._solved:
            own = products[:, at[:, None], at]
            own = own + RIDGE * np.einsum("tii->ti", own)[:, :, None] * np.eye(len(at))
            self._solved[i] = np.linalg.solve(own, products[:, at, :])
        cross = products[:, at[:, None], place] @ q.T
        return np.asarray(np.sum(cross * (self._solved[i][:, :, place] @ q.T), axis=1))

    def _passes(self, gain: Values, k: int) -> Values:
        """Return the probability that a gain passes the gate."""
        bic = GATE_BIC + k * float(np.log(self.ranking.samples))
        gate = max(bic, float(scipy.special.chdtri(k, GATE_P / len(self.names))))
        return np.asarray(1.0 - scipy.special.chndtr(gate, k, gain))


def noise_sums(blocks: Blocks, samples: float, settings: Sequence[Setting], true: Setting) -> Values:
    """Return ``tr(C_t^-1 C) s^2`` of one channel of so many samples, C that of ``true``: (t,) array.

    It is that of the block means, and one for each sample beyond.
    """
    C = np.diag(1.0 / blocks.weight) + true.ratio**2 * blocks.covariance(true.time)
    traces = np.trace(GaussMarkov(blocks, settings).solve(C), axis1=1, axis2=2)
    return np.asarray(samples - len(blocks.weight) + traces)


class RestLimits(DetectionLimits):
    """What a selection by hand, of a simulated recording, is expected to see in readings of some noise."""

    def __init__(self, selection: by_hand.Selection, noise: Noise) -> None:
        model = selection.model
        terms = [Term(this, v) for this in selection.candidates for v in this.starts(model.sensor)]
        super().__init__(model.sensor, terms, selection.limits)
        equations = model.equations(replace(selection.fits[0].state, terms=()), terms)
        ratio = float(np.sqrt(np.mean(noise.wander**2) / np.mean(noise.white**2)))
        C = equations.covariance(NoiseHypothesis(Setting(ratio, noise.correlation_time), (0.0,) * model.kinds))
        drawn = np.linalg.cholesky(C) @ np.random.default_rng(0).standard_normal((len(C), DRAWS))
        together = replace(equations, candidates=[*equations.candidates, drawn])
        self.projected = project_out(together, selection.hypotheses)
        self.drawn, self.equations = self.projected.raw[-1], len(C)
        at_rest = self._scores(np.sum(self.drawn**2, axis=1))
        self.at = int(np.argmax(np.mean(at_rest, axis=1)))
        shown = [self.projected.count(j, self.at) for j in range(len(terms))]
        more = [int(self._fixed(j).sum()) for j in range(len(terms))]
        self.factors = [
            self.projected.correction(j, self.at, v + m, equations.scatter) if v else 0.0
            for j, (v, m) in enumerate(zip(shown, more, strict=True))
        ]
        self._of_draws = [self._along(j, self.drawn) for j in range(len(terms))]

    def _directions(self, j: int) -> int:
        return self.projected.count(j, self.at) if self.factors[j] > 0.0 else 0

    def _scores(self, rss: Values) -> Values:
        return log_likelihood(rss, self.drawn.shape[1], self.projected.log_determinant[:, None])

    def _signal(self, j: int, sizes: Values) -> _Signal:
        signs = np.random.default_rng(1).choice([-1.0, 1.0], (DRAWS, len(sizes)))
        signal = self.projected.raw[j] @ (signs * sizes).T
        total = np.sum(self.drawn**2, axis=1), np.sum(self.drawn * signal, axis=1), np.sum(signal**2, axis=1)
        taken = {i: self._squares(i, signal) for i in (j, *self._rivals(j))}
        power = float(np.sum(total[2][self.at]))
        shares = {i: min(float(np.sum(taken[i][2][self.at])) / power, 1.0) for i in taken if i != j}
        shares = {i: share for i, share in shares.items() if share > PARTLY}

        def bic(share: float, i: int) -> Values:
            rss, drop = (a + 2.0 * share * b + share**2 * c for a, b, c in (total, taken[i]))
            gain = self._scores(rss - drop).max(axis=0) - self._scores(rss).max(axis=0)
            return np.asarray(2.0 * self.factors[i] * gain - self._parameters(i) * float(np.log(self.equations)))

        def found(share: float) -> Values:
            return self._passes(bic(share, j), self._parameters(j))

        def ahead(share: float) -> Values:
            mine = bic(share, j)
            return np.array([mine >= bic(share, i) for i in shares], float).reshape(-1, DRAWS)

        return _Signal(found, ahead, shares)

    def _along(self, i: int, what: Values) -> Values:
        """Return draws or signals, (t, n, s), along the directions of candidate i: (t, p, s) array."""
        projected = self.projected
        return np.asarray(projected.orthonormal[i].transpose(0, 2, 1) @ (projected.raw[i].transpose(0, 2, 1) @ what))

    def _squares(self, i: int, signal: Values) -> Squares:
        """Return what candidate i takes of draws and signals: squares, products and squares, each (t, s)."""
        of_draws, of_signal = self._of_draws[i], self._along(i, signal)
        return np.sum(of_draws**2, axis=1), np.sum(of_draws * of_signal, axis=1), np.sum(of_signal**2, axis=1)

    def _passes(self, bic: Values, k: int) -> Values:
        """Return 1 where a delta BIC passes the gate, else 0."""
        gain = bic + k * float(np.log(self.equations))
        significant = scipy.special.chdtrc(k, np.maximum(gain, 0.0)) * len(self.names) < GATE_P
        return np.asarray((bic > GATE_BIC) & significant, float)
