"""The face or turn that a calibration by faces and turns (procedure ``ferraris``) still lacks.

Each of the six faces needs a rest, and each body axis a turn by the stated angle from rest to rest; where turns are
held out, enough of them that one is. Faces and turns are recognised as in the fit.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.estimation.multi_position.faces_and_turns import FACES, face_of
from pipeline.estimation.rest_means import ROLE, rest_means
from pipeline.records import AXES
from pipeline.signal.hand_turns import multiples
from pipeline.signal.rests import find_rests

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.records import Recording


def next_face_or_turn(recordings: Sequence[Recording], procedure: Mapping[str, Any]) -> tuple[bool, list[str]]:
    """Return whether all faces and turns are there, and what is there, what lacks and what comes next, as lines."""
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
