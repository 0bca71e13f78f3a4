"""The evidence for each effect as bars: the gate, what looks alike, and what could not be seen.

    length = v / 10 where |v| <= 10, else sign(v) (1 + log10(|v| / 10)),    v = delta BIC

so that the gate at 10 stands one length right of zero, and evidence for and against an effect can share an axis.
Brackets at the right join an effect to those that reproduce most of its signal: the data tell such a group, the margin
within it tells which of them.
"""

from __future__ import annotations

import math
from html import escape
from typing import TYPE_CHECKING

from pipeline.report.axes import Scale
from pipeline.report.figure import JSON, Figure, plain
from pipeline.report.numbers import number, percent
from pipeline.report.svg import WIDTH, frame, text

if TYPE_CHECKING:
    from collections.abc import Sequence

GATE = 10.0
MOST, FEWEST, MOST_HIDDEN, LANES = 9, 3, 6, 2
ROW, SMALL_ROW, LEFT, TOP = 29, 27, 6, 18
NUMBERS, LANE = 52, 48
LONGEST = 66  # letters of a reason that fit into a line
LOWEST = -100.0
CLOSE = 0.8  # of the selected effect's delta BIC: another that reaches it is no clear loser
COLOURS = {2: "selected", 4: "passes the gate", 3: "below the gate"}


def ranking(sensor: str, diagnosis: JSON) -> Figure | None:
    """Draw the ranking of a diagnosis; None where there is neither a candidate nor one that could not be seen.

    Parameters
    ----------
    sensor : str
    diagnosis : dict
        The sensor's part.
    """
    found, hidden = diagnosis.get("ranking") or [], diagnosis.get("not_observable") or []
    selected = diagnosis.get("selected") or []
    if not found:
        return None
    helpful = [r for r in found if _value(r) > 0 or r["effect"] in selected][:MOST]
    shown = helpful if len(helpful) >= FEWEST else found[:FEWEST]
    finding = _finding(found, selected)
    words = "; ".join(f"{plain(r['effect'])} {number(_value(r))}{_alike(r)}" for r in shown)
    if hidden:
        words += "; not observable: " + ", ".join(plain(h["effect"]) for h in hidden)
    height, content = _drawn(shown, selected, hidden)
    svg = frame(f"{sensor}-ranking", f"{sensor}: {finding}", f"delta BIC: {words}", height, content)
    rest = len(found) - len(shown)
    caption = (
        "ΔBIC of each effect beyond the configured model: a selected one when it was added, the others alone. Right of "
        "the gate the evidence is strong."
    )
    if any(_alike(r) for r in shown):
        caption += " Brackets join what looks alike: so much of the other one's signal that effect reproduces."
    if rest:
        caption += f" {rest} more {'has' if rest == 1 else 'have'} less evidence; the tables below tell of it."
    kinds = {_colour(r, selected) for r in shown}
    return Figure(svg, caption, tuple((f"c{c}", t) for c, t in COLOURS.items() if c in kinds), finding)


def _colour(entry: JSON, selected: Sequence[str]) -> int:
    return 2 if entry["effect"] in selected else 4 if _value(entry) > GATE else 3


def _value(entry: JSON) -> float:
    return float(entry.get("delta_bic") or 0.0)


def _alike(entry: JSON) -> str:
    alike = entry.get("look_alikes") or []
    return f" (like {', '.join(plain(a['effect']) + ' ' + percent(a['share']) for a in alike)})" if alike else ""


def _finding(found: Sequence[JSON], selected: Sequence[str]) -> str:
    best = max((r for r in found if r["effect"] not in selected), key=_value, default=None)
    nearest = f"{plain(best['effect'])} reaches {number(_value(best))}" if best else ""
    if not selected:
        verb = "No effect passes the gate" if best is None or _value(best) <= GATE else "No effect is selected"
        return f"{verb}: at best, {nearest}" if nearest else verb
    value = _value(next((r for r in found if r["effect"] == selected[0]), {}))
    head, close = plain(selected[0]).capitalize(), best is not None and _value(best) > CLOSE * value
    if len(selected) > 1:
        head += f", before {', '.join(plain(n) for n in selected[1:])},"
    head += f" is selected with ΔBIC {number(value)}" if close else f" stands out: ΔBIC {number(value)}"
    if not nearest:
        return head
    return f"{head}, but {nearest}" if close else f"{head}; of the others, {nearest}"


def symlog(value: float) -> float:
    """Return the length of a bar: linear to the gate on both sides, logarithmic beyond."""
    return value / GATE if abs(value) <= GATE else math.copysign(1.0 + math.log10(abs(value) / GATE), value)


