"""Find the selected effects that are no possible cause of the residual, with the reasons.

    beyond the sensor file      |p| - 1.96 u > 3 limit, unless the settings accept it
    by the thermometer          the temperature changes by less than its resolution
    by the Earth                a rate of more than the Earth's, 15.04 deg/h
    by the noise                white noise of more than 3 times what the sensor's file states: that of another sensor
                                (``generic`` is of no sensor, and states none)

Such effects fit best, and are listed as ``candidates``; the verdict is ``unexplained`` and nothing is offered.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.verdicts import Verdict
from pipeline.estimation.gates import TIMES_POSSIBLE, possible
from pipeline.evaluation.diagnosis.words import plain
from pipeline.physics.effects import effect
from pipeline.physics.effects.base import parameter_limits
from pipeline.physics.kinematics import EARTH_RATE_DPS

if TYPE_CHECKING:
    from pipeline.core.records import Candidate, Recording, SensorDiagnosis
    from pipeline.evaluation.diagnosis.findings import DiagnosisInput

EARTH = "earth_rotation"
OTHER_FILE = "check that the sensor's file is that of this unit, and that its range and units are right"


def without_impossible(found: SensorDiagnosis, case: DiagnosisInput) -> SensorDiagnosis:
    """Return the diagnosis with the selected effects that are not possible as candidates, and without a selection."""
    reasons = {entry.effect: reason for entry in found.chosen if (reason := _contradiction(entry, case))}
    if not reasons:
        return found
    told = "; ".join(
        f"{plain(name)} fits the residual best and is no cause: {reason}" for name, reason in reasons.items()
    )
    doubted = found.verdict == Verdict.REFERENCE_IN_DOUBT
    return replace(
        found,
        verdict=found.verdict if doubted else Verdict.UNEXPLAINED,
        selected=(),
        candidates=reasons,
        reason=f"{found.reason} {told[0].upper()}{told[1:]}.".strip(),
        next_experiment=found.next_experiment if doubted else OTHER_FILE,
        override="",
    )


def _contradiction(entry: Candidate, case: DiagnosisInput) -> str:
    """Return why a selected effect is not possible; empty if it is."""
    this, sheet = effect(entry.effect), case.data_sheet
    values = np.array([p.value for p in entry.parameters.values()])
    u = np.array([p.standard_uncertainty or 0.0 for p in entry.parameters.values()])
    limits = parameter_limits(this, case.sensor, sheet.effects)
    if len(limits) == len(values) and not sheet.accept_implausible and not possible(values, u, limits):
        ratio = float(np.max(np.abs(values) / limits))
        return f"it would be {ratio:.3g} times the data sheet's limit; at most {TIMES_POSSIBLE:g} times is possible"
    if entry.effect == EARTH and np.linalg.norm(values) - 2.0 * float(np.max(u)) > EARTH_RATE_DPS:
        return f"{np.linalg.norm(values):.2g} deg/s is more than the Earth turns ({EARTH_RATE_DPS:.2g} deg/s)"
    if "temperature" in this.needs:
        span, resolution = _temperatures([r for r in case.recordings if r.role != "validation"])
        if span < resolution:
            return f"the temperature changes by {span:.2g} degC, less than its resolution of {resolution:.2g} degC"
    used = [r for r in case.recordings if r.reading(case.sensor) is not None]
    density = sheet.stated("noise_density")
    if density is not None and case.noise is not None and case.noise.step is None and used:
        excess = float(np.min(case.noise.white)) / (density * float(np.sqrt(0.5 / used[0].interval)))
        if excess > TIMES_POSSIBLE:
            return f"the noise is {excess:.2g} times the sensor file's, so that the file is not that of this sensor"
    return ""


def _temperatures(recordings: list[Recording]) -> tuple[float, float]:
    """Return span and resolution of the temperature, degC: of the values, and the smallest step between two."""
    known = [r.temperature for r in recordings if r.temperature is not None]
    values = np.unique(np.concatenate(known)) if known else np.zeros(1)
    values = values[np.isfinite(values)]
    steps = np.diff(values)
    resolution = float(steps[steps > 0.0].min()) if np.any(steps > 0.0) else np.inf
    return float(np.ptp(values)), resolution
