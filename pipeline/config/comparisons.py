"""Resolve the comparisons of the campaign's page (``compare`` in ``campaign.yaml``) to named groups of units.

Each entry of the list is one comparison::

    - title: Stages against least squares
      where: {sensor: [mpu6050, stim300]}    # units of the comparison; default: all
      groups:                                # by name: a list of units, or columns and their values
        stages: {method: staged}
        least squares: {method: reference_least_squares}
      pairs: serial                          # units with equal values are one device; differences are within a device
      against: stages                        # the group that the others are compared with; default: the first
    - title: Rates
      by: [method, rate_dps]                 # a group for each value of a column, or combination of values
      sensors: accelerometer                 # default: both
      x: table_time                          # abscissa of the chart of errors: a column of numbers, or table_time
    - [U1, U2]                               # or {title, units}: a group for each unit

Columns are those of ``units.csv``, and the groups of the resolved configuration of each unit (sensor, table, procedure,
method, filter, ingest). With several columns in ``by``, the last one varies along a curve; each combination of the
others is a curve.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from pipeline.config.options import GROUPS, Problem, nearest
from pipeline.errors import ConfigurationError
from pipeline.history import SENSORS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.config.campaign import UnitRow

JSON = dict[str, Any]
KEYS = ("title", "units", "groups", "by", "where", "pairs", "against", "x", "sensors")
TABLE_TIME = "table_time"
FORM = "a list of units, or a mapping with units, groups or by"


def resolve_comparisons(entries: Sequence[Any], units: Mapping[str, UnitRow], file: str) -> list[JSON]:
    """Return the comparisons of ``campaign.yaml`` (``file``) with their units; raises one ``ConfigurationError``.

    Returns
    -------
    list of dict
        ``title``; ``groups``, each ``name, series, label, units``; ``sensors``; ``against``; ``pairs`` (unit to the
        value that identifies its device) or None; ``x`` (``label``; ``values`` by unit, None for the table time;
        ``named``: whether points are labelled with their names) or None.
    """
    columns = _Columns({n: unit.row | {g: unit.config[g]["name"] for g in GROUPS} for n, unit in units.items()})
    comparisons, problems = [], []
    for number, entry in enumerate(entries, 1):
        try:
            comparisons.append(_comparison(entry, number, columns))
        except Problem as problem:
            title = entry.get("title") if isinstance(entry, dict) else None
            problems.append(f"compare, {f'{title!r}' if title else f'entry {number}'}: {problem}")
    if problems:
        raise ConfigurationError("\n  ".join(problems), file)
    return comparisons


class _Columns:
    """The columns of each unit."""

    def __init__(self, of_unit: Mapping[str, Mapping[str, str]]) -> None:
        self.of_unit = of_unit
        self.known = sorted({column for row in of_unit.values() for column in row})

    def cell(self, unit: str, column: str) -> str:
        if column not in self.known:
            raise Problem(f"units have no column {column!r}{nearest(column, self.known)}")
        return str(self.of_unit[unit].get(column, ""))

    def select(self, wanted: Any, among: Sequence[str]) -> list[str]:  # noqa: ANN401  (the user's)
        """Return the units of a list of names, or those whose columns have the values of a mapping."""
        if isinstance(wanted, dict):
            values = {str(c): _names(v) for c, v in wanted.items()}
            return [u for u in among if all(self.cell(u, column) in valid for column, valid in values.items())]
        if not isinstance(wanted, list):
            form = "columns and their values, for example {method: staged}"
            raise Problem(f"a list of units is expected, or {form}, got {wanted!r}")
        for name in map(str, wanted):
            if name not in self.of_unit:
                raise Problem(f"no unit {name!r} in units.csv{nearest(name, self.of_unit)}")
        return [str(n) for n in wanted]


def _comparison(entry: Any, number: int, columns: _Columns) -> JSON:  # noqa: ANN401  (the user's)
    entry = {"units": entry} if isinstance(entry, list) else entry
    if not isinstance(entry, dict):
        raise Problem(f"{FORM} is expected, got {entry!r}")
    unknown = [str(k) for k in entry if k not in KEYS]
    if unknown:
        raise Problem(f"{unknown[0]}: unknown key{nearest(unknown[0], KEYS)}")
    groups = _groups(entry, columns)
    names, members = [g["name"] for g in groups], [u for g in groups for u in g["units"]]
    against = str(entry.get("against", names[0]))
    if against not in names:
        raise Problem(f"against: no group is called {against!r}{nearest(against, names)}")
    sensors, pairs = _names(entry.get("sensors", list(SENSORS))), entry.get("pairs")
    if not set(sensors) <= set(SENSORS):
        raise Problem(f"sensors: {' and '.join(SENSORS)} are known, got {', '.join(sensors)}")
    return {
        "title": str(entry.get("title") or f"Comparison {number}"),
        "groups": groups,
        "sensors": sensors,
        "against": against,
        "pairs": {u: ", ".join(columns.cell(u, c) for c in _names(pairs)) for u in members} if pairs else None,
        "x": _x(str(entry["x"]), members, _names(entry.get("by", [])), columns) if "x" in entry else None,
    }


def _groups(entry: JSON, columns: _Columns) -> list[JSON]:
    """Return the groups of an entry: at least two, none empty, without common units."""
    keys = [k for k in ("units", "groups", "by") if k in entry]
    if len(keys) != 1:
        raise Problem(f"{FORM} is expected, got {' and '.join(keys) or 'none of them'}")
    among, content = columns.select(entry.get("where") or {}, list(columns.of_unit)), entry[keys[0]]
    if keys[0] == "by":
        groups = _by(_names(content), str(entry.get("x", "")), among, columns)
    else:
        if keys[0] == "units":
            content = {unit: [unit] for unit in columns.select(content, among)}
        if not isinstance(content, dict):
            raise Problem(f"groups: a mapping of names to units or columns is expected, got {content!r}")
        units_of = {str(name): columns.select(wanted, among) for name, wanted in content.items()}
        groups = [{"name": name, "series": "", "label": name, "units": units} for name, units in units_of.items()]
    group_of: dict[str, str] = {}
    for group in groups:
        if not group["units"]:
            raise Problem(f"group {group['name']!r} is empty: no unit has these values")
        for unit in group["units"]:
            if unit in group_of:
                raise Problem(f"unit {unit} is in {group_of[unit]!r} and in {group['name']!r}; it can be in one")
            group_of[unit] = group["name"]
    if len(groups) < 2:
        raise Problem(f"two groups or more are expected, got {len(groups)}")
    return groups


def _by(names: list[str], x: str, among: list[str], columns: _Columns) -> list[JSON]:
    """Return a group for each combination of values, in the order of the units table."""
    along = names.index(x) if x in names else len(names) - 1
    units_with: dict[tuple[str, ...], list[str]] = {}
    for unit in among:
        values = tuple(columns.cell(unit, name) for name in names)
        if all(values):
            units_with.setdefault(values, []).append(unit)
    return [
        {"name": ", ".join(v), "series": ", ".join(v[:along] + v[along + 1 :]), "label": v[along], "units": units}
        for v, units in units_with.items()
    ]


def _x(column: str, members: list[str], by: list[str], columns: _Columns) -> JSON:
    if column == TABLE_TIME:
        return {"label": "table time, s", "values": None, "named": True}
    values = {}
    for unit in members:
        text = columns.cell(unit, column)
        try:
            values[unit] = float(text)
        except ValueError:
            values[unit] = math.nan
        if not math.isfinite(values[unit]):
            raise Problem(f"x: unit {unit} has {text!r} in column {column!r}, which is no number")
    return {"label": column, "values": values, "named": column not in by}


def _names(value: Any) -> list[str]:  # noqa: ANN401  (the user's)
    """Return a value, or a list of values, as a list of texts."""
    values = value if isinstance(value, list) else [value]
    return [str(v) for v in values]
