"""Compensate a log as a stream: read, compensate and write it block by block.

Calibrated readings are written as text here, as messages in ``mcap_log``. In a text log, calibrated columns in g and
deg/s with the canonical names ``accel_x_g`` .. ``gyro_z_dps`` replace the columns of the readings. All other cells, and
the lines before the data, are unchanged. The largest block determines the memory.

Logs of other programs (ROS bag, ULog, DataFlash, HDF5, MATLAB) and files that the profile joins are read into memory,
with the checks of ingest. Their output has the columns of the canonical CSV, ``time_s, accel_x_g .. gyro_z_dps,
temperature_degc``, in body axes.

If the user states an interval with a rest (``apply --rest``), the log is read twice, first to estimate the gyroscope's
bias b from that rest:

    b' = b + K m,    K = matrix^-1

where m is the mean rate, calibrated with b, of the longest rest in the interval. Rests are found as in recordings by
hand (``pipeline.physics.signal.rests``). b' is the bias at the power-on of the log. It includes Earth's rotation, at
most 0.0042 deg/s.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import compute as pc
from pyarrow import csv

from imu_logs.files import GIT_LFS, MESSAGE_FORMATS, not_regular
from imu_logs.log import in_house_unit
from imu_logs.profile import checks_of, csv_formats, mcap_formats
from imu_logs.text_layout import TextLayout, find_faults, other_separator
from imu_logs.text_lines import Head, TextLog
from imu_logs.text_write import text_scalar, times_as_decimals, to_arrow, to_numpy
from imu_logs.units import ACCELEROMETER, CANONICAL, COUNTS, GYROSCOPE, SECOND_NS, SINCE_1970_NS, TRIADS, UNITS
from pipeline.app.field_logs.log_checks import DECIMALS, LogChecks
from pipeline.core.errors import ConfigurationError, InputError, MissingInputError, PipelineError
from pipeline.core.records import SENSORS, STRAIGHT, Integers, Recording, Values, axis_matrix, in_body_axes, maps_of_log
from pipeline.core.settings import Ingest
from pipeline.physics.compensation import SMOOTHING_S, Compensation
from pipeline.physics.signal.rests import find_rests

Readings = dict[str, NDArray[Any]]
PARTS, K95 = 10, 2.262  # of a rest; Student's t for 95 %, two-sided, with 9 degrees of freedom
USED = ("time", "temperature", *ACCELEROMETER, *GYROSCOPE)
CANONICAL_CSV = Ingest(
    name="canonical_csv", csv={"columns": {c: {"column": CANONICAL[c], "unit": next(iter(UNITS[c]))} for c in USED}}
)
EXTRAPOLATED = "extrapolated"  # 1 where a row is beyond the soaked temperatures, else 0
BLOCK_ROWS = 20_000  # of a message log, like a block of a text log
CHANNELS_OF_SIGNALS = {**TRIADS, "temperature": ("temperature",), "time": ("time",)}
BLOCK_BYTES = 1 << 21  # of a text log: 20,000 rows, whose arrays take about 10 MB
DESCRIPTOR = re.compile(r"-|/dev/stdout|(?:/dev/fd|/proc/self/fd)/(\d+)")  # files that are already open
LOG_FORMATS = {".mcap": "MCAP", ".csv": "text", ".txt": "text"}


@dataclass(frozen=True)
class LogProfile:
    """The layout of the logs of a unit."""

    ingest: Ingest = CANONICAL_CSV
    # sensor to the body axes that its axes point along
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
            raise InputError(f"{message}; --rest states an interval with a rest, s from the first sample", file)
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
    """The result of the compensation with the calibration of ``unit``."""

    unit: str
    samples: int = 0
    sensors: list[str] = field(default_factory=list)
    topic: str = ""  # of the calibrated messages in an MCAP log
    notes: list[str] = field(default_factory=list)  # facts about the output
    warnings: list[str] = field(default_factory=list)  # signs that the calibration does not belong to the log


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


class CsvLog:
    """A text log and its compensated copy."""

    def __init__(self, source: Path, out: Output, profile: LogProfile, stream: LogStream) -> None:
        (part,) = sensor_parts(profile.ingest)
        self.source, self.out, self.profile, self.stream = source, out, profile, stream
        self.settings = csv_formats(profile.ingest)[part]
        self.columns = {c.channel: c for c in self.settings.columns}
        self.places: dict[str, list[int]] = {}  # indices of the columns of each signal
        self.origin = 0.0
        self.marked = False  # whether a column states which rows are beyond the soaked temperatures

    def compensate(self, block_bytes: int) -> Result:
        """Write the log with calibrated readings."""
        with self.source.open("rb") as raw:
            log = TextLog(raw, str(self.source), self.settings, keep_open_line=True, block_bytes=block_bytes)
            rows = 0
            for body, lines in log:
                if rows == 0:
                    self._begin(log.head)
                try:
                    table = self.layout.parse(body, dict.fromkeys(range(len(self.layout.names)), pa.string()))
                    cells = [column.combine_chunks() for column in table.columns]
                    signals = self._signals(cells, rows)
                except pa.ArrowInvalid as error:
                    raise self._refusal(body, lines, str(error)) from None
                if rows == 0:
                    readings = [cells[i] for s in SENSORS for i in self.places.get(s, [])]
                    self.stream.checks.check_decimals(readings, self.settings.decimal)
                calibrated = self.stream.apply(signals, raw.tell(), f"{self.source}:{lines[0]}")
                self._replace(cells, signals, calibrated)
                if self.marked:
                    beyond = self.stream.checks.extrapolated(signals["temperature"])
                    cells.append(pc.cast(to_arrow(beyond.astype(np.int64)), pa.string()))
                self.out.write(_lines_of(cells, self.layout.delimiter, quoted=b'"' in body))
                rows += len(lines)
            if rows == 0:
                self._begin(log.head)
            self.stream.result.sensors = [sensor for sensor in SENSORS if sensor in self.places]
            return self.stream.finish([note.detail for note in log.notes])

    def _replace(self, columns: list[pa.Array], signals: Readings, readings: Readings) -> None:
        """Replace raw by calibrated numbers in the columns; missing numbers keep their text."""
        for sensor, values in readings.items():
            for k, i in enumerate(self.places[sensor]):
                text = pc.cast(to_arrow(np.round(values[:, k], DECIMALS) + 0.0), pa.string())
                text = pc.replace_substring(text, ".", self.settings.decimal) if self.settings.decimal != "." else text
                missing = ~np.isfinite(values[:, k])
                if missing.any():
                    written = pa.array(~np.isfinite(signals[sensor][:, k]))
                    text = pc.if_else(pa.array(missing), pc.if_else(written, columns[i], ""), text)
                columns[i] = text

    def _begin(self, head: Head | None) -> None:
        """Find the columns, and write the lines before the rows."""
        if head is None:
            message = "the file is empty; expected a header with the names of the columns"
            raise InputError(message, f"{self.source}:1")
        self._find(head.names, f"{self.source}:{head.line}")
        pairs = ((c, i) for s, where in self.places.items() for c, i in zip(CHANNELS_OF_SIGNALS[s], where, strict=True))
        places = [(self.columns[c], i) for c, i in pairs]
        self.layout = TextLayout(str(self.source), head.names, places, head.delimiter, self.settings.decimal)
        new = list(head.names)
        for sensor in (s for s in SENSORS if s in self.places):
            for channel, i in zip(TRIADS[sensor], self.places[sensor], strict=True):
                new[i] = CANONICAL[channel]
        self.marked = self.stream.checks.soaked is not None and "temperature" in self.places
        self.out.write(head.text([*new, *[EXTRAPOLATED] * self.marked]).encode())

    def _find(self, names: list[str], where: str) -> None:
        """Find the columns of the signals by the names in the header; ``where``: its place, for messages."""
        for signal, channels in CHANNELS_OF_SIGNALS.items():
            expected = [self.columns[c] for c in channels if c in self.columns]
            present = {str(c.column): index for c in expected if (index := c.index(names)) is not None}
            twice = [name for name in present if names.count(name) > 1]
            if twice:
                raise InputError(f"the header names {twice[0]} more than once", where)
            if present and len(present) < len(expected):
                missing = ", ".join(str(c.column) for c in expected if str(c.column) not in present)
                raise InputError(f"the header names {', '.join(present)}, but not {missing}", where)
            if present:
                self.places[signal] = [*present.values()]
        if not any(sensor in self.places for sensor in SENSORS):
            hint = "--ingest names the profile, or its file, that describes this log"
            if {CANONICAL[c] for c in (*ACCELEROMETER, *GYROSCOPE)} & set(names):
                hint = f"these are the columns that this command writes: the log is compensated already, else {hint}"
            columns = ", ".join(str(self.columns[c].column) for s in SENSORS for c in TRIADS[s] if c in self.columns)
            got = f"{', '.join(names)[:200]}{other_separator(names)}"
            raise InputError(f"no column of a sensor; expected {columns}, got {got}; {hint}", where)

    def _refusal(self, body: bytes, lines: Integers, otherwise: str) -> InputError:
        """Return the error for the first line of a block with a cell that is not a number."""
        for fault in find_faults(self.layout, body, lines, None):
            if fault.kind != "not_finite":
                return InputError(fault.message, f"{self.source}:{fault.line}")
        return InputError(f"the log is no table of numbers: {otherwise}", f"{self.source}:{lines[0]}")

    def _numbers(self, cells: pa.Array) -> Values:
        """Return a column as numbers, NaN for an empty cell; raises ``ArrowInvalid`` if a cell is not a number."""
        text = cells if self.settings.decimal == "." else pc.replace_substring(cells, self.settings.decimal, ".")
        try:
            numbers = pc.cast(text, pa.float64())
        except pa.ArrowInvalid:  # blanks, empty cells, or other text
            text = pc.utf8_trim_whitespace(text)
            numbers = pc.cast(pc.if_else(pc.equal(text, ""), pa.scalar(None, pa.string()), text), pa.float64())
        return to_numpy(pc.fill_null(numbers, np.nan) if numbers.null_count else numbers)

    def _signals(self, cells: list[pa.Array], rows: int) -> dict[str, Any]:
        """Return the signals of a block that begins at row ``rows``: g and deg/s in body axes, degC and s."""
        signals: dict[str, Any] = {}
        for signal, where in self.places.items():
            numbers = np.column_stack([self._numbers(cells[i]) for i in where])
            for k, channel in enumerate(CHANNELS_OF_SIGNALS[signal]):
                column = self.columns[channel]
                if channel != "time" or column.unit == COUNTS:
                    numbers[:, k] = in_house_unit(column, numbers[:, k])
                else:
                    numbers[:, k] /= SECOND_NS / UNITS["time"][column.unit][0]
            signals[signal] = self.profile.to_body(signal, numbers) if signal in SENSORS else numbers[:, 0]
        if self.settings.rate_hz is not None:
            signals["time"] = np.arange(rows, rows + len(cells[0])) / self.settings.rate_hz
        if "time" in signals:
            if rows == 0 and signals["time"][0] > SINCE_1970_NS / SECOND_NS:
                self.origin = float(signals["time"][0])
            signals["time"] = signals["time"] - self.origin
        return signals


def sensor_parts(ingest: Ingest, *, messages: bool = False) -> list[int]:
    """Return the indices of the files with readings or the temperature in the profile's ``parts``.

    ``messages``: of message logs.
    """
    channels = {*ACCELEROMETER, *GYROSCOPE, "temperature"}
    if messages:
        return list(range(len(mcap_formats(ingest))))
    return [i for i, layout in enumerate(csv_formats(ingest)) if channels & {c.channel for c in layout.columns}]


def compensate_whole(files: Sequence[Path], out: Output, profile: LogProfile, stream: LogStream) -> Result:
    """Write the calibrated readings of a message log, or of files joined on equal time, as text."""
    source, ingest = files[0], profile.ingest
    if source.suffix.lower() in MESSAGE_FORMATS:
        from imu_logs.message_read import read_logs  # noqa: PLC0415  (slow import, not for text logs)

        table = read_logs(files, ingest)
    else:
        from imu_logs.text_read import read_csv  # noqa: PLC0415  (only for joined files)

        layouts = csv_formats(ingest)
        table = read_csv(files, [layouts[part] for part in sensor_parts(ingest)], checks_of(ingest))
    origin = int(table.time_ns[0]) if table.time_ns[0] > SINCE_1970_NS else 0
    present = {s: triad for s, triad in TRIADS.items() if triad[0] in table.values}
    signals = {s: profile.to_body(s, np.column_stack([table.values[c] for c in triad])) for s, triad in present.items()}
    names = ["time", *(c for s in signals for c in TRIADS[s]), *(["temperature"] * ("temperature" in table.values))]
    signals |= {"time": (table.time_ns - origin) / 1e9}
    signals |= {"temperature": table.values["temperature"]} if "temperature" in table.values else {}
    marked = stream.checks.soaked is not None and "temperature" in signals
    out.write((",".join([*(CANONICAL[c] for c in names), *[EXTRAPOLATED] * marked]) + "\n").encode())
    for start in range(0, len(table.time_ns), BLOCK_ROWS):
        block = {name: values[start : start + BLOCK_ROWS] for name, values in signals.items()}
        readings = stream.apply(block, 0, str(source), f" (row {start + 1})")
        columns = [v for s in SENSORS if s in readings for v in readings[s].T]
        columns += [block["temperature"]] if "temperature" in block else []
        arrays = [times_as_decimals(table.time_ns[start : start + BLOCK_ROWS])]
        arrays += [to_arrow(np.round(v, DECIMALS) + 0.0) for v in columns]
        arrays += [to_arrow(stream.checks.extrapolated(block["temperature"]).astype(np.int64))] if marked else []
        sink = pa.BufferOutputStream()
        rows = pa.Table.from_arrays(arrays, [str(i) for i in range(len(arrays))])
        csv.write_csv(rows, sink, csv.WriteOptions(include_header=False))
        out.write(memoryview(sink.getvalue()))
    return stream.finish([f"{n.code}: {n.detail}" for n in table.notes])


def _lines_of(columns: list[pa.Array], delimiter: str, *, quoted: bool) -> memoryview:
    """Return the rows as lines of text; ``quoted``: whether cells may need quotes."""
    cells = [_quoted(column, delimiter) for column in columns] if quoted else list(columns)
    cells[-1] = pc.binary_join_element_wise(cells[-1], text_scalar("\n"), text_scalar(""))
    lines = pc.binary_join_element_wise(*cells, text_scalar(delimiter)) if len(cells) > 1 else cells[0]
    ends = np.frombuffer(lines.buffers()[1], np.int32, len(lines) + 1, 4 * lines.offset)
    return memoryview(lines.buffers()[2])[ends[0] : ends[-1]]


def _quoted(column: pa.Array, delimiter: str) -> pa.Array:
    """Quote the cells that contain a delimiter, a quote or a line end."""
    special = pc.match_substring_regex(column, f'["{delimiter}\r\n]')
    if not pc.any(special).as_py():
        return column
    doubled = pc.replace_substring(column, '"', '""')
    return pc.if_else(special, pc.binary_join_element_wise('"', doubled, '"', ""), column)


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
    strict: bool = False,
    block_bytes: int = BLOCK_BYTES,
    progress: Callable[[int, int], None] | None = None,
) -> Result:
    """Compensate a log; its suffix states the format: ``.mcap``, one of ``MESSAGE_FORMATS``, else text.

    ``profile``: by default the canonical CSV, or the only Imu topic. ``joined``: the other files with readings, in the
    order of a profile that joins several. ``topic``: of the calibrated messages in an MCAP log; by default, topic of
    the readings with the suffix ``_calibrated``. ``smoothing``: memory of the regression line through past
    temperatures, s; 0 uses the temperature unchanged. ``rest``: an interval with a rest, s from the first sample; its
    mean rate is subtracted from the gyroscope. ``strict``: whether to refuse samples beyond the soaked temperatures.
    ``progress`` is called with the numbers of finished samples and of read bytes. Raises ``InputError``, without an
    output, if the log is damaged, contradicts the profile, has no rest in that interval, or would be overwritten.
    """
    files, profile, suffix = [source, *joined], profile or LogProfile(), source.suffix.lower()
    for file in files:
        require_apart(file, target)
    smoothed = 0.0 if suffix == ".mcap" else smoothing  # of MCAP, ``Temperatures`` smooths

    def write(stream: LogStream, file: Path) -> Result:
        with replacing(file) as out:
            result = written(stream, out)
            if strict:
                stream.checks.require_within(str(source))
            return result

    def written(stream: LogStream, out: Output) -> Result:
        if suffix == ".mcap":
            from pipeline.app.field_logs.mcap_log import McapLog  # noqa: PLC0415  (only for this format)

            return McapLog(source, out, profile, stream, topic, smoothing).compensate()

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
    kinds = [LOG_FORMATS.get(file.suffix.lower(), "text" if file is source else None) for file in (source, target)]
    if kinds[1] is not None and kinds[0] != kinds[1]:
        is_text = source.suffix.lower() in MESSAGE_FORMATS
        log = f"of a {source.suffix} log text is made" if is_text else f"the log is {kinds[0]}, and so is the output"
        message = f"{log}, but its name ends in {target.suffix}"
        raise InputError(f"{message}: choose another name", str(target))


def _descriptor(target: Path) -> int | None:
    """Return the file descriptor that a target names; None for a path."""
    match = DESCRIPTOR.fullmatch(str(target))
    return int(match[1] or 1) if match else None


@contextmanager
def replacing(target: Path) -> Iterator[Output]:
    """Open an output that replaces the file of its name when it is complete.

    The target of a symbolic link is replaced, with the same permissions. Standard output, pipes and devices are written
    directly.
    """
    descriptor, part = _descriptor(target), None
    file = target if descriptor is not None else target.resolve()
    with user_errors(target):
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
        with user_errors(target):
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
