"""Load the templates of pages and texts. Values are escaped in HTML, but not in Markdown, plain text and YAML.

A measured value is written to two digits of its expanded uncertainty (JCGM 100:2008, 7.2.6).
"""

from __future__ import annotations

import json
import math
import re
from collections import deque
from collections.abc import Container, Iterable, Mapping, Sequence
from functools import cache, lru_cache
from html import escape
from pathlib import Path
from textwrap import wrap
from typing import Any, NamedTuple
from urllib.parse import quote

from jinja2 import FileSystemLoader, Template, select_autoescape
from markupsafe import Markup

from pipeline.core.compiled_templates import Templates
from pipeline.core.files import JSON
from pipeline.core.verdicts import Verdict
from pipeline.estimation.candidates import is_fixed
from pipeline.evaluation.diagnosis.words import plain

MARK, LINK_MARK = "<!-- history -->", "<!-- history link -->"  # in templates/unit.html
NOTHING = "\N{EN DASH}"
PREFIXES = ((1.0, ""), (1e-3, "m"), (1e-6, "µ"))
MINUS = "\N{MINUS SIGN}"
# " x the l": largest, least expected (``pipeline.core.verdicts.FIGURES``)
TYPOGRAPHIC = {"+-": "±", " x noise": " × noise", " x the l": " × the l", "delta BIC": "ΔBIC", "degC": "°C"}
TYPOGRAPHIC |= {"^2": "²", "^3": "³", "sqrt(Hz)": "√Hz", "sqrt(s)": "√s", "gauss markov": "Gauss-Markov"}
TEMPLATES = Path(__file__).parent / "templates"
_sections: deque[tuple[JSON, Markup]] = deque(maxlen=2)  # budgets of both sensors of the last unit, and their sections
PUBLISHED_DATA = re.compile(r'<script type="application/json" id="published">(.*?)</script>')  # in a campaign's page


def number(value: object, digits: int = 3) -> str:
    """Return a value to ``digits`` significant digits, with an exponent beyond 1e-4 to 1e5; a dash for no number."""
    if not isinstance(value, (int, float)) or not math.isfinite(value):  # a tuple: a union takes three times as long
        return NOTHING
    if value == 0:
        return "0"
    if 1e-4 <= abs(value) < 1e5:
        decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
        return f"{value:.{decimals}f}".replace("-", MINUS)
    return f"{value:.{digits - 1}e}".replace("-", MINUS).replace("e+", "e")


def measured(value: float | None, expanded: float | None) -> str:
    """Return ``value ± expanded uncertainty``, both to the decimals that two digits of the uncertainty need."""
    if value is None or not math.isfinite(value):
        return NOTHING
    if expanded is None or not math.isfinite(expanded) or expanded <= 0:
        return number(value, 5)
    decimals = 1 - math.floor(math.log10(expanded))
    if decimals > 9:
        return f"{number(value, 7)} ± {number(expanded, 2)}"
    decimals = max(0, decimals)
    return f"{value:z.{decimals}f} ± {expanded:.{decimals}f}".replace("-", MINUS)


def measured_row(values: Sequence[float], expanded: Sequence[float | None]) -> list[str]:
    """Return values of one row, and the largest of their expanded uncertainties as ``± U``, to two digits of it."""
    known = [U for U in expanded if U is not None and math.isfinite(U) and U > 0.0]
    if not known:
        return [*(number(value, 5) for value in values), ""]
    decimals = min(max(0, 1 - math.floor(math.log10(max(known)))), 9)
    texts = [f"{value:z.{decimals}f}".replace("-", MINUS) for value in values]
    return [*texts, f"± {max(known):.{decimals}f}"]


def span(low: float, high: float) -> str:
    """Return an interval of positive values to the decimals of its high end; "at most" where the low one is 0."""
    if not 1e-4 <= high < 1e5:
        return f"{number(low)} to {number(high)}"
    upper = number(high)
    lower = f"{low:.{len(upper.partition('.')[2])}f}"
    return f"{lower} to {upper}" if float(lower) else f"at most {upper}"


class Scale(NamedTuple):
    """An SI prefix for values of a column: value in ``unit`` = value / ``factor``."""

    factor: float
    unit: str


def scale_of(unit: str, *values: float | None) -> Scale:
    """Return the prefix (none, m, µ) with which the largest of the values, in g or deg/s, is at least 1."""
    largest = max((abs(v) for v in values if v is not None and math.isfinite(v)), default=0.0)
    if largest <= 0.0 or not unit.startswith(("g", "deg/s")):
        return Scale(1.0, unit_text(unit))
    factor, prefix = next((p for p in PREFIXES if largest >= p[0]), PREFIXES[-1])
    return Scale(factor, f"{prefix}{unit_text(unit)}")


