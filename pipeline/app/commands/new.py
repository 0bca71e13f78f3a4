"""Create an empty campaign, with a README that states how to record it."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from pipeline.app.commands import parser_of
from pipeline.app.config.options import GROUPS
from pipeline.app.plan import readme
from pipeline.core.errors import ConfigurationError, InputError
from pipeline.core.files import CONFIGS
from pipeline.core.records import SENSOR_UNITS, SENSORS
from pipeline.core.settings import DataSheet, Table, settings_of_ranges
from pipeline.ingest.recordings_sheet import EXAMPLE
from pipeline.output.outcome import run_command
from pipeline.output.pages.pages import template
from pipeline.simulation.description import TABLE_PROCEDURES, UnitDescription, described, read_option, shipped_settings

HEADER = "unit,serial,lot,date,sensor,table,procedure,overrides"
EPILOG = """\
On a terminal the command asks for the sensor, the ranges, the procedure and the table that no option states.

examples:
  python -m pipeline new my_bench --sensor mpu6050 --range 4 500
  python -m pipeline new by_hand --sensor mpu6050 --procedure multi_position
"""


def main(argv: Sequence[str]) -> int:
    """Run ``python -m pipeline new DIR``."""
    parser = parser_of("new", __doc__, EPILOG, ("--range",))
    add = parser.add_argument
    add("directory", type=Path, metavar="DIR", help="directory of the campaign; it is created if it does not exist")
    add("--sensor", metavar="NAME", help="sensor model, a name in configs/sensor (default: generic)")
    add("--procedure", metavar="NAME", help="how you record, a name in configs/procedure (default: three_axis_turns)")
    add("--table", metavar="NAME", help="rate table, a name in configs/table (default: that of the procedure)")
    add("--unit", default="U1", metavar="NAME", help="name of the first unit (default: U1)")
    arguments = parser.parse_args(argv)
    units_table = arguments.directory / "units.csv"
    if units_table.exists():
        raise InputError("exists already; choose a directory without a campaign", str(units_table))
    sensor_name = _chosen("sensor", arguments.sensor, "generic")
    stated, completed = read_option("sensor", sensor_name), shipped_settings(sensor=sensor_name).sensor
    data_sheets = {s: completed.of(s) for s in SENSORS if stated.get(s)}
    ranges = _chosen_ranges(data_sheets, arguments.range)
    procedure_name = _chosen("procedure", arguments.procedure, "three_axis_turns")
    procedure = read_option("procedure", procedure_name)
    table_name = _chosen("table", arguments.table, procedure["table"])
    table = shipped_settings(table=table_name).table
    if (table.motion == "none") == (procedure_name in TABLE_PROCEDURES):
        known = ", ".join(TABLE_PROCEDURES)
        problem = f"procedure {procedure_name} does not fit table {table_name}: {known} need a table"
        raise ConfigurationError(f"{problem}, the others need none (table hand); docs/record.md shows both")
    bench = described({"sensor": sensor_name, "table": table_name, "procedure": procedure_name})
    unit = UnitDescription(arguments.unit, **bench)
    sheet = procedure.get("sheet")
    if sheet:
        turn_deg = f"{procedure['turns']['accuracy_deg']:g}"
        text = template("listed_readme.md").render(unit=arguments.unit, sensor=sensor_name, turn_deg=turn_deg)
    else:
        text = readme(unit, arguments.directory.resolve().name)
    if ranges != _ranges_of(data_sheets):
        text += "\nThe sizes apply to the ranges in the sensor file; campaign.yaml states the ranges of this bench.\n"
    folder = arguments.directory / procedure["folder"].replace("{unit}", arguments.unit)
    folder.mkdir(parents=True, exist_ok=True)
    if sheet and not (folder / sheet).exists():
        (folder / sheet).write_text(EXAMPLE, encoding="utf-8")
    (arguments.directory / "README.md").write_text(text, encoding="utf-8")
    text = _campaign(procedure_name, sensor_name, data_sheets, ranges)
    (arguments.directory / "campaign.yaml").write_text(text, encoding="utf-8")
    row = f"{arguments.unit},,,,{sensor_name},{table_name},{procedure_name},"
    units_table.write_text(f"{HEADER}\n{row}\n", encoding="utf-8")
    print(f"{units_table}: one row for each unit; put the recordings into {folder}")
    print(f"{arguments.directory / 'README.md'}: how to mount and record this bench, and what the recordings determine")
    print(_accuracy(table_name, table))
    print(f"then: {run_command({'campaign': str(arguments.directory)})}")
    return 0


def _accuracy(name: str, table: Table) -> str:
    """Return the assumed accuracy of the table, and how to state another, in words."""
    if table.motion == "none":
        return f"table {name}: there is no table; the unit is placed by hand"
    others = ", ".join(option for option in _options("table") if option != name)
    angle, rate = f"{table.angle_accuracy_deg:g} deg", f"{100 * table.rate_accuracy:g} %"
    return (
        f"table {name}: accuracy of its angles {angle}, of its rates {rate} (standard uncertainties); "
        f"for another table, write {others} or the name of your own file in configs/table/ into the column table"
    )


def _chosen(group: str, given: str | None, default: str) -> str:
    """Return the option of a group: the given one, the user's answer on a terminal, or the default."""
    if given is not None or not sys.stdin.isatty():
        return given or default
    files = sorted((CONFIGS / group).glob("*.yaml"))
    print(f"{group}:")
    for file in files:
        print(f"  {file.stem:<18}{file.read_text(encoding='utf-8').splitlines()[0].removeprefix('# ')}")
    return input(f"{group} [{default}]: ").strip() or default


def _chosen_ranges(data_sheets: Mapping[str, DataSheet], given: list[float] | None) -> list[float]:
    """Return the range of each sensor: the given one, the user's answer on a terminal, or that of the sensor file."""
    defaults = _ranges_of(data_sheets)
    if given is None and sys.stdin.isatty():
        shown = " ".join(f"{value:g}" for value in defaults)
        try:
            given = [float(word) for word in input(f"ranges, g and deg/s [{shown}]: ").split()]
        except ValueError:
            raise ConfigurationError(f"ranges: expected two numbers such as {shown}") from None
    return [*(given or []), *defaults[len(given or []) :]]


def _ranges_of(data_sheets: Mapping[str, DataSheet]) -> list[float]:
    return [data_sheet.full_scale for data_sheet in data_sheets.values()]


def _campaign(procedure: str, name: str, data_sheets: Mapping[str, DataSheet], wanted: list[float]) -> str:
    """Return ``campaign.yaml``; settings of ranges that equal those of the sensor file are comments."""
    defaults = _ranges_of(data_sheets)
    changed = [None if value == full_scale else value for value, full_scale in zip(wanted, defaults, strict=False)]
    larger = [
        min((r for r in data_sheet.ranges or [2.0 * full_scale] if r > full_scale), default=full_scale)
        for data_sheet, full_scale in zip(data_sheets.values(), defaults, strict=True)
    ]
    text: str = template("campaign.yaml").render(
        procedure=procedure,
        sensor=name,
        held=[(s, data_sheet.full_scale, SENSOR_UNITS[s]) for s, data_sheet in data_sheets.items()],
        settings=settings_of_ranges(data_sheets, [*changed, *wanted[len(changed) :]]),
        example=settings_of_ranges(data_sheets, larger),
        groups={group: _options(group) for group in GROUPS},
    )
    return text


def _options(group: str) -> list[str]:
    return sorted(file.stem for file in (CONFIGS / group).glob("*.yaml"))
