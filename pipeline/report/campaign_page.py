"""The page of a campaign: failures first, then the fleet in figures, methods side by side, and every unit.

Units with the same serial are the same device calibrated in several ways (or several times): they are put side by side.
"""

from __future__ import annotations

import json
from collections import Counter
from statistics import median
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

from pipeline.outcome import findings_of, next_commands, verdict_groups
from pipeline.records import SENSORS
from pipeline.report.fleet_figures import FAR, fleet_figures, fleet_values
from pipeline.report.numbers import number
from pipeline.report.summary import COLUMNS
from pipeline.report.templating import template

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

JSON = dict[str, Any]
FIRST = 100  # rows that a browser shows at once; it shows the others when asked
FEWEST_UNITS, FAR_SHOWN = 3, 30  # units, below which a distribution says nothing; units far from their siblings
UNITS = {"accelerometer": "g", "gyroscope": "deg/s"}
VERDICTS = {
    "nothing_missing": ("nothing missing", "good"),
    "missing_effect": ("missing effect", "warn"),
    "unexplained": ("unexplained", "warn"),
    "not_enough_data": ("not enough data", ""),
    "left_by_method": ("left by method", "warn"),
    "reference_in_doubt": ("reference in doubt", "warn"),
    "floor_in_doubt": ("floor in doubt", "warn"),
}


def render(
    campaign: str,
    rows: list[JSON],
    failures: list[JSON],
    comparisons: Sequence[JSON] = (),
    page: str | None = None,
    *,
    twins: Sequence[Sequence[str]] = (),
    statistics: JSON | None = None,
    history: JSON | None = None,
    settings: JSON | None = None,
) -> str:
    """Return ``index.html``.

    Parameters
    ----------
    campaign : str
    rows : list of dict
        One a unit, as of ``summary.summary_row``.
    failures : list of dict
        ``unit``, ``stage``, ``code``, ``message``, ``file`` of each failed unit.
    comparisons : sequence, optional
        As of ``comparison_page.section``.
    page : str, optional
        Name of a page of its own that the campaign has beside this one.
    twins : sequence of sequence of str, optional
        Files of several units that are the same, byte for byte, under different names.
    statistics : dict, optional
        As of ``fleet_statistics.fleet_statistics``.
    history : dict, optional
        As of ``history_section.runs_data``.
    settings : dict, optional
        Of the run, for the commands to continue with.

    Returns
    -------
    str
    """
    shown = [_cells(row) for row in rows]
    findings = findings_of(rows)
    by_unit = {row["unit"]: cells for row, cells in zip(rows, shown, strict=True)}
    text: str = template("campaign.html").render(
        campaign=campaign,
        rows=shown,
        failures=failures,
        twins=twins,
        implausible=_implausible(rows),
        ok=sum(row["status"] == "ok" for row in rows),
        passed=sum(row.get("pass") is True for row in rows),
        not_passed=sum(row.get("pass") is False for row in rows),
        judged=any(row.get("pass") is not None for row in rows if row["status"] == "ok"),
        fleet=[f for s in SENSORS if (f := _fleet(s, "all units", rows))],
        lots=_lots(rows),
        groups=[
            {"title": title, "rows": [by_unit[u] for u in units if u in by_unit]} for title, units in _same_serial(rows)
        ],
        figures=fleet_figures(rows),
        statistics=statistics if statistics and len(rows) >= FEWEST_UNITS else None,
        far_shown=FAR_SHOWN,
        causes=_causes(failures),
        found=verdict_groups(findings),
        commands=next_commands(findings, settings or {"campaign": campaign}),
        history=history,
        history_data=_script_data({"units": history["units"]}) if history else None,
        names=_script_data([row["unit"] for row in rows]),
        values=_script_data(fleet_values(rows)),
        first=FIRST,
        sections=comparisons,
        verdicts=VERDICTS,
        kept=sorted({key for row in rows for key in row} - set(COLUMNS)),
        beside=page,
    )
    return text


