"""The evidence of a diagnosis as charts and rows: the ranking of effects, added-variable plots, and the unexplained.

Ranking: bars of delta BIC on an axis that is linear up to the threshold of 10 and logarithmic beyond. Brackets join
effects whose signals are nearly the same: the data identify the group, not which of its members acts.

Added-variable plot: readings against the column of one coefficient, both less what everything else explains; the slope
through the origin is the coefficient. Points that leave the line show that the effect has another shape.

Unexplained: the residual against the covariate on which it depends, with the suggested shape. Nothing is fitted here:
all points are the binned data of the diagnosis.
"""

from __future__ import annotations

import math
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.records import AXES, SENSOR_UNITS
from pipeline.report.chart import WIDTH, Axis, Dots, Figure, Layer, Line, Panel, chart, svg, text
from pipeline.report.numbers import MINUS, measured, number, percent, plain, unit_text
from pipeline.report.parameter_section import parameter_texts

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

JSON = dict[str, Any]
GATE = 10.0  # delta BIC, strong evidence: A. E. Raftery, Sociological Methodology 25 (1995) 139, table 6
CLOSE = 0.8  # share of the selected effect's delta BIC from which another effect is named as a rival
MOST, FEWEST, MOST_HIDDEN, BRACKETS = 9, 3, 6, 2  # effects and brackets that a chart has room for
ROW, SMALL_ROW, LEFT, TOP = 29, 27, 6, 18  # px
NUMBERS, BRACKET = 52, 48  # px, widths of the numbers and of a bracket
LONGEST = 66  # letters of a reason that fit into a line
LOWEST = -100.0  # delta BIC at which a bar against an effect ends
COLOURS = {2: "selected", 4: "above the threshold", 3: "below the threshold"}
ON_THE_LINE = 3.0  # mean square of the points about the line, in standard errors: 1 for noise, bins being correlated
MOST_EXPLAINED = 0.97  # share of the points' variance that a line must explain where they leave it by more
SIGNALS = {
    "temperature": "temperature, degC",
    "time": "time since power-on, s",
    "speed": "magnitude of the angular rate, deg/s",
    "rate": "angular rate of the rate table, deg/s",
    "angle": "angle of the rate table, deg",
    **{f"f{a}": f"specific force along {a}, g" for a in AXES},
    **{f"w{a}": f"angular rate about {a}, deg/s" for a in AXES},
}


def evidence_figures(sensor: str, found: JSON) -> list[Figure]:
    """Return the charts of a sensor's diagnosis."""
    first = [f for f in (ranking(sensor, found), added_variable(sensor, found)) if f]
    return first + unexplained(sensor, found)


def ranking_rows(found: JSON) -> list[JSON]:
    """Return the ranked effects with their parameters as text; ``supported`` are those with evidence for them."""
    selected = found.get("selected") or []
    return [
        {
            **r,
            "parameter_texts": parameter_texts(r.get("parameters")),
            "selected": r["effect"] in selected,
            "supported": r["effect"] in selected or _evidence(r) > 0.0,
        }
        for r in found.get("ranking") or []
    ]


def ranking(sensor: str, found: JSON) -> Figure | None:
    """Draw the ranking of a diagnosis; None where it ranked nothing."""
    entries, hidden = found.get("ranking") or [], found.get("not_observable") or []
    selected = found.get("selected") or []
    if not entries:
        return None
    helpful = [r for r in entries if _evidence(r) > 0 or r["effect"] in selected][:MOST]
    shown = helpful if len(helpful) >= FEWEST else entries[:FEWEST]
    words = "; ".join(f"{plain(r['effect'])} {number(_evidence(r))}{_alike(r)}" for r in shown)
    if hidden:
        words += "; not observable: " + ", ".join(plain(h["effect"]) for h in hidden)
    caption = (
        "ΔBIC of each effect beyond the configured model: of a selected effect when it was added, of the others alone. "
        "Right of the threshold the evidence is strong."
    )
    if any(_alike(r) for r in shown):
        caption += (
            " Brackets join effects with similar signals, with the share of the signal that the other reproduces."
        )
    if rest := len(entries) - len(shown):
        caption += f" {rest} more {'has' if rest == 1 else 'have'} less evidence; see the tables below."
    finding, (height, content) = _ranking_finding(entries, selected), _ranking_content(shown, selected, hidden)
    colours = {_colour(r, selected) for r in shown}
    drawn = svg(f"{sensor}-ranking", f"{sensor}: {finding}", f"delta BIC: {words}", height, content)
    return Figure(drawn, caption, tuple((f"c{c}", t) for c, t in COLOURS.items() if c in colours), finding)


