"""Which physical effect is missing: a sensor's part of ``diagnoses/<unit>.json``.

The selection (``pipeline.estimation.selection``, or ``...multi_position.selection`` without a table) finds the effects;
``turntable`` and ``multi_position`` state its ``Findings`` in the same terms, and here these become a document.

A noise model with bias wander can take up a missing effect. So the fitted wander, ``sigma = q s`` with its ratio q to
the white noise s, is compared with that of the rests or the data sheet:

    inflated:   sigma > 3 sigma_expected   and   log L(best) - max {log L(q, tau): q s <= 3 sigma_expected} > 5
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.diagnosis import multi_position, turntable
from pipeline.diagnosis.verdict import evidence_of, judged
from pipeline.diagnosis.words import next_experiment
from pipeline.errors import NotObservableError
from pipeline.estimation.candidates import configured_effects
from pipeline.estimation.multi_position.rests import is_multi_position
from pipeline.estimation.selection import ALIKE, EVIDENCE, GATE_BIC, INFLATED
from pipeline.model.effects import catalogue, effect

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.diagnosis.findings import Findings
    from pipeline.estimation.ranking import Score
    from pipeline.records import Noise, Recording, SensorCalibration

LEAST_RATIO = 0.03  # of the white noise: the smallest wander of the selection's settings


def diagnose(
    calibration: SensorCalibration,
    recordings: Sequence[Recording],
    noise: Noise | None,
    settings: Mapping[str, Any],
    accelerometer: SensorCalibration | None = None,
    *,
    validation: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return a sensor's part of ``diagnoses/<unit>.json``.

    Parameters
    ----------
    calibration : SensorCalibration
        Its effects are starts for those that are configured.
    recordings : sequence of Recording
        All of the unit; those of role ``validation`` judge, and take no part in the selection.
    settings : mapping
        Sections ``sensor``, ``table`` and ``effects``; ``procedure`` for recordings by hand.
    accelerometer : SensorCalibration, optional
        For the gyroscope by hand, which needs the direction of gravity; without it, it is calibrated again.
    validation : mapping, optional
        The sensor's part of ``validations/<unit>.json``; without it, a free fit stands for the calibration.

    Returns
    -------
    dict
        ``verdict, reason`` (``pipeline.diagnosis.verdict``), ``residual_over_noise, selected, ranking, not_observable,
        unexplained, next_experiment, override``; in addition ``configured, suggested_effect``
        (``pipeline.diagnosis.functional_form_search``), ``wander`` (``ratio, time_s, standard_deviation, expected,
        inflated``), ``pictures`` (``...residual_plots``), ``method_errors`` (``...method_errors``), on a table
        ``held_out`` (``error_before, error_after, floor``), without one ``cross_validation``.
    """
    sensor = calibration.sensor
    by_hand = is_multi_position(sensor, recordings)
    procedure = multi_position if by_hand else turntable
    configured = configured_effects(sensor, settings, [] if by_hand else recordings)
    found = None
    try:
        found = procedure.findings(calibration, recordings, noise, settings, configured, accelerometer=accelerometer)
        document = _document(found, configured)
    except NotObservableError as reason:
        document = _not_enough_data(sensor, configured, reason.message, procedure.NEEDED)
    evidence = evidence_of(document, sensor, recordings, noise, settings, validation=validation, found=found)
    return judged(document, evidence)


def _document(found: Findings, configured: list[str]) -> dict[str, Any]:
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
        "not_observable": [{"effect": name, "reason": reason} for name, reason in found.hidden.items()],
        "unexplained": found.unknown,
        "suggested_effect": None,
        "next_experiment": next_experiment(verdict, ranking, found),
        "override": _override(found.sensor, [*configured, *found.selected]) if found.selected else "",
        "configured": configured,
        "wander": _wander(found),
        "method_errors": [],
        **found.more,
    }


def _override(sensor: str, names: Sequence[str]) -> str:
    return f"effects.{sensor}=[{','.join(names)}]"


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
    at = len(found.covariance) - sum(len(term.values) for term in found.terms)
    for term in found.terms:
        own = slice(at, at + len(term.values))
        at = own.stop
        if term.effect.name == score.name and score.name in found.selected:
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


def _not_enough_data(sensor: str, configured: list[str], reason: str, needed: str) -> dict[str, Any]:
    """Return the diagnosis of recordings that show no effect, and what to record."""
    names = [n for n, this in catalogue().items() if sensor in this.sensors and n not in configured]
    return {
        "verdict": "not_enough_data",
        "residual_over_noise": None,
        "selected": [],
        "ranking": [],
        "not_observable": [{"effect": name, "reason": reason} for name in names],
        "unexplained": [],
        "suggested_effect": None,
        "method_errors": [],
        "next_experiment": needed,
        "override": "",
        "configured": configured,
        "wander": None,
    }
