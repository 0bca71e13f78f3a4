"""Statistics of a fleet against fleets whose truth is known."""

from __future__ import annotations

from datetime import date, timedelta
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from scipy import stats
from unit_settings import settings_of

from pipeline.output.pages.fleet import _missing_effects, fleet_statistics, parameter_table, write_parameters
from pipeline.output.pages.parameters import unit_parameters

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

DAY = date(2026, 1, 1)


def fleet(values: NDArray[np.float64], model: str = "mpu6050", lots: int = 5) -> tuple[list[dict[str, Any]], Any]:
    rows: list[dict[str, Any]] = [
        {
            "unit": f"U{i}", "serial": f"S{i}", "lot": f"L{i % lots}", "date": str(DAY + timedelta(days=i)),
            "sensor": model, "method": "reference_least_squares",
        }
        for i in range(len(values))
    ]  # fmt: skip
    about = ("gyroscope", "gyroscope_bias_x", None, "deg/s")
    found = {
        row["unit"]: [(*about, float(v), 0.05, 0.1, None, False, True)] for row, v in zip(rows, values, strict=True)
    }
    return rows, parameter_table(found)


def test_a_unit_far_from_its_siblings_is_named_and_no_other() -> None:
    values = np.random.default_rng(1).normal(3.0, 0.5, 400)
    values[17] = 9.0
    rows, found = fleet(values)
    told = fleet_statistics(rows, found)
    assert [(f["name"], f["parameter"]) for f in told["far"]] == [("U17", "gyroscope_bias_x")]
    expected = (9.0 - np.median(values)) / stats.median_abs_deviation(values, scale="normal")
    assert told["far"][0]["z"] == pytest.approx(expected, rel=1e-3)
    (only,) = told["distributions"]
    assert only["robust_standard_deviation"] == pytest.approx(0.5, rel=0.15)
    assert (told["drift"], told["lots"], told["repeatability"]) == ([], [], [])


def test_the_farthest_unit_is_named_first_on_whichever_side_it_is() -> None:
    values = np.random.default_rng(1).normal(3.0, 0.5, 400)
    values[[17, 30, 50]] = 9.0, -6.0, 7.5
    assert [f["name"] for f in fleet_statistics(*fleet(values))["far"]] == ["U30", "U17", "U50"]


def test_units_of_another_model_are_no_siblings() -> None:
    rng = np.random.default_rng(2)
    one, two = fleet(rng.normal(0.0, 1.0, 30)), fleet(rng.normal(100.0, 1.0, 30), "stim300")
    for row in two[0]:
        row["unit"] = "V" + row["unit"]
    second = two[1].assign(unit="V" + two[1]["unit"])
    told = fleet_statistics([*one[0], *two[0]], pd.concat([one[1], second]))
    assert told["far"] == []
    assert [d["sensor"] for d in told["distributions"]] == ["mpu6050", "stim300"]


def test_few_fleets_in_which_nothing_is_wrong_are_said_to_have_something() -> None:
    rng = np.random.default_rng(3)
    told = [fleet_statistics(*fleet(rng.normal(0.0, 1.0, 25))) for _ in range(60)]
    assert sum(bool(t["far"]) for t in told) <= 4
    assert sum(bool(t["drift"] or t["lots"]) for t in told) <= 1


def test_a_fleet_without_serials_lots_and_dates_has_distributions_only() -> None:
    rows, found = fleet(np.random.default_rng(8).normal(0.0, 1.0, 25))
    rows = [row | {"serial": None, "lot": None, "date": ""} for row in rows]
    row = {"unit": "failed", "sensor": "mpu6050", "method": None}
    told = fleet_statistics([*rows, row], found)
    assert [key for key, value in told.items() if value] == ["distributions"]
    assert fleet_statistics([row], parameter_table({"failed": []}))["distributions"] == []


def test_a_parameter_that_no_unit_fits_is_in_the_distributions_only() -> None:
    told = fleet_statistics(*fleet(np.zeros(30)))
    assert [key for key, value in told.items() if value] == ["distributions"]


def test_a_drift_over_the_date_is_found_with_its_size() -> None:
    rng = np.random.default_rng(4)
    values = rng.normal(0.0, 0.1, 200) + 0.002 * np.arange(200)
    (drift,) = fleet_statistics(*fleet(values))["drift"]
    assert drift["per_year"] == pytest.approx(0.002 * 365.25, rel=0.1)
    assert drift["p_value"] < 1e-9


