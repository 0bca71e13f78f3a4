"""Which physical effect is missing from a calibration by rests and moves, where no table logged the motion.

The selection is ``pipeline.estimation.multi_position.selection``; here it becomes the document that
``pipeline.diagnosis.diagnose`` makes of a table's recordings. The residual of the rests is compared with white noise
and the expected bias instability. Nobody states how firmly a unit rests by hand, so that a scatter of the rests beyond
that is reported, but is by itself no sign of a missing effect.

Twenty rests are too few to keep every third from a selection. So the selection uses all of them, and cross-validation
judges it: of ``FOLDS`` models each leaves out every third rest with the move before it. ``held_out_error`` of a ranking
is that of the selected effects, fitted without those rests; ``cross_validation`` repeats the selection without them.
The published calibration keeps its own every third rest out and uses nothing of this.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.diagnosis.residual_trends import added_variable, dependences
from pipeline.diagnosis.unobservable_effects import hidden_effects, next_experiment, not_enough_data
from pipeline.diagnosis.verdict import evidence_of, judged
from pipeline.errors import CannotCalibrateError, PipelineError
from pipeline.estimation.accelerometer import nonlinear_least_squares
from pipeline.estimation.multi_position.fit import fit
from pipeline.estimation.multi_position.likelihood import NoiseHypothesis, project_out
from pipeline.estimation.multi_position.result import AUTO, calibration_of, model_of
from pipeline.estimation.multi_position.selection import FAR, select
from pipeline.estimation.selection import ALIKE, EVIDENCE, GATE_BIC, INFLATED
from pipeline.model.effects import effect

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.multi_position.fit import Fit
    from pipeline.estimation.multi_position.model import Model, State
    from pipeline.estimation.multi_position.selection import Scored, Selection
    from pipeline.estimation.ranking import Score
    from pipeline.records import Noise, Recording, SensorCalibration

FAR_ABOVE = 10.0  # times the noise: no unit that somebody sets down or holds rests so badly
FOLDS = 3
SPARE = 2  # equations beyond the parameters, from which on a fold is judged


def diagnose_multi_position(
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
    recordings : sequence of Recording
        All of the unit.
    noise : Noise or None
    settings : mapping
        Sections ``sensor``, ``table``, ``procedure`` and ``effects``.
    accelerometer : SensorCalibration, optional
        For the gyroscope, which needs the direction of gravity; without it, it is calibrated again.
    validation : mapping, optional
        The sensor's part of ``validations/<unit>.json``; without it, a free fit stands for the
        calibration.

    Returns
    -------
    dict
        As of ``pipeline.diagnosis.diagnose.diagnose``, and ``cross_validation``.
    """
    sensor = calibration.sensor
    wanted = settings["effects"][sensor]
    configured = [] if wanted == AUTO else list(wanted)
    try:
        every = {**settings, "procedure": {**settings["procedure"], "holdout_every": 0}}
        if sensor == "accelerometer":
            known = _with_all_rests(calibration, recordings, noise, every)
            model = model_of(recordings, known, noise, every)
        else:
            felt = accelerometer and _with_all_rests(accelerometer, recordings, None, every)
            model = model_of(recordings, calibration, noise, every, felt)
        why = "" if model else f"no recording holds a rest with readings of the {sensor}"
    except CannotCalibrateError as lack:
        model, why = None, lack.message
    if model is None:
        nothing = not_enough_data(sensor, configured, why)
        return judged(nothing, evidence_of(nothing, sensor, recordings, noise, settings, validation))
    sheet = settings["sensor"][sensor]
    selection = select(model, calibration, configured, noise, sheet)
    expected = _without_creep(noise, sheet)
    document = _document(selection, configured, expected)
    document["cross_validation"] = _nested(selection, calibration, configured, noise, sheet)
    names = selection.names
    found = evidence_of(
        document,
        sensor,
        recordings,
        noise,
        settings,
        validation,
        other=accelerometer if sensor == "gyroscope" else None,
        full=(lambda: calibration_of(model, selection.fits[-1], calibration, settings)) if names else None,
    )
    left = _over_noise(selection, selection.fits[-1], expected)
    return judged(document, replace(found, left_over_noise=left, on_table=False))


def _without_creep(noise: Noise | None, sheet: Mapping[str, Any]) -> Noise | None:
    """Return the noise with the data sheet's wander, where only rests by hand tell one.

    A unit that creeps from its attitude moves gravity from one axis to another, which is no wander of a bias.
    """
    if noise is None or noise.source == "static":
        return noise
    wander = np.full(3, float(sheet.get("bias_wander") or 0.0))
    return replace(noise, wander=wander, correlation_time=float(sheet.get("wander_time_s") or noise.correlation_time))


