"""What many units say together: distributions, units far from their siblings, lots, drift, repeatability, causes.

Siblings are units of one sensor model, calibrated by one method. For each parameter of theirs

    z = (value - median) / (1.4826 * median(|value - median|))

where

    z : how far a unit is from its siblings, in robust standard deviations (1.4826 makes it that of a normal law)

A unit is far where |z| > 6 with 20 siblings or more. A parameter drifts over the date where Spearman's rank
correlation differs from zero, and over lots where Kruskal and Wallis's test says so, both at 0.001 after Bonferroni's
correction for the number of parameters; what it drifts a year is the slope of a line by least squares. Repeatability is
the pooled standard deviation of units that share a serial.

References
----------
1. Rousseeuw & Croux, Alternatives to the median absolute deviation, J. Am. Stat. Assoc. 88 (1993) 1273.
"""

from __future__ import annotations

import math
from collections import Counter
from datetime import date
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.records import SENSORS

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

JSON = dict[str, Any]
AXES = "xyz"
FEWEST, FAR = 20, 6.0
LEVEL = 0.001


def parameters(calibration: JSON) -> dict[str, tuple[float, float | None, str]]:
    """Return every fitted parameter of a unit by name: its value, expanded uncertainty and unit.

    Parameters
    ----------
    calibration : dict
        As ``calibrations/<unit>.json``.
    """
    found: dict[str, tuple[float, float | None, str]] = {}
    for sensor in SENSORS:
        fit = calibration.get(sensor)
        if not fit:
            continue
        spread = fit.get("expanded_uncertainty") or {}
        for i, a in enumerate(AXES):
            found[f"{sensor}_bias_{a}"] = fit["bias"][i], _at(spread.get("bias"), i), fit["unit"]
        for i, a in enumerate(AXES):
            for j, b in enumerate(AXES):
                row = _at(spread.get("matrix"), i)
                found[f"{sensor}_matrix_{a}{b}"] = fit["matrix"][i][j], _at(row, j), "1"
        for effect in fit.get("effects") or []:
            for name, p in effect["parameters"].items():
                found[f"{sensor}_{effect['name']}_{name}"] = p["value"], p.get("expanded_uncertainty"), p["unit"]
    return found


def fleet_statistics(rows: Sequence[JSON], found: dict[str, dict[str, tuple[float, float | None, str]]]) -> JSON:
    """Return the statistics of a fleet.

    Parameters
    ----------
    rows : sequence of dict
        One a unit, as of ``summary.summary_row``.
    found : dict
        Unit to its parameters, as of ``parameters``; units that failed have none.

    Returns
    -------
    dict
        ``distributions``, ``far``, ``drift``, ``lots``, ``repeatability``: lists of dicts; ``missing``: sentences.
    """
    out: JSON = {"distributions": [], "far": [], "drift": [], "lots": [], "repeatability": []}
    for (model, method), units in _siblings(rows, found).items():
        names = list(dict.fromkeys(name for row in units for name in found[row["unit"]]))
        for name in names:
            have = [row for row in units if name in found[row["unit"]]]
            values = np.array([found[row["unit"]][name][0] for row in have])
            about = {"sensor": model, "method": method, "parameter": name, "unit": found[have[0]["unit"]][name][2]}
            out["distributions"].append(about | _distribution(values))
            if len(have) >= FEWEST:
                out["far"] += [about | f for f in _far(have, values)]
                out["drift"] += [about | d for d in _drift(have, values, len(names))]
                out["lots"] += [about | d for d in _lots(have, values, len(names))]
            out["repeatability"] += [about | r for r in _repeatability(have, values)]
    out["far"].sort(key=lambda f: -abs(f["z"]))
    out["missing"] = missing_effects(rows)
    return out


def missing_effects(rows: Sequence[JSON]) -> list[str]:
    """Return a sentence for each effect that units miss: how many, and from which lots."""
    sentences = []
    lots = Counter(row["lot"] for row in rows if row.get("lot"))
    for sensor in SENSORS:
        judged = [row for row in rows if row.get(f"{sensor}_verdict")]
        names = Counter(n for row in judged for n in str(row.get(f"{sensor}_selected") or "").split(";") if n)
        for name, count in names.most_common():
            units = [r for r in judged if name in str(r.get(f"{sensor}_selected") or "").split(";")]
            of = Counter(row["lot"] for row in units if row.get("lot"))
            said = f"{count} of {len(judged)} miss {name} ({sensor})"
            if len(lots) > 1 and of:
                lot, most = of.most_common(1)[0]
                if most == count:
                    said += f", all from lot {lot} ({most} of its {lots[lot]})"
                elif most > count / 2:
                    said += f", {most} of them from lot {lot} ({most} of its {lots[lot]})"
                else:
                    said += f", spread over {len(of)} lots"
            sentences.append(said)
    return sentences


