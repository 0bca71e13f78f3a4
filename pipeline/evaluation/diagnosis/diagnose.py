"""Diagnose which physical effect the model of a sensor lacks.

``turntable`` or, for rests and moves by hand, ``multi_position`` selects effects and returns ``Findings``.
``diagnosis_of`` states them as a diagnosis, which ``verdict`` compares with the error on held-out motion.

Selected effects are no possible cause of the residual by four reasons:

    beyond the sensor file      |p| - 1.96 u > 3 limit, unless the settings accept it
    by the thermometer          the temperature changes by less than its resolution
    by the Earth                a rate of more than the Earth's, 15.04 deg/h
    by the noise                white noise at rest of more than 3 times what the sensor's file states: that of another
                                sensor (``generic`` is of no sensor, and states none). Short rests of a table's turns
                                hold its motion, too, and say nothing

Such effects fit best, and are listed as ``candidates``; the verdict is ``unexplained`` and nothing is offered.

The effective noise in motion is white noise whose averages scatter as much as those of the error in motion:

    n_e(t)^2 = t var(mean of the error over t),    over_white = n_e / n,   n^2 = white^2 dt

The error is that of the calibrated readings on held-out motion, of the vector or, without a logged attitude, of the
magnitude. Its mean is subtracted, since an estimator takes it as bias. The variance is over consecutive stretches of
length t and the axes. White noise alone gives n at every t. Effects that are not compensated add errors that last as
long as the motion, so an estimator needs several times the noise at rest. The share of an effect that the diagnosis
found is n_e of the effect's own error, by the parameters of the diagnosis.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import scipy

from pipeline.core.errors import ConvergenceError, NotObservableError
from pipeline.core.records import (
    MATRIX,
    Candidate,
    Coefficient,
    FittedEffect,
    MovesError,
    Noise,
    Recording,
    SensorCalibration,
    SensorDiagnosis,
    SensorValidation,
    Values,
    finite_rows,
    median,
    once,
)
from pipeline.core.settings import Effects, Settings, Table, Uncertainty
from pipeline.core.verdicts import Verdict, decided_words
from pipeline.estimation.candidates import AUTO, MOUNTING, TILT, configured_effects
from pipeline.estimation.effects import mountings_by_gravity, of_the_angle
from pipeline.estimation.gates import MAX_FALSE_DEPENDENCE, TIMES_POSSIBLE, possible
from pipeline.estimation.noise import with_noises
from pipeline.estimation.rest_means import is_multi_position
from pipeline.estimation.stages import last_fit
from pipeline.evaluation.diagnosis import multi_position, turntable
from pipeline.evaluation.diagnosis.findings import DiagnosisInput, Findings, diagnosis_of, with_unknown
from pipeline.evaluation.diagnosis.verdict import (
    EXPLAINED,
    MAX_UNKNOWN_PROBABILITY,
    VerdictInput,
    judged,
    may_be_unknown,
)
from pipeline.evaluation.diagnosis.words import plain
from pipeline.evaluation.held_out.error_breakdown import left_out, vector_errors, with_known_effects
from pipeline.evaluation.held_out.samples import HeldOutCase, Samples, samples_of_motion
from pipeline.evaluation.held_out.validation import HeldOutError, last_error, static_error
from pipeline.physics.effects import catalogue, effect, effect_of
from pipeline.physics.effects.base import parameter_limits, truth, unit_of
from pipeline.physics.effects.equations import OTHER_PREFIX
from pipeline.physics.kinematics import EARTH_RATE_DPS
from pipeline.physics.measurement import linear_truth
from pipeline.physics.statements import not_determined

EARTH = "earth_rotation"
OTHER_FILE = "check that the sensor's file is that of this unit, and that its range and units are right"
IN_DOUBT = Verdict.REFERENCE_IN_DOUBT, Verdict.UNEXPLAINED  # of an accelerometer whose mountings may be wrong
LEANING = ("mounting", "table_axis_nonorthogonality")  # effects that tilt a turn axis in the body
# errors of a method that its uncertainty excludes
ERRORS_OUTSIDE_UNCERTAINTY = ("bias", "scale_factor", "non_orthogonality", "rotation")
AVERAGING_TIMES_S = (0.1, 1.0, 10.0)  # between two images, between key frames, between fixes of a position
MIN_STRETCHES = 8  # stretches, which determine a standard deviation to a quarter


def without_harmful(found: SensorDiagnosis, harmful: Mapping[str, str]) -> SensorDiagnosis:
    """Return the diagnosis without the selected effects that raise the held-out error; all become candidates."""
    found = replace(found, candidates={**harmful, **found.candidates})
    harmful = {name: reason for name, reason in harmful.items() if name in found.selected}
    if not harmful:
        return found
    left = [name for name in found.selected if name not in harmful]
    told = "; ".join(f"{plain(name)} fits and is not offered: {reason}" for name, reason in harmful.items())
    missing = found.verdict == Verdict.MISSING_EFFECT and not left
    head, _, names = found.override.partition("[")
    kept = [name for name in names.rstrip("]").split(",") if name and name not in harmful]
    override = f"{head}[{','.join(kept)}]" if left and found.override else ""
    return replace(_told(found, told, unexplained=missing), selected=left, override=override)


def without_impossible(found: SensorDiagnosis, case: DiagnosisInput) -> SensorDiagnosis:
    """Return the diagnosis with the selected effects that are not possible as candidates, and without a selection."""
    reasons = {entry.effect: reason for entry in found.chosen if (reason := _contradiction(entry, case))}
    if not reasons:
        return found
    told = "; ".join(f"{plain(name)} fits the residual best and is no cause: {why}" for name, why in reasons.items())
    doubted = found.verdict == Verdict.REFERENCE_IN_DOUBT
    found = replace(_told(found, told, unexplained=not doubted), candidates={**found.candidates, **reasons})
    return replace(found, selected=(), next_experiment=found.next_experiment if doubted else OTHER_FILE, override="")


def _told(found: SensorDiagnosis, told: str, *, unexplained: bool) -> SensorDiagnosis:
    """Return the diagnosis with a further reason, and ``unexplained`` where nothing explains its misfit."""
    found = replace(found, reason=f"{found.reason} {told[0].upper()}{told[1:]}.".strip())
    if not unexplained:
        return found
    return replace(found, verdict=Verdict.UNEXPLAINED, decided_by=decided_words("misfit", found.residual_over_noise))


def _contradiction(entry: Candidate, case: DiagnosisInput) -> str:
    """Return why a selected effect is not possible; empty if it is."""
    this, sheet = effect(entry.effect), case.data_sheet
    values = np.array([p.value for p in entry.parameters.values()])
    u = np.array([p.standard_uncertainty or 0.0 for p in entry.parameters.values()])
    limits = parameter_limits(this, case.sensor, sheet.effects)
    if len(limits) == len(values) and not sheet.accept_implausible and not possible(values, u, limits):
        ratio = float(np.max(np.abs(values) / limits))
        return f"it would be {ratio:.3g} times the data sheet's limit; at most {TIMES_POSSIBLE:g} times is possible"
    if entry.effect == EARTH and np.linalg.norm(values) > _longest_by_chance(EARTH_RATE_DPS, float(np.max(u))):
        return f"{np.linalg.norm(values):.2g} deg/s is more than the Earth turns ({EARTH_RATE_DPS:.2g} deg/s)"
    if "temperature" in this.needs:
        span, resolution = _temperatures([r for r in case.recordings if r.role != "validation"])
        if span < resolution:
            return f"the temperature changes by {span:.2g} degC, less than its resolution of {resolution:.2g} degC"
    used = [r for r in case.recordings if r.reading(case.sensor) is not None]
    noise = case.noise
    if sheet.stated("noise_density") is not None and noise.step is None and used:
        own = noise.source == "static" or (noise.source == "rests" and is_multi_position(case.sensor, case.recordings))
        excess = float(np.min(noise.white)) / sheet.white(used[0].interval) if own else 0.0
        if excess > TIMES_POSSIBLE:
            return f"the noise is {excess:.2g} times the sensor file's, so that the file is not that of this sensor"
    return ""


def _longest_by_chance(length: float, u: float) -> float:
    """Return the length that the estimate of a vector exceeds with the probability ``MAX_FALSE_DEPENDENCE``.

    ``u``: standard uncertainty of each component. Its two components across the vector lengthen the estimate, too.
    """
    return float(np.hypot(length, np.sqrt(2.0) * u) + scipy.special.ndtri(1.0 - MAX_FALSE_DEPENDENCE) * u)


def _temperatures(recordings: list[Recording]) -> tuple[float, float]:
    """Return span and resolution of the temperature, degC: of the values, and the smallest step between two."""
    known = [r.temperature for r in recordings if r.temperature is not None]
    values = np.unique(np.concatenate(known)) if known else np.zeros(1)
    values = values[np.isfinite(values)]
    steps = np.diff(values)
    resolution = float(steps[steps > 0.0].min()) if np.any(steps > 0.0) else np.inf
    return float(np.ptp(values)), resolution


def diagnose(
    calibration: SensorCalibration,
    recordings: Sequence[Recording],
    noise: Noise,
    settings: Settings,
    accelerometer: SensorCalibration | None = None,
    *,
    validation: SensorValidation | None = None,
    gravity: SensorDiagnosis | None = None,
    moves: MovesError | None = None,
    departures: Sequence[str] = (),
) -> SensorDiagnosis:
    """Return the diagnosis of a sensor.

    ``calibration``: the fits start from its effects. ``recordings``: all of the unit; those of role ``validation`` take
    no part in the selection. ``accelerometer``: the unit's other calibration, which a gyroscope by hand needs for the
    direction of gravity. ``validation``: of the calibration; without it, a free fit replaces the calibration.
    ``gravity``: for a gyroscope, the diagnosis of the accelerometer. ``moves``: for a gyroscope by hand,
    ``Validation.moves_error``; ``departures``: ``Validation.turn_departures``.
    """
    sensor, settings = calibration.sensor, settings.replaced(uncertainty=Uncertainty(monte_carlo=0))
    by_hand = is_multi_position(sensor, recordings)
    procedure = multi_position if by_hand else turntable
    configured = configured_effects(sensor, settings, [] if by_hand else recordings)
    by_gravity = sensor == "gyroscope" and MOUNTING in configured
    leaning = {} if by_hand or sensor == "accelerometer" else _leaning(gravity, accelerometer)
    if by_gravity:
        accelerometer = _mountings_by_gravity(recordings, settings)
    elif not by_hand:  # an accelerometer's fit is no prior of its own mountings
        accelerometer = None
    case = DiagnosisInput(calibration, recordings, noise, settings, accelerometer, configured)
    full = settings.diagnosis.depth == "full"

    def judge(findings: Findings | None, found: SensorDiagnosis) -> tuple[SensorDiagnosis, bool]:
        """Return the diagnosis with its verdict, and whether to search for a formula outside the catalogue."""
        evidence = evidence_of(found, case, validation, findings)
        doubts = [*evidence.doubts, *departures]
        if by_gravity and gravity:
            doubts += _doubts_of_gravity(gravity, case)
        elif not leaning.keys() & {*configured, *found.selected}:
            doubts += _doubts_of_axes(leaning, calibration)
        evidence = replace(evidence, doubts=doubts, moves=moves, scatter=_scatter(calibration))
        found = judged(found, evidence)
        found = without_harmful(without_impossible(found, case), findings.harmful if findings else {})
        found = with_unknown(found) if found.verdict == Verdict.UNEXPLAINED else found
        return found, full or may_be_unknown(found.verdict, evidence)

    try:
        findings = procedure.findings(case)
    except NotObservableError as reason:
        return judge(None, _not_enough_data(sensor, configured, reason.message, procedure.NEEDED_RECORDING))[0]
    diagnosis, unknown = judge(findings, diagnosis_of(findings, case))
    if unknown and findings.search and (found := findings.search()):
        findings = found
        diagnosis, _ = judge(findings, diagnosis_of(findings, case))
    if findings.deeper and (full or diagnosis.verdict != Verdict.NOTHING_MISSING):
        diagnosis = replace(diagnosis, further=findings.deeper())
    return diagnosis


def _scatter(calibration: SensorCalibration) -> float:
    """Return the scatter of moves or directions that a fit by hand found, over the noise; 0 for other fits."""
    details = [stage.details for stage in calibration.stages]
    found = [value for each in details for value in (each.scatter_of_moves, each.scatter_of_directions) if value]
    return max(found, default=0.0)


def held_out_of(validation: SensorValidation) -> HeldOutError | None:
    """Return the last error of a sensor's validation; None without held-out motion or without an interval."""
    error = validation.steps[-1].rms_error
    if not validation.held_out or validation.expected_rms_error is None or error is None:
        return None
    return HeldOutError(error, *validation.expected_rms_error)


