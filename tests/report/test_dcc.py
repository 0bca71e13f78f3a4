"""The Digital Calibration Certificate has the structure of DCC 3.2.1 and says what the report says."""

import copy
import html
import json
import re
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from pipeline.core.settings import Certificate
from pipeline.output.pages.certificate import (
    certificate,
    certificate_page,
    digital_certificate,
    dsi_unit,
    missing_for_dcc,
)

from .conftest import Unit, build_unit
from .test_certificate import BUDGET, STATED, settings_of

DCC, SI = "{https://ptb.de/dcc}", "{https://ptb.de/si}"
NAME, DESCRIPTION = ("name", 1, 1), ("description", 0, 1)
TEXT = [("content", 1, None)]
CONTACT = [NAME, ("location", 0, 1)]
# Children of each element in their order, with least and most: from the documentation of DCC 3.2.1 (ptb.de/dcc/v3.2.1)
# and of D-SI 2.1.0; elements that are not written are left out. tests/validate_dcc.py uses the schemas themselves.
STRUCTURE: dict[str, list[tuple[str, int, int | None]]] = {
    "digitalCalibrationCertificate": [("administrativeData", 1, 1), ("measurementResults", 1, 1)],
    "administrativeData": [
        ("dccSoftware", 1, 1), ("coreData", 1, 1), ("items", 1, 1), ("calibrationLaboratory", 1, 1),
        ("respPersons", 1, 1), ("customer", 1, 1), ("statements", 0, 1),
    ],
    "dccSoftware": [("software", 1, None)],
    "software": [NAME, ("release", 1, 1)],
    "coreData": [
        ("countryCodeISO3166_1", 1, 1), ("usedLangCodeISO639_1", 1, None), ("mandatoryLangCodeISO639_1", 1, None),
        ("uniqueIdentifier", 1, 1), ("receiptDate", 0, 1), ("beginPerformanceDate", 1, 1),
        ("endPerformanceDate", 1, 1), ("performanceLocation", 1, 1), ("issueDate", 0, 1),
    ],
    "items": [("item", 1, None)],
    "item": [NAME, DESCRIPTION, ("manufacturer", 0, 1), ("model", 0, 1), ("identifications", 1, 1)],
    "manufacturer": CONTACT,
    "identifications": [("identification", 1, None)],
    "identification": [("issuer", 1, 1), ("value", 1, 1), ("name", 0, 1)],
    "calibrationLaboratory": [("contact", 1, 1)],
    "contact": [NAME, ("location", 1, 1)],
    "customer": [NAME, ("location", 1, 1)],
    "location": [("further", 1, None)],
    "respPersons": [("respPerson", 1, None)],
    "respPerson": [("person", 1, 1), ("role", 0, 1), ("mainSigner", 0, 1)],
    "person": CONTACT,
    "statements": [("statement", 1, None)],
    "statement": [("name", 0, 1), ("declaration", 0, 1)],
    "measurementResults": [("measurementResult", 1, None)],
    "measurementResult": [
        NAME, DESCRIPTION, ("usedMethods", 0, 1), ("measuringEquipments", 0, 1), ("influenceConditions", 0, 1),
        ("results", 1, 1), ("measurementMetaData", 0, 1),
    ],
    "usedMethods": [("usedMethod", 1, None)],
    "usedMethod": [NAME, DESCRIPTION, ("reference", 0, None)],
    "measuringEquipments": [("measuringEquipment", 1, None)],
    "measuringEquipment": [NAME, DESCRIPTION, ("identifications", 0, 1)],
    "influenceConditions": [("influenceCondition", 1, None)],
    "influenceCondition": [NAME, ("data", 1, 1)],
    "results": [("result", 1, None)],
    "result": [NAME, ("data", 1, 1)],
    "data": [("text", 0, None), ("list", 0, None)],
    "list": [("quantity", 1, None)],
    "quantity": [("name", 0, 1), ("noQuantity", 0, 1), ("si:real", 0, 1), ("si:realListXMLList", 0, 1)],
    "si:real": [("si:value", 1, 1), ("si:unit", 1, 1), ("si:expandedUnc", 0, 1)],
    "si:expandedUnc": [
        ("si:uncertainty", 1, 1), ("si:coverageFactor", 1, 1), ("si:coverageProbability", 1, 1),
        ("si:distribution", 0, 1),
    ],
    "si:realListXMLList": [("si:valueXMLList", 1, 1), ("si:unitXMLList", 1, 1)],
    "measurementMetaData": [("metaData", 1, None)],
    "metaData": [("name", 0, 1), ("reference", 0, None), ("declaration", 0, 1), ("conformity", 0, 1)],
    **dict.fromkeys(("name", "description", "declaration", "text", "noQuantity", "further"), TEXT),
}  # fmt: skip
SWEPT = {
    "samples_of": "the samples of the fit",
    "bins": [{"temperature_degc": t, "mean_error": 1e-4 * t, "rms_error": 1e-3, "samples": 50} for t in (12.0, 27.5)],
}


