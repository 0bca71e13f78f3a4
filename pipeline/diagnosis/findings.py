"""What a selection found, in the same terms for turns on a table and for rests and moves by hand, as a document.

A noise model with bias wander can take up a missing effect. So the fitted wander, ``sigma = q s`` with its ratio q to
the white noise s, is compared with that of the rests or the sensor file:

    inflated:   sigma > 3 sigma_expected   and   log L(best) - max {log L(q, tau): q s <= 3 sigma_expected} > 5
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.diagnosis.words import next_experiment, to_distinguish
from pipeline.estimation.design import Term, placed
from pipeline.estimation.free_curves import OTHER
from pipeline.estimation.posterior import CERTAIN, Answers
from pipeline.estimation.selection import ALIKE, EVIDENCE, GATE_BIC, INFLATED
from pipeline.model.effects import effect

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from pipeline.estimation.ranking import Score
    from pipeline.records import Noise, Recording, SensorCalibration, Values


LEAST_RATIO = 0.03  # of the white noise: the smallest wander of the selection's settings


@dataclass(frozen=True)
class Case:
    """What is diagnosed: the calibration of a sensor, and what it was made of; see ``diagnose``."""

    calibration: SensorCalibration
    recordings: Sequence[Recording]
    noise: Noise | None
    settings: Mapping[str, Any]
    accelerometer: SensorCalibration | None
    configured: list[str]  # effects that the model holds: those that are listed, and those of the bench

    @property
    def sensor(self) -> str:
        """The sensor."""
        return self.calibration.sensor

    @property
    def sensor_config(self) -> Mapping[str, Any]:
        """Its section of the settings."""
        found: Mapping[str, Any] = self.settings["sensor"][self.sensor]
        return found


@dataclass(frozen=True, kw_only=True)
class Findings:
    """What a selection found, and how every candidate did."""

    sensor: str
    selected: Sequence[str]
    verdict: str  # by the selection alone
    steps: Mapping[str, Score]  # of each selected effect when it was accepted
    alone: Mapping[str, Score]  # of each candidate given base and configured effects
    terms: Sequence[Term]  # configured and selected effects at their values in the fit of all
    covariance: Values  # of that fit; the effects' parameters come last
    limits: Mapping[str, Values]  # of plausibility
    answers: Answers  # how sure each effect is
    shares: Callable[[str], Mapping[str, float]]  # of an effect's fitted signal that each other one reproduces
    left: Sequence[float]  # residual sum or mean of squares of the base, and with each further selected effect
    drop_alone: Callable[[str], float]  # by how much an effect that was not selected would lower the first
    excess: float  # of the first over the noise
    held_out: Sequence[float | None]  # held-out rms error, as ``left``
    hidden: Mapping[str, str]  # effect that is not observable to the reason
    unknown: list[dict[str, Any]]  # entries ``unexplained``
    over_noise: float | None  # residual of the base over the noise
    left_over_noise: float | None  # the same with what was selected
    noises: Sequence[tuple[float, float, float]]  # ratio of wander to white noise, its time in s, and log L
    white: float  # noise, unit of the sensor
    expected_wander: float | None
    advice: Callable[[str], str]  # verdict to what to record next where nothing was selected
    free: Callable[[], SensorCalibration] | None = None  # by a free fit of the same recordings
    full: Callable[[], SensorCalibration] | None = None  # with what was selected, where that is something
    other: SensorCalibration | None = None  # of the other sensor
    on_table: bool = True
    departures: Sequence[str] = ()  # of faces and turns by hand from what is stated
    scatter: Mapping[str, float] = field(default_factory=dict)  # further entries of ``wander``
    more: Mapping[str, Any] = field(default_factory=dict)  # further entries of the document
    turns: Mapping[str, str] = field(default_factory=dict)  # recordings that some effects have parameters for: setups
    search: Callable[[], Findings | None] | None = None  # looks for a formula outside the catalogue; None: found none
    deeper: Callable[[], dict[str, Any]] | None = None  # further entries of the document where something is missing

    def share(self, drop: float) -> float:
        """Return the share of the residual's excess over the noise that a drop of its squares is."""
        excess = max(self.excess, drop)
        return float(np.clip(drop / excess, 0.0, 1.0)) if excess > 0.0 else 0.0


