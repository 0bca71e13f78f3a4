"""The charts of a fleet: each unit's error before and after over the order of the sheet, and which effects are missing.

Every unit is a dot of its own, so that an outlier can be pointed at; the logarithmic axis shows a drift from lot to lot
and a unit ten times worse alike.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from pipeline.report.figure import JSON, UNITS, Figure, plain
from pipeline.report.numbers import number
from pipeline.report.shapes import Dots, Layer
from pipeline.report.svg import Panel, chart

FAR = 3.0  # of the noise floor: a unit beyond it is named
NAMED = 3
FEWEST = 3  # units, below which a picture says no more than the table


def fleet_figures(rows: list[JSON]) -> list[Figure]:
    """Return the charts of both sensors.

    Parameters
    ----------
    rows : list of dict
        One a unit, as of ``summary.summary_row``, in the order of the sheet.
    """
    return [f for sensor in UNITS if (f := _errors(sensor, rows))]


def fleet_values(rows: list[JSON]) -> dict[str, dict[str, list[str]]]:
    """Return what each dot of the charts stands for, by chart and colour, in the order of the units."""
    return {
        f"fleet-{sensor}": {
            colour: ["" if (v := r.get(f"{sensor}_{column}")) is None else f"{v:.6g}" for r in rows]
            for colour, column in (("c3", "error_before"), ("c4", "noise_floor"), ("after", "error_after"))
        }
        for sensor in UNITS
    }


def _errors(sensor: str, rows: list[JSON]) -> Figure | None:
    def column(name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
        values = [r.get(f"{sensor}_{name}") for r in rows]
        return np.array([np.nan if v is None or v <= 0 else v for v in values], float)

    before, after, floor = column("error_before"), column("error_after"), column("noise_floor")
    known = np.isfinite(after)
    if known.sum() < FEWEST:
        return None
    order, unit = np.arange(1.0, len(rows) + 1), UNITS[sensor]
    verdicts = [r.get(f"{sensor}_verdict") for r in rows]
    complete = known & np.array([v == "nothing_missing" for v in verdicts])
    layers: list[Layer] = [Dots(order, np.log10(before), 3), Dots(order, np.log10(floor), 4)]
    series = [("c3", "before"), ("c4", "noise floor")]
    for chosen, colour, name in (
        (complete, 2, "after, nothing missing"),
        (known & ~complete, 0, "after, any other verdict"),
    ):
        if chosen.any():
            layers.append(Dots(order[chosen], np.log10(after[chosen]), colour))
            series.append((f"c{colour}", name))
    ratio = np.where(known & np.isfinite(floor), after / floor, np.nan)
    finding = f"{sensor.capitalize()}: {_finding(rows, ratio, int(known.sum()))}"
    svg = chart(
        f"fleet-{sensor}",
        finding,
        f"Held-out error of {int(known.sum())} units. Median {number(float(np.nanmedian(before)))} {unit} before, "
        f"{number(float(np.nanmedian(after)))} after, noise floor {number(float(np.nanmedian(floor)))}. "
        f"{_missing(sensor, rows)}",
        [Panel(layers, f"rms error, {unit}", 200, logarithmic=True)],
        "unit, in the order of units.csv",
        names="units",
    )
    return Figure(svg, f"Error on held-out motion, each unit a dot. {_missing(sensor, rows)}", tuple(series), finding)


def _finding(rows: list[JSON], ratio: np.ndarray[Any, np.dtype[np.float64]], known: int) -> str:
    """Return how many units stand far above the noise, the worst by name."""
    far = [i for i in np.argsort(-np.nan_to_num(ratio)) if ratio[i] > FAR]
    if not far:
        return f"all {known} units are within {FAR:g} × the noise floor"
    named = ", ".join(f"{rows[i]['unit']} ({number(float(ratio[i]))} ×)" for i in far[:NAMED])
    return f"{len(far)} of {known} units are beyond {FAR:g} × the noise floor; worst: {named}"


def _missing(sensor: str, rows: list[JSON]) -> str:
    counts = Counter(n for r in rows for n in str(r.get(f"{sensor}_selected") or "").split(";") if n)
    if not counts:
        return "No effect is named as missing."
    return "Missing effects: " + ", ".join(f"{plain(n)} in {c}" for n, c in counts.most_common()) + "."
