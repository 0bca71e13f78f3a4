"""Charts as inline SVG: panels one above the other on a common axis x, with lines, samples, dots, bands and levels.

Colours are CSS classes of the page (``c0`` to ``c5``), so that a chart follows the page's dark mode. The chart (axis x)
and each panel (axis y) have an attribute ``data-scale``: low, high, their positions in pixels, kind and label of the
axis. The script of the page uses it to read values and to zoom.

Coordinates are whole tenths of a pixel and paths are written as differences, which keeps a page small. Many samples are
drawn as the range from the smallest to the largest of equal buckets, so that no extreme is lost (S. Steinarsson,
Downsampling Time Series for Visual Representation, University of Iceland 2013, section 4.1). Each such path has all its
samples in ``data-full``, from which the script draws a zoom: 16-bit numbers (base64) from -32767 at the low end of the
axis to 32767 at the high end, -32768 for no value. ``data-full`` of the chart is x.

An axis is linear, logarithmic or symmetric logarithmic, with round ticks.
"""

from __future__ import annotations

import math
import re
from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from functools import cache, lru_cache
from html import escape
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup

from pipeline.core.records import Integers, Values
from pipeline.output.pages.pages import MINUS, template, typeset

SUBDIVISION = 10  # drawing units in a pixel
ANGLE_STEPS = (10.0, 15.0, 30.0, 45.0, 90.0, 180.0, 360.0, 720.0, 1800.0, 3600.0)  # deg, parts and multiples of a turn
LINEAR_TO = 10.0  # value to which a symlog axis is linear: delta BIC of strong evidence

Tick = tuple[float, str]
Legend = tuple[tuple[str, str], ...]
Places = dict[tuple[int, int], tuple[Values, Integers]]  # of ``_placed``
AXES_LEGEND = (("c0", "x"), ("c1", "y"), ("c2", "z"))
CHART_WIDTH = 420  # px, of the drawing; the page scales it
LEFT, RIGHT, TOP, BOTTOM, PANEL_GAP = 72, 14, 8, 36, 14  # px, margins of the panels and the gap between two
UPRIGHT = 28  # px, of height for each tick of axis y
MAXIMUM_DOTS = 240  # samples drawn as dots; about one in 1.4 px
BUCKETS = 140  # ranges drawn for more samples; about one in 2.4 px
MAXIMUM_FULL = 20_000  # samples of a curve in a page (53 kB); of more samples, the ends of half as many buckets
LARGE_DOTS, LARGE_MEANS = 300, 40  # dots, and dots with intervals, that have room to be large
LETTER = 6.2  # px, width of a letter
FORMATTED = 4999  # drawing units: in charts up to 500 px high, paths are joined of texts that were made before


@lru_cache(64)  # the panels of a chart often have one axis
def round_ticks(low: float, high: float, count: int = 5, kind: str = "") -> list[Tick]:
    """Return about ``count`` round values from ``low`` to ``high`` with their text.

    ``kind``: "angle" (deg) for parts of a turn, "count" for whole numbers.
    """
    coarse = max((high - low) / count, 1.0 if kind == "count" else 0.0)
    if kind == "angle" and coarse > 5.0:
        step = min(ANGLE_STEPS, key=lambda s: abs(math.log(s / coarse)))
    else:
        power = 10.0 ** math.floor(math.log10(coarse))
        steps = (1.0, 2.0, 5.0, 10.0) if kind == "count" else (1.0, 2.0, 2.5, 5.0, 10.0)
        step = power * next(s for s in steps if s * power >= coarse * 0.999)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [(n * step, tick_label(n * step, step)) for n in range(first, last + 1)]


def tick_label(value: float, step: float) -> str:
    """Return the text of a tick with the decimals that the step between two ticks needs."""
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
    return text.replace("-", MINUS)


