"""Propose the next rest of a recording by hand for the accelerometer, and the next face or turn for the gyroscope.

The next rest is the one that improves the calibration of the accelerometer most:

    F = P + sum_i J_i^T J_i / s_i^2,    U_p = k_p sqrt(g_p (F^-1)_pp)

where

    J_i : (9,) derivative of the length of gravity at rest i (``derivative_of``)
    s_i : g; standard deviation of that length, by white noise of the mean and the scatter between rests
    P   : precision by the sensor file's limits, which are two standard deviations, for a misalignment as in the fit;
          it makes F regular from the start. If the fit determines a misalignment by its limit alone, F is the inverse
          of the fit's covariance
    g_p : variance of the fit over ``(F^-1)_pp``, for bias wander and an uncertain scatter; 1 without a fit
    k_p : coverage factor, with one more degree of freedom for each further rest

The remaining rests are planned together, since the best set of n rests does not contain the best set of n - 1: rests
are added one by one, and each planned rest is exchanged for a better attitude as long as the largest U decreases
(Fedorov, Theory of Optimal Experiments, 1972). The next rest is the planned one with the largest gain in log det F,
``log(1 + J F^-1 J^T / s^2)``. A face, an edge or a corner of the case points up in each of the 26 attitudes, so that a
few words describe it.

The default goal is the uncertainty of the 24 orientations of ``orientations_24`` by the sensor file:

    F = J^T (s^2 I + sum_c q^2 (n_c n_c^T) * R)^-1 J,    R_ij = exp(-|t_i - t_j| / tau)

with white noise s of the mean of a rest, bias wander q and tau, consecutive rests, and the vertical n_i in the body.

Faces and turns (procedure ``ferraris``): each of the six faces needs a rest, and each body axis a turn by the stated
angle from rest to rest, a held-out one if turns are held out. They are recognised as in the fit. A recording that is
stated as a turn about an axis may begin and end without a rest.

Rests and moves: of turns by A about a level body axis a, from the vertical u, the one with the largest gain

    log det (I + H S H^T / s^2),    H = d (exp(-[A (e_a + m)]x) u) / dm

where

    m, S : (3,) error of column a of the gyroscope's matrix, and its covariance by the fit
    s    : rad; standard deviation of the direction of the vertical at two rests
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import permutations, product

import numpy as np

from pipeline.core.errors import NotObservableError
from pipeline.core.records import AXES, BIAS, NotCalibrated, Recording, SensorCalibration, Values, coverage_factor
from pipeline.core.settings import DataSheet, Procedure, Settings
from pipeline.estimation.accelerometer.nonlinear_least_squares import IDEAL, LOWER_COLUMNS, LOWER_ROWS, PLACE, triangle
from pipeline.estimation.multi_position.accelerometer import limit_of_misalignment
from pipeline.estimation.multi_position.faces_and_turns import FACES, face_of
from pipeline.estimation.multi_position.moves import sound_span
from pipeline.estimation.rest_means import ROLE, Orientations, holdout_interval, orientations_of, rest_means
from pipeline.physics.signal.rests import WINDOW_S, Rest, find_rests
from pipeline.physics.signal.segments import multiples, turns_by_hand
from pipeline.simulation.trajectory import rotation_by
from pipeline.unit import Task, UnitState, run_checked, run_steps

SHARPNESS = 8  # exponent of a smooth norm for the largest U, within 32 % of it for nine parameters
SWEEPS = 10  # of the exchange, which usually ends after two or three
MAX_PLANNED_RESTS = 60  # planned rests: some 7 min
MIN_RESTS = 9  # rests of the fit, one for each parameter
# difference of components of the vertical, 5 deg from an edge: within it, the name does not change
SAME_DIRECTION = 0.08
LEVEL_DEG = 3.0  # largest tilt that is not mentioned: units are set down by hand to about 1 deg
BETWEEN_SIDES = np.tan(np.radians(22.5))  # ratio of two components above which a corner is raised, not a side
TURNS_DEG = (90.0, 180.0, 270.0, 360.0)  # angles that need no scale
RELATIVE_STEP = 1e-5  # relative, of a difference quotient: its error is 1e-10


@cache
def attitudes() -> Values:
    """Return the proposed attitudes as directions of the vertical in the body, faces first: (26, 3) array."""
    up = np.array(sorted(filter(any, product((1, 0, -1), repeat=3)), key=lambda p: sum(map(abs, p))), float)
    return np.asarray(up / np.linalg.norm(up, axis=1, keepdims=True))


def in_words(up: Sequence[float] | Values) -> str:
    """Return an attitude in words: the axis that points up, then the side or corner that is raised.

    >>> in_words([0.0, 0.0, 1.0])
    '+z up'
    >>> in_words([0.447, 0.0, 0.894])
    '+z up, then the +x side raised by 27 deg'
    """
    n = np.asarray(up, float) / float(np.linalg.norm(up))
    first = next(i for i in (2, 1, 0) if abs(n[i]) > np.max(np.abs(n)) - SAME_DIRECTION)
    tilt = float(np.degrees(np.arccos(min(abs(n[first]), 1.0))))
    if tilt < LEVEL_DEG:
        return f"{_axis(n, first)} up"
    large, small = sorted((i for i in range(3) if i != first), key=lambda i: -abs(float(n[i])))
    side = f"the {_axis(n, large)} side"
    if abs(n[small]) > BETWEEN_SIDES * abs(n[large]):
        side = f"the corner between its {' and '.join(_axis(n, i) for i in sorted((large, small)))} sides"
    return f"{_axis(n, first)} up, then {side} raised by {tilt:.0f} deg"


def _axis(n: Values, i: int) -> str:
    return f"{'+' if n[i] > 0 else '-'}{AXES[i]}"


@dataclass(frozen=True)
class GuideProgress:
    """The state of the accelerometer's calibration by the rests so far."""

    rests: tuple[tuple[Recording, Rest], ...]  # in order of time in each recording
    held_out: tuple[bool, ...]  # of each
    up: Values  # (m, 3); direction of the vertical in the body at each
    left_out: tuple[tuple[Recording, Rest], ...]
    next_is_held_out: bool
    information: Values  # (9, 9); F
    values: Values  # (9,); bias and the lower triangle of the matrix
    error: float  # g; s of a future rest
    inflation: Values  # (9,); g_p
    freedom: Values  # (9,); degrees of freedom
    expanded: float  # g; largest U of the fit, infinite without one
    reason: str  # why there is no fit

    @property
    def used(self) -> int:
        """Number of rests of the fit."""
        return self.held_out.count(False)

    def near(self, up: Values) -> list[int]:
        """Return the rests whose nearest proposed attitude is that of ``up``."""
        nearest = np.argmax(self.up @ attitudes().T, axis=1)
        return [int(i) for i in np.flatnonzero(nearest == int(np.argmax(attitudes() @ up)))]

    def largest(self, information: Values, further: int) -> float:
        """Return the largest expected U after further rests, g (of the matrix at 1 g)."""
        variance = self.inflation * np.diag(np.linalg.inv(information))
        return float(np.max(coverage_factor(self.freedom + further) * np.sqrt(variance)))