def _document(selection: Selection, configured: list[str], noise: Noise | None) -> dict[str, Any]:
    sensor, selected = selection.model.sensor, selection.names
    hidden = hidden_effects(selection, configured)
    unknown = dependences(selection)
    held = _held_out_errors(selection) if selected else [None]
    seen = [s for s in selection.first.scores.values() if s.name not in selected and s.name not in hidden]
    order = [*selected, *(s.name for s in sorted(seen, key=lambda s: -s.delta_bic))]
    chi = [_chi(selection, fit, noise) for fit in selection.fits]
    ranking = [_entry(selection, name, held, chi) for name in order]
    verdict = "missing_effect" if selected else "nothing_missing" if ranking else "not_enough_data"
    over = _over_noise(selection, selection.fits[0], noise)
    left = _over_noise(selection, selection.fits[-1], noise)
    if (unknown and not selected) or left > FAR_ABOVE:
        verdict = "unexplained"
    return {
        "verdict": verdict,
        "residual_over_noise": over,
        "selected": list(selected),
        "ranking": ranking,
        "not_observable": [{"effect": name, "reason": reason} for name, reason in hidden.items()],
        "unexplained": unknown,
        "suggested_effect": None,
        "next_experiment": next_experiment(selection, verdict, ranking, hidden, unknown=unknown, over_noise=left),
        "override": f"effects.{sensor}=[{','.join([*configured, *selected])}]" if selected else "",
        "configured": configured,
        "wander": _wander(selection, noise),
        "pictures": {"added_variable": added_variable(selection), "unexplained": []},
        "method_errors": [],
    }


def _entry(selection: Selection, name: str, held: Sequence[float | None], chi: Sequence[float]) -> dict[str, Any]:
    """Return one line of the ranking."""
    score = selection.steps.get(name) or selection.first.scores[name]
    before = after = None
    scored, drop = selection.first, 0.0
    if name in selection.names:
        step = selection.names.index(name)
        before, after = held[step], held[step + 1]
        scored, drop = selection.own[name], chi[step] - chi[step + 1]
    elif name in scored.signal:
        drop = float(scored.signal[name] @ scored.signal[name])
    return {
        "effect": name,
        "delta_bic": score.delta_bic,
        "p_value": score.p_value,
        "parameters": _parameters(selection, score),
        "explained_share": _share(drop, chi, len(selection.fits[0].residual) - selection.fits[0].rank),
        "held_out_error_before": before,
        "held_out_error_after": after,
        "look_alikes": _look_alikes(scored, score) if score.delta_bic > GATE_BIC else [],
        "plausible": score.plausible,
    }


def _share(drop: float, chi: Sequence[float], spare: int) -> float:
    excess = max(chi[0] - spare, chi[0] - chi[-1], drop)
    return float(np.clip(drop / excess, 0.0, 1.0)) if excess > 0 else 0.0


def _parameters(selection: Selection, score: Score) -> dict[str, dict[str, Any]]:
    """Return the estimates: of the fit of all selected effects, or of the effect alone."""
    values, uncertainty = score.values, score.uncertainty
    found = selection.fits[-1]
    at = selection.model.directions.shape[1]
    for term in found.state.terms:
        own = slice(at, at + len(term.values))
        if term.effect.name == score.name and score.name in selection.names:
            values, uncertainty = term.values, np.sqrt(np.clip(np.diag(found.covariance)[own], 0.0, None))
        at = own.stop
    described = effect(score.name).parameters(selection.model.sensor)
    return {
        p.name: {"value": float(v), "unit": p.unit, "standard_uncertainty": float(u) if u > 0 else None}
        for p, v, u in zip(described, values, uncertainty, strict=True)
    }


def _look_alikes(scored: Scored, score: Score) -> list[dict[str, Any]]:
    """Return the effects that reproduce most of an effect's fitted signal."""
    signal = scored.signal.get(score.name)
    power = 0.0 if signal is None else float(signal @ signal)
    if signal is None or power == 0.0:
        return []
    shares = {
        name: float(np.sum((shown.T @ signal) ** 2)) / power
        for name, shown in scored.shown.items()
        if name != score.name
    }
    alike = sorted(((share, name) for name, share in shares.items() if share > ALIKE), reverse=True)
    return [{"effect": name, "share": min(share, 1.0)} for share, name in alike]


def _expected(selection: Selection, noise: Noise | None) -> NoiseHypothesis:
    """Return the noise without scatter of the rests, with the wander that is expected."""
    nothing = (0.0,) * selection.model.kinds
    if noise is None:
        return NoiseHypothesis(0.0, 1.0, nothing, 0.0)
    ratio = float(np.sqrt(np.mean(noise.wander**2) / np.mean(noise.white**2)))
    return NoiseHypothesis(ratio, noise.correlation_time, nothing, 0.0)


