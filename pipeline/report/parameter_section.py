"""Rows of the tables of parameters: values with data-sheet limits, stages of the fit, and the uncertainty budget."""

from __future__ import annotations

from typing import Any

from pipeline.report.numbers import NOTHING, measured, number, percent, plain, unit_text
from pipeline.report.parameters import NO_UNCERTAINTY, Parameter, fitted_parameters, reading_errors

JSON = dict[str, Any]


def parameter_rows(part: JSON, sheet: JSON) -> list[JSON]:
    """Return bias, scale factor errors, cross-axis terms and effects, each with its limit.

    Parameters
    ----------
    part : dict
        The sensor's part of the calibration.
    sheet : dict
        The sensor's section of the configuration, with the data-sheet limits.
    """
    fitted, limits = fitted_parameters(part), sheet.get("effects") or {}
    rows = [_row(p, p.words.capitalize(), sheet.get("bias")) for p in fitted[:3]]
    for p in reading_errors(part):
        kind, _, axes = p.name.rpartition("_")
        cross = kind == "cross_axis"
        name = f"{axes[0]} reads of {axes[1]}" if cross else f"Scale factor error {axes}"
        rows.append(_row(p, name, sheet.get("cross_axis" if cross else "scale_factor")))
    return rows + [_row(p, p.words, limits.get(p.name.partition(".")[0])) for p in fitted[12:]]


def _row(p: Parameter, name: str, limit: object) -> JSON:
    bound = limit if isinstance(limit, int | float) and limit > 0 else None
    return {
        "name": name,
        "value": measured(p.value, p.expanded_uncertainty),
        "unit": unit_text(p.unit),
        "factor": number(p.coverage_factor, 3),
        "limit": NOTHING if bound is None else f"± {number(bound)}",
        "share": None if bound is None else percent(abs(p.value) / bound),
        "beyond": bound is not None and abs(p.value) > bound,
    }


def matrix_rows(part: JSON) -> list[list[str]]:
    """Return the elements of the calibration matrix with their expanded uncertainties."""
    expanded = (part.get("expanded_uncertainty") or NO_UNCERTAINTY)["matrix"]
    return [[measured(m, U) for m, U in zip(*row, strict=True)] for row in zip(part["matrix"], expanded, strict=True)]


def stage_rows(part: JSON) -> list[JSON]:
    """Return each stage of the fit: its name, parameters, the residual after it and its details."""
    rows = []
    for stage in part.get("stages", []):
        details = {k: v for k, v in (stage.get("details") or {}).items() if isinstance(v, int | float | str | bool)}
        told = [f"{plain(k)}: {number(v, 4) if isinstance(v, float) else v}" for k, v in details.items()]
        row = {"name": plain(stage["name"]), "residual": number(stage.get("residual_rms")), "details": told}
        rows.append(row | {"parameters": parameter_texts(stage.get("parameters"))})
    return rows


def parameter_texts(parameters: JSON | None) -> list[str]:
    """Return ``name = value ± uncertainty unit`` of a stage or an effect.

    Where only a standard uncertainty is stated, twice its value is shown, which covers about 95 %.
    """
    texts = []
    for name, given in (parameters or {}).items():
        p = given if isinstance(given, dict) else {"value": given}
        standard = p.get("standard_uncertainty")
        expanded = p.get("expanded_uncertainty", 2.0 * standard if standard else None)
        texts.append(f"{name} = {measured(p.get('value'), expanded)} {unit_text(p.get('unit'))}".rstrip())
    return texts


def monte_carlo_of(part: JSON) -> JSON | None:
    """Return what the page shows of the Monte Carlo run beside the uncertainty budget; None where there is none.

    Returns
    -------
    dict or None
        ``finding``, a sentence, and ``rows``, the index of each uncertain parameter.
    """
    budget = part.get("uncertainty_budget") or {}
    run = budget.get("monte_carlo")
    if not run:
        return None
    if not run["trials"]:
        return {"finding": f"No Monte Carlo run: {run['reason']}.", "rows": []}
    rows = [j for j, U in enumerate(run["expanded_uncertainty"]) if U > 0.0]
    validated = sum(run["validated"][j] for j in rows)
    digit = "second" if run["digits"] == 2 else "first"
    finding = (
        f"Monte Carlo, {run['trials']:,} trials: the interval of {validated} of {len(rows)} parameters agrees with the "
        f"budget's to half a unit of the {digit} digit of u."
    )
    if validated < len(rows):
        finding += " Where it does not, use the Monte Carlo interval."
    return {"finding": finding, "rows": rows}


def convergence_of(part: JSON) -> str:
    """Return one sentence on whether the fit is at a minimum, with the evidence; empty where nothing is known."""
    shown = part.get("convergence")
    if not shown:
        return ""
    condition = f"condition {number(shown['condition'])}" if shown.get("condition") else "condition not finite"
    rank = f"{condition} in scaled columns, {shown['rank']} of {shown['parameters']} determined"
    if shown.get("closed_form"):
        return f"A closed formula, without iteration; {rank}."
    cosine = f"largest cosine of the residual and a column of the Jacobian {number(shown['cosine'], 2)}"
    if part.get("converged", True):
        return f"The fit converged: {cosine}; {rank}."
    return (
        f"The fit did not converge: {cosine}, {rank}. Its values are where it stopped; do not use them. Record more, "
        "or fit fewer effects."
    )
