"""Parse formulas in named signals against a white list, and compile them to numpy and to C; never run them as Python.

    formula  := sum of products and powers of numbers, pi, signals and functions of formulas
    a ** b   :  b is a number, at most 20 in size; ** 2 and ** 3 are products, so that numpy and C agree to the last bit

where a signal is one of ``SIGNALS`` and a function one of ``FUNCTIONS``. Python's parser reads the text. The tree is
translated node by node. An unknown name, an attribute, an index, a text, a keyword or a comparison is refused with its
position.
"""

from __future__ import annotations

import ast
import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np

from pipeline.core.errors import ConfigurationError
from pipeline.core.records import Values

Evaluate = Callable[[Mapping[str, Values]], Any]

# above every shipped formula; they bound the cost
MAX_FORMULA_LENGTH, MAX_FORMULA_DEPTH, MAX_FORMULA_NODES, LARGEST_POWER = 500, 40, 200, 20.0
MOVING = ("angular_rate", "angular_acceleration", "direction", "rate")
_LIBRARY_FUNCTIONS = (np.sin, np.cos, np.tan, np.tanh, np.exp, np.log, np.sqrt)
OPERATORS: dict[type[ast.operator], tuple[Callable[..., Any], str]] = {ast.Add: (np.add, "+")}
OPERATORS |= {ast.Sub: (np.subtract, "-"), ast.Mult: (np.multiply, "*"), ast.Div: (np.divide, "/")}
POWER_FUNCTIONS: dict[float, tuple[Callable[..., Any], str, str]] = {  # in C of a name, and of what is longer
    2.0: (np.square, "({0} * {0})", "imu_square({0})"),
    3.0: (lambda x: x * x * x, "({0} * {0} * {0})", "imu_cube({0})"),
}
IN_C_ONCE = {f"(m->temperature - (imu_real){25.0!r})": "dt"}  # calibration.h has a name for it
SIMPLE_IN_C = re.compile(r"[\w\[\]{}>-]+")  # a name: to evaluate it twice costs nothing
STRANGE = re.compile(r"[^A-Za-z0-9_ .+\-*/(),]")
HINTS = {"^": "; write ** for a power", "=": "; a formula has no names of its own"}
HINTS |= dict.fromkeys("<>", "; use step(x) or band(x, low, high)")


class Signal(NamedTuple):
    """A signal: its meaning, the field of ``Motion`` that holds it, the index in that field, and its name in C.

    An empty ``field`` is the truth of the sensor. With an empty ``c`` (the name in ``calibration.h``), the log of a
    sensor does not hold the signal.
    """

    meaning: str
    field: str
    place: tuple[int, ...] = ()
    c: str = ""


def _vector(prefix: str, field: str, meaning: str, c: str) -> dict[str, Signal]:
    axes = [(i, a, meaning.format(axis=f"body {a}")) for i, a in enumerate("xyz")]
    return {f"{prefix}{a}": Signal(words, field, (i,), c.format(i)) for i, a, words in axes}


SIGNALS = {
    "u": Signal("what this axis of the sensor should read, g or deg/s", "", (), "u[{axis}]"),
    **_vector("f", "specific_force", "specific force along {axis}, g", "f[{}]"),
    **_vector("w", "angular_rate", "angular rate about {axis}, deg/s", "w[{}]"),
    **_vector("alpha", "angular_acceleration", "angular acceleration about {axis}, deg/s^2", "m->alpha[{}]"),
    **_vector("e", "direction", "{axis} component of the unit vector of this or the last turn", "m->direction[{}]"),
    "speed": Signal("magnitude of the angular rate, deg/s", "angular_rate", (), "imu_length(w)"),
    "temperature": Signal("temperature, degC", "temperature", (), "m->temperature"),
    "temperature_rate": Signal("rate of the temperature, degC/s", "temperature_rate", (), "m->temperature_rate"),
    "time": Signal("time since power-on, s", "time", (), "m->time"),
    "rate": Signal("rate of the table about its turn axis, deg/s", "rate"),
    "angle": Signal("angle of the table about its turn axis, deg", "angle"),
    **{
        f"level_{a}{b}": Signal(f"body {b} component of the level frame's {a} axis", "level", (i, j))
        for i, a in enumerate("xyz")
        for j, b in enumerate("xyz")
    },
}
OF_THE_MOTION = {name for name, signal in SIGNALS.items() if signal.field in MOVING}  # 0 while nothing moves


