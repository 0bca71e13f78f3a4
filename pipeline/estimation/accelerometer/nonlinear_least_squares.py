"""Nine parameters of the accelerometer from the length of gravity (paper eqs 1 and 4; Sudsanguan 2019, 5.5-5.6).

    u = T S (y - b),   minimise  sum_i w_i (|u_i| - G)^2

with the bias b, the scale factors S and the unit lower triangular misalignment T: x of the sensor is x of the body, and
its y lies in the plane of x and y, since the length of gravity says nothing of how the sensor is mounted. The
orientations need not be known. See ``pipeline.estimation.accelerometer.ellipsoid_fit`` for the equations.

A misalignment that the orientations do not determine, as in six positions, is left at zero, and the result says so. On
a table the errors of the rows are correlated by the bias wander, whose covariance is that of
``pipeline.estimation.engine``; by hand that of ``pipeline.estimation.accelerometer.orientations``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import NotObservableError
from pipeline.estimation.accelerometer.ellipsoid_fit import (
    COLUMNS,
    MISALIGNMENT,
    NAMES,
    ROWS,
    derivative_of,
    fit_ellipsoid,
)
from pipeline.estimation.accelerometer.orientations import (
    RestErrors,
    orientations_of,
    rest_candidates,
    rest_scatter,
    without,
)
from pipeline.estimation.engine import LinearMap, Posterior, assess_noise
from pipeline.estimation.least_squares import ScaledColumns, certified
from pipeline.estimation.monte_carlo import beside_trials, quadratic_results, through, trials_of, without_trials
from pipeline.estimation.noise import prior_of
from pipeline.estimation.rest_means import describe_rests
from pipeline.estimation.table_errors import Reference, disturbance
from pipeline.estimation.turns import blocks_of_samples
from pipeline.estimation.uncertainty_budget import (
    combined,
    gravity_contribution,
    noise_contribution,
    scatter_contribution,
)
from pipeline.model.kinematics import table_motion
from pipeline.records import SensorCalibration, StageResult, coverage_factor

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from pipeline.estimation.accelerometer.ellipsoid_fit import Ellipsoid
    from pipeline.estimation.accelerometer.orientations import Orientations
    from pipeline.estimation.engine import ResidualNoise
    from pipeline.estimation.gauss_markov import Prior
    from pipeline.records import Contribution, Motion, Recording, Values

NAME = "nonlinear_least_squares"
MISALIGNMENT_UNKNOWN = 0.05  # rad, standard uncertainty above which the rests do not determine a misalignment
UNKNOWN = 0.05  # g of a bias, relative of a scale factor: beyond it nothing of them is known
FALSE_ALARM = 1e-3  # probability of calling one of the rests of a sound recording an outlier
SMALLEST_OUTLIER_G = 1e-6  # rests of a noise-free recording are no outliers
FEWEST_TO_JUDGE = 18  # rests, two a parameter
OUTLIER_SHARE = 0.2  # of the rests: where more are off, none can be called wrong
MOST_ROWS = 600  # of which a covariance is drawn


def fit(
    recordings: Sequence[Recording], previous: SensorCalibration | None, settings: Mapping[str, Any]
) -> SensorCalibration:
    """Fit bias, scale factors and misalignment of the accelerometer.

    ``recordings``: rests in many orientations (role ``rests``), or a table's turns (role ``accelerometer``).
    ``previous``: the result of the stage before; only its stages are kept. ``settings``: sections ``table``
    (``gravity_g``), ``procedure`` (``holdout_every``; ``faces``: the full matrix, by
    ``pipeline.estimation.multi_position.result``) and ``sensor``. Raises ``CannotCalibrateError`` if there is no
    recording for it; ``NotObservableError`` if the orientations are too few or too much alike, or a stated face is
    missing.
    """
    if not settings["procedure"].get("faces"):
        return _fit_triangular(recordings, previous, settings)
    from pipeline.estimation.multi_position.result import fit_faces, require_faces  # noqa: PLC0415  (needs this module)

    require_faces(recordings, settings)
    return fit_faces(_fit_triangular(recordings, previous, settings), recordings, settings)


def _fit_triangular(
    recordings: Sequence[Recording], previous: SensorCalibration | None, settings: Mapping[str, Any]
) -> SensorCalibration:
    gravity_g = float(settings["table"].get("gravity_g", 1.0))
    orientations = orientations_of(recordings, settings)
    found = _fit_determined(orientations, gravity_g)
    while refused := _outlier(orientations, found):
        orientations = without(orientations, refused)
        found = _fit_determined(orientations, gravity_g)
    prior = prior_of("accelerometer", recordings, settings)
    scatter = _scatter(orientations, found, prior, settings["table"])
    result = StageResult(
        name=NAME,
        parameters=_parameters(found, scatter.covariance),
        residual_rms=float(np.sqrt(np.mean(found.error**2))),
        correction={"steps": [{"subtract": found.bias.tolist()}, {"matrix": found.matrix.tolist()}]},
        details=_details(orientations, found, float(scatter.degrees_of_freedom.min())),
    )
    place = np.zeros((12, 9))
    place[[0, 1, 2, *(3 + 3 * ROWS + COLUMNS).tolist()], np.arange(9)] = 1.0
    calibration = SensorCalibration(
        sensor="accelerometer",
        bias=found.bias,
        matrix=found.matrix,
        stages=(*(previous.stages if previous else ()), result),
        converged=found.fit.converged,
        convergence=certified(found.fit.cosine, found.fit.condition, found.fit.rank, int(found.free.sum())),
    )
    gravity = gravity_contribution("accelerometer", found.matrix, settings["table"], 12)
    lines = [scatter.placed(place), *([gravity] if gravity else [])]
    complete = combined(calibration, lines, _not_included(gravity))
    trials = trials_of(settings)
    if not trials:
        return complete
    errors = _row_errors(orientations, found, prior, settings["table"])
    steps = _second_order(orientations, found)

    def results(drawn: Values) -> Values:
        values = np.tile(np.concatenate([found.bias, found.matrix.ravel()]), (len(drawn), 1))
        return np.asarray(values + steps(drawn) @ place[:, found.free].T)

    if isinstance(errors, str):
        return without_trials(complete, errors)
    return beside_trials(complete, through(errors, [], results), trials, lines[1:])


def _row_errors(
    orientations: Orientations, found: Ellipsoid, prior: Prior, table: Mapping[str, Any]
) -> Posterior | str:
    """Return the distribution of the rows' errors, or why there is none."""
    rows, every = len(orientations.mean), np.eye(len(orientations.mean))
    spare = found.fit.degrees_of_freedom
    if rows > MOST_ROWS:
        return f"{rows} readings of a continuous turn are too many equations to draw; it is made for rests"
    if spare <= 1:
        variance = orientations.variance + prior.wander**2
        return Posterior(np.ones(1), np.diag(variance)[None], float(3 * np.sum(orientations.count - 1)))
    if orientations.by_hand and orientations.rests:
        J = derivative_of(orientations.mean, found.values)[:, found.free]
        weight, candidates = rest_candidates(_errors(orientations, found, J), every, prior)
        return Posterior(weight, candidates, np.inf)
    noise, along = _table_noise(orientations, found, prior, table)
    per_sample = np.where(np.arange(rows)[:, None] == orientations.row, 1.0 / orientations.count[orientations.row], 0.0)
    x, y, z = (per_sample * along[orientations.row, c] for c in range(3))
    return noise.posterior(LinearMap((x, y, z), (every, every, every)))


