"""The fitted parameters of a sensor with their uncertainties, and the row of a unit in the tables of the campaign.

The calibration file contains the matrix M of ``truth = M (reading - bias - effects)``. Scale factor errors and
cross-axis terms are elements of ``K = M^-1`` in ``reading = bias + K truth + effects``:

    dK = -K dM K,    cov(K) = J cov(M) J^T,    J = K (x) K^T    (rows of M one after the other)

A sensor file limits those of ``K = P R`` without the rotation R of the unit: P is symmetric, ``P P = K K^T``, and

    P dP + dP P = dK K^T + K dK^T

In a row of the tables, the columns of every campaign (``SUMMARY_COLUMNS``) come first, then the other columns of
``units.csv``. If such a column has the name of one in ``SUMMARY_COLUMNS``, it gets the prefix ``sheet_``.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import chain, combinations, permutations
from typing import Any, NamedTuple

import numpy as np

from pipeline.core.files import JSON
from pipeline.core.records import (
    AFTER_BASE,
    AXES,
    BASE_NAMES,
    BIAS,
    BIAS_NAMES,
    MATRIX,
    MATRIX_NAMES,
    SENSORS,
    standard_uncertainty,
)
from pipeline.core.settings import DataSheet, Sensor
from pipeline.core.verdicts import (
    IMPLAUSIBLE,
    KINDS,
    NOT_CONVERGED,
    NOT_HELD_OUT,
    WORSE_THAN_RAW,
    Verdict,
    error_of,
    moves_over_noise,
)
from pipeline.estimation.candidates import is_fixed
from pipeline.evaluation.diagnosis.words import plain
from pipeline.output.pages.held_out_section import first_and_last_step, passes
from pipeline.physics.statements import beyond_uncertainty, both_figures, left_out, limited_effects, without_rotation

UNIT_COLUMNS = ("unit", "serial", "lot", "date", "status", "error", "sensor", "method")
SENSOR_COLUMNS = (
    "error_before", "error_after", "mean_abs_before", "mean_abs_after", "noise_floor", "verdict", "selected", "reason",
    "answers",
)  # fmt: skip
REMARK_KINDS = ("beyond_limits", IMPLAUSIBLE, "not_in_uncertainty", NOT_HELD_OUT, NOT_CONVERGED, WORSE_THAN_RAW)
OF_CALIBRATION = tuple(f"{s}_{c}" for c in REMARK_KINDS for s in SENSORS)
OF_UNIT = ("left_out", "incomplete")  # ``incomplete``: written by ``gather``, which knows what no stage could make
# the error of the vector, where the attitude is known, the next step where the verdict is not ``nothing_missing``, and
# the figure that decided the verdict
OF_NEXT = ("vector_error_before", "vector_error_after", "vector_noise_floor", "next_step", "decided_by")
NEXT = tuple(f"{s}_{c}" for s in SENSORS for c in OF_NEXT)
MOVES = "gyroscope_moves_over_noise"
SUMMARY_COLUMNS = (
    *UNIT_COLUMNS, *(f"{s}_{c}" for s in SENSORS for c in SENSOR_COLUMNS), "pass", *OF_CALIBRATION, *OF_UNIT, *NEXT,
    MOVES, "state",
)  # fmt: skip
PARAMETER_KEYS = ("sensor", "parameter", "label", "measure", "value", "u", "U", "limit", "beyond", "fitted")
SHEET_COLUMNS = ("table", "procedure", "ingest", "filter", "certificate", "overrides")  # of units.csv; not repeated
NO_UNCERTAINTY: JSON = {"bias": [None] * 3, "matrix": [[None] * 3] * 3}


class Parameter(NamedTuple):
    """A value with its unit; without an uncertainty where the method states none."""

    name: str
    value: float
    unit: str
    expanded_uncertainty: float | None = None
    coverage_factor: float | None = None
    with_open: float | None = None  # expanded uncertainty with the open effects, where it differs

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
    values, expanded, factors = ([*each["bias"], *chain(*each["matrix"])] for each in (part, U, k))
    units = (part["unit"],) * len(BIAS_NAMES) + ("1",) * len(MATRIX_NAMES)
    wide = both_figures(part)
    with_open = [wide[name][1] if name in wide else None for name in BASE_NAMES]
    found = list(map(Parameter, BASE_NAMES, values, units, expanded, factors, with_open))
    for effect in part.get("effects") or []:
        for symbol, p in effect["parameters"].items():
            name, expanded = f"{effect['name']}.{symbol}", p.get("expanded_uncertainty")
            factor = None if expanded is None else k_of_effects.get(name)
            found.append(Parameter(name, p["value"], p["unit"], expanded, factor))
    return found


def reading_errors(part: JSON) -> list[Parameter]:
    """Return the elements of K, from a sensor's part of a calibration.

    ``scale_factor_error_x`` is ``K_xx - 1``; ``cross_axis_xy`` is ``K_xy``, the reading of axis x for a truth along y.
    Each has the coverage factor of the same element of the matrix.
    """
    K = np.linalg.inv(np.array(part["matrix"], float))
    element = _elements(part, K, np.kron(K, K.T))
    scale = [element(f"scale_factor_error_{a}", i, i) for i, a in enumerate(AXES)]
    return scale + [element(f"cross_axis_{AXES[i]}{AXES[j]}", i, j) for i, j in permutations(range(3), 2)]


def sensor_errors(part: JSON) -> list[Parameter]:
    """Return the elements of P, which a sensor file limits, named as in ``beyond_limits`` of a calibration."""
    M = np.array(part["matrix"], float)
    K, P = np.linalg.inv(M), without_rotation(M)
    sizes, axes = np.linalg.eigh(P)
    of_K = -np.einsum("ia,bj->abij", K, K).reshape(9, 3, 3)  # dK for each element of dM
    changes = axes.T @ (of_K @ K.T + K @ of_K.transpose(0, 2, 1)) @ axes
    J = (axes @ (changes / np.add.outer(sizes, sizes)) @ axes.T).reshape(9, 9).T
    element = _elements(part, P, J)
    scale = [element(f"scale_factor_{a}", i, i) for i, a in enumerate(AXES)]
    return scale + [element(f"cross_axis_{AXES[i]}{AXES[j]}", i, j) for i, j in combinations(range(3), 2)]


def _elements(part: JSON, matrix: np.ndarray, J: np.ndarray) -> Callable[[str, int, int], Parameter]:
    """Return a function for the elements of a matrix, less 1 on the diagonal; ``J``: its derivative to M, (9, 9)."""
    k = (part.get("coverage_factor") or NO_UNCERTAINTY)["matrix"]
    covariance = (part.get("covariance") or {}).get("values")
    u: np.ndarray | None = None
    if covariance is not None and k[0][0] is not None:
        u = standard_uncertainty(J @ np.array(covariance, float)[MATRIX, MATRIX] @ J.T).reshape(3, 3)

    def element(name: str, i: int, j: int) -> Parameter:
        U = None if u is None else float(k[i][j] * u[i, j])
        return Parameter(name, float(matrix[i, j] - (i == j)), "1", U, k[i][j])

    return element


def parameter_rows(sensor: str, part: JSON, data_sheet: DataSheet) -> list[JSON]:
    """Return bias, scale factor errors, cross-axis terms and effects.

    A row has ``p``, ``name``, ``limit`` (or None), ``share`` of the limit, and ``beyond``: whether the calibration
    counts it as outside the data sheet's limit. ``part``: the sensor's part of the calibration.
    """
    fitted = fitted_parameters(part)
    beyond = {entry["parameter"] for entry in part.get("beyond_limits") or []}
    limits = {name: limit for name, _, _, _, limit, *_ in limited_effects(sensor, part, data_sheet.effects)}
    found: list[tuple[Parameter, str, float | None]] = [
        (p, p.words.capitalize(), data_sheet.bias) for p in fitted[BIAS]
    ]
    for p in sensor_errors(part):
        kind, _, axes = p.name.rpartition("_")
        if kind == "cross_axis":
            found.append((p, f"Cross-axis sensitivity {axes}", data_sheet.cross_axis))
        else:
            found.append((p, f"Scale factor error {axes}", data_sheet.scale_factor))
    for p in fitted[AFTER_BASE]:
        at_zero = is_fixed(p.name, p.value, p.unit, p.standard_uncertainty)
        name = f"{p.words} (not determined, fixed at 0)" if at_zero else p.words
        found.append((p, name, limits.get(p.name)))
    return [
        {"p": p, "name": name, "limit": limit or None, "share": abs(p.value) / limit if limit else 0.0,
         "beyond": p.name in beyond}
        for p, name, limit in found
    ]  # fmt: skip


def summary_row(
    unit: str, calibration: JSON, validation: JSON | None, diagnosis: JSON | None, units_table_row: dict[str, str]
) -> JSON:
    """Return a unit's row: a dict from column to value, or None; ``units_table_row``: its row of ``units.csv``."""
    error = calibration.get("error") or {}
    file = f"{error['file']}: " if error.get("file") else ""
    row: JSON = dict.fromkeys(SUMMARY_COLUMNS) | {
        "unit": unit,
        **{key: units_table_row.get(key) or None for key in ("serial", "lot", "date")},
        "status": calibration.get("status"),
        "error": f"{file}{error['message']}" if error.get("message") else None,
        "sensor": calibration.get("sensor"),
        "method": calibration.get("method"),
        "pass": passes(calibration, validation),
        "left_out": "; ".join(left_out(calibration.get("inputs"))) or None,
        MOVES: moves_over_noise(validation or {}),
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
        beyond = (part or {}).get("beyond_limits") or []
        row[f"{sensor}_beyond_limits"] = ";".join(e["parameter"] for e in beyond) or None
        row[f"{sensor}_implausible"] = ";".join(e["parameter"] for e in implausible) or None
        row[f"{sensor}_not_held_out"] = held_out.get("reason")
        row[f"{sensor}_not_converged"] = None if (part or {}).get("converged", True) else KINDS[NOT_CONVERGED].meaning
        row[f"{sensor}_worse_than_raw"] = held_out.get("worse_than_raw") if part is None else None
        vector = error_of(held_out)
        figures = vector[1:] if vector.kind == "vector" else (None,) * 3
        step = found.get("next_experiment") if found.get("verdict") != Verdict.NOTHING_MISSING else None
        of_sensor = [name for name in NEXT if name.startswith(sensor)]
        row |= dict(zip(of_sensor, (*figures, step or None, found.get("decided_by") or None), strict=True))
        row[f"{sensor}_not_in_uncertainty"] = "; ".join(source for source, _ in beyond_uncertainty(part)) or None
    for key, value in units_table_row.items():
        if key not in SHEET_COLUMNS and key not in UNIT_COLUMNS:
            row[f"sheet_{key}" if key in SUMMARY_COLUMNS else key] = value
    return row


def sheet_columns(row: JSON) -> dict[str, str]:
    """Return the values of a row that are from ``units.csv``."""
    own = {"serial", "lot", "date"}
    return {k: v for k, v in row.items() if v is not None and (k in own or k not in SUMMARY_COLUMNS)}


def unit_parameters(calibration: JSON, sensor_model: Sensor) -> list[tuple[Any, ...]]:
    """Return a row of ``PARAMETER_KEYS`` for each fitted parameter and each limited element of P; none if it failed."""
    rows = []
    for sensor in [s for s in SENSORS if calibration.get(s)]:
        fitted = fitted_parameters(calibration[sensor])
        limits = {row["p"]: row for row in parameter_rows(sensor, calibration[sensor], sensor_model.of(sensor))}
        limits = {p: row for p, row in limits.items() if row["limit"]}
        for p in dict.fromkeys([*fitted, *limits]):
            row = limits.get(p) or {"name": None, "limit": None, "beyond": False}
            name = f"{sensor}_{p.name.replace('.', '_')}"
            figures = p.value, p.standard_uncertainty, p.expanded_uncertainty, row["limit"]
            rows.append((sensor, name, row["name"], p.unit, *figures, row["beyond"], p in fitted))
    return rows
