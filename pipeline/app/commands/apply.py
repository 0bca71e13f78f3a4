"""Apply the calibration of a unit to a log, and write the calibrated readings."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from imu_logs.files import MESSAGE_FORMATS
from pipeline.app.commands import parser_of
from pipeline.app.field_logs.stream import LogProfile, compensate_log, require_apart
from pipeline.app.run_progress import Countdown
from pipeline.core.errors import ConfigurationError, InputError
from pipeline.core.files import CONFIGS
from pipeline.core.pack import is_published, read_published
from pipeline.core.records import SENSORS
from pipeline.core.verdicts import DOUBTS, KINDS, Verdict
from pipeline.physics.compensation import SMOOTHING_S, load, read_calibration

EPILOG = """\
In a CSV log, calibrated columns in g and deg/s (accel_x_g .. gyro_z_dps) replace the columns of the sensors; all other
cells are unchanged. In an MCAP log, all messages are unchanged, and a topic with calibrated Imu messages is added. For
a log of another format, the output is a CSV with the columns time_s, accel_x_g .. gyro_z_dps, temperature_degc.

The log is expected to have the columns, units, counts and axes of the recordings with which the unit was calibrated,
unless --ingest names another profile or its file. If the profile joins files of one recording (accelerometer and
gyroscope in separate files), name one or all of them; the output is a CSV with the columns above. CSV and MCAP are read
in a stream; logs of other formats and joined files are read into memory.

The bias of a gyroscope changes from one power-on to the next. If the unit rests for some seconds of the log, state
them: --rest 0:10 subtracts the mean rate of the longest rest in the first 10 s of the log. The command prints this rate
with its uncertainty.

examples:
  python -m pipeline apply --calibration results/demo/calibrations/U1.json drive.csv -o drive_calibrated.csv
  python -m pipeline apply --calibration U1.json drive.mcap -o drive_calibrated.mcap
  python -m pipeline apply --calibration U1.json drive/accelerometer.txt drive/gyroscope.txt -o drive.csv
  python -m pipeline apply --calibration U1.json drive.csv --rest 0:10 -o drive_calibrated.csv
  python -m pipeline apply --calibration U1.json counts.csv --ingest arduino_counts -o out.csv
  python -m pipeline apply --calibration U1.json log.csv --ingest my_bench/configs/ingest/my_logger.yaml -o out.csv
