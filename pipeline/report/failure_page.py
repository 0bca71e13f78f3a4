"""The page of a unit for which no other page could be made: its name and the cause."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping


def failure_page(unit: str, failure: Mapping[str, Any]) -> str:
    """Return a page that needs no template and nothing of the unit's results."""
    where = f"{failure['file']}: " if failure["file"] else ""
    cause = escape(f"{where}{failure['message']}")
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(unit)}</title></head>\n'
        f"<body><h1>{escape(unit)}</h1><p>Not calibrated: the stage {escape(failure['stage'])} failed "
        f"({escape(failure['code'])}).</p><pre>{cause}</pre>\n"
        '<p><a href="../index.html">The campaign</a></p></body></html>\n'
    )
