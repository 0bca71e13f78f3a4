"""Strip plots of fitted parameters: each unit a dot, as a share of its data sheet's limit, beside its siblings.

    share = value / limit

Siblings are units of one sensor model that were calibrated by one method. A row is a parameter of the measurement:
bias, error of a scale factor, or what one axis reads of another.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.records import SENSORS
from pipeline.report.chart import Area, Dots, Figure, Layer, Panel, chart
from pipeline.report.numbers import number, percent, plain, unit_text
from pipeline.report.parameters import parameter_rows

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

JSON = dict[str, Any]
Placed = dict[str, tuple[float, float, str]]  # row of the plot: value, limit, unit
EDGE = 3.0  # share at which a dot stands at most: one unit in a wrong unit of measurement must not hide the others
FEWEST, MOST = 3, 60  # siblings, below which there is no plot, and above which only the farthest are drawn
FARTHEST = 20  # units that are drawn of each parameter then, on either side
ROW, LEFT = 17, 130  # px
SPREAD, HALF = 0.6, 0.42  # of a row: over which the units stand in their order, and half of its bar's height


@dataclass(frozen=True)
class Strips:
    """Strip plots, and what the page tells of each dot: figure and colour to texts in the order of the dots."""

    figures: list[Figure]
    dots: dict[str, dict[str, list[str]]]


def against_limits(calibration: JSON, sheet: JSON) -> dict[str, Placed]:
    """Return for each sensor the parameters that its data sheet limits; ``sheet`` is the section ``sensor``."""
    found = {}
    for sensor in SENSORS:
        rows = parameter_rows(calibration[sensor], sheet.get(sensor) or {}) if calibration.get(sensor) else []
        limited = ((r["name"], r["p"], r["limit"]) for r in rows if r["limit"])
        found[sensor] = {
            sys.intern(name): (p.value, limit, sys.intern(unit_text(p.unit))) for name, p, limit in limited
        }
    return found


def strips(rows: Sequence[JSON], placed: Mapping[str, Mapping[str, Placed]]) -> Strips:
    """Return the strip plots of a campaign.

    ``rows``: one a unit, as of ``summary_row``, in the order of the page; ``placed``: unit to its parameters, as of
    ``against_limits``.
    """
    siblings: dict[tuple[str, str], list[int]] = {}
    for i, row in enumerate(rows):
        if row["status"] == "ok" and row["unit"] in placed:
            siblings.setdefault((row.get("sensor") or "", row.get("method") or ""), []).append(i)
    out = Strips([], {})
    for (model, method), members in siblings.items():
        for sensor in SENSORS:
            known = [(i, placed[rows[i]["unit"]][sensor]) for i in members if placed[rows[i]["unit"]].get(sensor)]
            if len(known) >= FEWEST:
                name, title = f"strip-{len(out.figures) + 1}", f"{sensor.capitalize()}, {model}, {plain(method)}"
                figure, out.dots[name] = _figure(name, title, [r["unit"] for r in rows], known)
                out.figures.append(figure)
    return out


def _figure(
    name: str, title: str, units: list[str], known: list[tuple[int, Placed]]
) -> tuple[Figure, dict[str, list[str]]]:
    """Return the plot of some siblings and the text of each dot."""
    labels = list(dict.fromkeys(label for _, of in known for label in of))
    share = np.array([[of[k][0] / of[k][1] if k in of else np.nan for k in labels] for _, of in known])
    numbers = np.array([i for i, _ in known])
    at = len(labels) - np.arange(len(labels), dtype=float)  # the first row on top
    down = SPREAD * (0.5 - (np.arange(len(known)) + 0.5) / len(known))
    drawn = np.isfinite(share)
    layers = [_bar(np.array([-1.0, 1.0]), 0.4, at[0] + 0.6, 4)]
    if many := len(known) > MOST:
        rank = np.argsort(np.argsort(share, axis=0), axis=0)
        drawn &= (rank < FARTHEST) | (rank >= drawn.sum(axis=0) - FARTHEST)
        ends = np.nanquantile(share, [0.05, 0.95], axis=0).T
        layers += [_bar(each, row - HALF, row + HALF, 3) for row, each in zip(at, ends, strict=True)]
    beyond, values, legend = np.abs(share) > 1.0, {}, []
    dots: list[Layer] = []
    for chosen, colour, words in ((drawn & ~beyond, 2, "within the limit"), (drawn & beyond, 0, "beyond the limit")):
        i, j = np.nonzero(chosen)
        if len(i):
            x = 100.0 * np.clip(share[i, j], -EDGE, EDGE)
            dots.append(Dots(x, at[j] + down[i], colour, units=tuple((numbers[i] + 1).tolist())))
            legend.append((f"c{colour}", words))
            values[f"c{colour}"] = [_told(labels[b], known[a][1]) for a, b in zip(i, j, strict=True)]
    worst, column = np.unravel_index(np.nanargmax(np.abs(share)), share.shape)
    farthest = f"{units[numbers[worst]]}, {labels[column].lower()} ({percent(float(abs(share[worst, column])))})"
    count = int(beyond.any(axis=1).sum())
    said = f"{count} of {len(known)} units are beyond" if count else f"all {len(known)} units are within"
    caption = "Each unit a dot, as a share of its data sheet's limit; shaded: within the limit."
    if many:
        caption += f" Grey bars: 5 to 95 % of the units; dots: the {FARTHEST} smallest and largest."
    if np.nanmax(np.abs(share)) > EDGE:
        caption += f" Shares above {percent(EDGE)} stand at the edge."
    figure = Figure(name, f"{title}: {said} the data sheet; farthest: {farthest}", caption, tuple(legend))
    medians = zip(labels, np.nanmedian(share, axis=0), strict=True)
    description = "Median share of the limit. " + "; ".join(f"{k}: {percent(float(m))}" for k, m in medians)
    panel = Panel([*layers, *dots], "", ROW * len(labels), limits=(0.4, at[0] + 0.6), rows=labels[::-1])
    label = "share of the data sheet's limit, %"
    return chart(figure, description, [panel], label, margin=0.03, left=LEFT, units="units"), values


def _bar(ends: NDArray[np.float64], low: float, high: float, colour: int) -> Layer:
    return Area(low, high, colour, 100.0 * np.clip(ends, -EDGE, EDGE))


def _told(label: str, of: Placed) -> str:
    """Return the text of a dot: value, and its share of the limit."""
    value, limit, unit = of[label]
    return f"{label}: {number(value, 4)} {unit}".rstrip() + f", {percent(value / limit)} of ±{number(limit)}"
