"""Charts as inline SVG: panels one above the other that share the axis x, with lines, dots, bands and levels.

A chart is text: no image, no script, no font, no other host. Colours are CSS classes of the page (``c0`` .. ``c5``), so
that a chart follows the page into the dark. Each has a title and a description in words for those who cannot see it.
"""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING

import numpy as np
from markupsafe import Markup

from pipeline.report.axes import (
    SUBDIVISION,
    Scale,
    span,
    thin,
    tick_label,
    tick_step,
    ticks,
)
from pipeline.signal.rests import runs

if TYPE_CHECKING:
    from numpy.typing import NDArray

WIDTH = 420
MAXIMUM_DOTS = 240
BUCKETS = 200
LEFT, RIGHT, TOP, BOTTOM, GAP = 58, 14, 8, 34, 10


@dataclass(frozen=True)
class Line:
    """Values joined by a line, broken where one is not finite. ``style`` is ``""``, ``dashed`` or ``model`` (thin)."""

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    colour: int = 0
    style: str = ""


@dataclass(frozen=True)
class Samples:
    """Single samples in their order: dots; where they are many, strokes from the smallest to the largest of a bucket.

    ``mean`` adds the line of the buckets' means, which shows what is slow below the noise.
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    colour: int = 0
    mean: bool = False


@dataclass(frozen=True)
class Band:
    """The area between two curves."""

    x: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    colour: int = 0


@dataclass(frozen=True)
class Panel:
    """One field of a chart.

    Attributes
    ----------
    layers : list of Line, Samples or Band
        Drawn in this order.
    label : str
        Of the axis y, with unit.
    height : int, px
    levels : dict of str to float
        Horizontal lines by their text.
    limits : (low, high), optional
        Of the axis y; from the layers where it is not given.
    """

    layers: list[Line | Samples | Band]
    label: str
    height: int = 140
    levels: dict[str, float] | None = None
    limits: tuple[float, float] | None = None


def chart(name: str, title: str, description: str, panels: list[Panel], x_label: str, *, angle: bool = False) -> Markup:
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
    """
    x = Scale(*span([layer.x for p in panels for layer in p.layers], 0.0), LEFT, WIDTH - RIGHT)
    parts, top = [], TOP
    for panel in panels:
        parts.append(_panel(panel, x, top, angle=angle))
        top += panel.height + GAP
    parts.append(_x_axis(x, top - GAP, x_label, angle=angle))
    return frame(name, title, description, top - GAP + BOTTOM, "".join(parts))


def frame(name: str, title: str, description: str, height: float, content: str) -> Markup:
    """Return the ``svg`` element with its text alternatives around drawn content."""
    name = escape(name)
    return Markup(  # noqa: S704  (every text in it is escaped where it is written)
        f'<svg class="chart" viewBox="0 0 {WIDTH} {height:g}" role="img" aria-labelledby="{name}-t {name}-d">'
        f'<title id="{name}-t">{escape(title)}</title><desc id="{name}-d">{escape(description)}</desc>{content}</svg>'
    )


def text(x: float, y: float, content: str, kind: str = "") -> str:
    """Return a text element; ``kind`` is its CSS class (``e`` right-aligned, ``m`` centred)."""
    return f'<text x="{x:.4g}" y="{y:.4g}" class="{kind}">{escape(content)}</text>'


