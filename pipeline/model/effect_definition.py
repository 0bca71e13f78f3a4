"""What a file in ``effects/`` may say of an effect of the user's own, checked to the letter.

    name: gear_mesh                 # the file's stem
    owner: table                    # sensor (compensated in field logs), recording, mounting or table
    sensors: [gyroscope]
    meaning: The gear of the table pushes five times a turn.
    terms:                          # the effect is the sum of coefficient times formula
      A: {formula: "cos(5 * radians(angle))", unit: deg/s}
      B: {formula: "sin(5 * radians(angle))", unit: deg/s}
    axes: [x, y, z]                 # optional: which axes have a coefficient of their own
    limits: {A: 0.1, B: 0.1}        # optional: largest plausible absolute value of each coefficient
    excitation: ...                 # optional texts: what shows it, what tells it from others, where it comes from
    experiment: ...
    source: ...

A formula that is a list of three is a vector with one coefficient that the axes share. ``unit`` and each limit may be a
mapping from sensor to value where the sensors differ.
"""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from pipeline.errors import ConfigurationError
from pipeline.model.effects import built_in
from pipeline.model.effects.base import Owner
from pipeline.model.formula import parse
from pipeline.records import AXES, SENSORS

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from pipeline.model.formula import Formula

    Lines = Mapping[tuple[str, ...], int]

REQUIRED = ("name", "owner", "sensors", "meaning", "terms")
TEXTS = ("meaning", "excitation", "experiment", "source")
KEYS = (*REQUIRED, "axes", "limits", "excitation", "experiment", "source")
NAME = re.compile(r"[a-z][a-z0-9_]{0,49}")
TERM = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,19}")
RESERVED = ("auto", "all", "none")
MOST_TERMS, LONGEST_TEXT, LONGEST_UNIT = 12, 500, 30
OF_THE_TABLE = {"angle", "rate"}


@dataclass(frozen=True)
class TermDefinition:
    """One term: a formula for all axes, or one for each, and the unit of its coefficient per sensor."""

    name: str
    formulas: tuple[Formula, ...]
    units: dict[str, str]
    limits: dict[str, float]

    @property
    def shared(self) -> bool:
        """Whether it is a vector with one coefficient."""
        return len(self.formulas) == 3

    @property
    def signals(self) -> frozenset[str]:
        """The signals in it."""
        return frozenset().union(*(formula.signals for formula in self.formulas))


@dataclass(frozen=True)
class Definition:
    """An effect of the user's own, checked.

    Attributes
    ----------
    name : str
    owner : Owner
    sensors, axes : tuple of str
    terms : tuple of TermDefinition
    texts : dict of str to str
        ``meaning`` and, where given, ``excitation``, ``experiment``, ``source``.
    source : dict
        The mapping itself, as plain data that JSON holds.
    """

    name: str
    owner: Owner
    sensors: tuple[str, ...]
    axes: tuple[str, ...]
    terms: tuple[TermDefinition, ...]
    texts: dict[str, str]
    source: dict[str, Any]


def read_definition(given: object, where: str, lines: Lines | None = None) -> Definition:
    """Check what a file says of an effect.

    Parameters
    ----------
    given : anything
        What the file holds.
    where : str
        The file, for messages.
    lines : mapping, optional
        Keys from the top to their line in the file.

    Raises
    ------
    ConfigurationError
        At the first thing that is wrong, with file, line, and what is expected.
    """
    return _Check(where, lines or {}).definition(given)


