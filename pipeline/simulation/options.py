"""What is recorded and how, as options of a command line: sensor, table, procedure, sampling and course.

``simulate`` and ``plan`` take the same options, so that what was planned can be simulated word for word.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.simulation.procedures import TABLE_PROCEDURES
from pipeline.simulation.table_logs import KINDS

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping

RECORDED = ("sensor", "table", "procedure", "samples", "interval_s", "lost")
COURSE = (
    "dwell_s", "step_deg", "accelerometer_rates_dps", "rates_dps", "both_directions", "turns", "positions",
    "validation_s", "validation_rate_dps", "static_s", "pause_s", "thermal_ramp_degc",
)  # fmt: skip


def add_recording_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``RECORDED`` and ``COURSE``; those not given are absent from the result.

    Parameters
    ----------
    parser : ArgumentParser
        With ``argument_default=argparse.SUPPRESS``.
    """
    add = parser.add_argument
    add("--sensor", metavar="NAME", help="configs/sensor (mpu6050)")
    add("--table", metavar="NAME", help="configs/table (acutronic; hand for procedures without a table)")
    add("--procedure", metavar="NAME", help="configs/procedure (three_axis_turns)")
    add("--samples", type=int, metavar="N", help="about so many rows a unit: dwells, rests, held-out motion follow")
    add("--interval", dest="interval_s", type=float, metavar="S", help="sampling interval in s (0.12)")
    add("--table-log", choices=KINDS, help="where the table is logged: in the sensor's rows (the default), in a file "
        "with a clock of its own, or not at all: then its program is known")  # fmt: skip
    add("--lost", type=float, metavar="SHARE", help="share of the samples that the radio link loses (0)")
    _add_course(parser.add_argument_group("how the procedure is run"))


def _add_course(course: argparse._ArgumentGroup) -> None:
    add = course.add_argument
    add("--dwell", dest="dwell_s", type=float, metavar="S", help="rest at each stop (1; without a table 4)")
    add("--step", dest="step_deg", type=float, metavar="DEG", help="of stop-and-go (5)")
    add("--accelerometer-rate", dest="accelerometer_rates_dps", type=float, nargs="+", metavar="DPS",
        help="continuous turns for the accelerometer in place of stop-and-go")  # fmt: skip
    add("--rate", "--rates", dest="rates_dps", type=float, nargs="+", metavar="DPS", help="gyroscope turns (60)")
    add("--both-directions", action="store_true", help="make each turn backwards too")
    add("--turns", type=int, metavar="N", help="whole turns at each rate (1)")
    add("--positions", type=int, metavar="N", help="rests of multi_position (40)")
    add("--validation", dest="validation_s", type=float, metavar="S", help="length of held-out motion (120; 0: none)")
    add("--validation-rate", dest="validation_rate_dps", type=float, metavar="DPS", help="largest rate in it (40)")
    add("--static", dest="static_s", type=float, metavar="S", help="length of the long rest (120; 0: none)")
    add("--pause", dest="pause_s", type=float, metavar="S", help="between recordings (30)")
    add(
        "--thermal-ramp", dest="thermal_ramp_degc", type=float, metavar="DEGC", help="of thermal_ramp: up and down (15)"
    )


def described(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys of a unit of ``simulation.yaml`` that the options give.

    Parameters
    ----------
    arguments : mapping
        Parsed options; others than those of this module are left aside.
    """
    procedure = arguments.get("procedure", "three_axis_turns")
    unit: dict[str, Any] = {"table": "acutronic" if procedure in TABLE_PROCEDURES else "hand"}
    unit |= {name: arguments[name] for name in RECORDED if name in arguments}
    unit |= {"table_log": {"kind": arguments["table_log"]}} if "table_log" in arguments else {}
    course = {name: arguments[name] for name in COURSE if name in arguments}
    return {**unit, "course": course} if course else unit
