"""Check values from files that users write or edit: a check returns the value, or raises what is wrong and where.

``fields``, ``each`` and ``items`` build the check of a document from those of its values. Only the standard library is
imported: every job reads the effects that ship, and pydantic would add 0.1 s to its start.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Callable
from math import isfinite
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

Check = Callable[[Any], Any]


class WrongValueError(Exception):
    """A value is invalid: the reason, and the keys and indices that lead to the value."""

    def __init__(self, reason: str, *path: str | int) -> None:
        super().__init__(reason)
        self.reason, self.path = reason, path

    def __str__(self) -> str:
        place = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in self.path).lstrip(".")
        return f"{place}: {self.reason}" if place else self.reason


def expected(what: str, given: object) -> WrongValueError:
    """Return the error that states the expected value and the given one."""
    shown = json.dumps(given, default=str, ensure_ascii=False)
    return WrongValueError(f"{what} is expected, not {shown if len(shown) <= 60 else f'{shown[:57]}...'}")


def fields(checks: Mapping[str, Check], required: Iterable[str] = (), *, others: bool = False) -> Check:
    """Return the check of a mapping with these keys; ``others``: allow any other key, and drop it."""

    def check(given: object) -> dict[str, Any]:
        values = mapping(given)
        for key in () if others else values:
            if key not in checks:
                close = difflib.get_close_matches(str(key), checks, 1)
                nearest = f"; nearest: {close[0]}" if close else ""
                raise WrongValueError(f"unknown key{nearest}; valid: {', '.join(checks)}", str(key))
        for key in required:
            if key not in values:
                raise WrongValueError(f"{key} is missing")
        return {key: _at(key, checks[key], value) for key, value in values.items() if key in checks}

    return check


def each(check: Check) -> Check:
    """Return the check of a mapping of any keys to values."""
    return lambda given: {str(key): _at(str(key), check, value) for key, value in mapping(given).items()}


def items(check: Check, count: int | None = None) -> Check:
    """Return the check of a list; with ``count``, of exactly so many values."""
    what = "a list" if count is None else f"a list of {count} values"

    def checked(given: object) -> list[Any]:
        if not isinstance(given, list) or count not in {None, len(given)}:
            raise expected(what, given)
        return [_at(i, check, value) for i, value in enumerate(given)]

    return checked


def or_none(check: Check) -> Check:
    """Return the check of a value that may be null."""
    return lambda given: None if given is None else check(given)


def one_of(*known: str) -> Check:
    """Return the check that a value is one of the given texts."""
    *first, last = (repr(str(k)) for k in known)
    what = f"one of {', '.join(first)} or {last}" if first else last

    def check(given: object) -> str:
        if given not in known:
            raise expected(what, given)
        return known[known.index(str(given))]

    return check


def mapping(given: object) -> dict[Any, Any]:
    """Return the value if it is a mapping."""
    if not isinstance(given, dict):
        raise expected("a mapping of names", given)
    return given


def text(given: object) -> str:
    """Return the value if it is a text."""
    if not isinstance(given, str):
        raise expected("a text", given)
    return given


def flag(given: object) -> bool:
    """Return the value if it is true or false."""
    if not isinstance(given, bool):
        raise expected("true or false", given)
    return given


def number(given: object) -> float:
    """Return the value if it is a finite number."""
    if isinstance(given, bool) or not isinstance(given, (int, float)) or not isfinite(given):
        raise expected("a finite number", given)
    return given


def _at(key: str | int, check: Check, value: object) -> Any:  # noqa: ANN401
    """Return the checked value of a key; an error names the key."""
    try:
        return check(value)
    except WrongValueError as wrong:
        raise WrongValueError(wrong.reason, key, *wrong.path) from None
