"""Select effects by rests and moves: forward selection with backward drop, as in ``pipeline.estimation.selection``.

The gate is the same (``pipeline.estimation.gates``), with the gain, delta BIC and p of ``model``. After each acceptance
all parameters are fitted and every column is computed again. An effect that would need more than ten times its limit in
the sensor file is not accepted as an explanation of a few rests. A selected effect is dropped if its delta BIC has
become negative, and exchanged if another one passes the gate in its place and is better by a delta BIC of more than 10.

The posterior over effects is computed for the linear problem of ``pipeline.estimation.evidence``: columns at the fit of
the selected effects, and readings ``y = r + Z p`` with the residual r and their values p. As in the selection, white
noise is known and a scatter only adds to it: sigma is at least 1.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise, product

import numpy as np
import scipy

from pipeline.core.records import Mask, Motion, Noise, SensorCalibration, Values
from pipeline.core.settings import DataSheet
from pipeline.estimation.candidates import NO_SWING, limits_of, starts_of, time_constants
from pipeline.estimation.design import EffectColumns, Terms
from pipeline.estimation.evidence import CandidateProblem, linear_problem
from pipeline.estimation.gates import MIN_DELTA_BIC, passes, within
from pipeline.estimation.gauss_markov import random_walks
from pipeline.estimation.multi_position.fit import (
    CEILING_TO,
    COMPARED_STEP,
    MIN_NEW_NORM_SHARE,
    SMALL_LAST_STEP,
    FitByHand,
    adds_nothing,
    fit,
    judged_curves,
    log_determinants,
    project_out,
)
from pipeline.estimation.multi_position.model import Equations, Model, NoiseHypothesis, State, selection_hypotheses
from pipeline.estimation.posterior import Answers, SetSearch, answers, excluded
from pipeline.estimation.ranking import Score, without
from pipeline.estimation.rest_means import Rests
from pipeline.estimation.selection import MAX_SELECTED_EFFECTS, overlaps
from pipeline.physics.effects import catalogue, effect, effect_from
from pipeline.physics.effects.base import Effect, EffectParameter, Layout, Owner

MAX_SELECTION_ROUNDS = 3 * MAX_SELECTED_EFFECTS
POSSIBLE = 10.0  # times its limits, beyond which an effect is no explanation
MAX_TIMES_LIMIT = 5.0  # times its limits, which bound an amplitude that a time constant leaves undetermined
DRIFT, LAG, WARM_UP = "bias_drift", "temperature_lag", "warm_up"
ONE_CYCLE = "the soak passes no temperature twice in one direction, so hysteresis looks like it: heat and cool twice"
FEWEST_PARTS = 8  # of a soak that heats and cools
TURNING = 0.2  # of the largest rate of the temperature: where it turns round
# delta BIC of one curve above that of another: "positive" evidence (Raftery, Sociological Methodology 25, 1995); of 80
# sensors with a lag none, of 96 with hysteresis by the sign of dT/dt all are called hysteresis
PREFERRED = 2.0
COMPETES = 0.6  # share of the best delta BIC above which an effect is fitted to its optimum


@dataclass(frozen=True)
class CandidateScores:
    """The scores of all candidates, given a model; each by the candidate's name."""

    scores: dict[str, Score] = field(default_factory=dict)  # of those that the equations show
    # mean gain with its parameters at their limits; infinite without limits
    visible: dict[str, float] = field(default_factory=dict)
    slowest: dict[str, float] = field(default_factory=dict)  # the smallest of all starts, where they are several
    shown: dict[str, Values] = field(default_factory=dict)  # orthonormal directions under the model's best hypothesis
    spare: dict[str, float] = field(default_factory=dict)  # factor on its gain; 0 with too few equations to judge it
    signal: dict[str, Values] = field(default_factory=dict)  # its fitted, whitened signal there
    # of the linear problem: values at its start, equations with its columns, log L under each hypothesis after a step
    start: dict[str, tuple[EffectColumns, tuple[Equations, Values]]] = field(default_factory=dict)
    fits: dict[str, FitByHand] = field(default_factory=dict)  # of those that were fitted to their optimum


def _gain_at(limit: Values, raw: Values) -> float:
    """Return the mean gain of parameters at their limits, (p,); infinite without limits. ``raw``: (n, p), projected."""
    size = np.linalg.norm(raw, axis=0)
    power = float(np.sum((limit[size > 0.0] * size[size > 0.0]) ** 2))
    return len(raw) * float(np.log1p(power / len(raw)))


