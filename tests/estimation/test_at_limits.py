"""The change by an effect at its limit is that of a fit to the same simulated recordings with the effect."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hand_session import METHODS
from unit_settings import settings_of, with_noise

from pipeline.app.one_unit import unit_of_recordings
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
    """Return the fit of a sensor of one unit with an effect at a share of its limits; ``by``: a procedure, or table."""
    hidden = {f"{of}.{name}": values_of(name, of, share).tolist()} if name else {}
    described = {"table": "acutronic", "samples": 3000}
    if by != "table":
        described = {"table": "hand", "procedure": by, "interval_s": 0.02}
    unit = UnitDescription("U", sensor=SENSOR, effects=hidden, **described)
    settings = settings_of(sensor=SENSOR, table=unit.table, procedure=unit.procedure)
    recordings = with_noise(simulate_unit(unit, 7, 0)[0], settings)
    return (
        METHODS[sensor].fit(StageInput(sensor, recordings, None, settings))
        if by != "table"
        else fit_on_table(StageInput(sensor, recordings, None, settings))
    )


@pytest.mark.parametrize(
    ("by", "sensor", "of", "name", "share", "tolerance"),
    [
        ("multi_position", "accelerometer", "accelerometer", "scale_factor_asymmetry", 0.3, 0.05),
        ("multi_position", "accelerometer", "accelerometer", "cubic_nonlinearity", 0.3, 0.05),
        ("orientations_24", "accelerometer", "accelerometer", "hysteresis", 0.3, 0.05),  # where moves are the shortest
        (
            "multi_position",
            "gyroscope",
            "accelerometer",
            "scale_factor_asymmetry",
            0.3,
            0.25,
        ),  # weights depend on the residuals
        ("multi_position", "gyroscope", "gyroscope", "g_sensitivity", 0.01, 0.1),
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
    # An error of gravity's direction hardly changes the bias; nor does the last move of an axis that hardly changed.
    parts = [BIAS, MATRIX] if sensor == of and name != "hysteresis" else [MATRIX]
    for part in parts:
        assert np.abs(found[part]).max() > 0.0
        assert np.allclose(found[part], predicted[part], rtol=0.0, atol=tolerance * np.abs(found[part]).max() + 1e-5)


def test_by_hand_hysteresis_and_a_warm_up_that_outlasts_the_recording_are_open() -> None:
    constant = {"accelerometer.warm_up": [0.01, -0.01, 0.01, 1500.0]}  # by which a session of minutes moves its bias
    unit = UnitDescription("U", table="hand", procedure="multi_position", interval_s=0.02, effects=constant)
    recordings, truth = simulate_unit(unit, 7, 0)
    layers = ["table=hand", "procedure=multi_position", "sensor=mpu6050", "method=rests_and_moves"]
    state = unit_of_recordings(recordings, layers).run_to("calibration")
    part = state.calibration["accelerometer"]
    error = np.abs(np.array(part["bias"]) - truth["accelerometer"]["bias"])
    assert np.all(error > 5.0 * np.array(part["expanded_uncertainty"]["bias"]))
    assert np.all(error < 1.2 * np.array(part["uncertainty_with_open"]["bias"]))
    reasons = {entry["effect"]: entry["reason"] for entry in part["open"]}
    assert reasons["warm_up"].startswith("with its longest time constant it would hide")
    assert reasons["hysteresis"] == "by hand the direction of the last move before a rest is not logged"