def doubts_of(sensor: str, recordings: Sequence[Recording], *, seats: bool = True) -> list[str]:
    """Return the notes of the recordings that contradict the reference of a sensor.

    Notes on turns of the other sensor do not count. ``seats``: whether the note counts that the turns had different
    mountings.
    """
    codes = {"N-REFERENCE", "N-SEATS"} if seats else {"N-REFERENCE"}
    relevant = [r for r in recordings if r.role not in {"accelerometer", "gyroscope"} or r.role == sensor]
    return [f"{r.name}: {note.detail}" for r in relevant for note in r.notes if note.code in codes]


def evidence_of(
    found: SensorDiagnosis, case: DiagnosisInput, validation: SensorValidation | None, findings: Findings | None
) -> VerdictInput:
    """Return the evidence for the verdict on ``found``, the diagnosis by the selection alone.

    The held-out errors of the free fits are computed only if that of the calibration is above its interval.
    """
    sensor, recordings, settings, fit = case.sensor, case.recordings, case.settings, last_fit(case.calibration)
    free, full = (findings.free, findings.full) if findings else (None, None)
    on_table = findings is None or found.on_table is not None
    other = None if on_table or sensor == "accelerometer" else case.accelerometer
    departures = [text for stage in case.calibration.stages for text in stage.details.departures or ()]

    def error_of(fit: Callable[[], SensorCalibration] | None, *, smoothed: bool) -> HeldOutError | None:
        if fit is None:
            return None
        try:
            held_out = HeldOutCase(fit(), recordings, case.noise, settings, other)
            return last_error(held_out, held_out.held_out_samples(smoothed=smoothed))
        except ConvergenceError:  # the fit's effects cannot be subtracted from the held-out readings
            return None

    static = static_error(HeldOutCase(case.calibration, recordings, case.noise, settings, case.accelerometer))
    accepted = settings.sensor.of(sensor).accept_implausible
    published = held_out_of(validation) if validation else error_of(free, smoothed=False)
    contradicted = published is not None and published.above
    return VerdictInput(
        sensor,
        found.verdict,
        tuple(found.selected),
        max((entry.delta_bic for entry in found.chosen), default=None),
        found.residual_over_noise,
        findings.left_over_noise if findings else None,
        published=published,
        static=static,
        agreement=validation.agreement if validation else None,
        free=error_of(free, smoothed=True) if contradicted else None,
        full=error_of(full, smoothed=True) if contradicted else None,
        doubts=[
            *doubts_of(sensor, recordings, seats=not _seats_explained(found, sensor, findings)),
            *(departures if findings else ()),
        ],
        approximations=[error.name for error in found.method_errors if error.name in ERRORS_OUTSIDE_UNCERTAINTY],
        unknown=[entry.covariate for entry in found.unexplained if not entry.explained_by],
        beyond=[
            name.removeprefix(OTHER_PREFIX)
            for name, probability in found.probability.items()
            if name.startswith(OTHER_PREFIX) and probability > MAX_UNKNOWN_PROBABILITY
        ],
        implausible=() if accepted else [entry.effect for entry in found.chosen if not entry.plausible],
        held_out=found.on_table.held_out if found.on_table else None,
        method=settings.method.of(sensor) or "",
        fit=fit,
        as_printed=settings.method.as_printed,
        filtered=any(r.filter["name"] != "none" for r in recordings if r.role == "validation"),
        likely=found.answer_set[0].effects if found.answer_set and all(a.effects for a in found.answer_set) else (),
        held_by_limit=not_determined(case.calibration.to_json()) if settings.procedure.sheet or not fit.free else "",
        on_table=on_table,
    )


