"""The fitted parameters of a sensor with their uncertainties, and the row of a unit in the tables of the campaign.

The calibration file contains the matrix M of ``truth = M (reading - bias - effects)``. A sensor file states scale
factor errors and cross-axis sensitivities, which are elements of ``K = M^-1`` in ``reading = bias + K truth +
effects``:

    dK = -K dM K,    cov(K) = J cov(M) J^T,    J = K (x) K^T    (rows of M one after the other)

In a row of the tables, the columns of every campaign (``COLUMNS``) come first, then the other columns of ``units.csv``.
If such a column has the name of one in ``COLUMNS``, it gets the prefix ``sheet_``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pipeline.errors import first
from pipeline.estimation.candidates import is_held
from pipeline.model.calibration_file import beyond_uncertainty, left_out
from pipeline.records import AXES, SENSORS
from pipeline.report.held_out_section import first_and_last_step, passes
from pipeline.report.numbers import percent, plain
from pipeline.verdicts import Verdict

if TYPE_CHECKING:
    from collections.abc import Sequence

JSON = dict[str, Any]
CROSS_AXIS = "cross_axis"  # elements of K outside its diagonal, as a sensor file limits them
NAMED = 5  # parameters beyond the limits of the sensor file that a page lists at its top
UNIT_COLUMNS = ("unit", "serial", "lot", "date", "status", "error", "sensor", "method")
SENSOR_COLUMNS = (
    "error_before", "error_after", "mean_abs_before", "mean_abs_after", "noise_floor", "verdict", "selected", "reason",
    "answers",
)  # fmt: skip
OF_CALIBRATION = tuple(f"{s}_{c}" for c in ("implausible", "not_in_uncertainty", "not_held_out") for s in SENSORS)
OF_UNIT = ("left_out", "incomplete")  # ``incomplete``: written by ``gather``, which knows what no stage could make
COLUMNS = (*UNIT_COLUMNS, *(f"{s}_{c}" for s in SENSORS for c in SENSOR_COLUMNS), "pass", *OF_CALIBRATION, *OF_UNIT)
PARAMETERS = ("sensor", "parameter", "label", "measure", "value", "u", "U", "limit", "fitted")
SHEET_COLUMNS = ("table", "procedure", "ingest", "filter", "certificate", "overrides")  # of units.csv; not repeated
NO_UNCERTAINTY: JSON = {"bias": [None] * 3, "matrix": [[None] * 3] * 3}


class Parameter(NamedTuple):
    """A value with its unit; without an uncertainty where the method states none."""

    name: str
    value: float
    unit: str
    expanded_uncertainty: float | None = None
    coverage_factor: float | None = None

    @property
    def standard_uncertainty(self) -> float | None:
        """Expanded uncertainty over coverage factor (JCGM 100:2008, 6.2.1), in the parameter's unit."""
        if self.expanded_uncertainty is None or not self.coverage_factor:
            return None
        return self.expanded_uncertainty / self.coverage_factor

    @property
    def words(self) -> str:
        """The name for a page: ``bias x``, ``g sensitivity: G_xy``."""
        effect, dot, symbol = self.name.rpartition(".")
        return f"{plain(effect)}: {symbol}" if dot else plain(self.name)


def fitted_parameters(part: JSON) -> list[Parameter]:
    """Return bias, matrix and effects of a sensor's part of a calibration, in the order of the covariance's rows.

    Their names are ``bias_x``, ``matrix_xy`` (row, column) and ``<effect>.<parameter>``. The effective degrees of
    freedom, and so the coverage factors, differ between parameters.
    """
    U = part.get("expanded_uncertainty") or NO_UNCERTAINTY
    k = part.get("coverage_factor") or NO_UNCERTAINTY
    budget = part.get("uncertainty_budget") or {"parameters": [], "coverage_factor": []}
    k_of_effects = dict(zip(budget["parameters"], budget["coverage_factor"], strict=True))
    found = [
        Parameter(f"bias_{a}", part["bias"][i], part["unit"], U["bias"][i], k["bias"][i]) for i, a in enumerate(AXES)
    ]
    found += [
        Parameter(f"matrix_{a}{b}", part["matrix"][i][j], "1", U["matrix"][i][j], k["matrix"][i][j])
        for i, a in enumerate(AXES)
        for j, b in enumerate(AXES)
    ]
    for effect in part.get("effects") or []:
        for symbol, p in effect["parameters"].items():
            name, expanded = f"{effect['name']}.{symbol}", p.get("expanded_uncertainty")
            factor = None if expanded is None else k_of_effects.get(name)
            found.append(Parameter(name, p["value"], p["unit"], expanded, factor))
    return found


