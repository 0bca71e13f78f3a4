"""Select the effects that the model of a sensor lacks, from turns on a table, and what shows them.

The held-out error of a fit is the rms length of ``matrix (reading - model)`` if the attitude is logged, else the rms
error of the magnitude. It is compared with the noise floor of ``pipeline.evaluation.held_out.validation``.

The gain of an effect is a sum over seconds, of which the largest are listed:

    gain = r0^T C^-1 r0 - r1^T C^-1 r1,    r0 = r1 + Z gamma - X (X^T C^-1 X)^-1 X^T C^-1 Z gamma

with the residual r1 of the fit, the signal Z gamma of the effect, the columns X of base and other effects, and the
noise C of the fit. Both terms are sums over whitened blocks of time and the scatter within them. Whether the evidence
depends on one recording follows from linear fits without each: their delta BIC, and the largest change of a parameter
in standard uncertainties (Cook, Technometrics 19, 1977).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from pipeline.core.errors import ConvergenceError
from pipeline.core.files import JSON
from pipeline.core.records import (
    BASE_COUNT,
    Index,
    SelectionErrors,
    SensorCalibration,
    SensorDiagnosis,
    TableEvidence,
    Values,
)
from pipeline.core.verdicts import Verdict
from pipeline.estimation.candidates import estimates, turns_of
from pipeline.estimation.design import Design, EffectColumns, placed
from pipeline.estimation.gates import MIN_DELTA_BIC, min_delta_bic
from pipeline.estimation.generalized_least_squares import JointFit, calibration_of
from pipeline.estimation.harm import fits_of, harmful_in_turns, harmful_on_held_out
from pipeline.estimation.observability import alike_with_zeros, hidden_in, never_shown, not_observable, one_way
from pipeline.estimation.observations import ROLES, Observations, observe, without_each_recording
from pipeline.estimation.posterior import completed, curves_of, posterior
from pipeline.estimation.ranking import projection, without
from pipeline.estimation.selection import ABOVE_NOISE, FAR_ABOVE, Selection, select
from pipeline.estimation.stages import last_fit
from pipeline.evaluation.diagnosis.findings import DiagnosisInput, Findings, implausible, wander_of
from pipeline.evaluation.diagnosis.formula_discovery import Discovery, discover, why_not_suggested
from pipeline.evaluation.diagnosis.method_errors import method_errors
from pipeline.evaluation.diagnosis.residual_dependence import dependences, goodness_of_fit, plots
from pipeline.evaluation.diagnosis.verdict import verdict_of_selection
from pipeline.evaluation.diagnosis.words import FAR_OFF, plain
from pipeline.evaluation.held_out.error_breakdown import errors_of
from pipeline.evaluation.held_out.samples import HeldOutCase
from pipeline.evaluation.held_out.validation import noise_floor, vector_noise_floor
from pipeline.physics.effects import catalogue

MOST_OF = 0.5  # share of the gain that the seconds have together, of which the largest stretches are listed
MAX_INFLUENTIAL_STRETCHES = 5  # that a page lists
DETERMINED = 1e-6  # least information on an effect's weakest direction, over that of all recordings
NEEDED_RECORDING = "record turns about all three axes on a table whose angle and rate are logged"


def influence(selection: Selection, names: Sequence[str]) -> list[JSON]:
    """Return the recordings and seconds that show each effect of a selection's fit, those with the largest share first.

    Entries: ``effect, recordings`` (``recording, share, delta_bic_without, change``), ``seconds`` (``recording, from_s,
    to_s, share``) and ``depends_on``, the recordings without which the evidence is below the gate.
    """
    if not names:
        return []
    observations, fit = selection.observations.less_stop_errors, selection.fit
    slices = placed(fit.terms)
    design = fit.design(observations)
    products = design.products([fit.setting])[0]
    rests = without_each_recording(observations)
    without_each = [(design.reweighted(rest).products([fit.setting])[0], rest) for rest in rests]
    ends = np.cumsum([len(part.weight) for part in observations.parts])
    of_block = np.searchsorted(ends, observations.blocks.first, side="right")  # index of the recording
    found = []
    for name in names:
        term, index = slices[name][0], np.arange(slices[name][1].start, slices[name][1].stop)
        shares = _shares_of_blocks(selection, design, products, term, index)
        least, gate = DETERMINED * _weakest(products, index), min_delta_bic(term.effect, observations.sensor)
        recordings: list[JSON] = []
        for k, part in enumerate(observations.parts):
            entry: JSON = {"recording": part.name, "share": float(shares[of_block == k].sum())}
            refitted = _refitted(fit, index, least, *without_each[k]) if without_each else {}
            recordings.append({**entry, "delta_bic_without": None, "change": None, **refitted})
        recordings.sort(key=lambda entry: -entry["share"])
        found.append(
            {
                "effect": name,
                "recordings": recordings,
                "seconds": _stretches(observations, shares, of_block),
                "depends_on": [r["recording"] for r in recordings if (r["delta_bic_without"] or 0.0) < gate],
            }
        )
    return found


def _shares_of_blocks(
    selection: Selection, design: Design, products: Values, term: EffectColumns, index: Index
) -> Values:
    """Return the share of each block in the gain of an effect: (m,) array."""
    observations, fit = selection.observations.less_stop_errors, selection.fit
    change = np.zeros(design.count)
    nonlinear = () if term.effect.moves else term.effect.nonlinear
    linear = [p.name not in nonlinear for p in term.effect.parameters(observations.sensor)]
    change[index] = np.where(linear, term.values, 0.0)
    others = np.setdiff1d(np.arange(design.count), index)
    change[others] = -(projection(products[:, :-1, :-1], others)[0] @ change)
    blocks, weight = observations.blocks, observations.weight
    label, noise, gains = blocks.label(len(weight)), blocks.model((fit.setting,)), np.zeros(len(blocks.first))
    with_effect = design.left(-change)
    for c in range(3):
        both = np.stack([with_effect[:, c], design.of_axis(c)[:, -1]], axis=1)
        means = blocks.sums(weight[:, None] * both) / blocks.weight[:, None]
        inside = np.sum(weight[:, None] * (both - means[label]) ** 2 * [1.0, -1.0], axis=1)
        white = noise.whitened(means)[0] ** 2
        of_axis = np.bincount(label, inside, len(gains))
        of_axis[blocks.order] += white[0] - white[1]
        gains += of_axis / fit.scale[c] ** 2
    total = float(gains.sum())
    return np.asarray(gains / total if total > 0.0 else gains * 0.0)


def _weakest(products: Values, index: Index) -> float:
    """Return the least information on an effect's parameters given all others, with columns of unit norm."""
    others = np.setdiff1d(np.arange(products.shape[1] - 1), index)
    size = np.sqrt(np.maximum(np.diag(products[0])[index], 1e-300))
    return float(np.linalg.eigvalsh(without(products, others)[0][np.ix_(index, index)] / np.outer(size, size))[0])