def _evidence(entry: JSON) -> float:
    return float(entry.get("delta_bic") or 0.0)


def _colour(entry: JSON, selected: Sequence[str]) -> int:
    return 2 if entry["effect"] in selected else 4 if _evidence(entry) > GATE else 3


def _alike(entry: JSON) -> str:
    alike = entry.get("look_alikes") or []
    return f" (like {', '.join(plain(a['effect']) + ' ' + percent(a['share']) for a in alike)})" if alike else ""


def _ranking_finding(entries: Sequence[JSON], selected: Sequence[str]) -> str:
    best = max((r for r in entries if r["effect"] not in selected), key=_evidence, default=None)
    nearest = f"{plain(best['effect'])} reaches {number(_evidence(best))}" if best else ""
    if not selected:
        none = best is None or _evidence(best) <= GATE
        head = "No effect passes the threshold" if none else "No effect is selected"
        return f"{head}: at best, {nearest}" if nearest else head
    value = _evidence(next((r for r in entries if r["effect"] == selected[0]), {}))
    head, close = plain(selected[0]).capitalize(), best is not None and _evidence(best) > CLOSE * value
    if len(selected) > 1:
        head += f", before {', '.join(plain(n) for n in selected[1:])},"
    head += f" is selected with ΔBIC {number(value)}" if close else f" stands out: ΔBIC {number(value)}"
    if not nearest:
        return head
    return f"{head}, but {nearest}" if close else f"{head}; of the others, {nearest}"


def _symlog(value: float) -> float:
    """Return ``v / 10`` where ``|v| <= 10``, else ``sign(v) (1 + log10(|v| / 10))``."""
    return value / GATE if abs(value) <= GATE else math.copysign(1.0 + math.log10(abs(value) / GATE), value)


def _ranking_content(shown: Sequence[JSON], selected: Sequence[str], hidden: Sequence[JSON]) -> tuple[float, str]:
    """Return height and content of the chart."""
    brackets = _brackets(shown, selected)
    values = [_evidence(r) for r in shown]
    low = max(min(*values, 0.0), LOWEST)
    x = Axis(_symlog(low), _symlog(max(*values, GATE * 2.0)), LEFT, WIDTH - NUMBERS - BRACKET * len(brackets))
    bottom = TOP + ROW * len(shown)
    ticks = [v for v in (-100.0, -10.0) if low <= v] + [0.0]
    ticks += [10.0**k for k in range(1, 9) if _symlog(10.0**k) <= x.high]
    gate = x.pixels(_symlog(GATE))
    out = [f'<path class="grid" d="{"".join(f"M{x.pixels(_symlog(t)):.1f} {TOP}V{bottom}" for t in ticks)}"/>']
    out += [_ranking_bar(r, x, TOP + ROW * i, selected) for i, r in enumerate(shown)]
    out.append(f'<path class="level" d="M{gate:.1f} {TOP}V{bottom}"/>')
    out.append(text(max(gate, LEFT + 32), TOP - 5, "threshold 10", "m"))
    for tick in ticks:
        words = f"{tick:.0f}" if abs(tick) < 1e5 else f"1e{math.log10(tick):.0f}"
        out.append(text(max(x.pixels(_symlog(tick)), LEFT + 6), bottom + 13, words.replace("-", MINUS), "m"))
    out.append(text((LEFT + x.stop) / 2, bottom + 28, "ΔBIC (linear to ±10, logarithmic beyond)", "m"))
    for k, members in enumerate(brackets):
        at = x.stop + NUMBERS + BRACKET * k
        path = f"M{at:.1f} {members[0][0]:g}V{members[-1][0]:g}" + "".join(f"M{at - 6:.1f} {y:g}h6" for y, _ in members)
        out.append(f'<path class="bracket" d="{path}"/>')
        out += [text(at + 3, y + 3.5, label) for y, label in members if label]
    height = bottom + 36
    if hidden:
        out.append(text(LEFT, height + 10, f"Not observable in these recordings: {len(hidden)}", "b"))
        out += [_hidden_row(h, height + 14 + SMALL_ROW * i) for i, h in enumerate(hidden[:MOST_HIDDEN])]
        height += 18 + SMALL_ROW * min(len(hidden), MOST_HIDDEN)
        if len(hidden) > MOST_HIDDEN:
            out.append(text(LEFT, height + 8, f"and {len(hidden) - MOST_HIDDEN} more, listed below", "off"))
            height += 14
    return height, "".join(out)


