from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.core.records import Budget, NotIncluded, SensorCalibration
from pipeline.physics.statements import both_figures, open_words, with_open

U_BIAS = 1e-3 * 1.959964
CALIBRATION = SensorCalibration(
    "accelerometer",
    covariance=np.diag([1e-3] * 3 + [1e-4] * 9) ** 2,
    at_limits={
        "cubic_nonlinearity": np.array([[0.002, -0.001]] * 3 + [[1e-9, 0.0]] * 9),
        "bias_temperature": np.full((12, 1), 0.5),
        "scale_factor_asymmetry": np.full((12, 1), 0.5),
        "bias_temperature_quadratic": np.full((12, 1), 1e-4),
    },
)
HIDDEN = {
    "accelerometer": {
        "cubic_nonlinearity": "few rests", "bias_temperature": "steady", "bias_temperature_quadratic": "steady",
    },
    "gyroscope": {},
}  # fmt: skip


def test_an_open_effect_adds_a_rectangular_distribution() -> None:
    found = with_open("accelerometer", CALIBRATION, HIDDEN)
    names = [entry["effect"] for entry in found["open"]]
    # the quadratic contains the linear change with temperature; the asymmetry is observable
    assert names == ["cubic_nonlinearity", "bias_temperature_quadratic"]
    assert found["open"][0]["up_to"]["bias"] == pytest.approx([0.003] * 3)
    assert found["open"][0]["reason"] == "few rests"
    # k = 1.96: sqrt(1e-6 + 0.003^2 / 3 + 1e-8 / 3)
    expected = 1.959964 * np.sqrt(1e-6 + 0.003**2 / 3.0 + 1e-8 / 3.0)
    assert found["uncertainty_with_open"]["bias"] == pytest.approx([expected] * 3, rel=1e-6)


def test_the_part_of_an_effect_that_the_recordings_show_is_not_open() -> None:
    changes = {"bias_temperature": np.full((12, 1), 0.5), "bias_temperature_quadratic": np.full((12, 2), [0.5, 0.01])}
    hidden = {"accelerometer": {"bias_temperature_quadratic": "below the noise"}, "gyroscope": {}}
    found = with_open("accelerometer", replace(CALIBRATION, at_limits=changes), hidden)
    assert found["open"][0]["up_to"]["bias"] == pytest.approx([0.01] * 3)


def test_without_a_diagnosis_every_effect_is_open() -> None:
    found = with_open("accelerometer", CALIBRATION, {"accelerometer": None, "gyroscope": None})
    assert "scale_factor_asymmetry" in [entry["effect"] for entry in found["open"]]


def test_a_fitted_effect_is_not_open() -> None:
    from pipeline.core.records import FittedEffect  # noqa: PLC0415

    effect = FittedEffect("cubic_nonlinearity", {})
    found = with_open("accelerometer", replace(CALIBRATION, effects=(effect,)), HIDDEN)
    assert [entry["effect"] for entry in found["open"]] == ["bias_temperature_quadratic"]


def test_an_effect_of_the_accelerometer_is_open_for_the_gyroscope_where_it_is_for_the_accelerometer() -> None:
    gyroscope = SensorCalibration(
        "gyroscope",
        covariance=np.eye(12) * 1e-8,
        at_limits={f"accelerometer.{name}": np.full((12, 1), 0.01) for name in ("cubic_nonlinearity", "hysteresis")},
    )
    found = with_open("gyroscope", gyroscope, HIDDEN)
    assert [entry["effect"] for entry in found["open"]] == ["accelerometer.cubic_nonlinearity"]


def test_the_clock_is_open_where_the_budget_does_not_include_it() -> None:
    budget = Budget((), (NotIncluded("time base", "not stated", {"matrix": 0.01}),))
    found = with_open("gyroscope", SensorCalibration("gyroscope", covariance=np.eye(12) * 1e-8, budget=budget), HIDDEN)
    assert found["open"][0]["effect"] == "clock_rate"
    assert np.allclose(found["open"][0]["up_to"]["matrix"], 0.01 * np.eye(3))


def test_both_figures_are_said_where_they_differ_by_more_than_ten_percent() -> None:
    part = {"unit": "g", **CALIBRATION.to_json(), **with_open("accelerometer", CALIBRATION, HIDDEN)}
    assert set(both_figures(part)) >= {"bias_x", "bias_y", "bias_z"}
    ((source, reason),) = open_words(part)
    assert "cubic nonlinearity" in source
    assert f"in place of {U_BIAS:.2g}" in source
    assert "if they are absent" in reason
    assert open_words({**part, "uncertainty_with_open": part["expanded_uncertainty"]}) == []
    assert open_words({k: v for k, v in part.items() if k != "uncertainty_with_open"}) == []  # of an older version