def test_a_lot_that_differs_is_named() -> None:
    values = np.random.default_rng(5).normal(0.0, 0.1, 100)
    values[3::5] += 0.3
    (found,) = fleet_statistics(*fleet(values))["lots"]
    assert found["lot"] == "L3"
    assert found["lot_median"] == pytest.approx(0.3, abs=0.1)


def test_repeatability_is_the_spread_within_devices_not_between_them() -> None:
    rng = np.random.default_rng(6)
    values = np.repeat(rng.normal(0.0, 5.0, 300), 2) + rng.normal(0.0, 0.2, 600)
    rows, found = fleet(values)
    for i, row in enumerate(rows):
        row["serial"] = f"S{i // 2}"
    (told,) = fleet_statistics(rows, found)["repeatability"]
    assert (told["devices"], told["calibrations"]) == (300, 600)
    assert told["standard_deviation"] == pytest.approx(0.2, rel=0.1)


@pytest.mark.parametrize(("scatter", "beyond"), [(0.05, False), (0.2, True)])
def test_calibrations_of_a_device_are_compared_with_their_stated_uncertainty(scatter: float, *, beyond: bool) -> None:
    rng = np.random.default_rng(7)
    values = np.repeat(rng.normal(0.0, 5.0, 100), 3) + rng.normal(0.0, scatter, 300)
    rows, found = fleet(values)
    for i, row in enumerate(rows):
        row["serial"] = f"S{i // 3}"
    (told,) = fleet_statistics(rows, found)["repeatability"]
    groups = values.reshape(100, 3)
    squares = np.sum((groups - groups.mean(axis=1, keepdims=True)) ** 2) / 0.05**2  # u is 0.1 / 2
    assert told["chi_square"] == pytest.approx(squares)
    assert told["degrees_of_freedom"] == 200
    assert told["p_value"] == pytest.approx(stats.chi2.sf(squares, 200))
    assert told["largest_en"] == pytest.approx(np.max(np.ptp(groups, axis=1)) / np.hypot(0.1, 0.1))
    assert told["beyond_uncertainty"] is beyond


def test_missing_effects_are_counted_with_the_lot_that_they_come_from() -> None:
    rows: list[dict[str, Any]] = [
        {"unit": f"U{i}", "lot": f"{i // 10}", "gyroscope_verdict": "nothing_missing"} for i in range(100)
    ]
    for i in range(70, 77):
        rows[i]["gyroscope_selected"] = "g_sensitivity"
    for i in (1, 21, 31, 32, 33, 34):
        rows[i]["gyroscope_selected"] = "warm_up;bias_drift"
    assert _missing_effects(rows) == [
        "missing effect: g_sensitivity (7 of 100 units, gyroscope), all from lot 7 (7 of its 10)",
        "missing effect: warm_up (6 of 100 units, gyroscope), 4 of them from lot 3 (4 of its 10)",
        "missing effect: bias_drift (6 of 100 units, gyroscope), 4 of them from lot 3 (4 of its 10)",
    ]


def test_the_table_holds_every_parameter_with_its_uncertainty_and_unit(tmp_path: Path) -> None:
    fit = {"unit": "g", "bias": [1.0, 2.0, 3.0], "matrix": np.eye(3).tolist()}
    fit |= {"expanded_uncertainty": {"bias": [0.1, 0.2, 0.3], "matrix": np.full((3, 3), 0.01).tolist()}}
    p = {f"b_{a}": {"value": 0.5, "unit": "g/degC", "expanded_uncertainty": 0.05} for a in "xyz"}
    document = {"accelerometer": fit | {"effects": [{"name": "bias_temperature", "parameters": p}]}, "gyroscope": None}
    rows = [{"unit": "U1", "lot": None, "pass": True, "accelerometer_error_after": 0.5}, {"unit": "U2"}]
    parameters = unit_parameters(document, settings_of().sensor)
    write_parameters(tmp_path / "p.parquet", rows, parameter_table({"U1": parameters, "U2": []}))
    table = pq.read_table(tmp_path / "p.parquet")
    first, second = table.to_pylist()
    assert first["accelerometer_bias_y"] == 2.0
    assert first["accelerometer_matrix_xy_expanded_uncertainty"] == 0.01
    assert first["accelerometer_bias_temperature_b_x"] == 0.5
    assert second["accelerometer_bias_y"] is None
    assert table.schema.field("accelerometer_bias_temperature_b_x").metadata == {b"unit": b"g/degC"}
    assert table.num_columns == 4 + 2 * 15
