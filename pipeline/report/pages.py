"""Load the templates of pages and texts. Values are escaped in HTML, but not in Markdown, plain text and YAML."""

from __future__ import annotations

import json
import re
from functools import cache
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from jinja2 import Environment, FileSystemLoader, Template, select_autoescape
from markupsafe import Markup

from pipeline.report import numbers
from pipeline.report.parameters import monte_carlo_of, parameter_texts, stage_details

if TYPE_CHECKING:
    from collections.abc import Container, Iterable, Mapping

FOLDER = Path(__file__).parent / "templates"
OF_NUMBERS = ("aligned", "measured", "number", "percent", "percent_change", "probability", "span", "typeset")  # filters
PUBLISHED = re.compile(r'<script type="application/json" id="published">(.*?)</script>')  # in a campaign's page


def _figure(value: object) -> str:
    """Return a number for a cell, empty for another value."""
    return numbers.number(value) if isinstance(value, int | float) and value == value else ""  # noqa: PLR0124  (not NaN)


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(FOLDER),
        auto_reload=False,
        autoescape=select_autoescape(disabled_extensions=["md", "txt", "yaml"], default=True),
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {name: getattr(numbers, name) for name in OF_NUMBERS}
    environment.filters |= {"words": numbers.plain, "figure": _figure, "unit": numbers.unit_text}
    environment.filters |= {"parameter_texts": parameter_texts, "details": stage_details, "monte_carlo": monte_carlo_of}
    environment.filters |= {"script_data": script_data, "numeric": "#{}".format}
    environment.globals |= {"asset": asset, "unit_link": unit_link}
    return environment


def template(name: str) -> Template:
    """Return a template by its file name."""
    return _environment().get_template(name)


def compile_templates() -> None:
    """Compile all templates before processes are forked from this one."""
    for file in (*FOLDER.glob("*.html"), *FOLDER.glob("*.txt")):
        template(file.name)


@cache
def asset(name: str) -> Markup:
    """Return a style sheet or script of the templates' folder."""
    return Markup((FOLDER / name).read_text(encoding="utf-8"))  # noqa: S704  (our own file)


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
    found = PUBLISHED.search(page)
    if found:
        names = [*json.loads(found[1]), *units]
        page = page.replace(found[0], found[0].replace(found[1], script_data(sorted(set(names)))))
    return page


def script_data(value: object) -> Markup:
    """Return a value as JSON for a script element; raises ``ValueError`` if a number is not finite."""
    text = json.dumps(value, ensure_ascii=False, allow_nan=False)
    return Markup(text.replace("<", "\\u003c"))  # noqa: S704  (no tag can begin)


def failure_page(unit: str, failure: Mapping[str, Any]) -> str:
    """Return a page for a unit whose page cannot be rendered; it needs no template and no results."""
    where = f"{failure['file']}: " if failure["file"] else ""
    cause = escape(f"{where}{failure['message']}")
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(unit)}</title>'
        '<meta name="viewport" content="width=device-width"><style>:root { color-scheme: light dark; } '
        "body { font: 15px/1.5 sans-serif; margin: 24px; } pre { white-space: pre-wrap; }</style></head>\n"
        f"<body><h1>{escape(unit)}</h1><p>This unit has no result: the stage {escape(failure['stage'])} failed "
        f"({escape(failure['code'])}).</p><pre>{cause}</pre>\n"
        '<p><a href="../index.html">The campaign</a></p></body></html>\n'
    )
