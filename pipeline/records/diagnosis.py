"""The diagnosis of a sensor, and its JSON form."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.verdicts import Verdict


@dataclass(frozen=True)
class Candidate:
    """The evidence for an effect."""

    effect: str
    delta_bic: float
    p_value: float
    parameters: dict[str, dict[str, Any]]  # name to value, unit, standard uncertainty
    explained_share: float  # of the residual above the noise
    held_out_error_before: float | None  # of a selected effect
    held_out_error_after: float | None
    look_alikes: Sequence[Mapping[str, Any]]  # effects with a similar signal, and the share that they reproduce
    plausible: bool  # within the sensor file's limits
    meaning: str | None = None  # of a user's effect

    def to_json(self) -> dict[str, Any]:
        """Return the entry of the ranking."""
        return {key: value for key, value in vars(self).items() if key != "meaning" or value is not None}


@dataclass(frozen=True)
class Answer:
    """A set of effects that may be what is missing; empty: nothing is."""

    effects: Sequence[str]
    probability: float

    def to_json(self) -> dict[str, Any]:
        """Return the entry of the answer set."""
        return {"effects": list(self.effects), "probability": self.probability}


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
    upper_limit: Mapping[str, Any] = field(default_factory=dict)
    to_distinguish: str = ""
    not_observable: Mapping[str, str] = field(default_factory=dict)  # effect to the reason
    unexplained: Sequence[Mapping[str, Any]] = ()
    suggested_effect: Mapping[str, Any] | None = None
    method_errors: Sequence[Mapping[str, Any]] = ()
    next_experiment: str = ""
    override: str = ""
    wander: Mapping[str, Any] | None = None  # None: no fit
    details: Mapping[str, Any] = field(default_factory=dict)  # of the selection: pictures, formulas, held-out errors
    given: bool = False  # whether the calibration is given, not fitted
    reason: str = ""
    further: Mapping[str, Any] = field(default_factory=dict)  # influence, goodness of fit, effective noise

    @property
    def chosen(self) -> list[Candidate]:
        """The evidence for the selected effects."""
        return [entry for entry in self.ranking if entry.effect in self.selected]

    def to_json(self) -> dict[str, Any]:
        """Return the part of the document."""
        of_method = {"method_errors": list(self.method_errors)}
        return {
            "verdict": self.verdict,
            "residual_over_noise": self.residual_over_noise,
            "selected": list(self.selected),
            "ranking": [entry.to_json() for entry in self.ranking],
            "probability": dict(self.probability),
            "answer_set": [answer.to_json() for answer in self.answer_set],
            "upper_limit": dict(self.upper_limit),
            "to_distinguish": self.to_distinguish,
            "not_observable": [{"effect": name, "reason": reason} for name, reason in self.not_observable.items()],
            "unexplained": list(self.unexplained),
            "suggested_effect": self.suggested_effect,
            **({} if self.wander else of_method),
            "next_experiment": self.next_experiment,
            "override": self.override,
            "configured": list(self.configured),
            "wander": self.wander,
            **of_method,
            **self.details,
            **({"given": True} if self.given else {}),
            "reason": self.reason,
            **self.further,
        }
