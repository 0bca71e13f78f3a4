"""Compensate a log as a stream: read, compensate and write it block by block.

The modules ``pipeline.app.field_logs.stream`` and ``mcap_log`` read and write the blocks of each format. The
largest block determines the memory; logs of other programs, and files that the profile joins, are read into memory.

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
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from imu_logs.files import GIT_LFS, MESSAGE_FORMATS, not_regular
from pipeline.app.field_logs.stream import CalibratedStretch, LogProfile, LogStream, Output, Result, user_errors
from pipeline.core.errors import ConfigurationError, InputError, MissingInputError
from pipeline.physics.compensation import SMOOTHING_S, Compensation

BLOCK_BYTES = 1 << 21  # of a text log: 20,000 rows, whose arrays take about 10 MB
DESCRIPTOR = re.compile(r"-|/dev/stdout|(?:/dev/fd|/proc/self/fd)/(\d+)")  # files that are already open
LOG_FORMATS = {".mcap": "MCAP", ".csv": "text", ".txt": "text"}


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
        from pipeline.app.field_logs.stream import CsvLog, compensate_whole, sensor_parts  # noqa: PLC0415

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
