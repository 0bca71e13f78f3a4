"""What changed from run to run: a section of a unit's page, and the data with which a campaign's page compares runs.

A page of a unit that only one run has changed has no such section, so that the page of a first run depends on its
recordings and settings alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.history import Change, difference, dropped, of_units
from pipeline.outcome import add_command
from pipeline.records import SENSORS
from pipeline.report.bars import Bar, bars
from pipeline.report.figure import JSON, UNITS, Figure, plain
from pipeline.report.numbers import number
from pipeline.report.templating import template

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

MARK, LINK_MARK = "<!-- history -->", "<!-- history link -->"  # in templates/unit.html
SHOWN = 12  # runs that a chart shows: the first, and the last ones
LABEL = 50  # letters of a bar's text before the ratio; a bar is 66 letters long
STATES = 10_000  # of units in runs after the first that a campaign's page holds, 0.2 kB each
SAME = 0.02  # relative change of an error, below which it stays


def with_history(page: str, states: Sequence[tuple[int, JSON]], times: Mapping[int, str]) -> str:
    """Return a unit's page with the section on its runs.

    Parameters
    ----------
    page : str
        As of ``unit_page.render``.
    states : sequence of (int, dict)
        Number of each run that changed the unit, and the unit's state after it.
    times : mapping of int to str
        When each run was.
    """
    entries: list[JSON] = []
    before: JSON = {}
    for run, state in states:
        change = difference(before, state) if before else None
        entries.append(
            {
                "run": run,
                "time": times[run],
                "state": state,
                "change": change,
                "words": change.words() if change else [],
            }
        )
        before = state
    figures = [figure for sensor in SENSORS if (figure := _chart(sensor, entries))]
    last = entries[-1]["change"]
    lost = [plain(name) for sensor in SENSORS for name in last.removed[sensor]] if last else []
    section = template("history.html").render(entries=entries, figures=figures, lost=lost, before=states[-2][0])
    link = '<li><a href="#history">Runs</a></li>'
    return page.replace(MARK, section, 1).replace(LINK_MARK, link, 1)


def runs_data(entries: Sequence[JSON], settings: JSON) -> JSON | None:
    """Return what the campaign's page needs to compare any two runs; None while there is one run.

    Parameters
    ----------
    entries : sequence of dict
        As of ``history.read_history``.
    settings : dict
        Of the run.
    """
    if len(entries) < 2:
        return None
    kept = _kept(entries)
    numbers = [e["run"] for e in kept]
    units = [
        [unit, [[run, _short(state)] for run, state in shown]]
        for unit, states in of_units(entries).items()
        if len(shown := _at(states, numbers)) > 1
    ]
    runs = [[e["run"], f"run {e['run']}, {_time(e)}: {_count(e)}"] for e in kept]
    lost: dict[tuple[str, int], list[str]] = {}
    for unit, sensor, effect, run in dropped(entries):
        lost.setdefault((unit, run), []).append(f"{sensor}.{effect}")
    told = [
        {"unit": unit, "run": run, "effects": effects, "add": add_command(settings, unit, effects)}
        for (unit, run), effects in lost.items()
    ]
    return {"runs": runs, "units": units, "dropped": told, "number": entries[-1]["run"]}


def _kept(entries: Sequence[JSON]) -> list[JSON]:
    """Return the runs that can be compared: the first, and the last ones, as many as ``STATES`` allows."""
    kept, count = [entries[-1]], len(entries[-1]["units"])
    for entry in reversed(entries[1:-1]):
        count += len(entry["units"])
        if count > STATES:
            break
        kept.append(entry)
    return [entries[0], *reversed(kept)]


def _at(states: Sequence[tuple[int, JSON]], runs: Sequence[int]) -> list[tuple[int, JSON]]:
    """Return the states that hold after some runs, each once."""
    found = [next((s for s in reversed(states) if s[0] <= run), None) for run in runs]
    return list({s[0]: s for s in found if s}.values())


def _time(entry: JSON) -> str:
    return str(entry["time"])[:16].replace("T", " ")


def _count(entry: JSON) -> str:
    count = len(entry["units"]) + len(entry.get("gone") or [])
    return f"{count} unit{'s' if count != 1 else ''} changed" if entry["run"] > 1 else f"{count} units"


def _short(state: JSON) -> JSON:
    """Return what a comparison tells of a state."""
    if not state:
        return {"status": "not in units.csv"}
    short: JSON = {"status": state["status"], "overrides": state["overrides"]}
    for sensor in SENSORS:
        part = state.get(sensor)
        if part:
            short[sensor] = [part["error"], part["floor"], part["verdict"], part["effects"]]
    return short


def _chart(sensor: str, entries: Sequence[JSON]) -> Figure | None:
    """Draw the held-out error of a sensor run by run beside its noise floor; None where it never changed."""
    known: list[tuple[JSON, JSON]] = [(e, part) for e in entries if (part := e["state"].get(sensor)) and part["error"]]
    if len({part["error"] for _, part in known}) < 2:
        return None
    shown = known if len(known) <= SHOWN else [known[0], *known[1 - SHOWN :]]
    unit = UNITS[sensor]
    rows = [_bar(entry, part, sensor) for entry, part in shown]
    (_, first), (_, last) = known[-2:]
    way = "stays at" if abs(last["error"] - first["error"]) <= SAME * first["error"] else "changes"
    if way != "stays at":
        way = "falls" if last["error"] < first["error"] else "rises"
    ends = f"{number(first['error'])} to {number(last['error'])}" if way != "stays at" else number(last["error"])
    ratio = f", {number(last['error'] / last['floor'])} × the noise floor" if last["floor"] else ""
    verb = f"{way} from" if way != "stays at" else way
    finding = f"{sensor.capitalize()}: in the last run the held-out error {verb} {ends} {unit}{ratio}"
    description = "; ".join(f"{row.label}: {number(row.value)} {unit}" for row in rows)
    levels = {"noise floor": last["floor"]} if last["floor"] else {}
    svg = bars(f"history-{sensor}", finding, description, rows, f"rms error, {unit} (logarithmic)", levels=levels)
    return Figure(
        svg, "Error on held-out motion after each run that changed the unit, and what it added or removed.", (), finding
    )


def _bar(entry: JSON, part: JSON, sensor: str) -> Bar:
    change: Change | None = entry["change"]
    words = change.words(sensor) if change else [f"+ {name}" for name in part["effects"]]
    told = ", ".join(words).replace("_", " ")
    label = f"run {entry['run']}" + (f": {told}" if told else "")
    label = label if len(label) <= LABEL else f"{label[: LABEL - 1]}…"
    label += f", {number(part['error'] / part['floor'])} × floor" if part["floor"] else ""
    at_floor = bool(part["floor"]) and part["error"] < 1.5 * part["floor"]  # FAR of unit_page
    return Bar(label, part["error"], 1 if at_floor else 3)


def times_of(entries: Sequence[JSON]) -> dict[int, str]:
    """Return when each run was, to the minute (UTC)."""
    return {entry["run"]: _time(entry) for entry in entries}
