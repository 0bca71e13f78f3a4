"""The calibration of one sensor after a stage of a fit, and its JSON form.

reading = bias + matrix^-1 @ truth + effects + noise
truth   = matrix @ (reading - bias - effects)

The steps of a method correct readings, too. Each acts on the row vectors v that the step before returns. Published is
``{"steps": [...]}`` with one entry for each:

    {"subtract": b}                                          v - b
    {"matrix": M}                                            v M^T, that is M v as a column
    {"two_sided": {"positive": p, "negative": n, "switch_at": s}}   p_i v_i if v_i > s_i, else n_i v_i

where b, p, n, s are (3,) and M is (3, 3).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from imu_logs.log import Mask, Values
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
    as_json,
    base_units,
    base_values,
    finite,
    matrix_of,
    unlimited,
)

STEP_KINDS = "subtract, matrix, two_sided"
COSINE_AT_MINIMUM = 1e-7  # the root of rounding, about 1e-8, times a factor for sums over many residuals
SCHEMA_VERSION = 2  # of published documents; the keys of each version are in pipeline/schemas
PRODUCT = 0.1  # of a limit: the largest change of one parameter by the limit of others
READABLE_VERSIONS = (1, 2)  # a key that a document of version 1 lacks counts as null


@dataclass(frozen=True)
class Subtract:
    """The step ``v - b``."""

    offset: Values  # (3,)

    def apply(self, readings: Values) -> Values:
        """Apply the step to (n, 3) readings."""
        return readings - self.offset


@dataclass(frozen=True)
class Multiply:
    """The step ``v M^T``."""

    matrix: Values  # (3, 3)

    def apply(self, readings: Values) -> Values:
        """Apply the step to (n, 3) readings."""
        return readings @ self.matrix.T


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
    return {"steps": [_entry(step) for step in steps]}


def _entry(step: CorrectionStep) -> dict[str, Any]:
    match step:
        case Subtract(offset):
            return {"subtract": offset.tolist()}
        case Multiply(matrix):
            return {"matrix": matrix.tolist()}
    return {"two_sided": as_json(step)}


def corrected(steps: Sequence[CorrectionStep], readings: Values) -> Values:
    """Return (n, 3) readings, g or deg/s, after the steps of a correction."""
    out = np.array(readings, float)
    for step in steps:
        out = step.apply(out)
    return out


@dataclass(frozen=True, kw_only=True)
class RestUse:
    """A rest that a fit uses, holds out or leaves out."""

    recording: str
    time_s: float
    duration_s: float
    creep_dps: float = 0.0  # where it is significant
    reason: str = ""  # why it is refused


@dataclass(frozen=True)
class OutlyingMove:
    """A move by hand that has less weight in a fit."""

    recording: str
    time_s: float
    error_deg: float
    over_noise: float
    weight: float


@dataclass(frozen=True)
class TurnAngle:
    """The total angle of a turn: stated, and by the calibration."""

    recording: str
    time_s: float
    axis: str
    stated_deg: float
    angle_deg: float


@dataclass(frozen=True)
class TurnAxes:
    """How well the axes of turns by hand are known, and would need to be."""

    stated_deg: float
    needed_deg: float


@dataclass(frozen=True, kw_only=True)
class StageDetails:
    """What a stage states of its fit, for the report and for later stages; None: it does not state this.

    Of noise, a number is that of all channels. A new stage mostly needs the first block.
    """

    rests: int | None = None
    samples_used: int | None = None
    samples_left_out: int | None = None
    equations: int | None = None
    rounds: int | None = None  # iterations
    condition: float | None = None  # of the scaled columns; infinite is published as null
    cosine: float | None = None  # largest between the residual and a column
    degrees_of_freedom: float | None = None  # smallest of all parameters
    white_noise: float | Sequence[float] | None = None
    bias_wander: Sequence[float] | None = None
    residual_rms: Sequence[float] | None = None  # of each channel
    departures: Sequence[str] | None = None  # of faces and turns by hand from what is stated
    replaces: str | None = None  # stage whose bias and matrix are fitted anew
    # a fit with effects
    samples: int | None = None
    wander_ratio: float | None = None
    wander_time_s: float | None = None
    scatter_over_noise: Sequence[float] | None = None
    # rests and moves by hand
    orientations_used: int | None = None
    rests_used: Sequence[RestUse] | None = None
    rests_left_out: Sequence[RestUse] | None = None
    rests_held_out: Sequence[RestUse] | None = None
    known_by_limit: Mapping[str, float] | None = None  # parameters with a pseudo-observation, each with its u
    scatter_between_rests: float | None = None
    scatter_time_s: float | None = None  # of slow movement: correlation time of its accelerations
    noise_of_means: float | None = None  # standard deviation of a mean that was recorded as such, by their scatter
    largest_error: float | None = None
    rests_on_faces: Mapping[str, int] | None = None
    face_off_deg: Mapping[str, float] | None = None
    moves: int | None = None
    direction_error_rms_deg: float | None = None  # null without a move, as the scatter of moves
    scatter_of_rests: float | None = None
    scatter_of_moves: float | None = None
    scatter_of_directions: float | None = None
    moves_weighted_down: int | None = None
    moves_outlying: Sequence[OutlyingMove] | None = None
    accelerometer_moved: Sequence[float] | None = None  # change of its bias and matrix that the moves show
    # turns
    turns: int | Sequence[TurnAngle] | None = None
    turns_left_out: int | None = None
    turn_axes: TurnAxes | None = None
    angle_error_rms_deg: Sequence[Sequence[float | None]] | None = None
    orthonormality_error: float | None = None
    determinant_of_M: float | None = None  # noqa: N815  (the key of the document)
    # a given calibration, the mean of several, or one with the prior of its lot
    source: str | None = None
    sha256: str | None = None
    notes: Sequence[str] | None = None
    left_out: Sequence[str] | None = None
    calibrations: int | None = None
    repeatability: Sequence[float] | None = None
    lot: str | None = None
    siblings: int | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the entries of the document."""
        without_moves = ("direction_error_rms_deg", "scatter_of_moves") if self.moves is not None else ()
        stated = {k: v for k, v in as_json(self).items() if v is not None or k in without_moves}
        return stated if self.condition is None or np.isfinite(self.condition) else {**stated, "condition": None}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Return the object from the value of ``to_json``."""
        known = {k: v for k, v in data.items() if k in cls.__dataclass_fields__}  # not of other versions
        if "condition" in known and known["condition"] is None:
            known["condition"] = float("inf")
        for name, kind in ENTRIES.items():
            if isinstance(entries := known.get(name), list):
                known[name] = tuple(kind(**entry) for entry in entries)
        if axes := known.get("turn_axes"):
            known["turn_axes"] = TurnAxes(**axes)
        return cls(**known)


ENTRIES = {
    **dict.fromkeys(("rests_used", "rests_left_out", "rests_held_out"), RestUse),
    "moves_outlying": OutlyingMove, "turns": TurnAngle,
}  # fmt: skip


@dataclass(frozen=True)
class StageResult:
    """One stage of a fit."""

    name: str
    parameters: Mapping[str, Estimate] = field(default_factory=dict)
    residual_rms: float | None = None  # of the error that the fit minimises, after this stage, unit of the sensor
    correction: tuple[CorrectionStep, ...] | None = None  # of readings after it, if it is more than matrix and bias
    details: StageDetails = field(default_factory=StageDetails)

    def to_json(self) -> dict[str, Any]:
        """Return the entry of the document."""
        correction = None if self.correction is None else published(self.correction)
        return {**as_json(self), "correction": correction, "details": self.details.to_json()}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Return the object from the value of ``to_json``."""
        parameters = {name: Estimate(**estimate) for name, estimate in data["parameters"].items()}
        correction, details = steps_of(data.get("correction")), StageDetails.from_json(data.get("details") or {})
        return cls(data["name"], parameters, data.get("residual_rms"), correction, details)


