"""Compute the probability of each effect by Bayesian model averaging over sets of effects, their sizes and the noise.

Every effect is in a set with the prior probability ``INCLUSION``. ``pipeline.estimation.evidence`` gives the evidence
of a set, which is averaged over its scales by the product of their conditionals at the best scales (Chib, JASA 90,
1995). Sets are found by a beam search, then by exchange of each member.

An upper limit is the ``UPPER_LIMIT_SHARE`` quantile of a parameter's absolute value, given that its effect is present,
averaged over sets, scales and noises. It is stated only for effects that were not selected. At the detection size these
are two of three units (26 of 40 simulated ones), so that a share of 1/30 of all limits is 5 % of the stated ones.
Source: Hoeting et al., Statistical Science 14 (1999), 382-417; conjugate prior of Zellner.

In turns on a table, columns are computed at the fit of the selected effects. The readings are linearised there: ``y = r
+ Z p`` with the residual r, the columns Z and the values p of the selected effects. An effect of timing changes the
motion and so all columns; if sets with other timing effects are probable, the fit is repeated with these effects.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
import scipy

from pipeline.core.records import BASE_COUNT, Values
from pipeline.estimation.candidates import SECOND, SECOND_SHARE, time_constants
from pipeline.estimation.design import EffectColumns, placed
from pipeline.estimation.evidence import (
    LIMIT_SCALES,
    NEGLIGIBLE_MIXTURE_WEIGHT,
    SCALE_PRIOR,
    CandidateProblem,
    Conditional,
    EffectSet,
    Further,
    Given,
    Mixture,
    Pick,
    linear_problem,
    log_sum,
)
from pipeline.estimation.gates import MIN_ANSWER_PROBABILITY
from pipeline.estimation.gauss_markov import WHITE_SETTING
from pipeline.estimation.generalized_least_squares import JointFit, design_at, fit_terms
from pipeline.estimation.ranking import MIN_NEW_COLUMN_SHARE, without
from pipeline.estimation.selection import DELAYS, Selection
from pipeline.physics.effects import catalogue, effect
from pipeline.physics.effects.base import Effect
from pipeline.physics.effects.equations import BEND, free_curves

INCLUSION = 0.02  # prior probability of each effect
FIRST_VERSION_AND_SCALE = 0, 3  # version and scale at which the search for the best ones of a set begins
ODDS = float(np.log(INCLUSION / (1.0 - INCLUSION)))
BEAM, MAX_SET_SIZE = 6, 5  # sets that are extended, and their largest size
BEAM_LOG_EVIDENCE = 12.0  # of log E below the best, beyond which a set of the beam is not examined further
# of log E below the best, within which a set is extended, and its best scales are determined
EXTENDED_LOG_EVIDENCE = 7.0
# number of these sets; iterations of the search for the best scales, and of exchanges
MOST_NEAR, SCALE_SEARCH_ITERATIONS = 16, 3
CERTAIN = 0.97  # largest stated probability: of the inclusions with 1.000, 96.6 % were right in 738 sensors
ANSWER_SET_PROBABILITY = 0.95  # probability of an answer set
UPPER_LIMIT_SHARE = 29.0 / 30.0  # of an upper limit, see above: that of 0.95 was above the truth in 103 of 116
# share of the best probability, above which a set is used for upper limits: with twice as much, 39 of 13,922 limits in
# 208 sensors of the blind study change by more than 1 % (at most 8 %), with half as much 57
LIMIT_SET_SHARE = 0.05
QUANTILE_ITERATIONS, QUANTILE_PRECISION = 40, 1e-6  # iterations for a quantile; their relative precision
MAX_NORMAL_DEVIATIONS = 40.0  # standard deviations: beyond them the normal distribution is 0 or 1 in doubles
# probability of the sets with the same other timing effects, above which these are fitted; with half of it nothing
# changes in these sensors
WORTH_A_FIT = 0.01
MOST_FITS = 3  # of other timing effects
LEAST_LAG_S = 1e-4  # a smaller lag has the column of a time offset, whose sign is free


class Found(NamedTuple):
    """One set: its log posterior, up to a constant, and the best versions and scales of its members."""

    score: float
    picks: Mapping[str, Pick]
    spread: float = 0.0  # log of the evidence averaged over the scales, over that at the best ones
    final: bool = False  # whether ``picks`` are the best ones


@dataclass(frozen=True)
class Answers:
    """Probabilities of sets of effects, and upper limits of parameters."""

    sets: list[tuple[tuple[str, ...], float]]  # sets and their probability, the most probable first
    upper_limit: dict[str, Values]  # (k,), of the linear parameters of each effect

    def probability(self, name: str) -> float:
        """Return the probability that an effect is present."""
        return float(sum(weight for names, weight in self.sets if name in names))

    def answer_set(self) -> list[tuple[tuple[str, ...], float]]:
        """Return the fewest sets that have 95 % of the probability together."""
        total = np.cumsum([weight for _, weight in self.sets])
        return self.sets[: int(np.searchsorted(total, ANSWER_SET_PROBABILITY * total[-1])) + 1]


class SetSearch:
    """Search for the probable sets of effects of a problem.

    ``required``: effects that are in every set. ``seeds``: sets from which the search begins.
    """

    def __init__(
        self, problem: CandidateProblem, required: Iterable[str] = (), seeds: Iterable[Iterable[str]] = ()
    ) -> None:
        self.problem, self.required = problem, frozenset(required)
        self.pool: dict[EffectSet, Found] = {}
        self._known: dict[frozenset[tuple[str, Pick]], dict[str, Conditional]] = {}  # with each effect, given picks
        # all effects in addition to some sets, and the number of the set, given picks
        self._further: dict[frozenset[tuple[str, Pick]], tuple[Further, int]] = {}
        self._extended: set[EffectSet] = set()
        first = [*dict.fromkeys([self.required, *(frozenset(seed) | self.required for seed in seeds)])]
        self._prune(first)
        for names in first:
            self._finish(names)
        self._beam()
        self._exchange()
        for names in self._best(MOST_NEAR, EXTENDED_LOG_EVIDENCE):
            self._finish(names)

    def best(self, among: Iterable[EffectSet] = ()) -> EffectSet:
        """Return the most probable set of all, or of some."""
        return max(among or self.pool, key=lambda names: self.pool[names].score)

    def mixtures(self, names: EffectSet, but: EffectSet, added: Sequence[str]) -> dict[str, Mixture]:
        """Return the distribution of the parameters of further effects, given a set without some of its members."""
        picks = {n: pick for n, pick in self.pool[names].picks.items() if n not in but}
        known = self._further.get(frozenset(picks.items()))
        further, number = known or (Given(self.problem, [picks]).further(added), 0)
        return further.mixtures(number, added, self.problem)

    def _prune(self, seeds: Sequence[EffectSet]) -> None:
        """Remove the noise hypotheses that have no weight given any of the sets ``seeds``."""
        kept = np.zeros(len(self.problem.prior), bool)
        for names in seeds:
            picks = dict.fromkeys(sorted(names), FIRST_VERSION_AND_SCALE)
            given, allowed = Given(self.problem, [picks]), self._allowed(names)
            scores = given.alone()
            if allowed:
                further = given.further(allowed)
                best = np.maximum.reduceat(np.max(further.score[:, :, 0], axis=0), further.starts, axis=1)
                scores = np.concatenate([scores, best], axis=1)
                if len(allowed) == len(self.problem.versions):
                    self._further[frozenset(picks.items())] = further, 0
            kept |= np.any(scores > scores.max(axis=0) + np.log(NEGLIGIBLE_MIXTURE_WEIGHT), axis=1)
        self.problem = self.problem.under(kept)
        self._further = {key: (further.under(kept), n) for key, (further, n) in self._further.items()}

    def _allowed(self, names: EffectSet) -> list[str]:
        barred = names.union(*(self.problem.excluded.get(n, frozenset()) for n in names))
        return [n for n in self.problem.versions if n not in barred]

    def _beam(self) -> None:
        level = [self.required]
        while level:
            level = self._near(sorted(self._extend(level), key=lambda n: -self.pool[n].score)[:BEAM], BEAM_LOG_EVIDENCE)
            for names in level:
                self._finish(names)
            level = self._near(level, EXTENDED_LOG_EVIDENCE)

    def _near(self, level: list[EffectSet], within: float) -> list[EffectSet]:
        """Return the sets that are within a distance of the best of all, and all single effects."""
        least = self.pool[self.best()].score - within
        return [n for n in level if len(n) <= len(self.required) + 1 or self.pool[n].score > least]

    def _exchange(self) -> None:
        """Replace each member of the best set by every other effect."""
        for _ in range(SCALE_SEARCH_ITERATIONS):
            best = self.best()
            self._extend([best - {name} for name in sorted(best - self.required)])  # in the same order in each process
            for names in self._best(BEAM, EXTENDED_LOG_EVIDENCE):
                self._finish(names)
            if self.best() == best:
                self._extend([best])
                return

    def _best(self, most: int, within: float) -> list[EffectSet]:
        top = self.pool[self.best()].score
        near = [names for names, found in self.pool.items() if found.score > top - within]
        return sorted(near, key=lambda names: -self.pool[names].score)[:most]

    def _extend(self, level: Sequence[EffectSet]) -> list[EffectSet]:
        """Add every allowed effect to some sets; return the new sets."""
        most = MAX_SET_SIZE + len(self.required)
        level = [names for names in level if len(names) < most and self._allowed(names)]
        new = [names for names in level if names not in self._extended]
        self._extended.update(new)
        for names in new:
            self._finish(names)
        keys = {names: frozenset(self.pool[names].picks.items()) for names in new}
        unknown = [names for names in new if keys[names] not in self._further]
        if unknown:
            given = Given(self.problem, [self.pool[names].picks for names in unknown])
            further = given.further([*self.problem.versions])
            self._further |= {keys[names]: (further, number) for number, names in enumerate(unknown)}
        for names in new:
            parent, (further, number) = self.pool[names], self._further[keys[names]]
            self._known[keys[names]] = evidence = further.conditionals[number]
            for name in self._allowed(names):
                child, (total, best, pick) = names | {name}, evidence[name]
                score, known = total + parent.spread + ODDS * len(child), self.pool.get(child)
                if known is None or (not known.final and known.score < score):
                    spread = total - best if len(child) == 1 else 0.0
                    self.pool[child] = Found(score, {**parent.picks, name: pick}, spread, final=len(child) == 1)
        return list(dict.fromkeys(names | {name} for names in level for name in self._allowed(names)))

    def _finish(self, names: EffectSet) -> None:
        """Determine the best versions and scales of a set, and average over all."""
        known = self.pool.get(names)
        if known is not None and known.final:
            return
        picks: dict[str, Pick] = dict(known.picks) if known else dict.fromkeys(sorted(names), FIRST_VERSION_AND_SCALE)
        spread = score = 0.0
        for _ in range(SCALE_SEARCH_ITERATIONS):
            before, spread = dict(picks), 0.0
            for name in picks:
                others = {n: pick for n, pick in picks.items() if n != name}
                known_of = self._known.setdefault(frozenset(others.items()), {})
                if name not in known_of:
                    known_of |= Given(self.problem, [others]).further([name]).conditionals[0]
                total, score, picks[name] = known_of[name]
                spread += total - score
            if picks == before:
                break
        if not picks:
            score = float(log_sum(Given(self.problem, [{}]).alone()[:, 0], 0))
        self.pool[names] = Found(score + spread + ODDS * len(names), picks, spread, final=True)


def answers(searches: Sequence[SetSearch | None], owner: Callable[[EffectSet], int], names: Iterable[str]) -> Answers:
    """Combine the results of several searches of the same readings.

    ``searches``: None if none of its sets is possible. ``owner``: index of the search to which a set belongs.
    ``names``: effects whose upper limits are computed. Both forms of a free curve count as one.
    """
    possible = [(k, search) for k, search in enumerate(searches) if search is not None]
    pool = {key: (search, of) for k, search in possible for key, of in search.pool.items() if owner(key) == k}
    score = np.array([found.score for _, found in pool.values()])
    weight = np.exp(score - score.max())
    weight /= weight.sum()
    order = np.argsort(-weight, kind="stable")
    keys = list(pool)
    probability: dict[tuple[str, ...], float] = {}
    for i in order:
        stated = tuple(sorted(name.removesuffix(BEND) for name in keys[i]))
        probability[stated] = probability.get(stated, 0.0) + float(weight[i])
    sets = sorted(probability.items(), key=lambda each: -each[1])
    likely = [(pool[keys[i]][0], keys[i]) for i in order[:BEAM] if weight[i] > LIMIT_SET_SHARE * weight[order[0]]]
    return Answers(sets, _upper_limits([name for name in names if not name.endswith(BEND)], likely))


def _upper_limits(names: Sequence[str], likely: Sequence[tuple[SetSearch, EffectSet]]) -> dict[str, Values]:
    """Return the upper limits of effects' parameters, given that each is present in addition to likely sets."""
    parts: dict[str, list[tuple[Values, Values, Values]]] = {}
    seen = set()
    for search, members in likely:
        by_rest: dict[EffectSet, list[str]] = {}  # effects by the other members of the set
        for name in (n for n in names if n in search.problem.versions):
            barred = search.problem.excluded.get(name, frozenset())
            rest = members - ((barred | {name}) - (search.required - {name}))
            if not search.required & barred and (id(search), rest, name) not in seen:
                seen.add((id(search), rest, name))
                by_rest.setdefault(rest, []).append(name)
        for rest, added in by_rest.items():
            for name, (weight, mean, deviation) in search.mixtures(members, members - rest, added).items():
                limit = search.problem.limits[name]
                parts.setdefault(name, []).append((weight + ODDS * len(rest), mean * limit, deviation * limit))
    mixtures = {}
    for name in (n for n in names if n in parts):
        weight, mean, deviation = (np.concatenate(each) for each in zip(*parts[name], strict=True))
        weight = np.exp(weight - weight.max())
        weight /= weight.sum()
        kept = weight > NEGLIGIBLE_MIXTURE_WEIGHT
        mixtures[name] = weight[kept], mean[kept], deviation[kept]
    return dict(zip(mixtures, quantiles([*mixtures.values()]), strict=True))