class Function(NamedTuple):
    """A function: its number of arguments, its numpy function and its C expression."""

    takes: int
    numpy: Callable[..., Any]
    c: str


FUNCTIONS: dict[str, Function] = {
    **{f.__name__: Function(1, f, f"(imu_real){f.__name__}({{}})") for f in _LIBRARY_FUNCTIONS},
    "sign": Function(1, np.sign, "(imu_real)imu_sign({})"),
    "radians": Function(1, np.radians, f"({{}} * (imu_real){np.pi / 180.0!r})"),
    "abs": Function(1, np.abs, "(imu_real)fabs({})"),
    "minimum": Function(2, np.minimum, "(imu_real)imu_minimum({}, {})"),
    "maximum": Function(2, np.maximum, "(imu_real)imu_maximum({}, {})"),
    "step": Function(1, lambda x: np.where(np.isnan(x), x, np.heaviside(x, 1.0)), "(imu_real)imu_step({})"),
    "band": Function(
        3,
        lambda x, low, high: np.where(np.isnan(x), x, np.logical_and(x >= low, x <= high)),
        "(imu_real)imu_band({}, {}, {})",
    ),
}


@dataclass(frozen=True)
class Formula:
    """A parsed formula: its text, the signals in it, and its compiled forms."""

    text: str
    signals: frozenset[str]
    _evaluate: Evaluate
    _c: str

    def __call__(self, signals: Mapping[str, Values]) -> Values:
        """Return the value, in the shape to which the signals broadcast; 0-d where the formula names no signal.

        Undefined values (``log(-1)``) are NaN or infinite, without a warning.
        """
        with np.errstate(all="ignore"):
            return np.asarray(self._evaluate(signals), np.float64)

    def in_c(self, axis: int) -> str:
        """Return the formula for one axis as a C expression of type ``imu_real``, in the names of ``calibration.h``."""
        return self._c.format(axis=axis)


@lru_cache(maxsize=256)
def parse(text: str) -> Formula:
    """Parse a formula; raise ``ConfigurationError`` with the position of a fault.

    It contains numbers, signals, functions and operators alone, and is neither too long nor too deeply nested.
    """
    line = " ".join(text.split())
    if not line:
        raise _refusal(line, 0, "it is empty")
    if len(line) > MAX_FORMULA_LENGTH:
        raise ConfigurationError(f"a formula of {len(line)} characters; at most {MAX_FORMULA_LENGTH} are read")
    strange = STRANGE.search(line)
    if strange:
        found = strange.group()
        raise _refusal(line, strange.start(), f"{found!r} is not allowed in a formula{HINTS.get(found, '')}")
    depth = accumulate((character == "(") - (character == ")") for character in line)
    if max(depth) > MAX_FORMULA_DEPTH:
        raise ConfigurationError(f"a formula with brackets {MAX_FORMULA_DEPTH} deep; use several terms")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            tree = ast.parse(line, mode="eval")
    except SyntaxError as error:
        raise _refusal(line, (error.offset or 1) - 1, f"this is no formula ({error.msg})") from None
    except (ValueError, RecursionError, MemoryError) as error:
        raise _refusal(line, 0, f"this is no formula ({error})") from None
    reader = _Reader(line)
    evaluate, c = reader.read(tree.body, 1)
    return Formula(line, frozenset(reader.signals), evaluate, c)


