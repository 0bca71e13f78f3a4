"""Formulas in named signals, as a user writes them: parsed against a white list, never run as Python.

    formula  := sum of products and powers of numbers, pi, signals and functions of formulas
    a ** b   :  b is a number, at most 20 in size

where a signal is one of ``SIGNALS`` and a function one of ``FUNCTIONS``. Python's own parser reads the text; the tree
that it gives is translated, node by node, into calls of numpy. Nothing else has a meaning here: a name that is not
known, an attribute, an index, a text, a keyword or a comparison is refused with its place.
"""

from __future__ import annotations

import ast
import re
import warnings
from dataclasses import dataclass
from functools import partial
from itertools import accumulate
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    Signals = Mapping[str, NDArray[np.float64]]
    Evaluate = Callable[[Signals], Any]

SIGNALS = {
    "u": "what this axis of the sensor should read, g or deg/s",
    "fx": "specific force along body x, g",
    "fy": "specific force along body y, g",
    "fz": "specific force along body z, g",
    "wx": "angular rate about body x, deg/s",
    "wy": "angular rate about body y, deg/s",
    "wz": "angular rate about body z, deg/s",
    "alphax": "angular acceleration about body x, deg/s^2",
    "alphay": "angular acceleration about body y, deg/s^2",
    "alphaz": "angular acceleration about body z, deg/s^2",
    "speed": "magnitude of the angular rate, deg/s",
    "temperature": "temperature, degC",
    "time": "time since power-on, s",
    "rate": "rate of the table about its turn axis, deg/s",
    "angle": "angle of the table about its turn axis, deg",
}
FUNCTIONS: dict[str, tuple[int, Callable[..., Any]]] = {
    **{f.__name__: (1, f) for f in (np.sin, np.cos, np.tan, np.tanh, np.exp, np.log, np.sqrt, np.sign, np.radians)},
    "abs": (1, np.abs),
    "minimum": (2, np.minimum),
    "maximum": (2, np.maximum),
    "step": (1, lambda x: np.where(np.isnan(x), x, np.heaviside(x, 1.0))),
    "band": (3, lambda x, low, high: np.where(np.isnan(x), x, np.logical_and(x >= low, x <= high))),
}
CONSTANTS = {"pi": np.pi}
OPERATORS: dict[type[ast.operator], Callable[..., Any]] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
}
LONGEST, DEEPEST, MOST_NODES, LARGEST_POWER = 500, 40, 200, 20.0
STRANGE = re.compile(r"[^A-Za-z0-9_ .+\-*/(),]")
HINTS = {
    "^": "; write ** for a power",
    "=": "; a formula has no names of its own",
    "<": "; use step(x) or band(x, low, high)",
}
HINTS[">"] = HINTS["<"]
REFUSED: dict[type[ast.AST], str] = {
    ast.Attribute: "an attribute (a name after a dot)",
    ast.Subscript: "an index",
    ast.Constant: "a text",
    ast.Compare: "a comparison",
    ast.BoolOp: "a logical operation",
    ast.IfExp: "a condition",
    ast.Lambda: "a function of its own",
    ast.Tuple: "a list of values",
    ast.GeneratorExp: "a loop",
    ast.Await: "a keyword of Python",
    ast.Yield: "a keyword of Python",
    ast.BinOp: "this operator",
    ast.UnaryOp: "this operator",
    ast.Starred: "a star before a value",
}


@dataclass(frozen=True)
class Formula:
    """A formula, ready to be evaluated.

    Attributes
    ----------
    text : str
        As it was written.
    signals : frozenset of str
        The signals in it.
    """

    text: str
    signals: frozenset[str]
    _evaluate: Evaluate

    def __call__(self, signals: Signals) -> NDArray[np.float64]:
        """Return the value: an array of the shape that the signals broadcast to, 0-d where it names none.

        What is not a number (``log(-1)``) comes out as NaN or infinite, without a warning.
        """
        with np.errstate(all="ignore"):
            return np.asarray(self._evaluate(signals), np.float64)


def parse(text: str, where: str | None = None) -> Formula:
    """Read a formula.

    Parameters
    ----------
    text : str
    where : str, optional
        File (and line) that the messages name.

    Raises
    ------
    ConfigurationError
        If it is anything but numbers, signals and functions, too long or too deep; with the position in the text.
    """
    line = " ".join(text.split())
    if not line:
        raise _refusal(line, 0, "it is empty", where)
    if len(line) > LONGEST:
        raise ConfigurationError(f"a formula of {len(line)} characters; at most {LONGEST} are read", where)
    strange = STRANGE.search(line)
    if strange:
        found = strange.group()
        raise _refusal(line, strange.start(), f"{found!r} has no place in a formula{HINTS.get(found, '')}", where)
    depth = accumulate((character == "(") - (character == ")") for character in line)
    if max(depth) > DEEPEST:
        raise ConfigurationError(f"a formula with brackets {DEEPEST} deep; use several terms", where)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            tree = ast.parse(line, mode="eval")
    except SyntaxError as error:
        raise _refusal(line, (error.offset or 1) - 1, f"this is no formula ({error.msg})", where) from None
    except (ValueError, RecursionError, MemoryError) as error:
        raise _refusal(line, 0, f"this is no formula ({error})", where) from None
    return _Reader(line, where).read(tree.body)


