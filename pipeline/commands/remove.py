"""Remove effects of a unit from <campaign>/devices/<unit>.yaml, and run the campaign: undoes add."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.commands.add import change, parser_of_edit

if TYPE_CHECKING:
    from collections.abc import Sequence


def main(argv: Sequence[str]) -> int:
    """Run ``python -m pipeline remove CAMPAIGN UNIT SENSOR.EFFECT ...``."""
    return change(parser_of_edit("remove", __doc__).parse_args(argv), remove=True)
