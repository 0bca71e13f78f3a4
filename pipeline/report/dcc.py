"""The Digital Calibration Certificate of a unit: the laboratory's report as XML (PTB, DCC 3.2.1 with D-SI 2.1.0).

Values are in units of the SI: an acceleration in m/s^2 (1 g = 9.80665 m/s^2), a rate in deg/s, a temperature difference
in K. What the schema demands and nobody stated is not invented: then there is no such file, and the report says why.
"""

from __future__ import annotations

import re
from typing import Any

from pipeline.report.pages import template

JSON = dict[str, Any]
# What the schema (https://www.ptb.de/dcc/v3.2.1/dcc.xsd) demands, in addition to what ISO/IEC 17025 does.
DEMANDED = {"certificate.country": "countryCodeISO3166_1"}
PLACES = ("laboratory", "customer", "laboratoryBranch", "customerBranch", "other")  # of performance, by the schema
# Units of this product: factor to the SI, and powers of the units of D-SI (D-SI 2.1.0, BIPM SI brochure, table 8: deg).
UNITS: dict[str, tuple[float, dict[str, int]]] = {
    "1": (1.0, {}),
    "ppm": (1e-6, {}),
    "g": (9.80665, {"metre": 1, "second": -2}),
    "deg": (1.0, {"degree": 1}),
    "s": (1.0, {"second": 1}),
    "m": (1.0, {"metre": 1}),
    "degC": (1.0, {"kelvin": 1}),  # in slopes: a difference
}
TOKEN = re.compile(r"(\([^()]*\)|[^/()^]+)(?:\^(\d+))?")


def missing_for_dcc(report: JSON) -> list[str]:
    """Return the settings without which there is no Digital Calibration Certificate of a report."""
    core = report["administrativeData"]["coreData"]
    return [m["key"] for m in report["missing"]] + [key for key, name in DEMANDED.items() if not core[name]]


def digital_certificate(unit: str, report: JSON) -> str | None:
    """Return ``certificates/<unit>.xml`` of a report (``pipeline.report.certificate``), None where something lacks."""
    if missing_for_dcc(report):
        return None
    place = report["administrativeData"]["coreData"]["performanceLocation"]
    results = [{**r, "quantities": [_quantity(q) for q in r["results"]], "tables": _tables(r)}
               for r in report["measurementResults"]]  # fmt: skip
    text: str = template("dcc.xml").render(
        unit=unit, report=report, results=results, place=place if place in PLACES else "other", filled=_filled
    )
    return text


def dsi_unit(unit: str) -> tuple[float, str] | None:
    r"""Return the factor to the SI and the unit in D-SI's notation; None for a unit that is not known.

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
    for i, (token, exponent) in enumerate(TOKEN.findall(unit)):
        base = _powers(token[1:-1]) if token.startswith("(") else UNITS.get(token)
        if base is None:
            return None
        n = int(exponent or 1) * (-1 if i else 1)
        factor *= base[0] ** n
        for name, power in base[1].items():
            powers[name] = powers.get(name, 0) + n * power
    return factor, powers


def _quantity(q: JSON) -> JSON:
    """Return a result in units of the SI; without a unit of D-SI as a text."""
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
    for name, key in (("before", "beforeAdjustment"), ("after", "afterAdjustment")):
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
    return [t for t in tables if t["columns"]]


def _filled(value: object) -> str:
    """Return a text without space at its ends, as the schema asks of a string that is not empty."""
    return " ".join(str(value).split())