def _second_order(orientations: Orientations, found: Ellipsoid) -> Callable[[Values], Values]:
    """Return how errors of the rows move the fitted values."""
    y, values, step = orientations.mean, found.values, 1e-5
    moved = step * np.eye(9)[found.free]
    slopes = [derivative_of(y, values + d)[:, found.free] - derivative_of(y, values - d)[:, found.free] for d in moved]
    H = np.stack(slopes, axis=2) / (2.0 * step)
    return quadratic_results(derivative_of(y, values)[:, found.free], H, np.diag(found.weight**2))


def _not_included(gravity: Contribution | None) -> dict[str, str]:
    reasons = {
        "table angle, rate and orthogonality, levelling": "the length of gravity does not change with the attitude",
        "quantisation": "contained in the noise of the readings, as the rests scatter",
        "temperature": "the parameters hold at the temperature of these recordings; "
        "no accuracy of the thermometer is stated",
        "time base": "no time enters the length of gravity",
    }
    return reasons if gravity else {"local gravity": "table.gravity_accuracy_g is not stated", **reasons}


def _fit_determined(orientations: Orientations, gravity_g: float) -> Ellipsoid:
    """Fit bias, scale factors and those misalignments that the orientations determine."""
    rows = len(orientations.mean)
    if rows < 6:
        raise NotObservableError(
            f"{rows} orientations determine neither bias nor scale factors: {_left(orientations)}. Record rests in at "
            "least 6 orientations, each axis up and down, or better in 24 that are spread evenly"
        )
    free = np.full(9, fill_value=True) if rows >= 9 else ~MISALIGNMENT
    while True:
        try:
            found = fit_ellipsoid(orientations, gravity_g, free)
        except NotObservableError as lack:
            if not np.any(free & MISALIGNMENT):
                raise NotObservableError(
                    f"the {rows} orientations are too much alike: {lack.message} ({_left(orientations)}). Record rests "
                    "with each axis up, down and level, spread evenly"
                ) from lack
            free = ~MISALIGNMENT
            continue
        uncertainty = np.where(MISALIGNMENT, found.standard_uncertainty, 0.0)
        if np.max(uncertainty) <= MISALIGNMENT_UNKNOWN:
            return _require_determined(found, orientations)
        free = free & (np.arange(9) != np.argmax(uncertainty))


