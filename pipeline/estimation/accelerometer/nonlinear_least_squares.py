"""Fit nine parameters of the accelerometer to the length of gravity (paper eqs 1 and 4; Sudsanguan 2019, 5.5-5.6).

    u = L (y - b),   L = T S,   |u| = G

with the bias b, the scale factors S and the unit lower triangular misalignment T: x of the sensor is x of the body, and
its y is in the plane of x and y, because the length of gravity does not determine the mounting of the sensor. The
orientations need not be known. ``pipeline.estimation.multi_position`` has the equations and the fit; the rows are
hand-held rests, the dwells of a table's stop-and-go turns, or the single samples of its continuous turns.

If the orientations determine a misalignment worse than the sensor file does, as in six positions, it has a
pseudo-observation by the file's limit, and the result states this; with a sheet of recordings, bias and scale factors,
too. On a table the bias wander correlates the errors of
the rows; ``pipeline.estimation.engine`` gives the covariance.

The start is the ellipsoid ``p . (x^2, y^2, z^2, 2xy, 2xz, 2yz, 2x, 2y, 2z) = 1``, that is ``y^T Q y + 2 h^T y = 1``. It
is linear in p; its centre is ``b = -Q^-1 h``, and ``L^T L = Q G^2 / (1 + b^T Q b)``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from pipeline.core.errors import NotObservableError
from pipeline.core.records import (
    AXES,
    BASE_COUNT,
    BIAS,
    MATRIX,
    MEDIAN_SIZE,
    Estimate,
    Multiply,
    Noise,
    NoMonteCarlo,
    SensorCalibration,
    StageDetails,
    StageResult,
    Subtract,
    Values,
    base_units,
    base_values,
    coverage_factor,
)
from pipeline.core.settings import DataSheet, Settings
from pipeline.estimation.engine import LinearMap, ScaledColumns, quadratic_results, through, with_trials
from pipeline.estimation.gauss_markov import WHITE_SETTING, Setting, WanderPrior
from pipeline.estimation.multi_position.accelerometer import (
    PARAMETERS,
    AccelerometerModel,
    limit_of_misalignment,
    limits_of_parameters,
)
from pipeline.estimation.multi_position.fit import FitByHand
from pipeline.estimation.multi_position.fit import fit as fit_model
from pipeline.estimation.multi_position.model import NoiseHypothesis, State, prior_hypotheses, with_limits
from pipeline.estimation.multi_position.result import (
    NOT_INCLUDED,
    after_stage,
    curvature,
    fit_faces,
    limits_contribution,
    require_faces,
    with_stage,
)
from pipeline.estimation.rest_means import Orientations, orientations_of, rest_uses, sound_samples
from pipeline.estimation.stages import FitStage, StageInput
from pipeline.estimation.table_errors import Reference
from pipeline.estimation.turns import TurnPart, noise_of_turns, used_motions
from pipeline.estimation.uncertainty_budget import (
    changes_on_table,
    combined,
    gravity_line,
    noise_contribution,
    stage_parameters,
)
from pipeline.physics.kinematics import table_motion

NAME = "nonlinear_least_squares"
FIT_STAGES = {NAME: FitStage(sensors=("accelerometer",), accepts=("readings",), changes=("bias", "matrix"), free=True)}
LOWER_ROWS, LOWER_COLUMNS = np.tril_indices(3)
TRIANGLE = slice(BIAS.stop, None)  # of the nine values: the elements of L; the bias comes first
PLACE = np.append(np.arange(BIAS.stop), MATRIX.start + np.ravel_multi_index((LOWER_ROWS, LOWER_COLUMNS), (3, 3)))
PLACED = np.eye(BASE_COUNT)[:, PLACE]
ELEMENTS = [(AXES[i], AXES[j]) for i, j in zip(LOWER_ROWS, LOWER_COLUMNS, strict=True)]
PARAMETER_NAMES = np.array(PARAMETERS)
MISALIGNMENT = np.concatenate([np.zeros(3, bool), LOWER_ROWS != LOWER_COLUMNS])
IDEAL = np.concatenate([np.zeros(3), np.eye(3)[LOWER_ROWS, LOWER_COLUMNS]])  # the nine values of an ideal sensor
# standard uncertainty, g or relative, beyond which a bias or scale factor is called undetermined
MAX_KNOWN_UNCERTAINTY = 0.05
FALSE_ALARM = 1e-3  # probability that a recording without outliers has one
SMALLEST_OUTLIER_G = 1e-6  # rests of a noise-free recording are no outliers
FEWEST_TO_JUDGE = 18  # rests, two for each parameter
OUTLIER_SHARE = 0.2  # of the rests, the most that are called outliers
MIN_OWN_SHARE = 0.01  # of the assumed variance of a mean: averages over 100 s
MAX_COVARIANCE_ROWS = 600  # for which errors are drawn from a covariance
KNOCK, LARGEST_CORRELATION = 3.0, 0.95  # deviations of a part by a knock; of successive parts, so that T stays finite
OF_LENGTH = {
    **NOT_INCLUDED,
    "table angle, rate and orthogonality, levelling": "the length of gravity does not change with the attitude",
    "time base": "no time enters the length of gravity",
}


@dataclass(frozen=True)
class _Solved:
    """A fit of m rows and then k pseudo-observations."""

    model: AccelerometerModel
    fit: FitByHand
    columns: Values  # (m + k, 9); over the standard deviation of each
    share: Values  # (m + k,); white noise over that standard deviation

    @property
    def rows(self) -> slice:
        return slice(self.model.rests_equations)

    @property
    def error(self) -> Values:
        """|u| minus its target: (m,) array, g."""
        return -(self.fit.residual * self.fit.error)[self.rows]

    @property
    def residual(self) -> Values:
        """Residuals over the standard deviation of each: (m + k,) array."""
        return self.fit.residual * self.share

    @property
    def spare(self) -> int:
        return len(self.residual) - len(PARAMETER_NAMES)

    @property
    def uncertainty(self) -> Values:
        """Standard uncertainties by the scatter of the rows: (9,) array."""
        scale = max(1.0, float(np.sum(self.residual**2)) / max(self.spare, 1))
        return np.asarray(np.sqrt(scale * np.diag(np.linalg.pinv(self.columns.T @ self.columns, hermitian=True))))

    @property
    def between(self) -> float:
        """Scatter s of the rows beyond white noise v, g: ``sum error^2 / (v + s^2) = m - p`` (Mandel & Paule 1970)."""
        spare, squares, variance = self.spare, self.error**2, self.fit.error[self.rows] ** 2
        if spare < 1 or np.sum(squares / variance) <= spare:
            return 0.0
        low, high = 0.0, float(np.sum(squares)) / spare
        for _ in range(60):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if np.sum(squares / (variance + middle)) > spare else (low, middle)
        return float(np.sqrt(high))


def fit(task: StageInput) -> SensorCalibration:
    """Fit bias, scale factors and misalignment of the accelerometer (``pipeline.estimation.stages``).

    The recordings are rests in many orientations (role ``rests``), or a table's turns (role ``accelerometer``). Where
    the procedure states faces, the full matrix is fitted (``pipeline.estimation.multi_position.result``).
    """
    if task.settings.procedure.faces:
        require_faces(task.recordings.filtered, task.settings.procedure)
    found = _fit_triangular(task)
    return fit_faces(found, task.recordings, task.settings) if task.settings.procedure.faces else found


def triangle(values: Values) -> Values:
    """Return L of the nine values: (3, 3) array."""
    L = np.zeros((3, 3))
    L[LOWER_ROWS, LOWER_COLUMNS] = values[TRIANGLE]
    return L


def _fit_triangular(task: StageInput) -> SensorCalibration:
    settings, data_sheet, prior, gravity_g = task.settings, task.data_sheet, task.prior, task.settings.table.gravity_g
    rows = orientations_of(task.recordings.filtered, settings)
    if settings.procedure.sheet is None:
        limit = limit_of_misalignment(data_sheet)
        determined = partial(_fit_determined, gravity_g=gravity_g, prior=prior, limit=limit)
    else:
        determined = partial(_fit_partly, gravity_g=gravity_g, prior=prior, data_sheet=data_sheet)
    solved = determined(rows)
    if (rows.rests.own > 0.0).all() and solved.spare > 1:
        rows = _with_noise_of_means(rows, solved)
        solved = determined(rows)
    while refused := _outlier(rows, solved):
        rows = _without(rows, refused)
        solved = determined(rows)
    if "slow" in rows.rests.kinds and (time := _scatter_time(rows, solved)):
        rows = replace(rows, rests=replace(rows.rests, scatter_time=time))
        solved = determined(rows)
    fitted, before = solved.fit, SensorCalibration("accelerometer", stages=task.stages)
    if not rows.by_hand and solved.spare > 1:
        return _on_table(rows, solved, before, prior, settings)
    covariance = PLACED @ fitted.covariance @ PLACED.T
    freedom = float(fitted.degrees_of_freedom.min())
    gain = (ScaledColumns.of(solved.columns).weights() * solved.share)[:, solved.rows]
    stage, white = _stage(rows, solved, covariance, freedom), PLACED @ np.sum(gain**2, axis=1)
    return after_stage(before, stage, solved.model, fitted, settings, white=white, not_included=OF_LENGTH)


def _with_noise_of_means(rows: Orientations, solved: _Solved) -> Orientations:
    """Return rows of means with the noise that their scatter shows, where that is less than assumed.

    How long a mean was averaged is not known: with the residuals r over the standard deviation d of each, of nu degrees
    of freedom, the variance of a mean is ``v + (sum r^2 / nu - 1) d^2`` in place of v.
    """
    residual, deviation = solved.residual[solved.rows], (solved.fit.error / solved.share)[solved.rows]
    excess = min(float(residual @ residual) / solved.spare - 1.0, 0.0)
    own = np.maximum(rows.rests.own + excess * deviation**2, MIN_OWN_SHARE * rows.rests.own)
    return replace(rows, rests=replace(rows.rests, own=own))


def _scatter_time(rows: Orientations, solved: _Solved) -> float:
    """Return the time T in which accelerations of slow movement decay to 37 %, s; 0 where none is seen.

    By the covariance c of successive parts, d apart, and the variance s^2 beyond white noise: ``c = s^2 exp(-d / T)``.
    """
    slow = np.array([rows.recordings[i].kind == "slow" for i in rows.rests.recording.tolist()])
    both = slow[1:] & slow[:-1] & (np.diff(rows.rests.recording) == 0)
    limit = KNOCK * MEDIAN_SIZE * float(np.median(np.abs(solved.error[slow])))
    error, white = np.clip(solved.error, -limit, limit), solved.fit.error[solved.rows] ** 2
    excess = float(np.mean(error[slow] ** 2 - white[slow]))
    alike = float(np.mean((error[1:] * error[:-1])[both])) / excess if excess > 0.0 and both.any() else 0.0
    if alike <= 2.0 / max(float(both.sum()), 1.0) ** 0.5:
        return 0.0
    apart = float(np.median(np.diff(rows.rests.time)[both]))
    return apart / -float(np.log(min(alike, LARGEST_CORRELATION)))


def _without(rows: Orientations, refused: Mapping[int, str]) -> Orientations:
    """Return the rows without the refused ones, which are listed as left out, each with its reason."""
    used, kept = rows.used, np.ones(len(rows.rests.time), bool)
    kept[list(refused)] = False
    outlying = [(used[i][0], replace(used[i][1], accepted=False, reason=reason)) for i, reason in refused.items()]
    left_out = sorted([*rows.left_out, *outlying], key=lambda pair: (pair[0].name, pair[1].start))
    return replace(rows, rests=rows.rests.select(kept), left_out=tuple(left_out))


def _fit_determined(rows: Orientations, gravity_g: float, prior: WanderPrior, limit: float) -> _Solved:
    """Fit the nine values, with the limit of each misalignment that the orientations determine worse."""
    count = len(rows.rests.time)
    if count < 6:
        raise NotObservableError(
            f"{count} orientations determine neither bias nor scale factors: {_unused(rows)}. Record rests in at "
            "least 6 orientations, each axis up and down, or better in 24 that are spread evenly"
        )
    solved = _fitted(rows, gravity_g, prior, dict.fromkeys(PARAMETER_NAMES[MISALIGNMENT].tolist(), limit))
    # A variance of more than half that of the limit is mostly the limit's.
    by_limit = MISALIGNMENT & ((solved.uncertainty > limit * np.sqrt(0.5)) | (count < len(PARAMETER_NAMES)))
    if not np.array_equal(by_limit, MISALIGNMENT):
        solved = _fitted(rows, gravity_g, prior, dict.fromkeys(PARAMETER_NAMES[by_limit].tolist(), limit))
    _require_known(solved.uncertainty, rows)
    return solved


def _require_known(u: Values, rows: Orientations) -> None:
    """Raise ``NotObservableError`` if the standard uncertainty of a bias or scale factor, (9,), is too large."""
    weak = (u > MAX_KNOWN_UNCERTAINTY) & ~MISALIGNMENT
    if weak.any():
        raise NotObservableError(
            f"the {len(rows.rests.time)} orientations are nearly degenerate: they leave "
            f"{', '.join(PARAMETER_NAMES[weak])} open to {float(u[weak].max()):.2g} (standard uncertainty; "
            f"{_unused(rows)}). Record rests with each axis up, down and level, spread evenly, not all in one plane or "
            "direction"
        )


def _fit_partly(rows: Orientations, gravity_g: float, prior: WanderPrior, data_sheet: DataSheet) -> _Solved:
    """Fit the nine values, with the limit of each that the orientations determine worse."""
    if len(rows.rests.time) == 0:
        raise NotObservableError(f"no rest of the accelerometer was found: {_unused(rows)}")

    def solve_with(held: Mapping[str, float]) -> tuple[_Solved, Values]:
        solved = _fitted(rows, gravity_g, prior, held, partly=True)
        return solved, solved.uncertainty

    return with_limits(limits_of_parameters(data_sheet), solve_with)


def _unused(rows: Orientations) -> str:
    """Return how many rests are not used, and why, as a clause."""
    left_out, held_out = len(rows.left_out), len(rows.held_out)
    unless = " (procedure.holdout_every=0 uses them)" if held_out else ""
    return f"{left_out} rests were left out because the sensor moved, {held_out} are held out for validation{unless}"


def _fitted(
    rows: Orientations, gravity_g: float, prior: WanderPrior, limits: Mapping[str, float], *, partly: bool = False
) -> _Solved:
    """Fit the nine values; raise ``NotObservableError`` if orientations and limits do not determine them.

    ``partly``: whether a bias or scale factor may be known to its limit alone.
    """
    noise = Noise(rows.white, np.zeros(3), prior.time, "rests")
    model = AccelerometerModel(rows.rests, PLACED, gravity_g, noise, known_by_limit=limits, wander=rows.by_hand)
    # Attitudes that do not determine an ellipsoid lie on one far from any sensor.
    values = IDEAL if partly and limits else _start(rows.rests.reading, gravity_g, tilted=not limits)
    state = State(values[BIAS], triangle(values))
    equations = model.equations(state)
    columns = ScaledColumns.of(equations.base)
    try:
        columns.require_full_rank(PARAMETER_NAMES.tolist())
    except NotObservableError as lack:
        problem = f"the {len(rows.rests.time)} orientations are too much alike: {lack.message} ({_unused(rows)})"
        raise NotObservableError(f"{problem}. Record rests with each axis up, down and level, spread evenly") from lack
    if not partly:  # far from a minimum that the orientations hardly determine, the fit would name others
        _require_known(np.linalg.norm(columns.weights(), axis=1), rows)
    known = WanderPrior(0.0, prior.time) if not rows.by_hand else prior
    noises = prior_hypotheses(known, float(np.mean(model.white)), model.kinds)
    if known.wander == 0.0:  # on a table the wander follows from all readings
        noises = [noise for noise in noises if noise.bias.ratio == 0.0]
    if len(equations.residual) - len(PARAMETER_NAMES) <= 1:  # too few rows to show a scatter: the prior replaces it
        wander = Setting(prior.wander / float(np.mean(model.white)), prior.time)  # which rests of one file share
        scatter = prior.wander / float(np.median(equations.error[: model.rests_equations]))
        noises = [NoiseHypothesis(wander, (0.0,)) if rows.by_hand else NoiseHypothesis(WHITE_SETTING, (scatter,))]
    known_white = rows.rests.freedom > 0.0 or not np.any(rows.rests.own)  # by the scatter within the rests
    noises = [replace(noise, known=known_white) for noise in noises]
    fitted = fit_model(model, state, noises, {}, max(rows.rests.freedom, 1.0) if known_white else None)
    equations = model.equations(fitted.state)
    variance = np.diag(equations.covariance(fitted.noise)) if rows.by_hand else equations.variance(fitted.noise)
    return _Solved(model, fitted, equations.base / np.sqrt(variance)[:, None], 1.0 / np.sqrt(variance))


def _start(y: Values, gravity_g: float, *, tilted: bool) -> Values:
    """Return the values of the ellipsoid through the readings, or of an ideal sensor if there is no ellipsoid."""
    products = 2.0 * y[:, [0, 0, 1]] * y[:, [1, 2, 2]]
    columns = [y**2, products, 2.0 * y] if tilted else [y**2, 2.0 * y]
    factors = ScaledColumns.of(np.concatenate(columns, axis=1))
    if factors.rank < len(factors.scale):
        return IDEAL
    p = factors.solve(np.ones(len(y)))
    xy, xz, yz = p[3:6] if tilted else np.zeros(3)
    Q = np.array([[p[0], xy, xz], [xy, p[1], yz], [xz, yz, p[2]]])
    if np.min(np.linalg.eigvalsh(Q)) <= 0:
        return IDEAL
    b = -np.linalg.solve(Q, p[-3:])
    scaled = Q * gravity_g**2 / (1.0 + b @ Q @ b)
    reverse = np.linalg.cholesky(scaled[::-1, ::-1])[::-1, ::-1]  # upper triangular U with U U^T = L^T L
    return np.concatenate([b, reverse.T[LOWER_ROWS, LOWER_COLUMNS]])


def _outlier(rows: Orientations, solved: _Solved) -> dict[int, str]:
    """Return the hand-held rest with the largest error if it is an outlier, with the reason.

    A rest is compared with the fit of the others alone: with its leverage h, its weighted error r and p parameters,
    ``t = r / (s sqrt(1 - h))`` follows Student's t with m - p - 1 degrees of freedom, where s is the scatter of the
    others, ``s^2 = (sum r^2 - r^2 / (1 - h)) / (m - p - 1)`` (Belsley, Kuh & Welsch 1980, section 2.1).
    """
    r, left_out = solved.residual[solved.rows], len(rows.left_out)
    if not rows.by_hand or len(r) < FEWEST_TO_JUDGE or left_out >= OUTLIER_SHARE * (len(r) + left_out):
        return {}
    rest = 1.0 - np.sum(ScaledColumns.of(solved.columns).basis[solved.rows] ** 2, axis=1)
    spare = solved.spare - 1
    others = np.maximum(np.sum(r**2) - r**2 / np.maximum(rest, 1e-9), 1e-12 * np.sum(r**2)) / spare
    t = np.abs(r) / np.sqrt(others * np.maximum(rest, 1e-9))
    worst = int(np.argmax(t))
    off = float(solved.error[worst] / rest[worst])
    if t[worst] <= coverage_factor(spare, 1.0 - FALSE_ALARM / len(r)) or abs(off) < SMALLEST_OUTLIER_G:
        return {}
    error = f"{1e3 * off:.2f} mg off the length by the other rests, t = {t[worst]:.0f}"
    return {worst: f"length of the specific force is {error}"}


def _on_table(
    rows: Orientations, solved: _Solved, before: SensorCalibration, prior: WanderPrior, settings: Settings
) -> SensorCalibration:
    """Return the calibration under white noise and bias wander, estimated from the residuals of ``y = b + K u``.

    The error of a sample is its noise along the direction of gravity, ``n^T L noise``, so that the estimate is linear
    in the readings of each channel c with the weights ``J^+ (n^T L)_c``.
    """
    count, parts = rows.rests.count, []
    for i in dict.fromkeys(rows.rests.recording.tolist()):
        recording, motion = rows.recordings[i], table_motion(rows.recordings[i], settings.table)
        assert motion is not None  # noqa: S101
        keep = np.zeros(recording.samples, bool)
        for start, stop in rows.rests.span[rows.rests.recording == i]:
            keep[start:stop] = True
        parts.append(TurnPart(recording, motion, keep & sound_samples(recording, "accelerometer")))
    truth = (rows.rests.reading - solved.fit.state.bias) @ solved.fit.state.matrix.T
    along = (truth / np.linalg.norm(truth, axis=1, keepdims=True)) @ solved.fit.state.matrix
    noise, row = noise_of_turns(parts, prior, settings.table), np.repeat(np.arange(len(count)), count)

    def map_of(weights: Values, derivative: Values) -> LinearMap:
        x, y, z = ((weights / count)[:, row] * along[row, c] for c in range(3))
        return LinearMap((x, y, z), (derivative, derivative, derivative))

    weights, share, white = ScaledColumns.of(solved.columns).weights(), solved.share, solved.fit.error
    linear = map_of((weights * share / white)[:, solved.rows], PLACED)
    scatter = noise_contribution(noise, linear, prior)
    lines = [scatter, *limits_contribution(solved.model, solved.fit)[0]]
    covariance = np.sum([line.covariance for line in lines], axis=0)
    stage = _stage(rows, solved, covariance, float(scatter.degrees_of_freedom.min()))
    reference = Reference("accelerometer", used_motions(parts), solved.fit.state.K, settings.table)
    at_limits = changes_on_table(reference, linear, (), settings.sensor.accelerometer)
    calibration = replace(with_stage(before, stage, solved.model, solved.fit), at_limits=at_limits)
    gravity, missing = gravity_line(calibration, settings.table)
    lines += gravity
    complete, trials = combined(calibration, lines, missing | OF_LENGTH), settings.uncertainty.monte_carlo
    if not trials:
        return complete
    if len(count) > MAX_COVARIANCE_ROWS:
        reason = f"{len(count)} readings of a continuous turn are too many equations to draw; it is made for rests"
        return replace(complete, budget=complete.budget and replace(complete.budget, monte_carlo=NoMonteCarlo(reason)))
    moved = quadratic_results(solved.columns / share[:, None], curvature(solved.model, solved.fit), np.diag(share**2))
    estimate, every = calibration.parameters.values, np.eye(len(count))

    def results(drawn: Values) -> Values:
        errors = np.pad(drawn / white[solved.rows], ((0, 0), (0, len(white) - len(count))))
        return np.asarray(estimate + moved(errors) @ PLACED.T)

    return with_trials(complete, through(noise.posterior(map_of(every, every)), [], results), trials, lines[1:])


def _parameters(solved: _Solved, covariance: Values) -> dict[str, Estimate]:
    """Return b, S and T with their uncertainties; ``L_ij = T_ij S_j``."""
    values = base_values(solved.fit.state.bias, solved.fit.state.matrix)[PLACE]
    S, J = np.diag(solved.fit.state.matrix)[LOWER_COLUMNS], np.eye(9)
    L, of_L = values[TRIANGLE], J[TRIANGLE, TRIANGLE]
    for k, (i, j) in enumerate(ELEMENTS):
        if i != j:
            L[k] /= S[k]
            of_L[k, k], of_L[k, ELEMENTS.index((j, j))] = 1.0 / S[k], -L[k] / S[k]
    units = [*base_units("accelerometer")[BIAS]] + ["1" if i == j else "rad" for i, j in ELEMENTS]
    named = zip(PARAMETER_NAMES.tolist(), zip(values.tolist(), units, strict=True), strict=True)
    return stage_parameters(dict(named), J @ covariance[np.ix_(PLACE, PLACE)] @ J.T)


def _stage(rows: Orientations, solved: _Solved, covariance: Values, freedom: float) -> StageResult:
    """Return the result of the stage; ``covariance``: (12, 12), of bias and matrix."""
    details = StageDetails(
        orientations_used=len(rows.rests.time),
        samples_used=int(rows.rests.count.sum()),
        rests_used=rest_uses(rows.used) if rows.by_hand else [],
        rests_left_out=rest_uses(rows.left_out),
        rests_held_out=rest_uses(rows.held_out),
        known_by_limit=solved.model.known_by_limit,
        white_noise=float(np.sqrt(np.mean(rows.white**2))),
        scatter_between_rests=solved.between,
        scatter_time_s=rows.rests.scatter_time or None,
        noise_of_means=float(np.sqrt(np.mean(rows.rests.own))) if np.all(rows.rests.own > 0.0) else None,
        largest_error=float(np.max(np.abs(solved.error))),
        condition=solved.fit.condition,
        cosine=solved.fit.cosine,
        degrees_of_freedom=freedom,
    )
    correction = Subtract(solved.fit.state.bias), Multiply(solved.fit.state.matrix)
    return StageResult(NAME, _parameters(solved, covariance), correction=correction, details=details)
