"""The file of an effect: what it may say, checked to the letter. Built-in effects and those of users have one schema.

    name: gear_mesh                 # the file's stem
    owner: table                    # sensor (compensated in field logs), recording, mounting or table
    sensors: [gyroscope]
    meaning: The gear of the table pushes five times a turn.
    terms:                          # the effect is the sum of coefficient times formula
      A: {formula: "cos(5 * radians(angle))", unit: deg/s}
      B: {formula: "sin(5 * radians(angle))", unit: deg/s}

A term has one of three forms:

    formula: text                   # on each axis, with a coefficient for each axis: A_x, A_y, A_z
    formula: {x: .., y: .., z: ..}  # likewise, with a formula for each axis
    formula: [.., .., ..]           # a vector (x, y, z) with one coefficient

A star in the name of a term stands for the axis (``G_*x``: G_xx, G_yx, G_zx). ``docs/effects_of_your_own.md`` lists all
keys. A built-in effect that no formula can state names its class (``python: timing.TimeOffset``) and ``parameters``.
"""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple

from pipeline.errors import ConfigurationError
from pipeline.model.effects.base import Owner, Parameter
from pipeline.model.formula import SIGNALS, Formula, parse
from pipeline.records import AXES, SENSORS

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from pydantic import GetCoreSchemaHandler, ValidationError
    from pydantic_core import CoreSchema

    Lines = Mapping[tuple[str, ...], int]

NAME = re.compile(r"[a-z][a-z0-9_]{0,49}")
TERM = re.compile(r"[A-Za-z](?=.{0,19}$)[A-Za-z0-9_]*\*?[A-Za-z0-9_]*")
RESERVED = ("auto", "all", "none")
MOST_TERMS, LONGEST_TEXT, LONGEST_UNIT = 12, 500, 30  # above every shipped effect; they bound pages and fits


class _Before(NamedTuple):
    """A check before that of pydantic, which only effects of users import: it takes 0.1 s."""

    check: Callable[[Any], Any]

    def __get_pydantic_core_schema__(self, source: object, handler: GetCoreSchemaHandler) -> CoreSchema:
        from pydantic_core import core_schema  # noqa: PLC0415  (0.1 s that only effects of users pay)

        return core_schema.no_info_before_validator_function(self.check, handler(source))


def _text(longest: int) -> Callable[[object], str]:
    def check(given: object) -> str:
        text = " ".join(given.split()) if isinstance(given, str) else ""
        if not text or len(text) > longest or not text.isprintable():
            raise ValueError(f"a text of 1 to {longest} characters is expected, not {given!r:.60}")
        return text

    return check


def _name(given: object) -> str:
    if not isinstance(given, str) or not NAME.fullmatch(given) or given in RESERVED:
        raise ValueError(f"{given!r} is no name of an effect; use small letters, digits and _, at most 50")
    return given


def _some_of(known: tuple[str, ...]) -> Callable[[object], tuple[str, ...]]:
    def check(given: object) -> tuple[str, ...]:
        listed = isinstance(given, (list, tuple)) and given and len({*map(str, given)}) == len(given)
        if not listed or not all(v in known for v in given):  # type: ignore[attr-defined]
            raise ValueError(f"a list of some of {', '.join(known)} is expected, not {given!r:.60}")
        return tuple(v for v in known if v in given)  # type: ignore[operator]

    return check


class Formulas(NamedTuple):
    """The formula of each axis, or of ``""`` for all axes; shared: they are a vector with one coefficient."""

    of: dict[str, Formula]
    shared: bool


def _formulas(given: object) -> Formulas:
    vector = isinstance(given, list)
    if isinstance(given, list) and len(given) == len(AXES):
        given = dict(zip(AXES, given, strict=True))
    if isinstance(given, list) or (isinstance(given, dict) and set(given) != set(AXES)):
        raise ValueError("one formula, a list of three (x, y, z), or a mapping of x, y and z is expected")
    texts = {axis: given[axis] for axis in AXES} if isinstance(given, dict) else {"": given}
    return Formulas({axis: _formula(text) for axis, text in texts.items()}, vector)


def _formula(text: object) -> Formula:
    if isinstance(text, bool) or not isinstance(text, (str, int, float)):
        raise ValueError(f"a formula is text, not {text!r}")  # noqa: TRY004  (pydantic collects ValueError)
    try:
        return parse(text if isinstance(text, str) else repr(text))
    except ConfigurationError as error:
        raise ValueError(error.message) from None


def _size(given: Any) -> Any:  # noqa: ANN401
    try:
        size = float("nan") if isinstance(given, bool) else float(given)
    except (TypeError, ValueError):
        size = float("nan")
    if not isinstance(given, dict) and not 0.0 < size < float("inf"):
        raise ValueError(f"a number above 0 is expected, not {given!r:.60}")
    return given if isinstance(given, dict) else size


