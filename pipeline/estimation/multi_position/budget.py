"""The uncertainty budget of a fit to rests and moves by hand."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.estimation.monte_carlo import trials_of
from pipeline.estimation.multi_position.trials import tried_by_hand
from pipeline.estimation.uncertainty_budget import combined, gravity_contribution, scatter_contribution, type_b
from pipeline.records import NORMAL

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from pipeline.estimation.multi_position.fit import HandFit
    from pipeline.estimation.multi_position.model import Model
    from pipeline.records import SensorCalibration

REMARK = {
    "accelerometer": "white noise, bias wander and what the rests scatter beyond both, as the residuals tell them",
    "gyroscope": "white noise, bias wander, scatter of rests and moves, and the accelerometer's own calibration",
}
NOT_INCLUDED = {
    "table angle, rate and orthogonality, levelling": "there is no table",
    "quantisation": "contained in the noise of the readings, as the rests scatter",
    "temperature": "the parameters hold at the temperature of these recordings; no accuracy of the thermometer is "
    "stated",
}


def budgeted_by_hand(  # noqa: PLR0917  (what a fit by hand is)
    calibration: SensorCalibration,
    covariance: NDArray[np.float64],
    degrees_of_freedom: NDArray[np.float64],
    model: Model,
    found: HandFit,
    settings: Mapping[str, Any],
) -> SensorCalibration:
    """Return a calibration by hand with its uncertainty budget.

    Parameters
    ----------
    calibration : SensorCalibration
    covariance : (p, p) array
        Of all parameters, as the residuals tell it.
    degrees_of_freedom : (p,) array
    model : Model
    found : HandFit
    settings : mapping
        Sections ``table`` (``gravity_g``, ``gravity_accuracy_g``, ``clock_accuracy_ppm``) and ``uncertainty``.
    """
    sensor, size, table = calibration.sensor, len(calibration.parameter_names()), settings["table"]
    scatter = scatter_contribution(covariance, np.inf, remark=REMARK[sensor])
    lines = [scatter.with_freedom(degrees_of_freedom)]
    missing = dict(NOT_INCLUDED)
    if sensor == "accelerometer":
        gravity = gravity_contribution(sensor, calibration.matrix, table, size)
        lines += [gravity] if gravity else []
        missing |= {} if gravity else {"local gravity": "table.gravity_accuracy_g is not stated"}
    elif table.get("clock_accuracy_ppm") is None:
        missing["time base"] = "table.clock_accuracy_ppm is not stated"
    else:  # a rate is an angle over a time: dM = M de
        effect = np.zeros((size, 1))
        effect[3:12, 0] = 1e-6 * calibration.matrix.ravel()
        lines.append(type_b("time base", NORMAL, float(table["clock_accuracy_ppm"]), "ppm", effect))
    if sensor == "gyroscope":
        missing["Earth's rotation"] = "not in the model: by hand nobody knows the heading; up to 0.0042 deg/s of bias"
    complete, trials = combined(calibration, lines, missing), trials_of(settings)
    return tried_by_hand(complete, model, found, trials, lines[1:]) if trials else complete
