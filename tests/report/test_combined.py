"""Joint estimates of devices that were calibrated several times, against scipy and drawn calibrations."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

from pipeline.core.records import Budget, Contribution, SensorCalibration
from pipeline.output.pages.combined import combined_calibrations, repeatability

TRUTH = np.concatenate([[0.02, -0.01, 0.03], np.eye(3).ravel()])
OWN_U, BENCH_U = 1e-4, 5e-5


def document(unit: str, values: np.ndarray, own_u: float = OWN_U, **changes: Any) -> dict[str, Any]:
    """Return a calibration of the accelerometer as it is published."""
    own, bench = own_u**2 * np.eye(12), BENCH_U**2 * np.eye(12)
    lines = [
        Contribution("noise of the readings", "A", "Student's t", own, np.full(12, 50.0)),
        Contribution("local gravity", "B", "normal", bench, np.full(12, np.inf)),
    ]
    found = SensorCalibration(
        "accelerometer", values[:3], values[3:].reshape(3, 3), covariance=own + bench, degrees_of_freedom=50.0,
        budget=Budget(tuple(line.line() for line in lines), ()),
    )  # fmt: skip
    inputs = [{"file": f"{unit}.csv", "sha256": unit}]
    same = {"status": "ok", "sensor": "mpu6050", "method": "m", "table": "t"}
    return {"unit": unit, "inputs": inputs, **same, "accelerometer": found.to_json(), "gyroscope": None} | changes


def joint(documents: list[dict[str, Any]]) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    rows = [{"unit": d["unit"], "serial": "S1", "status": d["status"]} for d in documents]
    return combined_calibrations(rows, {d["unit"]: d for d in documents}.__getitem__)


def test_repeatability_solves_the_equation_of_paule_and_mandel() -> None:
    rng = np.random.default_rng(1)
    x, variance = rng.normal(0.0, 3.0, (5, 4)), rng.uniform(0.5, 2.0, (5, 4))
    found = repeatability(x, variance, np.arange(4))
    for value, column, own in zip(found, x.T, variance.T, strict=True):

        def excess(r2: float, column: np.ndarray = column, own: np.ndarray = own) -> float:
            w = 1.0 / (own + r2)
            return float(np.sum(w * (column - np.sum(w * column) / np.sum(w)) ** 2) - 4.0)

        assert value**2 == pytest.approx(brentq(excess, 0.0, 1e3) if excess(0.0) > 0.0 else 0.0, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("scatter", [0.0, 3e-4])
def test_the_joint_estimate_of_drawn_calibrations_is_inside_its_uncertainty(scatter: float) -> None:
    rng, inside, found_r = np.random.default_rng(7), [], []
    for _ in range(40):
        common = rng.normal(0.0, BENCH_U, 12)
        drawn = [TRUTH + common + rng.normal(0.0, np.hypot(OWN_U, scatter), 12) for _ in range(4)]
        found, told = joint([document(f"U{k}", x) for k, x in enumerate(drawn)])
        assert told == [{"serial": "S1", "units": ["U0", "U1", "U2", "U3"], "refused": None}]
        part = found["S1"]["accelerometer"]
        value = np.concatenate([part["bias"], np.ravel(part["matrix"])])
        U = np.concatenate([part["expanded_uncertainty"]["bias"], np.ravel(part["expanded_uncertainty"]["matrix"])])
        next_use = TRUTH + rng.normal(0.0, scatter, 12)
        inside.append(np.abs(value - next_use) <= U)
        found_r.append(part["stages"][0]["details"]["repeatability"])
    assert 0.92 < np.mean(inside) <= 0.995  # 480 values: 95 % less three standard errors
    # r^2 = max(0, s^2 - u^2) with s^2 of 9 or 18 degrees of freedom: 0.16 u^2 on average where nothing scatters
    expected = 0.16 * OWN_U**2 if scatter == 0.0 else scatter**2
    assert np.mean(np.square(found_r)) == pytest.approx(expected, rel=0.4 if scatter == 0.0 else 0.1)


def test_more_calibrations_lower_the_noise_and_not_the_error_of_the_bench() -> None:
    count = 16
    found, _ = joint([document(f"U{k}", TRUTH) for k in range(count)])
    variance = np.diag(found["S1"]["accelerometer"]["covariance"]["values"])
    assert variance == pytest.approx(np.full(12, OWN_U**2 / count + BENCH_U**2), rel=1e-6)


def test_small_and_exact_parameters_stand_beside_large_ones() -> None:
    """A clock rate in ppm has 1e14 times the variance of a bias; the matrix is stated without uncertainty."""
    documents = []
    for k, shift in enumerate((-1e-6, 1e-6)):
        found = document(f"U{k}", TRUTH + np.concatenate([np.full(3, shift), np.zeros(9)]))
        part = found["accelerometer"]
        covariance = np.diag([1e-12] * 3 + [0.0] * 9 + [100.0])
        part["covariance"] = {
            "parameters": [*part["covariance"]["parameters"], "clock_rate.e"],
            "values": covariance.tolist(),
        }
        part["effects"] = [{"name": "clock_rate", "parameters": {"e": {"value": 50.0 + k, "unit": "ppm"}}}]
        part["effective_degrees_of_freedom"] = [50.0] * 13
        part["uncertainty_budget"] = {"contributions": []}
        documents.append(found)
    found, _ = joint(documents)
    part = found["S1"]["accelerometer"]
    assert part["bias"] == pytest.approx(TRUTH[:3], abs=1e-12)
    assert part["matrix"] == np.eye(3).tolist()
    assert part["effects"][0]["parameters"]["e"]["value"] == pytest.approx(50.5)
    assert np.diag(part["covariance"]["values"])[12] == pytest.approx(50.0, rel=1e-6)


def test_a_recording_is_never_used_twice() -> None:
    one, other = document("U1", TRUTH), document("U2", TRUTH)
    other["inputs"].append(one["inputs"][0])
    found, told = joint([one, other])
    assert not found
    assert told[0]["refused"] == "U1 and U2 use the same recording, U1.csv"


def test_a_joined_file_is_never_used_twice_but_for_the_log_of_a_table() -> None:
    one, other = document("U1", TRUTH), document("U2", TRUTH)
    for found in (one, other):
        found["inputs"][0]["joined"] = [{"file": "table.csv", "sha256": "t", "table_only": True}]
    assert joint([one, other])[0]
    for found in (one, other):
        found["inputs"][0]["joined"].append({"file": "gyroscope.csv", "sha256": "g"})
    assert joint([one, other])[1][0]["refused"] == "U1 and U2 use the same recording, gyroscope.csv"


def test_calibrations_of_different_methods_have_no_joint_estimate() -> None:
    found, told = joint([document("U1", TRUTH), document("U2", TRUTH, method="staged")])
    assert not found
    assert "differ in method: m, staged" in told[0]["refused"]


def test_a_failed_calibration_does_not_count() -> None:
    assert joint([document("U1", TRUTH), document("U2", TRUTH, status="failed")]) == ({}, [])
