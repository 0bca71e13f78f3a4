"""Find the recordings and seconds that show an effect, and whether the evidence depends on one recording.

The gain of an effect is a sum over seconds:

    gain = r0^T C^-1 r0 - r1^T C^-1 r1,    r0 = r1 + Z gamma - X (X^T C^-1 X)^-1 X^T C^-1 Z gamma

with the residual r1 of the fit, the signal Z gamma of the effect, the columns X of base and other effects, and the
noise C of the fit. Both terms are sums over whitened blocks of time and the scatter within them. Without each
recording, the linear model is fitted again, for delta BIC and the largest change of a parameter in standard
uncertainties (Cook, Technometrics 19, 1977).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.records import BASE_COUNT
from pipeline.estimation.design import Design, EffectColumns, placed
from pipeline.estimation.gates import min_delta_bic
from pipeline.estimation.gauss_markov import GaussMarkov
from pipeline.estimation.generalized_least_squares import JointFit, design_at
from pipeline.estimation.observations import without_each_recording
from pipeline.estimation.ranking import projection, without

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.core.files import JSON
    from pipeline.core.records import Index, Values
    from pipeline.estimation.observations import Observations
    from pipeline.estimation.selection import Selection


MOST_OF = 0.5  # share of the gain that the listed seconds have together
MAX_INFLUENTIAL_STRETCHES = 5
DETERMINED = 1e-6  # least information on an effect's weakest direction, over that of all recordings


def influence(selection: Selection, names: Sequence[str]) -> list[JSON]:
    """Return the recordings and seconds that show each effect of a selection's fit, those with the largest share first.

    Entries: ``effect, recordings`` (``recording, share, delta_bic_without, change``), ``seconds`` (``recording, from_s,
    to_s, share``) and ``depends_on``, the recordings without which the evidence is below the gate.
    """
    if not names:
        return []
    observations, fit = selection.observations.less_stop_errors, selection.fit
    slices = placed(fit.terms)
    design = fit.design(observations)
    products = design.products([fit.setting])[0]
    without_each = [
        (design_at(rest, fit).products([fit.setting])[0], rest) for rest in without_each_recording(observations)
    ]
    ends = np.cumsum([len(part.weight) for part in observations.parts])
    of_block = np.searchsorted(ends, observations.blocks.first, side="right")  # index of the recording
    found = []
    for name in names:
        term, index = slices[name][0], np.arange(slices[name][1].start, slices[name][1].stop)
        shares = _shares_of_blocks(selection, design, products, term, index)
        least, gate = DETERMINED * _weakest(products, index), min_delta_bic(term.effect, observations.sensor)
        recordings: list[JSON] = []
        for k, part in enumerate(observations.parts):
            entry: JSON = {"recording": part.name, "share": float(shares[of_block == k].sum())}
            refitted = _refitted(fit, index, least, *without_each[k]) if without_each else {}
            recordings.append({**entry, "delta_bic_without": None, "change": None, **refitted})
        recordings.sort(key=lambda entry: -entry["share"])
        found.append(
            {
                "effect": name,
                "recordings": recordings,
                "seconds": _stretches(observations, shares, of_block),
                "depends_on": [r["recording"] for r in recordings if (r["delta_bic_without"] or 0.0) < gate],
            }
        )
    return found


def _shares_of_blocks(
    selection: Selection, design: Design, products: Values, term: EffectColumns, index: Index
) -> Values:
    """Return the share of each block in the gain of an effect: (m,) array."""
    observations, fit = selection.observations.less_stop_errors, selection.fit
    change = np.zeros(design.count)
    nonlinear = () if term.effect.moves else term.effect.nonlinear
    linear = [p.name not in nonlinear for p in term.effect.parameters(observations.sensor)]
    change[index] = np.where(linear, term.values, 0.0)
    others = np.setdiff1d(np.arange(design.count), index)
    change[others] = -(projection(products[:, :-1, :-1], others)[0] @ change)
    blocks, weight = observations.blocks, observations.weight
    label, noise, gains = blocks.label(len(weight)), GaussMarkov(blocks, [fit.setting]), np.zeros(len(blocks.first))
    for c in range(3):
        columns, places = design.of_axis(c), design.places(c)[1]
        both = np.stack([columns[:, -1] + columns[:, :-1] @ change[places[:-1]], columns[:, -1]], axis=1)
        means = blocks.sums(weight[:, None] * both) / blocks.weight[:, None]
        inside = np.sum(weight[:, None] * (both - means[label]) ** 2 * [1.0, -1.0], axis=1)
        white = noise.whitened(means)[0] ** 2
        of_axis = np.bincount(label, inside, len(gains))
        of_axis[blocks.order] += white[0] - white[1]
        gains += of_axis / fit.scale[c] ** 2
    total = float(gains.sum())
    return np.asarray(gains / total if total > 0.0 else gains * 0.0)


def _weakest(products: Values, index: Index) -> float:
    """Return the least information on an effect's parameters given all others, with columns of unit norm."""
    others = np.setdiff1d(np.arange(products.shape[1] - 1), index)
    size = np.sqrt(np.maximum(np.diag(products[0])[index], 1e-300))
    return float(np.linalg.eigvalsh(without(products, others)[0][np.ix_(index, index)] / np.outer(size, size))[0])


def _refitted(fit: JointFit, index: Index, least: float, products: Values, rest: Observations) -> JSON:
    """Return delta BIC of an effect and the largest change of its parameters without a recording.

    Empty if the information of the other recordings, ``rest``, is below ``least``.
    """
    if _weakest(products, index) < least:
        return {}
    within, samples, p = float(np.sum(rest.scatter / fit.scale**2)), 3.0 * rest.samples, products.shape[1] - 1
    given = without(products, np.setdiff1d(np.arange(p), index))
    values = np.concatenate([term.values for term in fit.terms])[index - BASE_COUNT]
    step = projection(given, index)[0][:, -1]  # from the values of the fit, whose residual is the last column
    left = float(without(given, index)[0, -1, -1])
    alone = left + float((step + values) @ given[0][np.ix_(index, index)] @ (step + values))
    gain = samples * float(np.log((alone + within) / (left + within)))
    uncertainty = np.sqrt(np.clip(np.diag(fit.covariance)[index], 1e-300, None))
    return {
        "delta_bic_without": gain - len(index) * float(np.log(samples)),
        "change": float(np.max(np.abs(step) / uncertainty)),
    }


def _stretches(observations: Observations, shares: Values, of_block: Index) -> list[JSON]:
    """Return the fewest seconds that have half of the gain, adjacent blocks of a recording joined, largest first."""
    order = np.argsort(-shares)
    chosen = np.sort(order[: int(np.searchsorted(np.cumsum(shares[order]), MOST_OF)) + 1])
    time = np.concatenate([part.motion.time for part in observations.parts])
    first, last = observations.blocks.first, np.append(observations.blocks.first[1:], len(time)) - 1
    breaks = np.flatnonzero((np.diff(chosen) != 1) | (np.diff(of_block[chosen]) != 0)) + 1
    found = [
        {
            "recording": observations.parts[of_block[run[0]]].name,
            "from_s": float(time[first[run[0]]]),
            "to_s": float(time[last[run[-1]]]),
            "share": float(shares[run].sum()),
        }
        for run in np.split(chosen, breaks)
    ]
    return sorted(found, key=lambda stretch: -stretch["share"])[:MAX_INFLUENTIAL_STRETCHES]
