"""What a calibration is worth in an attitude: its drift on held-out motion, before and after.

Gyroscope alone, from the table's attitude at the start:

    q[n+1] = q[n] exp(a[n] / 2)
    a[n] = dt (13 w[n] + 13 w[n+1] - w[n-1] - w[n+2]) / 24 + dt^2 (w[n] x w[n+1]) / 12

where

    q : attitude, body to level, unit quaternion
    w : angular rate, rad/s
    a : rotation vector over one interval, of rates that run through four samples as a cubic. Source: A. Iserles et al.,
        Lie-group methods, Acta Numerica 9 (2000), 215-365, section 4 (Magnus expansion)

The drift after one minute is the angle between what the integral and what the table say that the sensor turned in any
minute of the recording, root mean square over its starts. With the accelerometer an attitude is fused by the
complementary filter of x-io Technologies' Fusion (``imufusion``; S. Madgwick, AHRS algorithms and calibration
solutions, PhD thesis, Bristol 2014, chapter 7); its tilt, the angle between the verticals, is what gravity keeps from
drifting.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import InputError
from pipeline.model.compensation import Compensation
from pipeline.records import level_in_body

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pipeline.records import Recording, SensorCalibration

    Array = NDArray[np.float64]

MINUTE = 60.0
STARTS = 60  # of the minutes over which a drift is averaged
SHORTEST = 10.0  # s of a recording that is worth a drift
CURVE = 120  # points of the published curves
STEP_S, STEP_DEG = 0.1, 5.0  # of the complementary filter, which integrates to first order
GAIN = 0.5  # of the complementary filter: its library's default
SETTLED = 10.0  # s after which the tilt counts


def attitude(
    accelerometer: SensorCalibration | None, gyroscope: SensorCalibration | None, recordings: Sequence[Recording]
) -> dict[str, Any]:
    """Return the part ``attitude`` of ``validations/<unit>.json``.

    Parameters
    ----------
    accelerometer, gyroscope : SensorCalibration or None
    recordings : sequence of Recording
        Of the unit; looked at is the first of role ``validation`` that logs the table's attitude.

    Returns
    -------
    dict
        ``reason`` (why there is none, else None), ``recording``, ``seconds`` (60, or the recording's length),
        ``drift_deg`` and ``tilt_rms_deg`` (each ``before`` and ``after``) and ``curve``: ``time_s`` and, deg, the angle
        of the gyroscope alone (``drift_before``, ``drift_after``) and the tilt of the fused attitude (``tilt_...``).
    """
    recording = next((r for r in recordings if r.role == "validation" and r.table_attitude is not None), None)
    if recording is None:
        return {"reason": "no held-out recording logs the table's attitude"}
    if recording.gyroscope is None or gyroscope is None:
        return {"reason": "the gyroscope is not calibrated"}
    known, reference = _beside_table(recording)
    if known.samples < 2 or known.time[-1] - known.time[0] < SHORTEST:
        return {"reason": f"recording {recording.name} is shorter than {SHORTEST:g} s"}
    try:
        compensated = Compensation(accelerometer, gyroscope).apply(
            known.accelerometer, known.gyroscope, known.temperature, known.time
        )
    except InputError as error:
        return {"reason": str(error)}
    found: dict[str, Any] = {"reason": None, "recording": recording.name}
    found["seconds"] = float(min(MINUTE, known.time[-1] - known.time[0]))
    found |= {"drift_deg": {}, "tilt_rms_deg": {} if accelerometer and known.accelerometer is not None else None}
    shown = np.unique(np.linspace(0, known.samples - 1, CURVE).astype(int))
    found["curve"] = {"time_s": _rounded(known.time[shown] - known.time[0])}
    pairs = {
        "before": (known.accelerometer, known.gyroscope),
        "after": (compensated.accelerometer, compensated.gyroscope),
    }
    for name, (force, rate) in pairs.items():
        assert rate is not None  # noqa: S101
        alone = integrate(known.time, rate, reference[0])
        found["drift_deg"][name] = drift(known.time, alone, reference, found["seconds"])
        found["curve"][f"drift_{name}"] = _rounded(angle_between(alone, reference)[shown])
        if found["tilt_rms_deg"] is not None:
            assert force is not None  # noqa: S101
            at, fused = fuse(known.time, force, alone)
            tilt, since = tilt_between(fused, reference[at]), known.time[at] - known.time[0]
            found["tilt_rms_deg"][name] = float(np.sqrt(np.mean(tilt[since >= min(SETTLED, 0.5 * since[-1])] ** 2)))
            found["curve"][f"tilt_{name}"] = _rounded(np.interp(known.time[shown] - known.time[0], since, tilt))
    return found


def integrate(time: Array, rate: Array, start: Array) -> Array:
    """Return the attitude that angular rates add up to: (n, 4) array, the first of them ``start``.

    Parameters
    ----------
    time : (n,) array, s
    rate : (n, 3) array, deg/s
    start : (4,) array
    """
    w, dt = np.radians(rate), np.diff(time)[:, None]
    mean = 0.5 * (w[:-1] + w[1:])
    mean[1:-1] += (w[1:-2] + w[2:-1] - w[:-3] - w[3:]) / 24.0
    half = 0.5 * (dt * mean + dt**2 / 12.0 * np.cross(w[:-1], w[1:]))
    size = np.linalg.norm(half, axis=1, keepdims=True)
    q = np.concatenate([start[None], np.hstack([np.cos(size), np.sinc(size / np.pi) * half])])
    step = 1
    while step < len(q):  # products of 2, 4, 8 ... neighbours: a running product in log2 n passes
        q[step:] = product(q[:-step], q[step:])
        step *= 2
    normed: NDArray[np.float64] = q / np.linalg.norm(q, axis=1, keepdims=True)
    return normed


def fuse(time: Array, force: Array, alone: Array) -> tuple[NDArray[np.int64], Array]:
    """Return the attitude of the complementary filter, at samples about 0.1 s or 5 deg apart.

    Parameters
    ----------
    time : (n,) array, s
    force : (n, 3) array, g
    alone : (n, 4) array
        Attitude of the gyroscope alone, whose turns between those samples are the rates that the filter is fed with.

    Returns
    -------
    (m,) array of int, (m, 4) array
        The samples, and the attitude at them; the first is that of the gyroscope alone.
    """
    import imufusion  # noqa: PLC0415  (only units with a logged attitude pay for it)

    turns = angle_between(alone[:-1], alone[1:])
    within = min(STEP_S / float(np.median(np.diff(time))), STEP_DEG / max(float(turns.max()), 1e-9))
    at = np.arange(0, len(time), max(1, int(within)))
    intervals = np.diff(time[at])
    rates = rotation_vector(product(conjugate(alone[at[:-1]]), alone[at[1:]])) / intervals[:, None]
    settings = imufusion.AhrsSettings(
        sample_rate=float(1.0 / np.median(intervals)),
        convention=imufusion.CONVENTION_NWU,
        gain=GAIN,
        gyroscope_range=0.0,
        acceleration_rejection=0.0,
        magnetic_rejection=0.0,
        rejection_timeout=0.0,
    )
    fusion = imufusion.Ahrs().set_settings(settings).skip_startup().set_quaternion(alone[0])
    q = np.empty((len(at), 4))
    q[0] = alone[0]
    # The filter holds the force against the attitude before its step.
    for n, (interval, rate, felt) in enumerate(zip(intervals.tolist(), rates, force[at[:-1]], strict=True), 1):
        fusion.set_sample_period(interval)
        fusion.update_no_magnetometer(rate, felt)
        q[n] = fusion.get_quaternion()
    return at, q


def drift(time: Array, estimate: Array, reference: Array, seconds: float) -> float:
    """Return by how much an attitude is off after so many seconds, root mean square over starts, deg.

    Parameters
    ----------
    time : (n,) array, s
    estimate, reference : (n, 4) array
    seconds : float
    """
    last = int(np.searchsorted(time, time[-1] - seconds + 1e-6, "right")) - 1
    start = np.unique(np.linspace(0, max(last, 0), STARTS).astype(int))
    interval = float(np.median(np.diff(time)))
    stop = np.minimum(np.searchsorted(time, time[start] + seconds - 0.5 * interval), len(time) - 1)
    turned = [product(conjugate(q[start]), q[stop]) for q in (estimate, reference)]
    return float(np.sqrt(np.mean(angle_between(*turned) ** 2)))


def angle_between(p: Array, q: Array) -> Array:
    """Return the angle of the rotation from one attitude to another: (n,) array, deg."""
    angle: NDArray[np.float64] = np.linalg.norm(rotation_vector(product(conjugate(p), q)), axis=1)
    return angle


def rotation_vector(q: Array) -> Array:
    """Return axis times angle of rotations by less than 180 deg: (n, 3) array, deg."""
    size = np.linalg.norm(q[:, 1:], axis=1)
    angle = np.degrees(2.0 * np.arctan2(size, np.abs(q[:, 0])))
    vector: NDArray[np.float64] = (np.sign(q[:, 0]) * angle / np.maximum(size, 1e-300))[:, None] * q[:, 1:]
    return vector


def tilt_between(p: Array, q: Array) -> Array:
    """Return the angle between the verticals of two attitudes: (n,) array, deg."""
    up, other = level_in_body(p), level_in_body(q)
    across = np.linalg.norm(np.cross(up, other), axis=1)
    angle: NDArray[np.float64] = np.degrees(np.arctan2(across, np.einsum("ij,ij->i", up, other)))
    return angle


def product(p: Array, q: Array) -> Array:
    """Return the products of quaternions: (n, 4) array."""
    (a, b, c, d), (w, x, y, z) = p.T, q.T
    return np.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ],
        1,
    )


def conjugate(q: Array) -> Array:
    """Return the inverse rotations: (n, 4) array."""
    inverse: NDArray[np.float64] = q * np.array([1.0, -1.0, -1.0, -1.0])
    return inverse


def _beside_table(recording: Recording) -> tuple[Recording, Array]:
    """Return the samples whose readings and attitude are known, and the table's attitude, as late as the readings."""
    q = recording.table_attitude
    assert q is not None  # noqa: S101
    readings = [v for v in (recording.accelerometer, recording.gyroscope) if v is not None]
    known, logged = np.isfinite(np.hstack(readings)).all(axis=1), np.isfinite(q).all(axis=1)
    clock, q = recording.time[logged], q[logged]
    late = recording.time - float(recording.filter.get("delay_s", 0.0))
    known &= (late >= clock[:1].sum()) & bool(len(clock))
    same = np.concatenate([[1.0], np.cumprod(np.where(np.einsum("ij,ij->i", q[:-1], q[1:]) < 0.0, -1.0, 1.0))])
    smooth = np.stack([np.interp(late[known], clock, c) for c in (q * same[: len(q), None]).T], 1)
    normed: NDArray[np.float64] = smooth / np.linalg.norm(smooth, axis=1, keepdims=True)
    return recording.select(known), normed


def _rounded(values: Array) -> list[float]:
    return [float(f"{v:.4g}") for v in values]
