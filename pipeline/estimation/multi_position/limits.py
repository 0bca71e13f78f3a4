"""Pseudo-observations of parameters that the recordings do not determine, by the limits of the sensor file."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.records import base_values
from pipeline.estimation.multi_position.model import EquationBlock

if TYPE_CHECKING:
    from collections.abc import Mapping

    from imu_logs.log import Values
    from pipeline.estimation.multi_position.model import State

# Parameters that are 1 in an ideal sensor; all others are 0.
ONE = {f"{prefix}{axis}" for axis in "xyz" for prefix in ("scale_factor_", f"matrix_{axis}")}


def limit_block(known: Mapping[str, float], columns: Values, state: State, unit: float = 1.0) -> EquationBlock:
    """Return the pseudo-observations of parameters that the sensor file's limits alone determine.

    ``known``: name to standard uncertainty; ``columns``: (k, 12), derivative of each by bias and matrix; ``unit``:
    factor of the errors that are reported.
    """
    u = np.array(list(known.values()))
    ideal = np.array([float(name in ONE) for name in known])
    return EquationBlock(
        (ideal - columns @ base_values(state.bias, state.matrix)) / u,
        columns / u[:, None],
        lambda term: np.zeros((len(u), len(term.values))),
        unit * u,
    )
