"""Why some cells differ from the printed ones by more than a quarter: a letter for each reason, and where it holds."""

from __future__ import annotations

import re
from dataclasses import dataclass


@dataclass(frozen=True)
class Explanation:
    """One reason.

    Attributes
    ----------
    key : str
    text : str
    where : str
        Regular expression of ``table|block|row|column``.
    """

    key: str
    text: str
    where: str


EXPLANATIONS: tuple[Explanation, ...] = ()


def key_of(table: str, block: str, row: str, column: str) -> str:
    """Return the key of the first explanation that holds for a cell, or nothing."""
    place = f"{table}|{block}|{row}|{column}"
    return next((e.key for e in EXPLANATIONS if re.search(e.where, place)), "")
