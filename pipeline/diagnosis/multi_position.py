"""What the selection finds in rests and moves by hand, where no table logged the motion.

The residual of the rests is compared with white noise and the expected bias instability. How firmly a unit
rests by hand is not known, so that a scatter of the rests beyond that is reported, but alone is no sign of a missing
effect.

Twenty rests are too few to keep every third from a selection. So the selection uses all of them, and cross-validation
judges it: of ``FOLDS`` models each leaves out every third rest with the move before it. ``held_out_error`` of a ranking
is that of the selected effects, fitted without those rests; ``cross_validation`` repeats the selection without them.

A residual depends on time, temperature (powers 1 to 2 or 3 over their span) or the axis' own specific force (Chebyshev
polynomials of degree 4 and 5) where curves with coefficients of their own in every axis have delta BIC > 10 and
m p < 1e-3, m the number of all tests.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from pipeline.diagnosis import functional_forms as forms
from pipeline.diagnosis.findings import Case, Findings
from pipeline.diagnosis.method_errors import given_differences
from pipeline.diagnosis.observability import MORE, never_shown, not_observable_by_hand
from pipeline.diagnosis.residual_dependence import GATE_P
from pipeline.diagnosis.residual_plots import added_variable_of_rests
from pipeline.diagnosis.words import listed, plain
from pipeline.errors import CannotCalibrateError, NotObservableError, PipelineError
from pipeline.estimation.accelerometer import nonlinear_least_squares
from pipeline.estimation.design import Term
from pipeline.estimation.gauss_markov import WHITE, Setting
from pipeline.estimation.least_squares import ScaledColumns
from pipeline.estimation.multi_position.fit import Fit, fit
from pipeline.estimation.multi_position.model import NEW, NoiseHypothesis, project_out
from pipeline.estimation.multi_position.result import calibration_of, model_of
from pipeline.estimation.multi_position.selection import FAR, Selection, posterior
from pipeline.estimation.selection import GATE_BIC
from pipeline.model.effects import catalogue, effect, effect_from

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from pipeline.estimation.multi_position.model import Model, State
    from pipeline.records import Mask, Noise, Recording, SensorCalibration

NEEDED = MORE
FAR_ABOVE = 10.0  # times the noise: no unit that somebody sets down or holds rests so badly
BESIDE_FACES = ", beside those on the six faces: bias and matrix need the faces and turns alone, an effect needs more"
FOLDS = 3  # as every third rest is held out of a published fit (procedure.holdout_every)
SPARE = 2  # equations beyond the parameters, from which on a fold is judged
LEAST_SPAN = 1.0  # s or degC: of a covariate
FORCE = ("8 * u ** 4 - 8 * u ** 2 + 1", "16 * u ** 5 - 20 * u ** 3 + 5 * u")  # Chebyshev polynomials of u in g
WORTH = 0.25  # share of the residual's mean square, of what could be its cause
MOST_NAMED = 3  # effects in a sentence
FIRM = 2.0  # times the noise, above which the scatter of the rests is worth a word


def findings(case: Case) -> Findings:
    """Return what the selection finds in rests and moves by hand; as ``require_model``."""
    model, calibration = _model_of_all_rests(case), case.calibration
    given = calibration, case.configured, case.noise, case.sensor_config
    selection = Selection(model, *given)
    expected = _without_creep(case.noise, case.sensor_config)
    hidden, unknown = not_observable_by_hand(selection, case.configured), dependences(selection)
    chi = [_chi(selection, fit, expected) for fit in selection.fits]
    over, left_over = (_over_noise(selection, selection.fits[k], expected) for k in (0, -1))
    verdict = "missing_effect" if selection.names else "nothing_missing"
    if (unknown and not selection.names) or (left_over or 0.0) > FAR_ABOVE:
        verdict = "unexplained"
    likely = project_out(model.equations(selection.fits[-1].state), selection.hypotheses).scores()
    best = selection.hypotheses[int(np.argmax(likely))]
    signal = selection.first.signal

    def calibrated(fit: Fit) -> SensorCalibration:
        return calibration_of(model, fit, calibration, case.settings)

    def advice(verdict: str) -> str:
        if verdict == "not_enough_data":
            return f"{MORE}{BESIDE_FACES if case.settings['procedure'].get('faces') else ''}"
        if left_over is not None and (left_over > FIRM or verdict == "unexplained"):
            return _of_scatter(_suspects(selection, hidden), left_over)
        warmth = catalogue()["bias_temperature"]
        return f"to make bias temperature observable: record {warmth.excitation}" if warmth.name in hidden else ""

    return Findings(
        sensor=case.sensor,
        selected=selection.names,
        verdict=verdict,
        steps=selection.steps,
        alone=selection.first.scores,
        terms=selection.fits[-1].state.terms,
        covariance=selection.fits[-1].covariance,
        limits=selection.limits,
        answers=posterior(selection, never_shown(hidden, selection.names)),
        shares=lambda name: _shares(selection, name),
        left=chi,
        drop_alone=lambda name: float(signal[name] @ signal[name]) if name in signal else 0.0,
        excess=max(chi[0] - (len(selection.fits[0].residual) - selection.fits[0].rank), chi[0] - chi[-1]),
        held_out=_held_out_errors(selection) if selection.names else [None],
        hidden=hidden,
        unknown=unknown,
        over_noise=over,
        left_over_noise=left_over,
        noises=[
            (h.bias.ratio, h.bias.time, score) for h, score in zip(selection.hypotheses, likely.tolist(), strict=True)
        ],
        white=float(np.sqrt(np.mean(model.white**2))),
        expected_wander=None if expected is None else float(np.sqrt(np.mean(expected.wander**2))),
        advice=advice,
        full=(lambda: calibrated(selection.fits[-1])) if selection.names else None,
        other=case.accelerometer if case.sensor == "gyroscope" else None,
        on_table=False,
        departures=[text for stage in calibration.stages for text in stage.details.get("departures", ())],
        scatter={"scatter_over_noise": float(best.scatter[0])},
        more={
            "pictures": {
                "added_variable": added_variable_of_rests(selection) if selection.names else None,
                "unexplained": [],
            },
            "method_errors": given_differences(
                calibration, lambda: calibrated(selection.fits[0]), case.recordings, case.settings
            ),
            "cross_validation": _nested(selection, lambda part: Selection(part, *given)),
        },
    )


def _model_of_all_rests(case: Case) -> Model:
    """Return the model with no rest held out.

    The accelerometer is calibrated by all rests, which shows those that contradict the others; it is taken as it is
    where it has effects, or where all rests do not determine it.
    """

    def with_all_rests(found: SensorCalibration, noise: Noise | None) -> SensorCalibration:
        known = {"noise": {"accelerometer": noise}} if noise is not None else {}
        if found.effects:
            return found
        try:
            return nonlinear_least_squares.fit(case.recordings, None, {**every, **known})
        except PipelineError:
            return found

    every = {**case.settings, "procedure": {**case.settings["procedure"], "holdout_every": 0}}
    if case.sensor == "accelerometer":
        return require_model(case.recordings, with_all_rests(case.calibration, case.noise), case.noise, every)
    other = case.accelerometer and with_all_rests(case.accelerometer, None)
    return require_model(case.recordings, case.calibration, case.noise, every, other)


def require_model(
    recordings: Sequence[Recording],
    calibration: SensorCalibration,
    noise: Noise | None,
    settings: Mapping[str, Any],
    accelerometer: SensorCalibration | None = None,
) -> Model:
    """Return the model of rests and moves; see ``pipeline.estimation.multi_position.result.model_of``.

    Raises ``NotObservableError`` if there are no rests, or they do not determine bias and matrix.
    """
    try:
        model = model_of(recordings, calibration, noise, settings, accelerometer)
    except CannotCalibrateError as lack:
        raise NotObservableError(lack.message) from lack
    if model is None:
        raise NotObservableError(f"no recording holds a rest with readings of the {calibration.sensor}")
    return model


def _without_creep(noise: Noise | None, sensor_config: Mapping[str, Any]) -> Noise | None:
    """Return the noise with the sensor file's wander, where only rests by hand determine one.

    A unit that creeps from its attitude moves gravity from one axis to another, which is no wander of a bias.
    """
    if noise is None or noise.source == "static":
        return noise
    wander = np.full(3, float(sensor_config.get("bias_wander") or 0.0))
    return replace(
        noise, wander=wander, correlation_time=float(sensor_config.get("wander_time_s") or noise.correlation_time)
    )


def _shares(selection: Selection, name: str) -> dict[str, float]:
    """Return the share of an effect's fitted signal that each other effect reproduces."""
    scored = selection.own[name] if name in selection.names else selection.first
    signal = scored.signal.get(name)
    if signal is None or not signal.any():
        return {}
    power = float(signal @ signal)
    others = {other: shown for other, shown in scored.shown.items() if other != name}
    return {other: min(float(np.sum((shown.T @ signal) ** 2)) / power, 1.0) for other, shown in others.items()}