def _refitted(fit: JointFit, index: Index, least: float, products: Values, rest: Observations) -> JSON:
    """Return delta BIC of an effect and the largest change of its parameters without a recording.

    Empty if the information of the other recordings, ``rest``, is below ``least``.
    """
    if _weakest(products, index) < least:
        return {}
    within, samples, p = float(np.sum(rest.scatter / fit.scale**2)), 3.0 * rest.samples, products.shape[1] - 1
    given = without(products, np.setdiff1d(np.arange(p), index))
    values = np.concatenate([term.values for term in fit.terms])[index - BASE_COUNT]
    step = projection(given, index)[0][:, -1]  # from the values of the fit, whose residual is the last column
    left = float(without(given, index)[0, -1, -1])
    alone = left + float((step + values) @ given[0][np.ix_(index, index)] @ (step + values))
    gain = samples * float(np.log((alone + within) / (left + within)))
    uncertainty = np.sqrt(np.clip(np.diag(fit.covariance)[index], 1e-300, None))
    return {
        "delta_bic_without": gain - len(index) * float(np.log(samples)),
        "change": float(np.max(np.abs(step) / uncertainty)),
    }


def _stretches(observations: Observations, shares: Values, of_block: Index) -> list[JSON]:
    """Return the fewest seconds that have half of the gain, adjacent blocks of a recording joined: the five largest."""
    if not shares.any():
        return []
    order = np.argsort(-shares)
    chosen = np.sort(order[: int(np.searchsorted(np.cumsum(shares[order]), MOST_OF)) + 1])
    time = np.concatenate([part.motion.time for part in observations.parts])
    first, last = observations.blocks.first, np.append(observations.blocks.first[1:], len(time)) - 1
    breaks = np.flatnonzero((np.diff(chosen) != 1) | (np.diff(of_block[chosen]) != 0)) + 1
    found = [
        {
            "recording": observations.parts[of_block[run[0]]].name,
            "from_s": float(time[first[run[0]]]),
            "to_s": float(time[last[run[-1]]]),
            "share": float(shares[run].sum()),
        }
        for run in np.split(chosen, breaks)
    ]
    return sorted(found, key=lambda stretch: -stretch["share"])[:MAX_INFLUENTIAL_STRETCHES]


