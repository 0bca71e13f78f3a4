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

from pipeline.config.options import GROUPS, nearest
from pipeline.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.config.campaign import UnitRow

JSON = dict[str, Any]
KEYS = ("title", "units", "groups", "by", "where", "pairs", "against", "x", "sensors")
SENSORS = ("accelerometer", "gyroscope")
TABLE_TIME = "table_time"
FORM = "a list of units, or a mapping with units, groups or by"


def resolve_comparisons(entries: Sequence[Any], units: Mapping[str, UnitRow], file: str) -> list[JSON]:
    """Return the comparisons with their units.

    Raises ``ConfigurationError`` with one message for everything that is wrong.

    Parameters
    ----------
    entries : sequence
        As ``campaign.yaml`` holds them.
    units : mapping of str to UnitRow
        Of the campaign, with their resolved configurations.
    file : str
        Named in messages.

    Returns
    -------
    list of dict
        ``title``; ``groups``, each ``name, series, label, units``; ``sensors``; ``against``; ``pairs`` (unit to what
        it shares with its pair, or None) and ``x`` (``label``; ``values`` by unit, None for the table time; ``named``:
        the points' names are drawn beside them), or None.
    """
    columns = {name: unit.row | {g: unit.config[g]["name"] for g in GROUPS} for name, unit in units.items()}
    out, problems = [], []
    for number, entry in enumerate(entries, 1):
        try:
            out.append(_Resolver(columns).comparison(entry, number))
        except _Problem as problem:
            title = entry.get("title") if isinstance(entry, dict) else None
            problems.append(f"compare, {f'{title!r}' if title else f'entry {number}'}: {problem}")
    if problems:
        raise ConfigurationError("\n  ".join(problems), file)
    return out


class _Problem(Exception):  # noqa: N818  (one of many: they are collected)
    """One thing that is wrong."""


class _Resolver:
    """Finds the units that an entry names.

    Parameters
    ----------
    columns : mapping of str to dict
        Unit to its columns.
    """

    def __init__(self, columns: Mapping[str, Mapping[str, str]]) -> None:
        self.columns = columns
        self.known = sorted({column for row in columns.values() for column in row})

    def comparison(self, entry: Any, number: int) -> JSON:  # noqa: ANN401  (the user's)
        """Return one comparison."""
        entry = {"units": entry} if isinstance(entry, list) else entry
        if not isinstance(entry, dict):
            raise _Problem(f"{FORM} is expected, got {entry!r}")
        unknown = [str(k) for k in entry if k not in KEYS]
        if unknown:
            raise _Problem(f"{unknown[0]}: unknown key{nearest(unknown[0], KEYS)}")
        groups = self._groups(entry)
        self._check(groups)
        members = [u for g in groups for u in g["units"]]
        names = [g["name"] for g in groups]
        against = str(entry.get("against", names[0]))
        if against not in names:
            raise _Problem(f"against: no group is called {against!r}{nearest(against, names)}")
        pairs = entry.get("pairs")
        sensors = _names(entry.get("sensors", list(SENSORS)))
        if not set(sensors) <= set(SENSORS):
            raise _Problem(f"sensors: {' and '.join(SENSORS)} are known, got {', '.join(sensors)}")
        return {
            "title": str(entry.get("title") or f"Comparison {number}"),
            "groups": groups,
            "sensors": sensors,
            "against": against,
            "pairs": {u: ", ".join(self._cell(u, c) for c in _names(pairs)) for u in members} if pairs else None,
            "x": self._x(str(entry["x"]), members, _names(entry.get("by", []))) if "x" in entry else None,
        }

    def _groups(self, entry: JSON) -> list[JSON]:
        given = [k for k in ("units", "groups", "by") if k in entry]
        if len(given) != 1:
            raise _Problem(f"{FORM} is expected, got {' and '.join(given) or 'none of them'}")
        among = self._select(entry.get("where") or {}, list(self.columns))
        if given[0] == "by":
            return self._by(_names(entry["by"]), str(entry.get("x", "")), among)
        content = entry[given[0]]
        if given[0] == "units":
            return [_group(unit, "", [unit]) for unit in self._units(content)]
        if not isinstance(content, dict):
            raise _Problem(f"groups: a mapping of names to units or columns is expected, got {content!r}")
        return [
            _group(str(n), "", self._select(g, among) if isinstance(g, dict) else self._units(g))
            for n, g in content.items()
        ]

    def _by(self, columns: list[str], x: str, among: list[str]) -> list[JSON]:
        """Return a group for each combination of values, in the order of the sheet."""
        along = x if x in columns else columns[-1]
        found: dict[tuple[str, ...], list[str]] = {}
        for unit in among:
            values = tuple(self._cell(unit, c) for c in columns)
            if all(values):
                found.setdefault(values, []).append(unit)
        groups = []
        for values, members in found.items():
            told = dict(zip(columns, values, strict=True))
            series = ", ".join(v for c, v in told.items() if c != along)
            groups.append(_group(", ".join(values), series, members) | {"label": told[along]})
        return groups

    def _units(self, names: Any) -> list[str]:  # noqa: ANN401  (the user's)
        if not isinstance(names, list):
            raise _Problem(f"a list of units is expected, got {names!r}")
        for name in map(str, names):
            if name not in self.columns:
                raise _Problem(f"no unit {name!r} in units.csv{nearest(name, self.columns)}")
        return [str(n) for n in names]

    def _select(self, where: Any, among: list[str]) -> list[str]:  # noqa: ANN401  (the user's)
        """Return the units whose columns say what is asked for."""
        if not isinstance(where, dict):
            raise _Problem(f"columns and their values are expected, for example {{method: staged}}, got {where!r}")
        wanted = {str(c): _names(v) for c, v in where.items()}
        return [u for u in among if all(self._cell(u, c) in values for c, values in wanted.items())]

    def _cell(self, unit: str, column: str) -> str:
        if column not in self.known:
            raise _Problem(f"units have no column {column!r}{nearest(column, self.known)}")
        return str(self.columns[unit].get(column, ""))

    def _check(self, groups: list[JSON]) -> None:
        for group in groups:
            if not group["units"]:
                raise _Problem(f"group {group['name']!r} is empty: no unit is as it asks for")
        if len(groups) < 2:
            raise _Problem(f"two groups or more are expected, got {len(groups)}")
        seen: dict[str, str] = {}
        for group in groups:
            for unit in group["units"]:
                if unit in seen:
                    raise _Problem(f"unit {unit} is in {seen[unit]!r} and in {group['name']!r}; it can be in one")
                seen[unit] = group["name"]

    def _x(self, column: str, members: list[str], by: list[str]) -> JSON:
        if column == TABLE_TIME:
            return {"label": "table time, s", "values": None, "named": True}
        values = {}
        for unit in members:
            text = self._cell(unit, column)
            try:
                values[unit] = float(text)
            except ValueError:
                values[unit] = math.nan
            if not math.isfinite(values[unit]):
                raise _Problem(f"x: unit {unit} has {text!r} in column {column!r}, which is no number")
        return {"label": column, "values": values, "named": column not in by}


def _group(name: str, series: str, units: list[str]) -> JSON:
    return {"name": name, "series": series, "label": name, "units": units}


def _names(value: Any) -> list[str]:  # noqa: ANN401  (the user's)
    """Return one value or a list of them as texts, as a sheet holds them."""
    values = value if isinstance(value, list) else [value]
    return [str(v) for v in values]
