"""Propose the next rest or turn of a recording by hand, and state when the recording is sufficient."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from pipeline.app.commands import parser_of
from pipeline.simulation import REST_BY_HAND_S

EPILOG = """\
The next rest is the one that reduces the uncertainty of the accelerometer's calibration most. The goal is reached when
the largest expanded uncertainty (95 %) of the bias, in mg, and of the matrix, in mg at 1 g, is below --goal. With
--gyroscope-goal, turns for the gyroscope's matrix follow (method=rests_and_moves); until then each message states its
uncertainty. With --procedure ferraris, the next missing face or turn is named. docs/record.md shows the names of the
attitudes.

A recording of a campaign is read as the campaign's configuration says, together with the unit's other recordings. Any
other file is read by --sensor, --ingest and --procedure.

examples:
  python -m pipeline guide data/my_bench/raw/U1/recording.csv --follow
  python -m pipeline guide log.csv --sensor mpu6050 --goal 0.3
  python -m pipeline guide log.mcap --sensor mpu6050 --ingest mcap --follow
"""


def main(argv: Sequence[str]) -> int:
    """Run ``python -m pipeline guide RECORDING...``."""
    arguments = _parser().parse_args(argv)
    from pipeline.app.commands.guide_recording import guide_recording  # noqa: PLC0415  (0.4 s, which --help does not need)

    return guide_recording(arguments)


def _parser() -> argparse.ArgumentParser:
    parser = parser_of("guide", __doc__, EPILOG, ("--sensor", "--ingest"))
    add = parser.add_argument
    add("files", type=Path, nargs="+", metavar="RECORDING", help="recordings of one unit, made by hand")
    add("--follow", action="store_true", help="read the log while it grows, until the goal is reached (Ctrl-C ends it)")
    wanted = "wanted expanded uncertainty, mg (default: what orientations_24 reaches with the noise of the sensor file)"
    add("--goal", type=float, metavar="MG", help=wanted)
    wanted = "wanted expanded uncertainty of the gyroscope's matrix (default: only the accelerometer is guided)"
    add("--gyroscope-goal", type=float, metavar="PERCENT", help=wanted)
    words = "planned length of a rest (default: %(default)g)"
    add("--dwell", type=float, metavar="S", default=REST_BY_HAND_S, help=words)
    add("--procedure", metavar="NAME", help="multi_position (default), orientations_24, six_positions or ferraris")
    return parser
