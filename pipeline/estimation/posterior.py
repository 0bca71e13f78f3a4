"""Compute the probability of each effect by Bayesian model averaging over sets of effects, their sizes and the noise.

Every effect is in a set with the prior probability ``INCLUSION``. ``pipeline.estimation.evidence`` gives the evidence
of a set, which is averaged over its scales by the product of their conditionals at the best scales (Chib, JASA 90,
1995). Sets are found by a beam search, then by exchange of each member.

An upper limit is the ``BELOW`` quantile of a parameter's absolute value, given that its effect is present, over sets,
scales and noises, whatever was selected. It is stated only for effects that were not selected. At the detection size
these are two of three units (26 of 40 simulated ones), so that a share of 1/30 of all limits is 5 % of the stated ones.
Source: Hoeting et al., Statistical Science 14 (1999), 382-417; conjugate prior of Zellner.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import scipy

from pipeline.estimation.evidence import NEGLIGIBLE, SCALE_PRIOR, SCALES, Given, Pick, Problem, Set
from pipeline.estimation.free_curves import BEND
from pipeline.estimation.selection import DELAYS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from pipeline.model.effects.base import Effect
    from pipeline.records import Values

INCLUSION = 0.02  # prior probability of each effect
FIRST = 0, 3  # version and scale from which those of a set are improved
ODDS = float(np.log(INCLUSION / (1.0 - INCLUSION)))
BEAM, MOST = 6, 5  # sets that are extended, and their largest size
FAR = 12.0  # of log E below the best, beyond which a set that a beam found is not looked at any further
NEAR = 7.0  # of log E below the best, within which a set is extended, and its scales are found
MOST_NEAR, ROUNDS = 16, 3  # of these sets; of a search for the best scales, and of exchanges
CERTAIN = 0.97  # what is said of more than that: of the inclusions with 1.000, 96.6 % were right in those sensors
ENOUGH = 0.95  # of an answer set
BELOW = 29.0 / 30.0  # of an upper limit, see above
LIKELY = 0.05  # share of the best probability, above which a set counts for upper limits
HALVINGS, EXACT = 40, 1e-9  # of the interval that holds a quantile; relative
FARTHEST = 40.0  # standard deviations: beyond them the normal distribution is 0 or 1 in doubles


@dataclass(frozen=True)
class Found:
    """One set: its log posterior, up to a constant, and the best versions and scales of its members."""

    score: float
    picks: Mapping[str, Pick]
    spread: float = 0.0  # log of what averaging over the scales brings above the best ones
    final: bool = False  # whether ``picks`` are the best ones


@dataclass(frozen=True)
class Answers:
    """The results of the posterior."""

    sets: list[tuple[tuple[str, ...], float]]  # sets and their probability, the most probable first
    upper_limit: dict[str, Values]  # (k,), of the parameters in which the reading is linear

    def probability(self, name: str) -> float:
        """Return the probability that an effect is present."""
        return float(sum(weight for names, weight in self.sets if name in names))

    def answer_set(self) -> list[tuple[tuple[str, ...], float]]:
        """Return the smallest number of sets with 95 % of the probability."""
        total = np.cumsum([weight for _, weight in self.sets])
        return self.sets[: int(np.searchsorted(total, ENOUGH * total[-1])) + 1]


class Search:
    """Search for the probable sets of effects of a problem.

    ``required``: effects that are in every set. ``seeds``: sets from which the search begins.
    """

    def __init__(self, problem: Problem, required: Iterable[str] = (), seeds: Iterable[Iterable[str]] = ()) -> None:
        self.problem, self.required = problem, frozenset(required)
        self.pool: dict[Set, Found] = {}
        self._extended: set[Set] = set()
        first = [*dict.fromkeys([self.required, *(frozenset(seed) | self.required for seed in seeds)])]
        self._prune(first)
        for names in first:
            self._finish(names)
        self._beam()
        self._exchange()
        for names in self._best(MOST_NEAR, NEAR):
            self._finish(names)

    def best(self, among: Iterable[Set] = ()) -> Set:
        """Return the most probable set of all, or of some."""
        return max(among or self.pool, key=lambda names: self.pool[names].score)

    def given(self, names: Set, but: Set = frozenset()) -> Given:
        """Return the problem given a set without some of its members."""
        return Given(self.problem, [{n: pick for n, pick in self.pool[names].picks.items() if n not in but}])

    def _prune(self, seeds: Sequence[Set]) -> None:
        """Remove hypotheses without weight, given any of the sets ``seeds``."""
        kept = np.zeros(len(self.problem.prior), bool)
        for names in seeds:
            found = Given(self.problem, [dict.fromkeys(sorted(names), FIRST)])
            blocks = found.blocks(self._allowed(names))
            best = [np.maximum.reduceat(np.max(b.score[:, :, 0], axis=0), b.starts, axis=1) for b in blocks]
            each = np.concatenate([found.alone(), *best], axis=1)
            kept |= np.any(each > each.max(axis=0) + np.log(NEGLIGIBLE), axis=1)
        self.problem = self.problem.under(kept)

    def _allowed(self, names: Set) -> list[str]:
        barred = names.union(*(self.problem.excluded.get(n, frozenset()) for n in names))
        return [n for n in self.problem.versions if n not in barred]

    def _beam(self) -> None:
        level = [self.required]
        while level:
            level = self._near(sorted(self._extend(level), key=lambda names: -self.pool[names].score)[:BEAM], FAR)
            for names in level:
                self._finish(names)
            level = self._near(level, NEAR)

    def _near(self, level: list[Set], within: float) -> list[Set]:
        """Return the sets that are not far below the best of all; single effects in any case."""
        least = self.pool[self.best()].score - within
        return [n for n in level if len(n) <= len(self.required) + 1 or self.pool[n].score > least]

    def _exchange(self) -> None:
        """Replace each member of the best set by every other effect."""
        for _ in range(ROUNDS):
            best = self.best()
            self._extend([best - {name} for name in sorted(best - self.required)])  # in the same order in each process
            for names in self._best(BEAM, NEAR):
                self._finish(names)
            if self.best() == best:
                self._extend([best])
                return

    def _best(self, most: int, within: float) -> list[Set]:
        top = self.pool[self.best()].score
        near = [names for names, found in self.pool.items() if found.score > top - within]
        return sorted(near, key=lambda names: -self.pool[names].score)[:most]

    def _extend(self, level: Sequence[Set]) -> list[Set]:
        """Add every allowed effect to some sets; return the new sets."""
        level = [names for names in level if len(names) < MOST + len(self.required)]
        new = [names for names in level if names not in self._extended]
        self._extended.update(new)
        for names in new:
            self._finish(names)
        given = Given(self.problem, [self.pool[names].picks for names in new]) if new else None
        for names, found_of in zip(new, given.conditionals([*self.problem.versions]) if given else [], strict=True):
            own = self.pool[names]
            for name in self._allowed(names):
                found, child = found_of[name], names | {name}
                total = float(np.logaddexp.reduce(found, axis=None))
                score, held = total + own.spread + ODDS * len(child), self.pool.get(child)
                if held is None or (not held.final and held.score < score):
                    best, at = _largest(found)
                    spread = total - best if len(child) == 1 else 0.0
                    self.pool[child] = Found(score, {**own.picks, name: at}, spread, final=len(child) == 1)
        return list(dict.fromkeys(names | {name} for names in level for name in self._allowed(names)))

    def _finish(self, names: Set) -> None:
        """Find the best versions and scales of a set, and average over all."""
        held = self.pool.get(names)
        if held is not None and held.final:
            return
        picks: dict[str, Pick] = dict(held.picks) if held else dict.fromkeys(sorted(names), FIRST)
        spread = score = 0.0
        for _ in range(ROUNDS):
            before, spread = dict(picks), 0.0
            for name in picks:
                others = {n: pick for n, pick in picks.items() if n != name}
                each = Given(self.problem, [others]).conditionals([name])[0][name]
                score, picks[name] = _largest(each)
                spread += float(np.logaddexp.reduce(each, axis=None)) - score
            if picks == before:
                break
        if not picks:
            score = float(np.logaddexp.reduce(Given(self.problem, [{}]).alone(), axis=None))
        self.pool[names] = Found(score + spread + ODDS * len(names), picks, spread, final=True)


def _largest(each: Values) -> tuple[float, Pick]:
    """Return the largest of (versions, scales) values, and where it is."""
    v, s = divmod(int(np.argmax(each)), each.shape[1])
    return float(each[v, s]), (v, s)


def answers(searches: Sequence[Search | None], owner: Callable[[Set], int], names: Iterable[str]) -> Answers:
    """Combine the results of several searches of the same readings.

    ``searches``: None if none of its sets is possible. ``owner``: index of the search to which a set belongs.
    ``names``: effects whose upper limits are computed. Both forms of a free curve count as one.
    """
    pool = {
        key: (search, found)
        for k, search in enumerate(searches)
        if search is not None
        for key, found in search.pool.items()
        if owner(key) == k
    }
    score = np.array([found.score for _, found in pool.values()])
    weight = np.exp(score - score.max())
    weight /= weight.sum()
    order = np.argsort(-weight, kind="stable")
    keys = list(pool)
    together: dict[tuple[str, ...], float] = {}
    for i in order:
        stated = tuple(sorted(name.removesuffix(BEND) for name in keys[i]))
        together[stated] = together.get(stated, 0.0) + float(weight[i])
    sets = sorted(together.items(), key=lambda each: -each[1])
    likely = [(pool[keys[i]][0], keys[i]) for i in order[:BEAM] if weight[i] > LIKELY * weight[order[0]]]
    return Answers(sets, _upper_limits([name for name in names if not name.endswith(BEND)], likely))


def _upper_limits(names: Sequence[str], likely: Sequence[tuple[Search, Set]]) -> dict[str, Values]:
    """Return the upper limits of effects' parameters, given that each is there beside likely sets: (k,) arrays."""
    parts: dict[str, list[tuple[Values, Values, Values]]] = {}
    seen = set()
    for search, members in likely:
        asked: dict[Set, list[str]] = {}  # by the rest of the set, beside which they are
        for name in (n for n in names if n in search.problem.versions):
            barred = search.problem.excluded.get(name, frozenset())
            kept = members - ((barred | {name}) - (search.required - {name}))
            if not search.required & barred and (id(search), kept, name) not in seen:
                seen.add((id(search), kept, name))
                asked.setdefault(kept, []).append(name)
        for kept, own in asked.items():
            for name, (weight, mean, deviation) in search.given(members, members - kept).mixtures(own).items():
                limit = search.problem.limits[name]
                parts.setdefault(name, []).append((weight + ODDS * len(kept), mean * limit, deviation * limit))
    mixtures = {}
    for name in (n for n in names if n in parts):
        weight, mean, deviation = (np.concatenate(each) for each in zip(*parts[name], strict=True))
        weight = np.exp(weight - weight.max())
        weight /= weight.sum()
        kept = weight > NEGLIGIBLE
        mixtures[name] = weight[kept], mean[kept], deviation[kept]
    return dict(zip(mixtures, quantiles([*mixtures.values()]), strict=True))


