"""Twenty rests by hand name an effect of data-sheet size, 25 a drift: the diagnosis uses all, and judges by folds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hand_simulator import Hand, draw
from unit_settings import settings_of, with_noise

from pipeline.estimation.accelerometer import nonlinear_least_squares
from pipeline.estimation.gyroscope import rests_and_moves
from pipeline.estimation.noise import estimate_noise
from pipeline.estimation.stages import StageInput
from tests.published import diagnose

REAL: dict[str, Any] = {"rests": 20, "vertical": 0.2, "tail_dps": (0.7, 3.0), "creep_dps": 0.03}
G_SENSITIVITY = 0.1 * np.array([[1, -0.8, 0.5], [0.6, -1, 0.7], [-0.9, 0.5, 0.8]])
HIDDEN: list[tuple[str, str, dict[str, Any]]] = [
    ("accelerometer", "quadratic_nonlinearity", {"quadratic": [0.008, -0.009, 0.007]}),
    ("gyroscope", "g_sensitivity", {"g_sensitivity": G_SENSITIVITY}),
    ("gyroscope", "bias_drift", {"gyro_drift": [3e-4, -2e-4, 2.5e-4]}),
    ("accelerometer", "", {}),
    ("gyroscope", "", {}),
]


@pytest.mark.parametrize(("sensor", "name", "effects"), HIDDEN)
def test_twenty_rests_name_what_is_hidden_and_nothing_else(sensor: str, name: str, effects: dict[str, Any]) -> None:
    drawn = draw(Hand(effects=effects, **REAL | ({"rests": 25} if "gyro_drift" in effects else {})), 5)
    recordings, sheet = [drawn.recording], drawn.settings.sensor.of(sensor)
    felt = nonlinear_least_squares.fit(
        StageInput("accelerometer", with_noise(recordings, drawn.settings), None, drawn.settings)
    )
    found = (
        felt
        if sensor == "accelerometer"
        else rests_and_moves.fit(StageInput("gyroscope", with_noise(recordings, drawn.settings), None, drawn.settings))
    )
    part = diagnose(found, recordings, estimate_noise(sensor, recordings, sheet), drawn.settings, felt)
    assert part["selected"] == ([name] if name else [])
    assert part["verdict"] == ("missing_effect" if name else "nothing_missing")
    judged = part["cross_validation"]
    if name == "g_sensitivity":
        assert judged["named"][name] == judged["folds"] == 3
        assert judged["error_after"] < 0.7 * judged["error_before"]
        best = part["ranking"][0]
        assert best["held_out_error_after"] < 0.7 * best["held_out_error_before"]
        assert (best["effect"], best["plausible"], part["override"]) == (name, True, f"effects.{sensor}=[{name}]")
        configured = settings_of(drawn.settings, effects={sensor: [name]})
        mended = diagnose(found, recordings, estimate_noise(sensor, recordings, sheet), configured, felt)
        assert mended["selected"] == []
        assert mended["residual_over_noise"] < 1.5 < part["residual_over_noise"]
    elif not name:
        assert judged is None
        assert part["residual_over_noise"] < 1.5


def test_advice_names_what_too_few_rests_cannot_tell_where_they_scatter() -> None:
    drawn = draw(Hand(effects={"quadratic": [0.003, -0.004, 0.003]}, **REAL), 11)
    recordings = [drawn.recording]
    found = nonlinear_least_squares.fit(
        StageInput("accelerometer", with_noise(recordings, drawn.settings), None, drawn.settings)
    )
    noise = estimate_noise("accelerometer", recordings, drawn.settings.sensor.accelerometer)
    part = diagnose(found, recordings, noise, drawn.settings)
    assert part["selected"] == []
    assert part["residual_over_noise"] > 2.0
    assert "quadratic_nonlinearity" in [entry["effect"] for entry in part["not_observable"]]
    assert "an unsteady hand from quadratic nonlinearity" in part["next_experiment"]
    assert "firmly" not in part["next_experiment"]