@pytest.fixture(scope="module")
def unit() -> Unit:
    made: Unit = build_unit()
    for sensor in ("accelerometer", "gyroscope"):
        made.calibration[sensor]["uncertainty_budget"] = BUDGET
        made.validation[sensor]["over_temperature"] = SWEPT
    return made


@pytest.fixture(scope="module")
def report(unit: Unit) -> dict[str, Any]:
    return report_of(unit, {})


def report_of(unit: Unit, more: dict[str, Any]) -> dict[str, Any]:
    stated = STATED | {"country": "DE", "item": {"description": "IMU <&> board", "manufacturer": "I"}}
    stated |= {"number": " S1-7 ", "authorised_by": {"name": "A. Person", "role": "head"}} | more
    Certificate.model_validate(stated)
    return certificate(unit.calibration, unit.validation, settings_of(unit, stated), "25.0 to 29.0", unit.diagnosis)


def tag(element: ET.Element) -> str:
    return element.tag.replace(DCC, "").replace(SI, "si:")


def faults(element: ET.Element) -> list[str]:
    """Return where an element departs from the structure: unknown or misplaced children, and wrong counts."""
    name, children = tag(element), [tag(child) for child in element]
    if name not in STRUCTURE:
        text = (element.text or "").strip()
        return [f"{name} has children"] * bool(children) + [f"{name} is empty"] * (not text)
    allowed = STRUCTURE[name]
    order = {child: i for i, (child, _, _) in enumerate(allowed)}
    found = [f"{name}/{child} is unknown" for child in children if child not in order]
    places = [order[child] for child in children if child in order]
    found += [f"{name}: order of {children}"] * (places != sorted(places))
    for child, least, most in allowed:
        count = children.count(child)
        found += [f"{name}/{child}: {count}"] * (count < least or (most is not None and count > most))
    return found + [fault for child in element for fault in faults(child)]


def test_the_structure_is_that_of_the_schema(report: dict[str, Any]) -> None:
    root = ET.fromstring((digital_certificate(report) or "").encode())  # noqa: S314  (our own)
    assert faults(root) == []
    assert root.get("schemaVersion") == "3.2.1"
    assert {tag(e) for e in root.iter()} > {"si:expandedUnc", "si:realListXMLList", "metaData", "manufacturer", "role"}


def test_values_are_those_of_the_report_in_units_of_the_si(report: dict[str, Any]) -> None:
    root = ET.fromstring((digital_certificate(report) or "").encode())  # noqa: S314  (our own)
    results = dict(zip(("accelerometer", "gyroscope"), root.iter(f"{DCC}measurementResult"), strict=True))
    for r in report["measurementResults"]:
        factor = 9.80665 if r["name"] == "accelerometer" else 1.0
        quantities = {q.findtext(f"{DCC}name/{DCC}content"): q for q in results[r["name"]].iter(f"{DCC}quantity")}
        bias, wanted = quantities["bias_y"], r["results"][1]
        assert float(bias.findtext(f"{SI}real/{SI}value") or "nan") == pytest.approx(
            wanted["value"] * factor, rel=1e-15
        )
        unit = r"\metre\second\tothe{-2}" if r["name"] == "accelerometer" else r"\degree\second\tothe{-1}"
        assert bias.findtext(f"{SI}real/{SI}unit") == unit
        expanded = bias.find(f"{SI}real/{SI}expandedUnc")
        assert expanded is not None
        assert float(expanded.findtext(f"{SI}uncertainty") or "nan") == pytest.approx(2.4e-4 * factor)
        assert quantities["matrix_xz"].find(f"{SI}real/{SI}expandedUnc") is None  # the method does not fit it
        residual = quantities["mean residual"].findtext(f"{SI}realListXMLList/{SI}valueXMLList") or ""
        assert [float(x) for x in residual.split()] == pytest.approx([1.2e-3 * factor, 2.75e-3 * factor])
        warmth = quantities["temperature of the sensor"]
        assert warmth.findtext(f"{SI}realListXMLList/{SI}unitXMLList") == r"\degreecelsius"


