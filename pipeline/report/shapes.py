"""What stands in a panel of a chart, and how it is drawn: paths of whole drawing units, short and quick to write."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from pipeline.report.axes import Scale, thin
from pipeline.signal.rests import runs

if TYPE_CHECKING:
    from numpy.typing import NDArray

MAXIMUM_DOTS = 240
FEW = 300  # dots of their own, up to which they are drawn large
BUCKETS = 140
REACH = 6000  # drawing units: how far a point, or the step to it, may lie from 0


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

    ``y`` may be (n, k): its columns have the colours from ``colour`` on. ``mean`` adds the line of the buckets' means,
    which shows what is slow below the noise.
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    colour: int = 0
    mean: bool = False


@dataclass(frozen=True)
class Dots:
    """Values as dots, however many, each of which counts by itself; left out where not finite."""

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    colour: int = 0


@dataclass(frozen=True)
class Band:
    """The area between two curves."""

    x: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    colour: int = 0


@dataclass(frozen=True)
class Means:
    """Means as dots, each with a stroke of ``half`` to both sides; left out where not finite."""

    x: NDArray[np.float64]
    mean: NDArray[np.float64]
    half: NDArray[np.float64]
    colour: int = 0


Layer = Line | Samples | Dots | Band | Means


def draw(layer: Layer, x: Scale, y: Scale) -> str:
    """Return the path elements of a layer, in drawing units."""
    if isinstance(layer, Samples):
        return _samples(layer, x, y)
    if isinstance(layer, Means):
        return _means(layer, x, y)
    if isinstance(layer, Dots):
        known = np.isfinite(layer.x) & np.isfinite(layer.y)
        drawn = dots(x.units(layer.x[known]), y.units(layer.y[known]))
        return f'<path class="dots{" large" * (len(layer.x) <= FEW)} c{layer.colour}" d="{drawn}"/>'
    if isinstance(layer, Band):
        at, (low, high) = x.units(layer.x), y.units(np.array([layer.low, layer.high]))
        area = path(np.concatenate([at, at[::-1]]), np.concatenate([high, low[::-1]]))
        return f'<path class="band c{layer.colour}" d="{area}z"/>'
    lines = []
    for piece in _pieces(np.isfinite(layer.x) & np.isfinite(layer.y)):
        shown = thin(layer.y[piece])
        lines.append(path(x.units(layer.x[piece][shown]), y.units(layer.y[piece][shown])))
    return f'<path class="line c{layer.colour} {layer.style}" d="{"".join(lines)}"/>'


def _pieces(finite: NDArray[np.bool_]) -> list[slice]:
    """Return the stretches without a hole."""
    return [slice(0, len(finite))] if finite.all() else [slice(a, b) for a, b in runs(finite)]


def _means(layer: Means, x: Scale, y: Scale) -> str:
    known = np.isfinite(layer.mean) & np.isfinite(layer.half)
    mean, half = layer.mean[known], layer.half[known]
    at, (low, high, middle) = x.units(layer.x[known]), y.units(np.array([mean - half, mean + half, mean]))
    return (
        f'<path class="strokes faint-strokes c{layer.colour}" d="{strokes(at, low, high)}"/>'
        f'<path class="dots c{layer.colour}" d="{dots(at, middle)}"/>'
    )


def _samples(layer: Samples, x: Scale, y: Scale) -> str:
    columns = np.atleast_2d(layer.y.T)
    finite = np.isfinite(layer.x) & np.isfinite(columns)
    if finite.all():
        return _columns(layer, layer.x, columns, x, y)
    known = zip(columns, finite, strict=True)
    each = [Samples(layer.x[k], c[k], layer.colour + i, layer.mean) for i, (c, k) in enumerate(known)]
    return "".join(_columns(one, one.x, one.y[None], x, y) for one in each)


def _columns(layer: Samples, at: NDArray[np.float64], columns: NDArray[np.float64], x: Scale, y: Scale) -> str:
    """Return finite samples, (k, n), at (n,) places."""
    if len(at) <= MAXIMUM_DOTS:
        place = x.units(at)
        drawn = enumerate((dots(place, y.units(column)) for column in columns), layer.colour)
        return "".join(f'<path class="dots c{colour}" d="{d}"/>' for colour, d in drawn)
    size = -(-len(at) // BUCKETS)
    start = np.arange(0, len(at) // size * size, size)  # the last, smaller bucket is joined to the one before
    count = np.full(len(start), float(size))
    count[-1] += len(at) - size * len(start)
    found = np.empty((len(columns), 2 + layer.mean, len(start)))  # smallest, largest, mean
    for column, (low, high, *mean) in zip(columns, found, strict=True):
        np.minimum.reduceat(column, start, out=low)
        np.maximum.reduceat(column, start, out=high)
        if mean:
            np.divide(np.add.reduceat(column, start), count, out=mean[0])
    centre, out = x.units(np.add.reduceat(at, start) / count), []
    for colour, (low, high, *mean) in enumerate(y.units(found), layer.colour):
        faint = " faint-strokes" * layer.mean
        out.append(f'<path class="strokes c{colour}{faint}" d="{strokes(centre, low, high)}"/>')
        if mean:
            out.append(f'<path class="line c{colour}" d="{path(centre, mean[0])}"/>')
    return "".join(out)


def path(x: NDArray[np.int64], y: NDArray[np.int64]) -> str:
    """Return a path through points in drawing units, as differences (they are shorter)."""
    if len(x) < 2:
        return f"M{x[0]} {y[0]}h0" if len(x) else ""
    return f"M{x[0]} {y[0]}l" + _written(" % %", x[1:] - x[:-1], y[1:] - y[:-1])[1:]


def dots(x: NDArray[np.int64], y: NDArray[np.int64]) -> str:
    """Return a path of dots: lines of length zero, which round line ends make visible."""
    if len(x) == 0:
        return ""
    return f"M{x[0]} {y[0]}h0" + _written("m% %h0", x[1:] - x[:-1], y[1:] - y[:-1])


def strokes(x: NDArray[np.int64], low: NDArray[np.int64], high: NDArray[np.int64]) -> str:
    """Return a path of upright strokes from ``low`` to ``high``."""
    return _written("M% %V%", x, low, high)


def _written(form: str, *columns: NDArray[np.int64]) -> str:
    """Return the form for each row of the columns, their numbers in place of its signs ``%``.

    Texts come from a table, filled up with zero bytes, which are taken out at the end.
    """
    index = np.empty((len(columns[0]), len(columns)), np.int64)
    for j, numbers in enumerate(columns):
        np.add(numbers, REACH + j * (2 * REACH + 1), out=index[:, j])
    return _table(form).take(index, mode="clip").tobytes().translate(None, b"\0").decode("ascii")


@cache
def _table(form: str) -> NDArray[np.bytes_]:
    """Return the texts of -REACH .. REACH, for each sign ``%`` of a form once, with what stands before it."""
    numbers = _numbers()
    *before, after = (np.frombuffer(part.encode(), np.uint8) for part in form.split("%"))
    width = max(map(len, before)) + numbers.shape[1] + len(after)
    texts = np.zeros((len(before), len(numbers), width), np.uint8)
    for text, part in zip(texts, before, strict=True):
        text[:, : len(part)] = part
        text[:, len(part) : len(part) + numbers.shape[1]] = numbers
    texts[-1, :, width - len(after) :] = after
    return texts.view(f"S{width}").ravel()


@cache
def _numbers() -> NDArray[np.uint8]:
    """Return the characters of -REACH .. REACH: (2 REACH + 1, 5) array."""
    texts = np.array([b"%d" % n for n in range(-REACH, REACH + 1)])
    return texts.view(np.uint8).reshape(len(texts), -1)
