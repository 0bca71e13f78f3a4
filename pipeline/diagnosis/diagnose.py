"""Which physical effect is missing: a sensor's part of ``diagnoses/<unit>.json``.

The selection itself is ``pipeline.estimation.selection``; here it becomes a document: the ranking of every candidate
with its look-alikes, what cannot be seen in these recordings, what remains unexplained, and what to do next.

Held-out errors of the selection's own fits are the rms length of ``matrix (reading - model)`` where the attitude is
logged, else the rms error of the magnitude, against the noise floor of ``pipeline.validation.heldout``.

A noise model with bias wander can take up a missing effect. So the fitted wander, ``sigma = q s`` with its ratio q to
the white noise s, is compared with that of the rests or the data sheet:

    inflated:   sigma > 3 sigma_expected   and   log L(best) - max {log L(q, tau): q s <= 3 sigma_expected} > 5
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.diagnosis.functional_form_search import select_with_form, suggested_effect, unexplained
from pipeline.diagnosis.method_errors import method_errors
from pipeline.diagnosis.observability import facts_of, not_observable
from pipeline.diagnosis.residual_plots import plots
from pipeline.diagnosis.unobservable_effects import not_enough_data
from pipeline.diagnosis.verdict import evidence_of, judged, verdict_of_selection
from pipeline.diagnosis.words import next_experiment
from pipeline.errors import NotObservableError
from pipeline.estimation.design import BASE, Start
from pipeline.estimation.effects import AUTO
from pipeline.estimation.generalized_least_squares import calibration_of, fit_terms
from pipeline.estimation.multi_position.rests import is_multi_position
from pipeline.estimation.observations import observe
from pipeline.estimation.selection import ALIKE, EVIDENCE, FAR_ABOVE, GATE_BIC, INFLATED, select
from pipeline.model.effects import catalogue, effect
from pipeline.records import Noise
from pipeline.validation.error_breakdown import with_known_effects
from pipeline.validation.heldout import noise_floors
from pipeline.validation.samples import samples_of_motion

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.generalized_least_squares import Fit
    from pipeline.estimation.ranking import Score
    from pipeline.estimation.selection import Selection
    from pipeline.records import Recording, SensorCalibration
    from pipeline.validation.samples import Samples

    Values = NDArray[np.float64]

CLOSE = 1.1  # mean square of a residual over that of noise, under which there is no excess to share
TURNS = "record turns about all three axes on a table whose angle and rate are logged"
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
    noise : Noise or None
    settings : mapping
        Sections ``sensor``, ``table`` and ``effects``; ``procedure`` for recordings by hand.
    accelerometer : SensorCalibration, optional
        For the gyroscope by hand, which needs the direction of gravity; without it, it is calibrated again.
    validation : mapping, optional
        The sensor's part of ``validations/<unit>.json``; without it, a free fit stands for the
        calibration.

    Returns
    -------
    dict
        ``verdict, reason`` (``pipeline.diagnosis.verdict``), ``residual_over_noise, selected, ranking, not_observable,
        unexplained, next_experiment, override``; beside these ``configured, suggested_effect``
        (``pipeline.diagnosis.functional_form_search``), ``wander`` (``ratio, time_s, standard_deviation, expected,
        inflated``), ``held_out`` (``error_before, error_after, floor``), ``pictures`` (``...residual_plots``) and
        ``method_errors`` (``...method_errors``).
    """
    sensor = calibration.sensor
    if is_multi_position(sensor, recordings):
        from pipeline.diagnosis.multi_position import diagnose_multi_position  # noqa: PLC0415  (recordings by hand alone)

        return diagnose_multi_position(calibration, recordings, noise, settings, accelerometer, validation=validation)
    wanted = settings["effects"][sensor]
    configured = [] if wanted == AUTO else list(wanted)
    observations = observe(sensor, recordings, settings["table"])
    try:
        selection = select(observations, configured, noise, settings["sensor"][sensor], calibration)
    except NotObservableError as reason:
        nothing = not_enough_data(sensor, configured, reason.message, TURNS) | {"held_out": None}
        return judged(nothing, evidence_of(nothing, sensor, recordings, noise, settings, validation))
    unknown = unexplained(selection)
    reported = select_with_form(selection, unknown, configured, noise, settings["sensor"][sensor])
    document = _document(reported, unknown, configured, recordings, noise, table=settings["table"])
    document |= {
        "suggested_effect": None if reported is selection else suggested_effect(unknown, sensor, catalogue()),
        "residual_over_noise": _over_noise(selection.base, recordings, noise),
        "pictures": plots(selection, unknown, noise, reported),
        "method_errors": method_errors(calibration, reported, recordings, settings),
    }

    def fitted(fit: Fit) -> SensorCalibration:
        return calibration_of(sensor, fit, selection.observations, None, settings)

    found = evidence_of(
        document,
        sensor,
        recordings,
        noise,
        settings,
        validation,
        free=lambda: fitted(selection.base),
        full=(lambda: fitted(selection.fit)) if selection.names else None,
    )
    left = _over_noise(selection.fit, recordings, noise)
    return judged(document, replace(found, left_over_noise=left))