class _Reader:
    """Translates a tree of one formula, and notes its signals."""

    def __init__(self, text: str, where: str | None) -> None:
        self.text, self.where = text, where
        self.signals: set[str] = set()
        self.nodes = 0

    def read(self, tree: ast.expr) -> Formula:
        evaluate = self._node(tree, 1)
        return Formula(self.text, frozenset(self.signals), evaluate)

    def _node(self, node: ast.expr, depth: int) -> Evaluate:
        self.nodes += 1
        if depth > DEEPEST or self.nodes > MOST_NODES:
            raise self._refused(node, "the formula is nested too deeply or has too many parts; use several terms")
        if isinstance(node, ast.Constant):
            return partial(_constant, self._number(node))
        if isinstance(node, ast.Name):
            return self._name(node)
        if isinstance(node, ast.Call):
            return self._call(node, depth)
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.UAdd)):
            inner = self._node(node.operand, depth + 1)
            return partial(_apply, np.negative, (inner,)) if isinstance(node.op, ast.USub) else inner
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow):
            return partial(_apply, np.power, (self._node(node.left, depth + 1), self._exponent(node.right)))
        if isinstance(node, ast.BinOp) and type(node.op) in OPERATORS:
            parts = self._node(node.left, depth + 1), self._node(node.right, depth + 1)
            return partial(_apply, OPERATORS[type(node.op)], parts)
        raise self._refused(node, f"{REFUSED.get(type(node), 'this')} has no place in a formula")

    def _number(self, node: ast.Constant) -> float:
        if isinstance(node.value, bool) or not isinstance(node.value, (int, float)):
            raise self._refused(node, f"{node.value!r} has no place in a formula")
        try:
            value = float(node.value)
        except OverflowError:
            value = float("inf")
        if not np.isfinite(value):
            raise self._refused(node, "this number is too large")
        return value

    def _name(self, node: ast.Name) -> Evaluate:
        if node.id in CONSTANTS:
            return partial(_constant, CONSTANTS[node.id])
        if node.id not in SIGNALS:
            function = f"; {node.id} is a function: write {node.id}(...)" if node.id in FUNCTIONS else ""
            known = f"signals: {', '.join(SIGNALS)}; functions: {', '.join(FUNCTIONS)}"
            raise self._refused(node, f"no signal is called {node.id!r}{function}; {known}")
        self.signals.add(node.id)
        return partial(_signal, node.id)

    def _call(self, node: ast.Call, depth: int) -> Evaluate:
        name = node.func.id if isinstance(node.func, ast.Name) else None
        if name not in FUNCTIONS:
            shown = f"no function is called {name!r}" if name else "this cannot be called"
            known = f"functions: {', '.join(FUNCTIONS)}; signals: {', '.join(SIGNALS)}"
            raise self._refused(node.func, f"{shown}; {known}")
        count, function = FUNCTIONS[name]
        if node.keywords or len(node.args) != count:
            raise self._refused(node, f"{name} takes {count} value{'s' * (count > 1)} in brackets, without names")
        return partial(_apply, function, tuple(self._node(argument, depth + 1) for argument in node.args))

    def _exponent(self, node: ast.expr) -> Evaluate:
        sign, number = 1.0, node
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
            sign, number = -1.0, node.operand
        if not isinstance(number, ast.Constant) or abs(self._number(number)) > LARGEST_POWER:
            raise self._refused(node, f"an exponent is a number from -{LARGEST_POWER:g} to {LARGEST_POWER:g}")
        return partial(_constant, sign * self._number(number))

    def _refused(self, node: ast.expr, reason: str) -> ConfigurationError:
        return _refusal(self.text, node.col_offset, reason, self.where)


def _constant(value: float, signals: Signals) -> np.float64:
    del signals
    return np.float64(value)


def _signal(name: str, signals: Signals) -> NDArray[np.float64]:
    return signals[name]


def _apply(function: Callable[..., Any], parts: tuple[Evaluate, ...], signals: Signals) -> Any:  # noqa: ANN401
    return function(*(part(signals) for part in parts))


def _refusal(text: str, place: int, reason: str, where: str | None) -> ConfigurationError:
    shown = text if len(text) <= 60 else f"{text[:57]}..."
    return ConfigurationError(f"formula {shown!r}, position {place + 1}: {reason}", where)
