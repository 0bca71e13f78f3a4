"""What readers and writers of field logs share: the layout of a log, its compensation by blocks, the output."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from imu_logs.units import ACCELEROMETER, CANONICAL, GYROSCOPE, UNITS
from pipeline.app.field_logs.log_checks import LogChecks
from pipeline.core.errors import ConfigurationError, InputError, PipelineError
from pipeline.core.records import SENSORS, Recording
from pipeline.core.settings import Ingest
from pipeline.ingest.axis_maps import STRAIGHT, axis_matrix, in_body_axes, maps_of_log
from pipeline.physics.signal.rests import find_rests

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.core.records import Values
    from pipeline.physics.compensation import Compensation

    Readings = dict[str, NDArray[Any]]

PARTS, K95 = 10, 2.262  # of a rest; Student's t for 95 %, two-sided, with 9 degrees of freedom
USED = ("time", "temperature", *ACCELEROMETER, *GYROSCOPE)
CANONICAL_CSV = Ingest(
    name="canonical_csv", csv={"columns": {c: {"column": CANONICAL[c], "unit": next(iter(UNITS[c]))} for c in USED}}
)


@dataclass(frozen=True)
class LogProfile:
    """The layout of the logs of a unit.

    ``ingest``: the ingest profile, by default the canonical one. ``axis_maps``: sensor to the body axes along which its
    reading axes point, by default +x, +y, +z.
    """

    ingest: Ingest = CANONICAL_CSV
    axis_maps: Mapping[str, Sequence[str]] = field(default_factory=dict)

    @classmethod
    def of_calibration(cls, document: Mapping[str, Any], file: str) -> LogProfile:
        """Return the profile with which a unit was calibrated, from ``calibrations/<unit>.json``."""
        log = document.get("log")
        if log is None:
            return cls()
        try:
            maps = maps_of_log({"axis_map": log["axis_map"]})
            for axis_map in maps.values():
                axis_matrix(axis_map)
            return cls(CANONICAL_CSV if log["ingest"] is None else Ingest(name="", **log["ingest"]), maps)
        except (KeyError, TypeError, ValueError, ConfigurationError) as error:
            expected = "log is invalid; expected ingest, an object or null, and axis_map, for example [+x, +y, +z]"
            raise InputError(f"{expected}; got {error}", file) from None

    def to_body(self, sensor: str, readings: Values) -> Values:
        """Return (n, 3) readings of a sensor in body axes."""
        return in_body_axes(self.axis_maps.get(sensor, STRAIGHT), readings)


@dataclass
class CalibratedStretch:
    """The calibrated readings in an interval of a log, s from its first sample, collected block by block."""

    first: float
    last: float
    begin: float | None = None  # time of the first sample of the log, s
    blocks: list[tuple[Values, Values, Values]] = field(  # s from the first sample, specific force, rate
        default_factory=lambda: [(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))]
    )

    def add(self, readings: Mapping[str, Values], time: Values | None, file: str) -> None:
        """Add a block: (n, 3) calibrated readings of each sensor, (n,) times in s."""
        if time is None or not {"accelerometer", "gyroscope"} <= set(readings):
            message = "--rest needs the time and the readings of both sensors; the log lacks some of these"
            raise InputError(f"{message}: leave out --rest", file)
        if self.begin is None:
            self.begin = float(time[0])
        since = time - self.begin
        inside = (since >= self.first) & (since <= self.last)
        if inside.any():
            self.blocks.append((since[inside], readings["accelerometer"][inside], readings["gyroscope"][inside]))

    def mean_rate(self, file: str) -> tuple[Values, str]:
        """Return the mean rate of the longest rest, deg/s, (3,) array, and a note that states it."""
        since, force, rate = (np.concatenate(column) for column in zip(*self.blocks, strict=True))
        log = Recording("log", "rests", None, np.round(since * 1e9).astype(np.int64), force, rate)
        rests = [r for r in find_rests(log) if r.accepted]
        if not rests:
            message = f"no rest of 1 s or more from {self.first:g} to {self.last:g} s of the log"
            raise InputError(
                f"{message}; --rest states an interval with a rest, in s from the first sample of the log", file
            )
        longest = max(rests, key=lambda r: r.stop - r.start)
        still = rate[longest.start : longest.stop]
        mean = still.mean(axis=0)
        parts = np.array([part.mean(axis=0) for part in np.array_split(still, PARTS)])
        error = parts.std(axis=0, ddof=1) / np.sqrt(PARTS)  # of the mean, also for noise correlated within a part
        words = ", ".join(f"{m:.4f} +- {K95 * e:.4f}" for m, e in zip(mean, error, strict=True))
        start, stop = since[[longest.start, longest.stop - 1]]
        return mean, (
            f"mean rate of the rest from {start:.1f} to {stop:.1f} s of the log, subtracted from all rates: {words} "
            f"deg/s (x, y, z; +- is the 95 % interval from the scatter of {PARTS} parts of the rest)"
        )


@dataclass
class Result:
    """The result of the compensation with the calibration of ``unit``.

    ``topic``: of the calibrated messages in an MCAP log. ``notes``: facts about the output. ``warnings``: signs that
    the calibration does not belong to the log.
    """

    unit: str
    samples: int = 0
    sensors: list[str] = field(default_factory=list)
    topic: str = ""
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


class LogStream:
    """Compensates, checks and counts the samples of a log block by block; ``stretch`` collects some of them."""

    def __init__(
        self,
        compensation: Compensation,
        smoothing: float,
        progress: Callable[[int, int], None] | None,
        stretch: CalibratedStretch | None = None,
    ) -> None:
        self.stretch = stretch
        self.compensation, self.stream, self.progress = compensation, compensation.stream(smoothing), progress
        self.calibrated = {s for s in SENSORS if compensation.calibration(s) is not None}
        self.checks, self.result = LogChecks(compensation.calibrated_range), Result(compensation.unit)

    def apply(self, signals: Mapping[str, NDArray[Any]], position: int, file: str, place: str = "") -> Readings:
        """Return the calibrated readings of some samples.

        ``signals``: ``accelerometer`` and ``gyroscope``, (n, 3) arrays in g and deg/s, body axes; ``time``, s, and
        ``temperature``, degC, (n,) arrays; absent signals are left out. ``file`` and ``place`` are for messages.
        ``position``: bytes up to the end of these samples.
        """
        raw = {s: signals[s] for s in SENSORS if s in signals}
        try:
            calibrated = self.stream.apply(**signals)
        except PipelineError as error:
            raise type(error)(error.message + place, file) from None
        readings = {s: getattr(calibrated, s) for s in raw}
        self.checks.add(raw, readings, signals.get("time"), signals.get("temperature"))
        if self.stretch is not None:
            self.stretch.add(readings, signals.get("time"), file)
        self.result.samples += len(next(iter(raw.values())))
        self.result.sensors = [s for s in SENSORS if s in {*self.result.sensors, *raw}]
        if self.progress is not None:
            self.progress(self.result.samples, position)
        return readings

    def finish(self, notes: Sequence[str]) -> Result:
        """Return the result with notes on the log and warnings."""
        result = self.result
        result.warnings = self.checks.warnings(self.calibrated & set(result.sensors))
        result.notes += notes
        for sensor in SENSORS:
            if sensor in self.calibrated and sensor not in result.sensors:
                result.notes.append(f"the log holds no readings of the {sensor}, which is calibrated")
            elif sensor in result.sensors and sensor not in self.calibrated:
                result.notes.append(f"the calibration holds no {sensor}; its readings are unchanged")
        return result


class Output:
    """The output: an ``OSError`` becomes a message that names it."""

    def __init__(self, stream: IO[bytes], target: Path) -> None:
        self.stream, self.target = stream, target

    def write(self, data: bytes | memoryview) -> None:
        """Write the data."""
        with user_errors(self.target):
            self.stream.write(data)


@contextmanager
def user_errors(target: Path) -> Iterator[None]:
    """Raise an ``OSError`` of the output as a message that names it."""
    try:
        yield
    except BrokenPipeError:
        raise InputError("the output was closed before it was complete", str(target)) from None
    except OSError as error:
        raise InputError(f"the output cannot be written: {error.strerror}", str(target)) from None