def _ranking_bar(entry: JSON, x: Axis, top: float, selected: Sequence[str]) -> str:
    value = _evidence(entry)
    zero, end = x.pixels(0.0), x.pixels(_symlog(value))
    implausible = value > GATE and not entry.get("plausible", True)
    out = text(LEFT, top + 11, plain(entry["effect"]) + " (beyond the data sheet)" * implausible, "b")
    out += f'<path class="bar c{_colour(entry, selected)}" d="M{zero:.1f} {top + 15}H{end:.1f}v9H{zero:.1f}z"/>'
    return out + text(max(zero, end) + 4, top + 23, number(value), "b" if entry["effect"] in selected else "")


def _hidden_row(entry: JSON, top: float) -> str:
    """Return an effect that these recordings cannot show, greyed, with the reason."""
    reason = str(entry.get("reason", ""))
    short = reason if len(reason) <= LONGEST else reason[: LONGEST - 1].rstrip(" ,;:") + "…"
    return (
        f'<g><title>{escape(reason)}</title><path class="off-bar" d="M{LEFT} {top + 4.5}h8v8h-8z"/>'
        f"{text(LEFT + 14, top + 12, plain(entry['effect']), 'off')}{text(LEFT + 14, top + 24, short, 'off small')}</g>"
    )


def _brackets(shown: Sequence[JSON], selected: Sequence[str]) -> list[list[tuple[float, str]]]:
    """Return the groups of similar effects, selected ones first: height of each member's bar, and its share."""
    rows = {r["effect"]: i for i, r in enumerate(shown)}
    brackets: list[list[tuple[float, str]]] = []
    joined: set[frozenset[str]] = set()
    for entry in sorted(shown, key=lambda r: r["effect"] not in selected):
        alike = {a["effect"]: a["share"] for a in entry.get("look_alikes") or [] if a["effect"] in rows}
        alike = {n: share for n, share in alike.items() if frozenset((n, entry["effect"])) not in joined}
        if not alike or len(brackets) == BRACKETS:
            continue
        joined |= {frozenset((n, m)) for n in (*alike, entry["effect"]) for m in alike}
        members = [(rows[entry["effect"]], ""), *((rows[n], percent(s)) for n, s in alike.items())]
        brackets.append([(TOP + ROW * row + 19.5, label) for row, label in sorted(members)])
    return brackets


