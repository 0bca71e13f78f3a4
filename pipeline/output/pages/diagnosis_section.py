"""The evidence of a diagnosis as charts and rows: ranking of effects, added-variable plots, unexplained residuals.

Ranking: bars of delta BIC. Brackets join effects with nearly equal signals: the data identify the group, but not the
effect within it. Added-variable plot: readings against the column of one coefficient, both minus their regression on
all other columns; the slope through the origin is the coefficient. If the points are off the line, the effect has
another shape. All points are the binned data of the diagnosis: nothing is fitted here.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.errors import shortened
from pipeline.core.records import AXES, SENSOR_UNITS, Values
from pipeline.estimation.gates import MIN_DELTA_BIC, MIN_DELTA_BIC_OF_SLOW, min_delta_bic
from pipeline.estimation.posterior import prior_limit
from pipeline.output.pages.chart import ChartLayer, Dots, Figure, LineMark, Panel, chart, sentences
from pipeline.output.pages.group_charts import Point, bars
from pipeline.output.pages.pages import measured, number, percent, plain, unit_text
from pipeline.physics.effects import catalogue
from pipeline.physics.effects.base import largest_by_unit, parameter_limits

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.core.files import JSON
    from pipeline.core.settings import DataSheet

RIVAL_SHARE = 0.8  # share of the selected effect's delta BIC above which another effect is named as a rival
# effects and brackets that a chart or its caption shows
MAX_CHART_EFFECTS, MIN_CHART_EFFECTS, MOST_HIDDEN, MAX_CAPTION_BRACKETS = 9, 3, 6, 2
EXCLUDED = 0.5  # of the upper limit by the prior alone, below which the recordings exclude an effect: convention
MOST_LIMITS = 8  # upper limits that a chart shows
ON_THE_LINE = 3.0  # mean square of the points about the line, in standard errors: 1 for noise, more for correlated bins
MOST_EXPLAINED = 0.97  # share of the points' variance that a line must explain where they are farther off
SIGNAL_NAMES = {
    "temperature": "temperature, degC",
    "time": "time since power-on, s",
    "speed": "magnitude of the angular rate, deg/s",
    "rate": "angular rate of the rate table, deg/s",
    "angle": "angle of the rate table, deg",
    **{f"f{a}": f"specific force along {a}, g" for a in AXES},
    **{f"w{a}": f"angular rate about {a}, deg/s" for a in AXES},
}


def limit_rows(sensor: str, found: JSON, data_sheet: DataSheet) -> list[JSON]:
    """Return the upper limits of each effect that was not selected as text, and as share of the data sheet's limit.

    ``share`` is None where the sensor file has no limit; the largest come first. ``excluded``: whether the recordings
    exclude an effect of the size of that limit, and no answer of the answer set contains it.
    """
    rows, open_effects = [], {name for answer in found.get("answer_set") or [] for name in answer["effects"]}
    for name, limits in (found.get("upper_limit") or {}).items():
        effect = catalogue().get(name)
        stated: dict[str, float] = {}
        if effect is not None:
            values = parameter_limits(effect, sensor, data_sheet.effects).tolist()
            stated = dict(zip((p.name for p in effect.parameters(sensor)), values, strict=True))
        text = ", ".join(f"{number(v, 2)} {unit_text(unit)}".rstrip() for unit, v in largest_by_unit(limits).items())
        shares = {key: v["value"] / stated[key] for key, v in limits.items() if np.isfinite(stated.get(key, np.inf))}
        share = max(shares.values(), default=None)
        row: JSON = {
            "effect": name,
            "text": text,
            "share": share,
            "excluded": share is not None and share < EXCLUDED * prior_limit() and name not in open_effects,
        }
        if shares:
            most = limits[max(shares, key=shares.__getitem__)]
            row["label"] = f"{plain(name)}: below {number(most['value'], 2)} {unit_text(most['unit'])}".rstrip()
        rows.append(row)
    return sorted(rows, key=lambda row: -(row["share"] or 0.0))


def upper_limits(sensor: str, rows: Sequence[JSON]) -> Figure | None:
    """Draw upper limits as shares of the data sheet's limits; None without any."""
    shown = [row for row in rows if row["share"]]
    if not shown:
        return None
    finding, caption, _ = sentences(
        "limits",
        count=len(shown),
        excluded=sum(row["excluded"] for row in shown),
        others=len(shown) - MOST_LIMITS,
        below=EXCLUDED * prior_limit(),
        prior=prior_limit(),
    )
    points = [Point(row["label"], row["share"], 3) for row in shown[:MOST_LIMITS]]
    figure = Figure(f"{sensor}-limits", finding, caption)
    label = "upper limit over the data sheet's limit (logarithmic)"
    return bars(figure, points, label, levels={"limit of the sensor file": 1.0})


