"""The face or turn that a calibration by hand still lacks.

Faces and turns (procedure ``ferraris``): each of the six faces needs a rest, and each body axis a turn by the stated
angle from rest to rest; where turns are held out, enough of them that one is. They are recognised as in the fit.

Rests and moves: of turns by A about a level body axis a, from the vertical u, the one with the largest gain

    log det (I + H S H^T / s^2),    H = d (exp(-[A (e_a + m)]x) u) / dm

where

    m, S : (3,) error of column a of the gyroscope's matrix, and its covariance by the fit
    s    : rad; standard deviation of the direction of the vertical at two rests
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.estimation.multi_position.faces_and_turns import FACES, face_of
from pipeline.estimation.rest_means import ROLE, rest_means
from pipeline.records import AXES
from pipeline.signal.hand_turns import multiples
from pipeline.signal.rests import find_rests
from pipeline.simulation.trajectory import rotation_by

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.records import Recording, SensorCalibration, Values


TURNS_DEG = (90.0, 180.0, 270.0, 360.0)  # that a person sees without a scale
STEP = 1e-5  # relative, of a difference quotient: its error is 1e-10


@dataclass(frozen=True)
class Turn:
    """A turn about a body axis that stays level."""

    axis: int
    up: int  # body axis that points up before it
    angle: float  # deg

    def in_words(self, dwell: float) -> str:
        """Return what to do."""
        turn = f"turn it by {self.angle:g} deg about its {AXES[self.axis]} axis, which stays level"
        return f"+{AXES[self.up]} up; rest it for {dwell:g} s, {turn}, rest it for {dwell:g} s again"

    def sensitivity(self) -> Values:
        """Return H: (3, 3) array."""
        turned = self.angle * np.eye(3)[self.axis]

        def vertical(m: Values) -> Values:
            return np.asarray(rotation_by(-(turned + self.angle * m)) @ np.eye(3)[self.up])

        steps = STEP * np.eye(3)
        return np.column_stack([(vertical(m) - vertical(-m)) / (2.0 * STEP) for m in steps])


def most_informative_turn(gyroscope: SensorCalibration, direction: float) -> Turn:
    """Return the turn that tells most of the gyroscope's matrix.

    ``gyroscope``: its calibration so far, with a covariance. ``direction``: rad, s.
    """
    assert gyroscope.covariance is not None  # noqa: S101
    S = gyroscope.covariance

    def gain(turn: Turn) -> float:
        own = 3 + 3 * np.arange(3) + turn.axis
        H = turn.sensitivity() / direction
        return float(np.linalg.slogdet(np.eye(3) + H @ S[np.ix_(own, own)] @ H.T)[1])

    turns = [Turn(a, b, angle) for a in range(3) for b in range(3) if a != b for angle in TURNS_DEG]
    return max(turns, key=gain)


def next_face_or_turn(recordings: Sequence[Recording], procedure: Mapping[str, Any]) -> tuple[bool, list[str]]:
    """Return whether all faces and turns are there, and lines that say what is there and what comes next."""
    stated = procedure["turns"]
    faces, turns, angle = dict.fromkeys(FACES, 0), dict.fromkeys(AXES, 0), float(stated["angle_deg"])
    for recording in (r for r in recordings if r.role == ROLE):
        rests = [rest for rest in find_rests(recording) if rest.accepted]
        for on in face_of(rest_means(recording, rests)[0])[0].tolist():
            if on >= 0:
                faces[FACES[on]] += 1
        if recording.gyroscope is None:
            continue
        for before, after in pairwise(rests):
            move = slice(before.stop - 1, after.start + 1)
            rate = recording.gyroscope
            bias = 0.5 * sum(rate[r.start : r.stop].mean(axis=0) for r in (before, after))
            axis, count = multiples(np.trapezoid(rate[move] - bias, recording.time[move], axis=0), angle)
            turns[AXES[axis]] += bool(count)
    every = int(stated["holdout_every"])
    held_elsewhere = any(r.role == "validation" for r in recordings)
    needed = 1 if held_elsewhere or not every else every
    lines = [
        "faces: " + ", ".join(f"{name} {count}" for name, count in faces.items()) + " rests",
        f"turns by {angle:g} deg: " + ", ".join(f"{axis} {count}" for axis, count in turns.items()) + f" of {needed}",
    ]
    face = next((name for name, count in faces.items() if not count), None)
    if face is not None:
        return False, [*lines, f"next: {face} up; rest it for 4 s or more"]
    about = next((name for name, count in turns.items() if count < needed), None)
    if about is None:
        return True, [*lines, "enough: all faces and turns are there"]
    back = "back " if turns[about] % 2 else ""
    turn = f"turn it {back}by {angle:g} deg about the vertical"
    return False, [*lines, f"next: +{about} up; rest it for 4 s, {turn}, rest it for 4 s again"]