@dataclass(frozen=True)
class ProposedRest:
    """The next rest."""

    up: Values  # (3,)
    further: int  # number of rests of the fit up to the goal; 0: the goal is reached
    expected: float  # g; largest U with these rests


def fitted_by_hand(recordings: Sequence[Recording], settings: Settings, *, gyroscope: bool = False) -> UnitState:
    """Return the unit with the fit of the accelerometer, and of the gyroscope where it is asked for.

    ``settings``: sections ``sensor``, ``table``, ``procedure`` and ``filter``; for the gyroscope also ``effects``. The
    uncertainty is that of the recordings: further rests do not reduce what the configuration states.
    """
    unit = run_checked(recordings, {}, settings, "filter")
    stages = {"accelerometer": ["nonlinear_least_squares"]}
    stages |= {"gyroscope": ["rests_and_moves", "effects"]} if gyroscope else {}
    for sensor, names in stages.items():
        try:
            run_steps(unit, (Task("fit", sensor, name, last=False) for name in names), lambda _: settings)
        except NotObservableError as lack:  # ends the unit in a run
            unit.fits = {**unit.fits, sensor: NotCalibrated(lack.message)}
    return unit


def progress_of(unit: UnitState, settings: Settings, dwell: float) -> GuideProgress:
    """Return the state of the accelerometer's calibration.

    ``unit``: with the fit of the accelerometer (``fitted_by_hand``). ``dwell``: s, of a future rest. Raises
    ``CannotCalibrateError`` if no recording holds readings of the accelerometer.
    """
    assert unit.recordings is not None  # noqa: S101
    recordings, fit = unit.recordings.filtered, unit.fits["accelerometer"]
    orientations = orientations_of(recordings, settings)
    fitted = None if isinstance(fit, NotCalibrated) else fit
    values, scatter, reason = IDEAL, 0.0, fit.reason if isinstance(fit, NotCalibrated) else _undetermined(fit)
    if fitted is not None:
        values = fitted.parameters.values[PLACE]
        scatter = fitted.stages[-1].details.scatter_between_rests or 0.0
    data_sheet, gravity = settings.sensor.accelerometer, settings.table.gravity_g
    rests, white = orientations.rests, _white_of_rest(orientations, data_sheet, dwell)
    error = float(np.hypot(white, scatter))
    u = {True: 0.5 * data_sheet.scale_factor, False: limit_of_misalignment(data_sheet)}
    of_matrix = [u[bool(i == j)] for i, j in zip(LOWER_ROWS, LOWER_COLUMNS, strict=True)]
    F = np.diag(1.0 / np.square([0.5 * data_sheet.bias / gravity] * 3 + of_matrix))  # P
    if len(rests.time):
        J = derivative_of(rests.reading, values)
        F = F + (J / (np.mean(orientations.white**2) * rests.share + scatter**2)[:, None]).T @ J
    inflation, freedom, expanded = np.ones(9), np.full(9, np.inf), np.inf
    if fitted is not None:
        nine = fitted.parameters.select(PLACE)
        covariance = nine.covariance
        if fitted.stages[-1].details.known_by_limit:
            F = np.asarray(np.linalg.inv(covariance), np.float64)
        else:
            freedom, inflation = nine.degrees_of_freedom, np.diag(covariance) / np.diag(np.linalg.inv(F))
        expanded = np.inf if reason else float(np.max(coverage_factor(freedom) * np.sqrt(np.diag(covariance))))
    of_both = [(pair, False) for pair in orientations.used] + [(pair, True) for pair in orientations.held_out]
    of_both.sort(key=lambda entry: (recordings.index(entry[0][0]), entry[0][1].start))
    pairs = [pair for pair, _ in of_both]
    last = sum(pair[0] is pairs[-1][0] for pair in pairs) if pairs else 0
    every = holdout_interval(recordings, settings.procedure)
    return GuideProgress(
        rests=tuple(pairs),
        held_out=tuple(held for _, held in of_both),
        up=_directions(pairs, values),
        left_out=orientations.left_out,
        next_is_held_out=bool(every) and last % every == every // 2,
        information=F,
        values=values,
        error=error,
        inflation=inflation,
        freedom=freedom,
        expanded=expanded,
        reason=reason,
    )


