"""The uncertainty budget of a sensor as the rows of its table, and how the fit converged, in words."""

from __future__ import annotations

from typing import Any

from pipeline.report.numbers import NOTHING, number

JSON = dict[str, Any]


def budget_of(part: JSON) -> JSON | None:
    """Return what the budget's table shows, or None where a calibration has none.

    Parameters
    ----------
    part : dict
        The sensor's part of the calibration.

    Returns
    -------
    dict or None
        ``sources``: a row each; ``parameters``: a row each, with one cell for every source; ``not_included``;
        ``trials``: the Monte Carlo run beside it, or None.
    """
    budget = part.get("uncertainty_budget")
    if not budget:
        return None
    lines = budget["contributions"]
    return {
        "sources": [_source(line) for line in lines],
        "parameters": [
            {
                "name": name.replace("_", " ").replace(".", ": "),
                "unit": "" if unit == "1" else unit,
                "contributions": [number(line["contribution"][j], 2) for line in lines],
                "standard": number(budget["standard_uncertainty"][j], 2),
                "freedom": _freedom(budget["effective_degrees_of_freedom"][j]),
                "factor": number(budget["coverage_factor"][j], 3),
                "expanded": number(budget["expanded_uncertainty"][j], 2),
            }
            for j, (name, unit) in enumerate(zip(budget["parameters"], budget["units"], strict=True))
        ],
        "not_included": budget["not_included"],
        "trials": _trials(budget),
    }


def convergence_of(part: JSON) -> str:
    """Return one sentence on whether the fit stands at a minimum, and what shows it; empty where nothing is known."""
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


def _trials(budget: JSON) -> JSON | None:
    """Return the Monte Carlo run as a sentence and a row for each uncertain parameter, or None where there is none."""
    run = budget.get("monte_carlo")
    if not run:
        return None
    if not run["trials"]:
        return {"finding": f"No Monte Carlo run: {run['reason']}.", "rows": []}
    values, rows = run["estimate"], []
    for j, name in enumerate(budget["parameters"]):
        U = run["expanded_uncertainty"][j]
        if U > 0.0:
            row = {"name": name.replace("_", " ").replace(".", ": "), "validated": run["validated"][j]}
            ends = {"low": run["low"][j] - values[j], "high": run["high"][j] - values[j]}
            row |= {"U": number(U, 2), **{k: f"{'+' if v > 0 else ''}{number(v, 2)}" for k, v in ends.items()}}
            rows.append(row | {key: number(run[key][j], 2) for key in ("d_low", "d_high", "tolerance")})
    borne = sum(row["validated"] for row in rows)
    finding = (
        f"Monte Carlo, {run['trials']:,} trials: the interval of {borne} of {len(rows)} parameters agrees with the "
        f"budget's to half a unit of the {'second' if run['digits'] == 2 else 'first'} digit of u."
    )
    if borne < len(rows):
        finding += " Where it does not, take the Monte Carlo interval."
    return {"finding": finding, "rows": rows}


def _source(line: JSON) -> JSON:
    u, inputs = line["standard_uncertainty"], line["independent_inputs"]
    worst = {name: max(values) for name, values in (line.get("parts") or {}).items()}
    largest = max(worst.values(), default=0.0) or 1.0
    return {
        "name": line["source"],
        "type": line["type"],
        "distribution": line["distribution"],
        "input": NOTHING if u is None else f"{number(u, 2)} {'' if line['unit'] == '1' else line['unit']}".rstrip(),
        "inputs": NOTHING if u is None else inputs,
        "remark": line.get("remark") or "",
        "parts": [name for name, size in worst.items() if size > 1e-3 * largest],
    }


def _freedom(value: float | None) -> str:
    return "\N{INFINITY}" if value is None or value > 1e6 else number(value, 3)