Text = Annotated[str, _Before(_text(LONGEST_TEXT))]
Unit = Annotated[str, _Before(_text(LONGEST_UNIT))]
Size = Annotated[float, _Before(_size)]
Sensor = Literal["accelerometer", "gyroscope"]


@dataclass(frozen=True, kw_only=True)
class ParameterDeclaration:
    """A parameter of an effect in Python, or a parameter for each axis: its unit (for each sensor) and its meaning."""

    __pydantic_config__: ClassVar = {"extra": "forbid"}

    unit: Unit | dict[Sensor, Unit]
    meaning: Text | None = None

    def unit_for(self, sensor: str) -> str:
        """Return the unit for a sensor."""
        return self.unit if isinstance(self.unit, str) else self.unit[sensor]  # type: ignore[index]


@dataclass(frozen=True, kw_only=True)
class Term(ParameterDeclaration):
    """A term: one formula, or one for each axis, and the unit and the meaning of its coefficient."""

    formula: Annotated[Any, _Before(_formulas)]  # Formulas

    @property
    def signals(self) -> frozenset[str]:
        """The signals in it."""
        return frozenset[str]().union(*(formula.signals for formula in self.formula.of.values()))

    @property
    def by_axis(self) -> bool:
        """Whether its value differs between the axes."""
        return len(self.formula.of) > 1 or "u" in self.signals

    @property
    def text(self) -> str:
        """The formula as it was written."""
        return ", ".join(formula.text for formula in self.formula.of.values())


@dataclass(frozen=True, kw_only=True)
class Declaration:
    """What the file of an effect says."""

    __pydantic_config__: ClassVar = {"extra": "forbid"}

    name: Annotated[str, _Before(_name)]
    built_in: Literal[True] | None = None
    python: str | None = None
    owner: Owner
    sensors: Annotated[tuple[Sensor, ...], _Before(_some_of(SENSORS))]
    meaning: Text
    terms: dict[str, Term] = field(default_factory=dict)
    parameters: dict[str, ParameterDeclaration] = field(default_factory=dict)
    axes: Annotated[tuple[str, ...], _Before(_some_of(AXES))] = AXES
    adds_to: Literal["reading", "truth"] = "reading"
    limits: dict[str, Size | dict[Sensor, Size]] = field(default_factory=dict)
    contains: tuple[str, ...] = ()
    needs_both_directions: bool = False
    excitation: Text | None = None
    experiment: Text | None = None
    source: Text | None = None

    def coefficients(self, term: str) -> list[tuple[str, str]]:
        """Return axis and name of a term's coefficients; no axis where the axes share one."""
        starred = "*" in term
        if starred or (term in self.terms and not self.terms[term].formula.shared):
            return [(a, term.replace("*", a) if starred else f"{term}_{a}") for a in self.axes]
        return [("", term)]

    def parameters_of(self, sensor: str) -> tuple[Parameter, ...]:
        """Return the coefficients: axis by axis those that each axis has of its own, then those that the axes share."""
        every = {**self.terms, **self.parameters}
        return tuple(
            Parameter(name, declared.unit_for(sensor), _meaning(declared, axis))
            for place in (*self.axes, "")
            for term, declared in every.items()
            for axis, name in self.coefficients(term)
            if axis == place
        )


UNKNOWN_KEY = "unexpected_keyword_argument"  # pydantic's type of this error
OF_BUILT_IN = ("built_in", "python", "parameters")
KEYS = tuple(f.name for f in fields(Declaration) if f.name not in OF_BUILT_IN)


def _meaning(declared: ParameterDeclaration, axis: str) -> str:
    text = declared.meaning or (f"coefficient of {declared.text}" if isinstance(declared, Term) else "")
    return f"{text}, {axis} axis" if axis else text


def read_declaration(
    given: Mapping[str, Any], where: str, lines: Callable[[], Lines] = dict, *, built_in: bool = False
) -> Declaration:
    """Check what a file says of an effect.

    Parameters
    ----------
    given : mapping
        What the file holds.
    where : str
        The file, for messages.
    lines : callable
        Returns the keys from the top with their line in the file; called for a message alone.
    built_in : bool
        Whether the file may name a class and ``parameters``.

    Raises
    ------
    ConfigurationError
        At the first thing that is wrong, with file, line, and what is expected.
    """

    def refused(path: tuple[str, ...], reason: str) -> ConfigurationError:
        found = lines()
        line = next((found[path[:n]] for n in range(len(path), 0, -1) if path[:n] in found), None)
        place = f"{where}:{line}" if line else where
        return ConfigurationError(f"{'.'.join(path)}: {reason}" if path else reason, place)

    declared = _shipped(given) if built_in else None
    if declared is None:
        from pydantic import TypeAdapter, ValidationError  # noqa: PLC0415  (0.1 s that only effects of users pay)

        try:
            declared = TypeAdapter(Declaration).validate_python(given)
        except ValidationError as error:
            raise refused(*_first(error)) from None
    for key in OF_BUILT_IN:
        if key in given and not built_in:
            raise refused((key,), f"unknown key; valid: {', '.join(KEYS)}")
    wrong = _contradiction(declared)
    if wrong:
        raise refused(*wrong)
    return declared