@dataclass(frozen=True)
class Coefficient:
    """The value of a coefficient of an effect."""

    value: float
    unit: str = ""  # empty: not stated
    expanded_uncertainty: float | None = None


@dataclass(frozen=True)
class FittedEffect:
    """A fitted effect."""

    name: str
    parameters: Mapping[str, Coefficient]
    definition: dict[str, Any] | None = None  # content of the file of a user's effect, to be applied without the file

    @property
    def values(self) -> Values:
        """Values of the parameters, in their order."""
        return np.array([p.value for p in self.parameters.values()])

    def at(self, values: Iterable[float]) -> FittedEffect:
        """Return the effect with other values of its parameters, in their order."""
        pairs = zip(self.parameters.items(), values, strict=True)
        return replace(self, parameters={name: replace(p, value=value) for (name, p), value in pairs})

    def to_json(self) -> dict[str, Any]:
        """Return the entry of the document."""
        return {key: value for key, value in as_json(self).items() if key != "definition" or value}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Return the object from the value of ``to_json``."""
        keys = Coefficient.__dataclass_fields__
        stated = {name: {k: v for k, v in p.items() if k in keys} for name, p in data["parameters"].items()}
        return cls(data["name"], {n: Coefficient(**p) for n, p in stated.items()}, data.get("definition"))


@dataclass(frozen=True)
class Convergence:
    """The evidence that the estimate of a fit is a minimum."""

    cosine: float  # largest between the residual and a column of the Jacobian
    condition: float  # of the scaled columns; infinite is published as null
    rank: int
    parameters: int  # their number
    cosine_at_minimum: float = COSINE_AT_MINIMUM
    closed_form: bool = False

    def to_json(self) -> dict[str, Any]:
        """Return the entry of the document."""
        condition = self.condition if np.isfinite(self.condition) else None
        return {k: v for k, v in vars(self).items() if k != "closed_form" or v} | {"condition": condition}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Return the object from the value of ``to_json``."""
        return cls(**{**data, "condition": np.inf if data["condition"] is None else data["condition"]})


