"""Charts of groups: a row for each value, stems in groups, and means along an axis.

On a logarithmic axis a value is a dot, as the length of a bar would have no meaning. Each row shows its number, and
levels (the noise floor) are lines across all rows. A row with an interval is the mean of several units: a dot with its
95 % interval and faint dots for the units. The description of the chart for screen readers states the values.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import NamedTuple

import numpy as np

from pipeline.output.pages.chart import (
    CHART_WIDTH,
    LETTER,
    LINEAR_TO,
    Axis,
    ChartLayer,
    Dots,
    Figure,
    LineMark,
    Panel,
    SampleMarks,
    chart,
    text,
)
from pipeline.output.pages.pages import number

ROW, LEFT, RIGHT, HALF_TICK = 30, 6, 64, 14  # px; half of a tick's text
BRACKET = 48  # px, width of a bracket
COLOURS = 6  # of the style sheet: c0 to c5
DECADE = 8.0  # largest over smallest x above which an axis x is logarithmic: the values fill nearly a decade
LOWEST = -100.0  # smallest value to which a bar on a symlog axis is drawn


class Point(NamedTuple):
    """One value; None has no bar.

    ``interval``: low and high of a mean, drawn with the dot; ``units``: the values that are averaged; ``floor``:
    value of this row by noise alone; ``x, series``: position in ``curves``, which joins the points of a series;
    ``note``: part of the description; ``digits``: of the value.
    """

    label: str
    value: float | None
    colour: int = 0
    interval: tuple[float, float] | None = None
    units: tuple[float, ...] = ()
    floor: float | None = None
    x: float = 0.0
    series: str = ""
    note: str = ""
    digits: int = 3


def bars(
    figure: Figure,
    rows: Sequence[Point],
    label: str,
    *,
    levels: Mapping[str, float] | None = None,
    kind: str = "log",
    brackets: Sequence[Mapping[int, str]] = (),
) -> Figure:
    """Return a figure with a row for each value.

    ``label``: of the values, with unit; ``levels``: vertical lines by their text, only levels above 0 are drawn;
    ``kind``: of the axis, "log", or "symlog" with bars from zero; ``brackets``: index and text of its rows.
    """
    levels = {words: value for words, value in (levels or {}).items() if value > 0}
    values = [v for r in rows for v in (r.value, *(r.interval or ()), *r.units, r.floor) if v is not None]
    means = any(r.interval for r in rows)
    if kind == "symlog":
        ends = [max(min(values, default=0.0), LOWEST), 0.0, max(values, default=0.0), 2.0 * LINEAR_TO]
    else:
        positive = [v for v in (*values, *levels.values()) if v > 0] or [0.1, 1.0]
        ends = [min(positive) / (1.1 if means else 2.0), max(positive) * 1.15]
    stop = CHART_WIDTH - (26 if means else RIGHT) - BRACKET * len(brackets)
    axis = Axis.over([np.array(ends)], LEFT + (20 if means else HALF_TICK), stop, kind, margin=0.0)
    top = 16 if levels else 4
    bottom = top + ROW * len(rows)
    ticks = axis.ticks(5)
    drawn = [(top + ROW * i, row) for i, row in enumerate(rows) if row.value is not None]
    at_bars = "".join(f"M{{0:.1f}} {place + 13}v14" for place, _ in drawn)  # these pieces of a line cross no label
    out = [f'<path class="grid" d="{"".join(f"{at_bars}M{{0:.1f}} {bottom}v3".format(at) for at, _ in ticks)}"/>']
    out += [_row(row, axis, at) for at, row in drawn]
    for words, value in levels.items():
        at, half = axis.pixels(value), LETTER / 2 * len(words)
        out.append(f'<path class="level" d="M{at:.1f} {top}v2{at_bars.format(at)}"/>')
        out.append(text(min(max(at, LEFT + half), CHART_WIDTH - half), top - 4, words, "m"))
    for at, row in drawn:
        if row.value is not None and row.interval is None:
            digits = number(row.value, row.digits)
            left = max(axis.pixels(0.0), axis.pixels(row.value)) + 4 + 4 * (kind == "log")
            lines = [line for line in map(axis.pixels, levels.values()) if left < line < left + LETTER * len(digits)]
            out.append(text(max(lines, default=left - 4) + 4, at + 24, digits, "value"))  # right of a level, not on it
    out += [_row(row, axis, top + ROW * i) for i, row in enumerate(rows) if row.value is None]
    for k, members in enumerate(brackets):
        at, heights = stop + RIGHT - 12 + BRACKET * k, {top + ROW * row + 20: words for row, words in members.items()}
        teeth = "".join(f"M{at - 6} {y}h6" for y in heights)
        out.append(f'<path class="bracket" d="M{at} {min(heights)}V{max(heights)}{teeth}"/>')
        out += [text(at + 3, y + 3.5, words) for y, words in heights.items() if words]
    out += [text(max(at, LEFT + 14), bottom + 13, tick, "m") for at, tick in ticks]
    out.append(text((axis.start + axis.stop) / 2, bottom + 27, label, "m"))
    description = _description(rows) + "".join(f"; {words}" for words in levels)
    return figure.drawn(f"{label}. {description}", bottom + 34, "".join(out))


def _description(points: Sequence[Point]) -> str:
    texts = []
    for p in points:
        interval = f", 95 % interval {number(p.interval[0])} to {number(p.interval[1])}" if p.interval else ""
        note = f", {p.note}" if p.note else ""
        texts.append(f"{p.series}{', ' if p.series else ''}{p.label}: {number(p.value, p.digits)}{interval}{note}")
    return "; ".join(texts)


def _row(row: Point, axis: Axis, top: int) -> str:
    if row.value is None:
        return text(LEFT, top + 11, f"{row.label}: not known", "off")
    label = f"{row.label}: {number(row.value)}" if row.interval else row.label
    out, end = text(LEFT, top + 11, label, "b"), axis.pixels(row.value)
    if row.interval is None:
        zero = axis.pixels(0.0)
        if axis.kind == "log":  # the length of a bar would have no meaning
            dot = f'<path class="mean-dot c{row.colour}" d="M{end:.1f} {top + 20}h0"/>'
            return f'{out}<path class="grid" d="M{axis.start:.1f} {top + 20}H{end:.1f}"/>{dot}'
        return f'{out}<path class="bar c{row.colour}" d="M{zero:.1f} {top + 15}H{end:.1f}v10H{zero:.1f}z"/>'
    middle, (low, high) = top + 21, row.interval
    out += f"<g><title>{escape(f'{label} ({number(low)} to {number(high)})')}</title>"
    if len(row.units) > 1:
        dots = "".join(f"M{axis.pixels(v):.1f} {middle}h0" for v in row.units)
        out += f'<path class="unit-dots c{row.colour}" d="{dots}"/>'
    ends = f"M{axis.pixels(low):.1f} {middle}H{axis.pixels(high):.1f}"
    out += f'<path class="strokes c{row.colour}" d="{ends}"/>'
    out += f'<path class="mean-dot c{row.colour}" d="M{end:.1f} {middle}h0"/></g>'
    if row.floor:
        out += f'<path class="level" d="M{axis.pixels(row.floor):.1f} {top + 15}v12"/>'
    return out


def stems(
    figure: Figure, groups: Mapping[str, Sequence[float]], label: str, x_label: str, levels: Sequence[float] = ()
) -> Figure:
    """Return a figure with a stem for each value, in groups: one colour for each position in a group.

    ``groups``: values, equally many in each, by the text below the group; ``label``: of the values, with unit;
    ``x_label``: of the groups; ``levels``: one for each group, joined by a dashed line.
    """
    values = np.array(list(groups.values()), float)
    at, zero = np.arange(1.0, len(values) + 1.0), np.zeros(len(values))
    layers: list[ChartLayer] = [LineMark(at, np.array(levels), 5, "dashed")] if len(levels) else []
    for j, column in enumerate(values.T):
        layers.append(Dots(at + 0.8 * ((j + 0.5) / values.shape[1] - 0.5), column, j, zero, column))
    texts = "; ".join(f"{below}: {', '.join(number(v, 2) for v in group)}" for below, group in groups.items())
    panel = Panel(layers, label)
    return chart(figure, f"{label}, by {x_label}. {texts}", [panel], x_label, margin=0.03, columns=list(groups))


def curves(figure: Figure, points: Sequence[Point], label: str, x_label: str, *, named: bool) -> Figure:
    """Return a figure with means and their intervals along an axis, a colour for each series.

    Each point has an interval; ``named``: the labels of the points are drawn.
    """
    layers: list[ChartLayer] = []
    for colour, series in enumerate(dict.fromkeys(p.series for p in points)):
        of_series = sorted((p for p in points if p.series == series), key=lambda p: p.x)
        x, value, floor = (np.array(v, float) for v in zip(*((p.x, p.value, p.floor) for p in of_series), strict=True))
        low, high = np.array([p.interval for p in of_series]).T
        layers.append(LineMark(x, value, colour % COLOURS, "model"))
        if np.isfinite(floor).any():
            layers.append(LineMark(x, floor, colour % COLOURS, "dashed"))
        units = [(p.x, unit) for p in of_series if len(p.units) > 1 for unit in p.units]
        unit_x, unit_y = np.array(units).reshape(-1, 2).T
        layers += [SampleMarks(unit_x, unit_y, colour % COLOURS), Dots(x, value, colour % COLOURS, low, high)]
    places = [p.x for p in points]
    kind = "log" if min(places) > 0.0 and max(places) > DECADE * min(places) else ""
    names = [(p.x, p.value or 0.0, p.label) for p in points] if named else []
    panel = Panel(layers, label, 230, logarithmic=True, names=names)
    return chart(figure, f"{label}. {_description(points)}", [panel], x_label, kind=kind, margin=0.03)
