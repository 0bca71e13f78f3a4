"""Charts of groups: a row for each value, upright bars in groups, and means along an axis.

The length of a bar on a logarithmic axis has no meaning, only its end has one: so each row shows its number, and levels
(the noise floor) are lines across all rows. A row with an interval is the mean of several units: a dot with its 95 %
interval and faint dots for the units. The values are also the description of the chart for screen readers.
"""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from pipeline.report.chart import WIDTH, Axis, Dots, Layer, Line, Panel, Samples, chart, svg, text, upright_text
from pipeline.report.numbers import number

if TYPE_CHECKING:
    from collections.abc import Sequence

    from markupsafe import Markup

ROW, LEFT, RIGHT = 30, 6, 64  # px
LETTER = 6.0  # px, width of one
COLOURS = 6  # of the style sheet: c0 to c5
DECADE = 8.0  # largest over smallest place from which an axis x is logarithmic: a decade is nearly filled


@dataclass(frozen=True)
class Point:
    """One value.

    Attributes
    ----------
    label : str
    value : float or None
        None: no bar.
    colour : int
    interval : (low, high), optional
        Of a mean; drawn in place of the bar.
    units : tuple of float
        The values behind a mean.
    floor : float, optional
        A level of this row alone: what noise alone gives.
    x : float
        Place along the axis of ``curves``.
    series : str
        Points of one series are joined in ``curves``.
    """

    label: str
    value: float | None
    colour: int = 0
    interval: tuple[float, float] | None = None
    units: tuple[float, ...] = ()
    floor: float | None = None
    x: float = 0.0
    series: str = ""


def bars(name: str, title: str, rows: Sequence[Point], label: str, *, levels: dict[str, float] | None = None) -> Markup:
    """Return a chart with a row for each value, on a logarithmic axis.

    Parameters
    ----------
    name, title : str
        Identifier that is unique on the page, and what the chart is.
    rows : sequence of Point
    label : str
        Of the values, with unit.
    levels : dict of str to float, optional
        Vertical lines by their text; values above 0 are drawn.
    """
    levels = {words: value for words, value in (levels or {}).items() if value > 0}
    values = [v for r in rows for v in (r.value, *(r.interval or ()), *r.units, r.floor) if v is not None and v > 0]
    values = values + list(levels.values()) or [0.1, 1.0]
    means = any(r.interval for r in rows)
    ends = np.array([min(values) / (1.1 if means else 2.0), max(values) * 1.15])
    axis = Axis.over([ends], LEFT + 20 * means, WIDTH - (26 if means else RIGHT), "log", margin=0.0)
    top = 16 if levels else 4
    bottom = top + ROW * len(rows)
    ticks = axis.ticks(5)
    out = [f'<path class="grid" d="{"".join(f"M{at:.1f} {top}V{bottom}" for at, _ in ticks)}"/>']
    out += [_row(row, axis, top + ROW * i) for i, row in enumerate(rows)]
    for words, value in levels.items():
        at, said = axis.pixels(value), f"{words} {number(value)}"
        half = LETTER / 2 * len(said)
        out.append(f'<path class="level" d="M{at:.1f} {top}V{bottom}"/>')
        out.append(text(min(max(at, LEFT + half), WIDTH - half), top - 4, said, "m"))
    out += [text(max(at, LEFT + 14), bottom + 13, tick, "m") for at, tick in ticks]
    out.append(text((axis.start + axis.stop) / 2, bottom + 27, label, "m"))
    description = _description(rows) + "".join(f"; {words} {number(value)}" for words, value in levels.items())
    return svg(name, title, f"{label}. {description}", bottom + 34, "".join(out))


def _description(points: Sequence[Point]) -> str:
    """Return the values of points with their intervals."""
    said = []
    for p in points:
        interval = f", 95 % interval {number(p.interval[0])} to {number(p.interval[1])}" if p.interval else ""
        said.append(f"{p.series}{', ' if p.series else ''}{p.label}: {number(p.value)}{interval}")
    return "; ".join(said)