def _causes(failures: list[JSON]) -> list[tuple[str, list[str]]]:
    """Return the units that failed by their kind of failure and stage, the most frequent first."""
    causes: dict[str, list[str]] = {}
    for failure in failures:
        cause = f"{failure.get('code')} in stage {failure.get('stage') or 'unknown'}"
        causes.setdefault(cause, []).append(str(failure.get("unit")))
    return sorted(causes.items(), key=lambda c: -len(c[1]))


def _implausible(rows: list[JSON]) -> list[tuple[str, str, str]]:
    """Return unit, sensor and parameters of sensors with parameters far beyond the data sheet."""
    found = ((r["unit"], s, str(r.get(f"{s}_implausible") or "")) for r in rows for s in SENSORS)
    return [(unit, sensor, names.replace(";", ", ")) for unit, sensor, names in found if names]


def _script_data(value: object) -> Markup:
    """Return a value as JSON that may stand within a script element."""
    return Markup(json.dumps(value, ensure_ascii=False).replace("<", "\\u003c"))  # noqa: S704  (no tag can begin)


def _cells(row: JSON) -> JSON:
    """Return a row with its figures as text, so that the template only places them."""
    cells: JSON = {k: row.get(k) or "" for k in ("unit", "serial", "lot", "date", "status", "sensor", "method")}
    cells["pass"] = row.get("pass")
    cells["sensors"] = []
    for sensor in SENSORS:
        after, floor = row.get(f"{sensor}_error_after"), row.get(f"{sensor}_noise_floor")
        ratio = after / floor if after is not None and floor else None
        cells["sensors"].append(
            (
                _figure(row.get(f"{sensor}_error_before")),
                _figure(after),
                _figure(floor),
                _figure(ratio),
                "n" if ratio is None or ratio <= FAR else "n warn-text",
                row.get(f"{sensor}_verdict") or "",
                (row.get(f"{sensor}_selected") or "").replace("_", " ").replace(";", ", "),
            )
        )
    return cells


def _figure(value: float | None) -> str:
    return "" if value is None else number(value)


def _fleet(sensor: str, name: str, rows: list[JSON]) -> JSON | None:
    """Return medians over units of what was reached."""
    known = [r for r in rows if r.get(f"{sensor}_error_after") is not None]
    if not known:
        return None

    def middle(column: str) -> float | None:
        values = [v for r in known if (v := r.get(f"{sensor}_{column}")) is not None]
        return median(values) if values else None

    verdicts = [r.get(f"{sensor}_verdict") for r in known]
    return {
        "sensor": sensor,
        "name": name,
        "unit": UNITS[sensor],
        "count": len(known),
        "before": number(middle("error_before")),
        "after": number(middle("error_after")),
        "floor": number(middle("noise_floor")),
        "verdicts": {VERDICTS[v][0]: verdicts.count(v) for v in VERDICTS if v in verdicts},
        "missing": _missing(sensor, known),
    }


def _missing(sensor: str, rows: list[JSON]) -> list[tuple[str, int]]:
    """Return in how many units each effect is missing, the most frequent first."""
    counts = Counter(name for r in rows for name in str(r.get(f"{sensor}_selected") or "").split(";") if name)
    return [(name.replace("_", " "), count) for name, count in sorted(counts.items(), key=lambda c: (-c[1], c[0]))]


def _lots(rows: list[JSON]) -> list[JSON]:
    lots = list(dict.fromkeys(r["lot"] for r in rows if r.get("lot")))
    if not 1 < len(lots) <= 60:
        return []
    return [
        f for s in SENSORS for lot in lots if (f := _fleet(s, f"lot {lot}", [r for r in rows if r.get("lot") == lot]))
    ]


def _same_serial(rows: list[JSON]) -> Iterable[tuple[str, list[str]]]:
    groups: dict[str, list[str]] = {}
    for row in rows:
        if row.get("serial"):
            groups.setdefault(row["serial"], []).append(row["unit"])
    return [(f"Serial {serial}", units) for serial, units in groups.items() if len(units) > 1]
