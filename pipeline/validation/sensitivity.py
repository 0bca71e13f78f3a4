"""Held-out samples beside the derivative of their calibrated readings with respect to the calibration's parameters.

    calibrated = M (reading - b - z):    d/db = -M,    d/dM_ij = e_i (M^-1 calibrated)_j

and for the parameters of effects a difference quotient over one standard uncertainty. Where an effect moves the
reference in time, the change of its magnitude counts along the truth with the opposite sign.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.model.inversion import inverse_of
from pipeline.validation.expected import Judged
from pipeline.validation.ladder import last_step

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from pipeline.records import SensorCalibration
    from pipeline.validation.samples import Samples

    Values = NDArray[np.float64]

ENOUGH = 2000  # samples of a recording that stand for all: its directions and rates change slowly


def judged(
    calibration: SensorCalibration, samples: Samples, truth: Values, other: SensorCalibration | None
) -> Judged | None:
    """Return what the expected error is made of; None where the samples hold nothing, or an effect is left out of them.

    Parameters
    ----------
    calibration : SensorCalibration
    samples : Samples
    truth : (n, 3) array
        Of the reference.
    other : SensorCalibration or None
        Of the other sensor.
    """
    found = last_step(calibration, samples, other)
    known = np.flatnonzero(samples.known)
    if found is None or len(known) == 0:
        return None
    vector, magnitude, _ = found
    shown = known[np.unique(np.linspace(0, len(known) - 1, ENOUGH).astype(int))]
    along = truth[shown] / np.maximum(np.linalg.norm(truth[shown], axis=1, keepdims=True), 1e-300)
    M, size = calibration.matrix, len(calibration.parameter_names())
    J = np.zeros((len(shown), 3, size))
    J[:, :, :3] = -M
    before = vector[shown] @ inverse_of(calibration).T
    for i in range(3):
        J[:, i, 3 + 3 * i : 6 + 3 * i] = before
    for column, changed, step in _steps(calibration):
        moved = last_step(changed, samples, other)
        assert moved is not None  # noqa: S101  (the same effects)
        shift = along * (moved[1] - magnitude)[shown, None]
        J[:, :, column] = (moved[0][shown] - vector[shown] - shift) / step
    return Judged(samples.select(shown), truth[shown], np.nan_to_num(J), len(known))


def _steps(calibration: SensorCalibration) -> Iterator[tuple[int, SensorCalibration, float]]:
    """Yield each parameter of an effect: its column, the calibration with it changed, and by how much."""
    if calibration.covariance is None:
        return
    column = 12
    for n, effect in enumerate(calibration.effects):
        for name, parameter in effect.parameters.items():
            step = float(np.sqrt(max(calibration.covariance[column, column], 0.0)))
            if step > 0.0:
                parameters = {**effect.parameters, name: {**parameter, "value": parameter["value"] + step}}
                effects = list(calibration.effects)
                effects[n] = replace(effect, parameters=parameters)
                yield column, replace(calibration, effects=tuple(effects)), step
            column += 1