def test_what_users_wrote_is_text_and_not_markup(report: dict[str, Any]) -> None:
    text = digital_certificate(report) or ""
    assert "IMU &lt;&amp;&gt; board" in text
    assert "<dcc:uniqueIdentifier>S1-7</dcc:uniqueIdentifier>" in text


def test_nothing_is_invented_for_a_report_that_lacks_what_the_schema_demands(report: dict[str, Any]) -> None:
    without = copy.deepcopy(report)
    without["administrativeData"]["coreData"]["countryCodeISO3166_1"] = None
    assert missing_for_dcc(report) == []
    assert missing_for_dcc(without) == ["certificate.country"]
    assert digital_certificate(without) is None


@pytest.mark.parametrize(
    ("unit", "factor", "dsi"),
    [
        ("deg/s/g", 1 / 9.80665, r"\degree\metre\tothe{-1}\second"),
        ("g/(deg/s)", 9.80665, r"\degree\tothe{-1}\metre\second\tothe{-1}"),
        ("g/degC^2", 9.80665, r"\kelvin\tothe{-2}\metre\second\tothe{-2}"),
        ("1/g^2", 9.80665**-2, r"\metre\tothe{-2}\second\tothe{4}"),
        ("ppm", 1e-6, r"\one"),
    ],
)
def test_a_unit_in_the_notation_of_d_si(unit: str, factor: float, dsi: str) -> None:
    found = dsi_unit(unit)
    assert found == (pytest.approx(factor), dsi)


def test_a_unit_that_d_si_does_not_know_is_not_guessed() -> None:
    assert dsi_unit("furlong/s") is None


def test_html_json_and_xml_state_the_same_items_of_the_standard(unit: Unit) -> None:
    """ISO/IEC 17025:2017, 7.8.2.1, 7.8.2.2, 7.8.4.1 and 7.8.4.3."""
    report = report_of(unit, {"next_date": "2027-02-03", "adjusted": None})
    xml, page = digital_certificate(report), certificate_page("U1", report)
    assert xml is not None
    kinds = [json.dumps(report, ensure_ascii=False), xml, html.unescape(page)]
    (ratio,) = re.findall(r"error of the \w+ ([\d.]+) × noise", report["measurementResults"][0]["model"]["sentence"])
    for words in (
        f"not modelled: quadratic nonlinearity; error of the vector {ratio} × noise",
        "Nothing was adjusted in the item: as found are its readings, as left",
        "reproduced in full only",
        "2027-02-03",
        "accelerometer: limits of parameters and effects",
    ):
        assert [words in text for text in kinds] == [True] * 3, words
    first = report["measurementResults"][0]
    assert first["model"]["errorOverNoise"] == pytest.approx(float(ratio), rel=5e-3)
    K = np.linalg.inv(np.array(unit.calibration["accelerometer"]["matrix"]))
    relations = {r["entry"]: r["value"] for r in first["relations"]}
    assert relations["matrix_xy"] == pytest.approx(K[0, 1])
    assert relations["matrix_zz"] == pytest.approx(K[2, 2] - 1.0)
    assert "scale factor error z 0.0515" in page
    assert "scale_factor_error_z" in xml
    assert 'class="signature">Signature of A. Person' in page
    assert ">1</td>" in page  # the unit of the matrix
    adjusted = report_of(unit, {"adjusted": "range set to 4 g"})
    assert "Adjusted: range set to 4 g." in certificate_page("U1", adjusted)
    assert "Next calibration" not in certificate_page("U1", adjusted)


def test_a_report_with_references_does_not_say_that_it_has_none(unit: Unit) -> None:
    for stated, said in ((STATED["equipment"], False), ([], True)):
        report = report_of(unit, {"equipment": stated})
        assert ("no certificate stated" in certificate_page("U1", report)) is said
        assert ("K-113" in certificate_page("U1", report)) is not said or not stated
