"""One row a unit: ``summary.csv`` and the table of the campaign's page.

Columns: those of every campaign in the order of ``COLUMNS``, then the user's own columns of ``units.csv``. A column of
the user's whose name is taken gets ``sheet_`` before it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.files import write_atomically
from pipeline.records import SENSORS
from pipeline.report.held_out_section import first_and_last_step, passes

if TYPE_CHECKING:
    from pathlib import Path

JSON = dict[str, Any]
UNIT_COLUMNS = ("unit", "serial", "lot", "date", "status", "error", "sensor", "method")
SENSOR_COLUMNS = (
    "error_before", "error_after", "mean_abs_before", "mean_abs_after", "noise_floor", "verdict", "selected", "reason",
    "answers",
)  # fmt: skip
IMPLAUSIBLE = tuple(f"{s}_implausible" for s in SENSORS)
COLUMNS = (*UNIT_COLUMNS, *(f"{s}_{c}" for s in SENSORS for c in SENSOR_COLUMNS), "pass", *IMPLAUSIBLE)
SHEET_COLUMNS = ("table", "procedure", "ingest", "filter", "certificate", "overrides")  # of units.csv; not repeated


def summary_row(
    unit: str, calibration: JSON, validation: JSON | None, diagnosis: JSON | None, sheet_row: dict[str, str]
) -> JSON:
    """Return a unit's row: a dict from column to value, None where there is none.

    ``calibration, validation, diagnosis``: as in their files; ``sheet_row``: the unit's row of ``units.csv``.
    """
    error = calibration.get("error") or {}
    file = f"{error['file']}: " if error.get("file") else ""
    row: JSON = dict.fromkeys(COLUMNS) | {
        "unit": unit,
        **{key: sheet_row.get(key) or None for key in ("serial", "lot", "date")},
        "status": calibration.get("status"),
        "error": f"{file}{error['message']}" if error.get("message") else None,
        "sensor": calibration.get("sensor"),
        "method": calibration.get("method"),
        "pass": passes(calibration, validation),
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
        implausible = (calibration.get(sensor) or {}).get("implausible") or []
        row[f"{sensor}_implausible"] = ";".join(e["parameter"] for e in implausible) or None
    for key, value in sheet_row.items():
        if key not in SHEET_COLUMNS and key not in UNIT_COLUMNS:
            row[f"sheet_{key}" if key in COLUMNS else key] = value
    return row


def write_summary(path: Path, rows: list[JSON]) -> None:
    """Write ``summary.csv`` from rows of ``summary_row``; own columns may differ from unit to unit."""
    import pandas as pd  # noqa: PLC0415  (0.4 s, and summary_row is used without it)

    columns = list(dict.fromkeys([*COLUMNS, *(key for row in rows for key in row)]))
    frame = pd.DataFrame([{key: _cell(value) for key, value in row.items()} for row in rows], columns=columns)
    write_atomically(path, frame.to_csv(index=False, lineterminator="\n"))


def _cell(value: object) -> object:
    """Return a number to nine digits, and a truth value in lower case."""
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:.9g}" if isinstance(value, float) else value
