"""The templates of the pages: HTML, CSS and JavaScript beside this file, every value escaped."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, Template
from markupsafe import Markup

from pipeline.report.numbers import measured, number, percent, probability, typeset

FOLDER = Path(__file__).parent / "templates"


class Pages(Environment):
    """Templates whose values are dicts for the most part: ``row.name`` does not look for an attribute first."""

    def getattr(self, obj: Any, attribute: str) -> Any:  # noqa: ANN401  (as of the base class)
        """Return a key of a dict, or what the base class finds."""
        if type(obj) is dict and attribute in obj and not hasattr(dict, attribute):
            return obj[attribute]
        return super().getattr(obj, attribute)


@cache
def template(name: str) -> Template:
    """Return a template by its file name."""
    environment = Pages(
        loader=FileSystemLoader(FOLDER),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(
        number=number,
        measured=measured,
        percent=percent,
        probability=probability,
        typeset=typeset,
        words=lambda s: s.replace("_", " "),
    )
    environment.globals["asset"] = asset
    return environment.get_template(name)


@cache
def asset(name: str) -> Markup:
    """Return a style sheet or script of our own as it is."""
    return Markup((FOLDER / name).read_text(encoding="utf-8"))  # noqa: S704  (our own file)