def fit_configured(  # noqa: PLR0917  (what a fit starts from)
    model: Model,
    start: SensorCalibration,
    configured: Sequence[str],
    hypotheses: Sequence[NoiseHypothesis],
    limits: Mapping[str, Values] | None = None,
    small: float = SMALL_LAST_STEP,
) -> FitByHand:
    """Fit base and configured effects, from the best of their starts; ``small``: see ``fit``."""
    fits = []
    for terms in starts_of(configured, model.sensor, start):
        own = tuple(EffectColumns(t.effect, np.array(t.values, float)) for t in terms)
        state = State(start.bias, start.matrix, own)
        fits.append(fit(model, state, hypotheses, limits or {}, small=small))
    return max(fits, key=lambda fitted: fitted.log_likelihood)


class SelectionByHand:
    """The selected effects, and the scores of every candidate: ``first`` and ``last`` before and after the search.

    ``start``: where the fit of the base starts; its effects are starts of the configured ones. ``data_sheet``: the
    sensor's section of the configuration. ``small``: see ``fit``. ``names``: in order. ``steps``: score of each when it
    was accepted. ``fits``: of base and configured effects, then with each further selected one.
    """

    def __init__(  # noqa: PLR0917  (what a selection starts from)
        self,
        model: Model,
        start: SensorCalibration,
        configured: Sequence[str],
        noise: Noise | None,
        data_sheet: DataSheet,
        small: float = SMALL_LAST_STEP,
    ) -> None:
        self.model, self.small = model, small
        self.hypotheses = selection_hypotheses(noise, model.kinds)
        self.limits = limits_of(model.sensor, data_sheet)
        effects = catalogue().items()
        others = [e for n, e in effects if n not in configured and (not e.shown_by or e.shown_by in model.rests.kinds)]
        self.candidates = [e for e in others if not no_candidate(e, model.sensor, model.rests)]
        self.bounds = {n: MAX_TIMES_LIMIT * limit for n, limit in self.limits.items() if effect(n).nonlinear}
        self.base = fit_configured(model, start, configured, self.hypotheses, self.bounds, small)
        self.ceilings = self.base.equations.ceilings(self.hypotheses)
        self._search()
        if LAG in self.names:
            state = self._state([name for name in self.names if name != LAG])
            loops = loops_of(model, state.terms)
            if loops and is_hysteresis(judged_curves(model.equations(state, loops), self.hypotheses)):
                loop_like = {LAG} if model.rests.repeats else {LAG, WARM_UP}  # a warm-up, in one cycle
                self.candidates = [e for e in self.candidates if e.name not in loop_like]
                self._search()
        parts = [self._fitted(self.names[:count]) for count in range(1, len(self.names))]
        self.fits = [self.base, *parts, self.fit] if self.names else [self.base]

    @cached_property
    def own(self) -> dict[str, CandidateScores]:
        """For each selected effect, the scores given all others."""
        return {name: self._without(name) for name in self.names}

    def _search(self) -> None:
        self.names: list[str] = []
        self.steps: dict[str, Score] = {}
        self.fit = self.base
        self.cache: dict[tuple[tuple[str, ...], tuple[str, ...]], CandidateScores] = {}
        self.first = self.last = self._scored([])
        for _ in range(MAX_SELECTION_ROUNDS):
            best = self._best(self.last) if len(self.names) < MAX_SELECTED_EFFECTS else None
            if best is not None:
                self._add(best, self.last)
                self._drop()
            elif not self._exchange():
                break
            self.last = self._scored(self.names)

    def _scored(self, names: Sequence[str]) -> CandidateScores:
        """Score every effect given base, configured and some of the selected effects."""
        key = tuple(self.names), tuple(names)
        if key not in self.cache:
            self.cache[key] = self._score_all(names)
        return self.cache[key]

    def _score_all(self, names: Sequence[str]) -> CandidateScores:
        fitted = {term.effect.name: term.values for term in self.fit.state.terms}
        terms = []
        for candidate in (c for c in self.candidates if c.name not in names):
            values = candidate.starts(self.model.sensor)
            if candidate.name in fitted:
                values = [np.where(_nonlinear(candidate, self.model.sensor), fitted[candidate.name], 0.0)]
            terms += [EffectColumns(candidate, v) for v in values]
        equations = self.model.equations(self._state(names), terms)
        fitted_model = self.fit if len(names) == len(self.names) else self.base
        possible = np.flatnonzero(self.ceilings > fitted_model.log_likelihood - CEILING_TO)
        projected = project_out(equations, [self.hypotheses[i] for i in possible])
        before, at = projected.of_model()
        Q, _ = np.linalg.qr(equations.base)
        out = CandidateScores()
        for j, term in enumerate(terms):
            name, count = term.effect.name, projected.count(j, at)
            added = count + len(term.effect.nonlinear)
            shows = count > 0 and not adds_nothing(Q, equations.candidates[j])
            factor = projected.correction(j, at, added, equations.scatter) if shows else 0.0
            seen = factor * _gain_at(self.limits[name], projected.raw[j][at]) if factor > 0.0 else 0.0
            if term.effect.nonlinear:
                out.slowest[name] = min(seen, out.slowest.get(name, seen))
            if not shows:
                continue
            after = projected.with_candidate(j)
            best = int(np.argmax(after))
            gain = factor * max(2.0 * (float(after[best]) - before), 0.0)
            score = self._score(term, added, gain, projected.raw[j][best], projected.residual[best])
            score = replace(score, setting=int(possible[best]), admissible=factor > 0.0)
            if name in out.scores and out.scores[name].delta_bic >= score.delta_bic:
                continue
            shown = projected.shown(j, at)
            out.scores[name], out.spare[name], out.shown[name] = score, factor, shown
            effects = [*equations.effects, equations.candidates[j]]
            predicted = self.ceilings.copy()
            predicted[possible] = after
            out.start[name] = term, (replace(equations, effects=effects, candidates=[]), predicted)
            out.signal[name] = shown @ (shown.T @ projected.residual[at])
            out.visible[name] = seen
        self._refine(out, names, before)
        return out

    def _score(self, term: EffectColumns, added: int, gain: float, raw: Values, residual: Values) -> Score:
        """Return the score of a candidate after one linear step."""
        inverse = np.linalg.pinv(raw, rcond=MIN_NEW_NORM_SHARE)
        n, step = len(residual), inverse @ residual
        rest = residual - raw @ step
        values = term.values + step
        uncertainty = np.sqrt(max(1.0, float(rest @ rest) / n) * np.sum(inverse**2, axis=1))
        name, p = term.effect.name, float(scipy.special.chdtrc(added, gain))
        delta_bic, plausible = gain - added * float(np.log(n)), within(values, uncertainty, self.limits[name])
        return Score(name, delta_bic, p, added, values, uncertainty, 0, plausible=plausible)

    def _refine(self, scored: CandidateScores, names: Sequence[str], before: float) -> None:
        """Fit the competing nonlinear candidates to their optimum, which one linear step may not reach."""
        top = max((s.delta_bic for s in scored.scores.values()), default=0.0)
        for score in list(scored.scores.values()):
            curved = bool(effect(score.name).nonlinear) or (self.model.kinds > 1 and top > MIN_DELTA_BIC)
            if not curved or score.delta_bic < max(COMPETES * top, 0.0):
                continue
            refit = self._with(names, score, scored)
            gain = 2.0 * (refit.log_likelihood - before) * scored.spare[score.name]
            limit, samples, terms = self.limits[score.name], len(refit.residual), refit.state.terms
            scored.scores[score.name] = score.refined(gain, samples, terms, refit.covariance, limit)

    def _state(self, names: Collection[str]) -> State:
        """Return the state of the fit with base, configured and some of the selected effects."""
        configured = len(self.base.state.terms)
        terms = (t for i, t in enumerate(self.fit.state.terms) if i < configured or t.effect.name in names)
        return replace(self.fit.state, terms=tuple(terms))

    def _with(self, names: Sequence[str], score: Score, scored: CandidateScores) -> FitByHand:
        """Fit a candidate together with some of the selected effects; ``scored``: the scores given these."""
        if score.name not in scored.fits:
            start, (term, known) = self._state(names), scored.start[score.name]
            start = replace(start, terms=(*start.terms, term))
            near = fit(self.model, start, self.hypotheses, self.bounds, known=known, small=COMPARED_STEP)
            scored.fits[score.name] = near
        return scored.fits[score.name]

    def _fitted(self, names: Sequence[str]) -> FitByHand:
        """Fit base, configured and some of the selected effects."""
        return fit(self.model, self._state(names), self.hypotheses, self.bounds, small=self.small)

    def _best(self, scored: CandidateScores) -> Score | None:
        """Return the candidate to accept; a plausible one is preferred if two differ by less than the threshold."""
        passing = [s for s in scored.scores.values() if s.name not in self.names and self._passes(s, self.names)]
        return max(passing, key=lambda s: s.delta_bic - (0.0 if s.plausible else MIN_DELTA_BIC), default=None)

    def _passes(self, score: Score, selected: Sequence[str]) -> bool:
        """Return whether a candidate passes the gate; ``selected``: effects in the model of the score."""
        if overlaps(score.name, [*selected, *(term.effect.name for term in self.base.state.terms)]):
            return False
        gain = 2.0 * (self.fit.log_likelihood - self.base.log_likelihood)
        explains = score.admissible and within(score.values, score.uncertainty, self.limits[score.name], POSSIBLE)
        return explains and passes(score, self.model.sensor, len(self.candidates), gain)

    def _add(self, score: Score, scored: CandidateScores) -> None:
        near = self._with(self.names, score, scored)
        known = near.equations, near.scores
        self.fit = fit(self.model, near.state, self.hypotheses, self.bounds, known=known, small=self.small)
        self.names.append(score.name)
        self.steps[score.name] = score

    def _remove(self, name: str) -> None:
        self.names.remove(name)
        del self.steps[name]

    def _without(self, name: str) -> CandidateScores:
        return self._scored([n for n in self.names if n != name])

    def _drop(self) -> None:
        """Remove each selected effect but the last whose delta BIC given the others is negative."""
        for name in self.names[:-1]:
            score = self._without(name).scores.get(name)
            if score is None or score.delta_bic < 0.0:
                self._remove(name)
                self.fit = self._fitted(self.names)

    def _exchange(self) -> bool:
        """Replace a selected effect by another one that explains significantly more.

        Where it is the only one, the first scores are those of its rivals: both are given the base alone.
        """
        for name in self.names:
            others = [n for n in self.names if n != name]
            scored = self._without(name) if others else self.first
            scores = scored.scores
            threshold = MIN_DELTA_BIC + (scores[name].delta_bic if name in scores else float("-inf"))
            rivals = [s for s in scores.values() if s.name not in self.names and self._passes(s, others)]
            rival = max(rivals, key=lambda s: s.delta_bic, default=None)
            if rival is not None and rival.delta_bic > threshold:
                self._remove(name)
                self._add(rival, scored)
                return True
        return False


