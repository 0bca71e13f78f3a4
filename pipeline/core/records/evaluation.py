"""Validation of a unit (errors of both calibrations on held-out motion) and diagnosis of a sensor; their JSON forms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Self

from imu_logs.units import SENSORS
from pipeline.core.records.budget import Estimate, as_json, with_arrays
from pipeline.core.records.calibration import SCHEMA_VERSION
from pipeline.core.records.recording import Noise
from pipeline.core.verdicts import Verdict

FEWEST_MOVES = 6  # held-out moves whose mean error counts; of fewer, the error weighted by its covariance
NOISE_AS_PUBLISHED = {  # of a published validation: field of ``Noise``
    "white": "white", "wander": "wander", "correlation_time_s": "correlation_time",
    "source": "source", "wander_source": "wander_source", "correlation_time_source": "time_source",
}  # fmt: skip


@dataclass(frozen=True)
class StepErrors:
    """Errors of the magnitude after a step of a calibration, g or deg/s; None where no sample tests it."""

    name: str  # ``raw``, ``stage:<name>``, ``calibrated``, ``+ <effect>``
    mean_abs_error: float | None = None
    sum_abs_error: float | None = None
    max_error: float | None = None
    min_error: float | None = None
    rms_error: float | None = None
    change_percent: float | None = None  # of the mean, relative to that of raw readings
    vector_rms_error: float | None = None  # of the difference to the reference; None without an attitude


@dataclass(frozen=True)
class Agreement:
    """The matrix against that of held-out motion, and the element that differs most."""

    p_value: float
    reads: str  # axis of the sensor
    of: str  # axis of the truth
    error: float
    expanded_uncertainty: float


@dataclass(frozen=True)
class TemperatureBin:
    """Errors of the magnitude after the last step at one temperature, g or deg/s."""

    temperature_degc: float  # mean
    mean_error: float
    rms_error: float  # with the noise
    samples: int


@dataclass(frozen=True)
class OverTemperature:
    """Errors over a swept temperature."""

    samples_of: str  # which samples these are
    bins: tuple[TemperatureBin, ...]


@dataclass(frozen=True)
class LimitCheck:
    """A figure against its limit."""

    name: str
    limit: float
    value: float | None
    passes: bool


@dataclass(frozen=True)
class Reduced:
    """The best that a format holds of a calibration: a part of the matrix, and some of its effects."""

    part: str  # of the matrix: full, diagonal, none
    effects: Sequence[str]  # that it holds
    bias: Sequence[float]
    matrix: Sequence[Sequence[float]]
    rms_error: float | None  # held-out, of the magnitude


@dataclass(frozen=True, kw_only=True)
class SensorValidation:
    """A sensor's part of ``validations/<unit>.json``."""

    unit: str  # of the errors
    held_out: bool  # False: the samples of the fit are used
    reason: str | None  # why no samples are held out
    samples: int
    noise: Noise
    noise_floor: float | None = None
    vector_noise_floor: float | None = None
    reference_rms: float | None = None  # of the reference's magnitude
    steps: tuple[StepErrors, ...]
    notes: tuple[str, ...] = ()
    expected_rms_error: tuple[float, float] | None = None  # None where an effect is left out
    worse_than_raw: str | None = None  # why the calibration must not be used
    agreement: Agreement | None = None
    over_temperature: OverTemperature | None = None  # only where the temperature was swept
    reduced: tuple[Reduced, ...] = ()  # for formats that hold less
    limits: tuple[LimitCheck, ...] = ()

    @property
    def passes(self) -> bool | None:
        """Whether all limits are kept; None: there is no limit."""
        return all(check.passes for check in self.limits) if self.limits else None

    def to_json(self) -> dict[str, Any]:
        """Return the part of the document."""
        document: dict[str, Any] = as_json(self)
        document["noise"] = {key: as_json(getattr(self.noise, name)) for key, name in NOISE_AS_PUBLISHED.items()}
        document["limits"] = [
            {"name": c.name, "limit": c.limit, "value": c.value, "pass": c.passes} for c in self.limits
        ]
        optional = {"over_temperature", "reduced"}
        return {key: value for key, value in document.items() if value or key not in optional} | {"pass": self.passes}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Return the object from the value of ``to_json``."""
        noise, agreement, over = data["noise"], data["agreement"], data.get("over_temperature")
        arrays = with_arrays(noise)
        bins = tuple(TemperatureBin(**each) for each in over["bins"]) if over else ()
        nested: dict[str, Any] = {
            "noise": Noise(**{name: arrays[key] for key, name in NOISE_AS_PUBLISHED.items()}),
            "steps": tuple(StepErrors(**step) for step in data["steps"]),
            "notes": tuple(data["notes"]),
            "expected_rms_error": data["expected_rms_error"] and tuple(data["expected_rms_error"]),
            "agreement": agreement and Agreement(**agreement),
            "over_temperature": over and OverTemperature(over["samples_of"], bins),
            "reduced": tuple(Reduced(**each) for each in data.get("reduced", ())),
            "limits": tuple(LimitCheck(c["name"], c["limit"], c["value"], c["pass"]) for c in data["limits"]),
        }
        return cls(**nested, **{name: data[name] for name in cls.__dataclass_fields__ if name not in nested})


class MovesError(NamedTuple):
    """Errors of gravity's direction after held-out moves by hand."""

    rms_deg: float
    largest_deg: float  # largest rms that noise, scatter and uncertainties explain
    over_noise: float = 1.0  # mean error over that of noise alone; 1 for fewer than ``FEWEST_MOVES``
    over_expected: float | None = None  # of these: weighted error over the largest that is expected

    @property
    def over_largest(self) -> float:
        """The error over the largest that noise and uncertainties explain."""
        return self.rms_deg / self.largest_deg if self.over_expected is None else self.over_expected