def _seats_explained(found: SensorDiagnosis, sensor: str, findings: Findings | None) -> bool:
    """Return whether the fit explains why turns seem to have different mountings.

    Either mountings or zeros of the angle are in the model or selected. Or they were candidates of the accelerometer,
    were not selected, and the residual is noise: then another effect looked like a mounting to the checks.
    """
    if any(effect(name).of_turns for name in (*found.configured, *found.selected)):
        return True
    residual = None if findings is None else findings.left_over_noise
    return sensor == "accelerometer" and residual is not None and residual <= EXPLAINED


def _doubts_of_gravity(accelerometer: SensorDiagnosis, case: DiagnosisInput) -> list[str]:
    """Return why the mountings that the accelerometer determines may be wrong, from its diagnosis.

    A missing tilt of the table causes no doubt if it shifts no mounting by more than the mounting's uncertainty.
    """
    subject = "the accelerometer, which determines the mountings,"
    if accelerometer.verdict in IN_DOUBT:
        return [f"{subject} has the verdict {accelerometer.verdict}"]
    missing = [name for name in accelerometer.selected if of_the_angle(name)]
    if not missing or (missing == [TILT] and _tilt_is_within_uncertainty(case)):
        return []
    remedy = "an error of the table that shifts the mountings: add it to effects.accelerometer"
    return [f"{subject} misses {' and '.join(missing)}, {remedy}"]


