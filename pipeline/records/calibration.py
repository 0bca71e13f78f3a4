"""The calibration of one sensor, as it grows stage by stage, and its JSON form.

``reading = bias + matrix^-1 @ truth + effects + noise``, so ``truth = matrix @ (reading - bias - effects)``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from pipeline.records.budget import finite

if TYPE_CHECKING:
    from numpy.typing import NDArray

UNITS = {"accelerometer": "g", "gyroscope": "deg/s"}


@dataclass(frozen=True)
class StageResult:
    """One stage of a fit.

    Attributes
    ----------
    name : str
    parameters : dict
        Name to ``{"value", "unit", "standard_uncertainty"}``; the uncertainty may be None.
    residual_rms : float or None
        Of the fit's own error measure after this stage, unit of the sensor.
    correction : dict or None
        How readings are corrected up to and including this stage, where that is not yet (or not only) matrix and
        bias; what it means is known to the method's module in ``pipeline.estimation``.
    details : dict
        Free figures for the report (condition number, samples used, iterations ...).
    """

    name: str
    parameters: dict[str, Any]
    residual_rms: float | None = None
    correction: dict[str, Any] | None = None
    details: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class FittedEffect:
    """A fitted effect: its name and parameters.

    Attributes
    ----------
    name : str
    parameters : dict
        Name to ``{"value", "unit", "expanded_uncertainty"}``.
    definition : dict or None
        Of an effect of the user's own, what it is made from, so that the calibration says all that is needed to
        apply it; None for a built-in one.
    """

    name: str
    parameters: dict[str, dict[str, Any]]
    definition: dict[str, Any] | None = None

    @property
    def values(self) -> NDArray[np.float64]:
        """Values of the parameters, in their order."""
        return np.array([p["value"] for p in self.parameters.values()])


@dataclass(frozen=True)
class SensorCalibration:
    """What is known of one sensor after a stage.

    Attributes
    ----------
    sensor : str
        ``accelerometer`` or ``gyroscope``.
    bias : (3,) array, g or deg/s
    matrix : (3, 3) array, dimensionless
    stages : tuple of StageResult
    effects : tuple of FittedEffect
    covariance : (12, 12) array or None
        Of (bias_x..z, matrix_xx, matrix_xy .. matrix_zz), then each effect's parameters (then larger than 12); of all
        that the uncertainty budget includes.
    degrees_of_freedom : float
        The smallest of the parameters.
    converged : bool
    freedom : (p,) array or None
        Effective degrees of freedom of each parameter; None: ``degrees_of_freedom`` for all.
    budget : dict or None
        The uncertainty budget as its file holds it; see ``pipeline.estimation.budget``.
    convergence : dict or None
        What shows that the estimate is a minimum: ``cosine``, the largest between the residual and a column of the
        Jacobian, with ``condition`` and ``rank`` of its scaled columns, and ``parameters``, their number.
    """

    sensor: str
    bias: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    matrix: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    stages: tuple[StageResult, ...] = ()
    effects: tuple[FittedEffect, ...] = ()
    covariance: NDArray[np.float64] | None = None
    degrees_of_freedom: float = float("inf")
    converged: bool = True
    freedom: NDArray[np.float64] | None = None
    budget: dict[str, Any] | None = None
    convergence: dict[str, Any] | None = None

    def parameter_names(self) -> list[str]:
        """Return the names of the covariance's rows."""
        names = [f"bias_{a}" for a in "xyz"] + [f"matrix_{a}{b}" for a in "xyz" for b in "xyz"]
        return names + [f"{e.name}.{p}" for e in self.effects for p in e.parameters]

    def to_json(self) -> dict[str, Any]:
        """Return the sensor's part of ``calibrations/<unit>.json``."""
        size = len(self.parameter_names())
        covariance = np.zeros((size, size)) if self.covariance is None else self.covariance
        freedom = np.full(size, self.degrees_of_freedom) if self.freedom is None else self.freedom
        factors = coverage_factors(freedom)
        standard = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
        return {
            "unit": UNITS[self.sensor],
            "bias": self.bias.tolist(),
            "matrix": self.matrix.tolist(),
            "standard_uncertainty": _shaped(standard),
            "expanded_uncertainty": _shaped(factors * standard),
            "coverage_factor": _shaped(factors),
            "degrees_of_freedom": self.degrees_of_freedom if np.isfinite(self.degrees_of_freedom) else None,
            "effective_degrees_of_freedom": finite(freedom),
            "covariance": {"parameters": self.parameter_names(), "values": covariance.tolist()},
            "stages": [
                {
                    "name": s.name,
                    "parameters": s.parameters,
                    "residual_rms": s.residual_rms,
                    "correction": s.correction,
                    "details": s.details,
                }
                for s in self.stages
            ],
            "effects": [
                {"name": e.name, "parameters": e.parameters} | ({"definition": e.definition} if e.definition else {})
                for e in self.effects
            ],
            "converged": self.converged,
            "convergence": self.convergence,
            "uncertainty_budget": self.budget,
        }

    @classmethod
    def from_json(cls, sensor: str, data: dict[str, Any]) -> Self:
        """Read back what ``to_json`` wrote."""
        freedom = data.get("effective_degrees_of_freedom")
        return cls(
            sensor=sensor,
            bias=np.array(data["bias"], float),
            matrix=np.array(data["matrix"], float),
            stages=tuple(StageResult(**s) for s in data["stages"]),
            effects=tuple(FittedEffect(**e) for e in data["effects"]),
            covariance=np.array(data["covariance"]["values"], float),
            degrees_of_freedom=float("inf") if data["degrees_of_freedom"] is None else data["degrees_of_freedom"],
            converged=data["converged"],
            freedom=None if freedom is None else np.array([np.inf if nu is None else nu for nu in freedom]),
            budget=data.get("uncertainty_budget"),
            convergence=data.get("convergence"),
        )


def _shaped(values: NDArray[np.float64]) -> dict[str, Any]:
    """Return the values of bias and matrix in the shapes of these."""
    return {"bias": values[:3].tolist(), "matrix": values[3:12].reshape(3, 3).tolist()}


def coverage_factor(degrees_of_freedom: float, probability: float = 0.95) -> float:
    """Return the two-sided coverage factor k of Student's t.

    k solves ``P(|t_nu| <= k) = probability`` (JCGM 100:2008, annex G); for infinite ``nu`` it is the normal quantile.

    Parameters
    ----------
    degrees_of_freedom : float
    probability : float

    Returns
    -------
    float
    """
    return float(coverage_factors(np.array([degrees_of_freedom]), probability)[0])


def coverage_factors(degrees_of_freedom: NDArray[np.float64], probability: float = 0.95) -> NDArray[np.float64]:
    """Return ``coverage_factor`` of each of (n,) degrees of freedom."""
    from scipy.special import ndtri, stdtrit  # noqa: PLC0415  (0.1 s that only writers of uncertainties pay)

    upper, known = 0.5 + probability / 2.0, np.isfinite(degrees_of_freedom)
    factors: NDArray[np.float64] = np.where(
        known, stdtrit(np.where(known, degrees_of_freedom, 1.0), upper), ndtri(upper)
    )
    return factors
