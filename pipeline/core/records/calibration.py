"""The calibration of one sensor after a stage of a fit, and its JSON form.

reading = bias + matrix^-1 @ truth + effects + noise
truth   = matrix @ (reading - bias - effects)

Correct readings by the steps of a method, each of which acts on the output of the step before.

The steps act on row vectors v. Published is ``{"steps": [...]}`` with one entry for each:

    {"subtract": b}                                          v - b
    {"matrix": M}                                            v M^T, that is M v as a column
    {"two_sided": {"positive": p, "negative": n, "switch_at": s}}   p_i v_i if v_i > s_i, else n_i v_i

where b, p, n, s are (3,) and M is (3, 3).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Self, TypeAlias

import numpy as np

from imu_logs.units import SENSOR_UNITS
from pipeline.core.errors import ConfigurationError
from pipeline.core.records.budget import (
    BASE,
    BASE_COUNT,
    BASE_NAMES,
    BIAS,
    LIMIT,
    Budget,
    BudgetLine,
    Estimate,
    Parameters,
    base_units,
    base_values,
    finite,
    matrix_of,
    unlimited,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from imu_logs.log import Mask, Values


STEP_KINDS = "subtract, matrix, two_sided"


@dataclass(frozen=True)
class Subtract:
    """The step ``v - b``."""

    offset: Values  # (3,)

    def apply(self, readings: Values) -> Values:
        """Apply the step to (n, 3) readings."""
        return readings - self.offset

    def to_json(self) -> dict[str, Any]:
        """Return the step as published."""
        return {"subtract": self.offset.tolist()}


@dataclass(frozen=True)
class Multiply:
    """The step ``v M^T``."""

    matrix: Values  # (3, 3)

    def apply(self, readings: Values) -> Values:
        """Apply the step to (n, 3) readings."""
        return readings @ self.matrix.T

    def to_json(self) -> dict[str, Any]:
        """Return the step as published."""
        return {"matrix": self.matrix.tolist()}


@dataclass(frozen=True)
class TwoSided:
    """The step that multiplies each axis by one of two factors."""

    # each (3,)
    positive: Values
    negative: Values
    switch_at: Values

    def apply(self, readings: Values) -> Values:
        """Apply the step to (n, 3) readings."""
        return np.asarray(readings * np.where(readings > self.switch_at, self.positive, self.negative))

    def to_json(self) -> dict[str, Any]:
        """Return the step as published."""
        return {"two_sided": {name: value.tolist() for name, value in vars(self).items()}}


CorrectionStep: TypeAlias = Subtract | Multiply | TwoSided


def steps_of(correction: Mapping[str, Any] | None) -> tuple[CorrectionStep, ...] | None:
    """Return the steps of a published correction; raise ``ConfigurationError`` if one is of an unknown kind."""
    return None if correction is None else tuple(_step(entry) for entry in correction["steps"])


def _step(entry: Mapping[str, Any]) -> CorrectionStep:
    match dict(entry):
        case {"subtract": offset}:
            return Subtract(np.asarray(offset, float))
        case {"matrix": matrix}:
            return Multiply(np.asarray(matrix, float))
        case {"two_sided": sides}:
            return TwoSided(*(np.asarray(sides[name], float) for name in ("positive", "negative", "switch_at")))
    raise ConfigurationError(f"a correction has a step {sorted(entry)}; known kinds are {STEP_KINDS}")


def published(steps: Sequence[CorrectionStep]) -> dict[str, Any]:
    """Return the published correction."""
    return {"steps": [step.to_json() for step in steps]}


def corrected(steps: Sequence[CorrectionStep], readings: Values) -> Values:
    """Return (n, 3) readings, g or deg/s, after the steps of a correction."""
    out = np.array(readings, float)
    for step in steps:
        out = step.apply(out)
    return out


SCHEMA_VERSION = 2  # of published documents; the keys of each version are in pipeline/schemas
PRODUCT = 0.1  # of a limit: the largest change of one parameter by the limit of others
READABLE_VERSIONS = (1, 2)  # a key that a document of version 1 lacks counts as null


@dataclass(frozen=True)
class StageResult:
    """One stage of a fit."""

    name: str
    parameters: Mapping[str, Estimate] = field(default_factory=dict)
    residual_rms: float | None = None  # of the error that the fit minimises, after this stage, unit of the sensor
    correction: tuple[CorrectionStep, ...] | None = (
        None  # of readings after this stage, if it is more than matrix and bias
    )
    details: Mapping[str, Any] = field(default_factory=dict)  # for the report: condition number, samples, iterations

    def to_json(self) -> dict[str, Any]:
        """Return the entry of the document."""
        parameters = {name: dict(vars(estimate)) for name, estimate in self.parameters.items()}
        correction = None if self.correction is None else published(self.correction)
        return {**vars(self), "parameters": parameters, "correction": correction}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Return the object from the value of ``to_json``."""
        parameters = {name: Estimate(**estimate) for name, estimate in data["parameters"].items()}
        return cls(**{**data, "parameters": parameters, "correction": steps_of(data.get("correction"))})


