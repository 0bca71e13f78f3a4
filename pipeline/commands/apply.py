"""Apply a unit's calibration to a log: write calibrated readings."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.commands import parser_of
from pipeline.errors import ConfigurationError, InputError
from pipeline.field_logs.compensate import LogProfile, compensate_log, require_apart
from pipeline.files import CONFIGS
from pipeline.io.files import MESSAGE_FORMATS
from pipeline.model.calibration_file import read_calibration
from pipeline.model.compensation import SMOOTHING_S, load
from pipeline.run_progress import Countdown

if TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence

EPILOG = """\
Of a CSV log, the columns of the sensors are replaced by calibrated ones in g and deg/s (accel_x_g .. gyro_z_dps); all
other cells stay as they are. Of an MCAP log, all messages stay byte for byte, and a topic with calibrated Imu messages
is added. Logs of other formats give CSV with the columns time_s, accel_x_g .. gyro_z_dps, temperature_degc.

Columns, units, counts and axes of the log are those of the recordings with which the unit was calibrated, unless
--ingest names another profile, or its file. CSV and MCAP are read in a stream; logs of other formats are held in
memory.

examples:
  python -m pipeline apply --calibration results/demo/calibrations/U1.json drive.csv -o drive_calibrated.csv
  python -m pipeline apply --calibration U1.json drive.mcap -o drive_calibrated.mcap
  python -m pipeline apply --calibration U1.json counts.csv --ingest arduino_counts -o out.csv
  python -m pipeline apply --calibration U1.json log.csv --ingest my_bench/configs/ingest/my_logger.yaml -o out.csv
"""


def main(argv: Sequence[str]) -> int:
    """Run ``python -m pipeline apply``."""
    arguments = _parser().parse_args(argv)
    if arguments.smoothing < 0:
        raise ConfigurationError(f"--temperature-smoothing is {arguments.smoothing:g} s; it cannot be negative")
    compensation = load(arguments.calibration, arguments.python_effects)
    require_apart(arguments.log, arguments.output)
    if (
        arguments.output.exists()
        and arguments.calibration.exists()
        and arguments.output.samefile(arguments.calibration)
    ):
        message = "the output would overwrite the calibration; choose another file for -o"
        raise InputError(message, str(arguments.output))
    profile = _profile(arguments.calibration, arguments.ingest, arguments.log)
    countdown = Countdown(arguments.log.stat().st_size if arguments.log.is_file() else 0)
    result = compensate_log(
        compensation, arguments.log, arguments.output, profile,
        topic=arguments.topic, smoothing=arguments.smoothing,
        progress=lambda rows, read: countdown(read, f"{rows} samples"),
    )  # fmt: skip
    countdown.end()
    for warning in result.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    for note in result.notes:
        print(f"note: {note}", file=sys.stderr)
    what = f"messages compensated on {result.topic}" if result.topic else "rows compensated"
    print(f"{result.samples} {what} with unit {result.unit}: {arguments.output}", file=sys.stderr)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = parser_of("apply", __doc__, EPILOG, ("--ingest",))
    add = parser.add_argument
    add("log", type=Path, metavar="LOG", help=f"the log: .mcap, {', '.join(MESSAGE_FORMATS)}, or text")
    add(
        "--calibration",
        type=Path,
        required=True,
        metavar="C.json",
        help="calibration of the unit: calibrations/<unit>.json",
    )
    words = "file to write: MCAP for an MCAP log, else CSV; - for the standard output"
    add("-o", "--output", type=Path, required=True, metavar="OUT", help=words)
    words = "MCAP: topic of the calibrated messages (default: that of the readings, with _calibrated at its end)"
    add("--topic", metavar="TOPIC", help=words)
    words = "time constant of the causal smoothing of the temperature, s; 0: none (default: %(default)g)"
    add("--temperature-smoothing", type=float, default=SMOOTHING_S, metavar="S", dest="smoothing", help=words)
    words = "file of an effect in Python with which the calibration was made; the file is run; may be repeated"
    add("--python-effect", action="append", default=[], metavar="FILE", dest="python_effects", help=words)
    return parser


def _profile(calibration: Path, ingest: str | None, log: Path) -> LogProfile:
    """Return the layout of the log: that of the unit's recordings, or that of a named profile or a profile's file."""
    document = read_calibration(calibration)
    profile = LogProfile.of_calibration(document, str(calibration))
    if ingest is None:
        return profile
    from pipeline.commands.readings import config_of_log  # noqa: PLC0415  (Hydra: 0.3 s that few logs need)

    sensor = document.get("sensor")
    known = (CONFIGS / "sensor" / f"{sensor}.yaml").is_file()
    config = config_of_log(log, ingest, sensor if known else None)
    return LogProfile(config["ingest"], profile.axis_maps)
