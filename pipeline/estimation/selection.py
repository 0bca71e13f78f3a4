"""Select the effects that the recordings show: forward selection with backward drop.

In each round every candidate is scored at its best noise setting. The best candidate is accepted if it passes the gate
(``pipeline.estimation.gates``). While the residual exceeds twice the noise, an effect must also explain 5 % of the
excess, because any small effect slightly improves a model that lacks a large one.

After each acceptance the model is fitted, and if the columns have changed, all are computed again. A set with a time
constant is refused if the recordings do not determine it: the constant may grow until bias and drift have the same
signal. A selected effect is dropped if its delta BIC has become negative, and exchanged if another one passes the gate
in its place and is better by a delta BIC of more than 10. If no candidate passes although the wander seems three times
that of a static recording or of the sensor file, two effects may mask each other: then all pairs are scored once.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import combinations

import numpy as np

from pipeline.core.errors import NotObservableError
from pipeline.core.records import Noise, SensorCalibration, Values
from pipeline.core.settings import DataSheet
from pipeline.estimation.candidates import candidates_for, estimates, limits_of, prior_of, starts_of
from pipeline.estimation.design import EffectColumns, Start, Terms, ordinary_base, placed, without_unknown_motion
from pipeline.estimation.engine import scaled_inverse
from pipeline.estimation.gates import MAX_FALSE_PROBABILITY, MIN_DELTA_BIC, passes
from pipeline.estimation.gauss_markov import Setting, random_walks, selection_grid
from pipeline.estimation.generalized_least_squares import (
    SMALL_STEP_UNCERTAINTIES,
    JointFit,
    fit_best,
    fit_terms,
    require_observable,
)
from pipeline.estimation.observations import Observations, weighted
from pipeline.estimation.ranking import Ranking, Score, by_size
from pipeline.physics.effects import effect

MAX_SELECTED_EFFECTS = 5  # effects that one selection adds
INFLATED = 3.0  # times the expected wander, see above
EVIDENCE = 5.0  # difference in log L: a Bayes factor of 150, "very strong" (Kass and Raftery, JASA 90, 1995)
LOOK_ALIKE_SHARE = 0.8  # share of an effect's signal that another reproduces, above which it is a look-alike
# ``MOVER_SHARE``, ``CONSTANT_SHARE``, ``TIE``, ``WORTH_NAMING``, ``ANOTHER_K``: halved together they change nothing in
# 208 sensors of the blind study (four of each family); doubled, the order of one selection and one verdict.
MOVER_SHARE = 0.1  # of the best candidate's delta BIC above which an effect of timing is fitted to its optimum
CONSTANT_SHARE = 0.6  # the same for an effect with a time constant, whose start is near its optimum
DELAYS = ("time_offset", "low_pass_lag")  # of the two the first is selected unless the second is clearly better
STRONG_DELTA_BIC = 6.0  # delta BIC: "strong" evidence (Raftery 1995)
# last step of a rough fit; from there 2 log L of an unexplained sensor's fits changed by less than 4
ROUGH_STEP_UNCERTAINTIES = 3.0
ROUGH_DELTA_BIC = 30.0  # below that of the best candidate, from which on a rough score is enough
TIE = 0.5  # delta BIC below which the catalogue's order decides
ABOVE_NOISE = 1.1  # mean square of a residual over that of noise, below which effects explain no part of the excess
FAR_ABOVE = 2.0  # times the noise: the residual of a model that lacks more than one effect of the catalogue
WORTH_NAMING = 0.05  # share of such a residual's excess that an effect must explain
ANOTHER_K = 2e-3  # change of K that changes the columns of effects that the axes share


def select(
    observations: Observations,
    configured: Sequence[str],
    noise: Noise | None,
    data_sheet: DataSheet,
    known: SensorCalibration | None = None,
    *,
    accelerometer: SensorCalibration | None = None,
    search: bool = True,
) -> Selection:
    """Select effects.

    ``configured``: effects of the model. ``data_sheet``: the sensor's section of the configuration. ``known``: a
    calibration whose effects are starts for the configured ones. ``accelerometer``, for the gyroscope: its fit with the
    mountings. ``search``: False computes the base and the products of the candidates only, without scores.
    """
    observations, grid = weighted(observations, noise), selection_grid(noise)

    @cache
    def models(observations: Observations) -> tuple[list[list[EffectColumns]], dict[str, EffectColumns]]:
        """Return the starts of the base with configured effects, and the candidates."""
        starts, candidates = starts_of(configured, observations, known, accelerometer), {}
        for this in candidates_for(observations, configured):
            zeros = np.zeros(len(this.parameters(observations.sensor)))
            prior = prior_of(this, observations, accelerometer, configured)
            candidates[this.name] = EffectColumns(this, zeros, prior=prior)
        return starts, candidates

    def searched(observations: Observations, near: Mapping[tuple[str, ...], JointFit]) -> Selection:
        """Select effects by all rows of the observations; ``near``: fits to most of them, from which fits start."""
        starts, candidates = models(observations)
        start, limits = ordinary_base(observations, noise), limits_of(observations.sensor, data_sheet)
        base = fit_best(observations, starts, start, grid)
        # where a residual is above the noise, its signal may look like noise with one effect and not without it
        at_noise = noise is not None and base.residual_rms**2 < ABOVE_NOISE * observations.noise_square(noise)
        settings = base.likely if search and at_noise else grid
        walks = [walk for setting, walk in random_walks(grid).items() if setting in settings]
        ranking = Ranking(observations, base, base, candidates, settings, walks=() if base.terms else walks)
        given = observations, noise, data_sheet, start, settings, walks, limits, candidates
        selection = Selection(*given, base, base, ranking, ranking, near=near)
        if search:
            selection.run()
        return selection

    def selected() -> Selection:
        selection = searched(observations, {})
        remaining = without_unknown_motion(observations, selection.fit.terms)
        return selection if remaining is observations else searched(remaining, {**selection.rough, **selection.fits})

    starts, candidates = models(observations)
    terms = [tuple(term.key for term in terms) for terms in ([*candidates.values()], *starts)]
    return observations.once((select, *terms, data_sheet.model_dump_json(), search), selected)


@dataclass
class Selection:
    """The selected effects, the scores of every candidate, and the search."""

    observations: Observations
    noise: Noise | None
    data_sheet: DataSheet
    start: Start
    settings: Sequence[Setting]  # of the noise: those under which base and effects may be likely
    walks: Sequence[Setting]  # their random walks of the bias, of the posterior
    limits: dict[str, Values]
    candidates: dict[str, EffectColumns]  # before any fit, with their priors
    base: JointFit  # base and configured effects
    fit: JointFit  # base, configured and selected effects
    first: Ranking  # the linear problem of the base
    ranking: Ranking  # the linear problem with the selected effects at their values
    steps: dict[str, Score] = field(default_factory=dict)  # of each selected effect, in order, when it was accepted
    alone: dict[str, Score] = field(default_factory=dict)  # of each candidate against the base
    fits: dict[tuple[str, ...], JointFit] = field(default_factory=dict)  # of base, configured and further effects
    optima: dict[Hashable, JointFit] = field(default_factory=dict)  # of candidates, by all terms at the start
    rough: dict[tuple[str, ...], JointFit] = field(default_factory=dict)  # as ``fits``, only near their optimum
    near: Mapping[tuple[str, ...], JointFit] = field(default_factory=dict)  # fits from which those of ``fits`` start
    refused: set[frozenset[str]] = field(default_factory=set)  # sets with a time constant that is not determined

    @property
    def names(self) -> list[str]:
        """The selected effects, in order."""
        return list(self.steps)

    def chosen(self) -> list[int]:
        """Return the indices of the selected effects among the ranking's candidates."""
        return self.ranking.of_effects(self.names)

    def run(self) -> None:
        """Search."""
        self.alone = {score.name: score for score in self._scores()}
        self._forward()
        if not self.names and self._inflated():
            self._pairs()
        if self.names:
            self._fit_selected()
            if self._other_delay():
                self._forward()
                self._fit_selected()
        # without the designs of other fits and the motions of their rounds, which would be kept as long as the unit
        self.fits = {names: fit if fit is self.fit else replace(fit) for names, fit in self.fits.items()}
        for part in self.observations.parts:
            part.moved.clear()

    def without(self, names: Collection[str]) -> Selection | None:
        """Return the selection by the other candidates; None if empty, or its 2 log L is less by ``MIN_DELTA_BIC``."""
        others = {name: term for name, term in self.candidates.items() if name not in names}
        found = replace(self, steps={}, fits=dict(self.fits), fit=self.base, ranking=self.first, candidates=others)
        found.run()
        less = 2.0 * (self.fit.log_likelihood - found.fit.log_likelihood)
        return found if found.names and less < MIN_DELTA_BIC else None

    @property
    def bic(self) -> float:
        """``2 log L - k log N`` of the fit."""
        count = sum(len(term.values) for term in self.fit.terms)
        return 2.0 * self.fit.log_likelihood - count * float(np.log(self.ranking.samples))

    def with_more(self, names: Sequence[str]) -> Selection:
        """Return the selection with further effects; itself if one of them is not possible or lowers the BIC."""
        if not self.candidates.keys() >= {*names}:
            return self
        found = replace(self, steps=dict(self.steps), fits=dict(self.fits), refused=set(self.refused))
        for name in names:
            score = found._given(found.names).get(name)  # noqa: SLF001  (of this class)
            if score is not None and effect(name).nonlinear:
                score = found._refined(score)  # noqa: SLF001
            if score is None or not score.delta_bic > 0.0 or not (score.admissible and score.plausible):
                return self
            if not found._possible(name, found.names) or not found._accept({**found.steps, name: score}):  # noqa: SLF001
                return self
            found._refit()  # noqa: SLF001
        return found

    def _forward(self) -> None:
        for _ in range(3 * MAX_SELECTED_EFFECTS):
            if len(self.names) == MAX_SELECTED_EFFECTS:
                return
            best = self._next()
            if best is None:
                if not self._exchange():
                    return
                continue
            this, K = effect(best.name), self.fit.K
            if not self._accept({**self.steps, best.name: best}):
                continue
            if this.nonlinear or this.moves or np.abs(self.fit.K - K).max() > ANOTHER_K:  # other columns
                self._refit()
            self._drop()
            self._drop_insignificant()
            self._merge()

    def _accept(self, steps: dict[str, Score]) -> bool:
        """Fit the effects of ``steps`` and select them, unless a time constant is at a value that is not determined."""
        before = self.steps, self.fit
        self.steps = steps
        self._fit_selected()
        if any(effect(name).nonlinear and not effect(name).moves for name in steps):
            try:
                require_observable(self.observations, self.fit)
            except NotObservableError:
                self.refused.add(frozenset(steps))
                self.steps, self.fit = before
                return False
        return True

    def _given(self, names: Sequence[str]) -> dict[str, Score]:
        """Return the score of each candidate given some of the selected effects, best first."""
        return {s.name: s for s in self.ranking.scores(self.ranking.of_effects(names), self.limits)}

    def _scores(self) -> list[Score]:
        """Score all candidates; competing ones of timing or with a time constant are fitted near their optimum.

        Before any effect is selected, they are fitted to it: each is then reported.
        """
        scores = list(self._given(self.names).values())
        top = max((s.delta_bic for s in scores if s.admissible), default=0.0)
        for i, score in enumerate(scores):
            this = effect(score.name)
            share = MOVER_SHARE if this.moves else CONSTANT_SHARE
            able = not self.names or self._able(score.name)
            if able and this.nonlinear and score.delta_bic > max(MIN_DELTA_BIC, share * top):
                scores[i] = self._refined(score, rough=bool(self.names))
        return scores

    def _next(self) -> Score | None:
        """Return the candidate to accept; those that are nearly as good have been fitted to their optimum."""
        scores = self._scores() if self.names else list(self.alone.values())
        while True:
            best = self._best(scores)
            least = np.inf if best is None else best.delta_bic - ROUGH_DELTA_BIC
            if not any(s.rough and s.delta_bic > least for s in scores):
                return best
            scores = [self._refined(s) if s.rough and s.delta_bic > least else s for s in scores]

    def _refined(self, score: Score, *, rough: bool = False) -> Score:
        """Return the score of a nonlinear candidate at its own optimum, or near it (``rough``)."""
        this = effect(score.name)
        values, names = score.values, (*self.names, score.name)
        if this.name == DELAYS[1]:
            values = np.maximum(values, this.starts(self.observations.sensor)[0])
        terms = [*self.base.terms, *self._terms(), EffectColumns(this, values)]
        key = rough, *(term.key for term in terms)
        if key not in self.optima:
            small = ROUGH_STEP_UNCERTAINTIES if rough else SMALL_STEP_UNCERTAINTIES
            fit = self._fitted(names, terms, self.start, small)
            self.optima[key] = replace(fit)  # without its design: there are many candidates
        fit = self.optima[key]
        (self.rough if rough else self.fits)[names] = fit
        before, _ = self.ranking.of_model(self.ranking.of_effects(self.names))
        gain, limit = 2.0 * (fit.log_likelihood - before), self.limits.get(score.name, np.inf)
        refined = score.refined(gain, self.ranking.samples, fit.terms, fit.covariance, limit)
        return replace(refined, rough=rough)

    def _best(self, scores: Sequence[Score]) -> Score | None:
        """Return the candidate to accept; a plausible one is preferred if two differ by less than the threshold."""
        values = {s.name: s.delta_bic - (0.0 if s.plausible else MIN_DELTA_BIC) for s in scores if self._passes(s)}
        if not values:
            return None
        best = max(values, key=lambda name: values[name])
        if best == DELAYS[1] and values.get(DELAYS[0], -np.inf) > values[best] - STRONG_DELTA_BIC:
            best = DELAYS[0]
        tied = [name for name in self.candidates if values.get(name, -np.inf) > values[best] - TIE]
        name = best if best in DELAYS else tied[0]
        return next(s for s in scores if s.name == name)

    def _passes(self, score: Score, partners: Sequence[int] = ()) -> bool:
        """Return whether a candidate may be selected; a lag cannot be negative, nor be distinguished from a delay.

        ``partners``: indices of candidates that were in the model of the score in addition to the selected effects.
        """
        negative_lag = score.name == DELAYS[1] and score.values[0] <= 0
        if negative_lag or not self._able(score.name):
            return False
        return self._significant(score) and self._matters(score, partners)

    def _able(self, name: str) -> bool:
        """Return whether a candidate of any size may be added to the selected effects; a second delay may not."""
        second_delay = name in DELAYS and any(selected in DELAYS for selected in self.names)
        return not second_delay and self._possible(name, self.names)

    def _significant(self, score: Score) -> bool:
        """Return whether a candidate passes the gate and the selected effects do not already explain its signal."""
        gain = 2.0 * (self.fit.log_likelihood - self.base.log_likelihood)
        return score.admissible and passes(score, self.observations.sensor, len(self.candidates), gain)

    def _possible(self, name: str, selected: Sequence[str]) -> bool:
        """Return whether an effect can be added: it contains no effect of the model, nor is contained in one."""
        if name not in self.candidates or frozenset([*selected, name]) in self.refused:
            return False
        return not overlaps(name, [*selected, *(term.effect.name for term in self.base.terms)])

    def _matters(self, score: Score, partners: Sequence[int]) -> bool:
        """Return whether an effect explains a significant part of a residual that is far above the noise."""
        if self.noise is None:
            return True
        selected = [*self.ranking.of_effects(self.names), *partners]
        floor = np.sum((self.noise.white**2 + self.noise.wander**2) / self.start.scale**2) / 3.0
        residual = (float(self.ranking.left([selected], slice(1))[0, 0]) + self.ranking.within) / self.ranking.samples
        drop = score.drop / self.ranking.samples
        return bool(residual - drop < FAR_ABOVE**2 * floor or drop > WORTH_NAMING * (residual - floor))

    def _refit(self) -> None:
        """Fit configured and selected effects together and rebuild the candidates there."""
        self._fit_selected()
        self.ranking = Ranking(self.observations, self.base, self.fit, self.candidates, self.settings)

    def _fit_selected(self) -> None:
        key = tuple(self.names)
        if key not in self.fits:
            terms = [*self.base.terms, *self._terms()]
            self.fits[key] = self._fitted(key, terms, self.fit)
        self.fit = self.fits[key]

    def _fitted(
        self, names: tuple[str, ...], terms: Terms, start: Start, small: float = SMALL_STEP_UNCERTAINTIES
    ) -> JointFit:
        """Fit terms from a start, or from the fit of the same effects that is known to be near."""
        if (near := self.rough.get(names) or self.near.get(names)) is not None:
            values = {term.effect.name: term.values for term in near.terms}
            terms = [replace(term, values=values[term.effect.name]) for term in terms]
            start = Start(near.bias, near.K, start.scale)
        return fit_terms(self.observations, terms, start, self.settings, small)

    def _terms(self) -> list[EffectColumns]:
        """Return the selected effects at their fitted values, or at those of the step that accepted them."""
        fitted = {term.effect.name: term for term in self.fit.terms}
        return [fitted.get(n) or replace(self.candidates[n], values=self.steps[n].values) for n in self.names]

    def _remove(self, names: Sequence[str]) -> None:
        self.steps = {name: step for name, step in self.steps.items() if name not in names}
        self.fit = replace(self.fit, terms=tuple(t for t in self.fit.terms if t.effect.name not in names))

    def _replaced(self, old: str, new: Score, without: str = "") -> dict[str, Score]:
        """Return the steps with another effect in the place of one."""
        return {new.name if n == old else n: new if n == old else s for n, s in self.steps.items() if n != without}

    def _drop(self) -> None:
        for name in [n for n in self.names if not effect(n).moves]:
            score = self._given([n for n in self.names if n != name]).get(name)
            if score is None or score.delta_bic < 0.0:
                self._remove([name])
                if effect(name).nonlinear:
                    self._refit()

    def _drop_insignificant(self) -> None:
        """Drop effects that are not significant in the full fit: the ranking had columns of an earlier matrix."""
        dropped = []
        for name, (term, block) in placed(self.fit.terms).items():
            if name not in self.names or term.effect.moves:
                continue
            covariance = self.fit.covariance[block, block]
            wald = float(term.values @ scaled_inverse(covariance) @ term.values)
            if wald < np.count_nonzero(np.diag(covariance) > 0.0) * float(np.log(self.ranking.samples)):
                dropped.append(name)
        self._remove(dropped)
        if dropped:
            self._refit()

    def _merge(self) -> None:
        """Replace two selected effects by one that contains the first, if it explains about as much."""
        for general, term in self.candidates.items():
            part = next((n for n in self.names if n in term.effect.contains), None)
            if part is None or general in self.names or not self.ranking.indices(general):
                continue
            for other in [n for n in self.names if n != part and not effect(n).moves]:
                rest = [n for n in self.names if n not in (part, other)]
                if self._criterion([*rest, general]) > self._criterion(self.names) - MIN_DELTA_BIC:
                    self.steps = self._replaced(part, self._given(rest)[general], other)
                    self._refit()
                    return

    def _criterion(self, names: Sequence[str]) -> float:
        """Return ``2 log L - k log N`` of base and some candidates, at the values of the ranking."""
        log_likelihood, _ = self.ranking.of_model(self.ranking.of_effects(names))
        count = sum(len(self.candidates[n].values) for n in names)
        return 2.0 * log_likelihood - count * float(np.log(self.ranking.samples))

    def _exchange(self) -> bool:
        """Replace a selected effect by another one that explains significantly more, if it is determined.

        Returns whether one explains more: it was taken, or is refused from now on.
        """
        for name in [n for n in self.names if not effect(n).moves]:
            others = [n for n in self.names if n != name]
            scores = self._given(others)
            delta_bic = scores.pop(name).delta_bic if name in scores else float("-inf")
            able = (s for s in scores.values() if self._significant(s) and not effect(s.name).moves)
            rival = next((s for s in able if self._possible(s.name, others)), None)
            if rival is not None and rival.delta_bic > delta_bic + MIN_DELTA_BIC:
                if self._accept(self._replaced(name, rival)):
                    self._refit()
                    self._drop_insignificant()
                return True
        return False

    def _other_delay(self) -> bool:
        """Replace a delay by a lag, or the reverse, if it is significantly better with all selected effects."""
        name = next((n for n in self.names if n in DELAYS), None)
        other = next((n for n in DELAYS if n != name), "")
        if name is None or len(self.names) == 1 or other not in self.candidates:
            return False
        place = self.names.index(name)
        terms = self._terms()
        value = np.maximum(-terms[place].values, effect(other).starts(self.observations.sensor)[0])
        terms[place] = EffectColumns(effect(other), value)
        fit = fit_terms(self.observations, [*self.base.terms, *terms], self.fit, self.settings)
        gain = 2.0 * (fit.log_likelihood - self.fit.log_likelihood)
        if gain <= (STRONG_DELTA_BIC if other == DELAYS[1] else 0.0):
            return False
        old, (values, uncertainty) = self.steps[name], estimates(fit.terms, fit.covariance)[other]
        score = replace(old, name=other, delta_bic=old.delta_bic + gain, values=values, uncertainty=uncertainty)
        self.steps = self._replaced(name, score)
        self.fits[tuple(self.names)] = fit
        self._refit()
        self._drop()
        return True

    def _inflated(self) -> bool:
        """Return whether the residual's wander is far above that of a static recording or of the sensor file."""
        _, setting = self.ranking.of_model([])
        white = float(np.sqrt(np.mean(self.start.scale**2)))
        expected = self.data_sheet.bias_wander
        if self.noise is not None and self.noise.source == "static":
            expected = float(np.sqrt(np.mean(self.noise.wander**2)))
        return expected > 0 and self.ranking.settings[setting].ratio * white > INFLATED * expected

    def _pairs(self) -> None:
        """Score all pairs once and accept the best if both effects are significant."""
        ranking = self.ranking
        before, _ = ranking.of_model([])
        able = [j for j, place in enumerate(ranking.places) if len(place)]
        names = [candidate.effect.name for candidate in ranking.candidates]
        pairs = [(j, k) for j, k in combinations(able, 2) if names[j] != names[k]]
        pairs = [(j, k) for j, k in pairs if {names[j], names[k]} != {*DELAYS} and not overlaps(names[j], [names[k]])]
        best: tuple[float, int, int] = (2.0 * MIN_DELTA_BIC, -1, -1)
        for members in by_size(len(ranking.places[j]) + len(ranking.places[k]) for j, k in pairs):
            alike = [pairs[m] for m in members]
            price = sum(len(ranking.places[j]) for j in alike[0]) * float(np.log(ranking.samples))
            likelihoods = ranking.log_likelihood(ranking.left(alike))[:, 1:].max(axis=1)
            gains = 2.0 * (likelihoods - before) - price
            best = max(best, *((gain, *pair) for gain, pair in zip(gains.tolist(), alike, strict=True)))
        _, j, k = best
        if j < 0:
            return
        number = len(able) * (len(able) - 1) / 2
        steps = {}
        for member, partner in ((j, k), (k, j)):
            name = ranking.candidates[member].effect.name
            steps[name] = next(s for s in ranking.scores([partner], self.limits) if s.name == name)
            if not self._passes(steps[name], [partner]) or steps[name].p_value * number >= MAX_FALSE_PROBABILITY:
                return
        self._accept(steps)


def overlaps(name: str, others: Sequence[str]) -> bool:
    """Return whether an effect contains one of the others, or is contained in one."""
    return any(name in effect(other).contains or other in effect(name).contains for other in others)
