"""Compute the motion of the body from the log of a table.

A turn about body axis ``a`` by the angle ``A(t)``:

    f = g * R_a(-A) up_a,   omega = dA/dt e_a,   df/dt = -omega x f

where ``R_a`` is the right-handed rotation about axis a, ``up_a`` the body axis that points up at angle 0 (z for turns
about x and y, x for turns about z), ``g`` the local gravity in g, and omega in rad/s.

An attitude ``q(t)`` (w, x, y, z; body to level with z up):

    f = g * R(q)^T e_z,   omega = 2 vec(conj(q) dq/dt),   alpha = 2 vec(conj(q) d2q/dt2)

with the derivatives of a quintic spline through the quaternion's components. At 0.12 s and 200 deg/s its truncation
error is below 1e-3 deg/s; a central difference would be wrong by 1 %.

Earth's rotation (15.041 deg/h) is added to omega where latitude and azimuth are given.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import numpy as np

from pipeline.core.errors import InputError
from pipeline.core.records import (
    AXES,
    Motion,
    Recording,
    Values,
    attitude_matrix,
    continuous,
    cross,
    level_in_body,
    once_of_log,
    quintic_spline,
    rotation_deg,
)
from pipeline.core.settings import Table
from pipeline.physics.signal.encoder_rate import EncoderTrajectory, Pieces, rate_by_angle
from pipeline.physics.signal.filters import temperature_of, temperature_rate_of
from pipeline.physics.signal.rests import still_samples

EARTH_RATE_DPS = 360.0 / 86164.0905  # a sidereal day, s
UP_AT_ZERO = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])  # see above
# Rows: level x, y, z axes in the body frame at table angle 0, for turns about x, y, z.
LEVEL_AT_ZERO = np.array([np.eye(3), np.eye(3), [[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]])
ABOUT = np.cross(np.eye(3)[:, None], np.eye(3)).transpose(0, 2, 1)  # ABOUT[a] @ u = e_a x u


def earth_rate(latitude_deg: float, azimuth_deg: float) -> Values:
    """Return Earth's rotation in the level frame: (3,) array, deg/s.

    ``Omega (cos L cos A, cos L sin A, sin L)`` with latitude L and azimuth A of level x, clockwise from north.
    """
    latitude, azimuth = np.radians([latitude_deg, azimuth_deg])
    horizontal = np.cos(latitude)
    direction = np.array([horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), np.sin(latitude)])
    return EARTH_RATE_DPS * direction


def normal_gravity_g(latitude_deg: float) -> float:
    """Return gravity at sea level by WGS 84, g.

    ``9.7803253359 (1 + 0.00193185265241 s) / sqrt(1 - 0.00669437999014 s) m/s^2`` with ``s = sin^2 latitude``
    (NIMA TR8350.2, eq. 4-1).
    """
    s = float(np.sin(np.radians(latitude_deg))) ** 2
    return float(9.7803253359 * (1.0 + 0.00193185265241 * s) / np.sqrt(1.0 - 0.00669437999014 * s) / 9.80665)


def earth_of(table: Table) -> Values | None:
    """Return Earth's rotation in the level frame; None where the table's latitude or azimuth is not set."""
    latitude, azimuth = table.latitude_deg, table.azimuth_deg
    return None if latitude is None or azimuth is None else earth_rate(latitude, azimuth)


def table_motion(recording: Recording, table: Table) -> Motion | None:
    """Return ``reference_motion`` with gravity, latitude and azimuth of a table's configuration."""
    earth, one_shaft = earth_of(table), table.azimuth_of == "turn_axis"
    known = None if earth is None else tuple(earth.tolist())
    return reference_motion(recording, table.gravity_g, known, one_shaft=one_shaft)