def default_goal(data_sheet: DataSheet, gravity: float, dwell: float) -> float:
    """Return the largest U of ``orientations_24`` by the noise of the sensor file, g, to two digits."""
    angle = np.radians(np.arange(0.0, 360.0, 45.0))
    turn = gravity * np.column_stack([np.zeros(8), np.cos(angle), np.sin(angle)])
    up = np.concatenate([np.roll(turn, axis, axis=1) for axis in range(3)])
    time = dwell * np.arange(len(up))
    R = np.exp(-np.abs(time[:, None] - time) / data_sheet.wander_time_s)
    C = data_sheet.white(dwell) ** 2 * np.eye(len(up)) + (data_sheet.bias_wander / gravity) ** 2 * (up @ up.T) * R
    J = derivative_of(up, IDEAL)
    variance = np.diag(np.linalg.inv(J.T @ np.linalg.solve(C, J)))
    return float(f"{coverage_factor(len(up) - J.shape[1]) * np.sqrt(np.max(variance)):.2g}")


def derivative_of(y: Values, values: Values) -> Values:
    """Return the derivative of |L (y - b)| with respect to the nine values: (m, 9) array.

    ``d/db = -L^T n`` and ``d/dL_ij = n_i (y - b)_j``, with ``n = u / |u|``.
    """
    L, centred = triangle(values), y - values[BIAS]
    u = centred @ L.T
    n = u / np.linalg.norm(u, axis=1, keepdims=True)
    return np.concatenate([-n @ L, n[:, LOWER_ROWS] * centred[:, LOWER_COLUMNS]], axis=1)


