"""The diagnosis of a sensor, and its JSON form."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.core.records.budget import Estimate
    from pipeline.core.verdicts import Verdict


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
        estimates = {name: vars(estimate) for name, estimate in self.parameters.items()}
        document = {**vars(self), "parameters": estimates, "look_alikes": alike}
        return {key: value for key, value in document.items() if key != "meaning" or value is not None}


@dataclass(frozen=True)
class Answer:
    """A set of effects that may be what is missing; empty: nothing is."""

    effects: Sequence[str]
    probability: float

    def to_json(self) -> dict[str, Any]:
        """Return the entry of the answer set."""
        return {"effects": list(self.effects), "probability": self.probability}


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
        return {
            "covariate": self.covariate,
            "p_value": self.p_value,
            **(vars(self.form) if self.form else {}),
            **({} if self.delta_bic is None else {"delta_bic": self.delta_bic}),
            **({"explained_by": self.explained_by} if searched else {}),
        }


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
        return {
            "held_out": self.held_out and vars(self.held_out),
            "formulas": [vars(each) for each in self.formulas],
            **({"not_suggested": self.not_suggested} if self.not_suggested else {}),
        }


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
            "answer_set": [answer.to_json() for answer in self.answer_set],
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
            "method_errors": [vars(error) for error in self.method_errors],
            **(self.on_table.to_json() if self.on_table else {}),
            **self.details,
            **({"given": True} if self.given else {}),
            "reason": self.reason,
            **self.further,
        }