def _expected(selection: Selection, noise: Noise | None) -> NoiseHypothesis:
    """Return the noise without scatter of the rests, with the wander that is expected."""
    nothing = (0.0,) * selection.model.kinds
    if noise is None:
        return NoiseHypothesis(WHITE, nothing)
    ratio = float(np.sqrt(np.mean(noise.wander**2) / np.mean(noise.white**2)))
    return NoiseHypothesis(Setting(ratio, noise.correlation_time), nothing)


def _chi(selection: Selection, fit: Fit, noise: Noise | None) -> float:
    """Return the sum of squares of a fit's residual, whitened by the expected noise and the scatter that is left."""
    expected = replace(_expected(selection, noise), scatter=selection.fits[-1].noise.scatter)
    found = project_out(selection.model.equations(fit.state), [expected])
    return float(np.sum(found.residual**2))


def _over_noise(selection: Selection, fit: Fit, noise: Noise | None) -> float | None:
    """Return the rms residual of the rests, of a fit, over that of noise alone; None without a degree of freedom."""
    equations, rests = selection.model.equations(fit.state), slice(selection.model.rests_equations)
    L = np.linalg.cholesky(equations.covariance(_expected(selection, noise))[rests, rests])
    columns, residual = (np.linalg.solve(L, v[rests]) for v in (equations.columns, equations.residual))
    factors = ScaledColumns.of(columns, NEW)
    left = residual - columns @ factors.solve(residual)
    return float(np.sqrt(left @ left / (len(left) - factors.rank))) if len(left) > factors.rank else None


