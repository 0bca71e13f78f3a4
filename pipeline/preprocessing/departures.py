"""What of a turn is otherwise than stated, in words and with the setting that describes it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.preprocessing.bench import bench_of, nearest_axis, off_at_rest, off_axis_deg, usual_up
from pipeline.records import AXES

if TYPE_CHECKING:
    from pipeline.preprocessing.bench import Bench
    from pipeline.preprocessing.turn_fit import TurnFit
    from pipeline.records import Recording

BIAS_DEG = 6.0  # zero that a bias of 0.1 g feigns where all rests are at one angle
UNLIKE = 0.5  # gain of the stated axis over that of another one, below which the other one turned


@dataclass(frozen=True)
class Turn:
    """A turn recording, what its configuration says and what its rows tell.

    Attributes
    ----------
    recording : Recording
    stated : Bench
    fit : TurnFit
    found : Bench or None
        None where gravity does not tell.
    configurable : bool
        Whether the procedure has an entry of the recording's name.
    """

    recording: Recording
    stated: Bench
    fit: TurnFit
    found: Bench | None
    configurable: bool

    @property
    def name(self) -> str:
        """Name of the recording."""
        return self.recording.name


@dataclass(frozen=True)
class Departure:
    """What is otherwise than stated.

    Attributes
    ----------
    turn : Turn
    fault : str
        Code of the refusal.
    problem : str
    settings : dict of str to str
        What describes it, by the key below the recording's entry in the procedure; empty where nothing does.
    """

    turn: Turn
    fault: str
    problem: str
    settings: dict[str, str]


@dataclass(frozen=True)
class Tolerance:
    """What a turn may be off.

    Attributes
    ----------
    angle_deg : float, deg
        Of the zero and of the direction of the turn axis.
    offset_s : float, s
        Largest plausible time offset: in turns one way it is a part of the zero.
    lost : float, relative
        Standard deviation of what a table without encoders loses of each turn; three of them, over half of the way.
    """

    angle_deg: float
    offset_s: float
    lost: float

    def of_zero(self, fit: TurnFit) -> float:
        """Return how far the zero of a turn may be off, deg."""
        return self.angle_deg + self.offset_s * abs(fit.mean_rate) + 1.5 * self.lost * fit.arc


def departure(turn: Turn, tolerance: Tolerance) -> Departure | None:
    """Return what is otherwise than stated, or None."""
    if turn.fit.vertical is not None or turn.stated.vertical:
        return _upright(turn) or _gyroscope_sense(turn)
    if turn.found is None:
        return _axis(turn, tolerance.angle_deg) or _gyroscope_sense(turn)
    return _axis(turn, tolerance.angle_deg) or _face(turn, tolerance)


def words(bench: Bench) -> str:
    """Return how a bench holds the unit, in words."""
    hand = "right" if bench.sense > 0 else "left"
    return (
        f"body {bench.up} up at a table angle of {bench.zero_deg:.1f} deg, the angle counted {hand}-handed about "
        f"{bench.axis}"
    )


def _axis(turn: Turn, tolerance: float) -> Departure | None:
    axis, fit, name = turn.stated.axis, turn.fit, turn.name
    direction = fit.turn_axis if fit.turn_axis is not None else fit.gain
    if direction is None:
        return None
    nearest, off = nearest_axis(direction), off_axis_deg(direction)
    if nearest[1] != axis and abs(direction[AXES.index(axis)]) < UNLIKE * np.max(np.abs(direction)):
        who = "gravity turns" if fit.turn_axis is not None else "the gyroscope turns"
        listed = ", ".join(f"{b} {g:+.3g}" for b, g in zip(AXES, direction, strict=True))
        problem = f"in {name} the table is said to turn about {axis}, and {who} about {nearest[1]} ({listed})"
        return Departure(turn, "wrong_axis", problem, {"axis": nearest[1]})
    if fit.turn_axis is not None and off > tolerance:
        problem = (
            f"in {name} gravity turns about an axis that is {off:.1f} deg off body {axis}; {tolerance:g} deg are "
            "allowed (procedure.mounting_tolerance_deg)"
        )
        return Departure(turn, "wrong_axis", problem, {})
    return None


def _gyroscope_sense(turn: Turn) -> Departure | None:
    axis, gain = turn.stated.axis, turn.fit.gain
    if gain is None or gain[AXES.index(axis)] * turn.stated.sense > 0.0:
        return None
    problem = f"in {turn.name} the readings about {axis} have the sign opposite to the table's rate"
    return Departure(turn, "wrong_sense", problem, {"sense": str(-turn.stated.sense)})


def _face(turn: Turn, tolerance: Tolerance) -> Departure | None:
    found, stated = turn.found, turn.stated
    assert found is not None  # noqa: S101
    off = (found.offset - stated.offset + 180.0) % 360.0 - 180.0
    allowed = tolerance.of_zero(turn.fit)
    if found.sense == stated.sense:
        if turn.recording.role == "gyroscope":  # it needs no zero, and fast turns show a clock's error as one
            at_rest = off_at_rest(turn.recording, stated) or 0.0
            allowed += BIAS_DEG
            found = found if abs(off) > allowed else bench_of(stated.axis, stated.sense, stated.offset + at_rest)
            off = at_rest
        if abs(off) <= allowed:
            return None
    fault = "wrong_sense" if found.sense != stated.sense else "wrong_face" if found.up != stated.up else "wrong_zero"
    problem = (
        f"{turn.name} is mounted otherwise than stated: found is {words(found)}; stated is {words(stated)}, to "
        f"{allowed:.2g} deg (procedure.mounting_tolerance_deg)"
    )
    settings = {}
    if found.up != stated.up:
        settings["up"] = found.up
    if found.sense != stated.sense:
        settings["sense"] = f"{found.sense}"
    if abs(found.zero_deg - stated.zero_deg) > tolerance.angle_deg:
        settings["zero_deg"] = f"{found.zero_deg:.1f}"
    return Departure(turn, fault, problem, settings)


def _upright(turn: Turn) -> Departure | None:
    """Return what is otherwise than stated of a turn whose axis stands, or should stand, vertical."""
    stated, fit, name = turn.stated, turn.fit, turn.name
    up = None if fit.vertical is None else nearest_axis(fit.vertical)
    if up is None and fit.cosine is None:
        return None
    if up is None:
        problem = f"in {name} the turn axis is stated to stand vertical ({stated.up} up), and gravity turns"
        return Departure(turn, "wrong_face", problem, {"up": usual_up(stated.axis)})
    if up[1] != stated.axis:
        problem = f"in {name} the table is said to turn about {stated.axis}, and gravity stays along body {up}"
        return Departure(turn, "wrong_axis", problem, {"axis": up[1], "up": up})
    if up != stated.up:
        problem = (
            f"in {name} gravity stays along body {up} while the table turns: the turn axis stands vertical, and stated "
            f"is {stated.up} up"
        )
        return Departure(turn, "wrong_face", problem, {"up": up})
    if turn.recording.role == "accelerometer":
        problem = f"{name} is to calibrate the accelerometer, and about a vertical axis gravity does not turn"
        return Departure(turn, "wrong_face", problem, {})
    return None