@dataclass(frozen=True)
class SensorCalibration:
    """Calibration of one sensor after a stage."""

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
    convergence: Convergence | None = None
    # each (12, p), signed; change of bias and matrix by each parameter of an effect, absent in the model, at its limit
    at_limits: Mapping[str, Values] = field(default_factory=dict)

    @property
    def parameters(self) -> Parameters:
        """Bias, matrix and the parameters of each effect."""
        of_effects = [(f"{e.name}.{name}", p.unit) for e in self.effects for name, p in e.parameters.items()]
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
            "standard_uncertainty": shaped(standard),
            "expanded_uncertainty": shaped(factors * standard),
            "determined_by": shaped(np.where(self.by_limit, "sensor_file", "recordings")),
            "coverage_factor": shaped(factors),
            "degrees_of_freedom": self.degrees_of_freedom if np.isfinite(self.degrees_of_freedom) else None,
            "effective_degrees_of_freedom": finite(parameters.degrees_of_freedom),
            "covariance": {"parameters": list(parameters.names), "values": parameters.covariance.tolist()},
            "stages": [stage.to_json() for stage in self.stages],
            "effects": [effect.to_json() for effect in self.effects],
            "converged": self.converged,
            "convergence": self.convergence and self.convergence.to_json(),
            "uncertainty_budget": self.budget and self.budget.to_json(parameters),
            "at_limits": as_json(self.at_limits),
        }

    @classmethod
    def from_json(cls, sensor: str, data: dict[str, Any]) -> Self:
        """Return the object from the value of ``to_json``; null in the covariance: not known."""
        freedom, budget = data.get("effective_degrees_of_freedom"), data.get("uncertainty_budget")
        covariance, convergence = np.array(data["covariance"]["values"], float), data.get("convergence")
        return cls(
            sensor=sensor,
            bias=np.array(data["bias"], float),
            matrix=np.array(data["matrix"], float),
            stages=tuple(map(StageResult.from_json, data["stages"])),
            effects=tuple(map(FittedEffect.from_json, data["effects"])),
            covariance=None if np.isnan(covariance).all() else np.nan_to_num(covariance, copy=False),
            degrees_of_freedom=float("inf") if data["degrees_of_freedom"] is None else data["degrees_of_freedom"],
            converged=data["converged"],
            freedom=None if freedom is None else unlimited(freedom),
            budget=budget and Budget.from_json(budget),
            convergence=convergence and Convergence.from_json(convergence),
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


def shaped(values: NDArray[Any]) -> dict[str, Any]:
    """Return values of all parameters in the shapes of bias and matrix."""
    return {"bias": values[BIAS].tolist(), "matrix": matrix_of(values).tolist()}
