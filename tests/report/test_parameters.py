"""Parameters with their uncertainties, read from a sensor's part of a calibration."""

import numpy as np
import pytest
from scipy.linalg import polar
from unit_settings import sheet_of

from pipeline.core.records import Coefficient, FittedEffect, SensorCalibration
from pipeline.output.pages.comparison import unit_figures
from pipeline.output.pages.parameters import fitted_parameters, parameter_rows, reading_errors, sensor_errors
from pipeline.physics.statements import beyond_limits, beyond_words, limited


def part_with_unequal_freedom() -> dict:
    """Return a fit whose bias has 4 and whose effect has 400 effective degrees of freedom."""
    freedom = np.array([4.0] * 3 + [400.0] * 10)
    k = {4.0: 2.776445, 400.0: 1.965912}  # Student's t, 95 %, of published tables
    effect = FittedEffect("scale_factor_asymmetry", {"c_x": Coefficient(0.01, "1", 0.0)})
    covariance = np.diag(np.full(13, 1e-6))
    fit = SensorCalibration("gyroscope", effects=(effect,), covariance=covariance, freedom=freedom)
    budget = {
        "parameters": list(fit.parameters.names),
        "coverage_factor": [k[f] for f in freedom.tolist()],
        "contributions": [],
    }
    part = fit.to_json() | {"uncertainty_budget": budget}
    part["effects"][0]["parameters"]["c_x"]["expanded_uncertainty"] = k[400.0] * 1e-3
    return part


def test_each_parameter_has_its_own_coverage_factor_not_that_of_the_bias() -> None:
    part = part_with_unequal_freedom()
    found = {p.name: p for p in fitted_parameters(part)}
    assert list(found) == part["covariance"]["parameters"]
    assert found["bias_x"].coverage_factor == pytest.approx(2.776445, rel=1e-6)
    assert found["scale_factor_asymmetry.c_x"].coverage_factor == pytest.approx(1.965912, rel=1e-6)
    held_out = {"steps": [{"rms_error": 1.0}]}
    (figures,) = unit_figures({"unit": "U1", "gyroscope": part}, {"gyroscope": held_out}, None)
    compared = figures["parameters"]
    assert compared["scale factor asymmetry: c_x"].standard_uncertainty == pytest.approx(1e-3, rel=1e-6)
    assert compared["bias x"].standard_uncertainty == pytest.approx(1e-3, rel=1e-6)


def test_the_uncertainty_of_the_inverse_is_that_of_drawn_matrices() -> None:
    rng = np.random.default_rng(3)
    matrix = np.eye(3) + 0.05 * rng.standard_normal((3, 3))
    root = 1e-4 * rng.standard_normal((9, 9))
    covariance = np.zeros((12, 12))
    covariance[3:, 3:] = root @ root.T
    part = SensorCalibration("gyroscope", matrix=matrix, covariance=covariance).to_json()
    drawn = matrix + (root @ rng.standard_normal((9, 20_000))).T.reshape(-1, 3, 3)
    K = np.linalg.inv(drawn)
    P = np.array([polar(each, side="left")[1] for each in K[:5000]])
    for p, of in [*((p, K) for p in reading_errors(part)), *((p, P) for p in sensor_errors(part))]:
        axes = p.name.rpartition("_")[2]
        i, j = "xyz".index(axes[0]), "xyz".index(axes[-1])
        true = np.linalg.inv(matrix) if of is K else polar(np.linalg.inv(matrix), side="left")[1]
        assert p.value == pytest.approx(true[i, j] - (i == j))
        assert p.standard_uncertainty == pytest.approx(of[:, i, j].std(), rel=0.05)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_parameter_far_to_either_side_is_beyond_its_limit_and_the_position_of_the_unit_is_not(sign: float) -> None:
    turned = np.array([[np.cos(0.1), -np.sin(0.1), 0.0], [np.sin(0.1), np.cos(0.1), 0.0], [0.0, 0.0, 1.0]])
    K = (np.eye(3) + sign * np.diag([0.06, 0.0, 0.0])) @ turned
    time_constant = {"T": Coefficient(500.0, "s", None)}
    bias = {f"b_{a}": Coefficient(0.1, "deg/s", 0.01) for a in "xyz"}
    warm_up = FittedEffect("warm_up", {**bias, **time_constant})
    matrix, covariance = np.linalg.inv(K), np.eye(16)
    fit = SensorCalibration("gyroscope", np.array([0.0, sign * 5.0, 0.0]), matrix, (), (warm_up,), covariance)
    limits = {"bias": 2.0, "scale_factor": 0.03, "cross_axis": 0.02, "full_scale": 250.0}
    sheet = sheet_of(**limits, effects={"warm_up": 0.6, "warm_up_T": 600.0})
    part = fit.to_json()
    part |= {"beyond_limits": beyond_limits(limited("gyroscope", part, sheet))}
    rows = parameter_rows("gyroscope", part, sheet)
    assert {row["p"].name: row["share"] for row in rows if row["share"] > 1.0} == pytest.approx(
        {"bias_y": 2.5, "scale_factor_x": 2.0}
    )
    assert [row["p"].name for row in rows if row["beyond"]] == ["bias_y", "scale_factor_x"]
    assert beyond_words(part) == "bias y (250 %), scale factor x (200 %)"
