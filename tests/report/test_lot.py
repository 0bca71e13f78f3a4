"""Calibrations with the prior of their lot: their documents against drawn lots, and when there is no prior."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pipeline.core.records import Budget, Coefficient, Contribution, FittedEffect, NoiseParts, SensorCalibration
from pipeline.output.pages.combined import calibration_with_prior, estimates, priors_of

TRUTH = np.concatenate([[0.02, -0.01, 0.03], np.eye(3).ravel()])
OWN_U, BENCH_U, TAU = 1e-4, 3e-4, 1e-4
SENSOR = "accelerometer"
EFFECTS = (
    FittedEffect("bias_temperature", {"c_x": Coefficient(1e-4, "g/degC")}),
    FittedEffect("table_tilt", {"d_x": Coefficient(0.01, "deg")}),
)


def document(
    unit: str, values: np.ndarray, effects: tuple[FittedEffect, ...] = (), lack: float = 0.0, fixed: slice = slice(0)
) -> dict[str, Any]:
    """Return a calibration as it is published, whose bench contributes three times what its readings do.

    ``lack``: how much of the readings' standard uncertainty is lack of fit. ``fixed``: parameters that the method does
    not estimate.
    """
    size, estimated = len(values), np.ones(len(values))
    estimated[fixed] = 0.0
    own, bench = OWN_U**2 * np.diag(estimated), BENCH_U**2 * np.diag(estimated)
    lines = [
        Contribution(
            "noise of the readings",
            "A",
            "Student's t",
            own,
            np.full(size, 50.0),
            parts=NoiseParts(lack_of_fit=np.full(size, lack * OWN_U)),
        ),
        Contribution("local gravity", "B", "normal", bench, np.full(size, np.inf)),
    ]
    given = zip(effects, values[12:], strict=True)
    fitted = tuple(e.at([v] * len(e.parameters)) for e, v in given)
    found = SensorCalibration(
        SENSOR, values[:3], values[3:12].reshape(3, 3), effects=fitted, covariance=own + bench,
        freedom=np.where(estimated, 50.0 * 10.0**2, np.inf), degrees_of_freedom=5000.0,
        budget=Budget(tuple(line.line() for line in lines), ()),
    )  # fmt: skip
    same = {"sensor": "mpu6050", "table": "t", "procedure": "p", "methods": {SENSOR: "m"}}
    return {"unit": unit, **same, SENSOR: found.to_json(), "gyroscope": None}


def lot(rng: np.random.Generator, units: int, size: int = 12, error: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return truth and estimates of a lot; ``error``: of the table, in all estimates."""
    middle = np.concatenate([TRUTH, [1e-4, 0.01]])[:size]
    truth = middle + TAU * rng.normal(size=(units, size))
    return truth, truth + OWN_U * rng.normal(size=(units, size)) + error


def with_priors(documents: list[dict[str, Any]], diagnoses: Any = None, **rows: Any) -> tuple[list[Any], Any]:
    """Return each unit's calibration with the prior (None where it has none), its prior, and what the fleet tells."""
    found = [
        e
        for d in documents
        for e in estimates(rows.get(d["unit"], {"lot": "7"}), d, (diagnoses or {}).get(d["unit"], {}))
    ]
    priors, told = priors_of(found)
    own = [priors[d["unit"], SENSOR] for d in documents]
    return [(calibration_with_prior(d, {SENSOR: p}), p) for d, p in zip(documents, own, strict=True)], told


def test_the_prior_never_reduces_the_error_of_a_shared_table() -> None:
    """The table's error is in every sibling: with TAU = OWN_U the readings' part halves, the table's stays."""
    rng, inside, errors = np.random.default_rng(1), [], []
    for _ in range(15):
        error = BENCH_U * rng.normal(size=12)
        truth, x = lot(rng, 16, error=error)
        found, _ = with_priors([document(f"U{i}", v) for i, v in enumerate(x)])
        for t, (calibrated, _) in zip(truth, found, strict=True):
            if calibrated is None:
                continue
            part = calibrated[SENSOR]
            value = np.concatenate([part["bias"], np.ravel(part["matrix"])])
            U = np.concatenate([part["expanded_uncertainty"]["bias"], np.ravel(part["expanded_uncertainty"]["matrix"])])
            bench = next(c for c in part["uncertainty_budget"]["contributions"] if c["type"] == "B")
            assert bench["contribution"] == pytest.approx([BENCH_U] * 12)
            inside.append(np.abs(value - t) <= U)
            errors.append(value - t - error)
    assert 0.91 < np.mean(inside) < 0.98  # 180 errors of tables: 95 % within three standard errors
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(OWN_U * np.sqrt(0.5), rel=0.1)