def document_of(found: Findings, case: Case) -> dict[str, Any]:
    """Return a sensor's part of ``diagnoses/<unit>.json``, with the verdict of the selection alone."""
    wanted = case.settings["effects"][case.sensor]
    listed = [name for name in case.configured if name in wanted]  # effects of the bench need no override
    others = sorted(found.alone.values(), key=lambda s: -s.delta_bic)
    unselected = [s.name for s in others if s.name not in found.selected and s.name not in found.hidden]
    ranking = [_entry(found, name) for name in (*found.selected, *unselected)]
    verdict = found.verdict
    if verdict == "nothing_missing" and not ranking and found.hidden:
        verdict = "not_enough_data"
    return {
        "verdict": verdict,
        "residual_over_noise": found.over_noise,
        "selected": list(found.selected),
        "ranking": ranking,
        **_how_sure(found),
        "not_observable": [{"effect": name, "reason": reason} for name, reason in found.hidden.items()],
        "unexplained": found.unknown,
        "suggested_effect": None,
        "next_experiment": next_experiment(verdict, ranking, found),
        "override": f"effects.{found.sensor}=[{','.join([*listed, *found.selected])}]" if found.selected else "",
        "configured": case.configured,
        "wander": _wander(found),
        "method_errors": [],
        **found.more,
    }


def _how_sure(found: Findings) -> dict[str, Any]:
    """Return probabilities, the answer set, what would make it smaller, and upper limits of what was not selected."""
    answers = found.answers
    sets = [
        {"effects": list(names), "probability": min(probability, CERTAIN)}
        for names, probability in answers.answer_set()
    ]
    limits = {}
    for name, values in answers.upper_limit.items():
        if name in found.selected or name.startswith(OTHER):
            continue
        this = effect(name).of_recordings(found.turns)
        linear = [p for p in this.parameters(found.sensor) if p.name not in this.nonlinear or this.moves]
        limits[name] = {p.name: {"value": float(v), "unit": p.unit} for p, v in zip(linear, values, strict=True)}
    return {
        "probability": {name: min(answers.probability(name), CERTAIN) for name in answers.upper_limit},
        "answer_set": sets,
        "upper_limit": limits,
        "to_distinguish": to_distinguish(sets, found.sensor, on_table=found.on_table),
    }


def _entry(found: Findings, name: str) -> dict[str, Any]:
    """Return one line of the ranking."""
    score = found.steps.get(name) or found.alone[name]
    before = after = None
    drop = found.drop_alone(name)
    if name in found.selected:
        step = found.selected.index(name)
        before, after = found.held_out[step : step + 2]
        drop = found.left[step] - found.left[step + 1]
    estimates, plausible = _estimates(found, score)
    shares = found.shares(name) if score.delta_bic > GATE_BIC else {}
    alike = sorted(((share, other) for other, share in shares.items() if share > ALIKE), reverse=True)
    return {
        "effect": name,
        "delta_bic": score.delta_bic,
        "p_value": score.p_value,
        "parameters": estimates,
        "explained_share": found.share(drop),
        "held_out_error_before": before,
        "held_out_error_after": after,
        "look_alikes": [{"effect": other, "share": share} for share, other in alike],
        "plausible": plausible,
        **({"meaning": effect(name).meaning} if effect(name).definition else {}),
    }


def _estimates(found: Findings, score: Score) -> tuple[dict[str, Any], bool]:
    """Return the parameters, and whether they are plausible: of the fit of all selected, or of the effect alone."""
    values, uncertainty, plausible = score.values, score.uncertainty, score.plausible
    base = len(found.covariance) - sum(len(term.values) for term in found.terms)
    if score.name in found.selected:
        term, own = placed(found.terms, base)[score.name]
        values, uncertainty = term.values, np.sqrt(np.clip(np.diag(found.covariance)[own], 0.0, None))
        if score.name in found.limits:
            plausible = bool(np.all(np.abs(values) - 2.0 * uncertainty <= found.limits[score.name]))
    described = effect(score.name).of_recordings(found.turns).parameters(found.sensor)
    return {
        p.name: {"value": float(v), "unit": p.unit, "standard_uncertainty": float(u) if u > 0 else None}
        for p, v, u in zip(described, values, uncertainty, strict=True)
    }, plausible


def _wander(found: Findings) -> dict[str, Any]:
    """Return the wander under which base, configured and selected effects explain the readings best."""
    ratio, time, best = max(found.noises, key=lambda noise: noise[2])
    inflated = False
    if found.expected_wander is not None:
        most = INFLATED * max(found.expected_wander / found.white, LEAST_RATIO)
        believed = [score for other, _, score in found.noises if other <= most]
        inflated = ratio > most and (not believed or best - max(believed) > EVIDENCE)
    return {
        "ratio": float(ratio),
        "time_s": float(time) if ratio else None,
        "standard_deviation": float(ratio * found.white),
        "expected": found.expected_wander,
        "inflated": bool(inflated),
        **found.scatter,
    }
