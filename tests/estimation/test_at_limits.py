"""The change by an effect at its limit is that of a fit to the same simulated recordings with the effect."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from ferraris_session import FITS
from unit_settings import settings_of, with_noise

from pipeline.core.records import BIAS, MATRIX, SensorCalibration, base_values
from pipeline.estimation.reference_least_squares import fit as fit_on_table
from pipeline.estimation.stages import StageInput
from pipeline.physics.effects import effect
from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import UnitDescription

SENSOR = "mpu6050"


def values_of(name: str, sensor: str, share: float) -> np.ndarray:
    count = len(effect(name).parameters(sensor))
    limit = settings_of(sensor=SENSOR).sensor.of(sensor).effects[name]
    return share * limit * np.where(np.arange(count) % 2, -1.0, 1.0)


@cache
def fitted(sensor: str, by: str, name: str = "", of: str = "", share: float = 0.0) -> SensorCalibration:
    """Return the fit of a sensor of one unit with an effect at a share of its limits; ``by``: hand or table."""
    hidden = {f"{of}.{name}": values_of(name, of, share).tolist()} if name else {}
    described = {"table": "acutronic", "samples": 3000}
    if by == "hand":
        described = {"table": "hand", "procedure": "multi_position", "interval_s": 0.02}
    unit = UnitDescription("U", sensor=SENSOR, effects=hidden, **described)
    settings = settings_of(sensor=SENSOR, table=unit.table, procedure=unit.procedure)
    recordings = with_noise(simulate_unit(unit, 7, 0)[0], settings)
    return (
        FITS[sensor].fit(StageInput(sensor, recordings, None, settings))
        if by == "hand"
        else fit_on_table(StageInput(sensor, recordings, None, settings))
    )


@pytest.mark.parametrize(
    ("by", "sensor", "of", "name", "share", "tolerance"),
    [
        ("hand", "accelerometer", "accelerometer", "scale_factor_asymmetry", 0.3, 0.05),
        ("hand", "accelerometer", "accelerometer", "cubic_nonlinearity", 0.3, 0.05),
        ("hand", "gyroscope", "accelerometer", "scale_factor_asymmetry", 0.3, 0.25),  # weights depend on the residuals
        ("hand", "gyroscope", "gyroscope", "g_sensitivity", 0.01, 0.1),
        ("table", "accelerometer", "accelerometer", "cubic_nonlinearity", 0.3, 0.02),
        ("table", "gyroscope", "gyroscope", "scale_factor_asymmetry", 0.3, 0.02),
        ("table", "gyroscope", "gyroscope", "g_sensitivity", 0.3, 0.02),
    ],
)
def test_an_effect_changes_the_fit_as_predicted(  # noqa: PLR0917
    by: str, sensor: str, of: str, name: str, share: float, tolerance: float
) -> None:
    before, after = fitted(sensor, by), fitted(sensor, by, name, of, share)
    found = base_values(after.bias, after.matrix) - base_values(before.bias, before.matrix)
    columns = before.at_limits[name if sensor == of else f"{of}.{name}"]
    predicted = columns @ (share * np.where(np.arange(columns.shape[1]) % 2, -1.0, 1.0))
    parts = [BIAS, MATRIX] if sensor == of else [MATRIX]  # an error of gravity's direction hardly changes the bias
    for part in parts:
        assert np.abs(found[part]).max() > 0.0
        assert np.allclose(found[part], predicted[part], rtol=0.0, atol=tolerance * np.abs(found[part]).max() + 1e-5)
