"""Charts as inline SVG: panels one above the other that share the axis x, with lines, dots, bands and levels.

A chart is text: no image, no font, no other host. Colours are CSS classes of the page (``c0`` .. ``c5``), so that a
chart follows the page into the dark. Each has a title and a description in words for those who cannot see it.

The chart itself and each panel say in ``data-scale`` what their axis is: value and place of both ends, whether it is
logarithmic, and its text. With it the page's script reads values back from the paths, and zooms.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from html import escape

import numpy as np
from markupsafe import Markup

from pipeline.report.axes import SUBDIVISION, Scale, log_ticks, span, tick_label, tick_step, ticks
from pipeline.report.shapes import REACH, Band, Layer, Means, draw

WIDTH = 420
LEFT, RIGHT, TOP, BOTTOM, GAP = 64, 14, 8, 36, 14

Tick = tuple[float, str]


@dataclass(frozen=True)
class Panel:
    """One field of a chart.

    Attributes
    ----------
    layers : list of Line, Samples, Band or Means
        Drawn in this order.
    label : str
        Of the axis y, with unit.
    height : int, px
    levels : dict of str to float
        Horizontal lines by their text.
    limits : (low, high), optional
        Of the axis y; from the layers where it is not given.
    logarithmic : bool
        Whether what is drawn are logarithms to base 10 of y; ticks tell the values.
    """

    layers: list[Layer]
    label: str
    height: int = 140
    levels: dict[str, float] | None = None
    limits: tuple[float, float] | None = None
    logarithmic: bool = False


def chart(
    name: str,
    title: str,
    description: str,
    panels: list[Panel],
    x_label: str,
    *,
    angle: bool = False,
    logarithmic: bool = False,
    names: str = "",
) -> Markup:
    """Return a chart of panels that share the axis x.

    Parameters
    ----------
    name : str
        Identifier, unique on its page.
    title, description : str
        What the chart is, and what it shows, in words.
    panels : list of Panel
    x_label : str
    angle : bool
        Whether x is an angle in deg.
    logarithmic : bool
        Whether what is drawn are logarithms to base 10 of x; ticks tell the values.
    names : str
        List of the page's script that names what stands at x = 1, 2, ...
    """
    margin = 0.03 if names else 0.0
    places = {id(layer.x): layer.x for p in panels for layer in p.layers}  # most layers share theirs
    x = Scale(*span(list(places.values()), margin), LEFT, WIDTH - RIGHT)
    x_ticks = _decades(x) if logarithmic else _x_ticks(x, angle=angle)
    marks = [f"M{x.pixels(at):.1f} " for at, _ in x_ticks]
    parts, top = [], TOP
    for panel in panels:
        parts.append(_panel(panel, x, marks, top))
        top += panel.height + GAP
    if top * SUBDIVISION > REACH:
        raise ValueError(f"chart {name} is {top} px high, more than {REACH // SUBDIVISION}")
    labels = "".join(text(x.pixels(at), top - GAP + 13, label, "m") for at, label in x_ticks)
    parts.append(f'<g class="ticks">{labels}</g>')
    parts.append(text((LEFT + WIDTH - RIGHT) / 2, top - GAP + 28, x_label, "m"))
    scale = _scale(x, x_label, "angle" if angle else "log" if logarithmic else "")
    scale += f' data-names="{names}"' if names else ""
    return frame(name, title, description, top - GAP + BOTTOM, "".join(parts), scale=scale)


def frame(name: str, title: str, description: str, height: float, content: str, *, scale: str = "") -> Markup:
    """Return the ``svg`` element with its text alternatives around drawn content."""
    name = escape(name)
    return Markup(  # noqa: S704  (every text in it is escaped where it is written)
        f'<svg class="chart" viewBox="0 0 {WIDTH} {height:g}" role="img" aria-labelledby="{name}-t {name}-d"{scale}>'
        f'<title id="{name}-t">{escape(title)}</title><desc id="{name}-d">{escape(description)}</desc>{content}</svg>'
    )


def text(x: float, y: float, content: str, kind: str = "") -> str:
    """Return a text element; ``kind`` is its CSS class (``e`` right-aligned, ``m`` centred)."""
    return f'<text x="{x:.4g}" y="{y:.4g}" class="{kind}">{escape(content)}</text>'


def _panel(panel: Panel, x: Scale, marks: list[str], top: float) -> str:
    bottom = top + panel.height
    y = Scale(*_limits(panel), bottom, top)
    values = _decades(y) if panel.logarithmic else _y_ticks(y.low, y.high, panel.height)
    grid = "".join([f"M{LEFT} {y.pixels(v):.1f}H{WIDTH - RIGHT}" for v, _ in values])
    height = f"{top:g}V{bottom:g}"
    grid += "".join([mark + height for mark in marks])
    out = [
        f'<g class="panel"{_scale(y, panel.label, "log" if panel.logarithmic else "")}><path class="grid" d="{grid}"/>'
    ]
    out.append('<g class="ticks">')
    out += [text(LEFT - 4, y.pixels(v) + 3.5, label, "e") for v, label in values]
    middle = (top + bottom) / 2
    out.append(f'</g><text class="m" transform="translate(10 {middle:g}) rotate(-90)">{escape(panel.label)}</text>')
    drawn = "".join(draw(layer, x, y) for layer in panel.layers)
    out.append(f'<g class="layers" transform="scale({1 / SUBDIVISION:g})">{drawn}')
    labels = ""
    for label, value in (panel.levels or {}).items():
        at = y.pixels(value)
        out.append(
            f'<path class="level" d="M{LEFT * SUBDIVISION} {SUBDIVISION * at:.0f}H{(WIDTH - RIGHT) * SUBDIVISION}"/>'
        )
        labels += text(WIDTH - RIGHT - 2, at - 3, label, "e") if label else ""
    return "".join([*out, f"</g>{labels}</g>"])


def _scale(scale: Scale, label: str, kind: str) -> str:
    """Return the attribute that tells the page's script what an axis is."""
    ends = f"{scale.low:.9g},{scale.high:.9g},{scale.start:g},{scale.stop:g}"
    return f' data-scale="{ends},{kind},{escape(label)}"'


def _x_ticks(x: Scale, *, angle: bool) -> list[Tick]:
    step = tick_step(x.low, x.high, 6, angle=angle)
    return [(v, tick_label(v, step)) for v in ticks(x.low, x.high, 6, angle=angle)]


@lru_cache(maxsize=16)
def _y_ticks(low: float, high: float, height: int) -> list[Tick]:
    """Return as many ticks as fit, and at least two; panels of one chart have them in common."""
    count = max(3, height // 28)
    values = ticks(low, high, count)
    if len(values) < 2:
        count += 2
        values = ticks(low, high, count)
    step = tick_step(low, high, count)
    return [(v, tick_label(v, step)) for v in values]


def _decades(scale: Scale) -> list[Tick]:
    """Return ticks of an axis of logarithms."""
    values = log_ticks(10.0**scale.low, 10.0**scale.high)
    return [(math.log10(v), tick_label(v, v)) for v in values]


def _limits(panel: Panel) -> tuple[float, float]:
    if panel.limits is not None:
        return panel.limits
    arrays = [np.asarray(list((panel.levels or {}).values()), float)]
    for layer in panel.layers:
        if isinstance(layer, Band):
            arrays += [layer.low, layer.high]
        elif isinstance(layer, Means):
            arrays += [layer.mean - layer.half, layer.mean + layer.half]
        else:
            arrays.append(layer.y)
    return span(arrays)