def _tilt_is_within_uncertainty(case: DiagnosisInput) -> bool:
    """Return whether a fitted tilt of the table shifts each mounting by gravity by less than its U."""
    effects, fit = case.settings.effects, case.accelerometer
    listed = effects.accelerometer
    with_tilt = effects.replaced(accelerometer=[*([] if listed == AUTO else listed), TILT])
    other = _mountings_by_gravity(case.recordings, case.settings.replaced(effects=with_tilt))
    if fit is None or other is None or fit.covariance is None:
        return False
    before, after = ({e.name: e.values for e in each.effects}[MOUNTING] for each in (fit, other))
    mountings = fit.parameters.select(fit.parameters.of_effect(MOUNTING))
    return bool(np.all(np.abs(after - before) < mountings.expanded_uncertainty))


def _mountings_by_gravity(recordings: Sequence[Recording], settings: Settings) -> SensorCalibration | None:
    return mountings_by_gravity(with_noises(recordings, settings.sensor, ("accelerometer",)), settings)


def _leaning(diagnosis: SensorDiagnosis | None, fit: SensorCalibration | None) -> dict[str, float]:
    """Return the largest tilt of a turn axis by each such effect that an accelerometer has or misses, deg."""
    chosen, effects = diagnosis.chosen if diagnosis else (), fit.effects if fit else ()
    values = {entry.effect: [p.value for p in entry.parameters.values()] for entry in chosen}
    values |= {each.name: each.values.tolist() for each in effects}
    return {name: max(map(abs, values[name])) for name in LEANING if name in values}


