"""Checks that every section of an ingest profile shares."""

from __future__ import annotations

import difflib
import math
from typing import TYPE_CHECKING, Any

from pipeline.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Mapping


def refuse_unknown(where: str, entries: Mapping[str, Any], allowed: tuple[str, ...]) -> None:
    """Refuse a key that is none, with the nearest that is one."""
    if not hasattr(entries, "keys"):
        raise ConfigurationError(f"{where} is {entries!r}; it is a mapping with {', '.join(allowed)}")
    for key in entries:
        if key not in allowed:
            near = difflib.get_close_matches(str(key), allowed, 1)
            hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(allowed)}"
            raise ConfigurationError(f"{where}.{key} is unknown; {hint}")


def is_number(value: object) -> bool:
    """Return whether a value is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
