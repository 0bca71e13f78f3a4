"""Select the effects that the model of a sensor lacks, from turns on a table.

The held-out error of a fit is the rms length of ``matrix (reading - model)`` if the attitude is logged, else the rms
error of the magnitude. It is compared with the noise floor of ``pipeline.evaluation.held_out.heldout``.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.errors import ConvergenceError
from pipeline.core.records import Noise, SelectionErrors, SensorCalibration, TableEvidence
from pipeline.core.verdicts import Verdict
from pipeline.estimation.candidates import turns_of
from pipeline.estimation.design import free_curves
from pipeline.estimation.generalized_least_squares import JointFit, calibration_of, fit_in_mean_frame, fit_terms
from pipeline.estimation.observations import observe
from pipeline.estimation.posterior import posterior
from pipeline.estimation.selection import FAR_ABOVE, Selection, select
from pipeline.evaluation.diagnosis.findings import DiagnosisInput, Findings
from pipeline.evaluation.diagnosis.formula_discovery import Discovery, discover, why_not_suggested
from pipeline.evaluation.diagnosis.influence import influence
from pipeline.evaluation.diagnosis.method_errors import method_errors
from pipeline.evaluation.diagnosis.observability import alike_with_zeros, never_shown, not_observable, one_way
from pipeline.evaluation.diagnosis.residual_dependence import dependences, goodness_of_fit
from pipeline.evaluation.diagnosis.residual_plots import plots
from pipeline.evaluation.diagnosis.verdict import verdict_of_selection
from pipeline.evaluation.diagnosis.words import FAR_OFF, plain
from pipeline.evaluation.held_out.error_breakdown import with_known_effects
from pipeline.evaluation.held_out.heldout import noise_floors
from pipeline.evaluation.held_out.samples import samples_of_motion
from pipeline.physics.effects import catalogue, effect

if TYPE_CHECKING:
    from collections.abc import Sequence


NEEDED_RECORDING = "record turns about all three axes on a table whose angle and rate are logged"
# mean square of a residual over that of noise below which effects cannot explain a part of the excess
UNEXPLAINABLE_RATIO = 1.1


def findings(case: DiagnosisInput) -> Findings:
    """Return the findings of the selection in turns on a table.

    Raises ``NotObservableError`` if the recordings do not determine bias and matrix.
    """
    observations = observe(case.sensor, case.recordings, case.settings.table)
    known = case.noise, case.data_sheet, case.calibration
    selection = select(observations, case.configured, *known, accelerometer=case.accelerometer)
    unknown = dependences(selection)

    def search() -> Findings | None:
        discovery = discover(selection, unknown, case)
        if not discovery.suggested:
            return None
        try:
            described = _described(discovery, case)
        except ConvergenceError:  # the form cannot be subtracted from held-out readings, so it is no effect of a sensor
            return None
        reason = why_not_suggested(discovery, described.hidden)
        if reason is None:
            return described
        formulas = [replace(formula, suggested=False) for formula in discovery.front]
        held_out = described.table_evidence.held_out if described.table_evidence else None
        evidence = TableEvidence(held_out, formulas, reason)
        return replace(described, suggested_effect=None, table_evidence=evidence)

    catalogue_alone = Discovery(selection, selection, unknown)
    try:
        described = _described(catalogue_alone, case)
    except ConvergenceError:  # effects are too large to be subtracted from held-out readings: no held-out error
        fitted = [r for r in case.recordings if r.role != "validation"]
        described = _described(catalogue_alone, replace(case, recordings=fitted))
    return replace(described, search=search)


def _described(discovery: Discovery, case: DiagnosisInput) -> Findings:
    """Return the findings of a selection and a discovery."""
    sensor, noise, selection, reported = case.sensor, case.noise, discovery.context, discovery.reported
    observations, unknown = selection.observations, discovery.unknown
    fits = _fits(reported)
    errors, floor = _held_out_errors(reported, fits, case)
    held_out = None
    if errors and noise is not None:
        held_out = SelectionErrors(errors[0], errors[-1], floor)
    hidden = not_observable(reported, case.modelled)
    squares = [fit.residual_rms**2 for fit in fits]
    reference = observations.less_stop_errors.expected_square
    noise_square = None if noise is None else float(np.mean(reference * noise.white**2 + noise.wander**2))
    least = squares[-1] if noise_square is None else noise_square
    at_noise = not reported.names and squares[0] < UNEXPLAINABLE_RATIO * least
    excess = squares[0] if at_noise else squares[0] - min(least, squares[-1])
    motions = [part.motion for part in observations.parts]
    bent = any(effect(name).of_the_room(sensor) for name in selection.names)
    curves = free_curves(sensor, motions, bent=bent) if selection.names or unknown else []
    answers = posterior(selection, never_shown(hidden, reported.names), curves)
    verdict = verdict_of_selection(
        reported.names,
        unknown,
        float(np.clip((squares[0] - squares[-1]) / excess, 0.0, 1.0)) if excess > 0.0 else 0.0,
        2.0 * (reported.fit.log_likelihood - reported.base.log_likelihood),
        above_noise=noise_square is not None and squares[-1] > FAR_ABOVE**2 * noise_square,
        held_out=held_out,
        beyond=max((answers.probability(curve.name) for curve in curves), default=0.0),
    )
    explained, white_square = reported.first.explained(), float(np.mean(reported.start.scale**2))

    def drop_alone(name: str) -> float:
        largest = max((explained[j] for j in reported.first.indices(name)), default=0.0)
        return float(largest) / reported.first.samples * white_square

    final, _ = fit_in_mean_frame(reported.fit)

    def advice(verdict: Verdict) -> str:
        if verdict == Verdict.UNEXPLAINED:
            return FAR_OFF
        if one_way(observations):
            return "make every turn in the other direction too: five effects are observable only in both directions"
        proposed = next((this for name, this in catalogue().items() if this.proposed and name in hidden), None)
        return f"to make {plain(proposed.name)} observable: record {proposed.excitation}" if proposed else ""

    def calibrated(fit: JointFit) -> SensorCalibration:
        return calibration_of(fit, selection.observations, None, case.settings)

    suggested = [str(discovery.suggested["name"])] if discovery.suggested else []  # in the base of ``reported``
    scores = reported.ranking.log_likelihoods(reported.chosen())
    noises = list(zip(reported.ranking.settings, scores.tolist(), strict=True))[1:]  # the first is white noise
    return Findings(
        sensor=sensor,
        selected=reported.names,
        verdict=verdict,
        steps=reported.steps,
        alone=reported.alone,
        terms=final.terms,
        covariance=final.covariance,
        limits=reported.limits,
        answers=answers,
        shares=lambda name: _shares(reported, name),
        squares=squares,
        drop_alone=drop_alone,
        excess=excess,
        held_out=errors or [None] * len(fits),
        hidden={**hidden, **alike_with_zeros(reported)},
        unknown=unknown,
        over_noise=_over_noise(selection.base, case, reference),
        left_over_noise=_over_noise(selection.fit, case, reference),
        noises=noises,
        white=float(np.sqrt(white_square)),
        expected_wander=None if noise is None else float(np.sqrt(np.mean(noise.wander**2))),
        advice=advice,
        free=lambda: calibrated(selection.base),
        full=(lambda: calibrated(selection.fit)) if selection.names else None,
        method_errors=method_errors(case.calibration, reported, case.recordings, case.settings),
        suggested_effect=discovery.suggested,
        table_evidence=TableEvidence(held_out, discovery.front),
        details={"pictures": plots(selection, unknown, noise, reported)},
        turns=turns_of(observations),
        deeper=lambda: {
            "influence": influence(reported, [*suggested, *reported.names]),
            "goodness_of_fit": goodness_of_fit(reported),
        },
    )


def _fits(selection: Selection) -> list[JointFit]:
    """Return the fits of the base and with each further selected effect."""
    fits = [selection.base]
    fitted = {term.effect.name: term for term in selection.fit.terms}
    for count in range(1, len(selection.names)):
        terms = [*selection.base.terms, *(fitted[name] for name in selection.names[:count])]
        fits.append(fit_terms(selection.observations, terms, selection.fit, selection.settings))
    return [*fits, selection.fit] if selection.names else fits


def _held_out_errors(selection: Selection, fits: Sequence[JointFit], case: DiagnosisInput) -> tuple[list[float], float]:
    """Return the held-out error of each fit, and the noise floor of the last; no errors without held-out motion."""
    noise = case.noise or Noise(np.zeros(3), np.zeros(3), 1.0, "none")
    held = [r for r in case.recordings if r.role == "validation"] if selection.names else []
    found = [samples_of_motion(case.sensor, r, noise, case.settings.table, smoothed=True) for r in held]
    samples = [s for s in found if s is not None and s.known.any()]
    if not samples:
        return [], 0.0
    calibrations = [calibration_of(fit, selection.observations, None) for fit in fits]
    corrected = [[with_known_effects(calibration, each) for each in samples] for calibration in calibrations]
    directed = all(true is not None for of_fit in corrected for _, _, true in of_fit)
    errors: list[float] = []
    for of_fit in corrected:
        squares = []
        for each, (vector, magnitude, true) in zip(samples, of_fit, strict=True):
            error = np.linalg.norm(vector, axis=1) - magnitude
            if directed and true is not None:
                error = np.linalg.norm(vector - true, axis=1)
            squares.append(error[each.known] ** 2)
        errors.append(float(np.sqrt(np.nanmean(np.concatenate(squares)))))
    floor, vector_floor = noise_floors(calibrations[-1], samples)
    return errors, floor if vector_floor is None or not directed else vector_floor


def _shares(selection: Selection, name: str) -> dict[str, float]:
    """Return the share of an effect's fitted signal that each other effect reproduces."""
    if name in selection.names:
        chosen, ranking = selection.chosen(), selection.ranking
        return ranking.shares(ranking.indices(name)[0], chosen, ranking.of_model(chosen)[1])
    return selection.first.shares(selection.first.indices(name)[0], [], selection.alone[name].setting)


def _over_noise(fit: JointFit, case: DiagnosisInput, reference: float) -> float | None:
    """Return the rms residual of a fit over that of noise alone; ``reference``: ``Observations.expected_square``."""
    if case.noise is None:
        return None
    gain = max(float(r.filter.get("noise_gain", 1.0)) for r in case.recordings)
    floor = float(np.sqrt(np.mean(reference * (gain * case.noise.white) ** 2 + case.noise.wander**2)))
    return float(fit.residual_rms / floor) if floor > 0 else None
