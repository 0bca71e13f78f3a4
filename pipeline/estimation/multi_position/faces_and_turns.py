"""Faces and turns by hand as a procedure states them, as equations beside those of rests and moves.

    face f      E_f^T mean_k(f_k) / G = 0 +- s_f
    turn k      e_a^T Phi_k = A_k +- s_t
    axis a      E_a^T sum_k sign(A_k) Phi_k / sum_k |A_k| = 0 +- s_a

where

    f_k   : specific force of the rests with face f up; E_f: two directions across the axis of the face
    Phi_k : integral of the calibrated rate over a turn, in the body's axes; A_k its stated total angle, about axis a
    s     : standard uncertainties: of a face's mean rest, of a turn's angle, and of the mean direction of the turns
            about an axis: an error that rests on one face, or turns about one axis, share is not averaged out

For a turn about a fixed axis Phi is angle times axis; an axis that wobbles by w rad changes its length by w^2 / 2. Both
sensors refer to the case. Source: F. Ferraris, U. Grimaldi & M. Parvis, Procedure for effortless in-field calibration
of three-axial rate gyro and accelerometers, Sensors and Materials 7 (1995), 311-330.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import NotObservableError
from pipeline.records import AXES
from pipeline.signal.hand_turns import ACROSS, multiples

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.multi_position.moves import Moves
    from pipeline.estimation.multi_position.rests import Rests
    from pipeline.records import Recording

    Values = NDArray[np.float64]

NEAR_DEG = 15.0  # of a face's axis, within which a rest is on that face: a chip askew in its case, and a hand
FACES = [f"{sign}{axis}" for axis in AXES for sign in "+-"]


@dataclass(frozen=True)
class Faces:
    """The faces on which a unit rests.

    Attributes
    ----------
    face : (m,) array of int
        Of each rest, as of ``FACES``; -1 for none.
    error : float, rad
        s_f.
    """

    face: NDArray[np.intp]
    error: float

    def select(self, index: NDArray[np.bool_]) -> Faces:
        """Return the faces of some of the rests."""
        return replace(self, face=self.face[index])

    def weights(self) -> Values:
        """Return the weights of the rests' forces in the equations: (r, m, 3) array, two rows a face."""
        rows = []
        for face in np.unique(self.face[self.face >= 0]):
            own = self.face == face
            rows += [own[:, None] / own.sum() * e for i, e in enumerate(np.eye(3)) if i != face // 2]
        return np.array(rows).reshape(-1, len(self.face), 3)


def faces_of(rests: Rests, force: Values, settings: Mapping[str, Any]) -> Faces | None:
    """Return on which face each rest is, by its specific force (m, 3); None where the procedure states no faces.

    Raises
    ------
    NotObservableError
        If there is no rest on a face.
    """
    stated = settings["procedure"].get("faces")
    if not stated:
        return None
    u = force / np.linalg.norm(force, axis=1, keepdims=True)
    axis = np.argmax(np.abs(u), axis=1)
    along = u[np.arange(len(u)), axis]
    tilt = np.degrees(np.arccos(np.clip(np.abs(along), 0.0, 1.0)))
    face = np.where(tilt <= NEAR_DEG, 2 * axis + (along < 0.0), -1)
    missing = [name for i, name in enumerate(FACES) if not np.any(face == i)]
    if missing:
        rows = zip(axis, along, rests.start, tilt, strict=True)
        found = ", ".join(f"{FACES[2 * a + (s < 0)]} at {t:.1f} s ({d:.0f} deg off)" for a, s, t, d in rows)
        raise NotObservableError(
            f"there is no rest with body {' or '.join(missing)} up, within {NEAR_DEG:g} deg: rest the unit for 3 s or "
            f"more on each of its six faces. Nearest to up in the rests found: {found}"
        )
    return Faces(face, float(np.radians(stated["accuracy_deg"])))


@dataclass(frozen=True)
class TurnRows:
    """Equations ``sum_k weight_k . Phi_k = value +- error`` of stated turns: (r, k, 3), (r,) and (r,) arrays, deg."""

    weight: Values
    value: Values
    error: Values


def turn_rows(moves: Moves, turns: Mapping[str, Any]) -> TurnRows | None:
    """Return the equations of the moves whose total angle is stated; None where there is none."""
    rows, value, error = [], [], []
    for k, axis in zip(*np.nonzero(moves.stated), strict=True):
        rows.append(np.outer(np.eye(moves.count)[k], np.eye(3)[axis]))
        value.append(moves.stated[k, axis])
        error.append(float(turns["accuracy_deg"]))
    for axis in np.flatnonzero(np.any(moves.stated, axis=0)):
        share = np.degrees(np.sign(moves.stated[:, axis]) / np.sum(np.abs(moves.stated[:, axis])))
        rows += [share[:, None] * e for i, e in enumerate(np.eye(3)) if i != axis]
        value += [0.0, 0.0]
        error += 2 * [float(turns["axis_accuracy_deg"])]
    return TurnRows(np.array(rows), np.array(value), np.array(error)) if rows else None


def integrated(moves: Moves, rests: Rests) -> Values:
    """Return the integral of each move's readings, less those of the rests beside it: (k, 3) array, deg."""
    bias = 0.5 * (rests.reading[moves.before] + rests.reading[moves.after])
    angle: Values = np.einsum("ks,ksi->ki", moves.weight, moves.reading - bias[:, None])
    return angle


def with_stated_turns(moves: Moves, rests: Rests, turns: Mapping[str, Any]) -> Moves:
    """Return moves that know which of them are turns by a multiple of the stated angle."""
    stated = np.zeros((moves.count, 3))
    for k, angle in enumerate(integrated(moves, rests)):
        axis, count = multiples(angle, float(turns["angle_deg"]))
        stated[k, axis] = count * float(turns["angle_deg"])
    return replace(moves, stated=stated)


def require_turns(moves: Moves | None, rests: Rests, recordings: Sequence[Recording], turns: Mapping[str, Any]) -> None:
    """Raise where an axis has no stated turn, or a recording that is a turn about an axis holds another one.

    Raises
    ------
    NotObservableError
    """
    angle_deg = float(turns["angle_deg"])
    found = np.zeros((0, 3)) if moves is None else integrated(moves, rests)
    stated = np.zeros((0, 3)) if moves is None else moves.stated
    where = [] if moves is None else [recordings[int(i)] for i in rests.recording[moves.after]]
    begin = [] if moves is None else moves.time[:, 0].tolist()
    expected = f"a multiple of {angle_deg:g} deg, within a tenth and a quarter of {angle_deg:g} deg"
    advice = (
        "turn the unit from rest to rest about each body axis, and state the angle in procedure.turns.angle_deg; an "
        "angle that is wrong in all turns shows a wrong unit or range of the gyroscope"
    )
    for part in {id(r): r for r in recordings if r.axis is not None and r.role == "rests"}.values():
        own = [k for k, r in enumerate(where) if r is part]
        if not any(stated[k, AXES.index(part.axis)] for k in own):
            seen = ", ".join(_angles(found[k]) for k in own) or "no move between two rests of a second or more"
            raise NotObservableError(
                f"recording {part.name} is no turn about {part.axis} by {expected}: the readings show {seen}; {advice}",
                part.source.get("file"),
            )
    for axis, name in enumerate(AXES):
        if not np.any(stated[:, axis]):
            about = [k for k, a in enumerate(found) if np.linalg.norm(np.delete(a, axis)) < ACROSS * abs(a[axis])]
            k = max(about, key=lambda k: abs(found[k, axis]), default=None)
            seen = "none" if k is None else f"{_angles(found[k])} at {begin[k]:.1f} s of {where[k].name}"
            raise NotObservableError(
                f"there is no turn about {name} by {expected}; the largest about {name} is {seen}: {advice}"
            )


def _angles(angle: Values) -> str:
    return "(" + ", ".join(f"{a:.1f}" for a in angle) + ") deg about x, y, z"