@once_of_log
def reference_motion(
    recording: Recording, gravity_g: float = 1.0, earth: tuple[float, ...] | None = None, *, one_shaft: bool = False
) -> Motion | None:
    """Return the motion of a recording by the log of the table; None where the recording has no such log.

    ``recording``: with ``table_angle`` and an axis, or with ``table_attitude``. ``earth``: Earth's rotation in the
    level frame, deg/s, or None. ``one_shaft``: level x is the axis about which the encoder counts right-handed, the
    same in all turns (``table.azimuth_of``), not the body axis at angle 0. Raises ``InputError`` if there are too few
    samples to differentiate the log.
    """
    if recording.axis is not None and recording.table_angle is not None:
        build: Callable[..., Motion] = partial(_motion_of_turn, shaft=recording.sense if one_shaft else 0)
    elif recording.table_attitude is not None:
        build = _motion_of_attitude
    else:
        return None
    if recording.samples < 6:
        message = f"recording {recording.name} has {recording.samples} samples; 6 are needed to follow the table"
        raise InputError(message, recording.source.get("file"))
    warm = recording.temperature is not None
    own_clock = "table" if "table_clock" in recording.source else "sensor"
    logged = partial(
        Motion.changed,
        temperature=temperature_of(recording) if warm else None,
        temperature_rate=temperature_rate_of(recording) if warm else None,
        timed_by=own_clock if recording.table_rate is None else "",
        recording=recording.name,
        setup=recording.setup,
    )
    return build(recording, gravity_g, None if earth is None else np.array(earth), logged)


def _motion_of_turn(
    recording: Recording, gravity_g: float, earth: Values | None, logged: Callable[[Motion], Motion], *, shaft: int
) -> Motion:
    assert recording.axis is not None  # noqa: S101
    assert recording.table_angle is not None  # noqa: S101
    time, angle, rate = recording.time, recording.table_angle, recording.table_rate
    by_angle = rate_by_angle(recording)
    if by_angle is not None:
        angle, rate = by_angle.angle, by_angle.rate
    assert rate is not None  # noqa: S101
    log = EncoderTrajectory(time, angle, rate, rate_logged=by_angle is None)
    if by_angle is not None:
        log.valid_samples &= ~by_angle.vague
    axis = AXES.index(recording.axis)
    home, still = level_at_zero(axis, recording.up, shaft), still_samples(time, rate)

    def at(
        before: float | Values, lag: float = 0.0, offset: float | Values = 0.0, rows: Pieces | None = None
    ) -> Motion:
        """Return the motion at ``time + before + offset``, filtered by a first-order lag in s.

        ``rows``: over which it is averaged; time, temperature and rests are those of all samples.
        """
        line, circle, known = log.path(before + offset, lag, rows)

        def turned(vector: Values) -> Values:
            cosine, sine = circle()
            return turn_by(vector, axis, cosine, -sine)

        def force() -> Values:
            return gravity_g * turned(home[2])

        deferred: dict[str, Any] = {
            "angle": lambda: line()[0],
            "rate": lambda: line()[1],
            "specific_force": force,
            "angular_rate": lambda: (
                _along(axis, line()[1]) + (0.0 if earth is None else earth_in_body(earth, turned(home)))
            ),
            "angular_acceleration": lambda: _along(axis, line()[2]),
            "specific_force_rate": lambda: -np.radians(line()[1])[:, None] * (force() @ ABOUT[axis].T),
            "level": lambda: turned(home),
            "reference_valid": known,
        }
        at_offset, at_lag = partial(at, before + offset, lag), partial(at, before + offset)
        deferred |= {"axis": axis, "still": still, "at_offset": at_offset, "at_lag": at_lag}
        return logged(Motion(time=time, temperature=None, **deferred))

    return at(0.0)


def _along(axis: int, values: Values) -> Values:
    """Return vectors along a body axis: (n, 3) array."""
    return np.asarray(values[:, None] * np.eye(3)[axis])


def earth_in_body(earth: Values, level: Values) -> Values:
    """Return Earth's rotation, (3,), in the body frame: (n, 3) array; ``level``: see ``Motion``."""
    return np.asarray(np.einsum("i,nij->nj", earth, level))


