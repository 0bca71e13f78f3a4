"""The interval in which the held-out rms error lies with 99 % probability, if model, noise and uncertainties are right.

A calibrated reading of held-out sample n is off by

    x_n = M w_n + M m_n + J_n d

where

    w : white noise behind the filter
    m : bias wander: a Gauss-Markov process, and the slower drift that data sheet and residuals of the fit allow
    d : errors of the calibration's parameters, of its covariance, and of the scale of the table's rate
    M : the calibration's matrix;  J_n : derivative of the calibrated reading with respect to d

The calibration's covariance holds what the table's stated accuracies do to the parameters. A wrong scale of the logged
rate does the same to the reference of held-out motion, so it is counted once: in the covariance where that has such a
line, else as a parameter of its own.

The squared error of the magnitude is ``x' W x`` with ``W = u u' + g (1 - u u')``: u is the direction of the truth; g is
0 far from zero and 1 at rest, such that the mean is exact (``pipeline.validation.floor``). So ``rms_error^2`` is a
quadratic form in Gaussians, of cumulants

    k_1 = tr Q,   k_2 = 2 tr Q^2,   k_3 = 8 tr Q^3,      Q = A C

where C is the covariance of all w, m and d, and A their form. A shifted chi-square with the same three takes its place
(E. S. Pearson; J. P. Imhof, Biometrika 48 (1961), 419-426, section 4). For wander and parameters, Q is summed over
blocks of samples, so that its size does not depend on the number of samples.

A finite recording does not tell exactly how large the noise is. The levels of wander, drift and parameters are factors
of their variances with distributions of their own, and the interval is that of the mixture over ``LEVELS``:

    wander      exp(2 s z), z standard normal, s = sqrt(correlation time / length of static rest and fit)
    drift       z^2: its size is hardly known at all
    parameters  nu / chi^2(nu), nu the degrees of freedom of the calibration

and the variance of white noise has the relative uncertainty ``sqrt(2 / n)`` of the n samples that told it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.estimation.budget import DITHERED
from pipeline.estimation.selection import INFLATED
from pipeline.estimation.serial_noise import DEFAULT_TIME_S, SHARPEST_WIDTH, SHEET_WIDTH
from pipeline.signal.wander import block_covariance
from pipeline.validation.floor import norm_weight
from pipeline.validation.quadratic_form import Form, quantile

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.records import Noise, SensorCalibration
    from pipeline.validation.samples import Samples

    Values = NDArray[np.float64]

LACK = "lack of fit"  # the part of a budget's line that no noise explains: not in a model that is right
TAIL = 0.005  # of the probability, on each side
LEVELS = np.array(
    [0.0005, 0.004, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.98, 0.996, 0.9995]
)  # probabilities at which a level is taken
WEIGHTS = np.diff(np.concatenate([[0.0], 0.5 * (LEVELS[1:] + LEVELS[:-1]), [1.0]]))
BLOCKS = 40  # of all held-out recordings; wander within a block counts as noise that forgets in its correlation time
NARROWEST = 0.5  # s of a wander of minutes, which may be of another kind: of a random walk (study, null_random_walk)
FEW = 300  # samples by which white noise counts as known where no static recording tells it: some rests of seconds
KNOWN = 1e4  # degrees of freedom from which on a level is known


@dataclass(frozen=True)
class Judged:
    """Held-out samples of one recording beside the derivative of their calibrated readings.

    Attributes
    ----------
    samples : Samples
        Without missing ones; the recording may hold more that are like them.
    truth : (n, 3) array, g or deg/s
    derivative : (n, 3, p) array
        J, of the parameters of the calibration's covariance.
    number : int
        Samples that the recording holds.
    """

    samples: Samples
    truth: Values
    derivative: Values
    number: int


@dataclass(frozen=True)
class Inputs:
    """What is random beside the white noise.

    Attributes
    ----------
    covariance : (p + 1, p + 1) array
        Of the parameters and of the scale of the table's rate.
    noise : Noise
    coarse : (3,) array
        Variance of rounding that is no part of the white noise.
    drift : (3,) array
        Variance of a drift beside the wander.
    drift_time : float, s
    """

    covariance: Values
    noise: Noise
    coarse: Values
    drift: Values
    drift_time: float


def expected_rms_error(
    calibration: SensorCalibration,
    judged: Sequence[Judged],
    noise: Noise,
    settings: Mapping[str, Any],
    fitted_s: float = 0.0,
) -> tuple[float, float]:
    """Return the interval of the rms error, g or deg/s.

    Parameters
    ----------
    calibration : SensorCalibration
        With its covariance; without one, its parameters count as exact.
    judged : sequence of Judged
    noise : Noise
    settings : mapping
        Sections ``table`` (``rate_accuracy``) and ``sensor`` (``bias_wander``, ``wander_time_s``, ``counts_per_unit``).
    fitted_s : float, s
        Length of the recordings of the fit.
    """
    sheet = (settings.get("sensor") or {}).get(calibration.sensor) or {}
    step = 1.0 / float(sheet["counts_per_unit"]) if sheet.get("counts_per_unit") else 0.0
    inputs = Inputs(
        _covariance(calibration, settings.get("table") or {}),
        noise,
        np.where(noise.white < DITHERED * step, step**2 / 12.0, 0.0),
        _drift(calibration, noise, sheet),
        float(sheet.get("wander_time_s") or DEFAULT_TIME_S),
    )
    form = _form(calibration.matrix, judged, inputs)
    if form.cumulants(np.ones((4, 1)))[0, 0] <= 0.0:
        return 0.0, 0.0
    watched = noise.length + (fitted_s if _residual_wander(calibration) is not None else 0.0)
    low, high = (
        quantile(form, *_levels(calibration, noise, watched, upper=upper), 1.0 - TAIL if upper else TAIL)
        for upper in (False, True)
    )
    return float(np.sqrt(low)), float(np.sqrt(high))


def _drift(calibration: SensorCalibration, noise: Noise, sheet: Mapping[str, Any]) -> Values:
    """Return the variance of a drift beside the wander, per axis.

    It is what the data sheet expects of slow wander beyond the wander that was seen, and what the residuals of the fit,
    which last longer than a rest, show beyond it; of these at most ``INFLATED`` times as much as is expected, since a
    residual may hold an effect that is missing.
    """
    time, size = float(sheet.get("wander_time_s") or DEFAULT_TIME_S), float(sheet.get("bias_wander") or 0.0)
    slow = noise.wander**2 * min(1.0, noise.correlation_time / time)
    expected = np.maximum(noise.wander**2, size**2)
    found = _residual_wander(calibration)
    fitted = noise.wander**2 if found is None else np.minimum(found**2, INFLATED**2 * expected)
    return np.asarray(np.maximum(size**2 - slow, 0.0) + np.maximum(fitted - noise.wander**2, 0.0))


def _residual_wander(calibration: SensorCalibration) -> Values | None:
    """Return the wander that the residuals of the fit show, (3,), or None where its method does not tell it."""
    found = [s.details["bias_wander"] for s in calibration.stages if "bias_wander" in s.details]
    return np.array(found[-1]) if found else None


def _covariance(calibration: SensorCalibration, table: Mapping[str, Any]) -> Values:
    """Return the covariance of the parameters, but for lack of fit, and of the scale of the table's rate."""
    size = len(calibration.parameter_names())
    lines = (calibration.budget or {}).get("contributions", ())
    out = np.zeros((size + 1, size + 1))
    if calibration.covariance is not None:
        total = np.diag(calibration.covariance)
        lack = np.sum([np.square(line["parts"][LACK]) for line in lines if LACK in line["parts"]], axis=0)
        kept = np.sqrt(np.clip(1.0 - lack / np.where(total > 0.0, total, 1.0), 0.0, 1.0)) * np.ones(size)
        out[:size, :size] = calibration.covariance * kept[:, None] * kept
    if calibration.sensor == "gyroscope" and not any(line["source"] == "table rate" for line in lines):
        out[size, size] = float(table.get("rate_accuracy") or 0.0) ** 2
    return out


