"""The laboratory's report claims what was stated and measured, and names what is missing."""

import copy
from typing import Any

import pytest

from pipeline.core.settings import Certificate, Settings, Stated
from pipeline.output.pages.certificate import STAMP, certificate
from pipeline.output.pages.certificate import certificate_page as render

from .conftest import Unit, build_unit

STATED: dict[str, Any] = {
    "name": "lab",
    "number": "{serial}-7",
    "laboratory": {"name": "Example Laboratory", "address": "1 Gyro Street"},
    "place": "room 3",
    "customer": {"name": "A Customer", "contact": "a@example.org"},
    "item": {"description": "breadboard IMU"},
    "issued": "2026-03-01",
    "authorised_by": {"name": "A. Person"},
    "method": {"deviations": "none"},
    "equipment": [{"name": "rate table", "certificate": "K-113"}],
    "traceability": "through K-113",
    "conformity": {"specification": "sheet 4", "decision_rule": "simple acceptance"},
}
NEEDED = [
    ("number",),
    ("laboratory", "name"),
    ("laboratory", "address"),
    ("place",),
    ("customer", "name"),
    ("customer", "contact"),
    ("item", "description"),
    ("issued",),
    ("authorised_by", "name"),
    ("method", "deviations"),
    ("equipment",),
    ("traceability",),
    ("conformity", "decision_rule"),
]


BUDGET = {
    "parameters": [*(f"bias_{a}" for a in "xyz"), *(f"matrix_{a}{b}" for a in "xyz" for b in "xyz")],
    "units": ["g"] * 3 + ["1"] * 9,
    "contributions": [],
    "standard_uncertainty": [1e-4] * 5 + [0.0] + [1e-4] * 6,
    "effective_degrees_of_freedom": [6.5] * 12,
    "coverage_factor": [2.4] * 12,
    "expanded_uncertainty": [2.4e-4] * 5 + [0.0] + [2.4e-4] * 6,
    "not_included": [{"source": "wobble", "reason": "wobble is not stated"}],
}


@pytest.fixture(scope="module")
def unit() -> Unit:
    made = build_unit()
    for sensor in ("accelerometer", "gyroscope"):
        made.calibration[sensor]["uncertainty_budget"] = BUDGET
    return made


def settings_of(unit: Unit, stated: dict[str, Any], **table: Any) -> Settings:
    return unit.settings.replaced(
        table=unit.settings.table.replaced(**{"gravity_accuracy_g": 1e-5} | table),
        certificate=Certificate.model_validate(stated),
        stated=Stated(row={"serial": "S1", "date": "2026-02-03"}),
    )


def report_of(unit: Unit, stated: dict[str, Any], **table: Any) -> dict[str, Any]:
    return certificate(unit.calibration, unit.validation, settings_of(unit, stated, **table), "25.0 to 29.0")


def test_a_report_states_full_scale_sample_rates_and_filter(unit: Unit) -> None:
    calibration = {**unit.calibration, "inputs": [{"rate_hz": rate} for rate in (100.0, 8.333333, None, 50.0)]}
    report = certificate(calibration, unit.validation, settings_of(unit, STATED), None)
    for result, full_scale in zip(report["measurementResults"], ("full scale, g", "full scale, deg/s"), strict=True):
        conditions = result["influenceConditions"]
        assert conditions[full_scale] == unit.settings.sensor.of(result["name"]).full_scale
        assert conditions["sample rate, Hz"] == "8.33 to 100"
        assert conditions["filter before the fit"] == unit.settings.filter.name


def test_a_report_of_which_nothing_is_stated_is_no_certificate_and_claims_no_traceability(unit: Unit) -> None:
    report = report_of(unit, {"name": "blank"})
    assert not report["complete"]
    assert report["stamp"].startswith(STAMP)
    assert {"traceability", "name of the laboratory", "authorising person"} <= {m["what"] for m in report["missing"]}
    assert report["administrativeData"]["statements"]["traceability"] is None
    page = render("U1", report)
    assert "NOT A CALIBRATION CERTIFICATE" in page
    assert '<dt>Traceability</dt><dd><span class="faint">not stated</span>' in page


