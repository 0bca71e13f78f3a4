"""The posterior over effects in rests and moves by hand: the linear problem of ``pipeline.estimation.evidence``.

Columns are taken at the fit of what was selected, with its values put back into the residual, ``y = r + Z p``.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from pipeline.estimation.candidates import over_limits, time_constants
from pipeline.estimation.evidence import Problem, Version
from pipeline.estimation.gauss_markov import WALK_RATIO, WALK_SHARE, WALK_TIME
from pipeline.estimation.multi_position.likelihood import NEW
from pipeline.estimation.posterior import Answers, Search, answers, excluded
from pipeline.estimation.ranking import without

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.design import Term
    from pipeline.estimation.multi_position.likelihood import NoiseHypothesis
    from pipeline.estimation.multi_position.selection import Selection
    from pipeline.model.effects.base import Effect

    Values = NDArray[np.float64]


def posterior(selection: Selection, hidden: Collection[str], others: Sequence[Effect] = ()) -> Answers:
    """Return probabilities, answer set and upper limits.

    ``hidden``: effects that the recordings cannot show. ``others``: further candidates.
    """
    shown = {this.name: this for this in (*selection.candidates, *others)}
    effects = {name: this for name, this in shown.items() if name not in hidden or name in selection.names}
    return answers([Search(_problem(selection, effects), seeds=[selection.names])], lambda _: 0, effects)


def _problem(selection: Selection, effects: Mapping[str, Effect]) -> Problem:
    """Return the linear problem at the fit of what was selected."""
    model, state = selection.model, selection.fits[-1].state
    held = len(selection.fits[0].state.terms)
    fitted = {term.effect.name: term for term in state.terms[held:]}
    listed: list[tuple[str, Term, float]] = []
    for name, this in effects.items():
        width = None  # of a fitted time constant: as wide as the steps of the grid
        terms = time_constants(this, model.sensor, fitted.get(name), width)
        listed += [(name, term, weight) for term, weight in terms]
    equations = model.equations(state, [term for _, term, _ in listed])
    base = np.concatenate([equations.base, *equations.effects[:held]], axis=1)
    columns = []
    for (_, term, _), Z in zip(listed, equations.candidates, strict=True):
        linear = [p.name not in term.effect.nonlinear for p in term.effect.parameters(model.sensor)]
        columns.append(Z[:, linear])
    readings = equations.residual + sum(
        Z @ fitted[name].values[: Z.shape[1]]
        for (name, term, _), Z in zip(listed, columns, strict=True)
        if name in fitted and term is fitted[name]
    )
    hypotheses = [*selection.hypotheses, *_random_walks(selection.hypotheses)]
    together = np.concatenate([base, *columns, readings[:, None]], axis=1)
    whitened = [equations.whitened(noise, together) for noise in hypotheses]
    known = base.shape[1]
    stacked = np.array([white.T @ white for white, _ in whitened])
    size = np.sqrt(np.maximum(np.einsum("tii->ti", stacked), 1e-300))
    scaled = stacked / (size[:, :, None] * size[:, None, :])
    own = np.linalg.eigvalsh(scaled[:, :known, :known])
    kept = int(np.sum(own[0] > NEW**2))
    logarithm = np.sum(np.log(np.maximum(own[:, -kept:], 1e-300)), axis=1) + 2.0 * np.sum(
        np.log(size[:, :known]), axis=1
    )
    prior = np.array([h.prior for h in hypotheses]) - 0.5 * (np.array([log for _, log in whitened]) + logarithm)
    products = without(stacked, np.arange(known))[:, known:, known:]
    ends = np.cumsum([0, *(Z.shape[1] for Z in columns)]).tolist()
    places = [(name, slice(*span)) for (name, _, _), span in zip(listed, pairwise(ends), strict=True)]
    samples = len(readings)
    products, limits = over_limits(places, products, size[0, known:], selection.limits, samples=samples, least=NEW)
    versions: dict[str, list[Version]] = {}
    for (name, at), (_, _, weight) in zip(places, listed, strict=True):
        versions.setdefault(name, []).append(Version(np.arange(at.start, at.stop), weight))
    free = float(max(samples - kept, 1))
    return Problem(products, prior, 0.0, free, versions, limits, excluded([*effects.values()]))


def _random_walks(hypotheses: Sequence[NoiseHypothesis]) -> list[NoiseHypothesis]:
    """Return the hypotheses with a bias that never settles; see ``pipeline.estimation.gauss_markov.random_walks``."""
    shortest: dict[float, float] = {}
    for h in hypotheses:
        shortest[h.ratio] = min(h.time, shortest.get(h.ratio, h.time))
    share = float(np.log(WALK_SHARE))
    return [
        replace(h, ratio=h.ratio * WALK_RATIO, time=h.time * WALK_TIME, belief=h.belief + share)
        for h in hypotheses
        if h.ratio > 0.0 and h.time == shortest[h.ratio]
    ]