def _shipped(given: Mapping[str, Any]) -> Declaration | None:
    """Return what a file that ships says, without its checks, which a test makes; None where it has another form."""
    try:
        terms = {n: Term(**{**t, "formula": _formulas(t["formula"])}) for n, t in given.get("terms", {}).items()}
        parameters = {n: ParameterDeclaration(**p) for n, p in given.get("parameters", {}).items()}
        limits = {
            name: {k: _size(v) for k, v in size.items()} if isinstance(size, dict) else _size(size)
            for name, size in given.get("limits", {}).items()
        }
        lists = {key: tuple(given[key]) for key in ("sensors", "axes", "contains") if key in given}
        made = {"terms": terms, "parameters": parameters, "limits": limits, "owner": Owner(given["owner"])}
        return Declaration(**{**given, **lists, **made})
    except (AttributeError, KeyError, TypeError, ValueError):
        return None


def _first(error: ValidationError) -> tuple[tuple[str, ...], str]:
    """Return path and reason of the first error; an unknown key goes before the key that it was meant to be."""
    every = sorted(error.errors(include_url=False), key=lambda e: e["type"] != UNKNOWN_KEY)
    first = every[0]
    path = tuple(str(key) for key in first["loc"] if not str(key).startswith(("function-", "dict[")))
    if first["type"] == UNKNOWN_KEY:
        model = Term if path[0] == "terms" else ParameterDeclaration if path[0] == "parameters" else Declaration
        known = KEYS if model is Declaration else tuple(f.name for f in fields(model))
        close = difflib.get_close_matches(path[-1], known, 1)
        return path, f"unknown key{f'; nearest: {close[0]}' if close else ''}; valid: {', '.join(known)}"
    if first["type"] == "missing":
        return path[:-1], f"{path[-1]} is missing"
    if first["type"] == "value_error":
        return path, str(first["ctx"]["error"])
    if first["type"] in ("dataclass_type", "dict_type"):
        return path, f"a mapping of names is expected, not {first['input']!r:.60}"
    expected = first.get("ctx", {}).get("expected")
    return path, f"{first['input']!r:.60}: one of {expected} is expected" if expected else first["msg"]


def _contradiction(declared: Declaration) -> tuple[tuple[str, ...], str] | None:
    """Return the place and the reason of the first thing that does not fit the others."""
    terms = declared.terms
    if not (declared.python or 1 <= len(terms) <= MOST_TERMS):
        return ("terms",), f"{len(terms)} terms; from 1 to {MOST_TERMS} are expected"
    for name, term in {**terms, **declared.parameters}.items():
        key = "terms" if name in terms else "parameters"
        if not TERM.fullmatch(name):
            return (key, name), f"{name!r} is no name of a term; use letters, digits and _, at most 20"
        if isinstance(term.unit, dict) and set(term.unit) != set(declared.sensors):
            return (key, name, "unit"), f"a unit for each of {', '.join(declared.sensors)} is expected"
    found = [_wrong_term(declared, name, term) for name, term in terms.items()]
    names = [n for term in terms for _, n in declared.coefficients(term)]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        found.append((("terms",), f"two coefficients would be called {twice[0]}; name the terms otherwise"))
    if declared.limits and set(declared.limits) != set(terms):
        expected = ", ".join(terms)
        found.append((("limits",), f"a limit for each term is expected ({expected}), or none at all"))
    for name, size in declared.limits.items():
        if isinstance(size, dict) and set(size) != set(declared.sensors):
            found.append((("limits", name), f"a limit for each of {', '.join(declared.sensors)} is expected"))
    return next((each for each in found if each), None)


def _wrong_term(declared: Declaration, name: str, term: Term) -> tuple[tuple[str, ...], str] | None:
    """Return how one term contradicts the rest of the file."""
    path = ("terms", name)
    not_in_a_log = sorted(s for s in term.signals if not SIGNALS[s].c)
    if not term.signals:
        return path, "the formula names no signal: a constant is the bias, which is fitted anyway"
    if declared.owner == Owner.SENSOR and not_in_a_log:
        found = " and ".join(not_in_a_log)
        return path, f"owner is sensor, but {found} is the table's and no field log holds it; write owner: table"
    if term.formula.shared and "*" in name:
        return path, "a vector has one coefficient: its name has no star"
    if declared.adds_to == "truth" and not term.formula.shared:
        return path, "what is added to the truth is a vector: a list of three formulas is expected"
    return None
