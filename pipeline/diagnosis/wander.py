"""Whether a fit needs more bias wander than its sensor has: the sign of something slow that the model misses.

A noise model with wander can swallow a missing effect. So the wander under which the readings are most likely,
``sigma_b = q s``, is held against the one that the rests or the data sheet tell,

    inflated:   sigma_b > 3 sigma_expected   and   log L(best) - max {log L(q, tau): q s <= 3 sigma_expected} > 5

where q is its ratio to the white noise s, tau its correlation time, and L has the prior of the noise settings in it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.estimation.selection import INFLATED

if TYPE_CHECKING:
    from pipeline.estimation.selection import Selection
    from pipeline.records import Noise

EVIDENCE = 5.0
LEAST_RATIO = 0.03  # of the white noise: a wander below it is none


def fitted_wander(selection: Selection, noise: Noise | None) -> dict[str, Any]:
    """Return the wander under which base, configured and selected effects explain the readings best.

    Parameters
    ----------
    selection : Selection
    noise : Noise or None
        What the rests or the data sheet tell.

    Returns
    -------
    dict
        ``ratio`` to the white noise, ``time_s`` of its correlation, ``standard_deviation`` and ``expected`` (g or
        deg/s; None where nothing is expected), ``inflated``.
    """
    settings = selection.ranking.settings
    found = selection.ranking.log_likelihoods(selection.chosen())
    best = int(np.argmax(found[1:])) + 1
    white = float(np.sqrt(np.mean(selection.start.scale**2)))
    expected = None if noise is None else float(np.sqrt(np.mean(noise.wander**2)))
    ratio = settings[best].ratio
    inflated = False
    if expected is not None:
        most = INFLATED * max(expected / white, LEAST_RATIO)
        believed = [found[k] for k in range(1, len(settings)) if settings[k].ratio <= most]
        inflated = ratio > most and (not believed or bool(found[best] - max(believed) > EVIDENCE))
    return {
        "ratio": ratio,
        "time_s": settings[best].time if ratio else None,
        "standard_deviation": ratio * white,
        "expected": expected,
        "inflated": bool(inflated),
    }
