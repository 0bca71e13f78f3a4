"""Create an empty campaign with comments."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from pipeline.errors import ConfigurationError, InputError
from pipeline.files import CONFIGS
from pipeline.outcome import run_command

if TYPE_CHECKING:
    from collections.abc import Sequence

GROUPS = ("sensor", "table", "procedure", "method", "filter", "ingest", "certificate")
HEADER = "unit,serial,lot,date,sensor,table,procedure,overrides"
SETTINGS = """\
# Hydra overrides for all units of this campaign; units.csv and the command line are stronger.
overrides:
  []
  # - table.gravity_g=0.9976          # local gravity, g (9.80665 m/s^2)
  # - filter=rc_low_pass              # a group: one of its options
  # - filter.cutoff_hz=2.0            # a value
  # - effects.gyroscope=[g_sensitivity]
  # - limits.gyroscope.held_out_rms_error=0.05
  # - batch_size=50                   # units that one job handles
"""


def main(argv: Sequence[str]) -> int:
    """Run ``python -m pipeline new DIR``."""
    parser = argparse.ArgumentParser(prog="python -m pipeline new", description=__doc__)
    parser.add_argument("directory", type=Path, metavar="DIR", help="the campaign's directory (created if need be)")
    parser.add_argument("--sensor", default="generic", help="sensor model of the example row (default: generic)")
    parser.add_argument("--table", help="table of the example row (default: that of the procedure)")
    parser.add_argument("--procedure", default="three_axis_turns", help="procedure (default: three_axis_turns)")
    parser.add_argument("--unit", default="U1", help="name of the example unit (default: U1)")
    arguments = parser.parse_args(argv)
    sheet = arguments.directory / "units.csv"
    if sheet.exists():
        raise InputError("exists already; choose a directory without a campaign", str(sheet))
    sensor = _option("sensor", arguments.sensor)
    procedure = _option("procedure", arguments.procedure)
    table_name = arguments.table or procedure["table"]
    table = _option("table", table_name)
    folder = arguments.directory / procedure["folder"].replace("{unit}", arguments.unit)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "README.md").write_text(_recordings(arguments.procedure, procedure), encoding="utf-8")
    (arguments.directory / "campaign.yaml").write_text(
        SETTINGS + _ranges(arguments.sensor, sensor) + _options(), encoding="utf-8"
    )
    row = f"{arguments.unit},,,,{arguments.sensor},{table_name},{arguments.procedure},"
    sheet.write_text(f"{HEADER}\n{row}\n", encoding="utf-8")
    print(f"{sheet}: one row for each unit; put the recordings into {folder} (its README.md lists them)")
    print(_accuracy(table_name, table))
    print(f"then: {run_command({'campaign': str(arguments.directory)})}")
    return 0


def _option(group: str, name: str) -> dict[str, Any]:
    file = CONFIGS / group / f"{name}.yaml"
    if not file.is_file():
        options = ", ".join(sorted(f.stem for f in (CONFIGS / group).glob("*.yaml")))
        raise ConfigurationError(f"no {group} is called {name!r}; known: {options}")
    content: dict[str, Any] = yaml.safe_load(file.read_text(encoding="utf-8"))
    return content


def _accuracy(name: str, table: dict[str, Any]) -> str:
    """Return the accuracy of the table that the results assume, and how to state another."""
    if table["motion"] == "none":
        return f"table {name}: there is no table; the unit is placed by hand"
    others = ", ".join(sorted(f.stem for f in (CONFIGS / "table").glob("*.yaml") if f.stem != name))
    angle, rate = f"{table['angle_accuracy_deg']:g} deg", f"{100 * table['rate_accuracy']:g} %"
    return (
        f"table {name}: accuracy of its angles {angle}, of its rates {rate} (standard uncertainties); "
        f"for another table, write {others} or the name of your own file in configs/table/ into the column table"
    )


def _ranges(name: str, sensor: dict[str, Any]) -> str:
    """Return comments that show how to set other ranges than those of the sensor's file."""
    units = {"accelerometer": "g", "gyroscope": "deg/s"}
    held = ", ".join(f"{s} +-{sensor[s]['full_scale']:g} {unit}" for s, unit in units.items())
    lines = [
        "",
        f"# The file of the sensor {name} states the ranges {held}. Example for ranges twice as large:",
        "# models:",
    ]
    lines.append(f"#   {name}:")
    for part in units:
        full_scale, counts = (float(sensor[part][key]) for key in ("full_scale", "counts_per_unit"))
        lines.append(f"#     - sensor.{part}.full_scale={2 * full_scale:g}")
        lines.append(f"#     - sensor.{part}.counts_per_unit={counts / 2:.10g}")
    return "\n".join(lines) + "\n"


def _recordings(name: str, procedure: dict[str, Any]) -> str:
    lines = [
        f"# Recordings of the procedure {name}",
        "",
        "`.mcap` in place of `.csv` works for each, and so do the formats of docs/formats.md.",
        "",
    ]
    for recording in procedure["recordings"].values():
        axis = f", turns about {recording['axis']}" if recording["axis"] else ""
        optional = " (optional)" if recording["optional"] else ""
        lines.append(f"- `{recording['file']}.csv`: {recording['role']}{axis}{optional}")
    columns = "time_s, accel_x_g, accel_y_g, accel_z_g, gyro_x_dps, gyro_y_dps, gyro_z_dps"
    optional = "temperature_degc, table_angle_deg, table_rate_dps, table_qw, table_qx, table_qy, table_qz"
    lines += ["", f"Columns of a canonical CSV: {columns}, and optionally {optional}.", ""]
    lines += ["Other columns, units and raw counts: describe them in an ingest config.", ""]
    lines += ["Face that points up at table angle 0, and direction in which the angle counts: docs/mounting.md.", ""]
    return "\n".join(lines)


def _options() -> str:
    lines = ["", "# Groups and their options (columns of units.csv, or overrides):"]
    for group in GROUPS:
        options = ", ".join(sorted(f.stem for f in (CONFIGS / group).glob("*.yaml")))
        lines.append(f"#   {group}: {options}")
    return "\n".join(lines) + "\n"