def quantiles(mixtures: Sequence[tuple[Values, Values, Values]]) -> list[Values]:
    """Return the ``UPPER_LIMIT_SHARE`` quantiles of the absolute values of k mixtures of m normal distributions.

    ``mixtures``: weights (m,), means and standard deviations (m, k). Returns a (k,) array of each.
    """
    if not mixtures:
        return []
    counts = [mean.shape[1] for _, mean, _ in mixtures]
    sizes = np.repeat([len(weight) for weight, _, _ in mixtures], counts)  # components of each of all quantities
    first, of = np.cumsum(sizes) - sizes, np.repeat(np.arange(len(sizes)), sizes)
    weight = np.concatenate([each[0] for each, k in zip(mixtures, counts, strict=True) for _ in range(k)])
    mean = np.abs(np.concatenate([each.T.ravel() for _, each, _ in mixtures]))
    deviation = np.maximum(np.concatenate([each.T.ravel() for _, _, each in mixtures]), 1e-300)

    def total(values: Values) -> Values:
        return np.asarray(np.add.reduceat(weight * values, first))

    whole = np.add.reduceat(weight, first)
    low, high = np.zeros(len(sizes)), np.maximum.reduceat(mean + 5.0 * deviation, first)
    x = np.minimum(2.0 * np.sqrt(total(mean**2 + deviation**2) / whole), high)
    for _ in range(QUANTILE_ITERATIONS):  # a step of Newton's method, or a halving if the step leaves the interval
        sides = ((x[of] + side * mean) / deviation for side in (-1.0, 1.0))
        upper, lower = (np.clip(side, -MAX_NORMAL_DEVIATIONS, MAX_NORMAL_DEVIATIONS) for side in sides)
        excess = total(scipy.special.ndtr(upper) - scipy.special.ndtr(-lower)) - UPPER_LIMIT_SHARE * whole
        density = total((np.exp(-0.5 * upper**2) + np.exp(-0.5 * lower**2)) / deviation) / np.sqrt(2.0 * np.pi)
        low, high = np.where(excess < 0.0, x, low), np.where(excess < 0.0, high, x)
        before, x = x, x - excess / np.maximum(density, 1e-300)
        x = np.where((x > low) & (x < high), x, 0.5 * (low + high))
        if np.all(np.abs(x - before) <= QUANTILE_PRECISION * high):
            break
    return np.split(x, np.cumsum(counts)[:-1])


