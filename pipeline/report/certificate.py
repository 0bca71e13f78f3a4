"""The calibration report of a laboratory: what ISO/IEC 17025:2017 asks for in 7.8.2.1, 7.8.4.1 and 7.8.6.

Filled from what was measured and from what the laboratory states in its ``certificate`` config. What neither holds is
not made up: the report lists it, and is stamped as no calibration certificate. Traceability is printed as stated, or
as not stated. Names follow the Digital Calibration Certificate (PTB, DCC 3) where it has one; units are those of the
house (g = 9.80665 m/s^2, deg/s).
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from pipeline.outcome import run_command
from pipeline.records import SENSORS
from pipeline.report.figure import AXES

if TYPE_CHECKING:
    from pipeline.report.figure import JSON

STAMP = "NOT A CALIBRATION CERTIFICATE - incomplete: "
ONLY_THIS_ITEM = "The results relate only to the item calibrated."
COVERAGE = (
    "The expanded uncertainty is the standard uncertainty multiplied by the coverage factor k of each value, for a "
    "coverage probability of about 95 %."
)
SOFTWARE_SAYS = "Accreditation and traceability are the laboratory's statements; the software asserts neither."
DAY = re.compile(r"\d{4}-\d{2}-\d{2}")


def certificate(calibration: JSON, validation: JSON | None, settings: JSON, temperature: str | None) -> JSON:
    """Return the report of one calibrated unit.

    Parameters
    ----------
    calibration, validation : dict
        As in their files.
    settings : dict
        The unit's resolved configuration, with ``row`` (serial, lot, date of ``units.csv``).
    temperature : str or None
        Range of the sensor's temperature, degC; None where it was not recorded.

    Returns
    -------
    dict
        ``complete, stamp, missing, administrativeData, measurementResults`` and ``source``.
    """
    stated = settings["certificate"]
    document: JSON = {
        "schema": "imu-calibration/certificate/1",
        "administrativeData": _administrative(calibration, stated, settings.get("row") or {}),
        "measurementResults": [
            _result(sensor, calibration, (validation or {}).get(sensor) or {}, settings, temperature)
            for sensor in SENSORS
            if calibration.get(sensor)
        ],
        "source": {
            "calibration": f"calibrations/{calibration['unit']}.json",
            "config_sha256": calibration.get("config_sha256"),
            "inputs": [{k: i.get(k) for k in ("file", "sha256", "rows")} for i in calibration.get("inputs") or []],
            "command": run_command(settings["run"]) if settings.get("run") else None,
        },
    }
    missing = _missing(document, stated, validation or {})
    stamp = STAMP + ", ".join(m["what"] for m in missing) if missing else None
    return {"complete": not missing, "stamp": stamp, "missing": missing, **document}


def _administrative(calibration: JSON, stated: JSON, row: JSON) -> JSON:
    serial, date = row.get("serial"), row.get("date") or ""
    begin = stated["performed"]["begin"] or (date if DAY.fullmatch(date) else None)
    number = stated["number"]
    return {
        "dccSoftware": [{"name": n, "release": v} for n, v in (calibration.get("software") or {}).items()],
        "coreData": {
            "title": stated["title"],
            "uniqueIdentifier": number
            and number.replace("{unit}", calibration["unit"]).replace("{serial}", serial or "?"),
            "countryCodeISO3166_1": stated["country"],
            "usedLangCodeISO639_1": "en",
            "receiptDate": stated["received"],
            "beginPerformanceDate": begin,
            "endPerformanceDate": stated["performed"]["end"] or begin,
            "performanceLocation": stated["place"],
            "issueDate": stated["issued"],
        },
        "items": [
            {
                "name": stated["item"]["description"] or f"inertial measurement unit {calibration.get('sensor')}",
                "manufacturer": stated["item"]["manufacturer"],
                "model": calibration.get("sensor"),
                "identifications": [
                    {"issuer": "manufacturer", "name": "serial number", "value": serial},
                    {"issuer": "laboratory", "name": "unit", "value": calibration["unit"]},
                ],
                "condition": stated["item"]["condition"],
            }
        ],
        "calibrationLaboratory": stated["laboratory"],
        "respPersons": [stated["authorised_by"]],
        "customer": stated["customer"],
        "statements": {
            "item": ONLY_THIS_ITEM,
            "uncertainty": COVERAGE,
            "traceability": stated["traceability"],
            "sampling": stated["sampling"],
            "externalResults": stated["external_results"],
            "opinions": stated["opinions"],
            "software": SOFTWARE_SAYS,
        },
    }


def _result(sensor: str, calibration: JSON, held_out: JSON, settings: JSON, temperature: str | None) -> JSON:
    part, stated, table = calibration[sensor], settings["certificate"], settings["table"]
    return {
        "name": sensor,
        "unit": part["unit"],
        "equation": "truth = matrix (reading - bias - effects)",
        "usedMethods": [
            {
                "name": (calibration.get("methods") or {}).get(sensor) or calibration.get("method"),
                "procedure": calibration.get("procedure"),
                "document": stated["method"]["document"],
                "deviations": stated["method"]["deviations"],
            }
        ],
        "measuringEquipments": [
            *stated["equipment"],
            {"name": f"table {calibration.get('table')}", "used_for": "motion of reference", "configured": table},
        ],
        "influenceConditions": {
            "temperature of the sensor, degC": temperature,
            "local gravity, g": table.get("gravity_g"),
            "accuracy of local gravity, g": table.get("gravity_accuracy_g"),
            "laboratory": stated["environment"],
        },
        "results": quantities(part),
        "uncertaintyBudget": part.get("uncertainty_budget"),
        "beforeAdjustment": _errors(held_out, 0),
        "afterAdjustment": _errors(held_out, -1),
        "noiseFloor": held_out.get("noise_floor"),
        "conformity": {
            **stated["conformity"],
            "checks": held_out.get("limits") or [],
            "pass": held_out.get("pass"),
        },
    }


def quantities(part: JSON) -> list[JSON]:
    """Return bias, matrix and the parameters of fitted effects, each with its expanded uncertainty.

    Parameters
    ----------
    part : dict
        The sensor's part of the calibration.

    Returns
    -------
    list of dict
        ``name, value, unit, expandedUnc``; the last None for what the method does not fit, or where no budget is known.
    """
    budget = part.get("uncertainty_budget")
    rows = [p for effect in part.get("effects") or [] for p in effect["parameters"].values()]
    values = [*part["bias"], *(m for row in part["matrix"] for m in row), *(p["value"] for p in rows)]
    if not budget:
        names = [*(f"bias_{a}" for a in AXES), *(f"matrix_{a}{b}" for a in AXES for b in AXES)]
        units = [part["unit"]] * 3 + ["1"] * 9
        return [
            {"name": n, "value": v, "unit": u, "expandedUnc": None}
            for n, v, u in zip(names, values[:12], units, strict=True)
        ]
    return [
        {"name": name, "value": value, "unit": budget["units"][j], "expandedUnc": _expanded(budget, j)}
        for j, (name, value) in enumerate(zip(budget["parameters"], values, strict=True))
    ]


def _expanded(budget: JSON, j: int) -> JSON | None:
    if not budget["standard_uncertainty"][j] > 0.0:
        return None
    return {
        "uncertainty": budget["expanded_uncertainty"][j],
        "standardUncertainty": budget["standard_uncertainty"][j],
        "coverageFactor": budget["coverage_factor"][j],
        "effectiveDegreesOfFreedom": budget["effective_degrees_of_freedom"][j],
        "coverageProbability": 0.95,
        "distribution": "t",
    }


def _errors(held_out: JSON, step: int) -> JSON | None:
    """Return the held-out errors of the first (0) or last (-1) step."""
    steps = held_out.get("steps") or []
    keys = ("rms_error", "mean_abs_error", "max_error", "min_error", "vector_rms_error")
    return {k: steps[step].get(k) for k in keys} if steps else None


def _missing(document: JSON, stated: JSON, validation: JSON) -> list[JSON]:
    """Return what the standard asks for and nobody has stated: ``what``, its ``clause`` and the ``key`` to set."""
    core = document["administrativeData"]["coreData"]
    results = document["measurementResults"]
    judged = any(r["conformity"]["checks"] for r in results)
    warm = all(r["influenceConditions"]["temperature of the sensor, degC"] is not None for r in results)
    serial = document["administrativeData"]["items"][0]["identifications"][0]["value"]
    wanted: list[tuple[str, str, str, Any]] = [
        ("name of the laboratory", "7.8.2.1 b", "certificate.laboratory.name", stated["laboratory"]["name"]),
        ("address of the laboratory", "7.8.2.1 b", "certificate.laboratory.address", stated["laboratory"]["address"]),
        ("place of performance", "7.8.2.1 c", "certificate.place", stated["place"]),
        ("unique identification", "7.8.2.1 d", "certificate.number", core["uniqueIdentifier"]),
        ("customer", "7.8.2.1 e", "certificate.customer.name", stated["customer"]["name"]),
        (
            "contact of the customer",
            "7.8.2.1 e",
            "certificate.customer.contact",
            stated["customer"]["contact"] or stated["customer"]["address"],
        ),
        ("description of the item", "7.8.2.1 g", "certificate.item.description", stated["item"]["description"]),
        ("serial number of the item", "7.8.2.1 g", "serial in units.csv", serial),
        ("date of performance", "7.8.2.1 i", "certificate.performed.begin", core["beginPerformanceDate"]),
        ("date of issue", "7.8.2.1 j", "certificate.issued", stated["issued"]),
        ("deviations from the method", "7.8.2.1 n", "certificate.method.deviations", stated["method"]["deviations"]),
        ("authorising person", "7.8.2.1 o", "certificate.authorised_by.name", stated["authorised_by"]["name"]),
        ("conditions of influence", "7.8.4.1 b", "certificate.environment", stated["environment"] or warm or None),
        ("reference equipment", "7.8.4.1 c", "certificate.equipment", stated["equipment"]),
        ("traceability", "7.8.4.1 c", "certificate.traceability", stated["traceability"]),
    ]
    if any(r["name"] == "accelerometer" for r in results):
        accuracy = results[0]["influenceConditions"]["accuracy of local gravity, g"]
        key = "table.gravity_accuracy_g"
        wanted.append(("accuracy of local gravity", "7.8.4.1 a", key, accuracy is not None))
    for sensor in (r["name"] for r in results):
        given = any(q["expandedUnc"] for q in next(r["results"] for r in results if r["name"] == sensor))
        wanted.append((f"uncertainty of the {sensor}", "7.8.4.1 a", "method=reference_least_squares", given))
        errors = (validation.get(sensor) or {}).get("steps")
        wanted.append((f"results of the {sensor} before and after", "7.8.4.1 d", "a held-out recording", errors))
    if judged:
        rule = stated["conformity"]
        wanted.append(("specification", "7.8.6.2", "certificate.conformity.specification", rule["specification"]))
        wanted.append(("decision rule", "7.8.6.2", "certificate.conformity.decision_rule", rule["decision_rule"]))
    return [{"what": what, "clause": clause, "key": key} for what, clause, key, value in wanted if not value]