def test_a_report_of_which_everything_is_stated_is_complete(unit: Unit) -> None:
    report = report_of(unit, STATED)
    assert report["missing"] == []
    assert report["stamp"] is None
    core = report["administrativeData"]["coreData"]
    assert (core["uniqueIdentifier"], core["beginPerformanceDate"]) == ("S1-7", "2026-02-03")
    page = render("U1", report)
    for expected in ("Example Laboratory", "through K-113", "End of the report", "before", "simple acceptance"):
        assert expected in page
    assert "NOT A CALIBRATION" not in page


@pytest.mark.parametrize("key", NEEDED, ids=".".join)
def test_each_thing_that_the_standard_asks_for_is_missed(unit: Unit, key: tuple[str, ...]) -> None:
    stated = copy.deepcopy(STATED)
    inner = stated
    for step in key[:-1]:
        inner = inner[step]
    del inner[key[-1]]
    report = report_of(unit, stated)
    assert [m["key"] for m in report["missing"]] == ["certificate." + ".".join(key)]


def test_a_fit_without_uncertainties_makes_no_certificate(unit: Unit) -> None:
    part = copy.deepcopy(unit.calibration["gyroscope"])
    del part["uncertainty_budget"]
    settings = settings_of(unit, STATED)
    report = certificate(unit.calibration | {"gyroscope": part}, unit.validation, settings, None)
    assert {m["what"] for m in report["missing"]} == {"uncertainty of the gyroscope", "conditions of influence"}
    assert all(q["expandedUnc"] is None for q in report["measurementResults"][1]["results"])
    assert "1.70" in render("U1", report)


def test_each_result_carries_the_uncertainty_of_the_calibrations_budget(unit: Unit) -> None:
    results = report_of(unit, STATED)["measurementResults"][0]["results"]
    assert [q["name"] for q in results] == BUDGET["parameters"]
    assert results[0]["expandedUnc"]["uncertainty"] == BUDGET["expanded_uncertainty"][0]
    assert results[4]["value"] == unit.calibration["accelerometer"]["matrix"][0][1]
    assert results[5]["expandedUnc"] is None  # the method does not fit it
    page = render("U1", report_of(unit, STATED))
    assert "0.03100 ± 0.00024" in page
    assert "wobble is not stated" in page


def test_the_errors_before_and_after_are_those_of_the_readings_and_of_the_last_step(unit: Unit) -> None:
    for result in report_of(unit, STATED)["measurementResults"]:
        first, *_, last = unit.validation[result["name"]]["steps"]
        for key, expected in (("beforeAdjustment", first), ("afterAdjustment", last)):
            assert result[key].items() <= expected.items()
        assert result["afterAdjustment"]["rms_error"] < result["beforeAdjustment"]["rms_error"]


def test_the_accuracy_of_gravity_is_asked_for(unit: Unit) -> None:
    report = report_of(unit, STATED, gravity_accuracy_g=None)
    assert [m["key"] for m in report["missing"]] == ["table.gravity_accuracy_g"]


def test_the_accuracy_of_a_clock_that_can_exceed_the_uncertainty_is_asked_for(unit: Unit) -> None:
    clock = {"source": "time base", "reason": "table.clock_accuracy_ppm is not stated", "up_to": {"matrix": 0.01}}
    calibration = copy.deepcopy(unit.calibration)
    calibration["gyroscope"]["uncertainty_budget"] = {**BUDGET, "not_included": [clock]}
    report = certificate(calibration, unit.validation, settings_of(unit, STATED), "25.0 to 29.0")
    assert [(m["what"], m["key"]) for m in report["missing"]] == [
        ("accuracy of the clock of the gyroscope", "table.clock_accuracy_ppm")
    ]


def test_only_a_table_that_moves_the_item_has_its_mounting_in_the_matrix(unit: Unit) -> None:
    for motion in ("logged", "commanded", "none"):
        page = render("U1", report_of(unit, STATED, motion=motion))
        assert ("mounting of the item" in page) == (motion != "none")


def test_what_a_laboratory_writes_is_escaped_in_the_page_and_in_its_style(unit: Unit) -> None:
    hostile = '"; } </style><script>alert(1)</script>'
    page = render("U1", report_of(unit, STATED | {"number": hostile, "place": hostile}))
    assert hostile not in page
    assert "<script>alert" not in page
    assert page.count("</style>") == 1
