"""Charts as inline SVG: panels one above the other on a common x axis, with lines, samples, dots, bands and levels.

A chart is text without images or fonts. Colours are CSS classes of the page (``c0`` to ``c5``), so that a chart follows
the page's dark mode. Each chart has a title and a description for screen readers. The chart (axis x) and each panel
(axis y) have an attribute ``data-scale``: low, high, their places in pixels, kind and label of the axis. From it the
page's script reads values and zooms.

Coordinates are whole tenths of a pixel and paths are written as differences, which keeps a page small. Where samples
are many, they are drawn as the range from the smallest to the largest of equal buckets, so that no extreme is lost
(S. Steinarsson, Downsampling Time Series for Visual Representation, University of Iceland 2013, section 4.1).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

JSON = dict[str, Any]
AXES_LEGEND = (("c0", "x"), ("c1", "y"), ("c2", "z"))
WIDTH = 420  # px, of the drawing; the page scales it
LEFT, RIGHT, TOP, BOTTOM, GAP = 64, 14, 8, 36, 14  # px, margins of the panels and the gap between two
UPRIGHT = 28  # px, of height for each tick of axis y
SUBDIVISION = 10  # drawing units in a pixel
MAXIMUM_DOTS = 240  # samples that are drawn as dots; about one in 1.4 px
BUCKETS = 140  # ranges that are drawn of more samples; about one in 2.4 px
LARGE_DOTS, LARGE_MEANS = 300, 20  # dots, and dots with intervals, that have room to be large
ANGLE_STEPS = (10.0, 15.0, 30.0, 45.0, 90.0, 180.0, 360.0, 720.0, 1800.0, 3600.0)  # deg, parts and multiples of a turn

Tick = tuple[float, str]


@dataclass(frozen=True)
class Figure:
    """A chart with its texts.

    ``caption``: what is drawn, below the chart; ``legend``: CSS class and text of each colour; ``finding``: what the
    chart shows, in one sentence above it; ``quiet``: nothing is seen beyond noise, so that the page folds it.
    """

    svg: Markup
    caption: str = ""
    legend: tuple[tuple[str, str], ...] = ()
    finding: str = ""
    quiet: bool = False


@lru_cache(maxsize=64)
def round_ticks(low: float, high: float, count: int = 5, *, angle: bool = False) -> list[Tick]:
    """Return about ``count`` round values from ``low`` to ``high`` with their text; angles (deg) at parts of a turn."""
    coarse = (high - low) / count
    if angle and coarse > 5.0:
        step = min(ANGLE_STEPS, key=lambda s: abs(math.log(s / coarse)))
    else:
        power = 10.0 ** math.floor(math.log10(coarse))
        step = power * next(s for s in (1.0, 2.0, 2.5, 5.0, 10.0) if s * power >= coarse * 0.999)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [(n * step, tick_label(n * step, step)) for n in range(first, last + 1)]


def tick_label(value: float, step: float) -> str:
    """Return the text of a tick with the decimals that the distance of two ticks needs."""
    if value == 0:
        return "0"
    if step < 2e-4 or abs(value) >= 1e6:
        mantissa, exponent = f"{value:.1e}".split("e")
        text = f"{mantissa.removesuffix('.0')}e{int(exponent)}"
    else:
        decimals = max(0, -math.floor(math.log10(step) + 1e-9))
        if not math.isclose(round(step, decimals), step, rel_tol=1e-6):
            decimals += 1
        text = f"{value:.{decimals}f}"
    return text.replace("-", "\N{MINUS SIGN}")


def log_ticks(low: float, high: float) -> list[Tick]:
    """Return the powers of ten from ``low`` to ``high``; where they are few, also 2 and 5, or round values."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for factors in ((1,), (1, 2, 5)):
        values = [s * 10.0**k for k in decades for s in factors if low * 0.999 <= s * 10.0**k <= high * 1.001]
        if len(values) >= 2:
            return [(v, tick_label(v, v)) for v in values]
    return round_ticks(low, high)


