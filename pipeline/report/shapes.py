"""What stands in a panel of a chart, and how it is drawn: paths of whole drawing units, short and quick to write."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.report.axes import Scale, thin
from pipeline.signal.rests import runs

if TYPE_CHECKING:
    from numpy.typing import NDArray

MAXIMUM_DOTS = 240
FEW = 300  # dots of their own, up to which they are drawn large
BUCKETS = 140


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
        at, low, high = x.units(layer.x), y.units(layer.low), y.units(layer.high)
        area = path(np.r_[at, at[::-1]], np.r_[high, low[::-1]])
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
    at, mean, half = x.units(layer.x[known]), layer.mean[known], layer.half[known]
    bars = strokes(at, y.units(mean - half), y.units(mean + half))
    return (
        f'<path class="strokes faint-strokes c{layer.colour}" d="{bars}"/>'
        f'<path class="dots c{layer.colour}" d="{dots(at, y.units(mean))}"/>'
    )


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
    steps = _steps(x, y)
    return f"M{x[0]} {y[0]}l" + str(steps)[1:-1].replace(",", "") if steps else f"M{x[0]} {y[0]}h0"


def _steps(x: NDArray[np.int64], y: NDArray[np.int64]) -> list[int]:
    """Return dx, dy of each point from the one before, one after the other."""
    points = np.empty((len(x), 2), np.int64)
    points[:, 0], points[:, 1] = x, y
    steps: list[int] = (points[1:] - points[:-1]).ravel().tolist()
    return steps


def dots(x: NDArray[np.int64], y: NDArray[np.int64]) -> str:
    """Return a path of dots: lines of length zero, which round line ends make visible."""
    if len(x) == 0:
        return ""
    steps = _steps(x, y)
    return f"M{x[0]} {y[0]}h0" + ("m%d %dh0" * (len(x) - 1)) % tuple(steps)


def strokes(x: NDArray[np.int64], low: NDArray[np.int64], high: NDArray[np.int64]) -> str:
    """Return a path of upright strokes from ``low`` to ``high``."""
    numbers = np.stack([x, low, high], 1).ravel().tolist()
    return ("M%d %dV%d" * len(x)) % tuple(numbers)