def _undetermined(fitted: SensorCalibration) -> str:
    """Return what the rests do not determine; empty if they determine everything."""
    details = fitted.stages[-1].details
    by_limit, count = details.known_by_limit, details.orientations_used or 0
    if by_limit:
        return f"{count} orientations leave {', '.join(by_limit)} open"
    return f"{count} orientations determine nine parameters without a check" if count <= MIN_RESTS else ""


def _white_of_rest(orientations: Orientations, data_sheet: DataSheet, dwell: float) -> float:
    """Return the standard deviation by white noise of the mean of a future rest on an axis, g."""
    white = float(np.sqrt(np.mean(orientations.white**2)))
    if white > 0.0:
        (recording, _), *_ = orientations.used
        return white / float(np.sqrt(max((dwell - WINDOW_S) / recording.interval, 1.0)))
    return data_sheet.white(dwell)


def _directions(pairs: Sequence[tuple[Recording, Rest]], values: Values) -> Values:
    """Return the direction of the vertical in the body at each rest: (m, 3) array."""
    readings = [np.asarray(r.accelerometer)[rest.start : rest.stop] for r, rest in pairs]
    mean = np.array([np.nanmean(values, axis=0) for values in readings]).reshape(-1, 3)
    force = (mean - values[BIAS]) @ triangle(values).T
    return np.asarray(force / np.linalg.norm(force, axis=1, keepdims=True))


def propose(progress: GuideProgress, goal: float) -> ProposedRest:
    """Return the next rest, with the number of rests up to the goal, g; at most ``MAX_PLANNED_RESTS``."""
    up = attitudes()
    readings = progress.values[BIAS] + up @ np.linalg.inv(triangle(progress.values)).T
    X = derivative_of(readings, progress.values) / progress.error
    planned, F = _planned(progress, X, goal)
    expected = progress.largest(F, len(planned))
    if progress.next_is_held_out:  # as far as possible from all rests, to judge the fit between them
        free = np.setdiff1d(np.arange(len(up)), planned) if len(set(planned)) < len(up) else np.arange(len(up))
        near = np.max(up[free] @ progress.up.T, axis=1, initial=-1.0)
        return ProposedRest(up[free[int(np.argmin(near))]], len(planned), expected)
    rows = planned or range(len(up))
    gain = np.einsum("ni,ij,nj->n", X[rows], np.linalg.inv(progress.information), X[rows])
    return ProposedRest(up[rows[int(np.argmax(gain))]], len(planned), expected)


def _planned(progress: GuideProgress, X: Values, goal: float) -> tuple[list[int], Values]:
    """Return the attitudes of the fewest further rests that reach the goal, and F with them."""
    planned: list[int] = []
    F = progress.information
    if progress.expanded <= goal:
        return planned, F

    def scores(information: Values) -> Values:
        """Return the score with each attitude added: the smaller the better."""
        inverse = np.linalg.inv(information)
        V = X @ inverse
        variance = progress.inflation * (np.diag(inverse) - V**2 / (1.0 + np.sum(V * X, axis=1))[:, None])
        return np.asarray(np.sum((variance / variance.max()) ** SHARPNESS, axis=1))

    while len(planned) < MAX_PLANNED_RESTS:
        planned.append(int(np.argmin(scores(F))))
        F = F + np.outer(X[planned[-1]], X[planned[-1]])
        for _ in range(SWEEPS):
            before = list(planned)
            for i, old in enumerate(before):
                without = F - np.outer(X[old], X[old])
                score = scores(without)
                new = int(np.argmin(score))
                if score[new] < score[old] * (1.0 - 1e-9):
                    planned[i], F = new, without + np.outer(X[new], X[new])
            if planned == before:
                break
        if progress.used + len(planned) > MIN_RESTS and progress.largest(F, len(planned)) <= goal:
            break
    return planned, F