def _require_determined(found: Ellipsoid, orientations: Orientations) -> Ellipsoid:
    """Refuse a bias or scale factor that the orientations leave as open as no sensor is."""
    u = np.where(MISALIGNMENT, 0.0, found.standard_uncertainty)
    weak = [name for name, one in zip(NAMES, u, strict=True) if one > UNKNOWN]
    if weak:
        raise NotObservableError(
            f"the {len(orientations.mean)} orientations are nearly degenerate: they leave {', '.join(weak)} open to "
            f"{float(u.max()):.2g} (standard uncertainty; condition {found.fit.condition:.1e} in scaled columns). "
            "Record rests with each axis up, down and level, spread evenly, not all in one plane or direction"
        )
    return found


def _left(orientations: Orientations) -> str:
    left_out, held_out = len(orientations.left_out), len(orientations.held_out)
    return f"{left_out} rests were left out because the sensor moved, {held_out} are held out for validation"


def _outlier(orientations: Orientations, found: Ellipsoid) -> dict[int, str]:
    """Return the hand-held rest that contradicts the others most, if it does, with the reason.

    A rest is compared with what the others alone say: with its leverage h, its weighted error r and p parameters,
    ``t = r / (s sqrt(1 - h))`` follows Student's t with m - p - 1 degrees of freedom, where s is the scatter of the
    others, ``s^2 = (sum r^2 - r^2 / (1 - h)) / (m - p - 1)`` (Belsley, Kuh & Welsch 1980, section 2.1).
    """
    m, left_out = len(found.error), len(orientations.left_out)
    if not orientations.by_hand or m < FEWEST_TO_JUDGE or left_out >= OUTLIER_SHARE * (m + left_out):
        return {}
    J = derivative_of(orientations.mean, found.values)[:, found.free]
    rest = 1.0 - np.sum(ScaledColumns.of(found.weight[:, None] * J).basis ** 2, axis=1)
    r, spare = found.weight * found.error, m - int(found.free.sum()) - 1
    others = np.maximum(np.sum(r**2) - r**2 / np.maximum(rest, 1e-9), 1e-12 * np.sum(r**2)) / spare
    t = np.abs(r) / np.sqrt(others * np.maximum(rest, 1e-9))
    worst = int(np.argmax(t))
    off = float(found.error[worst] / rest[worst])
    if t[worst] <= coverage_factor(spare, 1.0 - FALSE_ALARM / m) or abs(off) < SMALLEST_OUTLIER_G:
        return {}
    return {
        worst: f"length of the specific force is {1e3 * off:.2f} mg off what the other rests say, t = {t[worst]:.0f}"
    }


def _scatter(orientations: Orientations, found: Ellipsoid, prior: Prior, table: Mapping[str, Any]) -> Contribution:
    """Return what the readings' scatter contributes to b and L."""
    spare = found.fit.degrees_of_freedom
    if not orientations.by_hand and spare > 1:
        return _serial_scatter(orientations, found, prior, table)
    place = np.eye(9)[:, found.free]
    J = derivative_of(orientations.mean, found.values)[:, found.free]
    gain = _gain(J, found.weight)
    if spare > 1 and orientations.rests:
        return rest_scatter(_errors(orientations, found, J), gain, prior).placed(place)
    # Too few rests to show a scatter of their own: what is believed of the bias wander stands in.
    white = gain * orientations.variance @ gain.T
    covariance = gain * (orientations.variance + prior.wander**2) @ gain.T
    parts = {"white noise": np.sqrt(np.diag(white)), "bias wander": np.sqrt(np.diag(covariance - white))}
    freedom = float(3 * np.sum(orientations.count - 1))
    return scatter_contribution(covariance, freedom, parts).placed(place)


def _gain(J: Values, weight: Values) -> Values:
    """Return the weights of the readings in the estimate, ``(J^T W J)^-1 J^T W`` with W = diag(weight^2)."""
    factors = ScaledColumns.of(weight[:, None] * J)
    factors.require_full_rank()
    return factors.weights() * weight