@dataclass(frozen=True)
class Axis:
    """From values ``low`` to ``high`` (their log10 on a logarithmic axis) to pixels ``start`` to ``stop``."""

    low: float
    high: float
    start: float
    stop: float
    kind: str = ""  # "", "angle" (deg) or "log"

    @classmethod
    def over(
        cls, arrays: Iterable[NDArray[np.float64]], start: float, stop: float, kind: str = "", margin: float = 0.04
    ) -> Axis:
        """Return an axis over the finite values, wider by ``margin`` on both sides; 0 to 1 without any value."""
        values = np.concatenate([np.zeros(0), *(np.ravel(a) for a in arrays)])
        values = _logarithm(values) if kind == "log" else values
        finite = values[np.isfinite(values)]
        low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
        if high - low <= 1e-12 * max(abs(low), abs(high), 1e-300):
            half = 0.5 * abs(low) or 0.5
            return cls(low - half, high + half, start, stop, kind)
        wider = margin * (high - low) if finite.size else 0.0
        return cls(low - wider, high + wider, start, stop, kind)

    def pixels(self, value: float) -> float:
        """Return the place of a value, px."""
        at = value
        if self.kind == "log":
            at = math.log10(value) if value > 0 else self.low
        return self.start + (max(at, self.low) - self.low) / (self.high - self.low) * (self.stop - self.start)

    def units(self, values: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the places of values in whole drawing units; values beyond the axis stand at its end."""
        at = np.clip(_logarithm(values) if self.kind == "log" else values, self.low, self.high)
        slope = SUBDIVISION * (self.stop - self.start) / (self.high - self.low)
        units: NDArray[np.int64] = np.rint((at - self.low) * slope + SUBDIVISION * self.start).astype(np.int64)
        return units

    def ticks(self, count: int) -> list[Tick]:
        """Return at least two ticks as place (px) and text."""
        if self.kind == "log":
            found = log_ticks(10.0**self.low, 10.0**self.high)
        else:
            found = round_ticks(self.low, self.high, count, angle=self.kind == "angle")
            if len(found) < 2:
                found = round_ticks(self.low, self.high, count + 2)
        return [(self.pixels(value), label) for value, label in found]

    def attribute(self, label: str) -> str:
        """Return the attribute from which the page's script knows the axis."""
        return f' data-scale="{self.low:.9g},{self.high:.9g},{self.start:g},{self.stop:g},{self.kind},{escape(label)}"'


def _logarithm(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return log10, -inf for values that are not positive."""
    out = np.full(np.shape(values), -np.inf)
    return np.log10(values, out=out, where=np.asarray(values) > 0)


@dataclass(frozen=True)
class Line:
    """Values joined by a line, broken where one is not finite. ``style`` is ``""``, ``dashed`` or ``model`` (thin)."""

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    colour: int = 0
    style: str = ""


@dataclass(frozen=True)
class Samples:
    """Samples in their order, (n,) or (n, k) with a colour for each column: dots, or ranges of buckets.

    ``mean`` adds the line of the buckets' means, which shows slow changes below the noise.
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    colour: int = 0
    mean: bool = False


@dataclass(frozen=True)
class Dots:
    """Values that each count by themselves, with an upright interval ``low`` to ``high`` where it is given."""

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    colour: int = 0
    low: NDArray[np.float64] | None = None
    high: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class Band:
    """The area from ``low`` to ``high`` over the whole axis x."""

    low: float
    high: float
    colour: int = 5


Layer = Line | Samples | Dots | Band


@dataclass(frozen=True)
class Panel:
    """One field of a chart.

    Attributes
    ----------
    layers : list of Line, Samples, Dots or Band
        Drawn in this order.
    label : str
        Of the axis y, with unit.
    height : int, px
    levels : dict of str to float
        Horizontal lines by their text.
    limits : (low, high), optional
        Of the axis y; from the layers where it is not given.
    logarithmic : bool
    names : list of (x, y, text)
        Texts beside points; one that would cover another is left out.
    """

    layers: list[Layer]
    label: str
    height: int = 140
    levels: dict[str, float] | None = None
    limits: tuple[float, float] | None = None
    logarithmic: bool = False
    names: list[tuple[float, float, str]] | None = None


def chart(
    name: str,
    title: str,
    description: str,
    panels: list[Panel],
    x_label: str,
    *,
    kind: str = "",
    margin: float = 0.0,
    names: str = "",
) -> Markup:
    """Return a chart of panels that share the axis x.

    Parameters
    ----------
    name : str
        Identifier, unique on its page.
    title, description : str
        Text alternatives: what the chart is, and what it shows.
    panels : list of Panel
    x_label : str
    kind : str
        Of the axis x: "", "angle" (deg) or "log".
    margin : float
        By which axis x is wider than the values, as a share of their range.
    names : str
        List of the page's script that names what stands at x = 1, 2, ...
    """
    values = {id(layer.x): layer.x for p in panels for layer in p.layers if not isinstance(layer, Band)}
    x = Axis.over(values.values(), LEFT, WIDTH - RIGHT, kind, margin)
    ticks = x.ticks(6)
    parts, top = [], float(TOP)
    for panel in panels:
        parts.append(_panel(panel, x, ticks, top))
        top += panel.height + GAP
    labels = "".join(text(at, top - GAP + 13, label, "m") for at, label in ticks)
    parts.append(f'<g class="ticks">{labels}</g>')
    parts.append(text((LEFT + WIDTH - RIGHT) / 2, top - GAP + 28, x_label, "m"))
    attributes = x.attribute(x_label) + (f' data-names="{names}"' if names else "")
    return svg(name, title, description, top - GAP + BOTTOM, "".join(parts), attributes=attributes)


def svg(name: str, title: str, description: str, height: float, content: str, *, attributes: str = "") -> Markup:
    """Return the ``svg`` element with its text alternatives around drawn content."""
    name = escape(name)
    return Markup(  # noqa: S704  (every text in it is escaped where it is written)
        f'<svg class="chart" viewBox="0 0 {WIDTH} {height:g}" role="img" aria-labelledby="{name}-t {name}-d"'
        f'{attributes}><title id="{name}-t">{escape(title)}</title><desc id="{name}-d">{escape(description)}</desc>'
        f"{content}</svg>"
    )


def text(x: float, y: float, content: str, kind: str = "") -> str:
    """Return a text element; ``kind`` is its CSS class (``e`` right-aligned, ``m`` centred, ``b`` bold)."""
    return f'<text x="{x:.4g}" y="{y:.4g}" class="{kind}">{escape(content)}</text>'


def upright_text(middle: float, content: str) -> str:
    """Return the label of an axis y."""
    return f'<text class="m" transform="translate(10 {middle:g}) rotate(-90)">{escape(content)}</text>'


def _panel(panel: Panel, x: Axis, x_ticks: list[Tick], top: float) -> str:
    """Return a panel: grid, ticks, layers, levels and names."""
    bottom = top + panel.height
    kind, margin = "log" if panel.logarithmic else "", 0.04 if panel.limits is None else 0.0
    values = [np.array(panel.limits)] if panel.limits else [v for layer in panel.layers for v in _heights(layer)]
    levels = panel.levels or {}
    y = Axis.over([*values, np.array([*levels.values()], float)], bottom, top, kind, margin)
    ticks = y.ticks(max(3, panel.height // UPRIGHT))
    grid = "".join([f"M{LEFT} {at:.1f}H{WIDTH - RIGHT}" for at, _ in ticks])
    grid += "".join([f"M{at:.1f} {top:g}V{bottom:g}" for at, _ in x_ticks])
    labels = "".join([text(LEFT - 4, at + 3.5, label, "e") for at, label in ticks])
    drawn = "".join([_draw(layer, x, y) for layer in panel.layers])
    names = _names(panel.names or [], x, y)
    for label, value in levels.items():
        at = y.pixels(value)
        ends = f"M{LEFT * SUBDIVISION} {SUBDIVISION * at:.0f}H{(WIDTH - RIGHT) * SUBDIVISION}"
        drawn += f'<path class="level" d="{ends}"/>'
        names += text(WIDTH - RIGHT - 2, at - 3, label, "e") if label else ""
    return (
        f'<g class="panel"{y.attribute(panel.label)}><path class="grid" d="{grid}"/><g class="ticks">{labels}</g>'
        f"{upright_text((top + bottom) / 2, panel.label)}"
        f'<g class="layers" transform="scale({1 / SUBDIVISION:g})">{drawn}</g>{names}</g>'
    )


def _heights(layer: Layer) -> list[NDArray[np.float64]]:
    """Return the values of a layer along axis y."""
    if isinstance(layer, Band):
        return [np.array([layer.low, layer.high])]
    ends = (layer.low, layer.high) if isinstance(layer, Dots) else ()
    return [layer.y, *(end for end in ends if end is not None)]


def _draw(layer: Layer, x: Axis, y: Axis) -> str:
    """Return the path elements of a layer."""
    if isinstance(layer, Band):
        low, high = y.units(np.array([layer.low, layer.high]))
        left, right = SUBDIVISION * x.start, SUBDIVISION * x.stop
        return f'<path class="band c{layer.colour}" d="M{left:g} {low}H{right:g}V{high}H{left:g}z"/>'
    if isinstance(layer, Samples):
        columns = enumerate(np.atleast_2d(layer.y.T), layer.colour)
        return "".join([_samples(layer, column, f"c{colour}", x, y) for colour, column in columns])
    known = np.flatnonzero(np.isfinite(layer.x) & np.isfinite(layer.y))
    if isinstance(layer, Line):
        pieces = np.split(known, np.flatnonzero(np.diff(known) > 1) + 1)
        path = "".join([_line(x.units(layer.x[piece]), y.units(layer.y[piece])) for piece in pieces])
        return f'<path class="line c{layer.colour} {layer.style}" d="{path}"/>'
    at, path, room = x.units(layer.x[known]), "", LARGE_DOTS
    if layer.low is not None and layer.high is not None:
        low, high, room = y.units(layer.low[known]), y.units(layer.high[known]), LARGE_MEANS
        path = f'<path class="strokes faint-strokes c{layer.colour}" d="{_path("M%d %dV%d", at, low, high)}"/>'
    size = " large" * (len(layer.x) <= room)
    return f'{path}<path class="dots{size} c{layer.colour}" d="{_dots(at, y.units(layer.y[known]))}"/>'


def _samples(layer: Samples, values: NDArray[np.float64], colour: str, x: Axis, y: Axis) -> str:
    """Return one column of samples as dots, or as the ranges of buckets."""
    at, known = layer.x, np.isfinite(layer.x) & np.isfinite(values)
    if not known.all():
        at, values = at[known], values[known]
    if len(at) <= MAXIMUM_DOTS:
        return f'<path class="dots {colour}" d="{_dots(x.units(at), y.units(values))}"/>'
    size = -(-len(at) // BUCKETS)
    start = np.arange(0, len(at) // size * size, size)  # the last bucket also takes the remainder
    count = np.diff(np.append(start, len(at)))
    centre = x.units(np.add.reduceat(at, start) / count)
    low, high = (y.units(end.reduceat(values, start)) for end in (np.minimum, np.maximum))
    faint = " faint-strokes" * layer.mean
    out = f'<path class="strokes {colour}{faint}" d="{_path("M%d %dV%d", centre, low, high)}"/>'
    if layer.mean:
        means = y.units(np.add.reduceat(values, start) / count)
        out += f'<path class="line {colour}" d="{_line(centre, means)}"/>'
    return out


def _line(x: NDArray[np.int64], y: NDArray[np.int64]) -> str:
    """Return the path through points, as differences."""
    if len(x) < 2:
        return _dots(x, y)
    return f"M{x[0]} {y[0]}l{_path(' %d %d', np.diff(x), np.diff(y))[1:]}"


def _dots(x: NDArray[np.int64], y: NDArray[np.int64]) -> str:
    """Return a path of dots: lines of length zero, which round line ends make visible."""
    return f"M{x[0]} {y[0]}h0{_path('m%d %dh0', np.diff(x), np.diff(y))}" if len(x) else ""


def _path(form: str, *columns: NDArray[np.int64]) -> str:
    """Return the form once for each row of the columns."""
    return form * len(columns[0]) % tuple(np.stack(columns, 1).ravel().tolist())


def _names(points: list[tuple[float, float, str]], x: Axis, y: Axis) -> str:
    """Return the names of points; a name is 6.2 px a letter wide, and takes 11 px of height."""
    taken: list[tuple[float, float, float]] = []
    out = []
    for px, py, name in points:
        width, left, at = 6.2 * len(name), x.pixels(px) + 6.0, y.pixels(py) - 5.0
        left = left if left + width <= WIDTH - 2 else x.pixels(px) - 6.0 - width
        if all(abs(at - b) > 11.0 or left > a + w or a > left + width for a, b, w in taken):
            taken.append((left, at, width))
            out.append(text(left, at, name, "b"))
    return "".join(out)