def ranking_rows(found: JSON) -> list[JSON]:
    """Return the ranked effects, whether each is ``selected``, and ``supported``: selected or with evidence for it."""
    chosen = found.get("selected") or []
    rows = [(r, r["effect"] in chosen) for r in found.get("ranking") or []]
    return [{**r, "selected": selected, "supported": selected or _evidence(r) > 0.0} for r, selected in rows]


def ranking(sensor: str, found: JSON) -> Figure | None:
    """Draw the ranking of a diagnosis, and list the effects that are not observable; None without ranked effects."""
    entries, hidden = found.get("ranking") or [], found.get("not_observable") or []
    selected = found.get("selected") or []
    if not entries:
        return None
    helpful = [r for r in entries if _evidence(r) > 0 or r["effect"] in selected][:MAX_CHART_EFFECTS]
    shown = helpful if len(helpful) >= MIN_CHART_EFFECTS else entries[:MIN_CHART_EFFECTS]
    rows = [_ranking_row(r, selected, passes=_passes(r, sensor)) for r in shown]
    brackets = _brackets(shown, selected)
    best = max((r for r in entries if r["effect"] not in selected), key=_evidence, default=None)
    value = _evidence(next((r for r in entries if r["effect"] == (selected or [None])[0]), {}))
    finding, caption, _ = sentences(
        "ranking",
        selected=selected,
        value=value,
        best=best,
        close=best is not None and _evidence(best) > RIVAL_SHARE * value,
        passes=best is not None and _passes(best, sensor),
        slow=MIN_DELTA_BIC_OF_SLOW,
        brackets=brackets,
        others=len(entries) - len(shown),
        hidden=shortened([plain(h["effect"]) for h in hidden], MOST_HIDDEN),
    )
    figure = Figure(f"{sensor}-ranking", finding, caption)
    label = "ΔBIC (linear to ±10, logarithmic beyond)"
    return bars(
        figure, rows, label, levels={f"threshold {MIN_DELTA_BIC:g}": MIN_DELTA_BIC}, kind="symlog", brackets=brackets
    )


def _evidence(entry: JSON) -> float:
    return float(entry.get("delta_bic") or 0.0)


def _passes(entry: JSON, sensor: str) -> bool:
    """Return whether the evidence for an effect passes the gate of a first selection."""
    this = catalogue().get(entry["effect"])
    return _evidence(entry) > (min_delta_bic(this, sensor) if this else MIN_DELTA_BIC)


def _ranking_row(entry: JSON, selected: Sequence[str], *, passes: bool) -> Point:
    value, alike, chosen = _evidence(entry), entry.get("look_alikes") or [], entry["effect"] in selected
    beyond = passes and not entry.get("plausible", True)
    label = plain(entry["effect"]) + ", selected" * chosen + ", departs from the data sheet" * beyond
    note = "like " + ", ".join(f"{plain(a['effect'])} {percent(a['share'])}" for a in alike) if alike else ""
    return Point(label, value, 2 if chosen else 4 if passes else 3, note=note)


def _brackets(shown: Sequence[JSON], selected: Sequence[str]) -> list[dict[int, str]]:
    """Return the groups of similar effects, selected ones first: row of each member, and its share as text."""
    rows = {r["effect"]: i for i, r in enumerate(shown)}
    brackets: list[dict[int, str]] = []
    joined: set[frozenset[str]] = set()
    for entry in sorted(shown, key=lambda r: r["effect"] not in selected):
        alike = {a["effect"]: a["share"] for a in entry.get("look_alikes") or [] if a["effect"] in rows}
        alike = {n: share for n, share in alike.items() if frozenset((n, entry["effect"])) not in joined}
        if alike and len(brackets) < MAX_CAPTION_BRACKETS:
            joined |= {frozenset((n, m)) for n in (*alike, entry["effect"]) for m in alike}
            brackets.append({rows[entry["effect"]]: "", **{rows[n]: percent(s) for n, s in alike.items()}})
    return brackets