def added_variable(sensor: str, found: JSON) -> Figure | None:
    """Draw the added-variable plot of the first selected effect; None where the diagnosis holds none."""
    shown = (found.get("pictures") or {}).get("added_variable")
    if not shown or not shown["panels"]:
        return None
    unit, effect, panels = shown["unit"], plain(shown["effect"]), []
    points = [_points(p) for p in shown["panels"]]
    ends = np.array([min(float(x.min()) for x, _, _ in points), max(float(x.max()) for x, _, _ in points)])
    scatter, left, total = [], 0.0, 0.0
    for panel, (x, mean, error) in zip(shown["panels"], points, strict=True):
        own = np.array([x.min(), x.max()]) if panel["value"] else ends
        line = Line(own, panel["value"] * own, 5, "model")
        dots = Dots(x, mean, AXES.index(panel["axis"]), mean - 2.0 * error, mean + 2.0 * error)
        panels.append(Panel([line, dots], f"{panel['axis']}, {unit}", 92, {"": 0.0}))
        off = ((mean - panel["value"] * x) / error) ** 2
        scatter.append(float(np.mean(off)))
        left, total = left + float(off.sum()), total + float(np.sum((mean / error) ** 2))
    straight = max(scatter) < ON_THE_LINE or 1.0 - left / max(total, 1e-300) > MOST_EXPLAINED
    best = max(shown["panels"], key=lambda p: abs(p["value"]) / max(p["standard_uncertainty"], 1e-300))
    finding = f"{effect.capitalize()} shows: {_coefficient(best)}"
    finding += ", and the points follow the line" if straight else "; some points leave the line"
    what = best["parameter"] if len({p["parameter"] for p in shown["panels"]}) == 1 else "each parameter"
    slopes = "; ".join(dict.fromkeys(_coefficient(p) for p in shown["panels"]))
    x_unit = _column_unit(best["unit"], unit)
    drawn = chart(
        f"{sensor}-added-variable",
        f"{sensor}: {finding}",
        f"Added-variable plot of {effect}. Slopes: {slopes}. Mean square of the points about the line, in standard "
        f"errors: {', '.join(number(s, 2) for s in scatter)}.",
        panels,
        f"column of {what}, less all other columns" + (f", {x_unit}" if x_unit else ""),
    )
    caption = (
        "Readings less what bias, matrix, other effects and bias wander explain, in bins with ±2 standard errors; the "
        f"slope of the line is the parameter ({slopes}; ± covers 95 %)."
    )
    return Figure(drawn, caption, (("c5", "slope = parameter"),), finding)


def _points(panel: JSON) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return bin centres, means and standard errors."""
    x, mean, error = (np.array(panel[key], float) for key in ("x", "mean", "standard_error"))
    return x, mean, np.maximum(error, 1e-300)


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
    pictures = (found.get("pictures") or {}).get("unexplained") or []
    return [_unexplained(sensor, shown, entries.get(shown["covariate"], {})) for shown in pictures]


def _unexplained(sensor: str, shown: JSON, entry: JSON) -> Figure:
    unit, covariate, panels, off = shown["unit"], plain(shown["covariate"]), [], []
    for panel in shown["panels"]:
        x, mean, error = _points(panel)
        layers: list[Layer] = [Dots(x, mean, AXES.index(panel["axis"]), mean - 2.0 * error, mean + 2.0 * error)]
        if "curve" in panel:
            curve_x, curve = (np.array(panel[key], float) for key in ("curve_x", "curve"))
            layers.insert(0, Line(curve_x, curve, 5, "model"))
            off.append(float(np.mean(((mean - np.interp(x, curve_x, curve)) / error) ** 2)))
        panels.append(Panel(layers, f"{panel['axis']}, {unit}", 76, {"": 0.0}))
    finding = f"The residual depends on {covariate}" + (f": {entry['shape']}" if entry.get("shape") else "")
    finding = finding.replace(" -", f" {MINUS}")
    reaches = [f"{p['axis']} up to {number(float(np.abs(p['mean']).max()))} {unit}" for p in shown["panels"]]
    drawn = chart(
        f"{sensor}-unexplained-{shown['covariate']}",
        f"{sensor}: {finding}",
        f"Binned means of the residual: {', '.join(reaches)}.",
        panels,
        SIGNALS.get(shown["signal"], f"what the axis should read, {SENSOR_UNITS[sensor]}"),
        kind="angle" if shown["signal"] == "angle" else "",
    )
    caption = "Residual in bins, with ±2 standard errors of white noise and the expected bias wander"
    if off:
        caption += "; the line is the suggested shape, fitted together with bias, matrix and effects"
    if entry.get("delta_bic"):
        caption += f" (ΔBIC {number(entry['delta_bic'])})"
    follow = all(mean_square < ON_THE_LINE for mean_square in off)
    caption += ". No effect of the catalogue explains it." if follow else ". The points do not follow it well."
    return Figure(drawn, caption, (("c5", "suggested shape"),) if off else (), finding)
