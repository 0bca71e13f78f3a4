"""Rows of the tables of a unit's page: parameters beside data-sheet limits, stages, steps of the held-out error.

Scale factor errors and cross-axis terms are those of ``K = matrix^-1``, which the data sheet speaks of:

    dK = -K dM K,    cov(K) = J cov(M) J^T,    J = K (x) K^T    (rows of M one after the other)
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.report.numbers import MINUS, NOTHING, measured, number, percent

JSON = dict[str, Any]
AXES = "xyz"


def parameter_rows(part: JSON, sheet: JSON) -> list[JSON]:
    """Return bias, scale factor errors and cross-axis terms with expanded uncertainty beside their limits.

    Parameters
    ----------
    part : dict
        The sensor's part of the calibration.
    sheet : dict
        The sensor's section of the configuration, with the data-sheet limits.
    """
    unit, factors = part["unit"], part.get("coverage_factor") or {}
    k_bias, k_matrix = factors.get("bias", [None] * 3), factors.get("matrix", [[None] * 3] * 3)
    matrix = np.array(part["matrix"], float)
    K = np.linalg.solve(matrix, np.eye(3))
    bias_U = part.get("expanded_uncertainty", {}).get("bias", [None] * 3)
    K_U = _uncertainty_of_inverse(K, part)
    rows = [
        _row(f"Bias {a}", unit, part["bias"][i], expanded=bias_U[i], factor=k_bias[i], limit=sheet.get("bias"))
        for i, a in enumerate(AXES)
    ]
    rows += [
        _row(
            f"Scale factor error {a}",
            "",
            K[i, i] - 1.0,
            expanded=K_U[i][i],
            factor=k_matrix[i][i],
            limit=sheet.get("scale_factor"),
        )
        for i, a in enumerate(AXES)
    ]
    return rows + [
        _row(f"{a} reads of {b}", "", K[i, j], expanded=K_U[i][j], factor=k_matrix[i][j], limit=sheet.get("cross_axis"))
        for i, a in enumerate(AXES)
        for j, b in enumerate(AXES)
        if i != j
    ]


def effect_rows(part: JSON, sheet: JSON) -> list[JSON]:
    """Return the parameters of the fitted effects beside their limits."""
    limits = sheet.get("effects") or {}
    own = iter(((part.get("uncertainty_budget") or {}).get("coverage_factor") or [])[12:])
    return [
        _row(
            f"{e['name'].replace('_', ' ')}: {name}",
            _unit(p),
            p["value"],
            expanded=p.get("expanded_uncertainty"),
            factor=next(own, None),
            limit=limit,
        )
        for e in part.get("effects", [])
        for limit in [limits.get(e["name"])]
        for name, p in e["parameters"].items()
    ]


def matrix_rows(part: JSON) -> list[list[str]]:
    """Return the elements of the calibration matrix with their expanded uncertainties."""
    expanded = part.get("expanded_uncertainty", {}).get("matrix", [[None] * 3] * 3)
    return [[measured(part["matrix"][i][j], expanded[i][j]) for j in range(3)] for i in range(3)]


def stage_rows(part: JSON) -> list[JSON]:
    """Return each stage of the fit: its name, parameters and the residual after it."""
    return [
        {
            "name": str(stage.get("name", "")).replace("_", " "),
            "parameters": parameter_texts(stage.get("parameters")),
            "residual": number(stage.get("residual_rms")),
            "details": [
                f"{key.replace('_', ' ')}: {_detail(value)}"
                for key, value in (stage.get("details") or {}).items()
                if isinstance(value, int | float | str | bool)
            ],
        }
        for stage in part.get("stages", [])
    ]


def parameter_texts(parameters: JSON | None) -> list[str]:
    """Return ``name = value ± uncertainty unit`` for each parameter; the uncertainty covers about 95 %."""
    texts = []
    for name, given in (parameters or {}).items():
        p = given if isinstance(given, dict) else {"value": given}
        standard = p.get("standard_uncertainty")
        expanded = p.get("expanded_uncertainty", 2.0 * standard if standard else None)
        texts.append(f"{name} = {measured(p.get('value'), expanded)} {_unit(p)}".rstrip())
    return texts


def ranking_rows(diagnosis: JSON) -> list[JSON]:
    """Return the ranked effects with their parameters as text; ``supported`` are those with evidence for them."""
    selected = diagnosis.get("selected") or []
    return [
        {
            **r,
            "parameter_texts": parameter_texts(r.get("parameters")),
            "selected": r["effect"] in selected,
            "supported": r["effect"] in selected or (r.get("delta_bic") or 0.0) > 0.0,
        }
        for r in diagnosis.get("ranking") or []
    ]


def step_rows(held_out: JSON) -> list[JSON]:
    """Return the steps of the held-out error, each with its figures."""
    return [
        {
            "name": step_label(step["name"]),
            "mean_abs": number(step.get("mean_abs_error")),
            "sum_abs": number(step.get("sum_abs_error")),
            "rms": number(step.get("rms_error")),
            "max": number(step.get("max_error")),
            "min": number(step.get("min_error")),
            "vector": number(step.get("vector_rms_error")),
            "change": NOTHING
            if step.get("change_percent") is None
            else f"{step['change_percent']:.1f} %".replace("-", MINUS),
        }
        for step in held_out.get("steps", [])
    ]


def step_label(name: str) -> str:
    """Return a step's name for people."""
    if name.startswith("stage:"):
        return "after " + name.removeprefix("stage:").strip().replace("_", " ")
    return name.replace("_", " ")


def _row(
    name: str, unit: str, value: float, *, expanded: float | None, factor: float | None, limit: float | None
) -> JSON:
    bound = limit if isinstance(limit, int | float) and limit > 0 else None
    return {
        "name": name,
        "value": measured(value, expanded),
        "unit": unit,
        "factor": number(factor, 3),
        "limit": NOTHING if bound is None else f"± {number(bound)}",
        "share": None if bound is None else percent(abs(value) / bound),
        "beyond": bound is not None and abs(value) > bound,
    }


def _uncertainty_of_inverse(K: np.ndarray, part: JSON) -> list[list[float | None]]:
    values = part.get("covariance", {}).get("values")
    factor = (part.get("coverage_factor") or {}).get("matrix")
    if values is None or factor is None:
        return [[None] * 3] * 3
    J = np.kron(K, K.T)
    variance = np.diag(J @ np.array(values, float)[3:12, 3:12] @ J.T)
    expanded: list[list[float | None]] = (
        np.array(factor) * np.sqrt(np.clip(variance, 0.0, None)).reshape(3, 3)
    ).tolist()
    return expanded


def _unit(parameter: JSON) -> str:
    unit = str(parameter.get("unit") or "")
    return "" if unit == "1" else unit


def _detail(value: object) -> str:
    return number(float(value), 4) if isinstance(value, float) else str(value)


def rest_rows(part: JSON) -> list[JSON]:
    """Return the rests that were found without a table, in order of time: used, held out or left out, and why.

    Parameters
    ----------
    part : dict
        With ``rests``, or with the stages of a fit that tell them in ``details``.
    """
    told = [part.get("rests") or {}, *(stage.get("details") or {} for stage in part.get("stages") or [])]
    rows = [
        {**rest, "use": kind.replace("_", " ")}
        for found in told
        for kind in ("used", "held_out", "left_out")
        for rest in found.get(f"rests_{kind}") or []
    ]
    return sorted(rows, key=lambda row: (row["recording"], row["time_s"]))