def added_variable(sensor: str, found: JSON) -> Figure | None:
    """Draw the added-variable plot of the first selected effect; None where the diagnosis has none."""
    shown = (found.get("pictures") or {}).get("added_variable")
    if not shown or not shown["panels"]:
        return None
    unit, effect, panels = shown["unit"], plain(shown["effect"]), []
    points = [_points(p) for p in shown["panels"]]
    ends = np.array([min(x.min() for x, _, _ in points), max(x.max() for x, _, _ in points)])
    scatter, residual, total = [], 0.0, 0.0
    for panel, (x, mean, error) in zip(shown["panels"], points, strict=True):
        line_x = np.array([x.min(), x.max()]) if panel["value"] else ends
        line = LineMark(line_x, panel["value"] * line_x, 5, "model")
        panels.append(Panel([line, _binned(panel)], f"{panel['axis']}, {unit}", 92, {"": 0.0}))
        squares = ((mean - panel["value"] * x) / error) ** 2
        scatter.append(float(np.mean(squares)))
        residual, total = residual + float(squares.sum()), total + float(np.sum((mean / error) ** 2))
    straight = max(scatter) < ON_THE_LINE or 1.0 - residual / max(total, 1e-300) > MOST_EXPLAINED
    best = max(shown["panels"], key=lambda p: abs(p["value"]) / max(p["standard_uncertainty"], 1e-300))
    what = best["parameter"] if len({p["parameter"] for p in shown["panels"]}) == 1 else "each parameter"
    slopes = "; ".join(dict.fromkeys(_coefficient(p) for p in shown["panels"]))
    x_unit = _column_unit(best["unit"], unit)
    finding, caption, description = sentences(
        "added_variable",
        effect=effect,
        coefficient=_coefficient(best),
        slopes=slopes,
        straight=straight,
        scatter=scatter,
    )
    figure = Figure(f"{sensor}-added-variable", finding, caption, (("c5", "slope = parameter"),))
    label = f"column of {what}, minus all other columns" + (f", {x_unit}" if x_unit else "")
    return chart(figure, description, panels, label)


def _points(panel: JSON) -> tuple[Values, Values, Values]:
    x, mean, error = (np.array(panel[key], float) for key in ("x", "mean", "standard_error"))
    return x, mean, np.maximum(error, 1e-300)


def _binned(panel: JSON) -> Dots:
    x, mean, error = _points(panel)
    return Dots(x, mean, AXES.index(panel["axis"]), mean - 2.0 * error, mean + 2.0 * error)


def _coefficient(panel: JSON) -> str:
    value = measured(panel["value"], 2.0 * panel["standard_uncertainty"])
    return f"{panel['parameter']} = {value} {unit_text(panel['unit'])}".rstrip()


def _column_unit(parameter: str, unit: str) -> str:
    """Return the unit of the column that a parameter multiplies: the sensor's unit over the parameter's unit."""
    if parameter == unit:
        return ""
    if parameter == "1":
        return unit
    if parameter.startswith(f"{unit}/"):
        return parameter.removeprefix(f"{unit}/").removeprefix("(").removesuffix(")")
    if parameter.startswith("1/"):
        base, _, power = parameter.removeprefix("1/").partition("^")
        if base.strip("()") == unit:
            return f"{base}^{int(power or 1) + 1}"
        return f"{unit} {parameter.removeprefix('1/')}"
    return f"{unit}/{parameter}"


def unexplained(sensor: str, found: JSON) -> list[Figure]:
    """Draw the residual against each covariate on which it depends, with the suggested shape."""
    entries = {e["covariate"]: e for e in found.get("unexplained") or []}
    figures = []
    for shown in (found.get("pictures") or {}).get("unexplained") or []:
        unit, covariate, panels, scatter = shown["unit"], shown["covariate"], [], []
        for panel in shown["panels"]:
            x, mean, error = _points(panel)
            layers: list[ChartLayer] = [_binned(panel)]
            if "curve" in panel:
                curve_x, curve = (np.array(panel[key], float) for key in ("curve_x", "curve"))
                layers.insert(0, LineMark(curve_x, curve, 5, "model"))
                scatter.append(float(np.mean(((mean - np.interp(x, curve_x, curve)) / error) ** 2)))
            panels.append(Panel(layers, f"{panel['axis']}, {unit}", 76, {"": 0.0}))
        finding, caption, description = sentences(
            "unexplained",
            covariate=covariate,
            entry=entries.get(covariate, {}),
            fitted=bool(scatter),
            follow=all(mean_square < ON_THE_LINE for mean_square in scatter),
            reaches=[f"{p['axis']} up to {number(float(np.abs(p['mean']).max()))} {unit}" for p in shown["panels"]],
        )
        legend = (("c5", "suggested shape"),) if scatter else ()
        figure = Figure(f"{sensor}-unexplained-{covariate}", finding, caption, legend)
        label = SIGNAL_NAMES.get(shown["signal"], f"what the axis should read, {SENSOR_UNITS[sensor]}")
        kind = "angle" if shown["signal"] == "angle" else ""
        figures.append(chart(figure, description, panels, label, kind=kind))
    return figures