def findings(case: DiagnosisInput) -> Findings:
    """Return the findings of the selection in turns on a table.

    Held-out motion and limits distinguish sets that the turns do not. Where a selected effect raises the held-out
    error, another set that explains as much and raises none takes the place of the selection; where one is beyond its
    limits, another one that is plausible and better by a delta BIC of ``MIN_DELTA_BIC``, which the search had missed.
    A selection that leaves twice the noise stays as it is: no set of the catalogue explains such turns.
    Raises ``NotObservableError`` if the recordings do not determine bias and matrix.
    """
    observations = observe(case.sensor, case.recordings, case.settings.table)
    known = case.noise, case.data_sheet, case.calibration
    first = select(observations, case.configured, *known, accelerometer=case.accelerometer)

    far_above_noise = (_over_noise(first.fit, case, observations) or 0.0) > FAR_ABOVE

    def found_by(selected: Selection, harmful: Mapping[str, str]) -> tuple[Selection, Findings]:
        hidden = partial(hidden_in, modelled=case.modelled)
        selection = selected if far_above_noise else completed(selected, hidden)
        return selection, _found(selection, case, harmful)

    selection, found = found_by(first, {})
    beyond = [] if case.data_sheet.accept_implausible else implausible(found)
    doubted = {*found.harmful, *beyond}
    second = selection.without(doubted) if doubted and not far_above_noise else None
    if second is None or (beyond and second.bic < selection.bic + MIN_DELTA_BIC):
        return found
    _, other = found_by(second, found.harmful)
    return found if implausible(other) or other.harmful.keys() & {*other.diagnosis.selected} else other


def _found(selection: Selection, case: DiagnosisInput, harmful: Mapping[str, str]) -> Findings:
    """Return the findings of a selection, with the search of a formula outside the catalogue.

    ``harmful``: further effects that raise the held-out error, with the reason; no answer has them.
    """
    unknown = dependences(selection)

    def search() -> Findings | None:
        discovery = discover(selection, unknown, case)
        try:
            return _described(discovery, case, harmful) if discovery.suggested else None
        except ConvergenceError:  # the form cannot be subtracted from held-out readings, so it is no effect of a sensor
            return None

    catalogue_alone = Discovery(selection, selection, unknown)
    try:
        described = _described(catalogue_alone, case, harmful)
    except ConvergenceError:  # effects are too large to be subtracted from held-out readings: no held-out error
        fitted = [r for r in case.recordings if r.role != "validation"]
        described = _described(catalogue_alone, replace(case, recordings=fitted), harmful)
    return replace(described, search=search)


