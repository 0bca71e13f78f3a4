"""Gates: the evidence that a further effect needs, wherever effects are selected, planned or said to be hidden.

    delta BIC > g   and   m p < 0.01,    g = max(10 or, of a slow effect, 22; 2e-4 G), at most 30

where p is the p-value of the likelihood ratio, m the number of candidates (Bonferroni), and G the gain in 2 log L of
the effects that are already selected, whose equations are of first order. A slow effect depends on time and temperature
alone: wander of the bias that the noise model does not describe has a similar signal.

False selections (docs/evidence.md, measures ``nothing_by_hand``, ``nothing_on_tables``): of 2,000 units by hand with
nothing hidden, 5 gain more than 16 by a slow effect, 3 more than 20, and 1 more than 22 (0.05 %, 95 % interval 0.001 to
0.28 %), all five with five times the stated wander or a random walk; no other effect gains more than 6. Of 1,994
units on tables (3cbfaf00) 2 gain more than 16, none more than 20 (0 to 0.18 %), and no other effect more than 6.

On a table, effects below their gate join the selected ones where the set of all is ``MIN_ANSWER_PROBABILITY`` probable
(``pipeline.estimation.posterior.completed``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy

from pipeline.core.records import Values, coverage_factor
from pipeline.physics.effects import effect
from pipeline.physics.effects.base import Effect

if TYPE_CHECKING:
    from pipeline.estimation.ranking import Score

MIN_DELTA_BIC = 10.0  # "very strong" evidence (Raftery, Sociological Methodology 25, 1995)
MIN_DELTA_BIC_OF_SLOW = 22.0  # of a slow effect, see above
MAX_MIN_DELTA_BIC = 30.0  # largest delta BIC that is required after effects with a large gain
ERROR_OF_FIRST_ORDER = 2e-4  # of the gain in 2 log L of effects: the error of their equations of first order
MIN_ANSWER_PROBABILITY = 0.9  # nothing was selected in 1,996 sensors without an effect (e8e84f42)
MAX_FALSE_PROBABILITY = 0.01  # of a false selection by chance, over all candidates
TIMES_UNCERTAINTY = 2.0  # times the standard uncertainty: about 95 % (JCGM 100:2008, 6.3.3)
TIMES_POSSIBLE = 3.0  # times the sensor file's limit: a parameter beyond, by its 95 % interval, is not possible
MAX_FALSE_DEPENDENCE = 1e-3  # probability that a complete model seems to depend on a covariate, over all tests


def min_delta_bic(this: Effect, sensor: str, selected_gain: float = 0.0) -> float:
    """Return the delta BIC above which an effect may be selected; ``selected_gain``: G, 0 if none is selected."""
    least = MIN_DELTA_BIC_OF_SLOW if this.of_the_room(sensor) else MIN_DELTA_BIC
    return min(max(ERROR_OF_FIRST_ORDER * selected_gain, least), MAX_MIN_DELTA_BIC)


def passes(score: Score, sensor: str, candidates: int, selected_gain: float = 0.0) -> bool:
    """Return whether the evidence for one of so many candidates suffices to select it; see ``min_delta_bic``."""
    enough = score.delta_bic > min_delta_bic(effect(score.name), sensor, selected_gain)
    return bool(enough and score.p_value * candidates < MAX_FALSE_PROBABILITY)


def min_gain(this: Effect, sensor: str, parameters: int, equations: float, candidates: int) -> float:
    """Return the gain in 2 log L at which the first effect passes: ``max(k log N + g, chi^2_k(1 - 0.01/m))``.

    ``parameters``: k. ``equations``: N, the number of readings that are compared with the model. ``candidates``: m.
    """
    by_chance = float(scipy.special.chdtri(parameters, MAX_FALSE_PROBABILITY / candidates))
    return max(parameters * float(np.log(equations)) + min_delta_bic(this, sensor), by_chance)


def within(values: Values, uncertainty: Values, limits: Values | float, times: float = 1.0) -> bool:
    """Return ``|p| - 2 u <= times L`` for every parameter p of an effect, with its limit L: (p,) arrays."""
    return bool(np.all(np.abs(values) - TIMES_UNCERTAINTY * uncertainty <= times * limits))


def possible(values: Values, uncertainty: Values, limits: Values) -> bool:
    """Return whether no parameter of an effect is beyond three times its limit, by its 95 % interval: (p,) arrays."""
    return bool(np.all(np.abs(values) - float(coverage_factor(np.inf)) * uncertainty <= TIMES_POSSIBLE * limits))
