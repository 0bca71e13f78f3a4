"""What a figure of a page is: a chart, the finding above it, a sentence below it, and its legend."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from markupsafe import Markup

JSON = dict[str, Any]
AXES = "xyz"
UNITS = {"accelerometer": "g", "gyroscope": "deg/s"}
AXES_LEGEND = (("c0", "x"), ("c1", "y"), ("c2", "z"))


@dataclass(frozen=True)
class Figure:
    """A chart with its texts.

    Attributes
    ----------
    svg : Markup
    caption : str
        What is drawn, below the chart; empty where a sentence of the page says it for several.
    legend : tuple of (str, str)
        CSS class and text of each colour.
    finding : str
        What it shows in one sentence, above the chart.
    quiet : bool
        Whether nothing is to be seen in it, so that it may stand folded.
    """

    svg: Markup
    caption: str = ""
    legend: tuple[tuple[str, str], ...] = ()
    finding: str = ""
    quiet: bool = False


def plain(name: str) -> str:
    """Return the name of an effect or covariate in words."""
    return name.replace("_", " ")
