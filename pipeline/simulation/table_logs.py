"""The log of the table: in the sensor's rows, in a file with a clock of its own, or only the commanded program.

    tau = t + d + k t

where

    t, tau : the sensor's and the table's clock, s
    d, k   : offset and drift of the table's clock, s and 1

A file has the sampling interval of the table's computer. For a table without encoders only the program is known.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import ConfigurationError
from pipeline.records import Recording, continuous
from pipeline.simulation.trajectory import Turn

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.simulation.rate_table import Program
    from pipeline.simulation.trajectory import Planned

KINDS = ("rows", "file", "program")
BESIDE_S = 2.0  # that the table's computer begins earlier and ends later
NANOSECONDS = 1_000_000_000


@dataclass(frozen=True)
class TableLog:
    """How the table is logged.

    Attributes
    ----------
    kind : str
        ``rows``: in the sensor's rows; ``file``: in a file of its own; ``program``: not at all.
    interval_s : float
        Of a file.
    offset_s, drift_ppm : float or None
        Of the file's clock; None: drawn at random, 0 to 100 s and of 50 ppm.
    wrapped : bool
        Whether the encoder starts again at 360 deg.
    """

    kind: str = "rows"
    interval_s: float = 0.01
    offset_s: float | None = None
    drift_ppm: float | None = None
    wrapped: bool = False

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ConfigurationError(f"table_log.kind is {self.kind!r}; it is {', '.join(KINDS)}")


@dataclass(frozen=True)
class Clock:
    """The table's clock."""

    offset_s: float
    drift: float = field(default=0.0)


def table_log_of(described: Mapping[str, Any]) -> TableLog:
    """Return how the table is logged, by a description."""
    known = [f.name for f in fields(TableLog)]
    unknown = sorted(set(described) - set(known))
    if unknown:
        raise ConfigurationError(f"table_log: {', '.join(unknown)} is not known; known: {', '.join(known)}")
    return TableLog(**described)


def clock_of(log: TableLog, rng: np.random.Generator) -> Clock:
    """Return the table's clock: as described, else drawn."""
    offset, drift = rng.uniform(0.0, 100.0), 50.0 * rng.standard_normal()
    given = (
        log.offset_s if log.offset_s is not None else offset,
        log.drift_ppm if log.drift_ppm is not None else drift,
    )
    return Clock(float(given[0]), 1e-6 * float(given[1]))


def logged(
    planned: Sequence[Planned], starts: Sequence[float], time: NDArray[np.float64], *, wrapped: bool
) -> dict[str, NDArray[np.float64]]:
    """Return angle, rate and attitude of a table at any times of a session.

    Parameters
    ----------
    planned : sequence of Planned
    starts : sequence of float, s
        When each begins.
    time : (n,) array, s
        Increasing.
    wrapped : bool
    """
    angle, rate = np.zeros(len(time)), np.zeros(len(time))
    level = np.zeros((len(time), 3, 3))
    which = np.clip(np.searchsorted(starts, time, side="right") - 1, 0, None)
    last = 0.0
    for k in np.unique(which):
        here = which == k
        trajectory = planned[k].trajectory
        pose = trajectory.commanded(time[here] - starts[k])
        size = np.linalg.norm(pose.omega, axis=1)
        turning = pose.angle is not None and pose.rate is not None and isinstance(trajectory, Turn)
        angle[here] = pose.angle if turning and pose.angle is not None else last
        rate[here] = pose.rate if turning and pose.rate is not None else size
        level[here] = pose.level
        last = float(angle[here][-1])
    return {"table_angle": angle % 360.0 if wrapped else angle, "table_rate": rate, "table_attitude": attitudes(level)}


def attitudes(level: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the quaternions (w, x, y, z) of matrices that take body vectors to the level frame: (n, 4) array."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415  (few simulations need it)

    return continuous(np.roll(Rotation.from_matrix(level).as_quat(), 1, axis=1))


def own_log(name: str, planned: Sequence[Planned], starts: Sequence[float], log: TableLog, clock: Clock) -> Recording:
    """Return the table's own log of a recording, or of a session of several.

    Parameters
    ----------
    name : str
    planned : sequence of Planned
    starts : sequence of float, s
        When each begins, in the sensor's time.
    log : TableLog
    clock : Clock
    """
    last = starts[-1] + planned[-1].trajectory.duration
    begin, end = (t + clock.offset_s + clock.drift * t for t in (starts[0] - BESIDE_S, last + BESIDE_S))
    tau: NDArray[np.float64] = begin + log.interval_s * np.arange(int((end - begin) / log.interval_s), dtype=float)
    time = (tau - clock.offset_s) / (1.0 + clock.drift)
    turn = isinstance(planned[0].trajectory, Turn) if len(planned) == 1 else None
    return _recording(name, tau, logged(planned, starts, time, wrapped=log.wrapped), turn=turn)


def _recording(
    name: str, tau: NDArray[np.float64], channels: dict[str, NDArray[np.float64]], *, turn: bool | None
) -> Recording:
    """Return a log of what the table's computer knows: of a turn its encoder, else the attitude, of a session both."""
    kept = {True: ("table_angle", "table_rate"), False: ("table_attitude",), None: tuple(channels)}[turn]
    time_ns = np.rint(tau * NANOSECONDS).astype(np.int64)
    values: dict[str, Any] = {c: v for c, v in channels.items() if c in kept}
    return Recording(name, "table", None, time_ns, **values)


def as_program(program: Program) -> list[dict[str, Any]]:
    """Return a table's program as the steps of a procedure's ``program``: rests and turns, repeated ones together."""
    steps: list[dict[str, Any]] = []
    time = 0.0
    for ramp in np.flatnonzero((program.rate == 0) & (program.acceleration != 0)).tolist():
        hold, end = ramp + 1, ramp + 3
        if program.knots[ramp] > time + 1e-9:
            steps.append({"rest_s": round(float(program.knots[ramp] - time), 9)})
        turn = float(program.angle[end] - program.angle[ramp])
        steps.append({
            "turn_deg": round(turn, 9),
            "rate_dps": round(abs(float(program.rate[hold])), 9),
            "acceleration_dps2": round(abs(float(program.acceleration[ramp])), 9),
        })  # fmt: skip
        time = float(program.knots[end])
    steps.append({"rest_s": round(float(program.duration - time), 9)})
    return _folded(steps)


def _folded(steps: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return steps with a pair that repeats itself written once."""
    out: list[dict[str, Any]] = []
    i = 0
    while i < len(steps):
        pair, count = steps[i : i + 2], 1
        while len(pair) == 2 and steps[i + 2 * count : i + 2 * count + 2] == pair:
            count += 1
        if count > 2:
            out.append({"repeat": count, "steps": pair})
            i += 2 * count
        else:
            out.append(steps[i])
            i += 1
    return out
