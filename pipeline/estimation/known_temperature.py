"""State the known coefficients of temperature of a sensor (``method=known_temperature``); for both sensors.

    z = b_T (T - 25 degC) + k_T (T - 25 degC) u

are the effects ``bias_temperature`` and ``scale_factor_temperature``, by axis, with the truth u. They are subtracted
from the readings of the stages after this one (``pipeline.estimation.stages``). Of the settings
``sensor.<sensor>.known_temperature``, ``bias`` is b_T, in g or deg/s per degC. ``scale_factor`` is the relative change
s per degC of the scale factor against that at ``reference_degc`` T_r; with a scale factor of about 1,

    k_T = s / (1 + s (25 degC - T_r))

The bias is fitted, and that at T_r differs from that at 25 degC by a constant: for ``bias`` T_r is of no consequence.
"""

from __future__ import annotations

import numpy as np

from pipeline.core.errors import ConfigurationError
from pipeline.core.records import FittedEffect
from pipeline.core.settings import DataSheet
from pipeline.estimation.stages import FitStage
from pipeline.physics.effects import fitted_effect
from pipeline.physics.effects.base import REFERENCE_TEMPERATURE

NAME = "known_temperature"


def known(sensor: str, data_sheet: DataSheet) -> list[FittedEffect]:
    """Return the effects with known parameters; raise ``ConfigurationError`` if the settings state no coefficient."""
    stated, values = data_sheet.known_temperature, {}
    if stated.bias is not None:
        values["bias_temperature"] = np.array(stated.bias)
    if stated.scale_factor is not None:
        s = np.array(stated.scale_factor)
        values["scale_factor_temperature"] = s / (1.0 + s * (REFERENCE_TEMPERATURE - stated.reference_degc))
    if not values:
        lack = f"sensor.{sensor}.{NAME} states neither bias nor scale_factor"
        raise ConfigurationError(f"{lack}: state a coefficient, or choose another method.{sensor}")
    return [fitted_effect(name, sensor, of_axes) for name, of_axes in values.items()]


FIT_STAGES = {NAME: FitStage(changes=("readings",), known=known)}