@dataclass(frozen=True)
class _Check:
    where: str
    lines: Lines = field(default_factory=dict)

    def definition(self, given: object) -> Definition:
        given = self._mapping(given, (), "an effect")
        self._known(given, (), KEYS, required=REQUIRED)
        name = self._name(given["name"])
        sensors = self._choices(given["sensors"], ("sensors",), SENSORS)
        axes = self._choices(given.get("axes", list(AXES)), ("axes",), AXES)
        owner = self._one_of(given["owner"], ("owner",), [str(o) for o in Owner])
        limits = self._mapping(given.get("limits", {}), ("limits",), "limits")
        terms = self._terms(given["terms"], sensors, limits)
        texts = {key: self._text(given[key], (key,), LONGEST_TEXT) for key in TEXTS if key in given}
        self._require_meaning(terms, axes, owner)
        if limits and set(limits) != set(given["terms"]):
            expected = ", ".join(given["terms"])
            raise self._wrong(("limits",), f"a limit for each term is expected ({expected}), or none at all")
        source = {**given, "sensors": list(sensors), **({"axes": list(axes)} if "axes" in given else {})}
        return Definition(name, Owner(owner), sensors, axes, terms, texts, source)

    def _terms(
        self,
        given: object,
        sensors: tuple[str, ...],
        limits: dict[str, Any],
    ) -> tuple[TermDefinition, ...]:
        given = self._mapping(given, ("terms",), "terms")
        if not 1 <= len(given) <= MOST_TERMS:
            raise self._wrong(("terms",), f"{len(given)} terms; from 1 to {MOST_TERMS} are expected")
        return tuple(self._term(name, content, sensors, limits) for name, content in given.items())

    def _term(
        self,
        name: str,
        given: object,
        sensors: tuple[str, ...],
        limits: dict[str, Any],
    ) -> TermDefinition:
        path = ("terms", name)
        if not TERM.fullmatch(name):
            raise self._wrong(path, f"{name!r} is no name of a term; use letters, digits and _, at most 20")
        given = self._mapping(given, path, "a term")
        self._known(given, path, ("formula", "unit"), required=("formula", "unit"))
        written = given["formula"]
        texts = written if isinstance(written, list) else [written]
        if len(texts) not in (1, 3) or (isinstance(written, list) and len(texts) != 3):
            raise self._wrong((*path, "formula"), "one formula, or a list of three (x, y, z), is expected")
        formulas = tuple(self._formula(text, (*path, "formula")) for text in texts)
        units = {s: self._text(v, (*path, "unit"), LONGEST_UNIT) for s, v in self._each(given["unit"], sensors, path)}
        sizes = self._each(limits[name], sensors, ("limits", name)) if name in limits else []
        return TermDefinition(name, formulas, units, {s: self._size(v, ("limits", name)) for s, v in sizes})

    def _formula(self, text: object, path: tuple[str, ...]) -> Formula:
        if isinstance(text, (int, float)) and not isinstance(text, bool):
            text = repr(text)
        if not isinstance(text, str):
            raise self._wrong(path, f"a formula is text, not {text!r}")
        try:
            return parse(text)
        except ConfigurationError as error:
            raise self._wrong(path, error.message) from None

    def _require_meaning(self, terms: tuple[TermDefinition, ...], axes: tuple[str, ...], owner: str) -> None:
        for term in terms:
            if not term.signals:
                raise self._wrong(
                    ("terms", term.name), "the formula names no signal: a constant is the bias, which is fitted anyway"
                )
            if owner == Owner.SENSOR and term.signals & OF_THE_TABLE:
                found = " and ".join(sorted(term.signals & OF_THE_TABLE))
                raise self._wrong(
                    ("terms", term.name),
                    f"owner is sensor, but {found} is the table's and no field log holds it; write owner: table",
                )
        names = [n for term in terms for n in ([term.name] if term.shared else [f"{term.name}_{a}" for a in axes])]
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise self._wrong(("terms",), f"two coefficients would be called {twice[0]}; name the terms otherwise")

    def _name(self, given: object) -> str:
        if not isinstance(given, str) or not NAME.fullmatch(given) or given in RESERVED:
            raise self._wrong(
                ("name",), f"{given!r} is no name of an effect; use small letters, digits and _, at most 50"
            )
        if given in built_in():
            raise self._wrong(("name",), f"a built-in effect is called {given}; give yours another name")
        return given

    def _each(self, given: object, sensors: tuple[str, ...], path: tuple[str, ...]) -> list[tuple[str, object]]:
        """Return a value for each sensor: one for all, or a mapping."""
        if not isinstance(given, dict):
            return [(sensor, given) for sensor in sensors]
        self._known(given, path, sensors, required=sensors)
        return list(given.items())

    def _size(self, given: object, path: tuple[str, ...]) -> float:
        try:
            size = float("nan") if isinstance(given, bool) else float(given)  # type: ignore[arg-type]
        except (TypeError, ValueError):
            size = float("nan")
        if not 0.0 < size < float("inf"):
            raise self._wrong(path, f"a number above 0 is expected, not {given!r:.60}")
        return size

    def _text(self, given: object, path: tuple[str, ...], longest: int) -> str:
        text = " ".join(given.split()) if isinstance(given, str) else ""
        if not text or len(text) > longest or not text.isprintable():
            raise self._wrong(path, f"a text of 1 to {longest} characters is expected, not {given!r:.60}")
        return text

    def _one_of(self, given: object, path: tuple[str, ...], known: list[str]) -> str:
        if given not in known:
            raise self._wrong(path, f"{given!r}: one of {', '.join(known)} is expected")
        return str(given)

    def _choices(self, given: object, path: tuple[str, ...], known: tuple[str, ...]) -> tuple[str, ...]:
        if (
            not isinstance(given, list)
            or not given
            or not all(v in known for v in given)
            or len(set(given)) < len(given)
        ):
            raise self._wrong(path, f"a list of some of {', '.join(known)} is expected, not {given!r:.60}")
        return tuple(v for v in known if v in given)

    def _mapping(self, given: object, path: tuple[str, ...], what: str) -> dict[str, Any]:
        if not isinstance(given, dict) or not all(isinstance(key, str) for key in given):
            raise self._wrong(path, f"{what}: a mapping of names is expected, not {given!r:.60}")
        return given

    def _known(
        self, given: dict[str, Any], path: tuple[str, ...], known: Iterable[str], *, required: Iterable[str]
    ) -> None:
        known = tuple(known)
        for key in given:
            if key not in known:
                close = difflib.get_close_matches(key, known, 1)
                hint = f"; nearest: {close[0]}" if close else ""
                raise self._wrong((*path, key), f"unknown key{hint}; valid: {', '.join(known)}")
        lacking = [key for key in required if key not in given]
        if lacking:
            raise self._wrong(path, f"{', '.join(lacking)} is missing")

    def _wrong(self, path: tuple[str, ...], reason: str) -> ConfigurationError:
        line = next((self.lines[path[:n]] for n in range(len(path), 0, -1) if path[:n] in self.lines), None)
        place = f"{self.where}:{line}" if line else self.where
        return ConfigurationError(f"{'.'.join(path)}: {reason}" if path else reason, place)
