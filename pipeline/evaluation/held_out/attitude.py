"""Errors of an attitude that is integrated from the readings of held-out motion, before and after calibration.

The attitude q by the gyroscope alone starts at the table's attitude. Over one interval it turns by the rotation vector
a[n], with rates w in rad/s that are interpolated by a cubic (Magnus expansion: A. Iserles et al., Lie-group methods,
Acta Numerica 9, 2000):

    q[n+1] = q[n] exp(a[n] / 2)
    a[n] = dt (13 w[n] + 13 w[n+1] - w[n-1] - w[n+2]) / 24 + dt^2 (w[n] x w[n+1]) / 12

The drift is the angle between integrated and logged rotation over one minute, root mean square over many starts. The
tilt is the angle between the verticals of the logged attitude and of one that is fused with the accelerometer
(complementary filter of ``imufusion``; S. Madgwick, PhD thesis, Bristol 2014, chapter 7). By hand, each held-out move
is integrated from the rest before it to the rest after it: the error is the angle between the turned direction of
gravity and the observed one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.core.errors import InputError
from pipeline.core.records import (
    BASE,
    BIAS,
    FEWEST_MOVES,
    MATRIX,
    Integers,
    Noise,
    Recording,
    SensorCalibration,
    StageDetails,
    Values,
    continuous,
    cross,
    finite_rows,
    level_in_body,
    median,
)
from pipeline.core.settings import Procedure
from pipeline.estimation.design import EffectColumns
from pipeline.estimation.engine import cholesky, draw_normal
from pipeline.estimation.multi_position.accelerometer import white_of
from pipeline.estimation.multi_position.faces_and_turns import TurnsByHand, turns_of
from pipeline.estimation.multi_position.gyroscope import GyroscopeModel
from pipeline.estimation.multi_position.model import EquationBlock, State
from pipeline.estimation.multi_position.moves import moves_of, observed_rests
from pipeline.estimation.rest_means import HELD_OUT, ROLE, is_multi_position, rests_of
from pipeline.estimation.uncertainty_budget import covariance_without_reference
from pipeline.evaluation.held_out.error_breakdown import NORMAL_FREEDOM, TAIL
from pipeline.physics.compensation import Compensation
from pipeline.physics.effects import effect
from pipeline.physics.effects.base import length

DRIFT_TIME_S = 60.0  # s over which a drift is stated
DRIFT_STARTS = 60  # starts over which a drift is averaged
SHORTEST_DRIFT_S = 10.0  # s: a drift over a shorter time is mostly noise
INTEGRATED = 50_000  # samples that are integrated at once
CURVE_POINTS = 120  # points of the published curves
# largest steps of the complementary filter, which integrates to first order
MAX_FILTER_STEP_S, MAX_FILTER_STEP_DEG = 0.1, 5.0
STEADY_HAND = 3.0  # times the noise: largest scatter of moves that explains errors; 289 good hands fitted none
INTERVAL_DRAWS = 4000  # of errors of moves: 20 are beyond their 99 % interval
FILTER_GAIN = 0.5  # of the complementary filter: its library's default
NO_HAND = "not recorded by hand"
TILT_SETTLING_S = 10.0  # s after which the tilt counts


def attitude(
    accelerometer: SensorCalibration | None, gyroscope: SensorCalibration | None, recordings: Sequence[Recording]
) -> dict[str, Any]:
    """Return the part ``attitude`` of ``validations/<unit>.json``, from the first held-out recording of an attitude.

    It has ``reason`` (why there is none, else None), ``recording``, ``seconds`` (60, or the recording's length),
    ``drift_deg`` and ``tilt_rms_deg`` (each ``before`` and ``after``) and ``curve``: ``time_s`` and, deg, the error of
    the gyroscope alone (``drift_before``, ``drift_after``) and the tilt of the fused attitude (``tilt_...``).
    """
    recording = next((r for r in recordings if r.role == "validation" and r.table_attitude is not None), None)
    if recording is None:
        return {"reason": "no held-out recording logs the table's attitude"}
    if recording.gyroscope is None or gyroscope is None:
        return {"reason": "the gyroscope is not calibrated"}
    known, logged = _with_reference(recording)
    if known.samples < 2 or known.time[-1] - known.time[0] < SHORTEST_DRIFT_S:
        return {"reason": f"recording {recording.name} is shorter than {SHORTEST_DRIFT_S:g} s"}
    try:
        compensated = Compensation(accelerometer, gyroscope).apply(
            known.accelerometer, known.gyroscope, known.temperature, known.time
        )
    except InputError as error:
        return {"reason": str(error)}
    reference = (logged / np.sqrt(np.einsum("ij,ij->i", logged, logged))[:, None]).T
    time = known.time * known.table_seconds  # by the clock of the reference
    shown = np.unique(np.linspace(0, known.samples - 1, CURVE_POINTS).astype(int))
    seconds, curve = float(min(DRIFT_TIME_S, time[-1] - time[0])), {"time_s": _rounded(time[shown] - time[0])}
    drifts: dict[str, float] = {}
    tilts: dict[str, float] = {}
    for name, readings in (("before", known), ("after", compensated)):
        force, rate = readings.accelerometer, readings.gyroscope
        assert rate is not None  # noqa: S101
        alone = integrate(time, rate, reference[:, 0])
        drifts[name] = drift(time, alone, reference, seconds)
        curve[f"drift_{name}"] = _rounded(angle_between(alone[:, shown], reference[:, shown]))
        if accelerometer and force is not None:
            steps, fused = _fuse(time, force, alone)
            up, true_up = level_in_body(fused), level_in_body(reference[:, steps].T)
            sine, cosine = length(cross(up, true_up)), np.einsum("ij,ij->i", up, true_up)
            tilt, since = np.degrees(np.arctan2(sine, cosine)), time[steps] - time[0]
            tilts[name] = float(np.sqrt(np.mean(tilt[since >= min(TILT_SETTLING_S, 0.5 * since[-1])] ** 2)))
            curve[f"tilt_{name}"] = _rounded(np.interp(time[shown] - time[0], since, tilt))
    found = {"reason": None, "recording": recording.name, "seconds": seconds}
    return found | {"drift_deg": drifts, "tilt_rms_deg": tilts or None, "curve": curve}


def integrate(time: Values, rate: Values, start: Values) -> Values:
    """Return the attitude by integration of angular rates, deg/s, from ``start`` on: unit quaternions (4, n)."""
    total, last = np.empty((4, len(time))), len(time) - 1
    total[:, 0] = start
    for first in range(0, last, INTEGRATED):  # in parts, which bounds the memory
        stop = min(first + INTEGRATED, last)
        before, dt = max(first - 1, 0), np.diff(time[first : stop + 1])[:, None]
        w = np.radians(rate[before : stop + 2])
        mean = 0.5 * (w[:-1] + w[1:])
        mean[1:-1] += (w[1:-2] + w[2:-1] - w[:-3] - w[3:]) / 24.0
        mean, w = mean[first - before :][: stop - first], w[first - before :][: stop - first + 1]
        turns = (dt * mean + dt**2 / 12.0 * cross(w[:-1], w[1:])).T
        half = 0.5 * np.linalg.norm(turns, axis=0)
        each = np.vstack([np.cos(half), 0.5 * np.sinc(half / np.pi) * turns])
        total[:, first : stop + 1] = _running_product(np.column_stack([total[:, first], each]))
    return total


def _running_product(q: Values) -> Values:
    """Return the product of each quaternion with all before it, (4, n), by that of the products of pairs."""
    if q.shape[1] < 2:
        return q
    whole = _running_product(_product(q[:, :-1:2], q[:, 1::2]))  # up to every second
    total = np.empty_like(q)
    total[:, :1], total[:, 1::2] = q[:, :1], whole
    total[:, 2::2] = _product(whole[:, : (q.shape[1] - 1) // 2], q[:, 2::2])
    return total


def _product(p: Values, q: Values) -> Values:
    """Return the products of quaternions, (4, n) arrays; four times as fast as scipy's ``Rotation``."""
    a, b, c, d = p
    e, f, g, h = q
    rows = a * e - b * f - c * g - d * h, a * f + b * e + c * h - d * g, a * g - b * h + c * e + d * f
    return np.array([*rows, a * h + b * g - c * f + d * e])


def drift(time: Values, estimate: Values, reference: Values, seconds: float) -> float:
    """Return the error of an attitude (4, n) after a time of ``seconds``, root mean square over starts, deg."""
    last = int(np.searchsorted(time, time[-1] - seconds + 1e-6, "right")) - 1
    start = np.unique(np.linspace(0, max(last, 0), DRIFT_STARTS).astype(int))
    interval = float(median(np.diff(time)))
    stop = np.minimum(np.searchsorted(time, time[start] + seconds - 0.5 * interval), len(time) - 1)
    turned, known = (_between(q[:, start], q[:, stop]) for q in (estimate, reference))
    return float(np.sqrt(np.mean(angle_between(turned, known) ** 2)))


def angle_between(p: Values, q: Values) -> Values:
    """Return the angle of the rotation from one attitude (4, n) to another: (n,) array, deg."""
    turned = _between(p, q)
    return np.asarray(np.degrees(2.0 * np.arctan2(np.linalg.norm(turned[1:], axis=0), np.abs(turned[0]))))


def _between(p: Values, q: Values) -> Values:
    """Return the rotations from attitudes p to attitudes q: (4, n) arrays."""
    return _product(p * [[1.0], [-1.0], [-1.0], [-1.0]], q)


def _fuse(time: Values, force: Values, alone: Values) -> tuple[Integers, Values]:
    """Return indices of samples about 0.1 s or 5 deg apart, and the attitude of the complementary filter there.

    The rates are those of the attitude ``alone`` of the gyroscope between these samples. The filter starts at its first
    attitude.
    """
    import imufusion  # noqa: PLC0415  (only units with a logged attitude need it)

    turns = angle_between(alone[:, :-1], alone[:, 1:])
    interval, largest = float(median(np.diff(time))), max(float(turns.max()), 1e-9)
    within = min(MAX_FILTER_STEP_S / interval, MAX_FILTER_STEP_DEG / largest)
    chosen = np.arange(0, len(time), max(1, int(within)))
    intervals = np.diff(time[chosen])
    w, *v = _between(alone[:, chosen[:-1]], alone[:, chosen[1:]])
    sine = np.maximum(np.linalg.norm(v, axis=0), np.finfo(float).tiny)
    angles = np.degrees(2.0 * np.arctan2(np.copysign(sine, w), np.abs(w)))
    rates = (angles / sine * v / intervals).T.astype(np.float32, order="C")  # the filter computes in single precision
    off = dict.fromkeys(("gyroscope_range", "acceleration_rejection", "magnetic_rejection", "rejection_timeout"), 0.0)
    frequency, NWU = float(1.0 / np.median(intervals)), imufusion.CONVENTION_NWU
    settings = imufusion.AhrsSettings(sample_rate=frequency, convention=NWU, gain=FILTER_GAIN, **off)
    fusion = imufusion.Ahrs().set_settings(settings).skip_startup().set_quaternion(alone[:, 0].copy())
    set_period, update, attitude = fusion.set_sample_period, fusion.update_no_magnetometer, fusion.get_quaternion
    # The filter compares the force with the attitude before its step.
    period, q = 0.0, list[bytes]()
    periods, forces = intervals.astype(np.float32).tolist(), force[chosen[:-1]].astype(np.float32)
    for interval, rate, reading in zip(periods, rates, forces, strict=True):
        if interval != period:
            set_period(period := interval)
        update(rate, reading)
        q.append(attitude().tobytes())
    fused = np.frombuffer(b"".join(q), np.float32).reshape(-1, 4)  # four times as fast as np.concatenate
    return chosen, np.concatenate([alone[:, :1].T, fused])


def _with_reference(recording: Recording) -> tuple[Recording, Values]:
    """Return the samples of known readings and attitude, and the attitude (n, 4) one delay of the filter earlier."""
    q = recording.table_attitude
    assert q is not None  # noqa: S101
    readings = [v for v in (recording.accelerometer, recording.gyroscope) if v is not None]
    known, logged = np.all([finite_rows(v) for v in readings], axis=0), finite_rows(q)
    clock, q = recording.time[logged], q[logged]
    late = recording.time - float(recording.filter.get("delay_s", 0.0))
    known &= (late >= clock[:1].sum()) & bool(len(clock))
    if not known.any():
        return recording.select(known), np.zeros((0, 4))
    logged_then = np.stack([np.interp(late[known], clock, c) for c in continuous(q).T], 1)
    return recording if known.all() else recording.select(known), logged_then


def _rounded(values: Values) -> list[float]:
    return [float(f"{v:.4g}") for v in values.tolist()]


def gravity_direction(
    accelerometer: SensorCalibration | None,
    gyroscope: SensorCalibration | None,
    recordings: Sequence[Recording],
    noise: Noise | None,
    procedure: Procedure,
) -> dict[str, Any]:
    """Return the part ``gravity_direction`` of ``validations/<unit>.json``, with the noise of the gyroscope.

    It has ``reason`` (why there is none, else None), ``moves`` (number), ``mean_deg``, ``rms_deg`` and ``max_deg``
    (each ``before`` and ``after`` the gyroscope's calibration), ``noise_floor_deg`` (the mean by white noise alone),
    ``largest_expected_rms_deg`` (by noise and uncertainties, exceeded with a probability of 0.5 %; where the fit
    determines the matrix), of fewer than ``FEWEST_MOVES`` ``over_expected`` (the errors weighted by their covariance,
    with the scatter of a steady hand, over what they exceed with this probability) and ``creeping_rests`` (number of
    rests in which the unit turned slowly). Where the procedure states turns without a sheet, ``turns`` (``TurnAngle``).
    """
    if not is_multi_position("gyroscope", recordings):
        return {"reason": NO_HAND}
    if accelerometer is None or gyroscope is None:
        return {"reason": "both sensors have to be calibrated"}
    role = HELD_OUT if any(r.role == HELD_OUT for r in recordings) else ROLE
    observed = observed_rests(recordings, accelerometer, procedure, role)
    if observed is None:
        return {"reason": "no rest is held out"}
    rests, gravity = observed
    judged = replace(rests, held_out=~rests.held_out)
    whole, turns = role if role == HELD_OUT else "", None
    if procedure.sheet is None:
        turns = turns_of(recordings, judged, accelerometer, procedure, whole)
    model = GyroscopeModel(judged, moves_of(recordings, judged), gravity, noise, fewest=1, turns=turns)
    if model.moves is None:
        return {"reason": "no move is held out"}
    states = {"before": State(np.zeros(3), np.eye(3)), "after": _state(gyroscope)}
    errors = {name: model.direction_errors(state) for name, state in states.items()}
    found: dict[str, Any] = {"reason": None, "moves": model.moves.count}
    found["mean_deg"] = {name: float(np.mean(error)) for name, (error, _) in errors.items()}
    found["rms_deg"] = {name: float(np.sqrt(np.mean(error**2))) for name, (error, _) in errors.items()}
    found["max_deg"] = {name: float(np.max(error)) for name, (error, _) in errors.items()}
    found["noise_floor_deg"] = float(np.mean(errors["after"][1]))
    found["creeping_rests"] = int(np.count_nonzero(gravity.creeping))
    if gyroscope.parameters.covariance[MATRIX, MATRIX].any():
        ratio = 0.0 if noise is None else float(np.mean(noise.wander / np.maximum(noise.white, 1e-300)))
        details = gyroscope.stages[-1].details if gyroscope.stages else StageDetails()
        moves, directions = details.scatter_of_moves or 0.0, details.scatter_of_directions or 0.0
        block = model.equations_of_moves(states["after"])
        drawn, _ = _drawn_errors(block, gyroscope, (moves, directions), ratio)
        rms = np.sqrt(2.0 * np.mean((drawn * block.error) ** 2, axis=1))
        found["largest_expected_rms_deg"] = float(np.quantile(rms, 1.0 - TAIL))
        if model.moves.count < FEWEST_MOVES:
            steady = min(moves, STEADY_HAND), min(directions, STEADY_HAND)
            drawn, covariance = _drawn_errors(block, gyroscope, steady, ratio)
            L = cholesky(covariance)
            # where a large error of one direction is likely, as by an axis that few rests determine, it hides no other
            sizes = [np.linalg.norm(np.linalg.solve(L, e), axis=0) for e in (block.residual, drawn.T)]
            found["over_expected"] = float(sizes[0] / np.quantile(sizes[1], 1.0 - TAIL))
    if turns:
        found["turns"] = _turns(turns, states)
    return found


def _drawn_errors(
    block: EquationBlock, calibration: SensorCalibration, scatter: tuple[float, float], ratio: float
) -> tuple[Values, Values]:
    """Return simulated errors of moves over their white noise, (draws, n), and their covariance.

    ``scatter``: of moves and of directions, over the noise. ``ratio``: of bias wander to white noise. Errors of the
    accelerometer's calibration are drawn both for the directions and in the covariance, as if these were independent;
    so bounds are too large rather than too small.
    """
    C, freedom = covariance_without_reference(calibration)[BASE, BASE], calibration.parameters.degrees_of_freedom
    n, H = len(block.residual), np.asarray(block.bias)
    S = (1.0 + scatter[0] ** 2) * np.eye(n) + np.asarray(block.common)
    S = S + scatter[1] ** 2 * np.asarray(block.direction)
    S = S + ratio**2 * np.einsum("cnk,cmk->nm", H, H)
    rng = np.random.default_rng(0)
    drawn = rng.standard_normal((INTERVAL_DRAWS, n)) @ cholesky(S).T  # continuous in S, as eigenvectors are not
    errors = draw_normal(rng, C, INTERVAL_DRAWS)
    for part in (BIAS, MATRIX):  # the wander reduces the degrees of freedom of the bias
        least = min(float(freedom[part].min()), NORMAL_FREEDOM)
        errors[:, part] *= np.sqrt(least / rng.chisquare(least, (INTERVAL_DRAWS, 1)))
    return drawn + errors @ block.base.T, S + block.base @ C @ block.base.T


def _turns(turns: TurnsByHand, states: Mapping[str, State]) -> list[dict[str, Any]]:
    """Return the turns with the angle by each state, ``before`` and ``after`` the calibration."""
    return [
        {**vars(each[0]), "angle_deg": {name: t.angle_deg for name, t in zip(states, each, strict=True)}}
        for each in zip(*map(turns.described, states.values()), strict=True)
    ]


def held_out_turns(
    accelerometer: SensorCalibration | None,
    gyroscope: SensorCalibration | None,
    recordings: Sequence[Recording],
    noise: Noise | None,
    procedure: Procedure,
) -> tuple[list[dict[str, Any]], tuple[str, ...]]:
    """Return the held-out turns of a sheet, and descriptions of those whose angle the calibrated gyroscope contradicts.

    A turn has ``recording, time_s, axis, stated_deg, angle_deg`` (``before`` and ``after`` the calibration, by the
    integrated rate) and ``standard_uncertainty_deg`` of its error. That has noise, the stated accuracy, the
    calibration's uncertainty, the bias wander, and, as a bias that differs between files, the mean of the held-out
    rests less the bias. Without held-out rests that of the fit's rests stands for it.
    """
    if gyroscope is None or procedure.sheet is None or not is_multi_position("gyroscope", recordings):
        return [], ()
    rests = rests_of("gyroscope", recordings, procedure, None, HELD_OUT)
    rests = rests or rests_of("gyroscope", recordings, procedure)
    if rests is None:
        return [], ()
    used = replace(rests, held_out=np.zeros(len(rests.time), bool))
    turns = turns_of(recordings, used, accelerometer, procedure, HELD_OUT)
    if turns is None:
        return [], ()
    states = {"before": State(np.zeros(3), np.eye(3)), "after": _state(gyroscope)}
    block = turns.equations(states["after"], white_of(rests, noise))
    J = block.base * block.error[:, None]
    between = np.average(rests.reading, axis=0, weights=rests.count) - gyroscope.bias
    wander = np.zeros(3) if noise is None else noise.wander
    variance = block.error**2 + np.einsum("rp,pq,rq->r", J, gyroscope.parameters.covariance[BASE, BASE], J)
    deviation = np.sqrt(variance + J[:, BIAS] ** 2 @ (between**2 + wander**2))
    deviation[len(turns.name) :] = np.inf  # the axes refer to the case, of whose angles to the frame nothing is known
    pairs = zip(_turns(turns, states), deviation.tolist(), strict=False)
    departures = turns.departures(block.residual * block.error, deviation)
    return [turn | {"standard_uncertainty_deg": u} for turn, u in pairs], tuple(departures)


def _state(calibration: SensorCalibration) -> State:
    terms = tuple(EffectColumns(effect(e.name), e.values) for e in calibration.effects)
    return State(calibration.bias, calibration.matrix, terms)