def in_unit(value: object, scale: Scale) -> str:
    """Return a value of a column in the column's unit."""
    return number(value / scale.factor) if isinstance(value, int | float) else NOTHING


def percent(share: object) -> str:
    """Return a share as percent."""
    return f"{number(100.0 * share, 2)} %" if isinstance(share, int | float) else NOTHING


def percent_change(logarithm: float, largest: float) -> str:
    """Return a ratio, given by its logarithm, as a change in percent, or as a factor.

    All ratios of one cell have the same form: a factor where the logarithm of the largest is above log 2.
    """
    if largest > math.log(2.0):
        return f"× {number(math.exp(logarithm))}"
    return f"{100.0 * math.expm1(logarithm):+.1f} %".replace("-", MINUS)


def probability(value: object) -> str:
    """Return a p-value; below 1e-12 as a bound."""
    if not isinstance(value, int | float):
        return NOTHING
    return "< 1e\N{MINUS SIGN}12" if value < 1e-12 else number(value, 2)


@lru_cache(4096)  # ticks, units and names of effects are the same on many charts and pages
def typeset(sentence: str) -> str:
    """Return a sentence or a unit of the terminal with typographic signs: ``±``, ``−``, ``ΔBIC``, ``°C``."""
    for ascii_text, sign in TYPOGRAPHIC.items():
        sentence = sentence.replace(ascii_text, sign)
    return re.sub(r"-(?=\d)(?:(?<![\w.-]-)|(?<=\de-))", MINUS, sentence)  # searched by its first letter: fast


def unit_text(unit: object) -> str:
    """Return a unit as text behind a number; empty for the unit 1."""
    return "" if unit in (None, "1") else typeset(str(unit))


def aligned(rows: Sequence[Sequence[str]], width: int | None = None) -> list[str]:
    """Return rows as lines of a terminal with aligned columns; the last column is wrapped to the width."""
    if not rows:
        return []
    *widths, _ = (max(map(len, column)) for column in zip(*rows, strict=True))
    lines, start = [], 2 + sum(widths) + 2 * len(widths)
    for *cells, last in rows:
        parts = wrap(last, width - start, break_long_words=False) if width and last else [last]
        head = "".join(f"{cell.ljust(size)}  " for cell, size in zip(cells, widths, strict=True))
        lines += [f"  {head}{parts[0]}".rstrip(), *(" " * start + part for part in parts[1:])]
    return lines


def budget_section(budget: JSON) -> Markup:
    """Return the section of an uncertainty budget, made once for the page and the certificate of a unit."""
    for known, made in _sections:
        if known is budget:
            return made
    section: Markup = template("budget.html").module.budget(budget)  # type: ignore[attr-defined]  # a macro
    _sections.append((budget, section))
    return section


@lru_cache(512, typed=True)  # as ``typeset``; a text and markup differ
def heading(name: str) -> Markup:
    """Return a cell of a table's head; "#" before its name aligns the column as numbers."""
    of_numbers = Markup(' class="n"') if name.startswith("#") else ""
    head = Markup('<th scope="col"{}>{}</th>').format(of_numbers, name.removeprefix("#"))
    return head if name else Markup("<td></td>")


def _figure(value: object, scale: Scale | None = None) -> str:
    """Return a number for a cell of a column with an SI prefix, empty for another value."""
    return number(value / (scale.factor if scale else 1.0)) if isinstance(value, int | float) and value == value else ""  # noqa: PLR0124  (not NaN)


@cache
def _environment() -> Templates:
    escaped = select_autoescape(disabled_extensions=["md", "txt", "yaml"], default=True)
    environment = Templates("report", FileSystemLoader(TEMPLATES), autoescape=escaped)
    of_numbers = (aligned, in_unit, measured, number, percent, percent_change, probability, span, typeset)
    environment.filters |= {one.__name__: one for one in of_numbers}
    environment.filters |= {"words": plain, "figure": _figure, "unit": unit_text}
    environment.filters |= {"parameter_texts": parameter_texts, "details": stage_details, "monte_carlo": monte_carlo_of}
    environment.filters |= {"script_data": script_data, "numeric": "#{}".format, "heading": heading}
    environment.globals |= {one.__name__: one for one in (asset, unit_link, Verdict, budget_section)}
    return environment


def template(name: str) -> Template:
    """Return a template by its file name."""
    return _environment().get_template(name)


def compile_templates() -> None:
    """Compile all templates before processes are forked from this one."""
    for file in (*TEMPLATES.glob("*.html"), *TEMPLATES.glob("*.txt")):
        template(file.name)


@cache
def asset(name: str) -> Markup:
    """Return a style sheet or script of the templates' folder."""
    return Markup((TEMPLATES / name).read_text(encoding="utf-8"))  # noqa: S704  (our own file)