@cache
def prior_limit() -> float:
    """Return the upper limit that the prior gives without any reading, over the sensor file's limit."""
    return float(quantiles([(np.exp(SCALE_PRIOR), np.zeros((len(LIMIT_SCALES), 1)), LIMIT_SCALES[:, None])])[0][0])


def excluded(effects: Sequence[Effect]) -> dict[str, EffectSet]:
    """Return the effects that are never in a set with each: those that contain one another, and the two delays."""
    barred: dict[str, set[str]] = {this.name: set() for this in effects}
    for this in effects:
        for other in {*this.contains, *(DELAYS if this.name in DELAYS else ())} & barred.keys() - {this.name}:
            barred[this.name].add(other)
            barred[other].add(this.name)
    return {name: frozenset(others) for name, others in barred.items() if others}


def posterior(selection: Selection, hidden: Collection[str], others: Sequence[Effect] = ()) -> Answers:
    """Return probabilities, answer set and upper limits.

    ``hidden``: effects that the recordings cannot show. ``others``: further candidates.
    """
    of_fit = selection.fit.key, tuple(selection.names), selection.data_sheet.model_dump_json()
    key = posterior, *of_fit, frozenset(hidden), tuple(this.name for this in others)
    return selection.observations.once(key, lambda: _posterior(selection, hidden, others))