def _siblings(rows: Sequence[JSON], found: JSON) -> dict[tuple[str, str], list[JSON]]:
    groups: dict[tuple[str, str], list[JSON]] = {}
    for row in rows:
        if found.get(row["unit"]):
            groups.setdefault((str(row["sensor"]), str(row["method"])), []).append(row)
    return groups


def _distribution(values: NDArray[np.float64]) -> JSON:
    low, middle, high = np.quantile(values, [0.05, 0.5, 0.95])
    return {
        "units": len(values),
        "median": float(middle),
        "robust_standard_deviation": _spread(values),
        "quantile_05": float(low),
        "quantile_95": float(high),
        "smallest": float(values.min()),
        "largest": float(values.max()),
    }


def _spread(values: NDArray[np.float64]) -> float:
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def _far(rows: Sequence[JSON], values: NDArray[np.float64]) -> Iterable[JSON]:
    spread = _spread(values)
    if spread == 0.0:
        return
    z = (values - np.median(values)) / spread
    for i in map(int, np.flatnonzero(np.abs(z) > FAR)):
        yield {"name": rows[i]["unit"], "lot": rows[i].get("lot"), "value": float(values[i]), "z": float(z[i])}


def _drift(rows: Sequence[JSON], values: NDArray[np.float64], tests: int) -> Iterable[JSON]:
    days = np.array([_day(row.get("date")) for row in rows])
    known = np.isfinite(days)
    if known.sum() < FEWEST or np.ptp(days[known]) == 0.0:
        return
    from scipy import stats  # noqa: PLC0415  (0.3 s that few fleets need)

    rho, p = stats.spearmanr(days[known], values[known])
    if p * tests < LEVEL:
        slope = stats.theilslopes(values[known], days[known]).slope if known.sum() <= 2000 else None
        slope = float(np.polyfit(days[known], values[known], 1)[0]) if slope is None else float(slope)
        yield {
            "rank_correlation": float(rho),
            "p_value": float(p),
            "per_year": slope * 365.25,
            "units": int(known.sum()),
        }


def _lots(rows: Sequence[JSON], values: NDArray[np.float64], tests: int) -> Iterable[JSON]:
    groups: dict[str, list[float]] = {}
    for row, value in zip(rows, values, strict=True):
        if row.get("lot"):
            groups.setdefault(row["lot"], []).append(float(value))
    groups = {lot: v for lot, v in groups.items() if len(v) >= 3}
    if len(groups) < 2 or np.ptp(values) == 0.0:
        return
    from scipy import stats  # noqa: PLC0415  (as above)

    p = float(stats.kruskal(*groups.values()).pvalue)
    if p * tests < LEVEL:
        middle = float(np.median(values))
        lot = max(groups, key=lambda name: abs(float(np.median(groups[name])) - middle))
        yield {"p_value": p, "lot": lot, "lot_median": float(np.median(groups[lot])), "median": middle}


def _repeatability(rows: Sequence[JSON], values: NDArray[np.float64]) -> Iterable[JSON]:
    groups: dict[str, list[float]] = {}
    for row, value in zip(rows, values, strict=True):
        if row.get("serial"):
            groups.setdefault(row["serial"], []).append(float(value))
    repeated = [v for v in groups.values() if len(v) > 1]
    if repeated:
        squares = sum(float(np.sum((np.array(v) - np.mean(v)) ** 2)) for v in repeated)
        freedom = sum(len(v) - 1 for v in repeated)
        yield {
            "devices": len(repeated),
            "calibrations": freedom + len(repeated),
            "standard_deviation": math.sqrt(squares / freedom),
        }


def _day(text: str | None) -> float:
    try:
        return float(date.fromisoformat(str(text)).toordinal())
    except ValueError:
        return math.nan


def _at(values: Any, i: int) -> Any:  # noqa: ANN401  (a number or a row)
    return None if values is None else values[i]
