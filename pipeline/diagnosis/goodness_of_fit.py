"""Goodness of fit: the share of simulations from the fitted model that fit worse than the readings.

    T = min over tests of p(2 log L' - 2 log L)

The tests are the smooth curves of ``pipeline.diagnosis.residual_dependence``. The whitened linear model is fitted to
the residual and to draws from the noise of the fit, under every noise setting, so that the share allows for the number
of tests and for the noise that each fit takes (a parametric bootstrap: Davison and Hinkley, Bootstrap Methods and their
Application, 1997, section 4.2).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.diagnosis.residual_dependence import bases_of, curves_of, smooth_tests
from pipeline.diagnosis.residual_regression import ProjectedCurves, columns_of_fit, each_explains
from pipeline.estimation.gauss_markov import GaussMarkov, Products
from pipeline.estimation.ranking import without

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.estimation.observations import Observations
    from pipeline.estimation.selection import Selection

    Values = NDArray[np.float64]

SIMULATIONS = 199  # the share is known to 3.5 % (standard error) at worst


def goodness_of_fit(selection: Selection) -> dict[str, Any]:
    """Return ``share_worse``, the share of simulations that fit worse, and ``simulations``, their number."""
    from scipy.special import chdtrc  # noqa: PLC0415  (0.1 s that only a diagnosis pays)

    bases, observations = bases_of(selection), selection.observations.weakened
    curves = curves_of(bases)
    fitted = ProjectedCurves(selection, curves)
    draws = _draws(selection)
    A, places = columns_of_fit(selection, curves)
    parts = [
        _projected(
            observations,
            fitted,
            np.concatenate([A[:, [*model[:-1], *own]], A[:, model[-1:]] / fitted.scale[c], draws[c]], axis=1),
            len(own),
        )
        for c, (model, own) in enumerate(places)
    ]
    within = np.append(fitted.within, np.full(SIMULATIONS, 3.0 * (observations.samples - len(observations.weight))))
    left = sum(left for _, _, left in parts)  # (t, 1 + s)

    def likelihood(rss: Values) -> Values:
        return np.asarray(fitted.log_likelihood(rss, within).max(axis=0))

    error = fitted.error * fitted.scale[:, None]  # of the products in ``parts``, which hold no scale
    before, least = likelihood(np.asarray(left)), np.ones(1 + SIMULATIONS)
    for _, kept, fewest in smooth_tests(bases, fitted):
        drop = sum(
            np.cumsum(each_explains(inner[:, kept][:, :, kept], cross[:, kept], error[:, c, kept])[0], axis=1)
            for c, (inner, cross, _) in enumerate(parts)
        )
        gain = 2.0 * (likelihood(np.asarray(left)[:, None] - drop) - before)
        p = chdtrc(3 * np.arange(1, len(kept) + 1)[:, None], np.maximum(gain, 0.0))[fewest - 1 :].min(axis=0)
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


def _projected(
    observations: Observations, fitted: ProjectedCurves, columns: Values, curves: int
) -> tuple[Values, Values, Values]:
    """Project base and effects out: inner (t, q, q), cross (t, q, 1 + s) and left (t, 1 + s) of an axis.

    ``columns``: those of the model, q curves, the residual and s draws.
    """
    products = Products(observations.blocks, observations.weight, columns).products(fitted.settings)[0][1:]
    k = columns.shape[1] - 1 - SIMULATIONS - curves
    rest = without(products, np.arange(k))[:, k:, k:]
    return rest[:, :curves, :curves], rest[:, :curves, curves:], np.einsum("tss->ts", rest[:, curves:, curves:])
