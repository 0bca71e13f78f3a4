"""The calibration report of a laboratory, as ISO/IEC 17025:2017 requires in 7.8.2.1, 7.8.4.1 and 7.8.6.

It contains the measured results and the statements of the laboratory in its ``certificate`` config. If statements are
missing, the report lists them and has a stamp that it is no calibration certificate. Traceability is printed as stated,
or as not stated. Names follow the Digital Calibration Certificate (PTB, DCC 3) where it has one; units are g (9.80665
m/s^2) and deg/s.

In XML it is a Digital Calibration Certificate (PTB, DCC 3.2.1 with D-SI 2.1.0), in units of the SI: accelerations in
m/s^2, rates in deg/s, temperature differences in K. If a statement is missing that its schema requires, this file is
not written, and the report states the reason.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import product, repeat
from operator import attrgetter
from typing import Any

from markupsafe import Markup

from pipeline.core.files import JSON
from pipeline.core.records import AXES, SENSORS
from pipeline.core.settings import Certificate, Settings
from pipeline.core.verdicts import DOUBTS, KINDS, Verdict, error_of
from pipeline.evaluation.diagnosis.words import plain
from pipeline.output.outcome import run_command
from pipeline.output.pages.held_out_section import first_and_last_step
from pipeline.output.pages.pages import number, template
from pipeline.output.pages.parameters import Parameter, fitted_parameters, reading_errors
from pipeline.output.pages.unit_page import files_read
from pipeline.physics.statements import beyond_uncertainty, frame_words

STAMP = "NOT A CALIBRATION CERTIFICATE - incomplete: "
ONLY_THIS_ITEM = "The results relate only to the item calibrated."
COVERAGE = (
    "The expanded uncertainty is the standard uncertainty multiplied by the coverage factor k of each value, for a "
    "coverage probability of about 95 %."
)
REPRODUCTION = "This report may be reproduced in full only, unless the laboratory approves otherwise."
NOT_ADJUSTED = "Nothing was adjusted in the item: as found are its readings, as left those with this calibration."
SOFTWARE_SAYS = "Accreditation and traceability are the laboratory's statements; the software asserts neither."
DAY = re.compile(r"\d{4}-\d{2}-\d{2}")
CERTIFIED_ERRORS = ("rms_error", "mean_abs_error", "max_error", "min_error", "vector_rms_error")
ASKED = (
    ("name of the laboratory", "7.8.2.1 b", "certificate.laboratory.name"),
    ("address of the laboratory", "7.8.2.1 b", "certificate.laboratory.address"),
    ("place of performance", "7.8.2.1 c", "certificate.place"),
    ("unique identification", "7.8.2.1 d", "certificate.number"),
    ("customer", "7.8.2.1 e", "certificate.customer.name"),
    ("contact of the customer", "7.8.2.1 e", "certificate.customer.contact"),
    ("description of the item", "7.8.2.1 g", "certificate.item.description"),
    ("serial number of the item", "7.8.2.1 g", "serial in units.csv"),
    ("date of performance", "7.8.2.1 i", "certificate.performed.begin"),
    ("date of issue", "7.8.2.1 j", "certificate.issued"),
    ("deviations from the method", "7.8.2.1 n", "certificate.method.deviations"),
    ("authorising person", "7.8.2.1 o", "certificate.authorised_by.name"),
    ("conditions of influence", "7.8.4.1 b", "certificate.environment"),
    ("reference equipment", "7.8.4.1 c", "certificate.equipment"),
    ("traceability", "7.8.4.1 c", "certificate.traceability"),
)  # statements that the standard requires: name, clause and the key to set
# Required by the schema (https://www.ptb.de/dcc/v3.2.1/dcc.xsd), in addition to ISO/IEC 17025.
DEMANDED = {"certificate.country": "countryCodeISO3166_1"}
PLACES = ("laboratory", "customer", "laboratoryBranch", "customerBranch", "other")  # of performance, by the schema
# Units of this product: factor to the SI, and powers of the units of D-SI (D-SI 2.1.0, BIPM SI brochure, table 8: deg).
SI_UNITS: dict[str, tuple[float, dict[str, int]]] = {
    "1": (1.0, {}),
    "ppm": (1e-6, {}),
    "g": (9.80665, {"metre": 1, "second": -2}),
    "deg": (1.0, {"degree": 1}),
    "s": (1.0, {"second": 1}),
    "m": (1.0, {"metre": 1}),
    "degC": (1.0, {"kelvin": 1}),  # in slopes: a difference
}
UNIT_TOKEN = re.compile(r"(\([^()]*\)|[^/()^]+)(?:\^(\d+))?")


def certificate(
    calibration: JSON,
    validation: JSON | None,
    settings: Settings,
    temperature: str | None,
    diagnosis: JSON | None = None,
) -> JSON:
    """Return the report of a calibrated unit; ``temperature``: range in degC, None where it was not recorded."""
    stated = settings.certificate
    document: JSON = {
        "schema": "imu-calibration/certificate/1",
        "administrativeData": _administrative(calibration, stated, settings.stated.row),
        "measurementResults": [
            _result(sensor, calibration, (validation or {}).get(sensor) or {}, settings, temperature)
            | {"model": model_state((validation or {}).get(sensor), (diagnosis or {}).get(sensor))}
            for sensor in SENSORS
            if calibration.get(sensor)
        ],
        "source": {
            "calibration": f"calibrations/{calibration['unit']}.json",
            "config_sha256": calibration.get("config_sha256"),
            "inputs": files_read(calibration.get("inputs")),
            "command": run_command(settings.stated.run) if settings.stated.run else None,
        },
    }
    wanted = _wanted(document, stated)
    missing = [{"what": w, "clause": clause, "key": key} for w, clause, key, value in wanted if not value]
    stamp = STAMP + ", ".join(m["what"] for m in missing) if missing else None
    return {"complete": not missing, "stamp": stamp, "missing": missing, **document}


def _administrative(calibration: JSON, stated: Certificate, row: JSON) -> JSON:
    serial, date = row.get("serial"), row.get("date") or ""
    begin = stated.performed.begin or (date if DAY.fullmatch(date) else None)
    return {
        "dccSoftware": [{"name": n, "release": v} for n, v in (calibration.get("software") or {}).items()],
        "coreData": {
            "title": stated.title,
            "uniqueIdentifier": stated.number_of(calibration["unit"], serial or ""),
            "countryCodeISO3166_1": stated.country,
            "usedLangCodeISO639_1": "en",
            "receiptDate": stated.received,
            "beginPerformanceDate": begin,
            "endPerformanceDate": stated.performed.end or begin,
            "performanceLocation": stated.place,
            "issueDate": stated.issued,
            "nextDate": stated.next_date,
        },
        "items": [
            {
                "name": stated.item.description or f"inertial measurement unit {calibration.get('sensor')}",
                "manufacturer": stated.item.manufacturer,
                "model": calibration.get("sensor"),
                "identifications": [
                    {"issuer": "manufacturer", "name": "serial number", "value": serial},
                    {"issuer": "laboratory", "name": "unit", "value": calibration["unit"]},
                ],
                "condition": stated.item.condition,
            }
        ],
        "calibrationLaboratory": stated.laboratory.json_value,
        "respPersons": [stated.authorised_by.json_value],
        "customer": stated.customer.json_value,
        "statements": {
            "item": ONLY_THIS_ITEM,
            "uncertainty": COVERAGE,
            "traceability": stated.traceability,
            "sampling": stated.sampling,
            "externalResults": stated.external_results,
            "opinions": stated.opinions,
            "adjustment": f"Adjusted: {stated.adjusted}." if stated.adjusted else NOT_ADJUSTED,
            "reproduction": REPRODUCTION,
            "software": SOFTWARE_SAYS,
        },
    }


def _result(sensor: str, calibration: JSON, held_out: JSON, settings: Settings, temperature: str | None) -> JSON:
    part, stated, table = calibration[sensor], settings.certificate, settings.table
    first, last = first_and_last_step(held_out)
    rates = sorted({number(row["rate_hz"]) for row in calibration.get("inputs") or [] if row.get("rate_hz")}, key=float)
    return {
        "name": sensor,
        "unit": part["unit"],
        "equation": "truth = matrix (reading - bias - effects)",
        "usedMethods": [
            {
                "name": (calibration.get("methods") or {}).get(sensor) or calibration.get("method"),
                "procedure": calibration.get("procedure"),
                "document": stated.method.document,
                "deviations": stated.method.deviations,
            }
        ],
        "measuringEquipments": [
            *(used.json_value for used in stated.equipment),
            {
                "name": f"table {calibration.get('table')}",
                "used_for": "motion of reference",
                "configured": table.json_value,
            },
        ],
        "influenceConditions": {
            f"full scale, {part['unit']}": settings.sensor.of(sensor).full_scale,
            "sample rate, Hz": " to ".join([*rates[:1], *rates[1:][-1:]]) or None,
            "filter before the fit": settings.filter.name,
            "temperature of the sensor, degC": temperature,
            "local gravity, g": table.gravity_g,
            "accuracy of local gravity, g": table.gravity_accuracy_g,
            "laboratory": stated.environment,
        },
        "suppliedByOthers": _supplied(calibration, sensor, held_out),
        "results": _quantities(part),
        "relations": [
            {"entry": entry, "name": p.name, "value": p.value, "unit": p.unit, "uncertainty": p.expanded_uncertainty}
            for entry, p in _relations(part)
        ],
        "frame": frame_words(part) or None,
        "notInUncertainty": [f"{source}: {reason}" for source, reason in beyond_uncertainty(part)],
        "beyondLimits": part.get("beyond_limits") or [],
        "notDetermined": part.get("not_determined") or None,
        "uncertaintyBudget": part.get("uncertainty_budget"),
        "beforeAdjustment": {k: first.get(k) for k in CERTIFIED_ERRORS} if first else None,
        "afterAdjustment": {k: last.get(k) for k in CERTIFIED_ERRORS} if last else None,
        "noiseFloor": held_out.get("noise_floor"),
        "vectorNoiseFloor": held_out.get("vector_noise_floor"),
        "residualsOverTemperature": held_out.get("over_temperature"),
        "conformity": {
            **stated.conformity.json_value,
            "checks": held_out.get("limits") or [],
            "pass": held_out.get("pass"),
        },
    }


def model_state(held_out: JSON | None, found: JSON | None) -> JSON:
    """Return which effects of a sensor are not modelled, its verdict and its error over noise, and a sentence of it."""
    verdict, error = (found or {}).get("verdict"), error_of(held_out)
    missing = [plain(name) for name in (found or {}).get("selected") or []] * (verdict == Verdict.MISSING_EFFECT)
    said = f"not modelled: {', '.join(missing)}" if missing else KINDS[verdict].meaning if verdict in KINDS else ""
    if verdict == Verdict.NOTHING_MISSING:
        said = "complete as far as the recordings show"
    ratio = f"error of the {error.kind} {number(error.ratio)} × noise" if error.ratio else ""
    decided = (found or {}).get("decided_by") if verdict in DOUBTS else ""
    sentence = "; ".join(filter(None, [said or "not diagnosed", decided, ratio]))
    return {
        "verdict": verdict,
        "notModelled": missing,
        "error": error.kind,
        "errorOverNoise": error.ratio,
        "sentence": sentence,
    }


def _supplied(calibration: JSON, sensor: str, held_out: JSON) -> str:
    """Return the data that neither the recordings nor the laboratory determined (ISO/IEC 17025, 7.8.2.2)."""
    names = {"source": "white noise", "wander_source": "bias wander", "correlation_time_source": "its correlation time"}
    noise = [words for key, words in names.items() if (held_out.get("noise") or {}).get(key) == "data_sheet"]
    given = ", ".join([*noise, "limits of parameters and effects"])
    return f"sensor file {calibration.get('sensor')}, by the manufacturer's data sheet, {sensor}: {given}"


def _relations(part: JSON) -> Iterator[tuple[str, Parameter]]:
    """Yield each entry of the matrix with the element of K, its inverse, that has the same indices."""
    found = {p.name: p for p in reading_errors(part)}
    for row, column in product(AXES, repeat=2):
        name = f"scale_factor_error_{row}" if row == column else f"cross_axis_{row}{column}"
        yield f"matrix_{row}{column}", found[name]


def _quantities(part: JSON) -> list[JSON]:
    """Return each parameter with its uncertainty, None where the method fixes the parameter or states none."""
    budget = part.get("uncertainty_budget")
    keys = ("expanded_uncertainty", "standard_uncertainty", "coverage_factor", "effective_degrees_of_freedom")
    known = zip(*(budget[key] for key in keys), strict=True) if budget else repeat((None, 0.0, None, None))
    rows = []
    for p, (U, u, k, freedom) in zip(fitted_parameters(part), known, strict=False):
        expanded = {"uncertainty": U, "standardUncertainty": u, "coverageFactor": k}
        expanded |= {"effectiveDegreesOfFreedom": freedom, "coverageProbability": 0.95, "distribution": "t"}
        rows.append({
            "name": p.name, "value": p.value, "unit": p.unit, "expandedUnc": expanded if u > 0.0 else None,
            "uncertaintyWithOpenEffects": p.with_open,
        })  # fmt: skip
    return rows


def _wanted(document: JSON, stated: Certificate) -> Iterator[tuple[str, str, str, Any]]:
    """Yield the statements that the standard requires: name, clause, the key to set, and the statement if known."""
    core, results = document["administrativeData"]["coreData"], document["measurementResults"]
    conditions = [r["influenceConditions"] for r in results]
    measured = all(c["temperature of the sensor, degC"] is not None for c in conditions)
    known = {
        "certificate.number": core["uniqueIdentifier"],
        "certificate.performed.begin": core["beginPerformanceDate"],
        "certificate.customer.contact": stated.customer.contact or stated.customer.address,
        "certificate.environment": stated.environment or measured,
        "serial in units.csv": document["administrativeData"]["items"][0]["identifications"][0]["value"],
    }
    issued, performed = core["issueDate"], core["endPerformanceDate"]
    if issued and performed and str(issued) < str(performed):
        yield "date of issue after the calibration", "7.8.2.1 j", "certificate.issued", None
    for what, clause, key in ASKED:
        yield what, clause, key, known[key] if key in known else attrgetter(key.partition(".")[2])(stated)
    if any(r["name"] == "accelerometer" for r in results):
        accuracy = conditions[0]["accuracy of local gravity, g"]
        yield "accuracy of local gravity", "7.8.4.1 a", "table.gravity_accuracy_g", accuracy is not None
    for r in results:
        sensor, uncertain = r["name"], any(q["expandedUnc"] for q in r["results"])
        yield f"uncertainty of the {sensor}", "7.8.4.1 a", "method=reference_least_squares", uncertain
        yield f"results of the {sensor} before and after", "7.8.4.1 d", "a held-out recording", r["beforeAdjustment"]
        if any("clock_accuracy_ppm is" in line or "clock rate" in line for line in r["notInUncertainty"]):
            yield f"accuracy of the clock of the {sensor}", "7.8.4.1 a", "table.clock_accuracy_ppm", None
    if any(r["conformity"]["checks"] for r in results):
        for what, key in (("specification", "specification"), ("decision rule", "decision_rule")):
            yield what, "7.8.6.2", f"certificate.conformity.{key}", getattr(stated.conformity, key)


def certificate_page(unit: str, report: JSON) -> str:
    """Return the report of ``certificate`` as a page to print, with its identification on every sheet."""
    core = report["administrativeData"]["coreData"]
    sheet = f"{core['title']} {core['uniqueIdentifier'] or unit}"
    if report["stamp"]:
        sheet += " \N{MIDDLE DOT} NOT A CALIBRATION CERTIFICATE"
    # A string of a style sheet: all characters but letters and digits are written by their number.
    codes = Markup("".join(c if c.isascii() and c.isalnum() else f"\\{ord(c):x} " for c in sheet))  # noqa: S704
    lacking = missing_for_dcc(report)
    return template("certificate.html").render(unit=unit, report=report, sheet=codes, lacking=lacking)


def missing_for_dcc(report: JSON) -> list[str]:
    """Return the missing settings that the Digital Calibration Certificate of a report needs."""
    core = report["administrativeData"]["coreData"]
    return [m["key"] for m in report["missing"]] + [key for key, name in DEMANDED.items() if not core[name]]


def digital_certificate(report: JSON) -> str | None:
    """Return ``certificates/<unit>.xml`` of a report of ``certificate``; None where a statement is missing."""
    if missing_for_dcc(report):
        return None
    place = report["administrativeData"]["coreData"]["performanceLocation"]
    results = [{**r, "quantities": [_quantity(q) for q in r["results"]], "tables": _tables(r)}
               for r in report["measurementResults"]]  # fmt: skip
    return template("dcc.xml").render(
        report=report,
        results=results,
        place=place if place in PLACES else "other",
        filled=lambda value: " ".join(str(value).split()),
    )


def dsi_unit(unit: str) -> tuple[float, str] | None:
    r"""Return the factor to the SI and the unit in D-SI's notation; None for an unknown unit.

    ``deg/s/g`` is ``\degree\metre\tothe{-1}\second`` times 1/9.80665.
    """
    found = _powers(unit)
    if found is None:
        return None
    factor, powers = found
    parts = [f"\\{name}" + (f"\\tothe{{{n}}}" if n != 1 else "") for name, n in sorted(powers.items()) if n]
    return factor, "".join(parts) or "\\one"


def _powers(unit: str) -> tuple[float, dict[str, int]] | None:
    factor, powers = 1.0, dict[str, int]()
    for i, (token, exponent) in enumerate(UNIT_TOKEN.findall(unit)):
        base = _powers(token[1:-1]) if token.startswith("(") else SI_UNITS.get(token)
        if base is None:
            return None
        n = int(exponent or 1) * (-1 if i else 1)
        factor *= base[0] ** n
        for name, power in base[1].items():
            powers[name] = powers.get(name, 0) + n * power
    return factor, powers


def _quantity(q: JSON) -> JSON:
    """Return a result in units of the SI, or as a text where D-SI does not have its unit."""
    known = dsi_unit(q["unit"])
    if known is None:
        return {"name": q["name"], "text": f"{q['value']!r} {q['unit']}"}
    factor, unit = known
    U = q["expandedUnc"]
    expanded = U and {"uncertainty": U["uncertainty"] * factor, "k": U["coverageFactor"], "p": U["coverageProbability"]}
    return {"name": q["name"], "value": q["value"] * factor, "unit": unit, "expanded": expanded}


def _tables(result: JSON) -> list[JSON]:
    """Return the errors before and after, and the residuals over temperature: lists of values with one unit each."""
    known = dsi_unit(result["unit"])
    assert known is not None  # noqa: S101  (g or deg/s)
    factor, unit = known
    tables = []
    for name, key in (("as found, before", "beforeAdjustment"), ("as left, after", "afterAdjustment")):
        errors = {n: e * factor for n, e in (result[key] or {}).items() if e is not None}
        columns = [{"name": n, "values": [e], "unit": unit} for n, e in errors.items()]
        tables += [{"name": f"error on held-out motion {name} the calibration is applied", "columns": columns}]
    swept = result.get("residualsOverTemperature")
    if swept:
        columns = [{"name": "temperature of the sensor", "values": [b["temperature_degc"] for b in swept["bins"]],
                    "unit": "\\degreecelsius"}]  # fmt: skip
        for key, words in (("mean_error", "mean residual"), ("rms_error", "rms residual")):
            columns.append({"name": words, "values": [b[key] * factor for b in swept["bins"]], "unit": unit})
        tables.append({"name": f"residual over temperature, {swept['samples_of']}", "columns": columns})
    elements = [{"name": r["name"], "values": [r["value"]], "unit": "\\one"} for r in result["relations"]]
    tables.append({"name": "elements of the inverse of the matrix", "columns": elements})
    return [t for t in tables if t["columns"]]
