"""The page of a campaign: failures first, then every unit, the fleet in charts, comparisons and statistics.

Strip plots show fitted parameters as a share of the data sheet's limit, ``value / limit``, with one dot for each of
the siblings: units of one sensor model that were calibrated by one method. A row is a parameter of the measurement:
bias, error of a scale factor, or cross-axis sensitivity. Which are beyond the limit is counted by the calibrations.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from pipeline.core.files import JSON
from pipeline.core.records import SENSOR_UNITS, SENSORS, Index, Values
from pipeline.core.verdicts import FAR, KINDS, MARK_ABOVE_FLOORS, RowState, Verdict, far_by_moves, problems, state_of
from pipeline.evaluation.diagnosis.words import plain
from pipeline.output.outcome import all_well, beyond_limits_groups, command_of, counts_of, explain_command, ratio_words
from pipeline.output.pages.chart import Area, ChartLayer, Dots, Figure, LineMark, Panel, chart, worded
from pipeline.output.pages.fleet import parameter_table, wide
from pipeline.output.pages.pages import Scale, number, percent, scale_of, script_data, template, typeset, unit_text
from pipeline.output.pages.parameters import SUMMARY_COLUMNS

UnitChart = tuple[Figure, dict[str, list[str]]]  # a chart of units, and the text of each dot by its colour
FIRST_ROWS = 100  # rows in the page; the script adds the others when they come into view
NAMED_UNITS = 3  # units that the finding of a chart names
FEWEST_UNITS, FAR_SHOWN = 3, 30  # units of the smallest distribution; most units far from the others that are listed
MOST_DOTS, FARTHEST_UNITS = 2000, 50  # units above which dots show only the farthest from the noise, and their number
QUANTILE_PARTS = 100  # of the fleet, each with its quantiles: one in 3.5 px
MOST_PROBLEMS = 12  # lines of the list of what to do
MOST_GROUPS = 50  # serials of several units, and joint estimates, that are listed
MOST_LOTS = 60  # lots above which no medians lot by lot are shown
MAX_DRAWN_SHARE = 3.0  # largest share that is drawn: one unit in a wrong unit of measurement must not hide the others
# siblings below which there is no plot, and above which only the farthest are drawn
FEWEST_SIBLINGS, MAX_PLOTTED_UNITS = 3, 60
ENDS = 20  # farthest units of each parameter that are then drawn, on either side
ROW, LEFT, NAME_LETTERS, NAME_LETTER = 17, 130, 22, 7.2  # px; letters of a unit's name, px of each
NAMED_ROWS, HISTOGRAM_BINS = 40, 40  # most units with a row of their own; bins of the histogram of more units
# of a row: range over which the units are distributed in their order; half height of a bar
ROW_SPREAD, HALF_BAR = 0.6, 0.42


def render(
    campaign: str,
    rows: list[JSON],
    failures: list[JSON],
    comparisons: Sequence[JSON] = (),
    page: str | None = None,
    *,
    twins: Sequence[tuple[Sequence[str], Sequence[Sequence[str]]]] = (),
    statistics: JSON | None = None,
    parameters: pd.DataFrame | None = None,
    history: JSON | None = None,
    settings: JSON | None = None,
    published: Collection[str] | None = None,
    about: Mapping[str, Any] | None = None,
) -> str:
    """Return ``index.html``.

    ``rows``: of ``summary_row``, in the order of ``units.csv``; ``failures``: ``unit, stage, code, message, file`` of
    each; ``comparisons``: of ``comparison.section``; ``page``: name of a further page; ``twins``: of
    ``gather.same_files``; ``statistics``: of ``fleet_statistics``; ``parameters``: of ``parameter_table``; ``history``:
    of ``runs_data``; ``settings``: of the run, for the proposed commands; ``published``: units with a page, None: all;
    ``about``: ``run`` that last changed something, its ``day``, and the ``version`` of this package.
    """
    settings, states = settings or {"campaign": campaign}, [*map(state_of, rows)]
    found = problems(states)
    devices = {row.get("serial") or row["unit"] for row in rows}
    frame = pd.DataFrame(rows).reindex(columns=list(dict.fromkeys([*SUMMARY_COLUMNS, *(k for r in rows for k in r)])))
    for sensor in SENSORS:  # the error that the page states, in place of that of the magnitude
        for column, figure in (("error_before", "before"), ("error_after", "after"), ("noise_floor", "floor")):
            frame[f"{sensor}_{column}"] = [getattr(state.errors[sensor], figure) for state in states]
    judged = [row.get("pass") for row in rows]
    serials: dict[str, list[JSON]] = {}  # a loop: pandas takes as long for a group of one as for a large one
    for row in rows:
        serials.setdefault(str(row.get("serial") or ""), []).append(row)
    fleet = [unit_chart for sensor in SENSORS if (unit_chart := _fleet_figure(sensor, frame))]
    overview = [unit_chart for sensor in SENSORS if (unit_chart := overview_chart(sensor, states))]
    fitted = parameter_table({}) if parameters is None else parameters
    plots = strips(rows, fitted)
    causes: dict[str, list[str]] = {}
    for failure in failures:
        cause = f"{failure.get('code')} in stage {failure.get('stage') or 'unknown'}"
        causes.setdefault(cause, []).append(str(failure.get("unit")))
    return template("campaign.html").render(
        campaign=campaign,
        published=published,
        published_names=None if published is None else script_data(sorted(published)),
        rows=rows,
        failures=failures,
        twins=twins,
        implausible=[(r["unit"], s, names) for r in rows for s in SENSORS if (names := r.get(f"{s}_implausible"))],
        left_out=[(r["unit"], what) for r in rows if (what := r.get("left_out"))],
        incomplete=[(r["unit"], what) for r in rows if (what := r.get("incomplete"))],
        passed=judged.count(True),
        not_passed=judged.count(False),
        judged=any(row.get("pass") is not None for row in rows if row["status"] == "ok"),
        fleet=_medians("all units", frame),
        lots=_lots(frame),
        groups=[(f"Serial {n}", same) for n, same in serials.items() if n and len(same) > 1],
        most_groups=MOST_GROUPS,
        figures=[figure for figure, _ in fleet],
        statistics=statistics if statistics and len(rows) >= FEWEST_UNITS else None,
        strips=[figure for figure, _ in plots],
        far_shown=FAR_SHOWN,
        states={state.row["unit"]: state for state in states},
        far=MARK_ABOVE_FLOORS,
        judged_on=judged_on(rows),
        causes=sorted(causes.items(), key=lambda cause: -len(cause[1])),
        about=about or {},
        devices=len(devices),
        counts=counts_of(states),
        kinds=KINDS,
        well=typeset(all_well(states)),
        problems=[(p, typeset(ratio_words(p)), command_of(p, settings)) for p in found],
        most_problems=MOST_PROBLEMS,
        all_command=explain_command(settings, ["--all"]),
        limited=beyond_limits_groups(rows),
        overview=[figure for figure, _ in overview],
        history=history,
        history_data=script_data({"units": history["units"]}) if history else None,
        names=script_data([row["unit"] for row in rows]),
        values=script_data({figure.name: values for figure, values in [*overview, *fleet, *plots] if values}),
        first=FIRST_ROWS,
        sections=comparisons,
        verdicts={verdict: verdict.css_class for verdict in Verdict},
        sensors=[s for s in SENSORS if frame[f"{s}_error_after"].notna().any()] or SENSORS,
        scales={s: _scale(s, states) for s in SENSORS},
        kept=sorted(set(frame) - set(SUMMARY_COLUMNS)),
        page=page,
    )


def judged_on(rows: Sequence[Mapping[str, Any]], sensors: Sequence[str] = SENSORS) -> str:
    """Return in words where the errors of units are: on held-out motion, or without it on the samples of the fit."""
    of_fit = sum(any(isinstance(row.get(f"{s}_not_held_out"), str) for s in sensors) for row in rows)
    if of_fit in (0, len(rows)):
        return "on the samples of the fit" if of_fit else "on held-out motion"
    return f"on held-out motion (of {of_fit} units on the samples of the fit)"


def overview_chart(sensor: str, rows: Sequence[JSON | RowState]) -> UnitChart | None:
    """Draw the error over the noise floor of each unit, and return the text of each dot by its colour.

    Up to ``NAMED_ROWS`` units: a row with the name of the unit, its ratio before and after, the worst first; of more
    units, a histogram of the ratio after calibration. None where no ratio is known.
    """
    states = [*map(state_of, rows)]
    errors, names_of = [state.errors[sensor] for state in states], [str(state.row["unit"]) for state in states]
    known = sorted((i for i, e in enumerate(errors) if e.ratio), key=lambda i: -(errors[i].ratio or 0.0))
    if not known:
        return None
    ratio = np.array([errors[i].ratio for i in known], float)
    ready = np.array([not any(sensor in of for of in states[i].kinds.values()) for i in known])
    worst, far = names_of[known[0]], int(np.count_nonzero(ratio > MARK_ABOVE_FLOORS))
    moved = [(words, n) for s, n in zip(states, names_of, strict=True) if (words := far_by_moves(s, sensor))]
    middle = f", median {number(float(np.median(ratio)))} ×" if len(known) > 1 else ""
    finding = f"{sensor.capitalize()}: {far} of {len(known)} units above {MARK_ABOVE_FLOORS:g} × noise"
    finding += f"; {number(float(ratio[0]))} × in {worst}" if far else f"; at most {number(float(ratio[0]))} ×"
    if moved and not far:
        count = f"{len(moved)} of {len(known)} units {KINDS[FAR].name}"
        finding = typeset(f"{sensor.capitalize()}: {count}; {moved[0][0]} in {moved[0][1]}")
    kind = "vector" if all(errors[i].kind == "vector" for i in known) else "magnitude"
    place = judged_on([s.row for s in states], [sensor])
    caption = f"Error of the {kind} {place}, over the error that noise alone gives; lines: 1 × and 3 ×."
    description, label = f"{finding}{middle}.", "error over noise floor (logarithmic)"
    groups = ((ready, 2, "ready"), (~ready, 0, "not ready"))
    if len(known) > NAMED_ROWS:
        edges = np.linspace(np.log10(min(ratio.min(), 1.0)), np.log10(max(ratio.max(), 3.0)) + 1e-9, HISTOGRAM_BINS + 1)
        counts = np.array([np.histogram(np.log10(ratio[of]), edges)[0] for of, *_ in groups], float)
        tops = np.cumsum(counts, axis=0)
        layers: list[ChartLayer] = []
        for low, high, (of, colour, _) in zip([np.zeros(HISTOGRAM_BINS), tops[0]], tops, groups, strict=True):
            if of.any():
                layers.append(Area(np.repeat(low, 2), np.repeat(high, 2), colour, 10.0 ** np.repeat(edges, 2)[1:-1]))
        top = 1.1 * float(tops[-1].max())
        layers += [LineMark(np.full(2, x), np.array([0.0, top]), 3, "dashed") for x in (1.0, MARK_ABOVE_FLOORS)]
        layers.append(LineMark(10.0 ** ((edges[1:] + edges[:-1]) / 2), tops[-1], 5, "model"))
        legend = (*((f"c{colour}", text) for of, colour, text in groups if of.any()), ("c5", "units of a bin"))
        figure = Figure(f"ratio-{sensor}", finding, caption, legend)
        return chart(figure, description, [Panel(layers, "units", 150, limits=(0.0, top))], label, kind="log"), {}
    y = len(known) - np.arange(len(known), dtype=float)  # the first row on top
    before = np.array([(errors[i].before or np.nan) / (errors[i].floor or np.nan) for i in known])
    gap = np.full(len(known), np.nan)
    layers = [LineMark(np.full(2, x), np.array([0.4, y[0] + 1.4]), 5, "dashed") for x in (1.0, MARK_ABOVE_FLOORS)]
    layers.append(LineMark(np.stack([before, ratio, gap], 1).ravel(), np.repeat(y, 3), 3, "model"))
    numbers, values, legend_ = np.array(known) + 1, {}, []
    for v, of, colour, text in ((before, np.isfinite(before), 3, "before"), *((ratio, *group) for group in groups)):
        if of.any():
            layers.append(Dots(v[of], y[of], colour, units=tuple(numbers[of].tolist())))
            legend_.append((f"c{colour}", text if colour == 3 else f"after, {text}"))
            values[f"c{colour}"] = [f"{text}: {number(x)} × noise" for x in v[of].tolist()]
    names = [(x, y[0] + 0.7, f"{x:g} ×") for x in (1.0, MARK_ABOVE_FLOORS)]
    short = [_shortened(names_of[i]) for i in reversed(known)]
    left = round(NAME_LETTER * max(map(len, short))) + 10
    panel = Panel(layers, "", ROW * (len(known) + 1), limits=(0.4, y[0] + 1.4), rows=short, names=names)
    figure = Figure(f"ratio-{sensor}", finding, caption, tuple(legend_))
    return chart(figure, description, [panel], label, kind="log", margin=0.03, left=left, units="units"), values


def _shortened(name: str) -> str:
    return name if len(name) <= NAME_LETTERS else f"{name[: NAME_LETTERS - 8]}…{name[-7:]}"


def _scale(sensor: str, states: Sequence[RowState]) -> Scale:
    """Return the SI prefix for the errors of a sensor, by their median after calibration."""
    errors = [after for state in states if (after := state.errors[sensor].after) is not None]
    return scale_of(SENSOR_UNITS[sensor], float(np.median(errors)) if errors else None)


def _medians(name: str, frame: pd.DataFrame) -> list[JSON]:
    """Return the medians of the errors, the verdicts and the missing effects of some units for each sensor."""
    found = []
    for sensor in SENSORS:
        known = frame[frame[f"{sensor}_error_after"].notna()]
        figures = {
            figure: float(pd.to_numeric(known[f"{sensor}_{column}"]).median())
            for figure, column in (("before", "error_before"), ("after", "error_after"), ("floor", "noise_floor"))
        }
        verdicts = Counter(known[f"{sensor}_verdict"])
        about = {"sensor": sensor, "name": name, "unit": SENSOR_UNITS[sensor], "count": len(known)}
        counts = {verdict: verdicts[verdict] for verdict in Verdict if verdicts[verdict]}
        if len(known):
            found.append(about | figures | {"verdicts": counts, "missing": _missing(sensor, known)})
    return found


def _missing(sensor: str, frame: pd.DataFrame) -> list[tuple[str, int]]:
    """Return the number of units in which each effect is missing, the most frequent first."""
    names = Counter(name for names in frame[f"{sensor}_selected"].dropna() for name in names.split(";") if name)
    return sorted(((plain(name), count) for name, count in names.items()), key=lambda c: (-c[1], c[0]))


def _lots(frame: pd.DataFrame) -> list[JSON]:
    lots = {lot: units for lot, units in frame.groupby("lot", sort=False) if lot}
    if not 1 < len(lots) <= MOST_LOTS:
        return []
    found = [medians for lot, units in lots.items() for medians in _medians(f"lot {lot}", units)]
    return sorted(found, key=lambda medians: SENSORS.index(medians["sensor"]))


def _fleet_figure(sensor: str, frame: pd.DataFrame) -> UnitChart | None:
    """Draw the errors before and after in the order of ``units.csv``, and return the value of each dot by its colour.

    Each unit is a dot. Of more than ``MOST_DOTS`` units, only the farthest from the noise are dots, and quantiles show
    all. None for fewer than ``FEWEST_UNITS`` units.
    """
    unit, order = SENSOR_UNITS[sensor], np.arange(1.0, len(frame) + 1)
    errors = (pd.to_numeric(frame[f"{sensor}_{name}"]) for name in ("error_before", "error_after", "noise_floor"))
    before, after, floor = (v.where(v > 0).to_numpy(float) for v in errors)
    known = np.isfinite(after)
    count = int(known.sum())
    if count < FEWEST_UNITS:
        return None
    many = count > MOST_DOTS
    complete = known & (frame[f"{sensor}_verdict"] == Verdict.NOTHING_MISSING).to_numpy(bool)
    first, last = (before, order > 0, 3, "before"), (floor, order > 0, 4, "noise floor")  # the floor on top of the dots
    judged = [(after, complete, 2, "after, nothing missing"), (after, known & ~complete, 0, "after, any other verdict")]
    dotted = [first, *judged, last]
    layers: list[ChartLayer] = []
    legend, values = [], {}
    drawn = known
    if many:
        for v, _, colour, name in (first, last, (after, known, 5, "after")):
            layers += _quantiles(order, v, colour)
            legend.append((f"c{colour}", name))
        drawn = np.zeros(len(frame), bool)
        drawn[np.argsort(-np.nan_to_num(after / floor))[:FARTHEST_UNITS]] = True
        dotted = judged
    for v, of, colour, name in dotted:
        chosen = np.flatnonzero(of & drawn if v is after else of)
        if v is not after or len(chosen):
            layers.append(Dots(order[chosen], v[chosen], colour, units=tuple((chosen + 1).tolist()) if many else ()))
            legend.append((f"c{colour}", name))
            values[f"c{colour}" if many or v is not after else "after"] = [
                f"{e:.6g}" if np.isfinite(e) else "" for e in (v[chosen] if many else v)
            ]
    effects = ", ".join(f"{name} ({n} unit{'s' if n != 1 else ''})" for name, n in _missing(sensor, frame))
    words = f"Missing effects: {effects}." if effects else "No effect is named as missing."
    middle = [number(float(np.nanmedian(v))) if np.isfinite(v).any() else "not known" for v in (before, after, floor)]
    ratio, units = after / floor, frame["unit"].tolist()
    far = [int(i) for i in np.argsort(-np.nan_to_num(ratio)) if ratio[i] > MARK_ABOVE_FLOORS]
    finding = f"{sensor.capitalize()}: all {count} units are within {MARK_ABOVE_FLOORS:g} × the noise floor"
    if far:
        named = ", ".join(f"{units[i]} ({number(float(ratio[i]))} ×)" for i in far[:NAMED_UNITS])
        beyond = f"{len(far)} of {count} units are beyond {MARK_ABOVE_FLOORS:g} × the noise floor"
        finding = f"{sensor.capitalize()}: {beyond}; worst: {named}"
    dots = (
        f"the {FARTHEST_UNITS} farthest from the noise as dots, median and 5 to 95 % of all"
        if many
        else "one dot a unit"
    )
    figure = chart(
        Figure(
            f"fleet-{sensor}",
            finding,
            f"Error {judged_on(frame.to_dict('records'), [sensor])}, {dots}. {words}",
            tuple(legend),
        ),
        f"Held-out error of {count} units. Median {middle[0]} {unit} before, {middle[1]} after, noise floor "
        f"{middle[2]}. {words}",
        [Panel(layers, f"rms error, {unit}", 200, logarithmic=True)],
        "unit, in the order of units.csv",
        kind="count",
        margin=0.03,
        units="units",
    )
    return figure, values


def _quantiles(order: np.ndarray, values: np.ndarray, colour: int) -> list[ChartLayer]:
    """Return the median and the band from 5 to 95 % of neighbouring units."""
    parts = [p for p in np.array_split(np.arange(len(order)), QUANTILE_PARTS) if np.isfinite(values[p]).any()]
    low, middle, high = np.array([np.nanquantile(values[p], [0.05, 0.5, 0.95]) for p in parts]).reshape(-1, 3).T
    x = np.array([order[p].mean() for p in parts])
    return [Area(low, high, colour, x), LineMark(x, middle, colour)]


def strips(rows: Sequence[JSON], parameters: pd.DataFrame) -> list[UnitChart]:
    """Return the strip plots of a campaign, each with the text of its dots; ``rows``: in the order of the page."""
    siblings: dict[tuple[str, str], list[int]] = {}
    for i, row in enumerate(rows):
        if row["status"] == "ok":
            siblings.setdefault((row.get("sensor") or "", row.get("method") or ""), []).append(i)
    out: list[UnitChart] = []
    units = [row["unit"] for row in rows]
    for (model, method), members in siblings.items():
        placed = parameters[parameters["limit"].notna() & parameters["unit"].isin([units[i] for i in members])]
        for sensor, table in placed.groupby("sensor"):
            known = set(table["unit"])
            numbers = np.array([i for i in members if units[i] in known])
            if len(numbers) >= FEWEST_SIBLINGS:
                title = f"{str(sensor).capitalize()}, {model}, {plain(method)}"
                out.append(_strip(f"strip-{len(out) + 1}", title, units, numbers, table))
    return out


def _strip(name: str, title: str, units: list[str], numbers: Index, table: pd.DataFrame) -> UnitChart:
    """Return the plot of some siblings and the text of each dot; ``table``: their parameters with limits."""
    frames = wide(table, [units[i] for i in numbers], "label", "value", "limit", "beyond")
    labels, (value, limit, marked) = [*frames[0]], (frame.to_numpy(float) for frame in frames)
    measures = dict(zip(table["label"], map(unit_text, table["measure"]), strict=True))
    share = value / limit
    height = len(labels) - np.arange(len(labels), dtype=float)  # the first row on top
    offset = ROW_SPREAD * (0.5 - (np.arange(len(numbers)) + 0.5) / len(numbers))
    drawn = np.isfinite(share)
    layers = [_bar(np.array([-1.0, 1.0]), 0.4, height[0] + 0.6, 4)]
    if many := len(numbers) > MAX_PLOTTED_UNITS:
        rank = np.argsort(np.argsort(share, axis=0), axis=0)
        drawn &= (rank < ENDS) | (rank >= drawn.sum(axis=0) - ENDS)
        ends = np.nanquantile(share, [0.05, 0.95], axis=0).T
        layers += [_bar(each, row - HALF_BAR, row + HALF_BAR, 3) for row, each in zip(height, ends, strict=True)]
    beyond, values, legend = marked == 1.0, {}, []
    dots: list[ChartLayer] = []
    for chosen, colour, words in ((drawn & ~beyond, 2, "within the limit"), (drawn & beyond, 0, "beyond the limit")):
        i, j = np.nonzero(chosen)
        if len(i):
            x = 100.0 * np.clip(share[i, j], -MAX_DRAWN_SHARE, MAX_DRAWN_SHARE)
            dots.append(Dots(x, height[j] + offset[i], colour, units=tuple((numbers[i] + 1).tolist())))
            legend.append((f"c{colour}", words))
            values[f"c{colour}"] = [
                f"{labels[b]}: {number(value[a, b], 4)} {measures[labels[b]]}".rstrip()
                + f", {percent(share[a, b])} of ±{number(limit[a, b])}"
                for a, b in zip(i, j, strict=True)
            ]
    worst, column = np.unravel_index(np.nanargmax(np.abs(share)), share.shape)
    texts = worded(
        "strip",
        name,
        tuple(legend),
        title=title,
        beyond=int(beyond.any(axis=1).sum()),
        count=len(numbers),
        farthest=f"{units[numbers[worst]]}, {labels[column].lower()}",
        share=float(abs(share[worst, column])),
        ends=ENDS if many else 0,
        edge=MAX_DRAWN_SHARE if np.nanmax(np.abs(share)) > MAX_DRAWN_SHARE else 0,
        medians=[*zip(labels, np.nanmedian(share, axis=0).tolist(), strict=True)],
    )
    panel = Panel([*layers, *dots], "", ROW * len(labels), limits=(0.4, height[0] + 0.6), rows=labels[::-1])
    label = "share of the data sheet's limit, %"
    left = max(LEFT, round(NAME_LETTER * max(map(len, labels))) + 10)
    return chart(*texts, [panel], label, margin=0.03, left=left, units="units"), values


def _bar(ends: Values, low: float, high: float, colour: int) -> ChartLayer:
    return Area(low, high, colour, 100.0 * np.clip(ends, -MAX_DRAWN_SHARE, MAX_DRAWN_SHARE))
