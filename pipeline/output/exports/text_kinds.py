"""Parse calibrations of other programs into trees of values; functions for the expressions in ``read_back``.

json, yaml   : unchanged, but a list of mappings becomes a mapping by ``SensorType``, or by number
ini          : sections with ``NAME = value`` (configparser); several numbers are separated by blanks or commas
parameters   : a line for each parameter: ``NAME value``, ``NAME,value``, ``set NAME = a,b``, or PX4's five columns
c            : initialised arrays of C by name, ``NAME ... = {...};``, without their nesting
xml          : ``<define name= value=>`` by name
numbers      : the 21 numbers at the beginning of the file, as ``numbers``
"""

from __future__ import annotations

import configparser
import json
import re
from collections.abc import Callable, Iterator
from itertools import takewhile
from typing import Any

import numpy as np
import yaml
from jinja2 import Environment, StrictUndefined

from pipeline.core.records import Values
from pipeline.output.exports.sensors import UNIT_FACTORS, shifted
from pipeline.physics.effects.base import REFERENCE_TEMPERATURE

NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
ARRAY = re.compile(r"(\w+)\s*(?:\[\d*\]\s*)*=\s*(\{[^;]*\})\s*;")
NO_UNIT = (None, "", "a.u.")  # of imucal: the readings may be counts
DEFINE = re.compile(r'<define\s+name="(\w+)"\s+value="([^"]*)"')


class Node(dict[str, Any]):
    """A mapping in a file that stores its place in the file and records which values were used."""

    def __init__(self, content: dict[Any, Any], place: str = "", used: set[str] | None = None) -> None:
        self.place, self.used = place, set() if used is None else used
        super().__init__({str(key): self._of(str(key), value) for key, value in content.items()})

    def _of(self, key: str, value: Any) -> Any:  # noqa: ANN401
        place = f"{self.place}.{key}" if self.place else key
        if isinstance(value, list) and value and all(isinstance(each, dict) for each in value):
            value = {each.get("SensorType", number): each for number, each in enumerate(value)}
        if isinstance(value, dict):
            return Node(value, place, self.used)
        numeric = isinstance(value, list) and value and not isinstance(value[0], str)
        return np.array(value, float) if numeric else value

    def __getitem__(self, key: str) -> Any:  # noqa: ANN401
        place = f"{self.place}.{key}" if self.place else key
        if key not in self:
            raise KeyError(f"{place} is missing")
        self.used.add(place)
        return super().__getitem__(key)

    def get(self, key: str, default: Any = None) -> Any:  # noqa: ANN401
        """Return a value, or a default if the key does not exist."""
        try:
            return self[key]
        except KeyError:
            return default

    def at(self, path: str) -> Any:  # noqa: ANN401
        """Return the value at a dotted path."""
        value: Any = self
        for key in path.split("."):
            value = value[key]
        return value

    def has(self, path: str) -> bool:
        """Return whether a value exists at a dotted path."""
        value: Any = self
        for key in path.split("."):
            if not isinstance(value, Node) or key not in value:
                return False
            value = dict.__getitem__(value, key)
        return True

    def leaves(self) -> Iterator[str]:
        """Yield the place of every value."""
        for key in self:
            value, place = dict.__getitem__(self, key), f"{self.place}.{key}" if self.place else key
            if isinstance(value, Node):
                yield from value.leaves()
            else:
                yield place

    def unread(self) -> list[str]:
        """Return the keys of unused values; in a flat list of parameters, only those with the prefix of a used one."""
        prefixes = {place.partition("_")[0] for place in self.used}
        nested = any(isinstance(value, Node) for value in self.values())
        unused = [p for p in self.leaves() if p not in self.used and (nested or p.partition("_")[0] in prefixes)]
        return list(dict.fromkeys(place.rpartition(".")[2] for place in unused))


