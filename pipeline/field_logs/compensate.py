"""Compensation of a log as a stream: blocks are read, compensated and written one after the other.

The format of the log gives the blocks and writes them (``pipeline.field_logs.csv_log``, ``mcap_log``); all else is the
same for all formats. Memory is bounded by the largest block.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from pipeline.errors import PipelineError
from pipeline.field_logs.log_checks import LogChecks
from pipeline.field_logs.output import replacing, require_apart
from pipeline.field_logs.profile import LogProfile
from pipeline.model.compensation import SMOOTHING_S
from pipeline.records import SENSORS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.model.compensation import Compensation

    Readings = dict[str, NDArray[Any]]

BLOCK_BYTES = 1 << 21  # of a text log: 20,000 rows, whose arrays take some 10 MB


@dataclass
class Block:
    """Samples of a log.

    ``signals``: ``accelerometer`` and ``gyroscope``, (n, 3) arrays in g and deg/s, body axes; ``time``, s, and
    ``temperature``, degC, (n,) arrays; absent signals are left out. ``file`` returns file and line for a message,
    ``place`` is the place in a file without lines. ``position``: bytes up to the end of the block. ``content``: what
    the format needs to write the block.
    """

    signals: dict[str, NDArray[Any]]
    file: Callable[[], str]
    place: str
    position: int
    content: Any


@dataclass
class Result:
    """What was compensated with the calibration of ``unit``.

    ``sensors``: those whose readings the log holds. ``topic``: of the calibrated messages in an MCAP log. ``notes``:
    facts about the output. ``warnings``: what contradicts that this calibration belongs to this log.
    """

    unit: str
    samples: int = 0
    sensors: list[str] = field(default_factory=list)
    topic: str = ""
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


class Log(Protocol):
    """A log of some format and the log that is made of it.

    Attributes
    ----------
    smoothing : float, s
        Of the temperature, as of ``Compensation.stream``; 0 where the format smooths it itself.
    """

    smoothing: float

    def blocks(self, needs: set[str], checks: LogChecks) -> Iterator[Block]:
        """Yield the samples; ``needs`` are the signals that the fitted effects need."""

    def write(self, block: Block, readings: Readings, changed: set[str]) -> None:
        """Write a block with its calibrated readings; those of sensors that are not in ``changed`` are as before."""

    def finish(self, result: Result) -> None:
        """Write what follows the last block, and add what belongs into the result."""


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
    """Compensate a log: MCAP by its suffix ``.mcap``, else text.

    Parameters
    ----------
    compensation : Compensation
    source, target : Path
    profile : LogProfile, optional
        How the log is laid out; by default the canonical CSV, or the only Imu topic.
    topic : str, optional
        Of the calibrated messages in an MCAP log; that of the readings and ``_calibrated`` by default.
    smoothing : float, s
        Memory of the line through the temperature's past; 0 takes the temperature as it is.
    block_bytes : int
        Size of the blocks in which a text log is read.
    progress : callable, optional
        Called with the samples done and the bytes read.

    Raises
    ------
    InputError
        If the log is damaged, cannot be read as the profile says, or the output would overwrite it; then no output is
        left.
    """
    require_apart(source, target)
    profile = profile or LogProfile()
    checks, result = LogChecks(), Result(compensation.unit)
    calibrated = {s for s in SENSORS if compensation.calibration(s) is not None}
    with replacing(target) as out:
        log: Log
        if source.suffix.lower() == ".mcap":
            from pipeline.field_logs.mcap_log import McapLog  # noqa: PLC0415  (each log needs one of the two)

            log = McapLog(source, out, profile, topic, smoothing)
        else:
            from pipeline.field_logs.csv_log import CsvLog  # noqa: PLC0415

            log = CsvLog(source, out, profile, smoothing, block_bytes)
        stream = compensation.stream(log.smoothing)
        for block in log.blocks(stream.needs, checks):
            given = {s: block.signals[s] for s in SENSORS if s in block.signals}
            try:
                found = stream.apply(**block.signals)
            except PipelineError as error:
                raise type(error)(error.message + block.place, block.file()) from None
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