"""


def main(argv: Sequence[str]) -> int:
    """Run ``python -m pipeline apply``."""
    arguments = _parser().parse_args(argv)
    if arguments.smoothing < 0:
        raise ConfigurationError(f"--temperature-smoothing is {arguments.smoothing:g} s; it cannot be negative")
    compensation = load(arguments.calibration, arguments.python_effects)
    for log in arguments.logs:
        require_apart(log, arguments.output)
    calibration, output = arguments.calibration, arguments.output
    if output.exists() and calibration.exists() and output.samefile(calibration):
        raise InputError("the output would overwrite the calibration; choose another file for -o", str(output))
    profile = _profile(calibration, arguments.ingest, arguments.logs[0])
    log, *joined = _files(arguments.logs, profile)
    countdown = Countdown(log.stat().st_size if log.is_file() else 0)
    result = compensate_log(
        compensation, log, arguments.output, profile,
        joined=joined, topic=arguments.topic, smoothing=arguments.smoothing, rest=arguments.rest,
        strict=arguments.strict,
        progress=lambda rows, read: countdown(read, f"{rows} samples"),
    )  # fmt: skip
    countdown.end()
    for warning in [*_not_ready(arguments.calibration), *result.warnings]:
        print(f"warning: {warning}", file=sys.stderr)
    for note in result.notes:
        print(f"note: {note}", file=sys.stderr)
    what = f"messages compensated on {result.topic}" if result.topic else "rows compensated"
    print(f"{result.samples} {what} with unit {result.unit}: {arguments.output}", file=sys.stderr)
    return 0


def _not_ready(calibration: Path) -> list[str]:
    """Return which sensors of a published calibration are not ready, by the diagnosis beside it."""
    file = calibration.parent.parent / "diagnoses" / calibration.name
    if calibration.parent.name != "calibrations" or not is_published(file):
        return []
    document, found = json.loads(read_published(file)), []
    for sensor in SENSORS:
        part = document.get(sensor) or {}
        if part.get("verdict") in DOUBTS | {Verdict.MISSING_EFFECT}:
            words = ", ".join(part["selected"]) or part.get("decided_by") or ""
            found.append(f"the {sensor} is not ready: {KINDS[part['verdict']].name}{', ' * bool(words)}{words}")
    return found


def _parser() -> argparse.ArgumentParser:
    parser = parser_of("apply", __doc__, EPILOG, ("--ingest",))
    add = parser.add_argument
    words = f"the log: .mcap, {', '.join(MESSAGE_FORMATS)}, or text; several files only if the profile joins them"
    add("logs", type=Path, nargs="+", metavar="LOG", help=words)
    add("--calibration", type=Path, required=True, metavar="C.json", help="calibrations/<unit>.json of the unit")
    words = "file to write: MCAP for an MCAP log, else CSV; - for the standard output"
    add("-o", "--output", type=Path, required=True, metavar="OUT", help=words)
    words = "MCAP: topic of the calibrated messages (default: topic of the readings with the suffix _calibrated)"
    add("--topic", metavar="TOPIC", help=words)
    words = "time constant of the causal smoothing of the temperature, s; 0: none (default: %(default)g)"
    add("--temperature-smoothing", type=float, default=SMOOTHING_S, metavar="S", dest="smoothing", help=words)
    add("--strict", action="store_true", help="refuse a log with samples beyond the temperatures of the soaks")
    words = "interval with a rest, s from the first sample: the gyroscope's bias is measured there"
    add("--rest", type=_seconds, metavar="FROM:TO", help=words)
    words = "file of a Python effect that the calibration uses; the file is run; may be repeated"
    add("--python-effect", action="append", default=[], metavar="FILE", dest="python_effects", help=words)
    return parser


def _seconds(text: str) -> tuple[float, float]:
    """Return the first and the last second of a stretch ``FROM:TO``."""
    first, _, last = text.partition(":")
    try:
        found = float(first), float(last)
    except ValueError:
        found = 0.0, 0.0
    if not 0.0 <= found[0] < found[1] < float("inf"):
        raise ConfigurationError(f"--rest is {text}; expected FROM:TO in s, for example 0:10")
    return found


def _files(logs: Sequence[Path], profile: LogProfile) -> list[Path]:
    """Return the log, or all files with readings of one recording, in the order of the profile that joins them."""
    suffix = logs[0].suffix.lower()
    if suffix != ".mcap":
        from pipeline.app.field_logs.stream import sensor_parts  # noqa: PLC0415  (a text parser, not for MCAP)

        parts = sensor_parts(profile.ingest, messages=suffix in MESSAGE_FORMATS)
        if len(parts) > 1:
            from pipeline.ingest.files import grouped  # noqa: PLC0415

            recordings = grouped(logs, profile.ingest)
            if len(recordings) > 1:
                raise ConfigurationError(f"{len(recordings)} recordings are named; apply reads one", str(logs[1]))
            return [recordings[0][part] for part in parts]
    if len(logs) > 1:
        raise ConfigurationError("apply reads one log, unless the profile joins several files", str(logs[1]))
    return list(logs)


def _profile(calibration: Path, ingest: str | None, log: Path) -> LogProfile:
    """Return the layout of the log: of the recordings of the unit, or of the profile ``ingest`` (name or file)."""
    document = read_calibration(calibration)
    profile = LogProfile.of_calibration(document, str(calibration))
    if ingest is None:
        return profile
    from pipeline.app.commands.readings import config_of_log  # noqa: PLC0415  (imports Hydra: 0.3 s)

    sensor = document.get("sensor")
    known = (CONFIGS / "sensor" / f"{sensor}.yaml").is_file()
    config = config_of_log(log, ingest, sensor if known else None)
    return LogProfile(config.ingest, profile.axis_maps)