class Expressions(Environment):
    """Jinja2 expressions on a tree; an error names the place of a missing value."""

    def __init__(self, variables: dict[str, Any]) -> None:
        super().__init__(undefined=StrictUndefined, autoescape=False)  # no HTML
        self.globals |= EXPRESSION_FUNCTIONS | variables

    def getattr(self, obj: Any, attribute: str) -> Any:  # noqa: ANN401
        """Return a value of a mapping, or an attribute of another object."""
        return obj[attribute] if isinstance(obj, dict) else super().getattr(obj, attribute)

    def value(self, expression: object) -> Any:  # noqa: ANN401
        """Return the value of an expression."""
        return self.compile_expression(str(expression), undefined_to_none=False)()


def parsed(kind: str, text: str) -> Node:
    """Parse a text into a tree; raises ``ValueError`` if it is not of that kind."""
    try:
        content = PARSERS[kind](text)
    except (yaml.YAMLError, configparser.Error) as error:
        raise ValueError(str(error)) from error
    if not isinstance(content, dict):
        raise ValueError(f"{kind} with keys is expected")  # noqa: TRY004  (a text of another kind)
    only = next(iter(content.values())) if list(content) == ["value0"] else content  # cereal's root, in Basalt's files
    return Node(only)


def _parameters(text: str) -> dict[str, Any]:
    parameters: dict[str, Any] = {}
    for line in text.splitlines():
        stated = line.partition("#")[0].strip().removeprefix("param ").removeprefix("set ")  # PX4's and INAV's commands
        words = re.split(r"[\s,=]+", stated.strip())
        if len(words) == 5 and words[0].isdigit() and words[1].isdigit():
            words = words[2:4]
        if len(words) < 2 or not re.match(r"[A-Za-z]", words[0]):
            continue
        parameters[words[0]] = _values(words[1:])
    return parameters


def _values(words: list[str]) -> Any:  # noqa: ANN401
    """Convert words that are numbers; a single word gives its value instead of a list."""
    values = [float(w) if re.fullmatch(NUMBER, w) else w for w in words]
    return values[0] if len(values) == 1 else values


def _ini(text: str) -> dict[str, Any]:
    parser = configparser.ConfigParser(interpolation=None)
    parser.optionxform = str  # type: ignore[assignment,method-assign]  # names keep their case
    parser.read_string(text)
    return {
        section: {name: _values(re.split(r"[\s,]+", value)) for name, value in parser.items(section)}
        for section in parser.sections()
    }


def _c_arrays(text: str) -> dict[str, Any]:
    bare = re.sub(r"//[^\n]*|/\*.*?\*/", "", text, flags=re.DOTALL)
    arrays = {name: [float(x) for x in re.findall(rf"(?<![\w.]){NUMBER}", body)] for name, body in ARRAY.findall(bare)}
    return {name: numbers for name, numbers in arrays.items() if numbers}


def _numbers(text: str) -> dict[str, Any]:
    numbers = [float(word) for word in takewhile(re.compile(NUMBER).fullmatch, text.split())]
    return {"numbers": numbers} if len(numbers) == 21 else {}


PARSERS: dict[str, Callable[[str], Any]] = {
    "json": json.loads,
    "yaml": lambda text: yaml.safe_load(text.removeprefix("%YAML:1.0")),  # OpenCV writes this invalid directive
    "ini": _ini,
    "parameters": _parameters,
    "c": _c_arrays,
    "xml": lambda text: {name: float(value) for name, value in DEFINE.findall(text)},
    "numbers": _numbers,
}


def product(*matrices: Any) -> Values:  # noqa: ANN401
    """Return the product of 3x3 matrices, nested or flat."""
    result = np.eye(3)
    for matrix in matrices:
        result = result @ square(matrix)
    return result


def square(values: Any) -> Values:  # noqa: ANN401
    """Return nine values as a 3x3 matrix."""
    return np.asarray(values, float).reshape(3, 3)