def _form(M: Values, judged: Sequence[Judged], inputs: Inputs) -> Form:
    noise, q = inputs.noise, len(inputs.covariance)
    total = sum(j.number for j in judged)
    white, within, size = np.zeros(2), np.zeros(2), q
    of_parameters, of_blocks = np.zeros((q, q)), []
    for each in judged:
        samples, n, share = each.samples, len(each.truth), each.number / total
        count = max(1, min(n, round(BLOCKS * share)))
        label = np.arange(n) * count // n
        first = np.searchsorted(label, np.arange(count))
        interval = (samples.time[-1] - samples.time[0]) / max(n - 1, 1) if n > 1 else 1.0
        start = samples.time[first]
        length = np.maximum(np.diff(start, append=samples.time[-1] + interval), 1e-6)
        B = block_covariance(start, length, noise.correlation_time)
        W = _weights(M, each, inputs)
        J = np.concatenate([each.derivative, -each.truth[:, :, None]], axis=2)
        WJ, MWM = W @ J, M.T @ W @ M
        of_parameters += share / n * np.tensordot(J, WJ, ([0, 1], [0, 1]))
        own = np.add.reduceat(MWM, first, axis=0) * share / n
        across = np.add.reduceat(np.swapaxes(WJ, 1, 2) @ M, first, axis=0) * share / n
        of_blocks.append((own, across, B, block_covariance(start, length, inputs.drift_time)))
        size += 3 * count
        Q = MWM * (samples.white + inputs.coarse)[:, None, :]
        white = white + _traces_of(Q) * [share, share**2 * samples.alike / each.number]
        left = np.clip(samples.wander - np.diag(B)[label, None] * noise.wander**2, 0.0, None)
        forgets = np.clip(noise.correlation_time / interval, 1.0, n / count) / n
        within = within + _traces_of(MWM * left[:, None, :]) * [share, share**2 * forgets]
    A, covariances = np.zeros((size, size)), np.zeros((3, size, size))
    A[:q, :q], covariances[0, :q, :q], at = of_parameters, inputs.covariance, q
    for own, across, B, slow in of_blocks:
        for b, (form, mixed) in enumerate(zip(own, across, strict=True)):
            mine = slice(at + 3 * b, at + 3 * b + 3)
            A[mine, mine], A[:q, mine], A[mine, :q] = form, mixed, mixed.T
        mine = slice(at, at + 3 * len(own))
        covariances[1, mine, mine] = np.kron(B, np.diag(noise.wander**2))
        covariances[2, mine, mine] = np.kron(slow, np.diag(inputs.drift))
        at = mine.stop
    Q = A @ covariances
    flat, turned = Q.reshape(3, -1), np.swapaxes(Q, 1, 2).reshape(3, -1)
    pairs = (Q[:, None] @ Q[None]).reshape(9, -1)
    told = noise.length / interval if noise.length > 0.0 else FEW
    return Form(
        white, within, 1.0 / told, np.trace(Q, axis1=1, axis2=2), flat @ turned.T, (pairs @ turned.T).reshape(3, 3, 3)
    )


