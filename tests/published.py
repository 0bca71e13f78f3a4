"""Parts of the documents that a run publishes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.core.records import Candidate, Noise, SensorValidation, StepErrors, Validation
from pipeline.evaluation.diagnosis.diagnose import diagnose as diagnosis_of
from pipeline.evaluation.held_out import validation

if TYPE_CHECKING:
    from collections.abc import Mapping

NOISE = Noise(np.zeros(3), np.zeros(3), 100.0, "static")
STEPS = StepErrors("raw"), StepErrors("calibrated")
TESTED = SensorValidation(unit="", held_out=True, reason=None, samples=9, noise=NOISE, steps=STEPS)


def validation_document(unit: str, parts: Mapping[str, SensorValidation | None]) -> dict[str, Any]:
    """Return ``validations/<unit>.json``, without attitude and moves."""
    return Validation(unit, parts, {"reason": ""}, {"reason": ""}).to_json()


def validate(*arguments: Any, **keywords: Any) -> dict[str, Any]:
    """Return a sensor's part of ``validations/<unit>.json``."""
    return validation.validate(*arguments, **keywords).to_json()


def candidate(name: str, **values: Any) -> Candidate:
    """Return the evidence for an effect, with no figure but those given."""
    none: dict[str, Any] = dict.fromkeys(("held_out_error_before", "held_out_error_after"))
    rest = {"delta_bic": 0.0, "p_value": 1.0, "parameters": {}, "explained_share": 0.0, "look_alikes": {}}
    return Candidate(name, **{**none, **rest, "plausible": True, **values})


def diagnose(*arguments: Any, **keywords: Any) -> dict[str, Any]:
    """Return a sensor's part of ``diagnoses/<unit>.json``."""
    return diagnosis_of(*arguments, **keywords).to_json()