class _Reader:
    """Translates the tree of one formula into a numpy function and a C expression; collects its signals."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.signals: set[str] = set()
        self.nodes = 0

    def read(self, node: ast.expr, depth: int) -> tuple[Evaluate, str]:
        self.nodes += 1
        if depth > MAX_FORMULA_DEPTH or self.nodes > MAX_FORMULA_NODES:
            raise self._refused(node, "the formula is nested too deeply or has too many parts; use several terms")
        if isinstance(node, ast.Constant):
            return _number(self._value(node))
        if isinstance(node, ast.Name):
            return self._name(node)
        if isinstance(node, ast.Call):
            return self._call(node, depth)
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.UAdd)):
            inner, c = self.read(node.operand, depth + 1)
            return (_applied(np.negative, inner), f"(-{c})") if isinstance(node.op, ast.USub) else (inner, c)
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow):
            return self._power(node, depth)
        if isinstance(node, ast.BinOp) and type(node.op) in OPERATORS:
            function, sign = OPERATORS[type(node.op)]
            (left, c_left), (right, c_right) = self.read(node.left, depth + 1), self.read(node.right, depth + 1)
            c = f"({c_left} {sign} {c_right})"
            return _applied(function, left, right), IN_C_ONCE.get(c, c)
        known = "numbers, signals, functions and + - * / **"
        raise self._refused(node, f"{ast.unparse(node)!r:.40} is not allowed in a formula; it consists of {known}")

    def _value(self, node: ast.Constant) -> float:
        if isinstance(node.value, bool) or not isinstance(node.value, (int, float)):
            raise self._refused(node, f"{node.value!r} is not allowed in a formula")
        try:
            value = float(node.value)
        except OverflowError:
            value = float("inf")
        if not np.isfinite(value):
            raise self._refused(node, "this number is too large")
        return value

    def _name(self, node: ast.Name) -> tuple[Evaluate, str]:
        name = node.id
        if name == "pi":
            return _number(np.pi)
        if name not in SIGNALS:
            function = f"; {name} is a function: write {name}(...)" if name in FUNCTIONS else ""
            known = f"signals: {', '.join(SIGNALS)}; functions: {', '.join(FUNCTIONS)}"
            raise self._refused(node, f"no signal is called {name!r}{function}; {known}")
        self.signals.add(name)
        return lambda signals: signals[name], SIGNALS[name].c

    def _call(self, node: ast.Call, depth: int) -> tuple[Evaluate, str]:
        name = node.func.id if isinstance(node.func, ast.Name) else None
        if name not in FUNCTIONS:
            shown = f"no function is called {name!r}" if name else "this cannot be called"
            known = f"functions: {', '.join(FUNCTIONS)}; signals: {', '.join(SIGNALS)}"
            raise self._refused(node.func, f"{shown}; {known}")
        count, function, c = FUNCTIONS[name]
        if node.keywords or len(node.args) != count:
            raise self._refused(node, f"{name} takes {count} value{'s' * (count > 1)} in brackets, without names")
        values, in_c = zip(*(self.read(argument, depth + 1) for argument in node.args), strict=True)
        if name == "abs" and SIMPLE_IN_C.fullmatch(in_c[0]):
            c = "({0} < 0 ? -{0} : {0})"
        return _applied(function, *values), c.format(*in_c)

    def _power(self, node: ast.BinOp, depth: int) -> tuple[Evaluate, str]:
        base, c_base = self.read(node.left, depth + 1)
        exponent = self._exponent(node.right)
        if exponent not in POWER_FUNCTIONS:
            power = _applied(np.power, base, _number(exponent)[0])
            return power, f"(imu_real)pow({c_base}, {c_number(exponent)})"
        function, short, c = POWER_FUNCTIONS[exponent]
        return _applied(function, base), (short if SIMPLE_IN_C.fullmatch(c_base) else c).format(c_base)

    def _exponent(self, node: ast.expr) -> float:
        sign, number = 1.0, node
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
            sign, number = -1.0, node.operand
        if not isinstance(number, ast.Constant) or abs(self._value(number)) > LARGEST_POWER:
            raise self._refused(node, f"an exponent is a number from -{LARGEST_POWER:g} to {LARGEST_POWER:g}")
        return sign * self._value(number)

    def _refused(self, node: ast.expr, reason: str) -> ConfigurationError:
        return _refusal(self.text, node.col_offset, reason)


def c_number(value: float) -> str:
    """Return a number as C writes it."""
    return f"(imu_real){float(value)!r}"


def _number(value: float) -> tuple[Evaluate, str]:
    constant = np.float64(value)
    return lambda _: constant, c_number(value)


def _applied(function: Callable[..., Any], *parts: Evaluate) -> Evaluate:
    return lambda signals: function(*(part(signals) for part in parts))


def _refusal(text: str, place: int, reason: str) -> ConfigurationError:
    shown = text if len(text) <= 60 else f"{text[:57]}..."
    return ConfigurationError(f"formula {shown!r}, position {place + 1}: {reason}")
