"""The changes from run to run: a section of a unit's page, and the data for the comparison on the campaign's page.

The page of a unit has the section from the second run on that changed the unit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.core.records import SENSOR_UNITS, SENSORS
from pipeline.output.history import difference, dropped, errors_of, of_units
from pipeline.output.outcome import add_command, uncertainty_words
from pipeline.output.pages.chart import Figure
from pipeline.output.pages.group_charts import Point, bars
from pipeline.output.pages.pages import number, plain, template

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.core.files import JSON
    from pipeline.core.verdicts import Error

MARK, LINK_MARK = "<!-- history -->", "<!-- history link -->"  # in templates/unit.html
SHOWN = 12  # runs in a chart: the first, and the last ones
LABEL_LETTERS = 50  # letters of a bar's text before the ratio; a bar is 66 letters long
STATES = 10_000  # of units in runs after the first that a campaign's page contains: 2 MB at 0.2 kB each
UNCHANGED_ERROR = 0.02  # relative change of an error that is not significant
NEAR_FLOOR = 1.5  # error over noise floor below which a bar is green


def with_history(page: str, states: Sequence[tuple[int, JSON]], times: Mapping[int, str]) -> str:
    """Return a unit's page with the section on its runs.

    ``states``: number of each run that changed the unit, and the unit's state after it; ``times``: when each run was.
    """
    entries: list[JSON] = []
    before: JSON = {}
    for run, state in states:
        change = difference(before, state) if before else None
        words = change.words() if change else []
        for sensor in SENSORS:
            change_of_u = uncertainty_words(before.get(sensor) or {}, state.get(sensor) or {}, SENSOR_UNITS[sensor])
            words += [f"{sensor}: {change_of_u.replace('->', '→')}"] if change_of_u else []
        entries.append({"run": run, "time": times[run], "state": state, "change": change, "words": words})
        before = state
    figures = [figure for sensor in SENSORS if (figure := _chart(sensor, entries))]
    last = entries[-1]["change"]
    lost = [plain(name) for sensor in SENSORS for name in last.removed[sensor]] if last else []
    section = template("history.html").render(entries=entries, figures=figures, lost=lost, before=states[-2][0])
    return page.replace(MARK, section, 1).replace(LINK_MARK, '<li><a href="#history">Runs</a></li>', 1)


def _chart(sensor: str, entries: Sequence[JSON]) -> Figure | None:
    """Draw the held-out error of a sensor by run, with its noise floor; None where it never changed."""
    errors = errors_of([entry["state"] for entry in entries], sensor)
    known = [(e, error, error.after) for e, error in zip(entries, errors, strict=True) if error.after]
    if len({after for *_, after in known}) < 2:
        return None
    shown = known if len(known) <= SHOWN else [known[0], *known[1 - SHOWN :]]
    unit, rows = SENSOR_UNITS[sensor], [_row(entry, error, sensor) for entry, error, _ in shown]
    (*_, first), (_, error, last) = known[-2:]
    floor = error.floor
    if abs(last - first) <= UNCHANGED_ERROR * first:
        change = f"stays at {number(last)}"
    else:
        change = f"{'falls' if last < first else 'rises'} from {number(first)} to {number(last)}"
    ratio = f", {number(last / floor)} × the noise floor" if floor else ""
    finding = f"{sensor.capitalize()}: in the last run the error of the {error.kind} {change} {unit}{ratio}"
    caption = "Error on held-out motion after each run that changed the unit, and the effects that it added or removed."
    figure = Figure(f"history-{sensor}", finding, caption)
    return bars(figure, rows, f"rms error, {unit} (logarithmic)", levels={f"noise floor {number(floor)}": floor or 0.0})


def _row(entry: JSON, error: Error, sensor: str) -> Point:
    change, ratio = entry["change"], error.ratio
    words = change.words(sensor) or ["effects of the other sensor"] if change else entry["state"][sensor]["effects"]
    label = f"run {entry['run']}" + (f"{':' if change else ' with'} {plain(', '.join(words))}" if words else "")
    label = label if len(label) <= LABEL_LETTERS else f"{label[: LABEL_LETTERS - 1]}…"
    label += f", {number(ratio)} × floor" if ratio else ""
    return Point(label, error.after, 1 if ratio and ratio < NEAR_FLOOR else 3)


def times_of(entries: Sequence[JSON]) -> dict[int, str]:
    """Return when each run was, to the minute (UTC)."""
    return {entry["run"]: str(entry["time"])[:16].replace("T", " ") for entry in entries}


def runs_data(entries: Sequence[JSON], settings: JSON) -> JSON | None:
    """Return the data with which the campaign's page compares any two runs; None if there is one run.

    Of many runs, the first and the last ones can be compared, as many as ``STATES`` allows.
    """
    if len(entries) < 2:
        return None
    last, count = [entries[-1]], len(entries[-1]["units"])
    for entry in reversed(entries[1:-1]):
        count += len(entry["units"])
        if count > STATES:
            break
        last.append(entry)
    compared, times = [entries[0], *reversed(last)], times_of(entries)
    units = []
    for unit, states in of_units(entries).items():
        after = [next((s for s in reversed(states) if s[0] <= e["run"]), None) for e in compared]
        shown = dict(filter(None, after))
        if len(shown) > 1:
            errors = {s: errors_of([*shown.values()], s) for s in SENSORS}
            of_runs = [{s: errors[s][i] for s in SENSORS} for i in range(len(shown))]
            short = [[run, _short(state, of)] for (run, state), of in zip(shown.items(), of_runs, strict=True)]
            units.append([unit, short])
    runs = [[e["run"], f"run {e['run']}, {times[e['run']]}: {_count(e)}"] for e in compared]
    gone = [
        {"unit": unit, "run": run, "effects": effects, "add": add_command(settings, unit, effects)}
        for (unit, run), effects in dropped(entries).items()
    ]
    return {"runs": runs, "units": units, "dropped": gone, "number": entries[-1]["run"]}


def _count(entry: JSON) -> str:
    count = len(entry["units"]) + len(entry.get("gone") or [])
    return f"{count} unit{'s' if count != 1 else ''} changed" if entry["run"] > 1 else f"{count} units"


def _short(state: JSON, errors: Mapping[str, Error]) -> JSON:
    if not state:
        return {"status": "not in units.csv"}
    parts = {s: state[s] for s in SENSORS if state.get(s)}
    shown = {s: [errors[s].after, errors[s].floor, part["verdict"], part["effects"]] for s, part in parts.items()}
    return {"status": state["status"], "overrides": state["overrides"], **shown}