class CommonLag(Effect):
    """The lag of a thermometer, ``z = tau dz_T/dT dT/dt`` with the effects z_T of a fit.

    It has one time for all axes. At a constant rate, a lag of each axis has the curve of hysteresis.
    """

    name, owner, layout = "a lag common to all axes", Owner.SENSOR, Layout.SHARED

    def __init__(self, terms: Terms) -> None:
        self.terms = terms

    def parameters(self, sensor: str) -> tuple[EffectParameter, ...]:
        """Return the time."""
        del sensor
        return (EffectParameter("tau", "s", self.name),)

    def regressors(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        """Return the derivative by tau: (n, 3, 1) array."""
        del values
        assert motion.temperature is not None and motion.temperature_rate is not None  # noqa: S101, PT018
        change = np.zeros_like(motion.specific_force)
        for term, sign in product(self.terms, (1.0, -1.0)):
            side = replace(motion, temperature=motion.temperature + 0.5 * sign)  # degC
            change += sign * term.effect.reading(sensor, side, K, term.values)
        return np.asarray((change * motion.temperature_rate[:, None])[:, :, None])


def loops_of(model: Model, terms: Terms) -> list[EffectColumns]:
    """Return the curves of soaks that heat and cool, given effects: hysteresis, with the sign of dT/dt, and lag."""
    rate = (getattr(model, "soaks", None) or model.rests.select(model.rests.soaked)).temperature_rate
    cold = np.isnan(model.rests.temperature_rate).any()  # some recording holds no temperature
    if cold or not model.rests.swings or len(rate) < FEWEST_PARTS:
        return []
    formula = {"h": {"formula": f"tanh(temperature_rate / {TURNING * float(np.abs(rate).max())!r})", "unit": "1"}}
    own = {"name": "loop", "owner": "recording", "sensors": [model.sensor], "terms": formula, "meaning": "Hysteresis."}
    loop = effect_from(own, "a test of the residual")
    return [EffectColumns(loop, np.zeros(3)), EffectColumns(CommonLag(terms), np.zeros(1))]


def is_hysteresis(judged: Sequence[tuple[float, float]]) -> bool:
    """Return whether soaks show hysteresis rather than lag, by delta BIC and p of ``loops_of``."""
    by_loop, by_lag = (delta for delta, _ in judged)
    return by_loop > by_lag + PREFERRED


def _nonlinear(candidate: Effect, sensor: str) -> Mask:
    """Return which parameters of an effect are not linear: (p,) array."""
    return np.array([p.name in candidate.nonlinear for p in candidate.parameters(sensor)])


def refusal(candidate: Effect, sensor: str, rests: Rests) -> str:
    """Return why an effect cannot be in a model without a table; empty if it can."""
    unknown = [need for need in candidate.needs if need != "temperature"]
    checks = [
        (sensor not in candidate.sensors, f"{candidate.name} is no effect of the {sensor}"),
        (sensor in candidate.unseen, candidate.unseen.get(sensor, "")),
        (candidate.owner == Owner.TABLE or candidate.moves, "there is no table"),
        (candidate.owner == Owner.MOUNTING, "by hand the heading of the unit and the centre of its turns are unknown"),
        ("temperature" in candidate.needs and np.isnan(rests.temperature).any(), "the recordings hold no temperature"),
        (candidate.needs_swing and not rests.swings, NO_SWING),
        (bool(unknown), f"without a table {' and '.join(unknown)} cannot be known"),
        (candidate.needs_clock and not rests.clock_shared, "the time between the recordings is not known"),
    ]
    return next((reason for applies, reason in checks if applies), "")


def no_candidate(candidate: Effect, sensor: str, rests: Rests) -> str:
    """Return why an effect cannot be selected; empty if it can."""
    confused = candidate.name == DRIFT and not rests.repeats
    return ONE_CYCLE if confused else refusal(candidate, sensor, rests)


def posterior(selection: SelectionByHand, hidden: Collection[str]) -> Answers:
    """Return probabilities, answer set and upper limits; ``hidden``: effects that the recordings cannot show."""
    effects = {e.name: e for e in selection.candidates if e.name not in hidden or e.name in selection.names}
    return answers([SetSearch(_problem(selection, effects), seeds=[selection.names])], lambda _: 0, effects)


def _problem(selection: SelectionByHand, effects: Mapping[str, Effect]) -> CandidateProblem:
    model, state = selection.model, selection.fits[-1].state
    configured = len(selection.base.state.terms)
    fitted = {term.effect.name: term for term in state.terms[configured:]}
    constants = {name: time_constants(this, model.sensor, fitted.get(name)) for name, this in effects.items()}
    listed = [(name, term, weight) for name, each in constants.items() for term, weight in each]
    equations = model.equations(state, [term for _, term, _ in listed])
    base = np.concatenate([equations.base, *equations.effects[:configured]], axis=1)
    pairs = zip(listed, equations.candidates, strict=True)
    columns = [Z[:, ~_nonlinear(term.effect, model.sensor)] for (_, term, _), Z in pairs]
    walks = random_walks(h.bias for h in selection.hypotheses)
    hypotheses = [*selection.hypotheses]
    hypotheses += [replace(h, bias=walks[h.bias]) for h in selection.hypotheses if h.bias in walks]
    together = np.concatenate([base, *columns, equations.residual[:, None]], axis=1)
    whitened = [equations.whitened(noise, together) for noise in hypotheses]
    known = base.shape[1]
    products = np.array([white.T @ white for white, _ in whitened])
    logarithm, rank = log_determinants(products[:, :known, :known])
    logarithm += [log for _, log in whitened]
    ends = np.cumsum([0, *(Z.shape[1] for Z in columns)]).tolist()
    samples = len(equations.residual)
    return linear_problem(
        [(name, weight, slice(*span)) for (name, _, weight), span in zip(listed, pairwise(ends), strict=True)],
        without(products, np.arange(known))[:, known:, known:],
        np.sqrt(np.maximum(np.diag(products[0])[known:], 1e-300)),
        np.array([h.prior for h in hypotheses]) - 0.5 * logarithm,
        ({name: term.values for name, term in fitted.items()}, selection.limits),
        excluded([*effects.values()]),
        samples=samples,
        free=float(max(samples - rank, 1)),
        new=MIN_NEW_NORM_SHARE,
        least=1.0,
    )