def _doubts_of_axes(leaning: Mapping[str, float], calibration: SensorCalibration) -> list[str]:
    """Return the tilts of the turn axes that exceed the matrix's U: to a gyroscope they look like a misalignment."""
    if calibration.covariance is None:
        return []
    U = np.degrees(2.0 * float(np.max(calibration.parameters.standard_uncertainty[MATRIX])))
    return [
        f"by the accelerometer's {name} the turn axes lean by up to {size:.2g} deg, and the matrix of the gyroscope is "
        f"off by as much ({np.radians(size):.2g}), beyond its uncertainty"
        for name, size in leaning.items()
        if size > U
    ]


def without_diagnosis(sensor: str, effects: Effects, code: str, message: str) -> SensorDiagnosis:
    """Return the diagnosis of a sensor whose diagnosis failed with an error of this code and message.

    The verdict is ``not_enough_data``, because nothing is known of what is missing.
    """
    listed, bug = effects.of(sensor), code == "internal_error"
    remedy = "report this fault with the traceback, which is in the log of the stage diagnose" if bug else ""
    found = _not_enough_data(sensor, [] if listed == AUTO else list(listed), "", remedy)
    reason = f"The diagnosis failed: {message}. The calibration does not depend on it."
    return replace(found, details={"failed": message}, reason=reason, not_observable={})


def _not_enough_data(sensor: str, configured: list[str], reason: str, needed: str) -> SensorDiagnosis:
    """Return the diagnosis for recordings that cannot show any effect; ``needed``: what to record."""
    names = [name for name, each in catalogue().items() if sensor in each.sensors and name not in configured]
    hidden = dict.fromkeys(names, reason)
    return SensorDiagnosis(Verdict.NOT_ENOUGH_DATA, configured, not_observable=hidden, next_experiment=needed)