def _errors(orientations: Orientations, found: Ellipsoid, J: Values) -> RestErrors:
    """Return the errors of hand-held rests, with their times."""
    truth = (orientations.mean - found.bias) @ found.matrix.T
    edges = [(r.time[rest.start], r.time[rest.stop - 1] + r.interval) for r, rest in orientations.rests]
    start, stop = np.array(edges).T
    own = np.array([id(recording) for recording, _ in orientations.rests])
    shared = all(recording.clock_shared for recording, _ in orientations.rests)
    return RestErrors(
        error=found.error,
        derivative=J,
        along=truth / np.linalg.norm(truth, axis=1, keepdims=True) @ found.matrix,
        variance=orientations.variance,
        between=found.between,
        start=start,
        length=stop - start,
        joined=np.full((len(own), len(own)), shared) | (own[:, None] == own),
    )


def _serial_scatter(
    orientations: Orientations, found: Ellipsoid, prior: Prior, table: Mapping[str, Any]
) -> Contribution:
    """Return the scatter under white noise and bias wander, as the residuals of ``y = b + K u`` on the table tell it.

    The error of a sample is its noise along the direction of gravity, ``n^T L noise``, so that the estimate is linear
    in the readings of each channel c with the weights ``J^+ (n^T L)_c``.
    """
    row = orientations.row
    J = derivative_of(orientations.mean, found.values)[:, found.free]
    noise, along = _table_noise(orientations, found, prior, table)
    per_sample = (_gain(J, found.weight) / orientations.count)[:, row]
    weights_x, weights_y, weights_z = (per_sample * along[row, c] for c in range(3))
    place = np.eye(9)[:, found.free]
    return noise_contribution(noise, LinearMap((weights_x, weights_y, weights_z), (place, place, place)), prior)


def _table_noise(
    orientations: Orientations, found: Ellipsoid, prior: Prior, table: Mapping[str, Any]
) -> tuple[ResidualNoise, Values]:
    """Return the noise on the table, and ``n^T L`` of each row: (m, 3) array."""
    L = found.matrix
    truth = (orientations.mean - found.bias) @ L.T
    along = (truth / np.linalg.norm(truth, axis=1, keepdims=True)) @ L
    motions = [_motion(recording, table).select(keep) for recording, keep in orientations.parts]
    u = np.concatenate([motion.specific_force for motion in motions])
    X, reading = np.column_stack([np.ones(len(u)), u]), orientations.reading()
    factors, blocks = ScaledColumns.of(X), blocks_of_samples(orientations.parts)
    beta, A, every = factors.solve(reading), factors.weights(), np.eye(4)
    residuals = reading - X @ beta
    reference = Reference("accelerometer", motions, LinearMap((A, A, A), (every, every, every)), beta[1:].T, table)
    return assess_noise(residuals, X, blocks, prior, disturbance(reference, residuals, blocks)), along


def _motion(recording: Recording, table: Mapping[str, Any]) -> Motion:
    motion = table_motion(recording, table)
    assert motion is not None  # noqa: S101
    return motion


def _parameters(found: Ellipsoid, covariance: Values) -> dict[str, dict[str, Any]]:
    """Return b, S and T with their uncertainties; ``L_ij = T_ij S_j``."""
    S = np.diag(found.matrix)[COLUMNS]
    diagonal = {int(i): 3 + k for k, (i, j) in enumerate(zip(ROWS, COLUMNS, strict=True)) if i == j}
    J, values = np.eye(9), found.values.copy()
    for k in np.flatnonzero(ROWS != COLUMNS):
        values[3 + k] /= S[k]
        J[3 + k, 3 + k], J[3 + k, diagonal[int(COLUMNS[k])]] = 1.0 / S[k], -values[3 + k] / S[k]
    own = np.sqrt(np.clip(np.diag(J @ covariance @ J.T), 0.0, None))
    units = ["g"] * 3 + ["1" if i == j else "rad" for i, j in zip(ROWS, COLUMNS, strict=True)]
    return {
        name: {"value": float(value), "unit": unit, "standard_uncertainty": float(u) if is_free else None}
        for name, value, unit, u, is_free in zip(NAMES, values, units, own, found.free, strict=True)
    }


def _details(orientations: Orientations, found: Ellipsoid, freedom: float) -> dict[str, Any]:
    return {
        "orientations_used": len(orientations.mean),
        "samples_used": int(orientations.count.sum()),
        "rests_used": describe_rests(orientations.rests),
        "rests_left_out": describe_rests(orientations.left_out),
        "rests_held_out": describe_rests(orientations.held_out),
        "fixed": [name for name, is_free in zip(NAMES, found.free, strict=True) if not is_free],
        "white_noise": orientations.white,
        "scatter_between_rests": found.between,
        "largest_error": float(np.max(np.abs(found.error))),
        "condition": found.fit.condition,
        "cosine": found.fit.cosine,
        "degrees_of_freedom": freedom,
    }
