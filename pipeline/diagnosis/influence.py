"""How far a finding can be trusted: which recordings and seconds drive it, and how well the model fits.

The gain of an effect is a sum over seconds:

    gain = r0^T C^-1 r0 - r1^T C^-1 r1,    r0 = r1 + Z gamma - X (X^T C^-1 X)^-1 X^T C^-1 Z gamma

r1 is the residual of the fit, Z gamma what the effect adds, X the columns of base and other effects, C the noise of the
fit. Both sums are over whitened blocks of time and the scatter within them, so that the gain is a sum over seconds.
Without a recording, the linear model is fitted again: delta BIC and the largest change of a parameter, in its standard
uncertainties, tell whether the finding depends on that recording (Cook, Technometrics 19, 1977).

Goodness of fit is the share of simulations from the fitted model that fit worse than the readings.

    T = min over tests of p(2 log L' - 2 log L)

The tests are the smooth curves of ``pipeline.diagnosis.residual_dependence``. The whitened linear model is fitted to
the residual and to draws from the noise of the fit, under every noise setting, so that the share allows for the number
of tests and for the noise that each fit takes (a parametric bootstrap: Davison and Hinkley, Bootstrap Methods and their
Application, 1997, section 4.2).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from pipeline.diagnosis.residual_dependence import bases_of, curves_of, smooth_tests
from pipeline.diagnosis.residual_regression import ProjectedCurves, Scan, each_explains
from pipeline.estimation.design import BASE, Design, Term, placed
from pipeline.estimation.gauss_markov import GaussMarkov
from pipeline.estimation.generalized_least_squares import Fit, design_at
from pipeline.estimation.observations import without_each_recording
from pipeline.estimation.ranking import projection, without
from pipeline.estimation.selection import GATE_BIC, Selection

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.estimation.observations import Observations
    from pipeline.records import Index, Values

    JSON = dict[str, Any]

MOST_OF = 0.5  # share of the gain that the listed seconds have together
MOST_STRETCHES = 5
DETERMINED = 1e-6  # share of an effect's weakest direction, of that in all recordings: less is not determined


def influence(selection: Selection, names: Sequence[str]) -> list[JSON]:
    """Return for each effect of a selection's fit its recordings and its seconds, those with the largest share first.

    Entries hold ``effect, recordings`` (``recording, share, delta_bic_without, change``), ``seconds`` (``recording,
    from_s, to_s, share``) and ``depends_on``, recordings without which the evidence is gone.
    """
    if not names:
        return []
    own = placed(selection.fit.terms)
    design = design_at(selection.observations.weakened, selection.fit)
    whole = design.products([selection.fit.setting])[0]
    without_each = [
        (design_at(rest, selection.fit).products([selection.fit.setting])[0], rest)
        for rest in without_each_recording(selection.observations.weakened)
    ]
    found = []
    for name in names:
        term, index = own[name][0], np.arange(own[name][1].start, own[name][1].stop)
        gains = _gains_of_blocks(selection, design, whole, term, index)
        recordings = _of_recordings(selection, whole, index, gains, without_each)
        found.append(
            {
                "effect": name,
                "recordings": recordings,
                "seconds": _stretches(selection, gains),
                "depends_on": [r["recording"] for r in recordings if (r["delta_bic_without"] or 0.0) < GATE_BIC],
            }
        )
    return found


def _gains_of_blocks(selection: Selection, design: Design, whole: Values, term: Term, own: Index) -> Values:
    """Return the share of each block in what an effect gains: (m,) array. ``whole``: products of the fit's design."""
    observations, fit = selection.observations.weakened, selection.fit
    described = term.effect.parameters(observations.sensor)
    change = np.zeros(design.count)
    linear = [term.effect.moves or p.name not in term.effect.nonlinear for p in described]
    change[own] = np.where(linear, term.values, 0.0)
    others = np.setdiff1d(np.arange(design.count), own)
    change[others] = -(projection(whole[:, :-1, :-1], others)[0] @ change)
    blocks, weight = observations.blocks, observations.weight
    label, noise, gains = blocks.label(len(weight)), GaussMarkov(blocks, [fit.setting]), np.zeros(len(blocks.first))
    for c in range(3):
        columns, places = design.of_axis(c), design.places(c)[1]
        both = np.stack([columns[:, -1] + columns[:, :-1] @ change[places[:-1]], columns[:, -1]], axis=1)
        means = blocks.sums(weight[:, None] * both) / blocks.weight[:, None]
        inside = np.sum(weight[:, None] * (both - means[label]) ** 2 * [1.0, -1.0], axis=1)
        white = noise.whitened(means)[0] ** 2
        each = np.bincount(label, inside, len(gains))
        each[blocks.order] += white[0] - white[1]
        gains += each / fit.scale[c] ** 2
    total = float(gains.sum())
    return np.asarray(gains / total if total > 0.0 else gains * 0.0)


def _of_recordings(
    selection: Selection,
    whole: Values,
    own: Index,
    gains: Values,
    without_each: Sequence[tuple[Values, Observations]],
) -> list[JSON]:
    """Return the share of each recording in an effect, and what is left of the effect without it."""
    fit, parts = selection.fit, selection.observations.parts
    ends = np.cumsum([len(part.weight) for part in parts])
    of_block = np.searchsorted(ends, selection.observations.blocks.first, side="right")
    least = _weakest(whole, own)
    found = []
    for k, part in enumerate(parts):
        entry: JSON = {"recording": part.name, "share": float(gains[of_block == k].sum())}
        entry |= {"delta_bic_without": None, "change": None}
        if without_each:
            entry |= _refitted(fit, own, least, *without_each[k])
        found.append(entry)
    return sorted(found, key=lambda entry: -entry["share"])


