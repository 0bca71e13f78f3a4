"""What the campaign's page compares: ``compare`` of ``campaign.yaml``, resolved to named groups of units.

Each entry of the list is one comparison::

    - title: Stages against least squares
      where: {sensor: [mpu6050, stim300]}    # units that count; all where it is left out
      groups:                                # by name: units, or what columns say
        stages: {method: staged}
        least squares: {method: reference_least_squares}
      pairs: serial                          # units that agree in it are one device: differences are taken within it
      against: stages                        # what the others are compared with; the first where it is left out
    - title: Rates
      by: [method, rate_dps]                 # a group for each value of a column, or of several
      sensors: accelerometer                 # only this one; both where it is left out
      x: table_time                          # the error is drawn against it: a column of numbers, or table_time
    - [U1, U2]                               # or {title, units}: unit against unit

Columns are those of ``units.csv``, and the groups of the configuration that each unit ends up with (sensor, table,
procedure, method, filter, ingest). With several columns in ``by``, the last runs along a curve, the others tell curves.
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
        ``title``; ``groups``, each ``name, series, label, units``; ``sensors``; ``against``; ``pairs`` (unit to what
        it shares with its pair, or None) and ``x`` (``label``; ``values`` by unit, None for the table time; ``named``:
        the points' names are drawn beside them), or None.
    """
    columns = _Columns({n: unit.row | {g: unit.config[g]["name"] for g in GROUPS} for n, unit in units.items()})
    out, problems = [], []
    for number, entry in enumerate(entries, 1):
        try:
            out.append(_comparison(entry, number, columns))
        except Problem as problem:
            title = entry.get("title") if isinstance(entry, dict) else None
            problems.append(f"compare, {f'{title!r}' if title else f'entry {number}'}: {problem}")
    if problems:
        raise ConfigurationError("\n  ".join(problems), file)
    return out


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
            return [u for u in among if all(self.cell(u, c) in those for c, those in values.items())]
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
    """Return the groups of an entry: at least two, none empty, each unit in one of them."""
    given = [k for k in ("units", "groups", "by") if k in entry]
    if len(given) != 1:
        raise Problem(f"{FORM} is expected, got {' and '.join(given) or 'none of them'}")
    among, content = columns.select(entry.get("where") or {}, list(columns.of_unit)), entry[given[0]]
    if given[0] == "by":
        groups = _by(_names(content), str(entry.get("x", "")), among, columns)
    else:
        if given[0] == "units":
            content = {unit: [unit] for unit in columns.select(content, among)}
        if not isinstance(content, dict):
            raise Problem(f"groups: a mapping of names to units or columns is expected, got {content!r}")
        found = {str(name): columns.select(wanted, among) for name, wanted in content.items()}
        groups = [{"name": name, "series": "", "label": name, "units": units} for name, units in found.items()]
    seen: dict[str, str] = {}
    for group in groups:
        if not group["units"]:
            raise Problem(f"group {group['name']!r} is empty: no unit is as it asks for")
        for unit in group["units"]:
            if unit in seen:
                raise Problem(f"unit {unit} is in {seen[unit]!r} and in {group['name']!r}; it can be in one")
            seen[unit] = group["name"]
    if len(groups) < 2:
        raise Problem(f"two groups or more are expected, got {len(groups)}")
    return groups


def _by(names: list[str], x: str, among: list[str], columns: _Columns) -> list[JSON]:
    """Return a group for each combination of values, in the order of the units table."""
    along = names.index(x) if x in names else len(names) - 1
    found: dict[tuple[str, ...], list[str]] = {}
    for unit in among:
        values = tuple(columns.cell(unit, name) for name in names)
        if all(values):
            found.setdefault(values, []).append(unit)
    return [
        {"name": ", ".join(v), "series": ", ".join(v[:along] + v[along + 1 :]), "label": v[along], "units": units}
        for v, units in found.items()
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
    """Return one value or a list of them as texts, as the units table holds them."""
    values = value if isinstance(value, list) else [value]
    return [str(v) for v in values]