def test_the_budget_states_what_the_lot_contributes() -> None:
    _, x = lot(np.random.default_rng(2), 20)
    found, told = with_priors([document(f"U{i}", v) for i, v in enumerate(x)])
    calibrated, prior = found[0]
    part = calibrated[SENSOR]
    lines = {c["source"]: np.array(c["contribution"]) for c in part["uncertainty_budget"]["contributions"]}
    assert list(lines) == [
        "noise of the readings",
        "prior of the lot",
        "stated accuracies of the bench, and lack of fit",
    ]
    u = np.concatenate([part["standard_uncertainty"]["bias"], np.ravel(part["standard_uncertainty"]["matrix"])])
    assert np.sqrt(np.sum([line**2 for line in lines.values()], axis=0)) == pytest.approx(u)
    assert calibrated["lot_prior"][SENSOR]["siblings"] == prior.siblings == 19
    assert told[0] == {
        "lot": "mpu6050, lot 7", "sensor": SENSOR, "units": [f"U{i}" for i in range(20)], "with_prior": 20,
        "outliers": [], "without": {},
    }  # fmt: skip


def test_a_lot_whose_method_keeps_elements_fixed_has_a_prior_for_the_others() -> None:
    _, x = lot(np.random.default_rng(5), 12)
    x[:, 4:7] = TRUTH[4:7]
    documents = [document(f"U{k}", values, fixed=slice(4, 7)) for k, values in enumerate(x)]
    (estimate,) = estimates({"lot": "7"}, documents[0], {})
    assert np.isfinite(estimate.freedom).all()  # JSON has neither NaN nor infinity
    for (found, prior), values in zip(with_priors(documents)[0], x, strict=True):
        assert not prior.refused
        assert np.ravel(found[SENSOR]["matrix"])[1:4].tolist() == values[4:7].tolist()
        assert np.ravel(found[SENSOR]["expanded_uncertainty"]["matrix"])[1:4].tolist() == [0.0, 0.0, 0.0]
        assert found[SENSOR]["bias"] != values[:3].tolist()


def test_the_lack_of_fit_is_not_reduced_as_siblings_may_share_it() -> None:
    _, x = lot(np.random.default_rng(8), 20)
    found, _ = with_priors([document(f"U{i}", v, lack=0.8) for i, v in enumerate(x)])
    lines = {
        c["source"]: np.array(c["contribution"]) for c in found[0][0][SENSOR]["uncertainty_budget"]["contributions"]
    }
    assert lines["stated accuracies of the bench, and lack of fit"] == pytest.approx(np.hypot(BENCH_U, 0.8 * OWN_U))
    assert np.all(lines["noise of the readings"] < 0.6 * OWN_U)  # sqrt(1 - 0.8^2) without the prior


def test_effects_of_the_table_have_no_prior() -> None:
    _, x = lot(np.random.default_rng(3), 20, size=14)
    found, _ = with_priors([document(f"U{i}", v, EFFECTS) for i, v in enumerate(x)])
    prior = found[0][0]["lot_prior"][SENSOR]
    assert prior["parameters"][-1] == "bias_temperature.c_x"
    own, tilt = found[0][0][SENSOR]["effects"]
    assert tilt["parameters"]["d_x"]["value"] == pytest.approx(x[0, 13], abs=1e-12)
    assert own["parameters"]["c_x"]["value"] != pytest.approx(x[0, 12], abs=1e-6)
    assert own["parameters"]["c_x"]["expanded_uncertainty"] < tilt["parameters"]["d_x"]["expanded_uncertainty"]


def test_an_outlier_is_calibrated_without_the_prior() -> None:
    _, x = lot(np.random.default_rng(4), 20)
    x[5, 1] += 2e-3
    found, told = with_priors([document(f"U{i}", v) for i, v in enumerate(x)])
    assert found[5][0] is None
    assert "differs from its 19 siblings" in found[5][1].refused
    assert told[0]["outliers"] == ["U5"]
    assert found[0][1].siblings == 18


def test_who_has_no_prior_and_is_no_sibling() -> None:
    _, x = lot(np.random.default_rng(5), 24)
    documents = [document(f"U{i}", v) for i, v in enumerate(x)]
    documents[0][SENSOR]["converged"] = False
    documents[2] |= {"table": "another"}
    diagnoses = {"U1": {SENSOR: {"verdict": "missing_effect"}}}
    found, _ = with_priors(documents, diagnoses, U3={"lot": "8"})
    assert found[0][1].refused == "the fit of its accelerometer did not converge"
    assert found[1][1].refused == "the diagnosis of its accelerometer: missing effect"
    assert "1 devices of the lot can be compared, 9 or more are needed; the other units" in found[2][1].refused
    assert found[3][1].lot == "mpu6050, lot 8"
    assert found[3][1].refused
    assert found[4][1].siblings == 19


def test_calibrations_of_one_device_are_no_siblings_of_each_other() -> None:
    _, x = lot(np.random.default_rng(6), 12)
    documents = [document(f"U{i}", v) for i, v in enumerate(x)]
    same = {"lot": "7", "serial": "S"}
    found, _ = with_priors(documents, U0=same, U1=same)
    assert [prior.siblings for _, prior in found] == [10, 10, *[10] * 10]


def test_without_a_stated_uncertainty_there_is_no_prior() -> None:
    _, x = lot(np.random.default_rng(7), 12)
    documents = [document(f"U{i}", v) for i, v in enumerate(x)]
    for each in documents:
        each[SENSOR]["covariance"]["values"] = np.zeros((12, 12)).tolist()
    assert with_priors(documents)[0][0][1].refused == "the method states no uncertainty of the accelerometer"