def _weakest(products: Values, own: Index) -> float:
    """Return the least information on an effect's parameters given all others, columns scaled as they are given."""
    others = np.setdiff1d(np.arange(products.shape[1] - 1), own)
    size = np.sqrt(np.maximum(np.diag(products[0])[own], 1e-300))
    return float(np.linalg.eigvalsh(without(products, others)[0][np.ix_(own, own)] / np.outer(size, size))[0])


def _refitted(fit: Fit, own: Index, least: float, products: Values, rest: Observations) -> JSON:
    """Return delta BIC of an effect without a recording, and the largest change of its parameters."""
    within, samples, p = float(np.sum(rest.scatter / fit.scale**2)), 3.0 * rest.samples, products.shape[1] - 1
    others = np.setdiff1d(np.arange(p), own)
    if _weakest(products, own) < DETERMINED * least:
        return {}
    given = without(products, others)
    model = np.zeros(p)
    model[own] = np.concatenate([term.values for term in fit.terms])[own - BASE]
    step = projection(given, own)[0][:, -1]  # about the values of the fit, whose residual is the last column
    left = float(without(given, own)[0, -1, -1])
    size = given[0][np.ix_(own, own)]
    alone = left + float((step + model[own]) @ size @ (step + model[own]))
    gain = samples * float(np.log((alone + within) / (left + within)))
    uncertainty = np.sqrt(np.clip(np.diag(fit.covariance)[own], 1e-300, None))
    return {
        "delta_bic_without": gain - len(own) * float(np.log(samples)),
        "change": float(np.max(np.abs(step) / uncertainty)),
    }


def _stretches(selection: Selection, gains: Values) -> list[JSON]:
    """Return the fewest blocks that have half of the gain, adjacent ones of a recording joined, largest share first."""
    order = np.argsort(-gains)
    count = int(np.searchsorted(np.cumsum(gains[order]), MOST_OF)) + 1
    chosen = np.sort(order[:count])
    observations = selection.observations
    time = np.concatenate([part.motion.time for part in observations.parts])
    ends = np.cumsum([len(part.weight) for part in observations.parts])
    first, last = observations.blocks.first, np.append(observations.blocks.first[1:], len(time)) - 1
    part = np.searchsorted(ends, first, side="right")
    breaks = np.flatnonzero((np.diff(chosen) != 1) | (np.diff(part[chosen]) != 0)) + 1
    found = [
        {
            "recording": observations.parts[part[run[0]]].name,
            "from_s": float(time[first[run[0]]]),
            "to_s": float(time[last[run[-1]]]),
            "share": float(gains[run].sum()),
        }
        for run in np.split(chosen, breaks)
    ]
    return sorted(found, key=lambda stretch: -stretch["share"])[:MOST_STRETCHES]


SIMULATIONS = 199  # the share is known to 3.5 % (standard error) at worst


def goodness_of_fit(selection: Selection) -> dict[str, Any]:
    """Return ``share_worse``, the share of simulations that fit worse, and ``simulations``, their number."""
    bases, observations, scan = bases_of(selection), selection.observations.weakened, Scan(selection)
    fitted = ProjectedCurves(scan, curves_of(bases))
    within = np.append(scan.within, np.full(SIMULATIONS, 3.0 * (observations.samples - len(observations.weight))))
    left, cross = np.zeros((len(scan.left), 1 + SIMULATIONS)), []
    for c, drawn in enumerate(_draws(selection)):
        draws = scan.whitened(scan.scale[c] * drawn)
        left[:, 0] += scan.left[:, c]
        left[:, 1:] += np.einsum("tss->ts", scan.beside(c, draws, draws))[1:]
        own = scan.beside(c, fitted.columns[0], draws)[1:]
        cross.append(np.concatenate([fitted.cross[:, c, :, None], own], axis=2))

    def likelihood(rss: Values) -> Values:
        return np.asarray(scan.log_likelihood(rss, within).max(axis=0))

    before, least = likelihood(left), np.ones(1 + SIMULATIONS)
    for _, kept, fewest in smooth_tests(bases, fitted):
        drop = sum(
            np.cumsum(
                each_explains(fitted.inner[:, c, kept][:, :, kept], own[:, kept], fitted.error[:, c, kept])[0], axis=1
            )
            for c, own in enumerate(cross)
        )
        gain = 2.0 * (likelihood(left[:, None] - drop) - before)
        p = scipy.special.chdtrc(3 * np.arange(1, len(kept) + 1)[:, None], np.maximum(gain, 0.0))[fewest - 1 :].min(
            axis=0
        )
        least = np.minimum(least, p)
    return {"share_worse": float(np.mean(least[1:] <= least[0])), "simulations": SIMULATIONS}


def _draws(selection: Selection) -> Values:
    """Return draws from the noise of the fit, in units of the white noise of one sample: (3, n, s) array."""
    observations, rng = selection.observations.weakened, np.random.default_rng(0)
    blocks, weight = observations.blocks, observations.weight
    label, noise = blocks.label(len(weight)), GaussMarkov(blocks, [selection.fit.setting])
    found = []
    for _ in range(3):
        white = rng.standard_normal((len(weight), SIMULATIONS)) / np.sqrt(weight)[:, None]
        mean = blocks.sums(weight[:, None] * white) / blocks.weight[:, None]
        found.append(white + (noise.draw(rng, SIMULATIONS) - mean)[label])
    return np.stack(found)