def _described(discovery: Discovery, case: DiagnosisInput, known_harmful: Mapping[str, str]) -> Findings:
    noise, selection, reported = case.noise, discovery.context, discovery.reported
    observations, unknown = selection.observations, discovery.unknown
    fits = fits_of(reported)
    errors, floor, harmful = _held_out(reported, fits, case)
    suggested = [str(discovery.suggested["name"])] if discovery.suggested else []  # in the base of ``reported``
    if suggested:  # the override adds no formula
        harmful = _held_out(reported, fits_of(reported, suggested), case)[2]
    held_out = SelectionErrors(errors[0], errors[-1], floor) if errors else None
    hidden = not_observable(reported, case.modelled)
    not_shown = {**hidden, **alike_with_zeros(reported)}
    reason = why_not_suggested(discovery, not_shown) if discovery.suggested else None
    formulas = discovery.front if reason is None else [replace(each, suggested=False) for each in discovery.front]
    squares = [fit.residual_rms**2 for fit in fits]
    noise_square = observations.noise_square(noise)
    at_noise = not reported.names and squares[0] < ABOVE_NOISE * noise_square
    excess = squares[0] if at_noise else squares[0] - min(noise_square, squares[-1])
    curves = curves_of(selection) if selection.names or unknown else []
    answers = posterior(selection, [*never_shown(hidden, reported.names), *known_harmful], curves)
    verdict = verdict_of_selection(
        reported.names,
        unknown,
        float(np.clip((squares[0] - squares[-1]) / excess, 0.0, 1.0)) if excess > 0.0 else 0.0,
        2.0 * (reported.fit.log_likelihood - reported.base.log_likelihood),
        above_noise=squares[-1] > FAR_ABOVE**2 * noise_square,
        held_out=held_out,
        beyond=max((answers.probability(curve.name) for curve in curves), default=0.0),
    )
    explained, white_square = reported.first.explained(), float(np.mean(reported.start.scale**2))

    def drop_alone(name: str) -> float:
        largest = max((explained[j] for j in reported.first.indices(name)), default=0.0)
        return float(largest) / reported.first.samples * white_square

    final, _ = reported.fit.in_mean_frame

    def advice(verdict: Verdict) -> str:
        if verdict == Verdict.UNEXPLAINED:
            return FAR_OFF
        if one_way(observations):
            both = [plain(n) for n, e in catalogue().items() if e.needs_both_directions and case.sensor in e.sensors]
            return f"make every turn in the other direction too: only both directions show {', '.join(both)}"
        proposed = next((this for name, this in catalogue().items() if this.proposed and name in hidden), None)
        return f"to make {plain(proposed.name)} observable: record {proposed.excitation}" if proposed else ""

    def calibrated(fit: JointFit) -> SensorCalibration:
        return calibration_of(fit, selection.observations, None, case.settings)

    scores = reported.ranking.log_likelihoods(reported.chosen())
    noises = list(zip(reported.ranking.settings, scores.tolist(), strict=True))[1:]  # the first is white noise
    samples = sum(r.samples for r in case.recordings if r.role in ROLES)
    diagnosis = SensorDiagnosis(
        verdict,
        case.configured,
        _over_noise(selection.base, case, observations),
        reported.names,
        not_observable=not_shown,
        unexplained=unknown,
        suggested_effect=discovery.suggested if reason is None else None,
        method_errors=method_errors(case.calibration, reported, case.recordings, case.settings),
        wander=wander_of(noises, float(np.sqrt(white_square)), noise),
        on_table=TableEvidence(held_out, formulas, reason),
        details={
            "pictures": plots(selection, unknown, noise, reported),
            "rows": {"rows": len(observations.weight), "samples": samples},
        },
    )
    return Findings(
        sensor=case.sensor,
        diagnosis=diagnosis,
        steps=reported.steps,
        alone=reported.alone,
        fitted=estimates(final.terms, final.covariance),
        limits=reported.limits,
        answers=answers,
        shares=lambda name: _shares(reported, name),
        squares=squares,
        drop_alone=drop_alone,
        excess=excess,
        held_out=errors or [None] * len(fits),
        harmful={**known_harmful, **harmful},
        left_over_noise=_over_noise(selection.fit, case, observations),
        advice=advice,
        free=lambda: calibrated(selection.base),
        full=(lambda: calibrated(selection.fit)) if selection.names else None,
        turns=turns_of(observations),
        deeper=lambda: {
            "influence": influence(reported, [*suggested, *reported.names]),
            "goodness_of_fit": goodness_of_fit(reported),
        },
    )


def _held_out(
    selection: Selection, fits: Sequence[JointFit], case: DiagnosisInput
) -> tuple[list[float], float, dict[str, str]]:
    """Return the held-out error of each fit, the noise floor of the last, and the effects that raise the error.

    Effects are compared with the published calibration if it is by a table's motion, else with the base. The bias
    wanders as in the recordings of the fit, if that is more than in a rest. Without held-out motion the list is empty,
    and stretches of the turns that are left out judge the effects.
    """
    noise, held_out = case.noise, HeldOutCase(case.calibration, case.recordings, case.noise, case.settings)
    samples = held_out.held_out_samples(smoothed=True) if selection.names else []
    if not any(s.known.any() for s in samples):
        return [], 0.0, harmful_in_turns(selection, fits)
    calibrations = [calibration_of(fit, selection.observations, None) for fit in fits]
    before = case.calibration if last_fit(case.calibration).reference else calibrations[0]
    errors, time = errors_of([before, *calibrations], samples)
    floor = None if errors[0].mean.shape[1] == 1 else vector_noise_floor(calibrations[-1], samples)
    setting, wander = fits[-1].setting, fits[-1].setting.ratio * fits[-1].scale
    if np.mean(wander**2) > np.mean(noise.wander**2):
        noise = replace(noise, wander=wander, correlation_time=setting.time)
    return (
        [error.rms for error in errors[1:]],
        noise_floor(calibrations[-1], samples) if floor is None else floor,
        harmful_on_held_out(selection.names, [errors[0], *errors[2:]], time, noise),
    )


def _shares(selection: Selection, name: str) -> dict[str, float]:
    if name in selection.names:
        chosen, ranking = selection.chosen(), selection.ranking
        return ranking.shares(ranking.indices(name)[0], chosen, ranking.of_model(chosen)[1])
    return selection.first.shares(selection.first.indices(name)[0], [], selection.alone[name].setting)


def _over_noise(fit: JointFit, case: DiagnosisInput, observations: Observations) -> float | None:
    """Return the rms residual of a fit over that of noise alone."""
    gain = max(float(r.filter.get("noise_gain", 1.0)) for r in case.recordings)
    floor = float(np.sqrt(observations.noise_square(case.noise, gain)))
    return float(fit.residual_rms / floor) if floor > 0 else None
