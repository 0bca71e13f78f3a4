"""The largest plausible size of an effect's parameters, from the sensor's configuration.

``effects`` of a sensor's configuration names a limit for each effect. Where the parameters of an effect differ in unit,
``<effect>_<parameter>`` (the parameter's name or its part before the axis) goes before it: ``warm_up_time_constant``.
What is one setup's own has the limits of the effect. An effect of the user's own brings its limits itself; the sensor's
configuration goes before them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from pipeline.model.effects.base import Effect


def parameter_limits(effect: Effect, sensor: str, limits: Mapping[str, float]) -> NDArray[np.float64]:
    """Return the limit of each parameter's absolute value: (p,) array, infinite where the configuration has none.

    Parameters
    ----------
    effect : Effect
    sensor : str
    limits : mapping of str to float
        ``effects`` of the sensor's configuration.
    """
    found, own = [], effect.name.partition("@")[0]
    if own not in limits:
        limits = {**effect.limits(sensor), **limits}
    for parameter in effect.parameters(sensor):
        symbol = parameter.name.rpartition("_")[0]
        names = (f"{own}_{parameter.name}", f"{own}_{symbol}", own)
        found.append(next((float(limits[name]) for name in names if name in limits), np.inf))
    return np.array(found)
