"""Whether accelerometer and gyroscope are read in one right-handed frame.

With readings that are the truth in axes of the sensor's own, ``M_a f`` and ``M_g w`` (signed permutations), gravity
turns about ``n = det(M_a) M_a t`` and the gyroscope reads ``k = M_g t`` in a turn about t. So, of all turns,

    n = D k,   D = det(M_a) M_a M_g^T,   det D = det M_g

and D is the unit matrix where both are in one right-handed frame. On a table, faces and turn axes as stated give M_a:

    M_a = nearest signed permutation to sum (p u^T + q (u x a)^T)

By hand, D is what lets the gyroscope's rates turn gravity from rest to rest: ``du/dt = -(D w) x u``. Nothing tells
there whether the accelerometer is mirrored, as gravity's opposite turns alike.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import IngestError
from pipeline.io.channel_table import axis_matrix
from pipeline.io.gravity_rotation import FAILS_DEG, FEWEST_MOVES, MOST_SAMPLES, misfits_deg, moves_of
from pipeline.preprocessing.bench import nearest_axis, off_axis_deg, signed_axis
from pipeline.records import AXES

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.io.gravity_rotation import Move
    from pipeline.preprocessing.bench import TurnFit
    from pipeline.records import Recording, Values

# From the nearest axis: beyond cross-axis sensitivity and seats, below the 45 deg between two axes.
CLEAR_DEG = 30.0
FEWEST_MISSED, CLEARLY_FEWER = 2, 4  # moves that gravity does not follow: one may be a knock


def check_frames(
    turns: Sequence[tuple[Recording, TurnFit]], accelerometer: Values | None, maps: Mapping[str, Sequence[str]]
) -> None:
    """Refuse turns in which gravity and the gyroscope turn about different axes; ``accelerometer`` is M_a above."""
    seen: list[tuple[Recording, str, str]] = []
    for recording, fit in turns:
        n, k = fit.turn_axis, fit.gain
        if n is not None and k is not None and max(off_axis_deg(n), off_axis_deg(k)) < CLEAR_DEG:
            seen.append((recording, nearest_axis(n), nearest_axis(k)))
    wrong = [s for s in seen if s[1] != s[2]]
    if not wrong:
        return
    recording, gravity, gyro = wrong[0]
    names = ", ".join(r.name for r, _, _ in wrong)
    agreeing = ", ".join(r.name for r, n, k in seen if n == k)
    raise IngestError(
        f"accelerometer and gyroscope contradict each other in {names}"
        + (f" (not in {agreeing})" if agreeing else "")
        + f": in {recording.name} gravity turns as in a turn about body {gravity}, and the gyroscope reads a turn "
        f"about {gyro}; both belong in one right-handed frame",
        recording.source.get("file"),
        code="mirrored_axes",
        hint=_cure(_between(seen), accelerometer, maps),
    )


def check_frames_by_hand(recording: Recording, maps: Mapping[str, Sequence[str]]) -> None:
    """Refuse rests and moves by hand in which gravity turns as the gyroscope says only with other axes."""
    if recording.accelerometer is None or recording.gyroscope is None:
        return
    part = slice(0, MOST_SAMPLES)
    moves = moves_of(recording.accelerometer[part], recording.gyroscope[part], recording.time[part])
    found = other_axes(moves)
    if found is None:
        return
    text, D = found
    raise IngestError(
        f"accelerometer and gyroscope contradict each other: {text}; both belong in one right-handed frame",
        recording.source.get("file"),
        code="mirrored_axes",
        hint=_cure(D, None, maps),
    )


def other_axes(moves: Sequence[Move]) -> tuple[str, Values | None] | None:
    """Return that gravity turns as the rates say only with other axes, in words, and D where one map alone fits."""
    missed = _missed(moves, np.eye(3)) if len(moves) >= FEWEST_MOVES else 0
    if missed < FEWEST_MISSED:
        return None
    others = sorted((_missed(moves, D), i) for i, D in enumerate(signed_permutations()))
    best, alone = others[0][0], others[1][0] > others[0][0]
    if best > missed / CLEARLY_FEWER:
        return None
    text = (
        f"in {missed} of {len(moves)} moves between rests gravity turns by more than {FAILS_DEG:g} deg otherwise than "
        f"the angular rates say, and with other axes of the gyroscope in {best}"
    )
    return text, signed_permutations()[others[0][1]] if alone else None


def _missed(moves: Sequence[Move], D: Values) -> int:
    left = misfits_deg([replace(m, turns=m.turns @ D.T) for m in moves], [1.0])
    return int(np.sum(left > FAILS_DEG))


def signed_permutations() -> list[Values]:
    """Return the 48 maps of axes onto signed axes: (3, 3) arrays."""
    return [
        axis_matrix([s + a for s, a in zip(signs, order, strict=True)])
        for order in itertools.permutations(AXES)
        for signs in itertools.product("+-", repeat=3)
    ]


def _between(seen: Sequence[tuple[Recording, str, str]]) -> Values | None:
    """Return D where all three axes were turned about, and no two recordings disagree."""
    pairs = {(k[1], n if k[0] == "+" else n.translate(str.maketrans("+-", "-+"))) for _, n, k in seen}
    if len(pairs) != len(AXES) or {k for k, _ in pairs} != set(AXES):
        return None
    D = np.column_stack([signed_axis(dict(pairs)[a]) for a in AXES])
    return D if abs(np.linalg.det(D)) > 0.5 else None


def nearest_permutation(total: Values) -> Values | None:
    """Return the signed permutation that a matrix of the order of 1 is near to, or None."""
    scale = np.linalg.norm(total, axis=0)
    if np.min(scale) < 0.25:
        return None
    near = [found for found in signed_permutations() if np.max(np.abs(total / scale - found)) <= 0.5]
    return near[0] if near else None


def as_map(matrix: Values) -> str:
    """Return a signed permutation as an axis map is written."""
    return f"[{','.join(nearest_axis(column) for column in np.asarray(matrix).T)}]"


def _cure(D: Values | None, accelerometer: Values | None, maps: Mapping[str, Sequence[str]]) -> str:
    """Return which sensor is mirrored or turned, as far as it is known, and the map that would be right."""
    now = {sensor: axis_matrix(entries) for sensor, entries in maps.items()}
    if D is None:
        return "set sensor.accelerometer.axis_map or sensor.gyroscope.axis_map after the data sheet (docs/mounting.md)"
    mirrored = np.linalg.det(D) < 0.0
    right = {"accelerometer": now["accelerometer"], "gyroscope": D @ now["gyroscope"]}
    if accelerometer is None:
        which = "the gyroscope is mirrored" if mirrored else "one sensor is read in other axes"
        right = right if mirrored else right | {"accelerometer": D.T @ now["accelerometer"]}
        joined = " or ".join(_settings(right, now))
        return f"{which}: the data sheet shows which axes are right, and gravity agrees with {joined}"
    if np.linalg.det(accelerometer) > 0.0:
        which = "the gyroscope is mirrored" if mirrored else "the gyroscope is read in other axes"
    elif mirrored:
        which = "both sensors are mirrored"
        right = {s: M.T @ now[s] for s, M in (("accelerometer", accelerometer), ("gyroscope", -D.T @ accelerometer))}
    else:
        which = "the accelerometer is mirrored"
        right = {"accelerometer": -D.T @ now["accelerometer"], "gyroscope": now["gyroscope"]}
    return f"by the faces that are stated {which}: set {' and '.join(_settings(right, now))}"


def _settings(right: Mapping[str, Values], now: Mapping[str, Values]) -> list[str]:
    """Return the settings that bring the maps to the right ones."""
    if all(np.array_equal(right[s], right["gyroscope"]) and not np.array_equal(right[s], now[s]) for s in right):
        return [f"sensor.axis_map={as_map(right['gyroscope'])}"]
    return [f"sensor.{s}.axis_map={as_map(M)}" for s, M in right.items() if not np.array_equal(M, now[s])]