@dataclass(frozen=True)
class Validation:
    """``validations/<unit>.json``."""

    unit: str
    sensors: Mapping[str, SensorValidation | None]  # None for a sensor without a calibration
    attitude: dict[str, Any]  # see ``pipeline.evaluation.held_out.attitude``
    gravity_direction: dict[str, Any]
    turns: Sequence[Mapping[str, Any]] = ()  # held-out turns of a sheet
    turn_departures: tuple[str, ...] = ()  # held-out turns whose stated angle the calibrated gyroscope contradicts

    @property
    def moves_error(self) -> MovesError | None:
        """Errors after held-out moves by hand; None without them, or where the fit does not determine the matrix."""
        found = self.gravity_direction
        if "largest_expected_rms_deg" not in found:
            return None
        several, floor = found["moves"] >= FEWEST_MOVES, found["noise_floor_deg"]
        over = found["mean_deg"]["after"] / floor if several and floor > 0.0 else 1.0
        expected = found["largest_expected_rms_deg"], over, found.get("over_expected")
        return MovesError(found["rms_deg"]["after"], *expected)

    def to_json(self) -> dict[str, Any]:
        """Return the document."""
        return {
            "schema_version": SCHEMA_VERSION,
            "unit": self.unit,
            **{sensor: part and part.to_json() for sensor, part in self.sensors.items()},
            "attitude": self.attitude,
            "gravity_direction": self.gravity_direction,
            **({"turns": list(self.turns)} if self.turns else {}),
            **({"turn_departures": list(self.turn_departures)} if self.turn_departures else {}),
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Return the object from the value of ``to_json``."""
        parts = {sensor: data[sensor] and SensorValidation.from_json(data[sensor]) for sensor in SENSORS}
        departures = tuple(data.get("turn_departures", ()))
        return cls(data["unit"], parts, data["attitude"], data["gravity_direction"], data.get("turns", ()), departures)


@dataclass(frozen=True)
class Candidate:
    """The evidence for an effect."""

    effect: str
    delta_bic: float
    p_value: float
    parameters: Mapping[str, Estimate]
    explained_share: float  # of the residual above the noise
    held_out_error_before: float | None  # of a selected effect
    held_out_error_after: float | None
    look_alikes: Mapping[str, float]  # effects with a similar signal, and the share that they reproduce
    plausible: bool  # within the sensor file's limits
    meaning: str | None = None  # of a user's effect

    def to_json(self) -> dict[str, Any]:
        """Return the entry of the ranking."""
        alike = [{"effect": name, "share": share} for name, share in self.look_alikes.items()]
        document = {**as_json(self), "look_alikes": alike}
        return {key: value for key, value in document.items() if key != "meaning" or value is not None}


@dataclass(frozen=True)
class Answer:
    """A set of effects that may be what is missing; empty: nothing is."""

    effects: Sequence[str]
    probability: float


@dataclass(frozen=True)
class FittedForm:
    """A functional form of a dependence of the residual."""

    shape: str  # in words
    kind: str  # of ``pipeline.evaluation.diagnosis.functional_forms.Factor``
    axes: Sequence[str]
    formulas: Sequence[str]
    units: Sequence[str]  # of the coefficients of the formulas
    coefficients: Sequence[Sequence[float]]  # of each axis
    size: float
    unit: str


@dataclass(frozen=True)
class Dependence:
    """A covariate on which the residual depends."""

    covariate: str
    p_value: float
    delta_bic: float | None = None  # None: of rests by hand
    form: FittedForm | None = None
    explained_by: str | None = None  # covariate whose form explains this dependence too

    def to_json(self, *, searched: bool) -> dict[str, Any]:
        """Return the entry of ``unexplained``; ``searched``: a form was found for a dependence of the sensor."""
        form = vars(self.form) if self.form else {}
        gain = {} if self.delta_bic is None else {"delta_bic": self.delta_bic}
        found = {"covariate": self.covariate, "p_value": self.p_value, **form, **gain}
        return found | ({"explained_by": self.explained_by} if searched else {})


@dataclass(frozen=True)
class RankedFormula:
    """A formula outside the catalogue."""

    formula: str
    complexity: int
    constants: int  # scanned
    delta_bic: float
    score: float
    axes: Sequence[str]
    stability: float | None  # share of the resamples in which it is the best; None: not among the finalists
    suggested: bool


@dataclass(frozen=True)
class SelectionErrors:
    """The held-out rms error without and with the selected effects, and the noise floor, g or deg/s."""

    error_before: float
    error_after: float
    floor: float


@dataclass(frozen=True)
class TableEvidence:
    """Evidence that turns on a table alone give."""

    held_out: SelectionErrors | None  # None: no effect was selected, or no motion is held out
    formulas: Sequence[RankedFormula]
    not_suggested: str | None = None  # why the first formula is not offered as an effect

    def to_json(self) -> dict[str, Any]:
        """Return the entries of the document."""
        return {key: value for key, value in as_json(self).items() if key != "not_suggested" or value}


@dataclass(frozen=True)
class MethodError:
    """An error that the approximations of the method cause."""

    name: str
    meaning: str
    size: float
    unit: str
    share: float  # of the mean square of all errors of the method
    rms: float  # unit of the sensor
    held_out_share: float | None  # the same on held-out motion
    held_out_magnitude_share: float | None


@dataclass(frozen=True)
class Wander:
    """The bias wander of a fit."""

    ratio: float  # to the white noise
    time_s: float | None
    standard_deviation: float
    expected: float | None
    inflated: bool  # it may contain a missing effect
    scatter_over_noise: float | None = None  # of rests by hand

    def to_json(self) -> dict[str, Any]:
        """Return the entry of the document."""
        return {k: v for k, v in vars(self).items() if k != "scatter_over_noise" or v is not None}


@dataclass(frozen=True)
class SensorDiagnosis:
    """A sensor's part of ``diagnoses/<unit>.json``, which ``pipeline/schemas/diagnosis.json`` describes."""

    verdict: Verdict
    configured: Sequence[str]
    residual_over_noise: float | None = None
    selected: Sequence[str] = ()
    ranking: Sequence[Candidate] = ()
    probability: Mapping[str, float] = field(default_factory=dict)
    answer_set: Sequence[Answer] = ()
    upper_limit: Mapping[str, Mapping[str, tuple[float, str]]] = field(default_factory=dict)  # values and units
    to_distinguish: str = ""
    not_observable: Mapping[str, str] = field(default_factory=dict)  # effect to the reason
    unexplained: Sequence[Dependence] = ()
    candidates: Mapping[str, str] = field(default_factory=dict)  # effects that fit best but are not possible, and why
    suggested_effect: Mapping[str, Any] | None = None  # content of an effect file
    method_errors: Sequence[MethodError] = ()
    next_experiment: str = ""
    override: str = ""
    wander: Wander | None = None  # None: no fit
    on_table: TableEvidence | None = None
    details: Mapping[str, Any] = field(default_factory=dict)  # entries of the document: pictures, cross-validation
    given: bool = False  # whether the calibration is given, not fitted
    reason: str = ""
    decided_by: str = ""  # the figure that decided the verdict, in words (``pipeline.core.verdicts.FIGURES``)
    further: Mapping[str, Any] = field(default_factory=dict)  # influence, goodness of fit, effective noise

    @property
    def chosen(self) -> list[Candidate]:
        """The evidence for the selected effects."""
        return [entry for entry in self.ranking if entry.effect in self.selected]

    def to_json(self) -> dict[str, Any]:
        """Return the part of the document."""
        searched = any(entry.form for entry in self.unexplained)
        return {
            "verdict": self.verdict,
            "residual_over_noise": self.residual_over_noise,
            "selected": list(self.selected),
            "ranking": [entry.to_json() for entry in self.ranking],
            "probability": dict(self.probability),
            "answer_set": as_json(self.answer_set),
            "upper_limit": {
                name: {parameter: {"value": value, "unit": unit} for parameter, (value, unit) in limits.items()}
                for name, limits in self.upper_limit.items()
            },
            "to_distinguish": self.to_distinguish,
            "not_observable": [{"effect": name, "reason": reason} for name, reason in self.not_observable.items()],
            "candidates": [{"effect": name, "reason": reason} for name, reason in self.candidates.items()],
            "unexplained": [entry.to_json(searched=searched) for entry in self.unexplained],
            "suggested_effect": self.suggested_effect,
            "next_experiment": self.next_experiment,
            "override": self.override,
            "configured": list(self.configured),
            "wander": self.wander and self.wander.to_json(),
            "method_errors": as_json(self.method_errors),
            **(self.on_table.to_json() if self.on_table else {}),
            **self.details,
            **({"given": True} if self.given else {}),
            "reason": self.reason,
            **({"decided_by": self.decided_by} if self.decided_by else {}),
            **self.further,
        }
