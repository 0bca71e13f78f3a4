"""Noise at rest: Allan deviation of each axis, the identified terms with their 95 % band, and the sensor file.

The terms and their conventions are those of ``pipeline.estimation.noise_terms``; the white noise of a data sheet is
one-sided, ``N = noise_density / sqrt(2)``. Source: IEEE Std 952-1997, annex C.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.records import AXES, SENSOR_UNITS
from pipeline.estimation.gauss_markov import DEFAULT_TIME_S
from pipeline.estimation.noise_terms import TERM_UNITS, allan_variance
from pipeline.output.pages.chart import AXES_LEGEND, Area, ChartLayer, Dots, Figure, LineMark, Panel, chart, sentences
from pipeline.output.pages.numbers import number, percent, plain

if TYPE_CHECKING:
    from pipeline.core.files import JSON
    from pipeline.core.settings import DataSheet

# Factor between white noise and data sheet above which a cause is named: the digital filters of an MPU-6050 (5 to
# 260 Hz) change the white noise of a sample by sqrt(52) = 7 at one sampling rate, its ranges by 2 to 8.
MAX_TIMES_DATA_SHEET = 5.0
# factor between both below which they count as equal: data sheets state typical values to about 30 %
EQUAL_NOISE_FACTOR = 1.3
SURE_TERM_PROBABILITY = 0.9  # probability of a set of terms above which no other set is named
SYMBOLS = dict(zip(TERM_UNITS, "QNBKGRA", strict=True))


def allan(sensor: str, noise: JSON | None, data_sheet: DataSheet, wander: JSON | None) -> Figure | None:
    """Draw the Allan deviation of each axis; None where no noise was identified.

    ``noise``: the sensor's part of ``noise`` in its calibration; ``wander``: the bias wander by the diagnosis.
    """
    axes = {a: part for a, part in ((noise or {}).get("axes") or {}).items() if part["terms"]}
    if not noise or not axes:
        return None
    unit, layers, density = SENSOR_UNITS[sensor], list[ChartLayer](), data_sheet.stated("noise_density")
    for axis, part in axes.items():
        curve, colour = {k: np.array(v) for k, v in part["allan"].items()}, AXES.index(axis)
        layers += [Area(curve["low"], curve["high"], colour, curve["tau_s"])] if part["allan"]["low"] else []
        layers += [
            LineMark(curve["tau_s"], curve["fit"], colour, "model"),
            Dots(curve["tau_s"], curve["deviation"], colour),
        ]
    legend, tau = list(AXES_LEGEND), np.array(next(iter(axes.values()))["allan"]["tau_s"])
    if density:
        legend.append(("c3", "sensor file"))
        size, time = data_sheet.stated("bias_wander") or 0.0, data_sheet.stated("wander_time_s") or DEFAULT_TIME_S
        white = allan_variance("white", density / np.sqrt(2.0), tau)
        deviation = np.sqrt(white + allan_variance("gauss_markov", size, tau, time))
        layers.append(LineMark(tau, deviation, 3, "dashed"))
    mean = np.mean([part["allan"]["deviation"] for part in axes.values()], axis=0)
    finding, caption, description = sentences(
        "allan",
        **_white(axes, density),
        unit=unit,
        noise=noise,
        wander=wander,
        mean=[(float(mean[k]), float(tau[k])) for k in (0, len(tau) // 2, -1)],
    )
    return chart(
        Figure(f"{sensor}-allan", finding, caption, tuple(legend)),
        description,
        [Panel(layers, f"Allan deviation, {unit}", 190, logarithmic=True)],
        "averaging time, s",
        kind="log",
    )


def term_rows(noise: JSON | None) -> list[JSON]:
    """Return a row for each term: its name, unit, and a text with interval or upper limit for each axis.

    An axis whose noise was not identified has the text of an unknown number.
    """
    axes = [part["terms"] for part in ((noise or {}).get("axes") or {}).values()]
    if not any(axes):
        return []
    rows = []
    for name, symbol in SYMBOLS.items():
        found = [terms[name] if terms else [] for terms in axes]
        lists = [each if isinstance(each, list) else [each] for each in found]
        for i in range(max(map(len, lists))):
            parts = [parts[i] if i < len(parts) else None for parts in lists]
            unit = next(part["unit"] for part in parts if part)
            if any(part and (part["value"] is not None or part.get("upper_limit")) for part in parts):
                rows.append({"name": f"{plain(name)} {symbol}", "unit": unit, "axes": [_text(part) for part in parts]})
    return rows


def remarks(noise: JSON | None) -> list[str]:
    """Return sentences on terms that are missing, on the second best set of terms, and on doubts."""
    if not noise:
        return []
    texts = [f"Not identified: {noise['reason']}."] if noise["reason"] else []
    texts += [f"Intervals and further terms: {noise['intervals_by']}."] if noise.get("intervals_by") else []
    texts += [f"In doubt: {doubt}." for doubt in noise.get("doubts") or []]
    by_axis: dict[str, list[str]] = {}
    for axis, part in (noise["axes"] or {}).items():
        lines = [f"not identified: {part['reason']}"] if part["reason"] else []
        lines += [f"in doubt: {doubt}" for doubt in part.get("doubts") or []]
        ranking = part.get("ranking") or []
        if ranking and ranking[0]["probability"] < SURE_TERM_PROBABILITY and len(ranking) > 1:
            second = ", ".join(map(plain, ranking[1]["terms"]))
            best, next_best = (percent(r["probability"]) for r in ranking[:2])
            lines.append(f"these terms have a probability of {best}, the next best set ({second}) {next_best}")
        terms = part["terms"] or {}
        reasons = {name: term["reason"] for name, term in terms.items() if isinstance(term, dict) and "reason" in term}
        for reason in dict.fromkeys(reasons.values()):
            if "short" in reason:
                lines.append(f"{' and '.join(plain(n) for n, r in reasons.items() if r == reason)}: {reason}")
        for line in lines:
            by_axis.setdefault(line, []).append(axis)
    return texts + [f"{', '.join(axes)}: {line}." for line, axes in by_axis.items()]


def _text(part: JSON | None) -> str:
    """Return a value with its interval if there is one, or the upper limit."""
    if part is None:
        return number(None)
    if part["value"] is None:
        return f"< {number(part['upper_limit'])}" if part.get("upper_limit") else number(None)
    text = number(part["value"])
    text += " ({} to {})".format(*map(number, part["interval"])) if part["interval"] else ""
    for key, unit in (("correlation_time_s", "s"), ("frequency_hz", "Hz")):
        text += f", {number(part[key]['value'])} {unit}" if key in part else ""
    return text


def _white(axes: JSON, density: float | None) -> JSON:
    """Return the white noise, its ratio to the sensor file's density with a likely cause, and the other terms."""
    terms = [part["terms"] for part in axes.values()]
    names = {
        name
        for term in terms
        for name, parts in term.items()
        for part in (parts if isinstance(parts, list) else [parts])
        if part["value"] is not None
    }
    densities = [t["white"]["value"] for t in terms if t["white"]["value"]]
    white = float(np.sqrt(np.mean(np.square(densities)))) if densities else None
    stated = (density or 0.0) / np.sqrt(2.0)
    ratio, cause = white / stated if white and stated else None, ""
    if ratio and ratio > MAX_TIMES_DATA_SHEET:
        cause = ": vibration at rest, another range, or a column in another unit"
    elif ratio and ratio < 1.0 / MAX_TIMES_DATA_SHEET:
        cause = ": a filter in the sensor, smoothed or repeated samples, or a column in another unit"
    others = [name for name in SYMBOLS if name != "white" and name in names]
    as_stated = ratio is not None and 1.0 / EQUAL_NOISE_FACTOR < ratio < EQUAL_NOISE_FACTOR
    return {"white": white, "ratio": ratio, "as_stated": as_stated, "cause": cause, "others": others}