def _document(
    selection: Selection,
    unknown: list[dict[str, Any]],
    configured: list[str],
    recordings: Sequence[Recording],
    noise: Noise | None,
    *,
    table: Mapping[str, Any],
) -> dict[str, Any]:
    sensor, selected = selection.observations.sensor, selection.names
    hidden = not_observable(selection, configured)
    fits = _fits(selection)
    held_out = _held_out(selection, fits, recordings, noise, table)
    errors = [None] * len(fits) if held_out is None else held_out[0]
    explained = selection.first.explained([])
    steps = list(zip(fits, errors, strict=True))
    ranking = [_entry(selection, name, steps, explained, noise) for name in _order(selection, hidden)]
    floor = None if noise is None else float(np.mean(noise.white**2 + noise.wander**2))
    held = None
    if held_out and noise is not None:
        held = {"error_before": held_out[0][0], "error_after": held_out[0][-1], "floor": held_out[1]}
    verdict = verdict_of_selection(
        selected,
        unknown,
        _share(selection.base.residual_rms**2 - selection.fit.residual_rms**2, selection, noise),
        2.0 * (selection.fit.log_likelihood - selection.base.log_likelihood),
        above_noise=floor is not None and selection.fit.residual_rms**2 > FAR_ABOVE**2 * floor,
        held_out=held,
    )
    if not ranking and verdict == "nothing_missing" and len(hidden) > 0:
        verdict = "not_enough_data"
    adds = ",".join([*configured, *selected])
    return {
        "verdict": verdict,
        "selected": selected,
        "ranking": ranking,
        "not_observable": [{"effect": name, "reason": reason} for name, reason in hidden.items()],
        "unexplained": unknown,
        "next_experiment": next_experiment(
            verdict, ranking, selected, hidden, unknown, one_way=facts_of(selection.observations).one_way
        ),
        "override": f"effects.{sensor}=[{adds}]" if selected else "",
        "configured": configured,
        "wander": _fitted_wander(selection, noise),
        "held_out": held,
    }


def _held_out(
    selection: Selection,
    fits: Sequence[Fit],
    recordings: Sequence[Recording],
    noise: Noise | None,
    table: Mapping[str, Any],
) -> tuple[list[float], float] | None:
    """Return the held-out errors of some fits, and the noise floor of the last; None where nothing is held out."""
    sensor, known = selection.observations.sensor, noise or Noise(np.zeros(3), np.zeros(3), 1.0, "none")
    held = [r for r in recordings if r.role == "validation"] if selection.names else []
    samples = [s for r in held if (s := samples_of_motion(sensor, r, known, table, smoothed=True)) is not None]
    samples = [s for s in samples if s.known.any()]
    if not samples:
        return None
    calibrations = [calibration_of(sensor, fit, selection.observations, None) for fit in fits]
    floor, vector_floor = noise_floors(calibrations[-1], samples)
    return [_held_out_error(c, samples) for c in calibrations], floor if vector_floor is None else vector_floor


def _held_out_error(calibration: SensorCalibration, samples: Sequence[Samples]) -> float:
    """Return the rms vector error where the attitude is known, else the rms error of the magnitude."""
    squares = []
    for each in samples:
        vector, magnitude, true = with_known_effects(calibration, each, None)
        error = np.linalg.norm(vector, axis=1) - magnitude if true is None else np.linalg.norm(vector - true, axis=1)
        squares.append(error[each.known] ** 2)
    together = np.concatenate(squares)
    return float(np.sqrt(np.mean(together[np.isfinite(together)])))


def _fitted_wander(selection: Selection, noise: Noise | None) -> dict[str, Any]:
    """Return the wander under which base, configured and selected effects explain the readings best."""
    settings = selection.ranking.settings
    found = selection.ranking.log_likelihoods(selection.chosen())
    best = int(np.argmax(found[1:])) + 1
    white = float(np.sqrt(np.mean(selection.start.scale**2)))
    expected = None if noise is None else float(np.sqrt(np.mean(noise.wander**2)))
    ratio, inflated = settings[best].ratio, False
    if expected is not None:
        most = INFLATED * max(expected / white, LEAST_RATIO)
        believed = [found[k] for k in range(1, len(settings)) if settings[k].ratio <= most]
        inflated = ratio > most and (not believed or bool(found[best] - max(believed) > EVIDENCE))
    return {
        "ratio": ratio,
        "time_s": settings[best].time if ratio else None,
        "standard_deviation": ratio * white,
        "expected": expected,
        "inflated": bool(inflated),
    }