def completed(selection: Selection, hidden: Callable[[Selection], Collection[str]]) -> Selection:
    """Return a selection with the other effects of its most probable answer, if it has all selected and is sure enough.

    ``hidden`` returns the effects that the recordings cannot show. A gate asks of each effect what rules out chance
    among all candidates; where the size of an effect is known well (Earth's rotation), or beside effects that are
    shown, the evidence of the whole set is enough. A slow effect joins others only: alone, it was drift in 2 of 864
    sensors without one, both with a random walk of the bias.
    """
    scores = [s for s in selection.alone.values() if s.delta_bic > 0.0 and s.admissible]
    if not selection.names and not any(s.plausible or effect(s.name).nonlinear for s in scores):
        return selection  # none could be the first one; a nonlinear one may be plausible at its own optimum
    curves = curves_of(selection) if selection.names else ()
    names, probability = posterior(selection, hidden(selection), curves).sets[0]
    more = [name for name in names if name not in selection.names]
    whole = probability >= MIN_ANSWER_PROBABILITY and len(names) == len(selection.names) + len(more)
    slow = any(name in catalogue() and effect(name).of_the_room(selection.observations.sensor) for name in more)
    return selection.with_more(more) if more and whole and (selection.names or not slow) else selection


def curves_of(selection: Selection) -> list[Effect]:
    """Return the free curves of the covariates that vary, bent where an effect of the temperature is selected."""
    observations, sensor = selection.observations, selection.observations.sensor
    bent = any(effect(name).of_the_room(sensor) for name in selection.names)
    return free_curves(sensor, [part.motion for part in observations.parts], bent=bent)