def _chi(selection: Selection, fit: Fit, noise: Noise | None) -> float:
    """Return the sum of squares of a fit's residual, whitened by the expected noise and the scatter that is left."""
    expected = replace(_expected(selection, noise), scatter=selection.fits[-1].noise.scatter)
    found = project_out(selection.model.equations(fit.state), [expected])
    return float(np.sum(found.residual**2))


def _over_noise(selection: Selection, fit: Fit, noise: Noise | None) -> float:
    """Return the rms residual of the rests, of a fit, over that of noise alone."""
    equations = selection.model.equations(fit.state)
    at_rest = equations.rows(selection.model.rests_equations)
    found = project_out(at_rest, [_expected(selection, noise)])
    spare = max(len(at_rest.residual) - float(np.sum(found.basis[0] ** 2)), 1.0)
    return float(np.sqrt(np.sum(found.residual**2) / spare))


def _wander(selection: Selection, noise: Noise | None) -> dict[str, Any]:
    """Return the wander and the scatter of the rests under which the whole model explains the readings best."""
    found = project_out(selection.model.equations(selection.fits[-1].state), selection.hypotheses)
    scores = found.scores()
    best = selection.hypotheses[int(np.argmax(scores))]
    white = float(np.sqrt(np.mean(selection.model.white**2)))
    expected = None if noise is None else float(np.sqrt(np.mean(noise.wander**2)))
    inflated = False
    if expected is not None:
        most = INFLATED * expected / white
        believed = [score for score, n in zip(scores, selection.hypotheses, strict=True) if n.ratio <= most]
        inflated = best.ratio > most and (not believed or bool(scores.max() - max(believed) > EVIDENCE))
    return {
        "ratio": float(best.ratio),
        "time_s": float(best.time) if best.ratio else None,
        "standard_deviation": float(best.ratio * white),
        "expected": expected,
        "inflated": bool(inflated),
        "scatter_over_noise": float(best.scatter[0]),
    }


def _with_all_rests(
    accelerometer: SensorCalibration, recordings: Sequence[Recording], noise: Noise | None, settings: Mapping[str, Any]
) -> SensorCalibration:
    """Return the accelerometer's calibration by all rests, which shows those that contradict the others.

    It is returned as it is where it has effects, or where all rests do not determine it.
    """
    known = {"noise": {"accelerometer": noise}} if noise is not None else {}
    if accelerometer.effects:
        return accelerometer
    try:
        return nonlinear_least_squares.fit(recordings, None, {**settings, **known})
    except PipelineError:
        return accelerometer


def _held_out_errors(selection: Selection) -> list[float | None]:
    """Return the rms error, g or deg/s, of each of the selection's fits on rests that were left out of it in turn."""
    model = selection.model
    if model.held_out_error(selection.fits[0].state) is not None:  # a recording for validation
        return [model.held_out_error(found.state) for found in selection.fits]
    near = {n: FAR * limit for n, limit in selection.limits.items() if effect(n).nonlinear}
    errors = []
    for found in selection.fits:
        squares: list[float] = []
        for part, held in _folds(model):
            fitted = fit(part, found.state, selection.hypotheses, near)
            if len(fitted.residual) < fitted.rank + SPARE:
                squares = []
                break
            squares.append(_squared(part, fitted.state) * held)
        errors.append(float(np.sqrt(np.sum(squares) / len(model.rests.time))) if squares else None)
    return errors


def _nested(
    selection: Selection, start: SensorCalibration, configured: Sequence[str], noise: Noise | None,
    sheet: Mapping[str, Any],
) -> dict[str, Any] | None:  # fmt: skip
    """Return the errors of the whole procedure, selection included, on rests that it does not see.

    Returns
    -------
    dict or None
        ``folds``, ``error_before, error_after`` (rms, g or deg/s), and ``named``: the number of folds that selected
        each effect. None where nothing was selected, or a recording for validation judges.
    """
    model = selection.model
    if not selection.names or model.held_out_error(selection.fits[0].state) is not None:
        return None
    named: dict[str, int] = {}
    squares = np.zeros(2)
    for part, held in _folds(model):
        found = select(part, start, configured, noise, sheet)
        for name in found.names:
            named[name] = named.get(name, 0) + 1
        squares += held * np.array([_squared(part, found.fits[k].state) for k in (0, -1)])
    before, after = np.sqrt(squares / len(model.rests.time)).tolist()
    return {"folds": FOLDS, "error_before": before, "error_after": after, "named": named}


def _folds(model: Model) -> Iterator[tuple[Model, int]]:
    """Return the models that leave out every third rest in turn, and how many each leaves out."""
    fold = np.arange(len(model.rests.time)) % FOLDS
    for k in range(FOLDS):
        held: NDArray[np.bool_] = fold == k
        yield model.without(held), int(held.sum())


def _squared(model: Model, state: State) -> float:
    error = model.held_out_error(state)
    return 0.0 if error is None else error**2
