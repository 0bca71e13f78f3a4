"""The calibration report as a page that prints well: the identification on every sheet, a clear end."""

from __future__ import annotations

from typing import TYPE_CHECKING

from markupsafe import Markup

from pipeline.report.budget_table import budget_of
from pipeline.report.templating import template

if TYPE_CHECKING:
    from pipeline.report.figure import JSON


def render(unit: str, report: JSON) -> str:
    """Return the page of a report that ``certificate.certificate`` made.

    Parameters
    ----------
    unit : str
    report : dict
    """
    core = report["administrativeData"]["coreData"]
    sheet = f"{core['title']} {core['uniqueIdentifier'] or unit}"
    if report["stamp"]:
        sheet += " \N{MIDDLE DOT} NOT A CALIBRATION CERTIFICATE"
    budgets = {
        r["name"]: budget_of({"uncertainty_budget": r["uncertaintyBudget"]}) for r in report["measurementResults"]
    }
    page: str = template("certificate.html").render(unit=unit, report=report, sheet=_css_text(sheet), budgets=budgets)
    return page


def _css_text(text: str) -> Markup:
    """Return text for a string of a style sheet: everything but letters and digits as its number."""
    return Markup("".join(c if c.isascii() and c.isalnum() else f"\\{ord(c):x} " for c in text))  # noqa: S704  (no markup left)