def log_ticks(low: float, high: float) -> list[Tick]:
    """Return the powers of ten from ``low`` to ``high``; of fewer than two, also 2 and 5, or round values."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for factors in ((1,), (1, 2, 5)):
        values = [s * 10.0**k for k in decades for s in factors if low * 0.999 <= s * 10.0**k <= high * 1.001]
        if len(values) >= 2:
            return [(v, tick_label(v, v)) for v in values]
    return round_ticks(low, high)


def scaled(values: Any, kind: str) -> Values:  # noqa: ANN401  (numbers or an array)
    """Return values on the scale of an axis.

    ``log``: log10, -inf where v <= 0. ``symlog``: v / 10 where |v| <= 10, else sign(v) (1 + log10(|v| / 10)).
    """
    v = np.asarray(values, np.float64)
    if "log" not in kind:
        return v
    if kind == "log":
        return np.log10(v, out=np.full(v.shape, -np.inf), where=v > 0)
    size = np.abs(v) / LINEAR_TO
    return np.where(size <= 1.0, v / LINEAR_TO, np.copysign(1.0 + np.log10(np.maximum(size, 1.0)), v))


def _scaled(value: float, kind: str) -> float:
    """Return ``scaled`` of a number on a logarithmic axis, in a tenth of the time."""
    if kind == "log":
        return math.log10(value) if value > 0 else -math.inf
    size = abs(value) / LINEAR_TO
    return value / LINEAR_TO if size <= 1.0 else math.copysign(1.0 + math.log10(size), value)


class Axis(NamedTuple):
    """Maps values from ``low`` to ``high`` (on the scale of the axis) to pixels from ``start`` to ``stop``."""

    low: float
    high: float
    start: float
    stop: float
    kind: str = ""  # "", "angle" (deg), "count" (whole numbers), "log" or "symlog"

    @classmethod
    def over(cls, arrays: Iterable[Values], start: float, stop: float, kind: str = "", margin: float = 0.04) -> Axis:
        """Return an axis over the finite values, wider by ``margin`` on both sides; 0 to 1 without any value."""
        values = scaled(np.concatenate([np.zeros(0), *(a.ravel() for a in arrays)]), kind)
        if values.size and not math.isfinite(float(values.max()) - float(values.min())):
            values = values[np.isfinite(values)]
        if not values.size:
            return cls(0.0, 1.0, start, stop, kind)
        return cls.around(float(values.min()), float(values.max()), start, stop, kind=kind, margin=margin)

    @classmethod
    def around(cls, low: float, high: float, start: float, stop: float, *, kind: str, margin: float) -> Axis:
        """Return an axis over values from low to high, on the scale of the axis, wider by ``margin`` on both sides."""
        if high - low <= 1e-12 * max(abs(low), abs(high), 1e-300):
            half = 0.5 * abs(low) or 0.5
            return cls(low - half, high + half, start, stop, kind)
        wider = margin * (high - low)
        return cls(low - wider, high + wider, start, stop, kind)

    def pixels(self, value: float) -> float:
        """Return the position of a value, px; a value below the axis is drawn at its start."""
        v = _scaled(value, self.kind) if "log" in self.kind else value
        return self.start + (max(v, self.low) - self.low) / (self.high - self.low) * (self.stop - self.start)

    def units(self, values: Values) -> Integers:
        """Return the positions of values in whole drawing units; values beyond the axis are drawn at its end."""
        v = np.maximum(scaled(values, self.kind), self.low)
        np.minimum(v, self.high, out=v)
        v -= self.low
        v *= SUBDIVISION * (self.stop - self.start) / (self.high - self.low)
        v += SUBDIVISION * self.start
        return np.asarray(np.rint(v, out=v).astype(np.int64))

    def unit(self, value: float) -> int:
        """Return ``units`` of one value, in a fifth of the time."""
        v = min(max(_scaled(value, self.kind) if "log" in self.kind else value, self.low), self.high)
        factor = SUBDIVISION * (self.stop - self.start) / (self.high - self.low)
        return round((v - self.low) * factor + SUBDIVISION * self.start)

    def ticks(self, count: int, names: Sequence[str] = ()) -> list[Tick]:
        """Return at least two ticks as position (px) and text; ``names``: texts of the values 1, 2, ..."""
        if names:
            ticks = [(float(i), name) for i, name in enumerate(names, 1)]
        elif self.kind == "log":
            ticks = log_ticks(10.0**self.low, 10.0**self.high)
        elif self.kind == "symlog":
            decades = [sign * 10.0**k for sign in (-1, 1) for k in range(1, 9)]
            values = [v for v in (0.0, *decades) if self.low <= _scaled(v, self.kind) <= self.high]
            ticks = [(v, tick_label(v, LINEAR_TO)) for v in values]
        else:
            ticks = round_ticks(self.low, self.high, count, self.kind)
            if len(ticks) < 2:
                ticks = round_ticks(self.low, self.high, count + 2)
        return [(self.pixels(value), label) for value, label in ticks]

    def attribute(self, label: str, names: Sequence[str] = ()) -> str:
        """Return the attributes that describe the axis to the script of the page."""
        ticks = f' data-ticks="{escape("|".join(names))}"' if names else ""
        ends = f"{self.low:.9g},{self.high:.9g},{self.start:g},{self.stop:g}"
        return f' data-scale="{ends},{self.kind},{_escaped(label)}"{ticks}'


class Figure(NamedTuple):
    """The texts of a chart, and the chart once it is drawn.

    ``name``: identifier, unique on its page; ``finding``: the sentence above the chart, which states its result;
    ``caption``: the text below it, which explains its elements; ``legend``: CSS class and text of each colour;
    ``quiet``: nothing exceeds the noise, so the page folds the chart.
    """

    name: str
    finding: str
    caption: str = ""
    legend: Legend = ()
    quiet: bool = False
    svg: str = ""

    def drawn(self, description: str, height: float, content: str, attributes: str = "") -> Figure:
        """Return the figure with drawn content as its ``svg`` element; the description is for screen readers."""
        name, finding = escape(self.name), typeset(self.finding)
        svg = Markup(  # noqa: S704  (every text in it is escaped where it is written)
            f'<svg class="chart" viewBox="0 0 {CHART_WIDTH} {height:g}" role="img" aria-labelledby="{name}-t {name}-d"'
            f'{attributes}><title id="{name}-t">{escape(finding)}</title>'
            f'<desc id="{name}-d">{escape(typeset(description))}</desc>{content}</svg>'
        )
        return self._replace(svg=svg, finding=finding, caption=typeset(self.caption))


def worded(macro: str, name: str, legend: Legend = (), /, **values: Any) -> tuple[Figure, str]:  # noqa: ANN401
    """Return a figure with the texts of a macro in ``templates/figures.txt``, and its description."""
    text = str(getattr(template("figures.txt").module, macro)(**values))
    parts = (part.replace("\n", " ").split(" ") for part in text.split("---\n"))
    finding, caption, *description = (" ".join(filter(None, words)).strip() for words in parts)
    return Figure(name, finding, caption, legend), " ".join(description)


class LineMark(NamedTuple):
    """Values joined by a line, broken where one is not finite; ``style``: "", ``dashed``, ``model`` or ``thick``."""

    x: Values
    y: Values
    colour: int = 0
    style: str = ""


class SampleMarks(NamedTuple):
    """Samples in order, (n,) or (n, k) with a colour for each column, drawn as dots or as ranges of buckets.

    ``mean`` adds the line of the buckets' means, which shows slow changes below the noise.
    """

    x: Values
    y: Values
    colour: int = 0
    mean: bool = False


class Dots(NamedTuple):
    """Separate values, with an upright interval ``low`` to ``high`` where it is given.

    ``units``: index of each value in the list of the chart's units, counted from 1, where it is not x.
    """

    x: Values
    y: Values
    colour: int = 0
    low: Values | None = None
    high: Values | None = None
    units: tuple[int, ...] = ()


class Area(NamedTuple):
    """The area between two curves, or over the whole axis x from one value to another."""

    low: Values | float
    high: Values | float
    colour: int = 5
    x: Values | None = None


ChartLayer = LineMark | SampleMarks | Dots | Area


class Panel(NamedTuple):
    """One field of a chart: layers in the order in which they are drawn, and its axis y.

    ``height``: px; ``levels``: horizontal lines by their text; ``limits``: of the axis, by default from the layers;
    ``names``: x, y and text of points, left out where texts would overlap; ``rows``: names of y = 1, 2, ...
    """

    layers: list[ChartLayer]
    label: str
    height: int = 140
    levels: Mapping[str, float] | None = None
    limits: tuple[float, float] | None = None
    logarithmic: bool = False
    names: Sequence[tuple[float, float, str]] = ()
    rows: Sequence[str] = ()


def chart(
    figure: Figure,
    description: str,
    panels: list[Panel],
    x_label: str,
    *,
    kind: str = "",
    margin: float = 0.0,
    left: int = LEFT,
    columns: Sequence[str] = (),
    units: str = "",
) -> Figure:
    """Return a figure with its chart: panels that share the axis x.

    ``description``: for screen readers; ``kind``: of the axis x, "", "angle" (deg), "count" or "log"; ``margin``: share
    of the values' range by which the axis x exceeds it; ``left``: space for the ticks of the axes y, px; ``columns``:
    names of x = 1, 2, ...; ``units``: list in the script of the page that names the units.
    """
    values = {id(layer.x): layer.x for p in panels for layer in p.layers if layer.x is not None}
    x = Axis.over(values.values(), left, CHART_WIDTH - RIGHT, kind, margin)
    ticks = x.ticks(6, columns)
    parts, top = [], float(TOP)
    places: Places = {}
    for panel in panels:
        parts.append(_panel(panel, x, ticks, top, places))
        top += panel.height + PANEL_GAP
    labels = "".join(text(at, top - PANEL_GAP + 13, label, "m") for at, label in ticks)
    parts.append(f'<g class="ticks">{labels}</g>')
    parts.append(text((x.start + x.stop) / 2, top - PANEL_GAP + 28, x_label, "m"))
    attributes = x.attribute(x_label, columns) + (f' data-names="{units}"' if units else "")
    long = [one for p in panels for one in p.layers if isinstance(one, SampleMarks) and len(one.x) > MAXIMUM_DOTS]
    attributes += _full(long[0].x, long[0].x[:, None], x)[0] if long else ""
    return figure.drawn(description, top - PANEL_GAP + BOTTOM, "".join(parts), attributes)


def text(x: float, y: float, content: str, kind: str = "") -> str:
    """Return a text element; ``kind`` is its CSS class (``e`` right-aligned, ``m`` centred, ``b`` bold)."""
    return f'<text x="{x:.4g}" y="{y:.4g}" class="{kind}">{_escaped(content)}</text>'


@lru_cache(4096)  # as ``typeset``
def _escaped(content: str) -> str:
    return escape(typeset(content))


def _panel(panel: Panel, x: Axis, x_ticks: list[Tick], top: float, places: Places) -> str:
    bottom = top + panel.height
    kind, margin = "log" if panel.logarithmic else "", 0.04 if panel.limits is None else 0.0
    levels, limits = panel.levels or {}, panel.limits or ()
    stated = [*limits, *levels.values()]
    if limits and not kind and all(map(math.isfinite, stated)):
        y = Axis.around(min(stated), max(stated), bottom, top, kind=kind, margin=margin)
    else:
        heights = (getattr(layer, end, None) for layer in panel.layers for end in ("y", "low", "high"))
        values = [np.asarray(v) for v in heights if v is not None] if not limits else []
        y = Axis.over([*values, np.array(stated, float)], bottom, top, kind, margin)
    ticks = y.ticks(max(3, panel.height // UPRIGHT), panel.rows)
    start, stop, height = f"M{x.start:g} ", f"H{x.stop:g}", f" {top:g}V{bottom:g}"
    grid = "".join([f"{start}{at:.1f}{stop}" for at, _ in ticks] + [f"M{at:.1f}{height}" for at, _ in x_ticks])
    labels = "".join(text(x.start - 4, at + 3.5, label, "e") for at, label in ticks)
    drawn = "".join([_draw(layer, x, y, places) for layer in panel.layers])
    names = _names(panel.names, x, y)
    for label, value in levels.items():
        at = y.pixels(value)
        ends = f"M{x.start * SUBDIVISION:g} {SUBDIVISION * at:.0f}H{x.stop * SUBDIVISION:g}"
        drawn += f'<path class="level" d="{ends}"/>'
        names += text(x.stop - 2, at - 3, label, "e") if label else ""
    middle = (top + bottom) / 2
    return (
        f'<g class="panel"{y.attribute(panel.label, panel.rows)}><path class="grid" d="{grid}"/>'
        f'<g class="ticks">{labels}</g>'
        f'<text class="m" transform="translate(12 {middle:g}) rotate(-90)">{_escaped(panel.label)}</text>'
        f'<g class="layers" transform="scale({1 / SUBDIVISION:g})">{drawn}</g>{names}</g>'
    )


def _draw(layer: ChartLayer, x: Axis, y: Axis, places: Places) -> str:
    if isinstance(layer, Area) and layer.x is None:
        low, high = y.unit(float(layer.low)), y.unit(float(layer.high))
        start, stop = int(SUBDIVISION * x.start), int(SUBDIVISION * x.stop)
        path = f"M{start} {low}l{stop - start} 0 0 {high - low} {start - stop} 0z"
        return f'<path class="band c{layer.colour}" d="{path}"/>'
    if isinstance(layer, Area):
        at = x.units(np.asarray(layer.x))
        low, high = y.units(np.array([np.broadcast_to(end, len(at)) for end in (layer.low, layer.high)]))
        path = _line(np.concatenate([at, at[::-1]]), np.concatenate([low, high[::-1]]))
        return f'<path class="band c{layer.colour}" d="{path}z"/>'
    if isinstance(layer, SampleMarks):
        return _samples(layer, layer.y if layer.y.ndim > 1 else layer.y[:, None], x, y, places)
    heights: tuple[Values | None, ...] = (layer.y,) if isinstance(layer, LineMark) else (layer.y, layer.low, layer.high)
    values, known = np.array([v for v in heights if v is not None]), None
    if np.isfinite(layer.x).all() and np.isfinite(layer.y).all():
        at = _placed(layer.x, x, places)
    else:
        known = np.flatnonzero(np.isfinite(layer.x) & np.isfinite(layer.y))
        at, values = x.units(layer.x[known]), values[:, known]
    value, *ends = y.units(values)
    if isinstance(layer, LineMark):
        path = _line(at, value, None if known is None else np.flatnonzero(np.diff(known) > 1) + 1)
        return f'<path class="line c{layer.colour} {layer.style}" d="{path}"/>'
    path, room = "", LARGE_DOTS
    if len(ends) == 2:
        path = f'<path class="strokes interval c{layer.colour}" d="{_path("M%d %dV%d", at, *ends)}"/>'
        room = LARGE_MEANS
    size = " large" * (len(layer.x) <= room)
    names = layer.units if known is None else [layer.units[i] for i in known] if layer.units else ()
    units = f' data-units="{" ".join(map(str, names))}"' if layer.units else ""
    return f'{path}<path class="dots{size} c{layer.colour}" d="{_dots(at, value)}"{units}/>'


def _samples(layer: SampleMarks, values: Values, x: Axis, y: Axis, places: Places) -> str:
    """Return columns of samples, (n, k), as dots, or as the ranges of buckets."""
    known_x, known_y = layer.x, values
    if not (np.isfinite(values).all() and np.isfinite(known_x).all()):
        known = np.isfinite(values) & np.isfinite(layer.x)[:, None]
        if (known != known[:, :1]).any():  # each column has samples of its own
            each = enumerate(values.T, layer.colour)
            return "".join(_samples(layer._replace(colour=c), v[:, None], x, y, places) for c, v in each)
        known_x, known_y = layer.x[known[:, 0]], values[known[:, 0]]
    colours = range(layer.colour, layer.colour + values.shape[1])
    if len(known_x) <= MAXIMUM_DOTS:
        at, dots = _placed(known_x, x, places), y.units(known_y.T)
        return "".join(f'<path class="dots c{c}" d="{_dots(at, v)}"/>' for c, v in zip(colours, dots, strict=True))
    start, count = _buckets(len(known_x), BUCKETS)
    at = _placed(known_x, x, places, BUCKETS)
    ends = [end.reduceat(known_y, start) for end in (np.minimum, np.maximum)]
    means = [np.add.reduceat(known_y, start) / count[:, None]] if layer.mean else []
    columns, full_of = y.units(np.array([*ends, *means])).transpose(2, 0, 1), _full(layer.x, values, y)
    faint, out = " faint-strokes" * layer.mean, []
    for c, column, full in zip(colours, columns, full_of, strict=True):
        low, high, *mean = list(column)
        out.append(f'<path class="strokes c{c}{faint}" d="{_path("M%d %dV%d", at, low, high)}"{full}/>')
        out += [f'<path class="line mean c{c}" d="{_line(at, v)}"/>' for v in mean]
    return "".join(out)


def _placed(values: Values, x: Axis, places: Places, most: int = 0) -> Integers:
    """Return ``units`` of finite values, or of the means of ``most`` buckets; once for all layers of a chart."""
    if (id(values), most) not in places:
        start, count = _buckets(len(values), most) if most else (None, None)
        means = values if start is None else np.add.reduceat(values, start) / count
        places[id(values), most] = values, x.units(means)  # with the values, whose identity no other array then gets
    return places[id(values), most][1]


@lru_cache(16)  # the recordings of many units are equally long
def _buckets(samples: int, most: int) -> tuple[Integers, Integers]:
    """Return start and length of equal buckets; the last one also contains the remainder."""
    size = -(-samples // most)
    start = np.arange(0, samples // size * size, size)
    return start, np.diff(np.append(start, samples))


def _full(x: Values, values: Values, axis: Axis) -> list[str]:
    """Return all values of curves, (n, k), as attributes ``data-full``; of too many, both ends of each bucket."""
    if len(values) > MAXIMUM_FULL:
        start, _ = _buckets(len(values), MAXIMUM_FULL // 2)
        of_x = np.may_share_memory(values, x)
        ends = [x[start, None]] * 2 if of_x else [end.reduceat(values, start) for end in (np.fmin, np.fmax)]
        values = np.stack(ends, 1).reshape(-1, values.shape[1])
    clipped = np.minimum(np.maximum(values.T, axis.low, order="C"), axis.high)
    share = (clipped - axis.low) / (axis.high - axis.low)
    numbers = np.where(np.isnan(share), -32768.0, np.rint((2.0 * share - 1.0) * 32767.0)).astype("<i2")
    return [f' data-full="{b64encode(column.tobytes()).decode()}"' for column in numbers]


def _line(x: Integers, y: Integers, breaks: Integers | None = None) -> str:
    """Return the path through points, written as differences; it begins again at ``breaks``."""
    if breaks is not None and breaks.size:
        ends = [0, *breaks.tolist(), len(x)]
        if ends == [*range(0, len(x) + 1, 2)]:  # the chart of rests
            return _path("M%d %dl%d %d", x[::2], y[::2], x[1::2] - x[::2], y[1::2] - y[::2])
        return "".join(_line(x[i:j], y[i:j]) for i, j in pairwise(ends))
    if len(x) < 2:
        return _dots(x, y)
    return f"M{x[0]} {y[0]}l{_path(' %d %d', x[1:] - x[:-1], y[1:] - y[:-1])[1:]}"


def _dots(x: Integers, y: Integers) -> str:
    """Return a path of dots: lines of length zero, which are visible by their round ends."""
    return f"M{x[0]} {y[0]}h0{_path('m%d %dh0', x[1:] - x[:-1], y[1:] - y[:-1])}" if len(x) else ""


def _path(form: str, *columns: Integers) -> str:
    """Return the form, filled once for each row of the columns."""
    values = np.array(columns)
    if not values.size or (values + FORMATTED).view(np.uint64).max() > 2 * FORMATTED:
        return form * len(columns[0]) % tuple(values.T.ravel().tolist())
    texts, zeros = _texts(form)
    return texts.take(values.T + zeros).tobytes().translate(None, b"\0").decode()


@cache
def _texts(form: str) -> tuple[Integers, Integers]:
    """Return each piece of a form filled with each number, as its eight bytes, and the index of the 0 of each piece."""
    numbers = np.arange(-FORMATTED, FORMATTED + 1).astype("S5").view(np.uint8).reshape(-1, 5)
    pieces = re.findall(r"(\D)%d(h0)?", form)
    texts = np.zeros((len(pieces), len(numbers), 8), np.uint8)
    for text, (letter, end) in zip(texts, pieces, strict=True):
        text[:, 0], text[:, 1:6], text[:, 6 : 6 + len(end)] = ord(letter), numbers, list(end.encode())
    return texts.view(np.int64).ravel(), FORMATTED + len(numbers) * np.arange(len(pieces))


def _names(points: Sequence[tuple[float, float, str]], x: Axis, y: Axis) -> str:
    """Return the names of points, each 11 px high, without those that would overlap an earlier one."""
    drawn: list[tuple[float, float, float]] = []
    out = []
    for px, py, name in points:
        width, left, base = LETTER * len(name), x.pixels(px) + 6.0, y.pixels(py) - 5.0
        left = left if left + width <= CHART_WIDTH - 2 else x.pixels(px) - 6.0 - width
        if all(abs(base - b) > 11.0 or left > a + w or a > left + width for a, b, w in drawn):
            drawn.append((left, base, width))
            out.append(text(left, base, name, "b"))
    return "".join(out)