def effective_noise(
    calibration: SensorCalibration,
    recordings: Sequence[Recording],
    noise: Noise,
    table: Table,
    found: SensorDiagnosis,
    *,
    other: SensorCalibration | None = None,
) -> dict[str, Any] | None:
    """Return the effective noise of a sensor; None without held-out motion.

    ``found``: the sensor's diagnosis. ``other``: calibration of the other sensor. The result has ``unit``,
    ``recordings``, ``motion`` (rms rate in deg/s, rms change of the specific force in g, duration in s), ``white`` (n)
    and ``densities``: for each averaging time ``density``, ``over_white`` and the share of each effect.
    """
    held_out = [r for r in recordings if r.role == "validation"]
    of_motion = ((r, samples_of_motion(calibration.sensor, r, noise, table, other=other)) for r in held_out)
    samples = [(r, s) for r, s in of_motion if s is not None]
    used = [(r, s) for r, s in samples if not left_out(calibration, [s])]
    if not used:
        return None
    errors = [_about_mean(s.time, vector_errors([with_known_effects(calibration, s)], directed=True)) for _, s in used]
    of_effects = {}
    for name in found.selected:
        of_effect = [(s.time, _of_effect(calibration, s, found, name)) for _, s in samples]
        if all(error is not None for _, error in of_effect):
            of_effects[name] = [_about_mean(*error) for error in of_effect]
    interval = used[0][0].interval
    white = float(np.sqrt(np.mean(noise.white**2) * interval))
    densities = []
    for time in dict.fromkeys(max(1, round(t / interval)) * interval for t in AVERAGING_TIMES_S):  # whole samples
        density = _density(errors, time)
        if density is None:
            continue
        shares = [{"effect": name, "density": _density(parts, time)} for name, parts in of_effects.items()]
        ratio = density / white if white > 0 else None
        entry = {"averaging_time_s": round(time, 9), "density": density, "over_white": ratio, "effects": shares}
        densities.append(entry)
    if not densities:
        return None
    about = {"unit": f"{unit_of(calibration.sensor)}/sqrt(Hz)", "recordings": [r.name for r, _ in used]}
    return about | {"motion": _motion([r for r, _ in used]), "white": white, "densities": densities}


def _of_effect(calibration: SensorCalibration, samples: Samples, found: SensorDiagnosis, name: str) -> Values | None:
    """Return the error by an effect of the diagnosis: (n, 3); None if motion or parameters are unknown."""
    entry = next((e for e in found.ranking if e.effect == name), None)
    motion = samples.motion
    if entry is None or motion is None or not entry.parameters:
        return None
    fitted = FittedEffect(name, {n: Coefficient(p.value, p.unit) for n, p in entry.parameters.items()})
    this = effect_of(fitted)
    if any(getattr(motion, need) is None for need in this.needs):
        return None
    if this.moves:
        return np.asarray(truth(samples.sensor, this.moved(motion, fitted.values)) - truth(samples.sensor, motion))
    K = np.asarray(np.linalg.inv(calibration.matrix), np.float64)
    reading = this.reading(samples.sensor, motion, K, fitted.values)
    return np.asarray(linear_truth(calibration, calibration.bias + reading))


def _about_mean(times: Values, error: Values | None) -> tuple[float, Values]:
    """Return the interval of a recording's samples, and its known errors less their mean: (n, 3) array."""
    if error is None or len(times) < 2:
        return 1.0, np.zeros((0, 3))
    values = error[finite_rows(error)]
    return float(median(np.diff(times))), values - values.mean(axis=0) if len(values) else values


def _density(parts: Sequence[tuple[float, Values]], time: float) -> float | None:
    """Return n_e from ``_about_mean`` of recordings; None for too few stretches or samples in a stretch."""
    squares, count = 0.0, 0
    for interval, values in parts:
        size = round(time / interval)
        stretches = len(values) // size if size else 0
        if not stretches:
            continue
        means = values[: stretches * size].reshape(stretches, size, -1).mean(axis=1)
        squares += float(np.sum(means**2)) / means.shape[1]
        count += stretches
    return float(np.sqrt(time * squares / count)) if count >= MIN_STRETCHES else None


def _motion(recordings: Sequence[Recording]) -> dict[str, float | None]:
    """Return the extent of held-out motion by the readings."""
    squares = ([_squares(r, sensor) for r in recordings] for sensor in ("gyroscope", "accelerometer"))
    totals = [np.sum(each, axis=0).tolist() for each in squares]
    rms = [float(np.sqrt(total / count)) if count else None for total, count in totals]
    duration = float(sum(r.time[-1] - r.time[0] for r in recordings))
    return {"rate_dps": rms[0], "force_change_g": rms[1], "duration_s": duration}


@once
def _squares(recording: Recording, sensor: str) -> tuple[float, int]:
    """Return the sum of the squared lengths of readings less their centre, and the number of readings."""
    readings = recording.reading(sensor)
    if readings is None:
        return 0.0, 0
    centre = (np.nanmedian if sensor == "gyroscope" else np.nanmean)(readings, axis=0)
    squares = np.sum((readings - centre) ** 2, axis=1)
    return float(np.nansum(squares)), int(np.isfinite(squares).sum())