def _held_out_errors(selection: Selection) -> list[float | None]:
    """Return the rms error, g or deg/s, of each of the selection's fits on rests that were left out of it in turn."""
    model = selection.model
    if model.held_out_error(selection.fits[0].state) is not None:  # a recording for validation
        return [model.held_out_error(found.state) for found in selection.fits]
    near = {n: FAR * limit for n, limit in selection.limits.items() if effect(n).nonlinear}
    errors: list[float | None] = []
    for found in selection.fits:
        folds = [(part, held, fit(part, found.state, selection.hypotheses, near)) for part, held in _folds(model)]
        judged = all(len(fitted.residual) >= fitted.rank + SPARE for _, _, fitted in folds)
        square = sum(_squared(part, fitted.state) * held for part, held, fitted in folds) / len(model.rests.time)
        errors.append(float(np.sqrt(square)) if judged else None)
    return errors


def _nested(selection: Selection, again: Callable[[Model], Selection]) -> dict[str, Any] | None:
    """Return the errors of the whole procedure, selection included, on rests that it does not see.

    ``folds``, ``error_before, error_after`` (rms, g or deg/s), and ``named``: the number of folds that selected each
    effect. None where nothing was selected, or a recording for validation judges.
    """
    model = selection.model
    if not selection.names or model.held_out_error(selection.fits[0].state) is not None:
        return None
    named: dict[str, int] = {}
    squares = np.zeros(2)
    for part, held in _folds(model):
        found = again(part)
        for name in found.names:
            named[name] = named.get(name, 0) + 1
        squares += held * np.array([_squared(part, found.fits[k].state) for k in (0, -1)])
    before, after = np.sqrt(squares / len(model.rests.time)).tolist()
    return {"folds": FOLDS, "error_before": before, "error_after": after, "named": named}


def _folds(model: Model) -> Iterator[tuple[Model, int]]:
    """Return the models that leave out every third rest in turn, and how many each leaves out."""
    fold = np.arange(len(model.rests.time)) % FOLDS
    for k in range(FOLDS):
        held: Mask = fold == k
        yield model.without(held), int(held.sum())