def unit_link(unit: str, published: Container[str] | None) -> Markup:
    """Return a unit's name with a link to its page if it is one of the ``published`` units; None: all have a page."""
    address = f' href="reports/{quote(unit)}.html"' if published is None or unit in published else ""
    return Markup(f"<a{address}>{escape(unit)}</a>")  # noqa: S704  (the name is escaped)


def linked(page: str, units: Iterable[str]) -> str:
    """Return a campaign's page with links to units whose pages were published later."""
    for unit in units:
        name, link = unit_link(unit, ()), unit_link(unit, None)
        for without, with_link in ((name, link), (script_data(name)[1:-1], script_data(link)[1:-1])):
            page = page.replace(str(without), str(with_link))
    found = PUBLISHED_DATA.search(page)
    if found:
        names = [*json.loads(found[1]), *units]
        page = page.replace(found[0], found[0].replace(found[1], script_data(sorted(set(names)))))
    return page


def script_data(value: object) -> Markup:
    """Return a value as JSON for a script element; raises ``ValueError`` if a number is not finite."""
    text = json.dumps(value, ensure_ascii=False, allow_nan=False)
    return Markup(text.replace("<", "\\u003c"))  # noqa: S704  (no tag can begin)


def failure_page(unit: str, failure: Mapping[str, Any], *, calibrated: bool = False) -> str:
    """Return a page for a unit whose page cannot be rendered; it needs no template and no results."""
    where = f"{failure['file']}: " if failure["file"] else ""
    address = quote(unit)
    result = (
        f'is calibrated (<a href="../calibrations/{address}.json">calibrations/{escape(unit)}.json</a>), but its page '
        "and its calibration report could not be made"
        if calibrated
        else "has no result"
    )
    cause = escape(f"{where}{failure['message']}")
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(unit)}</title>'
        '<meta name="viewport" content="width=device-width"><style>:root { color-scheme: light dark; } '
        "body { font: 15px/1.5 sans-serif; margin: 24px; } pre { white-space: pre-wrap; }</style></head>\n"
        f"<body><h1>{escape(unit)}</h1><p>This unit {result}: the stage {escape(failure['stage'])} failed "
        f"({escape(failure['code'])}).</p><pre>{cause}</pre>\n"
        '<p><a href="../index.html">The campaign</a></p></body></html>\n'
    )


def stage_details(stage: JSON) -> list[str]:
    """Return the details of a stage of the fit that have one value, as texts."""
    details = {k: v for k, v in (stage.get("details") or {}).items() if isinstance(v, int | float | str | bool)}
    shown = {k: number(v, 4) if isinstance(v, float) else f"{v:,}" if type(v) is int else v for k, v in details.items()}
    texts = {k: f"{plain(k)}: {text}" for k, text in shown.items()}
    if details.get("samples_left_out"):
        texts["samples_left_out"] += (
            " (marked samples, and samples that the method does not use: outside of rests or steady turns, "
            "or of a vague log)"
        )
    return list(texts.values())


def parameter_texts(parameters: JSON | None, *, uncertain: bool = True) -> list[str]:
    """Return ``name = value ± uncertainty unit`` for each parameter of an effect or a stage.

    Where only a standard uncertainty is stated, twice its value is shown, which covers about 95 %.
    """
    texts = []
    for name, given in (parameters or {}).items():
        p = given if isinstance(given, dict) else {"value": given}
        if is_fixed(name, p["value"], p.get("unit"), p.get("standard_uncertainty")):
            texts.append(f"{name} fixed at 0")
            continue
        standard = p.get("standard_uncertainty")
        expanded = p.get("expanded_uncertainty", 2.0 * standard if standard else None)
        value = measured(p.get("value"), expanded if uncertain else None)
        texts.append(f"{name} = {value} {unit_text(p.get('unit'))}".rstrip())
    return texts


def monte_carlo_of(budget: JSON) -> JSON | None:
    """Return the result of the Monte Carlo run of an uncertainty budget for the page; None without a run.

    ``finding``: a sentence; ``rows``: the index of each uncertain parameter.
    """
    run = budget.get("monte_carlo")
    if not run:
        return None
    if not run["trials"]:
        return {"finding": f"No Monte Carlo run: {run['reason']}.", "rows": []}
    rows = [j for j, U in enumerate(run["expanded_uncertainty"]) if U > 0.0]
    validated = sum(run["validated"][j] for j in rows)
    digit = "second" if run["digits"] == 2 else "first"
    finding = f"Monte Carlo, {run['trials']:,} trials: the interval of {validated} of {len(rows)} parameters agrees"
    finding += f" with the budget's to half a unit of the {digit} digit of u."
    if validated < len(rows):
        finding += " Where it does not, use the Monte Carlo interval."
    return {"finding": finding, "rows": rows}
