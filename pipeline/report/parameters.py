"""The fitted parameters of a sensor with their uncertainties, and texts of the pages about the fit.

The calibration file contains the matrix M of ``truth = M (reading - bias - effects)``. A sensor file states scale
factor errors and cross-axis sensitivities, which are elements of ``K = M^-1`` in ``reading = bias + K truth +
effects``:

    dK = -K dM K,    cov(K) = J cov(M) J^T,    J = K (x) K^T    (rows of M one after the other)
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pipeline.errors import first
from pipeline.estimation.candidates import is_held
from pipeline.records import AXES
from pipeline.report.numbers import measured, number, percent, plain, unit_text

if TYPE_CHECKING:
    from collections.abc import Sequence

JSON = dict[str, Any]
LEFT_OUT = (
    "marked samples, and samples that the method does not use: outside of rests or steady turns, or of a vague log"
)
CROSS_AXIS = "cross_axis"  # elements of K outside its diagonal, as a sensor file limits them
NAMED = 5  # parameters beyond the limits of the sensor file that a page lists at its top
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


def stage_details(stage: JSON) -> list[str]:
    """Return the details of a stage of the fit that have one value, as texts."""
    details = {k: v for k, v in (stage.get("details") or {}).items() if isinstance(v, int | float | str | bool)}
    shown = {k: number(v, 4) if isinstance(v, float) else f"{v:,}" if type(v) is int else v for k, v in details.items()}
    texts = {k: f"{plain(k)}: {text}" for k, text in shown.items()}
    if details.get("samples_left_out"):
        texts["samples_left_out"] += f" ({LEFT_OUT})"
    return list(texts.values())


def parameter_texts(parameters: JSON | None, *, uncertain: bool = True) -> list[str]:
    """Return ``name = value ± uncertainty unit`` for each parameter of an effect or a stage.

    Where only a standard uncertainty is stated, twice its value is shown, which covers about 95 %.
    """
    texts = []
    for name, given in (parameters or {}).items():
        p = given if isinstance(given, dict) else {"value": given}
        if is_held(name, p):
            texts.append(f"{name} fixed at 0")
            continue
        standard = p.get("standard_uncertainty")
        expanded = p.get("expanded_uncertainty", 2.0 * standard if standard else None)
        value = measured(p.get("value"), expanded if uncertain else None)
        texts.append(f"{name} = {value} {unit_text(p.get('unit'))}".rstrip())
    return texts


def monte_carlo_of(budget: JSON) -> JSON | None:
    """Return the result of the Monte Carlo run of an uncertainty budget for the page; None without a run.

    ``finding``: a sentence; ``rows``: the index of each uncertain parameter.
    """
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