@dataclass(frozen=True)
class FittedEffect:
    """A fitted effect; ``parameters`` map names to ``{"value", "unit", "expanded_uncertainty"}``.

    ``definition`` is the content of the file of a user's effect, so that the calibration can be applied without that
    file; None for a built-in effect.
    """

    name: str
    parameters: dict[str, dict[str, Any]]
    definition: dict[str, Any] | None = None

    @property
    def values(self) -> Values:
        """Values of the parameters, in their order."""
        return np.array([p["value"] for p in self.parameters.values()])


@dataclass(frozen=True)
class SensorCalibration:
    """Calibration of one sensor after a stage.

    ``convergence`` is the evidence that the estimate is a minimum: ``cosine``, the largest cosine between the residual
    and a column of the Jacobian; ``condition`` and ``rank`` of its scaled columns; ``parameters``, their number.
    """

    sensor: str
    bias: Values = field(default_factory=lambda: np.zeros(3))  # (3,), g or deg/s
    matrix: Values = field(default_factory=lambda: np.eye(3))  # (3, 3), dimensionless
    stages: tuple[StageResult, ...] = ()
    effects: tuple[FittedEffect, ...] = ()
    # (p, p), in the order of ``pipeline.core.records.budget``; it includes all lines of the uncertainty budget.
    covariance: Values | None = None
    degrees_of_freedom: float = float("inf")  # smallest of all parameters
    converged: bool = True
    freedom: Values | None = None  # (p,), effective degrees of freedom; None: ``degrees_of_freedom`` for all
    budget: Budget | None = None
    convergence: dict[str, Any] | None = None
    # each (12, p), signed; change of bias and matrix by each parameter of an effect, absent in the model, at its limit
    at_limits: Mapping[str, Values] = field(default_factory=dict)

    @property
    def parameters(self) -> Parameters:
        """Bias, matrix and the parameters of each effect."""
        of_effects = [
            (f"{e.name}.{name}", str(p.get("unit", ""))) for e in self.effects for name, p in e.parameters.items()
        ]
        names = (*BASE_NAMES, *(name for name, _ in of_effects))
        return Parameters(
            names,
            (*base_units(self.sensor), *(unit for _, unit in of_effects)),
            np.concatenate([base_values(self.bias, self.matrix), *(e.values for e in self.effects)]),
            np.zeros((len(names), len(names))) if self.covariance is None else self.covariance,
            np.full(len(names), self.degrees_of_freedom) if self.freedom is None else self.freedom,
        )

    @property
    def lines(self) -> tuple[BudgetLine, ...]:
        """The lines of the budget; empty without a budget."""
        return self.budget.lines if self.budget else ()

    @property
    def by_limit(self) -> Mask:
        """Whether the sensor file's limit, and not the recordings, determines bias and matrix: (12,) array.

        It causes more than half of the variance, and more than its products do: open cross-axis terms change a scale
        factor that is known by some hundredths of their limit.
        """
        lines = (line.standard_uncertainty[BASE] for line in self.lines if line.source == LIMIT)
        u = next(lines, np.zeros(BASE_COUNT))
        half = np.sqrt(0.5 * np.diag(self.parameters.covariance)[BASE])
        return np.asarray((u > half) & (u > PRODUCT * u.max()))

    def to_json(self) -> dict[str, Any]:
        """Return the part of ``calibrations/<unit>.json`` for this sensor."""
        parameters = self.parameters
        factors, standard = parameters.coverage_factor, parameters.standard_uncertainty
        return {
            "unit": SENSOR_UNITS[self.sensor],
            "bias": self.bias.tolist(),
            "matrix": self.matrix.tolist(),
            "standard_uncertainty": _shaped(standard),
            "expanded_uncertainty": _shaped(factors * standard),
            "determined_by": _shaped(np.where(self.by_limit, "sensor_file", "recordings")),
            "coverage_factor": _shaped(factors),
            "degrees_of_freedom": self.degrees_of_freedom if np.isfinite(self.degrees_of_freedom) else None,
            "effective_degrees_of_freedom": finite(parameters.degrees_of_freedom),
            "covariance": {"parameters": list(parameters.names), "values": parameters.covariance.tolist()},
            "stages": [stage.to_json() for stage in self.stages],
            "effects": [
                {"name": e.name, "parameters": e.parameters} | ({"definition": e.definition} if e.definition else {})
                for e in self.effects
            ],
            "converged": self.converged,
            "convergence": self.convergence,
            "uncertainty_budget": self.budget and self.budget.to_json(parameters),
            "at_limits": {name: change.tolist() for name, change in self.at_limits.items()},
        }

    @classmethod
    def from_json(cls, sensor: str, data: dict[str, Any]) -> Self:
        """Return the object from the value of ``to_json``; null in the covariance: not known."""
        freedom, budget = data.get("effective_degrees_of_freedom"), data.get("uncertainty_budget")
        covariance = np.array(data["covariance"]["values"], float)
        return cls(
            sensor=sensor,
            bias=np.array(data["bias"], float),
            matrix=np.array(data["matrix"], float),
            stages=tuple(map(StageResult.from_json, data["stages"])),
            effects=tuple(FittedEffect(**e) for e in data["effects"]),
            covariance=None if np.isnan(covariance).all() else np.nan_to_num(covariance, copy=False),
            degrees_of_freedom=float("inf") if data["degrees_of_freedom"] is None else data["degrees_of_freedom"],
            converged=data["converged"],
            freedom=None if freedom is None else unlimited(freedom),
            budget=budget and Budget.from_json(budget),
            convergence=data.get("convergence"),
            at_limits={name: np.array(change, float) for name, change in data.get("at_limits", {}).items()},
        )


@dataclass(frozen=True)
class NotCalibrated:
    """The result of a fit where the recordings or the method cannot calibrate the sensor."""

    reason: str

    def to_json(self) -> dict[str, Any]:
        """Return the reason as a JSON document."""
        return {"not_calibrated": self.reason}


Fit: TypeAlias = SensorCalibration | NotCalibrated


def fit_from_json(sensor: str, data: dict[str, Any]) -> Fit:
    """Return the fit of a sensor from the value of its ``to_json``."""
    reason = data.get("not_calibrated")
    return SensorCalibration.from_json(sensor, data) if reason is None else NotCalibrated(reason)


def calibrated(fits: Mapping[str, Fit]) -> dict[str, SensorCalibration | None]:
    """Return the calibration of each sensor; None for a sensor that is not calibrated."""
    return {sensor: None if isinstance(fit, NotCalibrated) else fit for sensor, fit in fits.items()}


def _shaped(values: NDArray[Any]) -> dict[str, Any]:
    """Return values of all parameters in the shapes of bias and matrix."""
    return {"bias": values[BIAS].tolist(), "matrix": matrix_of(values).tolist()}