def _squared(model: Model, state: State) -> float:
    return (model.held_out_error(state) or 0.0) ** 2


def dependences(selection: Selection) -> list[dict[str, Any]]:
    """Return the covariates on which the residual still depends, each with its p-value, the likeliest first."""
    model = selection.model
    tests = _curves_of(selection)
    terms = [_curves(covariate, formulas, model.sensor) for covariate, formulas in tests]
    equations = model.equations(selection.fits[-1].state, terms)
    found = project_out(equations, selection.hypotheses)
    before, at = found.of_model()
    named: dict[str, tuple[float, float]] = {}
    for j, (covariate, _) in enumerate(tests):
        count = found.count(j, at)
        factor = found.correction(j, at, count, equations.scatter) if count else 0.0
        gain = factor * max(2.0 * (found.with_candidate(j)[0] - before), 0.0)
        delta = gain - count * float(np.log(len(equations.residual)))
        p = float(scipy.special.chdtrc(max(count, 1), gain))
        if delta > GATE_BIC and p * len(tests) < GATE_P and delta > named.get(covariate, (0.0, 1.0))[0]:
            named[covariate] = (delta, p)
    ordered = sorted(named.items(), key=lambda item: -item[1][0])
    return [{"covariate": name, "p_value": p} for name, (_, p) in ordered]


def _curves_of(selection: Selection) -> list[tuple[str, Sequence[str]]]:
    """Return the tests: a covariate and the formulas of its curves."""
    rests = selection.model.rests
    tests: list[tuple[str, Sequence[str]]] = []
    for covariate, values in (("time", rests.time), ("temperature", rests.temperature)):
        known = rests.clock_shared if covariate == "time" else not np.isnan(values).any()
        if known and np.ptp(values) > LEAST_SPAN:
            powers = forms.powers(forms.Span(covariate, np.sort(values)), covariate)
            tests += [(covariate, powers[:degree]) for degree in (2, 3)]
    return [*tests, ("specific_force", FORCE)] if selection.model.sensor == "accelerometer" else tests


def _curves(covariate: str, formulas: Sequence[str], sensor: str) -> Term:
    """Return curves with coefficients of their own in every axis, as an effect of size 0."""
    terms = {f"c{k}": {"formula": text, "unit": "1"} for k, text in enumerate(formulas)}
    known = {"name": f"curves_of_{covariate}", "owner": "recording", "sensors": [sensor], "meaning": "Curves."}
    return Term(effect_from({**known, "terms": terms}, "a test of the residual"), np.zeros(3 * len(formulas)))


def _suspects(selection: Selection, hidden: Mapping[str, str]) -> list[str]:
    """Return the effects that these recordings cannot distinguish, and that could be what the residual holds.

    Such an effect shows in the equations, and at its limits it brings at least the share ``WORTH`` of the mean square
    that is left; or it goes with the temperature, which was not recorded or did not change enough.
    """
    first, n = selection.first, len(selection.fits[0].residual)

    def could(name: str) -> bool:
        if "temperature" in catalogue()[name].needs:
            return bool(np.isnan(selection.model.rests.temperature).any()) or name in first.scores
        return name in first.scores and first.visible[name] >= first.spare[name] * n * float(np.log1p(WORTH))

    def brings(name: str) -> float:
        return -first.scores[name].delta_bic if name in first.scores else float("inf")

    return sorted((name for name in hidden if could(name)), key=brings)


def _of_scatter(names: Sequence[str], over_noise: float) -> str:
    """Return what to record where the rests scatter more than the noise, and nothing that can be seen explains it."""
    many = f"the rests scatter {over_noise:.2g} times the noise"
    if not names:
        return f"set the unit down firmly for each rest: {many} and follow nothing that is recorded"
    alike = listed([plain(name) for name in names[:MOST_NAMED]], "or")
    warm = any("temperature" in catalogue()[name].needs for name in names)
    temperature = ", with the temperature of the sensor" if warm else ""
    return f"{MORE}{temperature}: {many}, and they cannot distinguish an unsteady hand from {alike}"