def level_at_zero(axis: int, up: str = "", shaft: int = 0) -> Values:
    """Return the level axes in the body frame at table angle 0, as rows: (3, 3) array.

    Where the turn axis is vertical, ``up`` is the body axis, with its sign, that always points up; level x is then the
    next body axis in cyclic order. Where one level shaft turns the unit about each axis, level x is the body axis times
    ``shaft``, 1 or -1, about which its encoder counts right-handed: the level frame is then fixed in the room.
    """
    if not up and not shaft:
        return np.asarray(LEVEL_AT_ZERO[axis])
    if not up:
        along, upward = shaft * np.eye(3)[axis], UP_AT_ZERO[axis]
        return np.array([along, np.cross(upward, along), upward])
    upward = np.eye(3)[AXES.index(up[1])] * (1.0 if up[0] == "+" else -1.0)
    level_x = np.eye(3)[(AXES.index(up[1]) + 1) % 3]
    return np.array([level_x, np.cross(upward, level_x), upward])


def _motion_of_attitude(
    recording: Recording, gravity_g: float, earth: Values | None, logged: Callable[[Motion], Motion]
) -> Motion:
    assert recording.table_attitude is not None  # noqa: S101
    time, attitude = recording.time, continuous(recording.table_attitude)
    clock = recording.table_seconds
    spline = quintic_spline(time * clock, attitude)

    def at(before: float | Values, offset: float | Values = 0.0) -> Motion:
        offset = before + offset
        table_time = (time + offset) * clock
        q = cache(lambda: spline(table_time) if np.any(offset) else attitude)
        omega = cache(lambda: rotation_deg(q(), spline(table_time, 1)))
        deferred: dict[str, Any] = {
            "specific_force": lambda: gravity_g * level_in_body(q()),
            "angular_rate": lambda: omega() if earth is None else omega() + earth_in_body(earth, attitude_matrix(q())),
            "angular_acceleration": lambda: rotation_deg(q(), spline(table_time, 2)),
            "specific_force_rate": lambda: gravity_g * cross(level_in_body(q()), np.radians(omega())),
            "level": lambda: attitude_matrix(q()),
            "still": lambda: still_samples(time, np.linalg.norm(omega(), axis=1)),
        }
        return logged(
            Motion(
                time=time, temperature=None, angle=None, rate=None, axis=None, at_offset=partial(at, offset), **deferred
            )
        )

    return at(0.0)


def turn_about_axis(vector: Values, axis: int, angle_deg: Values) -> Values:
    """Turn (..., 3) vectors about coordinate axis 0, 1 or 2 by each of n angles (right-handed): (n, ..., 3) array."""
    angle = np.radians(angle_deg)
    return turn_by(vector, axis, np.cos(angle), np.sin(angle))


def turn_by(vector: Values, axis: int, cosine: Values, sine: Values) -> Values:
    """Return ``turn_about_axis`` by n angles of known cosine and sine, or by the mean of several turns: of both.

    The mean of turns leaves what is along the axis.
    """
    j, k = (axis + 1) % 3, (axis + 2) % 3
    c, s = (v.reshape(-1, *[1] * (vector.ndim - 1)) for v in (cosine, sine))
    out = np.empty((len(c), *vector.shape))
    out[..., axis] = vector[..., axis]
    out[..., j] = c * vector[..., j] - s * vector[..., k]
    out[..., k] = s * vector[..., j] + c * vector[..., k]
    return out


def turn_by_vector(phi: Values) -> Values:
    """Return the rotations by vectors, ``exp [phi]x`` (Rodrigues): (..., 3) array, rad, to (..., 3, 3)."""
    angle = np.linalg.norm(phi, axis=-1)
    small = angle < 1e-6
    safe = np.where(small, 1.0, angle)
    s = np.where(small, 1.0, np.sin(safe) / safe)
    c = np.where(small, 0.5, (1.0 - np.cos(safe)) / safe**2)
    cross = skew(phi)
    return np.asarray(np.eye(3) + s[..., None, None] * cross + c[..., None, None] * (cross @ cross))


def skew(v: Values) -> Values:
    """Return ``[v]x``, with ``[v]x u = v x u``: (..., 3) array to (..., 3, 3)."""
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out