def _drawn(shown: Sequence[JSON], selected: Sequence[str], hidden: Sequence[JSON]) -> tuple[float, str]:
    """Return height and content of the chart."""
    lanes = _lanes(shown, selected)
    end = WIDTH - NUMBERS - LANE * len(lanes)
    values = [_value(r) for r in shown]
    low = max(min(*values, 0.0), LOWEST)
    x = Scale(symlog(low), symlog(max(*values, GATE * 2.0)), LEFT, end)
    bottom = TOP + ROW * len(shown)
    ticks = [-(10.0**k) for k in (2, 1) if low <= -(10.0**k)] + [0.0]
    ticks += [10.0**k for k in range(1, 9) if symlog(10.0**k) <= x.high]
    gate = x.pixels(1.0)
    out = [f'<path class="grid" d="{"".join(f"M{x.pixels(symlog(t)):.1f} {TOP}V{bottom}" for t in ticks)}"/>']
    out += [_bar(r, x, TOP + ROW * i, selected) for i, r in enumerate(shown)]
    out.append(f'<path class="level" d="M{gate:.1f} {TOP}V{bottom}"/>')
    out.append(text(max(gate, LEFT + 18), TOP - 5, "gate 10", "m"))
    out += [text(max(x.pixels(symlog(t)), LEFT + 6), bottom + 13, _tick(t), "m") for t in ticks]
    out.append(text((LEFT + end) / 2, bottom + 28, "ΔBIC (linear to ±10, logarithmic beyond)", "m"))
    out += [_bracket(lane, x.stop + NUMBERS + LANE * k) for k, lane in enumerate(lanes)]
    height = bottom + 36
    if hidden:
        out.append(text(LEFT, height + 10, f"Not observable in these recordings: {len(hidden)}", "b"))
        out += [_hidden(h, height + 14 + SMALL_ROW * i) for i, h in enumerate(hidden[:MOST_HIDDEN])]
        height += 18 + SMALL_ROW * min(len(hidden), MOST_HIDDEN)
        if len(hidden) > MOST_HIDDEN:
            out.append(text(LEFT, height + 8, f"and {len(hidden) - MOST_HIDDEN} more, listed below", "off"))
            height += 14
    return height, "".join(out)


def _tick(value: float) -> str:
    short = f"{value:.0f}" if abs(value) < 1e5 else f"1e{math.log10(value):.0f}"
    return short.replace("-", "\N{MINUS SIGN}")


def _bar(entry: JSON, x: Scale, top: float, selected: Sequence[str]) -> str:
    value = _value(entry)
    zero, end = x.pixels(0.0), x.pixels(max(symlog(value), x.low))
    label = plain(entry["effect"]) + (
        "" if entry.get("plausible", True) or value <= GATE else " (beyond the data sheet)"
    )
    out = text(LEFT, top + 11, label, "b")
    out += f'<path class="bar c{_colour(entry, selected)}" d="M{zero:.1f} {top + 15}H{end:.1f}v9H{zero:.1f}z"/>'
    return out + text(max(zero, end) + 4, top + 23, number(value), "b" if entry["effect"] in selected else "")


def _hidden(entry: JSON, top: float) -> str:
    """Return a greyed line: the effect, and why these recordings cannot show it."""
    reason = str(entry.get("reason", ""))
    short = reason if len(reason) <= LONGEST else reason[: LONGEST - 1].rstrip(" ,;:") + "…"
    return (
        f"<g><title>{escape(reason)}</title>"
        f'<path class="off-bar" d="M{LEFT} {top + 4.5}h8v8h-8z"/>'
        + text(LEFT + 14, top + 12, plain(entry["effect"]), "off")
        + text(LEFT + 14, top + 24, short, "off small")
        + "</g>"
    )


Lane = list[tuple[float, str]]


def _lanes(shown: Sequence[JSON], selected: Sequence[str]) -> list[Lane]:
    """Return the groups that look alike, selected ones first: where each member's bar is, and its share."""
    places = {r["effect"]: i for i, r in enumerate(shown)}
    lanes: list[Lane] = []
    covered: set[frozenset[str]] = set()
    for entry in sorted(shown, key=lambda r: r["effect"] not in selected):
        alike = {a["effect"]: a["share"] for a in entry.get("look_alikes") or [] if a["effect"] in places}
        alike = {n: share for n, share in alike.items() if frozenset((n, entry["effect"])) not in covered}
        if not alike or len(lanes) == LANES:
            continue
        covered |= {frozenset((n, m)) for n in (*alike, entry["effect"]) for m in alike}
        rows = [(places[entry["effect"]], ""), *((places[n], percent(s)) for n, s in alike.items())]
        lanes.append([(TOP + ROW * place + 19.5, label) for place, label in sorted(rows)])
    return lanes


def _bracket(lane: Lane, x: float) -> str:
    """Return a bracket that joins the bars of a group."""
    ticks = "".join(f"M{x - 6:.1f} {y:g}h6" for y, _ in lane)
    labels = "".join(text(x + 3, y + 3.5, label) for y, label in lane if label)
    return f'<path class="bracket" d="M{x:.1f} {lane[0][0]:g}V{lane[-1][0]:g}{ticks}"/>' + labels