def _order(selection: Selection, hidden: Mapping[str, str]) -> list[str]:
    """Return the observable candidates: the selected ones in their order, then the others by what they bring alone."""
    others = sorted(selection.alone.values(), key=lambda s: -s.delta_bic)
    return [*selection.names, *(s.name for s in others if s.name not in selection.names and s.name not in hidden)]


def _fits(selection: Selection) -> list[Fit]:
    """Return the fits of the base and with each further selected effect."""
    fits = [selection.base]
    fitted = {term.effect.name: term for term in selection.fit.terms}
    for count in range(1, len(selection.names)):
        terms = [*selection.base.terms, *(fitted[name] for name in selection.names[:count])]
        start = Start(selection.fit.bias, selection.fit.K, selection.start.scale)
        fits.append(fit_terms(selection.observations, terms, start, selection.settings))
    return [*fits, selection.fit] if selection.names else fits


def _entry(
    selection: Selection,
    name: str,
    steps: Sequence[tuple[Fit, float | None]],
    explained: Values,
    noise: Noise | None,
) -> dict[str, Any]:
    """Return one line of the ranking."""
    score = selection.steps.get(name) or selection.alone[name]
    before = after = None
    if name in selection.names:
        step = selection.names.index(name)
        (without, before), (within, after) = steps[step], steps[step + 1]
        drop = without.residual_rms**2 - within.residual_rms**2
    else:
        best = max(explained[j] for j in selection.first.indices(name))
        drop = float(best / selection.first.samples * np.mean(selection.start.scale**2))
    values, uncertainty, plausible = _estimates(selection, score)
    described = effect(name).parameters(selection.observations.sensor)
    return {
        "effect": name,
        "delta_bic": score.delta_bic,
        "p_value": score.p_value,
        "parameters": {
            p.name: {"value": float(v), "unit": p.unit, "standard_uncertainty": float(u) if u > 0 else None}
            for p, v, u in zip(described, values, uncertainty, strict=True)
        },
        "explained_share": _share(drop, selection, noise),
        "held_out_error_before": before,
        "held_out_error_after": after,
        "look_alikes": _look_alikes(selection, score),
        "plausible": plausible,
        **({"meaning": effect(name).meaning} if effect(name).definition else {}),
    }


def _share(drop: float, selection: Selection, noise: Noise | None) -> float:
    """Return the share of the residual's excess over the noise that a drop of its mean square is."""
    base, final = selection.base.residual_rms**2, selection.fit.residual_rms**2
    floor = final if noise is None else float(np.mean(noise.white**2 + noise.wander**2))
    if not selection.names and base < CLOSE * floor:
        return float(np.clip(drop / base, 0.0, 1.0))
    excess = max(base - floor, base - final, drop)
    return float(np.clip(drop / excess, 0.0, 1.0)) if excess > 0 else 0.0


def _estimates(selection: Selection, score: Score) -> tuple[Values, Values, bool]:
    """Return values, standard uncertainties and plausibility: of the fit of all selected, or of the effect alone."""
    at = BASE
    for term in selection.fit.terms:
        own = slice(at, at + len(term.values))
        if term.effect.name == score.name and score.name in selection.names:
            uncertainty = np.sqrt(np.clip(np.diag(selection.fit.covariance)[own], 0.0, None))
            limits = selection.limits.get(score.name)
            if limits is None:
                return term.values, uncertainty, score.plausible
            return term.values, uncertainty, bool(np.all(np.abs(term.values) - 2.0 * uncertainty <= limits))
        at = own.stop
    return score.values, score.uncertainty, score.plausible


def _look_alikes(selection: Selection, score: Score) -> list[dict[str, Any]]:
    """Return the effects that reproduce most of an effect's fitted signal; of a signal in the noise, none."""
    if score.delta_bic <= GATE_BIC:
        return []
    if score.name in selection.names:
        ranking, held = selection.ranking, selection.chosen()
        place = ranking.indices(score.name)[0]
        _, at = ranking.of_model(held)
    else:
        ranking, held = selection.first, []
        place, at = ranking.indices(score.name)[0], score.setting
    shares = ranking.shares(place, held, at)
    alike = sorted(((share, name) for name, share in shares.items() if share > ALIKE), reverse=True)
    return [{"effect": name, "share": share} for share, name in alike]


def _over_noise(fit: Fit, recordings: Sequence[Recording], noise: Noise | None) -> float | None:
    """Return the rms residual of a fit over that of noise alone."""
    if noise is None:
        return None
    gain = max(float(r.filter.get("noise_gain", 1.0)) for r in recordings)
    floor = float(np.sqrt(np.mean((gain * noise.white) ** 2 + noise.wander**2)))
    return float(fit.residual_rms / floor) if floor > 0 else None
