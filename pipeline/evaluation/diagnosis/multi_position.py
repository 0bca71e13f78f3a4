"""Select the effects that the model of a sensor lacks, from rests and moves by hand.

The residual of the rests is compared with white noise and the expected bias instability. How firmly the unit rested is
unknown. So a larger scatter of the rests is reported, but alone it is no sign of a missing effect.

Twenty rests are too few to hold some out of a selection. So the selection uses all of them, and cross-validation
judges it: each of ``REST_FOLDS`` models leaves out every third rest with the move before it. ``held_out_error`` of a
ranking is that of the selected effects, fitted without those rests. ``cross_validation`` also repeats the selection. An
effect that raises the error at these rests, or after these moves, significantly is not offered
(``pipeline.estimation.harm``).

The residual depends on time, temperature (powers 1 to 2 or 3 over their span) or the axis' own specific force
(Chebyshev polynomials of degree 4 and 5) if such curves, with free coefficients on every axis, have delta BIC > 10 and
m p < 1e-3, with m the number of all tests (``fit.judged_curves``).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.core.errors import CannotCalibrateError, NotObservableError, PipelineError
from pipeline.core.records import Dependence, Mask, Noise, Recording, SensorCalibration, SensorDiagnosis, UnitRecordings
from pipeline.core.settings import Settings
from pipeline.core.verdicts import Verdict
from pipeline.estimation.accelerometer import nonlinear_least_squares
from pipeline.estimation.candidates import estimates
from pipeline.estimation.design import EffectColumns
from pipeline.estimation.effects import model_of
from pipeline.estimation.engine import ScaledColumns, cholesky
from pipeline.estimation.gauss_markov import Setting
from pipeline.estimation.harm import REST_FOLDS, LeftOut, left_out, rests_in_turn
from pipeline.estimation.multi_position import fit as fitting
from pipeline.estimation.multi_position.model import Equations, Model, NoiseHypothesis
from pipeline.estimation.multi_position.result import calibration_of
from pipeline.estimation.multi_position.selection import SelectionByHand, is_hysteresis, loops_of, posterior
from pipeline.estimation.noise import noise_of
from pipeline.estimation.observability import MORE_RESTS, never_shown, not_observable_by_hand, slow_by_hand
from pipeline.estimation.rest_means import held_out_rests
from pipeline.estimation.stages import StageInput, is_given
from pipeline.evaluation.diagnosis import functional_forms as forms
from pipeline.evaluation.diagnosis.findings import DiagnosisInput, Findings, wander_of
from pipeline.evaluation.diagnosis.method_errors import given_differences
from pipeline.evaluation.diagnosis.residual_dependence import added_variable_of_rests, significant
from pipeline.evaluation.diagnosis.verdict import verdict_of_selection_by_hand
from pipeline.evaluation.diagnosis.words import HYSTERESIS, listed, plain
from pipeline.physics.effects import catalogue, effect_from

Fold = tuple[SelectionByHand, Mask]  # a selection, and the rests that were left out of it

NEEDED_RECORDING = MORE_RESTS
WITH_FACES = ", in addition to those on the six faces, which determine bias and matrix but no effect"
LEAST_SPAN = 1.0  # s or degC: of a covariate
FORCE = ("8 * u ** 4 - 8 * u ** 2 + 1", "16 * u ** 5 - 20 * u ** 3 + 5 * u")  # Chebyshev polynomials of u in g
WORTH = 0.25  # least share of the residual's mean square that a possible cause explains at its limits
MAX_NAMED_EFFECTS = 3  # effects in a sentence
FIRM = 2.0  # times the noise: a larger scatter of the rests is reported


def findings(case: DiagnosisInput) -> Findings:
    """Return the findings of the selection in rests and moves by hand.

    Raises ``NotObservableError`` if there are no rests, or if they do not determine bias and matrix.
    """
    model, calibration, noise = _model_of_all_rests(case), case.calibration, _without_creep(case)
    given = calibration, case.configured, case.noise, case.data_sheet
    selection = SelectionByHand(model, *given)
    ratio = float(np.sqrt(np.mean(noise.wander**2) / np.mean(noise.white**2)))
    expected = NoiseHypothesis(Setting(ratio, noise.correlation_time), (0.0,) * model.kinds)
    with_scatter = replace(expected, scatter=selection.fits[-1].noise.scatter)
    hidden, unknown = not_observable_by_hand(selection, case.modelled), _dependences(selection)
    chi = [float(np.sum(fitting.project_out(fit.equations, [with_scatter]).residual ** 2)) for fit in selection.fits]
    moving = with_scatter if "slow" in model.rests.kinds else expected  # its accelerations are no missing effect
    over, left_over = (_over_noise(model, selection.fits[k].equations, moving) for k in (0, -1))
    scores = fitting.log_likelihoods(selection.fits[-1].equations, selection.hypotheses)
    best = selection.hypotheses[int(np.argmax(scores))]
    noises = [(h.bias, score) for h, score in zip(selection.hypotheses, scores.tolist(), strict=True)]
    signal = selection.first.signal
    folds = _folds(selection, lambda part: SelectionByHand(part, *given, fitting.COMPARED_STEP))

    held_out = _held_out(selection, folds)

    def calibrated(fit: fitting.FitByHand) -> SensorCalibration:
        return calibration_of(model, fit, calibration, case.settings)

    def advice(verdict: Verdict) -> str:
        if verdict == Verdict.NOT_ENOUGH_DATA:
            return f"{MORE_RESTS}{WITH_FACES if case.settings.procedure.faces else ''}"
        if left_over is not None and (left_over > FIRM or verdict == Verdict.UNEXPLAINED):
            return _of_scatter(_suspects(selection, hidden), left_over)
        warmth = catalogue()["bias_temperature"]
        return f"to make bias temperature observable: record {warmth.excitation}" if warmth.name in hidden else ""

    added_variable = added_variable_of_rests(selection) if selection.names else None
    diagnosis = SensorDiagnosis(
        verdict_of_selection_by_hand(selection.names, unknown, left_over),
        case.configured,
        over,
        selection.names,
        not_observable=hidden,
        unexplained=unknown,
        wander=wander_of(noises, float(np.sqrt(np.mean(model.white**2))), noise, float(best.scatter[0])),
        method_errors=given_differences(
            calibration, lambda: calibrated(selection.fits[0]), case.recordings, case.settings
        ),
        details={
            "pictures": {"added_variable": added_variable, "unexplained": []},
            "cross_validation": _cross_validation(selection, folds),
            "open_if_slow": slow_by_hand(selection, hidden),
        },
    )
    return Findings(
        sensor=case.sensor,
        diagnosis=diagnosis,
        steps=selection.steps,
        alone=selection.first.scores,
        fitted=estimates(selection.fits[-1].state.terms, selection.fits[-1].covariance),
        limits=selection.limits,
        answers=posterior(selection, never_shown(hidden, selection.names)),
        shares=lambda name: _shares(selection, name),
        squares=chi,
        drop_alone=lambda name: float(signal[name] @ signal[name]) if name in signal else 0.0,
        excess=max(chi[0] - (len(selection.fits[0].residual) - selection.fits[0].rank), chi[0] - chi[-1]),
        held_out=held_out.errors,
        harmful=held_out.harmful(selection.names) | _too_few(selection, case),
        left_over_noise=left_over,
        advice=advice,
        full=(lambda: calibrated(selection.fits[-1])) if selection.names else None,
    )


def _model_of_all_rests(case: DiagnosisInput) -> Model:
    """Return the model with no rest held out.

    The accelerometer is calibrated again by all rests, which shows rests that contradict the others, unless it has
    effects or all rests do not determine it. One that is given stays as it is, because the gyroscope refers to it.
    """
    settings = case.settings.replaced(procedure=case.settings.procedure.replaced(holdout_every=0))

    def with_all_rests(fitted: SensorCalibration, noise: Noise | None) -> SensorCalibration:
        if fitted.effects:
            return fitted
        noise = noise or noise_of("accelerometer", case.recordings, settings.sensor.accelerometer)
        recordings = UnitRecordings([*case.recordings], {"accelerometer": noise})
        try:
            return nonlinear_least_squares.fit(StageInput("accelerometer", recordings, None, settings))
        except PipelineError:
            return fitted

    calibration, other = case.calibration, None
    if case.sensor == "accelerometer":
        calibration = with_all_rests(calibration, case.noise)
    elif case.accelerometer and is_given("accelerometer", settings.method):
        other = case.accelerometer
    elif case.accelerometer:
        other = with_all_rests(case.accelerometer, None)
    return require_model(case.recordings, calibration, case.noise, settings, other)


def require_model(
    recordings: Sequence[Recording],
    calibration: SensorCalibration,
    noise: Noise,
    settings: Settings,
    accelerometer: SensorCalibration | None = None,
) -> Model:
    """Return the model of rests and moves; see ``pipeline.estimation.effects.model_of``.

    Raises ``NotObservableError`` if there are no rests, or if they do not determine bias and matrix.
    """
    try:
        model = model_of(recordings, calibration, noise, settings, accelerometer)
    except CannotCalibrateError as lack:
        raise NotObservableError(lack.message) from lack
    if model is None:
        raise NotObservableError(f"no recording holds a rest with readings of the {calibration.sensor}")
    return model


def _without_creep(case: DiagnosisInput) -> Noise:
    """Return the noise, with the wander of the sensor file unless a static recording determined it.

    In rests by hand a slow change of the attitude moves gravity between the axes and looks like a wander of the bias.
    """
    noise, data_sheet = case.noise, case.data_sheet
    if noise.source == "static":
        return noise
    wander = np.full(3, data_sheet.bias_wander)
    return replace(noise, wander=wander, correlation_time=data_sheet.wander_time_s)


def _shares(selection: SelectionByHand, name: str) -> dict[str, float]:
    scored = selection.own[name] if name in selection.names else selection.first
    signal = scored.signal.get(name)
    if signal is None or not signal.any():
        return {}
    power = float(signal @ signal)
    others = {other: shown for other, shown in scored.shown.items() if other != name}
    return {other: min(float(np.sum((shown.T @ signal) ** 2)) / power, 1.0) for other, shown in others.items()}


def _over_noise(model: Model, equations: Equations, expected: NoiseHypothesis) -> float | None:
    """Return the rms residual of the rests over that of noise alone; None without a degree of freedom."""
    rests = slice(model.rests_equations)
    L = cholesky(equations.covariance(expected)[rests, rests])
    columns = np.asarray(np.linalg.solve(L, equations.columns[rests]), np.float64)
    readings = np.asarray(np.linalg.solve(L, equations.residual[rests]), np.float64)
    factors = ScaledColumns.of(columns, fitting.MIN_NEW_NORM_SHARE)
    residual, freedom = readings - columns @ factors.solve(readings), len(readings) - factors.rank
    return float(np.sqrt(residual @ residual / freedom)) if freedom > 0 else None


def _held_out(selection: SelectionByHand, folds: Sequence[Fold]) -> LeftOut:
    """Return the errors of each fit of the selection on rests and moves that are left out of it in turn."""
    if not folds:  # a recording for validation, or nothing is selected
        squares = [selection.model.held_out_squares(each.state) for each in selection.fits]
        return LeftOut(squares, judged=[bool(selection.names) and len(squares[0]) > 0] * len(squares))

    def known(k: int, count: int) -> fitting.FitByHand | None:
        same = folds[k][0].names[:count] == selection.names[:count]
        return folds[k][0].fits[count] if same else None

    return left_out(selection, [(fold.model, held) for fold, held in folds], known)


def _too_few(selection: SelectionByHand, case: DiagnosisInput) -> dict[str, str]:
    """Return the selected effects that the rests of the published fit do not determine, with the reason.

    The selection uses the rests that are held out of that fit, too.
    """
    rests = len(selection.model.rests.time)
    used = rests - sum(map(len, held_out_rests(case.recordings, case.settings.procedure).values()))
    pairs = zip(selection.names, selection.fits[1:], strict=True)
    return {
        name: f"the {used} rests of the fit are too few for it: {fit.more_rests}, or hold none out "
        "(procedure.holdout_every=0)"
        for name, fit in pairs
        if len(fit.residual) * used <= fit.rank * rests
    }


def _cross_validation(selection: SelectionByHand, folds: Sequence[Fold]) -> dict[str, Any] | None:
    """Return the errors of the whole procedure, selection included, on rests that are left out of it in turn.

    ``folds``, ``error_before, error_after`` (rms, g or deg/s), and ``named``: the number of folds that selected each
    effect. None if there are no folds.
    """
    if not folds:
        return None
    named = Counter(name for fold, _ in folds for name in fold.names)
    squares = [[fold.model.held_out_squares(fold.fits[k].state).sum() for k in (0, -1)] for fold, _ in folds]
    before, after = np.sqrt(np.sum(squares, axis=0) / len(selection.model.rests.time)).tolist()
    return {"folds": REST_FOLDS, "error_before": before, "error_after": after, "named": dict(named)}


def _folds(selection: SelectionByHand, select: Callable[[Model], SelectionByHand]) -> list[Fold]:
    """Return the selections that leave out every third rest in turn, each with the rests left out.

    Empty if nothing was selected, if there is a recording for validation, or with too few rests, as in one soak.
    """
    model = selection.model
    if not selection.names or len(model.held_out_squares(selection.fits[0].state)):
        return []
    return [(select(model.without(rests)), rests) for rests in rests_in_turn(model)]


def _dependences(selection: SelectionByHand) -> list[Dependence]:
    """Return the covariates on which the residual depends, the clearest first.

    Where that is heating against cooling, curves of time and temperature follow from it, and are left out. A lag of the
    thermometer, which has a gate of its own, looks alike (``is_hysteresis``): if it is one, these are the covariates on
    which the residual depends beside the lag.
    """
    model, rests = selection.model, selection.model.rests
    tests: list[tuple[str, Sequence[str]]] = []  # covariate and formulas of its curves
    for covariate, values in (("time", rests.time), ("temperature", rests.temperature)):
        known = rests.clock_shared if covariate == "time" else not np.isnan(values).any()
        if known and np.ptp(values) > LEAST_SPAN:
            powers = forms.powers(forms.Span(covariate, values), covariate)
            tests += [(covariate, powers[:degree]) for degree in (2, 3)]
    if model.sensor == "accelerometer":
        tests.append(("specific_force", FORCE))
    curves = []
    for covariate, formulas in tests:
        terms = {f"c{k}": {"formula": text, "unit": "1"} for k, text in enumerate(formulas)}
        own = {"name": f"curves_of_{covariate}", "owner": "recording", "sensors": [model.sensor], "terms": terms}
        definition = effect_from({**own, "meaning": "Curves."}, "a test of the residual")
        curves.append(EffectColumns(definition, np.zeros(3 * len(formulas))))
    state = selection.fits[-1].state
    loops = loops_of(model, state.terms)
    tests += [(HYSTERESIS, ())] if loops else []
    equations = model.equations(state, [*curves, *loops])
    possible = selection.ceilings > selection.fits[-1].log_likelihood - fitting.CEILING_TO
    hypotheses = [selection.hypotheses[i] for i in np.flatnonzero(possible)]

    def dependences(judged: Sequence[tuple[float, float]]) -> list[Dependence]:
        results = [(test, *found) for (test, _), found in zip(tests, judged, strict=False)]
        return [Dependence(name, p) for name, (_, p) in significant(results).items()]

    judged = fitting.judged_curves(equations, hypotheses)
    found = dependences(judged)
    if HYSTERESIS not in [each.covariate for each in found]:
        return found
    if not is_hysteresis(judged[-2:]):
        *others, _, lag = equations.candidates
        given = replace(equations, effects=[*equations.effects, lag], candidates=others)
        return dependences(fitting.judged_curves(given, hypotheses))
    return found[:1] if found[0].covariate == HYSTERESIS else found


def _suspects(selection: SelectionByHand, hidden: Mapping[str, str]) -> list[str]:
    """Return the effects that are not observable, but could be a cause of the residual, the likeliest first.

    The effect shows in the equations, and at its limits explains at least the share ``WORTH`` of the residual's mean
    square; or it depends on the temperature, which was not recorded or did not change enough.
    """
    first, n = selection.first, len(selection.fits[0].residual)

    def possible(name: str) -> bool:
        if "temperature" in catalogue()[name].needs:
            return bool(np.isnan(selection.model.rests.temperature).any()) or name in first.scores
        return name in first.scores and first.visible[name] >= first.spare[name] * n * float(np.log1p(WORTH))

    def unlikely(name: str) -> float:
        return -first.scores[name].delta_bic if name in first.scores else float("inf")

    return sorted((name for name in hidden if possible(name)), key=unlikely)


def _of_scatter(suspects: Sequence[str], over_noise: float) -> str:
    """Return what to record if the rests scatter more than the noise and no observable effect explains it."""
    scatter = f"the rests scatter {over_noise:.2g} times the noise"
    if not suspects:
        return f"set the unit down firmly for each rest: {scatter} and follow nothing that is recorded"
    names = listed([plain(name) for name in suspects[:MAX_NAMED_EFFECTS]], "or")
    warm = any("temperature" in catalogue()[name].needs for name in suspects)
    temperature = ", with the temperature of the sensor" if warm else ""
    return f"{MORE_RESTS}{temperature}: {scatter}, and they cannot distinguish an unsteady hand from {names}"
