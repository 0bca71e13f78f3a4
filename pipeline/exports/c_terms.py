"""What effects add to a reading, as expressions in C.

Every sum stands in the order in which ``Effect.reading`` adds it up, so that double precision gives the same last bit
where no function of the C library is called. The names in the expressions are those of ``calibration.h``: ``u`` the
sensor's own truth, ``f`` g, ``w`` deg/s, ``dt`` degC from the reference, ``m`` the motion.
"""

from __future__ import annotations

import ast
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import ConfigurationError
from pipeline.model.log_motion import fields_used
from pipeline.model.user_effects import FormulaEffect, effect_of
from pipeline.records import AXES

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from pipeline.model.formula import Formula
    from pipeline.records import FittedEffect

    Terms = Callable[[NDArray[np.float64]], list[str]]

PRODUCTS = ("f[0] * f[1]", "f[1] * f[2]", "f[2] * f[0]")
SPEED = "imu_length(w)"
SIGNALS = {
    **{f"f{a}": f"f[{i}]" for i, a in enumerate(AXES)},
    **{f"w{a}": f"w[{i}]" for i, a in enumerate(AXES)},
    **{f"alpha{a}": f"m->alpha[{i}]" for i, a in enumerate(AXES)},
    "u": "u[{axis}]",
    "pi": repr(float(np.pi)),
    "speed": SPEED,
    "temperature": "m->temperature",
    "time": "m->time",
}
FUNCTIONS = {
    "sin": "sin({})",
    "cos": "cos({})",
    "tan": "tan({})",
    "tanh": "tanh({})",
    "exp": "exp({})",
    "log": "log({})",
    "sqrt": "sqrt({})",
    "abs": "fabs({})",
    "radians": "({} * 0.017453292519943295)",
    "sign": "imu_sign({})",
    "minimum": "imu_minimum({}, {})",
    "maximum": "imu_maximum({}, {})",
    "step": "imu_step({})",
    "band": "imu_band({}, {}, {})",
}
OPERATORS: dict[type[ast.operator], str] = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}


def number(value: float) -> str:
    """Return a number as C writes it."""
    return f"(imu_real){float(value)!r}"


def _per_axis(expression: str) -> Terms:
    return lambda p: [f"{number(p[i])} * {expression.format(u=f'u[{i}]')}" for i in range(3)]


def _every_axis(*expressions: str) -> Terms:
    def terms(p: NDArray[np.float64]) -> list[str]:
        rows = p.reshape(3, len(expressions))
        return [" + ".join(f"{number(x)} * {e}" for x, e in zip(row, expressions, strict=True)) for row in rows]

    return terms


def _warm_up(p: NDArray[np.float64]) -> list[str]:
    decay = f"(imu_real)exp(-m->time / {number(p[3])})" if p[3] > 0 else "0"
    return [f"{number(a)} * {decay}" for a in p[:3]]


def _hysteresis(p: NDArray[np.float64]) -> list[str]:
    ahead = [(1, 2), (2, 0), (0, 1)]
    changes = [f"-(m->direction[{i}] * f[{j}] - m->direction[{j}] * f[{i}])" for i, j in ahead]
    return [f"{number(h)} * (imu_real)tanh({c} / (imu_real)0.05)" for h, c in zip(p, changes, strict=True)]


def _lever_arms(p: NDArray[np.float64]) -> list[str]:
    return [f"imu_lever(m, {c}, {', '.join(map(number, row))})" for c, row in enumerate(p.reshape(3, 3))]


TERMS: dict[str, Terms] = {
    "bias_temperature": _every_axis("dt"),
    "bias_temperature_quadratic": _every_axis("dt", "(dt * dt)"),
    "scale_factor_temperature": _per_axis("(dt * {u})"),
    "scale_factor_asymmetry": _per_axis("({u} < 0 ? -{u} : {u})"),
    "quadratic_nonlinearity": _per_axis("({u} * {u})"),
    "cubic_nonlinearity": _per_axis("({u} * {u} * {u})"),
    "cross_axis_nonlinearity": _every_axis(*(f"({e})" for e in PRODUCTS)),
    "rate_dependence": _every_axis("w[0]", "w[1]", "w[2]"),
    "g_sensitivity": _every_axis("f[0]", "f[1]", "f[2]"),
    "g_squared_sensitivity": _every_axis("(f[0] * f[0])", "(f[1] * f[1])", *(f"({e})" for e in PRODUCTS)),
    "vibration_rectification": _every_axis(SPEED),
    "warm_up": _warm_up,
    "hysteresis": _hysteresis,
    "inner_lever_arms": _lever_arms,
}


def terms_of(fitted: FittedEffect) -> list[str] | None:
    """Return what an effect adds to the three axes, as expressions; None where C cannot know."""
    if fitted.definition is None:
        return TERMS[fitted.name](fitted.values) if fitted.name in TERMS else None
    if "python" in fitted.definition:
        return None
    made = effect_of(fitted)
    return _of_formulas(made, fitted.values) if isinstance(made, FormulaEffect) else None


def fields_of(sensor: str, fitted: FittedEffect) -> set[str] | None:
    """Return the fields of a motion at which an effect looks; None where no log of a sensor holds them."""
    try:
        return fields_used(sensor, [fitted])
    except ConfigurationError:
        return None


def _of_formulas(made: FormulaEffect, values: NDArray[np.float64]) -> list[str]:
    """Return the sums of an effect from formulas: on each axis its own terms, then those that the axes share."""
    scalar = [t for t in made.described.terms if not t.shared]
    shared = [t for t in made.described.terms if t.shared]
    coefficients = iter(values.tolist())
    sums: list[list[str]] = [[], [], []]
    for axis in made.described.axes:
        c = AXES.index(axis)
        sums[c] += [f"{number(next(coefficients))} * {expression(t.formulas[0], c)}" for t in scalar]
    for term in shared:
        p = number(next(coefficients))
        for c in range(3):
            sums[c].append(f"{p} * {expression(term.formulas[c], c)}")
    return [" + ".join(parts) or "0" for parts in sums]


def expression(formula: Formula, axis: int) -> str:
    """Return a formula that has been parsed (``pipeline.model.formula``), as an expression in C."""
    return f"(imu_real){_node(ast.parse(formula.text, mode='eval').body, axis)}"


def _node(node: ast.expr, axis: int) -> str:
    if isinstance(node, ast.Constant):
        return repr(float(str(node.value)))
    if isinstance(node, ast.Name):
        return SIGNALS[node.id].format(axis=axis)
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        return FUNCTIONS[node.func.id].format(*(_node(argument, axis) for argument in node.args))
    if isinstance(node, ast.UnaryOp):
        return f"({'-' if isinstance(node.op, ast.USub) else '+'}{_node(node.operand, axis)})"
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow):
        return f"pow({_node(node.left, axis)}, {_node(node.right, axis)})"
    if isinstance(node, ast.BinOp):
        return f"({_node(node.left, axis)} {OPERATORS[type(node.op)]} {_node(node.right, axis)})"
    raise TypeError(f"{ast.dump(node)} is no part of a formula")
