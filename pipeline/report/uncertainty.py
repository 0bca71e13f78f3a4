"""The uncertainty of bias and matrix with what the fit cannot see: the table's, gravity's and the Earth's share.

    u_c^2 = u_fit^2 + sum_i a_i^2 / 3,    nu_eff = nu_fit u_c^4 / u_fit^4,    U = t_{0.975}(nu_eff) u_c

where

    u_fit, nu_fit : standard uncertainty of the fit and its degrees of freedom: noise, bias wander, lack of fit (type A)
    a_i           : half-width of a rectangular distribution, from the configuration (type B), with sensitivity 1: an
                    error of the table's angle changes a matrix element by at most its size, a bias by at most gravity
                    times it; so the share is an upper bound
    u_c           : combined standard uncertainty

Source: JCGM 100:2008, 4.3.7 (rectangular), 5.1.2 (combined), G.4.1 (Welch-Satterthwaite).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import radians, sqrt

from pipeline.records.calibration import coverage_factor
from pipeline.report.figure import AXES, JSON

EARTH_RATE_DPS = 15.041 / 3600.0
SQRT_3 = sqrt(3.0)


@dataclass(frozen=True)
class Share:
    """A row of a budget; ``of`` says of which parameters: ``bias``, ``same`` (diagonal of the matrix) or ``cross``."""

    name: str
    standard_uncertainty: float
    of: tuple[str, ...]
    source: str
    distribution: str = "rectangular"


def shares(sensor: str, settings: JSON) -> list[Share]:
    """Return what reference and place add to the uncertainty of a sensor's parameters.

    Parameters
    ----------
    sensor : str
    settings : dict
        Sections ``table`` and ``certificate``.
    """
    table, gravity = settings["table"], (settings["table"].get("gravity_g") or 1.0)
    moved, found = table.get("motion") != "none", []
    angle = radians(table["angle_accuracy_deg"]) / SQRT_3
    square = radians(table["orthogonality_deg"]) / SQRT_3
    if sensor == "accelerometer":
        if moved:
            found += [
                Share("angle of the table", gravity * angle, ("bias", "same", "cross"), "table.angle_accuracy_deg")
            ]
            found += [Share("orthogonality of the table's axes", square, ("cross",), "table.orthogonality_deg")]
        stated = settings["certificate"].get("gravity_uncertainty")
        if stated is not None:
            found.append(
                Share("local gravity", stated / gravity, ("same",), "certificate.gravity_uncertainty", "normal")
            )
        return found
    if moved:
        found += [Share("rate of the table", table["rate_accuracy"] / SQRT_3, ("same",), "table.rate_accuracy")]
        found += [Share("orthogonality of the table's axes", square, ("cross",), "table.orthogonality_deg")]
    if table.get("latitude_deg") is None or table.get("azimuth_deg") is None:
        found.append(
            Share(
                "Earth's rotation, not in the model",
                EARTH_RATE_DPS / SQRT_3,
                ("bias",),
                "15.041 deg/h, direction unknown",
            )
        )
    return found


def quantities(sensor: str, part: JSON, settings: JSON) -> list[JSON]:
    """Return bias and matrix, each with its combined expanded uncertainty, None where the fit gives none.

    Parameters
    ----------
    sensor : str
    part : dict
        The sensor's part of the calibration.
    settings : dict

    Returns
    -------
    list of dict
        ``name, kind, value, unit, expandedUnc`` (``uncertainty, coverageFactor, coverageProbability,
        effectiveDegreesOfFreedom``) and ``budget``.
    """
    known, added = has_uncertainty(part), shares(sensor, settings)
    unit, expanded, factor = part["unit"], part["expanded_uncertainty"], part["coverage_factor"]
    rows = [
        (f"bias {a}", "bias", part["bias"][i], unit, expanded["bias"][i], factor["bias"][i]) for i, a in enumerate(AXES)
    ]
    rows += [
        (
            f"matrix {a}{b}",
            "same" if i == j else "cross",
            part["matrix"][i][j],
            "1",
            expanded["matrix"][i][j],
            factor["matrix"][i][j],
        )
        for i, a in enumerate(AXES)
        for j, b in enumerate(AXES)
    ]
    freedom = part.get("degrees_of_freedom")
    return [
        {
            "name": name,
            "kind": kind,
            "value": value,
            "unit": of_unit,
            "expandedUnc": _combined(U / k, freedom, [s for s in added if kind in s.of]) if known else None,
        }
        for name, kind, value, of_unit, U, k in rows
    ]


def has_uncertainty(part: JSON) -> bool:
    """Return whether the fit of a sensor gave uncertainties."""
    return any(U > 0.0 for U in part["expanded_uncertainty"]["bias"])


def _combined(fit: float, freedom: float | None, added: list[Share]) -> JSON:
    total = sqrt(fit**2 + sum(s.standard_uncertainty**2 for s in added))
    effective = float("inf") if freedom is None or fit == 0.0 else freedom * (total / fit) ** 4
    factor = coverage_factor(effective)
    return {
        "uncertainty": factor * total,
        "standardUncertainty": total,
        "coverageFactor": factor,
        "coverageProbability": 0.95,
        "effectiveDegreesOfFreedom": None if effective == float("inf") else effective,
        "distribution": "t",
        "standardUncertaintyOfTheFit": fit,
    }