def rotation(node: Node, key: str) -> Values:
    """Return the rotation of a 4x4 or 3x3 transformation in a file; the identity if the key does not exist."""
    return np.asarray(node[key], float)[:3, :3] if key in node else np.eye(3)


def axes(file: Node, name: str, letters: str = "XYZ", default: float | None = None) -> Values:
    """Return the values of three axes; ``{}`` in ``name`` stands for the axis."""
    names = [name.format(letter) for letter in letters]
    return np.array([default if default is not None and n not in file else file[n] for n in names], float)


def thermal(  # noqa: PLR0917  (the quantities of an autopilot's thermal calibration)
    file: Node,
    offset: Values,
    name: str,
    letters: str,
    reference: float,
    unit: float = 1.0,
    *,
    zero: float | None = None,
    on: float,
) -> Values:
    """Return ``offset + p(T)`` in powers of T - 25 degC: (3, 4) array, ``p = unit sum_k c_k (T - reference)^k``.

    ``name``: name of ``c_k``, with ``{order}`` and ``{axis}``; missing coefficients are 0. ``zero``: temperature at
    which p is 0 by definition, if it is not the reference. ``on``: 0 if p is switched off.
    """
    names = [[name.format(order=k, axis=a) for k in range(4)] for a in letters]
    coefficients = unit * np.array([[float(file[n]) if n in file and on else 0.0 for n in row] for row in names])
    out = shifted(coefficients, reference, REFERENCE_TEMPERATURE)
    out[:, 0] += offset
    if zero is not None:
        out[:, 0] -= np.sum(coefficients * (zero - reference) ** np.arange(4), axis=1)
    return out


def temperature_model(sensor: Node) -> dict[str, Values]:
    """Return the model of a sensor of an Azure Kinect: ``M(T) raw + B(T)``, of third order in T, degC.

    With ``K(T) = M(T)^-1`` and ``b(T) = -K(T) B(T)`` as power series about 25 degC:
    ``K1 = -K0 M1 K0``, ``K2 = -K0 (M1 K1 + M2 K0)``, ``b_n = -sum_k K_k B_(n-k)``. The diagonal of K1 is the change of
    the scale factor; no effect describes its other elements and K2.
    """
    mixing = sensor["MixingMatrixTemperatureModel"].reshape(3, 3, 4)
    M = np.moveaxis(shifted(mixing, 0.0, REFERENCE_TEMPERATURE), 2, 0)
    B = shifted(sensor["BiasTemperatureModel"].reshape(3, 4), 0.0, REFERENCE_TEMPERATURE)
    K = [np.linalg.inv(M[0])]
    K.append(-K[0] @ M[1] @ K[0])
    K.append(-K[0] @ (M[1] @ K[1] + M[2] @ K[0]))
    bias = np.stack([-sum(K[k] @ B[:, n - k] for k in range(n + 1)) for n in range(3)], axis=1)
    left_out = K[1] - np.diag(np.diag(K[1]))
    deviation = sensor["BiasUncertainty"]
    return {"K": K[0], "scale": np.diag(K[1]), "bias": bias, "deviation": deviation, "left_out": left_out}


def lower(values: Any) -> Values:  # noqa: ANN401
    """Return the lower triangular matrix of six values, column by column."""
    matrix = np.zeros((3, 3))
    matrix[np.triu_indices(3)[::-1]] = values
    return matrix


OF_THE_FORMATS = (axes, lower, product, rotation, square, temperature_model, thermal)
EXPRESSION_FUNCTIONS: dict[str, Any] = {function.__name__: function for function in OF_THE_FORMATS} | {
    "diagonal": np.diag,
    "given": lambda node, key, default: node.get(key, default),
    **dict.fromkeys(("in_dps", "in_g"), lambda unit: 1.0 / (1.0 if unit in NO_UNIT else UNIT_FACTORS[unit])),
    "times": lambda matrix, vector: square(matrix) @ np.asarray(vector, float),
    "ones": np.ones(3),
}
