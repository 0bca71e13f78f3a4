"""The fitted parameters of a sensor, each with its expanded uncertainty and coverage factor.

The calibration file holds the matrix M of ``truth = M (reading - bias - effects)``. A data sheet states scale factor
errors and cross-axis sensitivities, which are elements of ``K = M^-1`` in ``reading = bias + K truth + effects``:

    dK = -K dM K,    cov(K) = J cov(M) J^T,    J = K (x) K^T    (rows of M one after the other)
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from pipeline.records import AXES
from pipeline.report.numbers import plain

JSON = dict[str, Any]
NO_UNCERTAINTY: JSON = {"bias": [None] * 3, "matrix": [[None] * 3] * 3}


class Parameter(NamedTuple):
    """A value with its unit; the uncertainty is None where the method states none."""

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
    """Return bias, matrix and effects in the order of the covariance's rows.

    Parameters
    ----------
    part : dict
        The sensor's part of ``calibrations/<unit>.json``.

    Returns
    -------
    list of Parameter
        ``bias_x``, ``matrix_xy`` (row, column) and ``<effect>.<parameter>``. Each has its own coverage factor: the
        effective degrees of freedom differ between parameters.
    """
    U = part.get("expanded_uncertainty") or NO_UNCERTAINTY
    k = part.get("coverage_factor") or NO_UNCERTAINTY
    budget = part.get("uncertainty_budget") or {"parameters": [], "coverage_factor": []}
    own = dict(zip(budget["parameters"], budget["coverage_factor"], strict=True))
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
            name = f"{effect['name']}.{symbol}"
            found.append(Parameter(name, p["value"], p["unit"], p.get("expanded_uncertainty"), own.get(name)))
    return found


def reading_errors(part: JSON) -> list[Parameter]:
    """Return the elements of K that a data sheet states: ``scale_factor_error_x``, ``cross_axis_xy``.

    Parameters
    ----------
    part : dict
        The sensor's part of ``calibrations/<unit>.json``.

    Returns
    -------
    list of Parameter
        ``scale_factor_error_x`` is ``K_xx - 1``; ``cross_axis_xy`` is what axis x reads of a truth along y. Each has
        the coverage factor of the same element of the matrix.
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
        element(f"cross_axis_{a}{b}", K[i, j], i, j) for i, a in enumerate(AXES) for j, b in enumerate(AXES) if i != j
    ]