def _posterior(selection: Selection, hidden: Collection[str], others: Sequence[Effect]) -> Answers:
    sensor = selection.observations.sensor
    candidates = {term.effect.name: term for term in reversed(selection.first.candidates)}
    shown = {*(candidates.keys() - set(hidden)), *selection.names}
    candidates = {name: term for name, term in sorted(candidates.items()) if name in shown}
    candidates |= {this.name: EffectColumns(this, np.zeros(len(this.parameters(sensor)))) for this in others}
    selected, moving = frozenset(selection.names), frozenset(n for n, term in candidates.items() if term.effect.moves)
    first = SetSearch(_problem(selection, selection.fit, candidates), seeds=[selected])
    curves = {this.name for this in others}
    best = first.best([key for key in first.pool if not key & curves])  # a fit has no free curves
    changed = best ^ selected
    if changed and not changed & moving and any(candidates[n].effect.nonlinear for n in changed):
        first = SetSearch(_problem(selection, _fit(selection, best, candidates), candidates), seeds=[selected, best])
    searches: list[SetSearch | None] = [first]
    fitted = [selected & moving]
    for movers in _worth_a_fit(first, moving, selected & moving):
        names = first.best([key for key in first.pool if key & moving == movers]) - curves
        fit = _fit(selection, names, candidates)
        fitted.append(movers)
        lag = next((t.values[0] for t in fit.terms if t.effect.name == DELAYS[1]), np.inf)
        possible = DELAYS[1] not in movers or lag > LEAST_LAG_S  # a lag cannot be negative
        still = {name: term for name, term in candidates.items() if name not in moving - movers}
        searches.append(SetSearch(_problem(selection, fit, still), movers) if possible else None)

    def owner(key: frozenset[str]) -> int:
        return fitted.index(key & moving) if key & moving in fitted else 0

    return answers(searches, owner, candidates)


def _worth_a_fit(search: SetSearch, moving: frozenset[str], fitted: frozenset[str]) -> list[frozenset[str]]:
    """Return the probable sets of timing effects other than the fitted one, the most probable first."""
    pool = search.pool
    total = float(np.logaddexp.reduce([found.score for found in pool.values()]))
    probability: dict[frozenset[str], float] = {}
    for names, found in pool.items():
        key = names & moving
        probability[key] = probability.get(key, 0.0) + float(np.exp(found.score - total))
    other = [key for key, share in probability.items() if key and key != fitted and share > WORTH_A_FIT]
    return sorted(other, key=lambda key: -probability[key])[:MOST_FITS]