def _panel(panel: Panel, x: Scale, top: float, *, angle: bool) -> str:
    bottom = top + panel.height
    y = Scale(*_limits(panel), bottom, top)
    step = tick_step(y.low, y.high, max(3, panel.height // 28))
    values = ticks(y.low, y.high, max(3, panel.height // 28))
    grid = "".join(f"M{LEFT} {y.pixels(v):.1f}H{WIDTH - RIGHT}" for v in values)
    grid += "".join(f"M{x.pixels(v):.1f} {top:g}V{bottom:g}" for v in ticks(x.low, x.high, 6, angle=angle))
    out = [f'<path class="grid" d="{grid}"/>']
    out += [text(LEFT - 4, y.pixels(v) + 3.5, tick_label(v, step), "e") for v in values]
    middle = (top + bottom) / 2
    out.append(f'<text class="m" transform="translate(10 {middle:g}) rotate(-90)">{escape(panel.label)}</text>')
    drawn = "".join(_draw(layer, x, y) for layer in panel.layers)
    out.append(f'<g transform="scale({1 / SUBDIVISION:g})">{drawn}</g>')
    for label, value in (panel.levels or {}).items():
        at = y.pixels(value)
        out.append(f'<path class="level" d="M{LEFT} {at:.1f}H{WIDTH - RIGHT}"/>')
        out.append(text(WIDTH - RIGHT - 2, at - 3, label, "e"))
    return "".join(out)


def _limits(panel: Panel) -> tuple[float, float]:
    if panel.limits is not None:
        return panel.limits
    arrays = [np.asarray(list((panel.levels or {}).values()), float)]
    for layer in panel.layers:
        arrays += [layer.low, layer.high] if isinstance(layer, Band) else [layer.y]
    return span(arrays)


def _x_axis(x: Scale, top: float, label: str, *, angle: bool) -> str:
    values, step = ticks(x.low, x.high, 6, angle=angle), tick_step(x.low, x.high, 6, angle=angle)
    out = [text(x.pixels(v), top + 13, tick_label(v, step), "m") for v in values]
    return "".join(out) + text((LEFT + WIDTH - RIGHT) / 2, top + 28, label, "m")


def _draw(layer: Line | Samples | Band, x: Scale, y: Scale) -> str:
    if isinstance(layer, Samples):
        return _samples(layer, x, y)
    if isinstance(layer, Band):
        finite = np.isfinite(layer.x) & np.isfinite(layer.low) & np.isfinite(layer.high)
        parts = [
            _band(x.units(layer.x[a:b]), y.units(layer.low[a:b]), y.units(layer.high[a:b])) for a, b in runs(finite)
        ]
        return f'<path class="band c{layer.colour}" d="{"".join(parts)}"/>'
    parts = []
    for a, b in runs(np.isfinite(layer.x) & np.isfinite(layer.y)):
        kept = a + thin(layer.y[a:b])
        parts.append(path(x.units(layer.x[kept]), y.units(layer.y[kept])))
    return f'<path class="line c{layer.colour} {layer.style}" d="{"".join(parts)}"/>'


def _band(at: NDArray[np.int64], low: NDArray[np.int64], high: NDArray[np.int64]) -> str:
    return path(np.concatenate([at, at[::-1]]), np.concatenate([high, low[::-1]])) + "z"


def _samples(layer: Samples, x: Scale, y: Scale) -> str:
    finite = np.isfinite(layer.x) & np.isfinite(layer.y)
    px, py = layer.x[finite], layer.y[finite]
    if len(px) <= MAXIMUM_DOTS:
        return f'<path class="dots c{layer.colour}" d="{dots(x.units(px), y.units(py))}"/>'
    size = -(-len(px) // BUCKETS)
    whole = len(px) // size  # the last, smaller bucket is joined to the one before
    start = np.arange(whole) * size
    count = np.diff(np.append(start, len(px)))
    centre = x.units(np.add.reduceat(px, start) / count)
    low, high = y.units(np.minimum.reduceat(py, start)), y.units(np.maximum.reduceat(py, start))
    out = f'<path class="strokes c{layer.colour}{" faint-strokes" * layer.mean}" d="{strokes(centre, low, high)}"/>'
    if layer.mean:
        mean = y.units(np.add.reduceat(py, start) / count)
        out += f'<path class="line c{layer.colour}" d="{path(centre, mean)}"/>'
    return out


def path(x: NDArray[np.int64], y: NDArray[np.int64]) -> str:
    """Return a path through points in drawing units, as differences (they are shorter)."""
    if len(x) == 0:
        return ""
    steps = np.stack([np.diff(x), np.diff(y)], 1).ravel().tolist()
    return f"M{x[0]} {y[0]}l" + str(steps)[1:-1].replace(",", "") if steps else f"M{x[0]} {y[0]}h0"


def dots(x: NDArray[np.int64], y: NDArray[np.int64]) -> str:
    """Return a path of dots: lines of length zero, which round line ends make visible."""
    if len(x) == 0:
        return ""
    steps = np.stack([np.diff(x), np.diff(y)], 1).ravel().tolist()
    return f"M{x[0]} {y[0]}h0" + ("m%d %dh0" * (len(x) - 1)) % tuple(steps)


def strokes(x: NDArray[np.int64], low: NDArray[np.int64], high: NDArray[np.int64]) -> str:
    """Return a path of upright strokes from ``low`` to ``high``."""
    numbers = np.stack([x, low, high], 1).ravel().tolist()
    return ("M%d %dV%d" * len(x)) % tuple(numbers)
