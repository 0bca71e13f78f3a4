"""State the result of a selection, on a table or by hand, as a document.

A noise model with bias wander can take up a missing effect. So the standard deviation of the fitted wander, ``sigma =
q s`` with its ratio q to the white noise s, is compared with that of the rests or the sensor file:

    inflated:   sigma > 3 sigma_expected   and   log L(best) - max {log L(q, tau): q s <= 3 sigma_expected} > 5

Effects that raise the held-out error significantly (``pipeline.estimation.harm``) are candidates and not offered.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pipeline.core.records import (
    Answer,
    Candidate,
    Estimate,
    Noise,
    Recording,
    SensorCalibration,
    SensorDiagnosis,
    Values,
    Wander,
)
from pipeline.core.settings import DataSheet, Settings
from pipeline.core.verdicts import Verdict
from pipeline.estimation.gates import MIN_DELTA_BIC, within
from pipeline.estimation.gauss_markov import Setting
from pipeline.estimation.known_effects import known_effects
from pipeline.estimation.posterior import CERTAIN, Answers
from pipeline.estimation.ranking import Score
from pipeline.estimation.selection import EVIDENCE, INFLATED, LOOK_ALIKE_SHARE
from pipeline.evaluation.diagnosis.words import experiment_of, listed, of_unknown, plain, to_distinguish
from pipeline.physics.effects import catalogue, effect
from pipeline.physics.effects.equations import OTHER_PREFIX

IMITATED = 0.5  # share of an unexplained sensor's answers in which effects of the catalogue are imitations: undecided
LEAST_RATIO = 0.03  # of the white noise: the smallest wander of the selection's settings


@dataclass(frozen=True)
class DiagnosisInput:
    """The input of a diagnosis; see ``diagnose``."""

    calibration: SensorCalibration
    recordings: Sequence[Recording]
    noise: Noise
    settings: Settings
    accelerometer: SensorCalibration | None
    configured: list[str]  # effects in the model: those that the settings list, and those of the bench

    @property
    def sensor(self) -> str:
        """The sensor."""
        return self.calibration.sensor

    @property
    def modelled(self) -> list[str]:
        """Effects in the model, and effects with known parameters."""
        return [*self.configured, *(e.name for e in known_effects(self.sensor, self.settings.method))]

    @property
    def data_sheet(self) -> DataSheet:
        """The figures of the sensor."""
        return self.settings.sensor.of(self.sensor)


@dataclass(frozen=True, kw_only=True)
class Findings:
    """The result of a selection, and the scores of all candidates."""

    sensor: str
    diagnosis: SensorDiagnosis  # what the selection itself states; ``diagnosis_of`` adds what follows from the others
    steps: Mapping[str, Score]  # of each selected effect when it was accepted
    alone: Mapping[str, Score]  # of each candidate given base and configured effects
    fitted: Mapping[str, tuple[Values, Values]]  # values and uncertainties of configured and selected effects
    limits: Mapping[str, Values]  # of plausibility
    answers: Answers
    shares: Callable[[str], Mapping[str, float]]  # share of an effect's fitted signal that each other one reproduces
    squares: Sequence[float]  # sum or mean of squared residuals of the base, and with each further selected effect
    drop_alone: Callable[[str], float]  # reduction of the first of these by an effect that was not selected
    excess: float  # of the first of these over the noise
    held_out: Sequence[float | None]  # held-out rms error, of the same fits as ``squares``
    harmful: Mapping[str, str]  # selected effects that raise it significantly, with the reason
    left_over_noise: float | None  # rms residual with the selected effects over the noise
    advice: Callable[[Verdict], str]  # what to record next if no effect was selected, by the verdict
    free: Callable[[], SensorCalibration] | None = None  # by a free fit of the same recordings
    full: Callable[[], SensorCalibration] | None = None  # the same with the selected effects, if there are any
    turns: Mapping[str, str] = field(default_factory=dict)  # recordings for which effects of turns have parameters
    search: Callable[[], Findings | None] | None = None  # for a formula outside the catalogue; returns None without one
    deeper: Callable[[], dict[str, Any]] | None = None  # further entries of the document if something is missing


def diagnosis_of(findings: Findings, case: DiagnosisInput) -> SensorDiagnosis:
    """Return the diagnosis of a sensor, with the verdict by the selection alone."""
    found, answers = findings.diagnosis, findings.answers
    listed = [name for name in case.configured if name in case.settings.effects.of(case.sensor)]
    others = sorted(findings.alone.values(), key=lambda score: -score.delta_bic)
    unselected = [s.name for s in others if s.name not in found.selected and s.name not in found.not_observable]
    ranking = [_entry(findings, name) for name in (*found.selected, *unselected)]
    shows_nothing = found.verdict == Verdict.NOTHING_MISSING and not ranking and found.not_observable
    verdict = Verdict.NOT_ENOUGH_DATA if shows_nothing else found.verdict
    override = f"effects.{case.sensor}=[{','.join([*listed, *found.selected])}]"
    sets = [Answer(names, min(p, CERTAIN)) for names, p in answers.answer_set()]
    return replace(
        found,
        verdict=verdict,
        ranking=ranking,
        probability={name: min(answers.probability(name), CERTAIN) for name in answers.upper_limit},
        answer_set=sets,
        upper_limit=_upper_limits(findings),
        to_distinguish=to_distinguish(sets, findings.sensor, on_table=found.on_table is not None),
        next_experiment=next_experiment(verdict, ranking, findings),
        override=override if found.selected else "",
    )


def with_unknown(found: SensorDiagnosis) -> SensorDiagnosis:
    """Return the diagnosis of an unexplained sensor, in which effects of the catalogue may be only imitations.

    Answers compare sets of the catalogue, which the verdict says are no explanation. Of effects that they gave 0.9 or
    more, 77 of 94 were there in sensors with effects of the catalogue alone, and none of 687 in those with others
    (blind study, fdedcedf): ``IMITATED`` of each answer goes to its quantities outside the catalogue alone, or to
    the covariate of the residual, if it has none.
    """
    covariate = found.unexplained[0].covariate if found.unexplained else "time"
    weight: dict[tuple[str, ...], float] = {}
    for answer in found.answer_set:
        outside = tuple(n for n in answer.effects if n.startswith(OTHER_PREFIX)) or (f"{OTHER_PREFIX}{covariate}",)
        for names, share in ((tuple(answer.effects), 1.0 - IMITATED), (outside, IMITATED)):
            weight[names] = weight.get(names, 0.0) + share * answer.probability
    answers = [Answer(names, p) for names, p in sorted(weight.items(), key=lambda each: -each[1])]
    within = {n: p if n.startswith(OTHER_PREFIX) else (1.0 - IMITATED) * p for n, p in found.probability.items()}
    for name in {n for names in weight for n in names} - within.keys():  # the covariate of the residual
        within[name] = sum(p for names, p in weight.items() if name in names)
    return replace(found, answer_set=answers, probability=within)


def next_experiment(verdict: Verdict, ranking: Sequence[Candidate], findings: Findings) -> str:
    """Return the most informative next experiment as one sentence."""
    found, on_table = findings.diagnosis, findings.diagnosis.on_table is not None
    if verdict == Verdict.UNEXPLAINED:
        return of_unknown(found.unexplained, on_table=on_table) if found.unexplained else findings.advice(verdict)
    if not found.selected:
        if verdict == Verdict.NOTHING_MISSING and findings.answers.sets[0][0]:
            pair = findings.answers.sets[0], ((), dict(findings.answers.sets).get((), 0.0))
            sets = [Answer(names, min(p, CERTAIN)) for names, p in pair]
            return f"to distinguish {to_distinguish(sets, findings.sensor, on_table=on_table)}"
        return findings.advice(verdict) or "none is needed: nothing that these recordings can show is missing"
    entries = {entry.effect: entry for entry in ranking}

    def alike(name: str) -> list[str]:
        return [n for n in entries[name].look_alikes if name not in getattr(catalogue().get(n), "contains", ())]

    name = next((n for n in found.selected if alike(n)), found.selected[0])
    experiment = experiment_of(name, on_table=on_table)
    others = listed([plain(other) for other in alike(name)[:2]], "or")
    return f"to {f'distinguish {plain(name)} from {others}' if others else f'confirm {plain(name)}'}: {experiment}"


def _upper_limits(findings: Findings) -> dict[str, dict[str, tuple[float, str]]]:
    """Return the upper limits of the parameters of effects that were not selected, with their units."""
    limits = {}
    for name, values in findings.answers.upper_limit.items():
        if name in findings.diagnosis.selected or name.startswith(OTHER_PREFIX):
            continue
        this = effect(name).of_recordings(findings.turns)
        linear = [p for p in this.parameters(findings.sensor) if p.name not in this.nonlinear or this.moves]
        limits[name] = {p.name: (float(v), p.unit) for p, v in zip(linear, values, strict=True)}
    return limits


def _entry(findings: Findings, name: str) -> Candidate:
    score, selected = findings.steps.get(name) or findings.alone[name], findings.diagnosis.selected
    if name in selected:
        step = selected.index(name)
        before, after = findings.held_out[step : step + 2]
        drop = findings.squares[step] - findings.squares[step + 1]
    else:
        before, after, drop = None, None, findings.drop_alone(name)
    excess = max(findings.excess, drop)
    estimates, plausible = _estimates(findings, score)
    shares = findings.shares(name) if score.delta_bic > MIN_DELTA_BIC else {}
    alike = sorted(((share, other) for other, share in shares.items() if share > LOOK_ALIKE_SHARE), reverse=True)
    return Candidate(
        effect=name,
        delta_bic=score.delta_bic,
        p_value=score.p_value,
        parameters=estimates,
        explained_share=min(max(drop / excess, 0.0), 1.0) if excess > 0.0 else 0.0,
        held_out_error_before=before,
        held_out_error_after=after,
        look_alikes={other: share for share, other in alike},
        plausible=plausible,
        meaning=effect(name).meaning if effect(name).definition else None,
    )


def _estimates(findings: Findings, score: Score) -> tuple[dict[str, Estimate], bool]:
    """Return the parameters of an effect and whether they are plausible: if selected, by the fit of all selected."""
    values, uncertainty, plausible = score.values, score.uncertainty, score.plausible
    if score.name in findings.diagnosis.selected:
        values, uncertainty = findings.fitted[score.name]
        if score.name in findings.limits:
            plausible = within(values, uncertainty, findings.limits[score.name])
    described = effect(score.name).of_recordings(findings.turns).parameters(findings.sensor)
    found = zip(described, values, uncertainty, strict=True)
    return {p.name: Estimate(float(v), p.unit, float(u) if u > 0 else None) for p, v, u in found}, plausible


def implausible(findings: Findings) -> list[str]:
    """Return the selected effects beyond their limits."""
    return [name for name in findings.diagnosis.selected if not _estimates(findings, findings.steps[name])[1]]


def wander_of(
    noises: Sequence[tuple[Setting, float]], white: float, noise: Noise, scatter: float | None = None
) -> Wander:
    """Return the most likely wander, given base, configured and selected effects, and whether it is inflated.

    ``noises``: settings and log L. ``white``: unit of the sensor. ``noise``: as expected. ``scatter``: that of rests by
    hand, over the noise.
    """
    wander, best = max(noises, key=lambda each: each[1])
    expected = float(np.sqrt(np.mean(noise.wander**2)))
    limit = INFLATED * max(expected / white, LEAST_RATIO)
    believed = [score for setting, score in noises if setting.ratio <= limit]
    return Wander(
        ratio=float(wander.ratio),
        time_s=float(wander.time) if wander.ratio else None,
        standard_deviation=float(wander.ratio * white),
        expected=expected,
        inflated=bool(wander.ratio > limit and (not believed or best - max(believed) > EVIDENCE)),
        scatter_over_noise=scatter,
    )
