"""Compensation of a log as a stream: blocks are read, compensated and written one after the other.

The format of the log gives the blocks and writes them (``pipeline.field_logs.csv_log``, ``mcap_log``, ``message_log``);
all else is the same for all formats. Memory is bounded by the largest block, except in ``message_log``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import ConfigurationError, InputError, PipelineError
from pipeline.field_logs.log_checks import LogChecks
from pipeline.field_logs.output import replacing, require_apart
from pipeline.io.channel_table import STRAIGHT, axis_matrix, maps_of_log
from pipeline.io.files import MESSAGE_FORMATS
from pipeline.io.units import ACCELEROMETER, CANONICAL, GYROSCOPE, UNITS
from pipeline.model.compensation import SMOOTHING_S
from pipeline.records import SENSORS

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.field_logs.csv_log import CsvLog
    from pipeline.field_logs.mcap_log import McapLog
    from pipeline.field_logs.message_log import MessageLog
    from pipeline.model.compensation import Compensation

    Readings = dict[str, NDArray[Any]]


BLOCK_BYTES = 1 << 21  # of a text log: 20,000 rows, whose arrays take some 10 MB


def _canonical() -> dict[str, Any]:
    used = ("time", "temperature", *ACCELEROMETER, *GYROSCOPE)
    return {"csv": {"columns": {c: {"column": CANONICAL[c], "unit": next(iter(UNITS[c]))} for c in used}}}


@dataclass(frozen=True)
class LogProfile:
    """How the logs of a unit are laid out.

    ``ingest`` is the ingest profile, the canonical one by default. ``axis_maps``: sensor to the body axis that each of
    its reading axes points along; straight where it is not named.
    """

    ingest: Mapping[str, Any] = field(default_factory=_canonical)
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
            found = cls({**log["ingest"]}, maps)
        except (KeyError, TypeError, ConfigurationError) as error:
            told = "log is not what a run writes; expected ingest, an object, and axis_map, for example [+x, +y, +z]"
            raise InputError(f"{told}; got {error}", file) from None
        return found

    def to_body(self, sensor: str, readings: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (n, 3) readings of a sensor in the body's axes."""
        axis_map = tuple(self.axis_maps.get(sensor, STRAIGHT))
        if axis_map == STRAIGHT:
            return readings
        matrix = axis_matrix(axis_map)
        turned: NDArray[np.float64] = readings[:, np.argmax(np.abs(matrix), axis=1)] * matrix.sum(axis=1)
        return turned


@dataclass
class Block:
    """Samples of a log.

    ``signals``: ``accelerometer`` and ``gyroscope``, (n, 3) arrays in g and deg/s, body axes; ``time``, s, and
    ``temperature``, degC, (n,) arrays; absent signals are left out. ``file`` and, without lines, ``place`` stand in
    messages. ``position``: bytes up to the end of the block. ``content``: what the format needs to write the block.
    """

    signals: dict[str, NDArray[Any]]
    file: str
    place: str
    position: int
    content: Any


@dataclass
class Result:
    """What was compensated with the calibration of ``unit``.

    ``topic``: of the calibrated messages in an MCAP log. ``notes``: facts about the output. ``warnings``: what
    contradicts that this calibration belongs to this log.
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
    topic: str | None = None,
    smoothing: float = SMOOTHING_S,
    block_bytes: int = BLOCK_BYTES,
    progress: Callable[[int, int], None] | None = None,
) -> Result:
    """Compensate a log: MCAP by its suffix ``.mcap``, the formats of ``MESSAGE_FORMATS`` by theirs, else text.

    Parameters
    ----------
    profile : LogProfile, optional
        By default the canonical CSV, or the only Imu topic.
    topic : str, optional
        Of the calibrated messages in an MCAP log; that of the readings and ``_calibrated`` by default.
    smoothing : float, s
        Memory of the line through the temperature's past; 0 takes the temperature as it is.
    progress : callable, optional
        Called with the samples done and the bytes read.

    Raises
    ------
    InputError
        If the log is damaged, cannot be read as the profile says, or would be overwritten; no output is left.
    """
    require_apart(source, target)
    profile = profile or LogProfile()
    checks, result = LogChecks(), Result(compensation.unit)
    calibrated = {s for s in SENSORS if compensation.calibration(s) is not None}
    with replacing(target) as out:
        log: CsvLog | McapLog | MessageLog
        if source.suffix.lower() == ".mcap":
            from pipeline.field_logs.mcap_log import McapLog  # noqa: PLC0415  (each log needs one of the three)

            known = compensation.covariances
            log = McapLog(source, out, profile, topic=topic, smoothing=smoothing, covariances=known)
        elif source.suffix.lower() in MESSAGE_FORMATS:
            from pipeline.field_logs.message_log import MessageLog  # noqa: PLC0415

            log = MessageLog(source, out, profile, smoothing)
        else:
            from pipeline.field_logs.csv_log import CsvLog  # noqa: PLC0415

            log = CsvLog(source, out, profile, smoothing, block_bytes)
        stream = compensation.stream(log.smoothing)
        for block in log.blocks(stream.needs, checks):
            given = {s: block.signals[s] for s in SENSORS if s in block.signals}
            try:
                found = stream.apply(**block.signals)
            except PipelineError as error:
                raise type(error)(error.message + block.place, block.file) from None
            readings = {s: getattr(found, s) for s in given}
            checks.add(given, readings, block.signals.get("time"))
            log.write(block, readings, calibrated)
            result.samples += len(next(iter(given.values())))
            result.sensors = [s for s in SENSORS if s in {*result.sensors, *given}]
            if progress is not None:
                progress(result.samples, block.position)
        result.warnings = checks.warnings(calibrated & set(result.sensors))
        log.finish(result)
    for sensor in SENSORS:
        if sensor in calibrated and sensor not in result.sensors:
            result.notes.append(f"the log holds no readings of the {sensor}, which is calibrated")
        elif sensor in result.sensors and sensor not in calibrated:
            result.notes.append(f"the calibration holds no {sensor}; its readings are unchanged")
    return result
