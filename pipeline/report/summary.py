"""The row of a unit in the tables of the campaign, and its parameters.

The columns of every campaign (``COLUMNS``) come first, then the other columns of ``units.csv``. If such a column has
the name of one in ``COLUMNS``, it gets the prefix ``sheet_``.
"""

from __future__ import annotations

from typing import Any

from pipeline.model.calibration_file import beyond_uncertainty, left_out
from pipeline.records import SENSORS
from pipeline.report.held_out_section import first_and_last_step, passes
from pipeline.report.parameters import fitted_parameters, parameter_rows

JSON = dict[str, Any]
UNIT_COLUMNS = ("unit", "serial", "lot", "date", "status", "error", "sensor", "method")
SENSOR_COLUMNS = (
    "error_before", "error_after", "mean_abs_before", "mean_abs_after", "noise_floor", "verdict", "selected", "reason",
    "answers",
)  # fmt: skip
OF_CALIBRATION = tuple(f"{s}_{c}" for c in ("implausible", "not_in_uncertainty", "not_held_out") for s in SENSORS)
COLUMNS = (*UNIT_COLUMNS, *(f"{s}_{c}" for s in SENSORS for c in SENSOR_COLUMNS), "pass", *OF_CALIBRATION, "left_out")
PARAMETERS = ("sensor", "parameter", "label", "measure", "value", "u", "U", "limit", "fitted")
SHEET_COLUMNS = ("table", "procedure", "ingest", "filter", "certificate", "overrides")  # of units.csv; not repeated


def summary_row(
    unit: str, calibration: JSON, validation: JSON | None, diagnosis: JSON | None, units_table_row: dict[str, str]
) -> JSON:
    """Return a unit's row: a dict from column to value, or None.

    ``calibration, validation, diagnosis``: as in their files; ``units_table_row``: the unit's row of ``units.csv``.
    """
    error = calibration.get("error") or {}
    file = f"{error['file']}: " if error.get("file") else ""
    row: JSON = dict.fromkeys(COLUMNS) | {
        "unit": unit,
        **{key: units_table_row.get(key) or None for key in ("serial", "lot", "date")},
        "status": calibration.get("status"),
        "error": f"{file}{error['message']}" if error.get("message") else None,
        "sensor": calibration.get("sensor"),
        "method": calibration.get("method"),
        "pass": passes(calibration, validation),
        "left_out": "; ".join(left_out(calibration.get("inputs"))) or None,
    }
    for sensor in SENSORS:
        held_out, found = (validation or {}).get(sensor) or {}, (diagnosis or {}).get(sensor) or {}
        raw, final = first_and_last_step(held_out)
        selected = found.get("selected") if found.get("verdict") == "missing_effect" else None
        errors = [step.get(error) for error in ("rms_error", "mean_abs_error") for step in (raw, final)]
        texts = [found.get("verdict"), ";".join(selected or []) or None, found.get("reason") or None]
        texts.append(len(found.get("answer_set") or []) or None)
        values = [*errors, held_out.get("noise_floor"), *texts]
        row |= {f"{sensor}_{column}": value for column, value in zip(SENSOR_COLUMNS, values, strict=True)}
        part = calibration.get(sensor)
        implausible = (part or {}).get("implausible") or []
        row[f"{sensor}_implausible"] = ";".join(e["parameter"] for e in implausible) or None
        row[f"{sensor}_not_held_out"] = held_out.get("reason")
        row[f"{sensor}_not_in_uncertainty"] = "; ".join(source for source, _ in beyond_uncertainty(part)) or None
    for key, value in units_table_row.items():
        if key not in SHEET_COLUMNS and key not in UNIT_COLUMNS:
            row[f"sheet_{key}" if key in COLUMNS else key] = value
    return row


def sheet_columns(row: JSON) -> dict[str, str]:
    """Return the values of a row that are from ``units.csv``."""
    return {k: v for k, v in row.items() if v is not None and (k in ("serial", "lot", "date") or k not in COLUMNS)}


def unit_parameters(calibration: JSON, sensor_configs: JSON) -> list[tuple[Any, ...]]:
    """Return a row with the columns ``PARAMETERS`` for each parameter of a unit; none for a failed unit.

    These are the fitted parameters, and the elements of K that a sensor file limits. ``sensor_configs``: the section
    ``sensor`` of the configuration.
    """
    rows = []
    for sensor in [s for s in SENSORS if calibration.get(s)]:
        fitted = fitted_parameters(calibration[sensor])
        limits = {row["p"]: row for row in parameter_rows(calibration[sensor], sensor_configs.get(sensor) or {})}
        limits = {p: row for p, row in limits.items() if row["limit"]}
        for p in dict.fromkeys([*fitted, *limits]):
            label, limit = (limits[p]["name"], limits[p]["limit"]) if p in limits else (None, None)
            name = f"{sensor}_{p.name.replace('.', '_')}"
            figures = p.value, p.standard_uncertainty, p.expanded_uncertainty, limit
            rows.append((sensor, name, label, p.unit, *figures, p in fitted))
    return rows