@dataclass(frozen=True)
class ProposedTurn:
    """A turn about a body axis that stays level."""

    axis: int
    up: int  # body axis that points up before it
    angle: float  # deg

    def in_words(self, dwell: float) -> str:
        """Return the instruction."""
        turn = f"turn it by {self.angle:g} deg about its {AXES[self.axis]} axis, which stays level"
        return f"+{AXES[self.up]} up; rest it for {dwell:g} s, {turn}, rest it for {dwell:g} s again"

    def sensitivity(self) -> Values:
        """Return H: (3, 3) array."""
        turned = self.angle * np.eye(3)[self.axis]

        def vertical(m: Values) -> Values:
            return np.asarray(rotation_by(-(turned + self.angle * m)) @ np.eye(3)[self.up])

        steps = RELATIVE_STEP * np.eye(3)
        return np.column_stack([(vertical(m) - vertical(-m)) / (2.0 * RELATIVE_STEP) for m in steps])


def most_informative_turn(gyroscope: SensorCalibration, direction: float) -> ProposedTurn:
    """Return the turn that improves the gyroscope's matrix most.

    ``gyroscope``: its calibration so far, with a covariance. ``direction``: s, rad.
    """
    assert gyroscope.covariance is not None  # noqa: S101
    S = gyroscope.covariance

    def gain(turn: ProposedTurn) -> float:
        column = 3 + 3 * np.arange(3) + turn.axis
        H = turn.sensitivity() / direction
        return float(np.linalg.slogdet(np.eye(3) + H @ S[np.ix_(column, column)] @ H.T)[1])

    turns = (ProposedTurn(axis, up, angle) for axis, up in permutations(range(3), 2) for angle in TURNS_DEG)
    return max(turns, key=gain)


def next_face_or_turn(recordings: Sequence[Recording], procedure: Procedure, dwell: float) -> tuple[bool, list[str]]:
    """Return whether all faces and turns are recorded, and lines that state what is recorded and what comes next.

    ``procedure``: with turns. ``dwell``: s, of a future rest.
    """
    stated = procedure.turns
    assert stated is not None  # noqa: S101
    if any(entry.windows for entry in procedure.recordings.values()):
        stated = stated.replaced(holdout_every=0)  # the windows state what is held out
    faces, angle = dict.fromkeys(FACES, 0), stated.angle_deg
    turns: dict[str, list[bool]] = {axis: [] for axis in AXES}  # whether each is held out
    pairs = [(r, [rest for rest in find_rests(r) if rest.accepted]) for r in recordings if r.role == ROLE]
    at_rest = [r.gyroscope[rest.start : rest.stop] for r, rests in pairs for rest in rests if r.gyroscope is not None]
    for recording, rests in pairs:
        for face in face_of(rest_means(recording, rests)[0])[0].tolist():
            if face >= 0:
                faces[FACES[face]] += 1
        for turn in turns_by_hand(recording, rests, stated):
            turns[AXES[turn.axis]].append(turn.held_out)
        if recording.axis and len(rests) < 2 and at_rest and sound_span(recording, slice(0, recording.samples)):
            rate = np.asarray(recording.gyroscope) - np.concatenate(at_rest).mean(axis=0)  # a part that is one turn
            axis, count = multiples(np.trapezoid(rate, recording.time, axis=0), angle)
            turns[AXES[axis]] += [False] * bool(count)
    judged = bool(stated.holdout_every) and not any(r.role == "validation" for r in recordings)
    counts = (f"{axis} {len(held)}" + f" ({sum(held)} held out)" * judged for axis, held in turns.items())
    lines = [
        "faces: " + ", ".join(f"{name} {count}" for name, count in faces.items()) + " rests",
        f"turns by {angle:g} deg: " + ", ".join(counts),
    ]
    lacking = next((name for name, count in faces.items() if not count), None)
    if lacking is not None:
        return False, [*lines, f"next: {lacking} up; rest it for {dwell:g} s"]
    about = next((axis for axis, held in turns.items() if not (any(held) if judged else held)), None)
    if about is None:
        return True, [*lines, "enough for bias and matrix: all faces and turns are there"]
    back = "back " if len(turns[about]) % 2 else ""
    move = f"turn it {back}by {angle:g} deg about the vertical"
    return False, [*lines, f"next: +{about} up; rest it for {dwell:g} s, {move}, rest it for {dwell:g} s again"]