def quantiles(mixtures: Sequence[tuple[Values, Values, Values]]) -> list[Values]:
    """Return the ``BELOW`` quantiles of the absolute values of k quantities, mixtures of m normal distributions.

    ``mixtures``: weights (m,), means and standard deviations (m, k). Returns a (k,) array of each.
    """
    if not mixtures:
        return []
    counts = [mean.shape[1] for _, mean, _ in mixtures]
    sizes = np.repeat([len(weight) for weight, _, _ in mixtures], counts)  # all side by side, of every quantity
    first, of = np.cumsum(sizes) - sizes, np.repeat(np.arange(len(sizes)), sizes)
    weight = np.concatenate([np.tile(each[0], k) for each, k in zip(mixtures, counts, strict=True)])
    mean = np.abs(np.concatenate([each.T.ravel() for _, each, _ in mixtures]))
    deviation = np.maximum(np.concatenate([each.T.ravel() for _, _, each in mixtures]), 1e-300)

    def total(values: Values) -> Values:
        return np.asarray(np.add.reduceat(weight * values, first))

    whole = np.add.reduceat(weight, first)
    low, high = np.zeros(len(sizes)), np.maximum.reduceat(mean + 5.0 * deviation, first)
    found = np.minimum(2.0 * np.sqrt(total(mean**2 + deviation**2) / whole), high)
    for _ in range(HALVINGS):  # of Newton, or halvings where a step of it leaves the interval
        above, beneath = (np.clip((found[of] + side * mean) / deviation, -FARTHEST, FARTHEST) for side in (-1.0, 1.0))
        off = total(scipy.special.ndtr(above) - scipy.special.ndtr(-beneath)) - BELOW * whole
        density = total((np.exp(-0.5 * above**2) + np.exp(-0.5 * beneath**2)) / deviation) / np.sqrt(2.0 * np.pi)
        low, high = np.where(off < 0.0, found, low), np.where(off < 0.0, high, found)
        following = found - off / np.maximum(density, 1e-300)
        following = np.where((following > low) & (following < high), following, 0.5 * (low + high))
        if np.all(np.abs(following - found) <= EXACT * high):
            break
        found = following
    return np.split(following, np.cumsum(counts)[:-1])


@cache
def prior_limit() -> float:
    """Return the upper limit that the prior gives without any reading, over the sensor file's limit."""
    return float(quantiles([(np.exp(SCALE_PRIOR), np.zeros((len(SCALES), 1)), SCALES[:, None])])[0][0])


def excluded(effects: Sequence[Effect]) -> dict[str, Set]:
    """Return the effects that are never in a set with each: those that contain one another, and the two delays."""
    found: dict[str, set[str]] = {this.name: set() for this in effects}
    for this in effects:
        for other in {*this.contains, *(DELAYS if this.name in DELAYS else ())} & found.keys() - {this.name}:
            found[this.name].add(other)
            found[other].add(this.name)
    return {name: frozenset(others) for name, others in found.items() if others}