def _row(row: Point, axis: Axis, top: float) -> str:
    """Return the text of a row, and its bar or its mean."""
    said = f"{row.label}: {number(row.value)}" if row.interval else row.label
    out = text(LEFT, top + 11, said, "b")
    if row.value is None:
        return out + text(LEFT, top + 23, "not known")
    end = axis.pixels(row.value)
    if row.interval is None:
        out += f'<path class="bar c{row.colour}" d="M{LEFT} {top + 15}H{end:.1f}v10H{LEFT}z"/>'
        return out + text(end + 4, top + 24, number(row.value))
    middle, (low, high) = top + 21, row.interval
    out += f"<g><title>{escape(f'{said} ({number(low)} to {number(high)})')}</title>"
    if len(row.units) > 1:
        dots = "".join(f"M{axis.pixels(v):.1f} {middle}h0" for v in row.units)
        out += f'<path class="unit-dots c{row.colour}" d="{dots}"/>'
    ends = f"M{axis.pixels(low):.1f} {middle}H{axis.pixels(high):.1f}"
    out += f'<path class="strokes c{row.colour}" d="{ends}"/>'
    out += f'<path class="mean-dot c{row.colour}" d="M{end:.1f} {middle}h0"/></g>'
    if row.floor:
        out += f'<path class="level" d="M{axis.pixels(row.floor):.1f} {top + 13}v16"/>'
    return out


def columns(
    name: str,
    title: str,
    groups: dict[str, list[float]],
    label: str,
    *,
    x_label: str,
    levels: Sequence[float] = (),
) -> Markup:
    """Return a chart of upright bars in groups: one colour for each place in a group.

    Parameters
    ----------
    name, title : str
    groups : dict of str to list of float
        Values by the text below their group.
    label, x_label : str
        Of the values, with unit, and of the groups.
    levels : sequence of float
        A dash over each group.
    """
    high = max((v for g in [*groups.values(), levels] for v in g), default=1.0) or 1.0
    left, right, top, bottom = 64, WIDTH - 8, 8, 138
    y = Axis(0.0, high * 1.05, bottom, top)
    pitch = (right - left) / max(len(groups), 1)
    ticks = y.ticks(4)
    out = [f'<path class="grid" d="{"".join(f"M{left} {at:.1f}H{right}" for at, _ in ticks)}"/>']
    out += [text(left - 4, at + 3.5, tick, "e") for at, tick in ticks]
    for i, (below, values) in enumerate(groups.items()):
        width = 0.8 * pitch / max(len(values), 1)
        for j, value in enumerate(values):
            x = left + pitch * (i + 0.1) + j * width
            path = f"M{x:.1f} {bottom}V{y.pixels(value):.1f}h{width:.1f}V{bottom}z"
            out.append(f'<path class="bar c{j}" d="{path}"/>')
        out.append(text(left + pitch * (i + 0.5), bottom + 13, below, "m"))
    dashes = "".join(f"M{left + pitch * i:.1f} {y.pixels(v):.1f}h{pitch:.1f}" for i, v in enumerate(levels))
    if dashes:
        out.append(f'<path class="level" d="{dashes}"/>')
    out.append(upright_text((top + bottom) / 2, label))
    out.append(text((left + right) / 2, bottom + 27, x_label, "m"))
    said = "; ".join(f"{below}: {', '.join(number(v, 2) for v in group)}" for below, group in groups.items())
    return svg(name, title, f"{label}, by {x_label}. {said}", bottom + 34, "".join(out))


def curves(name: str, title: str, points: Sequence[Point], label: str, *, x_label: str, named: bool) -> Markup:
    """Return a chart of means with intervals along an axis, a colour for each series.

    Parameters
    ----------
    name, title : str
    points : sequence of Point
        Each with an interval.
    label, x_label : str
    named : bool
        Whether the label of each point is drawn beside it.
    """
    layers: list[Layer] = []
    for colour, series in enumerate(dict.fromkeys(p.series for p in points)):
        own = sorted((p for p in points if p.series == series), key=lambda p: p.x)
        x, value, floor = (np.array(v, float) for v in zip(*((p.x, p.value, p.floor) for p in own), strict=True))
        low, high = np.array([p.interval for p in own]).T
        layers.append(Line(x, value, colour % COLOURS, "model"))
        if np.isfinite(floor).any():
            layers.append(Line(x, floor, colour % COLOURS, "dashed"))
        units = [(p.x, unit) for p in own if len(p.units) > 1 for unit in p.units]
        unit_x, unit_y = np.array(units).reshape(-1, 2).T
        layers += [Samples(unit_x, unit_y, colour % COLOURS), Dots(x, value, colour % COLOURS, low, high)]
    places = [p.x for p in points]
    wide = min(places) > 0.0 and max(places) > DECADE * min(places)
    names = [(p.x, p.value or 0.0, p.label) for p in points] if named else None
    panel = Panel(layers, label, 230, logarithmic=True, names=names)
    return chart(
        name, title, f"{label}. {_description(points)}", [panel], x_label, kind="log" if wide else "", margin=0.03
    )