def _traces_of(Q: Values) -> Values:
    """Return the means of ``tr Q`` and ``tr Q^2`` over samples: (2,) array."""
    return np.array([np.trace(Q, axis1=1, axis2=2).mean(), np.sum(Q * np.swapaxes(Q, 1, 2), axis=(1, 2)).mean()])


def _weights(M: Values, judged: Judged, inputs: Inputs) -> Values:
    """Return W of each sample: (n, 3, 3) array."""
    samples = judged.samples
    J, own = judged.derivative, inputs.covariance[:-1, :-1]
    noise = samples.white + samples.wander + inputs.drift + inputs.coarse
    mean = np.einsum("ij,j,kj->ik", M, noise.mean(axis=0), M) + np.einsum(
        "nip,pq,njq->ij", J, own, J, optimize=True
    ) / len(J)
    size = np.linalg.norm(judged.truth, axis=1)
    u = judged.truth / np.where(size > 0.0, size, 1.0)[:, None]
    g = norm_weight(judged.truth, mean)[:, None, None]
    return np.asarray((1.0 - g) * u[:, :, None] * u[:, None, :] + g * np.eye(3))


def _levels(calibration: SensorCalibration, noise: Noise, watched: float, *, upper: bool) -> tuple[Values, Values]:
    """Return the levels that are mixed, (4, k), and their probabilities (k,).

    At the lower end drift and errors of parameters are left out, and wander is as little known as a data sheet tells
    it: none of them need have happened in this recording.
    """
    from scipy.special import gammaincinv, ndtri  # noqa: PLC0415  (0.1 s that other stages do not pay)

    z = ndtri(LEVELS)
    width = SHEET_WIDTH
    if upper and watched > 0.0:
        minutes = min(1.0, noise.correlation_time / DEFAULT_TIME_S)
        width = np.sqrt(max(noise.correlation_time / watched, NARROWEST**2 * minutes))
        width = float(np.clip(width, SHARPEST_WIDTH, SHEET_WIDTH))
    told = noise.source != "data_sheet"
    wander = np.exp(2.0 * width * z)
    drift = 2.0 * gammaincinv(0.5, LEVELS) if upper else np.zeros(len(z))
    white = np.ones(len(z)) if told else np.exp(2.0 * SHEET_WIDTH * z)
    nu = max(calibration.degrees_of_freedom, 1.0)
    parameters, weights = np.full(1, float(upper)), np.ones(1)
    if upper and nu < KNOWN:
        parameters, weights = 0.5 * nu / gammaincinv(0.5 * nu, 1.0 - LEVELS), WEIGHTS
    shape = (len(parameters), len(z))
    slow = [np.broadcast_to(values, shape).ravel() for values in (wander, drift, white)]
    return np.stack([np.repeat(parameters, len(z)), *slow]), np.outer(weights, WEIGHTS).ravel()
