"""Compensate a log as a stream: read, compensate and write it block by block.

The modules ``pipeline.field_logs.text_output`` and ``mcap_log`` read and write the blocks of each format. The largest
block determines the memory; logs of other programs, and files that the profile joins, are read into memory.

If the user states an interval with a rest (``apply --rest``), the log is read twice, first to estimate the gyroscope's
bias b from that rest:

    b' = b + K m,    K = matrix^-1

where m is the mean rate, calibrated with b, of the longest rest in the interval. Rests are found as in recordings by
hand (``pipeline.signal.rests``). b' is the bias at the power-on of the log. It includes Earth's rotation, at most
0.0042 deg/s.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from imu_logs.files import GIT_LFS, MESSAGE_FORMATS, not_regular
from imu_logs.units import ACCELEROMETER, CANONICAL, GYROSCOPE, UNITS
from pipeline.errors import ConfigurationError, InputError, MissingInputError, PipelineError
from pipeline.field_logs.log_checks import LogChecks
from pipeline.io.axis_maps import STRAIGHT, axis_matrix, in_body_axes, maps_of_log
from pipeline.model.compensation import SMOOTHING_S
from pipeline.records import SENSORS, Recording
from pipeline.settings import Ingest
from pipeline.signal.rests import find_rests

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.model.compensation import Compensation
    from pipeline.records import Values

    Readings = dict[str, NDArray[Any]]


BLOCK_BYTES = 1 << 21  # of a text log: 20,000 rows, whose arrays take about 10 MB
DESCRIPTOR = re.compile(r"-|/dev/stdout|(?:/dev/fd|/proc/self/fd)/(\d+)")  # files that are already open
KINDS = {".mcap": "MCAP", ".csv": "text", ".txt": "text"}
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


def compensate_log(
    compensation: Compensation,
    source: Path,
    target: Path,
    profile: LogProfile | None = None,
    *,
    joined: Sequence[Path] = (),
    topic: str | None = None,
    smoothing: float = SMOOTHING_S,
    rest: tuple[float, float] | None = None,
    block_bytes: int = BLOCK_BYTES,
    progress: Callable[[int, int], None] | None = None,
) -> Result:
    """Compensate a log; its suffix states the format: ``.mcap``, one of ``MESSAGE_FORMATS``, else text.

    ``profile``: by default the canonical CSV, or the only Imu topic. ``joined``: the other files with readings, in the
    order of a profile that joins several. ``topic``: of the calibrated messages in an MCAP log; by default, topic of
    the readings with the suffix ``_calibrated``. ``smoothing``: memory of the regression line through past
    temperatures, s; 0 uses the temperature unchanged. ``rest``: an interval with a rest, s from the first sample; its
    mean rate is subtracted from the gyroscope. ``progress`` is called with the numbers of finished samples and of read
    bytes. Raises ``InputError``, without an output, if the log is damaged, contradicts the profile, has no rest in the
    interval ``rest``, or would be overwritten.
    """
    files, profile, suffix = [source, *joined], profile or LogProfile(), source.suffix.lower()
    for file in files:
        require_apart(file, target)
    smoothed = 0.0 if suffix == ".mcap" else smoothing  # of MCAP, ``Temperatures`` smooths

    def write(stream: LogStream, file: Path) -> Result:
        with replacing(file) as out:
            if suffix == ".mcap":
                from pipeline.field_logs.mcap_log import McapLog  # noqa: PLC0415  (only for this format)

                return McapLog(source, out, profile, stream, topic, smoothing).compensate()
            from pipeline.field_logs.text_output import CsvLog, compensate_whole, sensor_parts  # noqa: PLC0415

            wanted = len(sensor_parts(profile.ingest, messages=suffix in MESSAGE_FORMATS))
            if len(files) != wanted:
                raise InputError(f"the profile reads a recording from {wanted} files; got {len(files)}", str(source))
            if len(files) > 1 or suffix in MESSAGE_FORMATS:
                return compensate_whole(files, out, profile, stream)
            return CsvLog(source, out, profile, stream).compensate(block_bytes)

    notes = []
    if rest is not None:
        gyroscope = compensation.gyroscope
        if gyroscope is None:
            raise ConfigurationError("the calibration holds no gyroscope: leave out --rest", str(source))
        stretch = CalibratedStretch(*rest)
        write(LogStream(compensation, smoothed, progress, stretch), Path(os.devnull))
        rate, note = stretch.mean_rate(str(source))
        gyroscope = replace(gyroscope, bias=gyroscope.bias + np.linalg.solve(gyroscope.matrix, rate))
        compensation, notes = replace(compensation, gyroscope=gyroscope), [note]
    result = write(LogStream(compensation, smoothed, progress), target)
    result.notes = notes + result.notes
    return result


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


def require_apart(source: Path, target: Path) -> None:
    """Refuse a log that is not a file, and an output (``-``: stdout) that cannot be written or would overwrite it."""
    if not source.exists():
        raise MissingInputError("there is no such log", str(source))
    other = not_regular(source)
    if other:
        raise InputError(other if other == GIT_LFS else f"{other}: save the log, then name that file", str(source))
    if (descriptor := _descriptor(target)) is not None:
        with suppress(OSError):  # it may be closed
            if os.path.samestat(os.fstat(descriptor), source.stat()):
                raise InputError("the output would overwrite the log; choose another file", str(target))
        return
    if target.is_dir():
        raise InputError("the output is a directory; name a file for -o", str(target))
    if target.exists() and target.samefile(source):
        raise InputError("the output would overwrite the log; choose another file for -o", str(target))
    if not target.resolve().parent.is_dir():
        raise InputError("the directory of the output does not exist; make it first", str(target))
    kinds = [KINDS.get(file.suffix.lower(), "text" if file is source else None) for file in (source, target)]
    if kinds[1] is not None and kinds[0] != kinds[1]:
        is_text = source.suffix.lower() in MESSAGE_FORMATS
        log = f"of a {source.suffix} log text is made" if is_text else f"the log is {kinds[0]}, and so is the output"
        message = f"{log}, but its name ends in {target.suffix}"
        raise InputError(f"{message}: choose another name", str(target))


def _descriptor(target: Path) -> int | None:
    """Return the file descriptor that a target names; None for a path."""
    match = DESCRIPTOR.fullmatch(str(target))
    return int(match[1] or 1) if match else None


class Output:
    """The output: an ``OSError`` becomes a message that names it."""

    def __init__(self, stream: IO[bytes], target: Path) -> None:
        self.stream, self.target = stream, target

    def write(self, data: bytes | memoryview) -> None:
        """Write the data."""
        with _user_errors(self.target):
            self.stream.write(data)


@contextmanager
def replacing(target: Path) -> Iterator[Output]:
    """Open an output that replaces the file of its name when it is complete.

    The target of a symbolic link is replaced, with the same permissions. Standard output, pipes and devices are written
    directly.
    """
    descriptor, part = _descriptor(target), None
    file = target if descriptor is not None else target.resolve()
    with _user_errors(target):
        if descriptor is not None:
            sys.stdout.flush()
            stream = os.fdopen(os.dup(descriptor), "wb")
        elif file.exists() and not file.is_file():
            stream = file.open("wb")
        else:
            part = file.with_name(f".apply.{os.getpid()}.part")
            stream = part.open("wb")
    try:
        yield Output(stream, target)
        with _user_errors(target):
            stream.close()
            if part is not None:
                if file.exists():
                    shutil.copymode(file, part)
                part.replace(file)
    finally:
        with suppress(OSError):
            stream.close()
        if part is not None:
            part.unlink(missing_ok=True)


@contextmanager
def _user_errors(target: Path) -> Iterator[None]:
    try:
        yield
    except BrokenPipeError:
        raise InputError("the output was closed before it was complete", str(target)) from None
    except OSError as error:
        raise InputError(f"the output cannot be written: {error.strerror}", str(target)) from None