def reading_errors(part: JSON) -> list[Parameter]:
    """Return the elements of K that a sensor file limits, from a sensor's part of a calibration.

    ``scale_factor_error_x`` is ``K_xx - 1``; ``cross_axis_xy`` is ``K_xy``, the reading of axis x for a truth along y.
    Each has the coverage factor of the same element of the matrix.
    """
    K = np.linalg.inv(np.array(part["matrix"], float))
    k = (part.get("coverage_factor") or NO_UNCERTAINTY)["matrix"]
    covariance = (part.get("covariance") or {}).get("values")
    u: np.ndarray | None = None
    if covariance is not None and k[0][0] is not None:
        J = np.kron(K, K.T)
        u = np.sqrt(np.clip(np.diag(J @ np.array(covariance, float)[3:12, 3:12] @ J.T), 0.0, None)).reshape(3, 3)

    def element(name: str, value: float, i: int, j: int) -> Parameter:
        return Parameter(name, float(value), "1", None if u is None else float(k[i][j] * u[i, j]), k[i][j])

    scale = [element(f"scale_factor_error_{a}", K[i, i] - 1.0, i, i) for i, a in enumerate(AXES)]
    return scale + [
        element(f"{CROSS_AXIS}_{a}{b}", K[i, j], i, j) for i, a in enumerate(AXES) for j, b in enumerate(AXES) if i != j
    ]


def parameter_rows(part: JSON, sensor_config: JSON) -> list[JSON]:
    """Return bias, scale factor errors, cross-axis terms and effects.

    A row has ``p``, ``name``, ``limit`` (or None) and ``share`` of the limit. ``part``: the sensor's part of the
    calibration; ``sensor_config``: the sensor's section of the configuration, with the limits.
    """
    fitted, effects = fitted_parameters(part), sensor_config.get("effects") or {}
    found = [(p, p.words.capitalize(), sensor_config.get("bias")) for p in fitted[:3]]
    for p in reading_errors(part):
        kind, _, axes = p.name.rpartition("_")
        if kind == CROSS_AXIS:
            found.append((p, f"{axes[0]} reads of {axes[1]}", sensor_config.get(CROSS_AXIS)))
        else:
            found.append((p, f"Scale factor error {axes}", sensor_config.get("scale_factor")))
    for p in fitted[12:]:
        held = is_held(p.name, {"value": p.value, "unit": p.unit, "standard_uncertainty": p.standard_uncertainty})
        name = f"{p.words} (not determined, fixed at 0)" if held else p.words
        found.append((p, name, effects.get(p.name.partition(".")[0])))
    bounds = (limit if isinstance(limit, int | float) and limit > 0 else None for *_, limit in found)
    return [
        {"p": p, "name": name, "limit": bound, "share": abs(p.value) / bound if bound else 0.0}
        for (p, name, _), bound in zip(found, bounds, strict=True)
    ]


def beyond_limits(rows: Sequence[JSON], *, mounted: bool) -> list[str]:
    """Return the parameters beyond the limits of the sensor file with their shares of them, the largest first.

    ``rows``: of ``parameter_rows``; ``mounted``: cross-axis terms contain the mounting on a table, and are left out.
    """
    beyond = (row for row in rows if row["share"] > 1.0 and not (mounted and row["p"].name.startswith(CROSS_AXIS)))
    largest = sorted(beyond, key=lambda row: -row["share"])
    return first([f"{row['name'].lower()} ({percent(row['share'])})" for row in largest], NAMED)


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
        selected = found.get("selected") if found.get("verdict") == Verdict.MISSING_EFFECT else None
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
