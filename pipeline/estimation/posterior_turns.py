"""Compute the posterior over effects in turns on a table: a linear problem for each relevant set of timing effects.

Columns are computed at the fit of the selected effects. The readings are linearised there: ``y = r + Z p`` with the
residual r, the columns Z and the values p of the selected effects. An effect of timing changes the motion and so all
columns; if sets with other timing effects are probable, the fit is repeated with these effects.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.records import BASE_COUNT
from pipeline.estimation.candidates import SECOND, SECOND_SHARE, time_constants
from pipeline.estimation.design import Design, EffectColumns, placed
from pipeline.estimation.evidence import CandidateProblem, linear_problem
from pipeline.estimation.gauss_markov import WHITE_SETTING, random_walks
from pipeline.estimation.generalized_least_squares import JointFit, design_at, fit_terms
from pipeline.estimation.posterior import Answers, SetSearch, answers, excluded
from pipeline.estimation.ranking import MIN_NEW_COLUMN_SHARE, without
from pipeline.estimation.selection import DELAYS, Selection

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from pipeline.core.records import Values
    from pipeline.physics.effects.base import Effect


WORTH_A_FIT = 0.01  # probability of the sets with the same other timing effects, above which these are fitted
MOST_FITS = 3  # of other timing effects
LEAST_LAG_S = 1e-4  # a smaller lag has the column of a time offset, whose sign is free


def posterior(selection: Selection, hidden: Collection[str], others: Sequence[Effect] = ()) -> Answers:
    """Return probabilities, answer set and upper limits.

    ``hidden``: effects that the recordings cannot show. ``others``: further candidates.
    """
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
    """Fit base, configured effects and a set of others."""
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


def _versions(sensor: str, fit: JointFit, term: EffectColumns) -> list[tuple[EffectColumns, float]]:
    """Return the terms of an effect and their prior log weights."""
    fitted, place = placed(fit.terms).get(term.effect.name, (None, slice(0)))
    width = None
    if fitted is not None and term.effect.nonlinear:
        last = place.stop - 1
        width = float(np.sqrt(fit.covariance[last, last]) / max(abs(fitted.values[-1]), 1e-300))
    terms = time_constants(term.effect, sensor, fitted, width, between=bool(fit.terms))
    second = float(np.log(SECOND_SHARE)) if term.effect.name in SECOND[sensor] else 0.0
    return [(replace(each, full=False, prior=term.prior), weight + second) for each, weight in terms]


def _products(
    selection: Selection, fit: JointFit, listed: Sequence[tuple[str, EffectColumns, float]], known: int
) -> tuple[Design, Values, Values, Values, list[slice]]:
    """Return a design at a fit, the products of its base, those of the other columns, log determinants, and places.

    The base is projected out of the other columns. The places are those of the listed terms. If the fit has no effects,
    the products are those of the selection's ranking. ``known``: number of columns of the base.
    """
    ranking, walks = selection.ranking, [*random_walks(selection.settings).values()]
    places = {
        (term.effect.name, term.values.tobytes()): at
        for term, at in zip(ranking.candidates, ranking.design.slices, strict=False)
    }
    keys = [(name, term.values.tobytes()) for name, term, _ in listed]
    if fit.terms or any(key not in places for key in keys):
        configured = fit.terms[: len(selection.base.terms)]
        design = design_at(selection.observations, fit, [*configured, *(term for _, term, _ in listed)])
        stacked, logarithms = design.products([WHITE_SETTING, *selection.settings, *walks])
        projected = without(stacked, np.arange(known))[:, known:, known:]
        return design, stacked[:, :known, :known], projected, logarithms, design.slices[len(configured) :]
    stacked, logarithms = ranking.design.products(walks)
    projected = without(stacked, np.arange(known))[:, known:, known:]
    base = np.concatenate([ranking.stacked[:, :known, :known], stacked[:, :known, :known]])
    projected = np.concatenate([ranking.projected, projected])
    return ranking.design, base, projected, np.append(ranking.logarithms, logarithms), [places[key] for key in keys]


def _problem(selection: Selection, fit: JointFit, candidates: Mapping[str, EffectColumns]) -> CandidateProblem:
    """Return the linear problem at a fit."""
    observations = selection.observations
    configured = fit.terms[: len(selection.base.terms)]
    fitted = {t.effect.name: t.values for t in fit.terms[len(configured) :]}
    listed = [
        (name, term, weight)
        for name, candidate in candidates.items()
        for term, weight in _versions(observations.sensor, fit, candidate)
    ]
    known = BASE_COUNT + sum(len(term.values) for term in configured)
    design, base, products, logarithms, places = _products(selection, fit, listed, known)
    settings = [WHITE_SETTING, *selection.settings, *random_walks(selection.settings).values()]
    size = np.where(design.sizes() > 0.0, design.sizes(), 1.0)
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