def _fit(selection: Selection, names: Collection[str], candidates: Mapping[str, EffectColumns]) -> JointFit:
    fitted = {term.effect.name: term for term in selection.fit.terms}
    terms = list(selection.base.terms)
    for name in sorted(names):
        term = candidates[name]
        scored = selection.steps.get(name) or selection.alone.get(name)
        values = term.values if scored is None else scored.values
        if name == DELAYS[1]:
            values = np.maximum(values, term.effect.starts(selection.observations.sensor)[0])
        terms.append(fitted.get(name) or replace(term, values=values))
    return fit_terms(selection.observations, terms, selection.fit, selection.settings)


def _versions(
    sensor: str, fit: JointFit, places: Mapping[str, tuple[EffectColumns, slice]], term: EffectColumns
) -> list[tuple[EffectColumns, float]]:
    """Return the terms of an effect and their prior log weights; ``places``: of the fitted terms."""
    fitted, place = places.get(term.effect.name, (None, slice(0)))
    width = None
    if fitted is not None and term.effect.nonlinear:
        last = place.stop - 1
        width = float(np.sqrt(fit.covariance[last, last]) / max(abs(fitted.values[-1]), 1e-300))
    terms = time_constants(term.effect, sensor, fitted, width, between=bool(fit.terms))
    second = float(np.log(SECOND_SHARE)) if term.effect.name in SECOND[sensor] else 0.0
    return [(EffectColumns(each.effect, each.values, prior=term.prior), weight + second) for each, weight in terms]


def _products(
    selection: Selection, fit: JointFit, listed: Sequence[tuple[str, EffectColumns, float]], known: int
) -> tuple[Values, Values, Values, Values, list[slice]]:
    """Return the columns' norms at a fit, the products of base and other columns, log determinants, and places.

    The base is projected out of the other columns. The places are those of the listed terms. If the fit has no effects,
    the products are those of the selection's ranking. ``known``: number of columns of the base.
    """
    ranking = selection.ranking
    candidates = zip(ranking.candidates, ranking.slices, strict=False)
    places = {(term.effect.name, term.values.tobytes()): at for term, at in candidates}
    keys = [(name, term.values.tobytes()) for name, term, _ in listed]
    if fit.terms or any(key not in places for key in keys):
        configured = fit.terms[: len(selection.base.terms)]
        design = design_at(selection.observations, fit, [*configured, *(term for _, term, _ in listed)])
        stacked, logarithms = design.products([WHITE_SETTING, *selection.settings, *selection.walks])
        projected = without(stacked, np.arange(known))[:, known:, known:]
        return design.sizes(), stacked[:, :known, :known], projected, logarithms, design.slices[len(configured) :]
    base, projected = ranking.stacked[:, :known, :known], ranking.with_walks.copy()
    return ranking.sizes, base, projected, ranking.logarithms, [places[key] for key in keys]


def _problem(selection: Selection, fit: JointFit, candidates: Mapping[str, EffectColumns]) -> CandidateProblem:
    observations = selection.observations
    configured = fit.terms[: len(selection.base.terms)]
    fitted = {t.effect.name: t.values for t in fit.terms[len(configured) :]}
    of_fit = observations.sensor, fit, placed(fit.terms)
    versions = {name: _versions(*of_fit, candidate) for name, candidate in candidates.items()}
    listed = [(name, term, weight) for name, each in versions.items() for term, weight in each]
    known = BASE_COUNT + sum(len(term.values) for term in configured)
    size, base, products, logarithms, places = _products(selection, fit, listed, known)
    settings = [WHITE_SETTING, *selection.settings, *selection.walks]
    size = np.where(size > 0.0, size, 1.0)
    base = base / np.outer(size[:known], size[:known])
    prior = np.array([s.prior for s in settings]) - 0.5 * (logarithms + np.linalg.slogdet(base)[1])
    pairs = zip(listed, places, strict=True)
    columns = [(name, weight, slice(at.start - known, at.stop - known)) for (name, _, weight), at in pairs]
    samples = 3.0 * observations.samples
    return linear_problem(
        columns,
        products,
        size[known:],
        prior,
        (fitted, selection.limits),
        excluded([term.effect for term in candidates.values()]),
        samples=samples,
        free=samples - known,
        new=MIN_NEW_COLUMN_SHARE,
        within=float(np.sum(observations.scatter / fit.scale**2)),
    ).under(slice(1, None))
