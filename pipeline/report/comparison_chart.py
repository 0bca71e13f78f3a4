"""Errors of groups beside each other: each group's mean with its interval, and its units as faint dots.

``rows`` draws a row for each group, ``curve`` draws groups along an axis (table time, or a column of numbers), a colour
for each series. An axis is logarithmic where its values span more than a factor of ``DECADE``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from html import escape
from typing import TYPE_CHECKING

from pipeline.report.axes import Scale, log_ticks, tick_label, tick_step, ticks
from pipeline.report.numbers import number
from pipeline.report.svg import BOTTOM, LEFT, RIGHT, TOP, WIDTH, frame, text

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from markupsafe import Markup

DECADE = 8.0
ROW, HEIGHT = 30, 230
LETTER = 6.2  # px, width of one
COLOURS = 6


@dataclass(frozen=True)
class Point:
    """One group: its mean, the interval about it and its units.

    Attributes
    ----------
    label : str
    value : float
    interval : (low, high)
    units : tuple of float
        Values of its units.
    floor : float or None
        What noise alone would leave.
    x : float
        Where it stands on the axis of a curve.
    series : str
    """

    label: str
    value: float
    interval: tuple[float, float]
    units: tuple[float, ...] = ()
    floor: float | None = None
    x: float = 0.0
    series: str = ""


def rows(name: str, title: str, points: Sequence[Point], unit: str) -> Markup:
    """Return a chart with a row for each group.

    Parameters
    ----------
    name, title : str
        Identifier that is unique on the page; what the chart is.
    points : sequence of Point
    unit : str
        Of the values.
    """
    bottom = 4 + ROW * len(points)
    x = _scale(points, 26, WIDTH - RIGHT - 12)
    at = _ticks(x, 6)
    out = [_grid([f"M{x.pixels(v):.1f} 4V{bottom}" for v, _ in at])]
    for i, point in enumerate(points):
        top = 4 + ROW * i
        out.append(text(6, top + 12, f"{point.label}: {number(point.value)}", "b"))
        out.append(_marks(point, 0, partial(_across, x, top + 21.0)))
        if point.floor:
            out.append(f'<path class="level" d="M{x.pixels(point.floor):.1f} {top + 13}V{top + 29}"/>')
    out += [text(x.pixels(v), bottom + 13, label, "m") for v, label in at]
    out.append(text(WIDTH / 2, bottom + 28, unit, "m"))
    return frame(name, title, _words(points), bottom + BOTTOM, "".join(out))


def curve(name: str, title: str, points: Sequence[Point], unit: str, x_label: str, *, labelled: bool) -> Markup:
    """Return a chart of groups along an axis; points of one series are joined.

    Parameters
    ----------
    name, title : str
    points : sequence of Point
    unit, x_label : str
    labelled : bool
        Whether each point is named; where the axis does not say it already.
    """
    bottom = TOP + HEIGHT
    x = _x_scale(points)
    y = _scale(points, bottom - 6, TOP + 8)
    across, up = _ticks(x, 6), _ticks(y, 6)
    lines = [f"M{LEFT} {y.pixels(v):.1f}H{WIDTH - RIGHT}" for v, _ in up]
    out = [_grid([*lines, *(f"M{x.pixels(v):.1f} {TOP}V{bottom}" for v, _ in across)])]
    for colour, series in enumerate(dict.fromkeys(p.series for p in points)):
        own = sorted((p for p in points if p.series == series), key=lambda p: p.x)
        out.append(_joined([(x.pixels(p.x), y.pixels(p.value)) for p in own], f"line model c{colour % COLOURS}"))
        floors = [(x.pixels(p.x), y.pixels(p.floor)) for p in own if p.floor]
        out.append(_joined(floors, "level"))
        out += [_marks(p, colour, partial(_upward, y, x.pixels(p.x))) for p in own]
    if labelled:
        out.append(_labels(points, x, y))
    out += [text(LEFT - 4, y.pixels(v) + 3.5, label, "e") for v, label in up]
    out += [text(x.pixels(v), bottom + 13, label, "m") for v, label in across]
    out.append(text((LEFT + WIDTH - RIGHT) / 2, bottom + 28, x_label, "m"))
    middle = (TOP + bottom) / 2
    out.append(f'<text class="m" transform="translate(10 {middle:g}) rotate(-90)">{escape(unit)}</text>')
    return frame(name, title, _words(points), bottom + BOTTOM, "".join(out))


def _scale(points: Sequence[Point], start: float, stop: float) -> Scale:
    """Return the axis of the errors."""
    held = [v for p in points for v in (*p.interval, *p.units, *([p.floor] if p.floor else []))]
    wide = min(held) > 0.0 and max(held) > DECADE * min(held)
    return (_logarithmic if wide else _linear)(held, start, stop)


def _x_scale(points: Sequence[Point]) -> Scale:
    at = [p.x for p in points]
    wide = min(at) > 0.0 and max(at) > DECADE * min(at)
    return (_logarithmic if wide else _linear)(at, LEFT + 10, WIDTH - RIGHT - 12)


def _logarithmic(values: Sequence[float], start: float, stop: float) -> Scale:
    return Scale(min(values) / 1.1, max(values) * 1.1, start, stop, logarithmic=True)


def _linear(values: Sequence[float], start: float, stop: float) -> Scale:
    low, high = min(values), max(values)
    margin = 0.06 * (high - low) or 0.5 * abs(high) or 0.5
    return Scale(low - margin, high + margin, start, stop)


def _ticks(scale: Scale, count: int) -> list[tuple[float, str]]:
    if not scale.logarithmic:
        step = tick_step(scale.low, scale.high, count)
        return [(v, tick_label(v, step)) for v in ticks(scale.low, scale.high, count)]
    values = log_ticks(scale.low, scale.high)
    if len(values) < 3:
        values = sorted({s * v for v in [values[0] / 10.0, *values] for s in (1.0, 2.0, 5.0)})
    return [(v, tick_label(v, v)) for v in values if scale.low <= v <= scale.high]


def _grid(lines: list[str]) -> str:
    return f'<path class="grid" d="{"".join(lines)}"/>'


def _joined(points: list[tuple[float, float]], kind: str) -> str:
    return f'<path class="{kind}" d="M{"L".join(f"{a:.1f} {b:.1f}" for a, b in points)}"/>' if len(points) > 1 else ""


def _across(scale: Scale, y: float, value: float) -> tuple[float, float]:
    return scale.pixels(value), y


def _upward(scale: Scale, x: float, value: float) -> tuple[float, float]:
    return x, scale.pixels(value)


def _marks(point: Point, colour: int, place: Callable[[float], tuple[float, float]]) -> str:
    """Return the units' dots, the interval and the mean of a group; ``place`` is where a value stands."""
    kind = f"c{colour % COLOURS}"
    low, high = point.interval
    (a, b), (c, d), (e, f) = place(low), place(high), place(point.value)
    dots = "".join(f"M{u:.1f} {v:.1f}h0" for u, v in map(place, point.units)) if len(point.units) > 1 else ""
    title = f"{point.label}: {number(point.value)} ({number(low)} to {number(high)})"
    out = f'<path class="unit-dots {kind}" d="{dots}"/>' if dots else ""
    out += f'<path class="strokes {kind}" d="M{a:.1f} {b:.1f}L{c:.1f} {d:.1f}"/>'
    return f'<g><title>{escape(title)}</title>{out}<path class="mean-dot {kind}" d="M{e:.1f} {f:.1f}h0"/></g>'


def _labels(points: Sequence[Point], x: Scale, y: Scale) -> str:
    """Return the points' names beside them; one that would cover another is left out, its title tells it."""
    taken: list[tuple[float, float, float]] = []
    out = []
    for p in points:
        wide = LETTER * len(p.label)
        left = x.pixels(p.x) + 6.0
        left = left if left + wide <= WIDTH - 2 else x.pixels(p.x) - 6.0 - wide
        at = y.pixels(p.value) - 5.0
        if all(abs(at - b) > 11.0 or left > a + w or a > left + wide for a, b, w in taken):
            taken.append((left, at, wide))
            out.append(text(left, at, p.label, "b"))
    return "".join(out)


def _words(points: Sequence[Point]) -> str:
    return "; ".join(
        f"{p.label}: {number(p.value)}, 95 % interval {number(p.interval[0])} to {number(p.interval[1])}"
        for p in points
    )
