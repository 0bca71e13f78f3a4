"""Horizontal bars, one a row, with their text above: the staircase of errors; and upright bars in groups.

    length = log(value / low) / log(high / low)

on a logarithmic axis from ``low`` to ``high``; a bar's length there is no quantity, its end is. So each bar carries its
number, and the levels (the noise floor) are lines that cross all rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING

from pipeline.report.axes import Scale, log_ticks, tick_label, ticks
from pipeline.report.numbers import number
from pipeline.report.svg import WIDTH, frame, text

if TYPE_CHECKING:
    from markupsafe import Markup

ROW, LEFT, RIGHT = 30, 6, 64


@dataclass(frozen=True)
class Bar:
    """One row: its text, its value (None: no bar), its colour class and a remark after the number."""

    label: str
    value: float | None
    colour: int = 0
    remark: str = ""


def bars(
    name: str,
    title: str,
    description: str,
    rows: list[Bar],
    unit: str,
    *,
    levels: dict[str, float] | None = None,
) -> Markup:
    """Return a chart of horizontal bars on a logarithmic axis.

    Parameters
    ----------
    name, title, description : str
        Identifier that is unique on the page, and the text alternatives.
    rows : list of Bar
        From top to bottom.
    unit : str
        Of the values.
    levels : dict of str to float, optional
        Vertical lines by their text.
    """
    levels = {label: value for label, value in (levels or {}).items() if value > 0}
    values = [b.value for b in rows if b.value is not None and b.value > 0] + list(levels.values())
    low, high = (min(values), max(values)) if values else (0.1, 1.0)
    scale = Scale(low / 2.0, high * 1.15, LEFT, WIDTH - RIGHT, logarithmic=True)
    top, bottom = 16 if levels else 4, (16 if levels else 4) + ROW * len(rows)
    at = log_ticks(scale.low, scale.high)
    grid = "".join(f"M{scale.pixels(v):.1f} {top}V{bottom}" for v in at)
    out = [f'<path class="grid" d="{grid}"/>']
    out += [_row(bar, scale, top + ROW * i) for i, bar in enumerate(rows)]
    for label, value in levels.items():
        x = scale.pixels(value)
        out.append(f'<path class="level" d="M{x:.1f} {top}V{bottom}"/>')
        words = f"{label} {number(value)}"
        half = 3.0 * len(words)  # a letter of this size is about 6 px wide
        out.append(text(min(max(x, LEFT + half), WIDTH - half), top - 4, words, "m"))
    out += [text(max(scale.pixels(v), LEFT + 14), bottom + 13, tick_label(v, v), "m") for v in at]
    out.append(text((LEFT + WIDTH - RIGHT) / 2, bottom + 27, unit, "m"))
    return frame(name, title, description, bottom + 34, "".join(out))


def _row(bar: Bar, scale: Scale, top: float) -> str:
    out = text(LEFT, top + 11, bar.label, "b")
    if bar.value is None:
        return out + text(LEFT, top + 23, bar.remark or "not known")
    end = scale.pixels(bar.value) if bar.value > 0 else scale.start
    out += f'<path class="bar c{bar.colour}" d="M{LEFT} {top + 15}H{end:.1f}v10H{LEFT}z"/>'
    return out + text(end + 4, top + 24, f"{number(bar.value)} {bar.remark}".strip())


def columns(
    name: str,
    title: str,
    description: str,
    groups: dict[str, list[float]],
    label: str,
    *,
    x_label: str,
    levels: list[float] | None = None,
) -> Markup:
    """Return a chart of upright bars in groups: one colour for each place in a group.

    Parameters
    ----------
    name, title, description : str
    groups : dict of str to list of float
        Values by the text below their group.
    label : str
        Of the values, with unit.
    x_label : str
        Of the groups.
    levels : list of float, optional
        A dash over each group.
    """
    high = max((v for g in [*groups.values(), levels or []] for v in g), default=1.0) or 1.0
    left, top, bottom = 64, 8, 138
    y = Scale(0.0, high * 1.05, bottom, top)
    pitch = (WIDTH - 8 - left) / max(len(groups), 1)
    at = ticks(0.0, y.high, 4)
    step = at[1] - at[0] if len(at) > 1 else 1.0
    out = [f'<path class="grid" d="{"".join(f"M{left} {y.pixels(v):.1f}H{WIDTH - 8}" for v in at)}"/>']
    out += [text(left - 4, y.pixels(v) + 3.5, tick_label(v, step), "e") for v in at]
    for i, (below, values) in enumerate(groups.items()):
        wide = 0.8 * pitch / max(len(values), 1)
        for j, value in enumerate(values):
            x = left + pitch * (i + 0.1) + j * wide
            out.append(
                f'<path class="bar c{j}" d="M{x:.1f} {bottom}V{y.pixels(value):.1f}h{wide:.1f}V{bottom}z"/>',
            )
        out.append(text(left + pitch * (i + 0.5), bottom + 13, below, "m"))
    dashes = "".join(f"M{left + pitch * i:.1f} {y.pixels(v):.1f}h{pitch:.1f}" for i, v in enumerate(levels or []))
    if dashes:
        out.append(f'<path class="level" d="{dashes}"/>')
    out.append(f'<text class="m" transform="translate(10 {(top + bottom) / 2:g}) rotate(-90)">{escape(label)}</text>')
    out.append(text((left + WIDTH - 8) / 2, bottom + 27, x_label, "m"))
    return frame(name, title, description, bottom + 34, "".join(out))
