"""Evaluate effects whose terms are formulas: by numpy in the fit, as C in ``calibration.h``.

    z_c = sum over terms of p_tc h_t(signals)          (a coefficient for each axis c in ``axes``)
        + sum over vector terms of p_t h_tc(signals)   (one coefficient for all axes)

where p are the coefficients, which are fitted, and h are formulas in the signals of ``pipeline.physics.formula``. A
formula with the table's angle or rate is 0 in a recording without a turn axis. With ``adds_to: truth`` the terms change
the specific force or the rate; the reading changes by K times the terms, with K the inverse of the calibration matrix.

Read and check the file of an effect. Built-in effects and effects of users have the same schema.

    name: gear_mesh                 # the file's stem
    owner: table                    # sensor (compensated in field logs), recording, mounting or table
    sensors: [gyroscope]
    meaning: The gear of the table pushes five times a turn.
    terms:                          # the effect is the sum of coefficient times formula
      A: {formula: "cos(5 * radians(angle))", unit: deg/s}

A ``formula`` is one of three forms: a text (the same formula for each axis, with coefficients A_x, A_y, A_z), a mapping
of x, y and z (a formula and a coefficient for each axis), or a list of three (a vector with one coefficient). A star in
the name of a term stands for the axis (``G_*x``: G_xx, G_yx, G_zx). ``docs/effects_of_your_own.md`` lists all keys. A
built-in effect that no formula can express states its class (``python: equations.TimeOffset``) and its ``parameters``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from typing import Any, TypeAlias

import numpy as np

from pipeline.core.errors import ConfigurationError, InputError
from pipeline.core.files import Check, WrongValueError, each, expected, fields, flag, items, one_of, text
from pipeline.core.records import AXES, SENSORS, Motion, Values
from pipeline.physics.effects.base import (
    Effect,
    EffectParameter,
    Layout,
    Owner,
    length,
    per_axis,
    truth,
    turning_direction,
)
from pipeline.physics.formula import OF_THE_MOTION, SIGNALS, Formula, c_number, parse

MotionSignals: TypeAlias = "Mapping[str, Values | None]"  # None: the recording has no turn axis

OF_THE_TURN = ("angle", "rate")
OPTIONAL_FIELDS = ("temperature", "angle", "rate", "level")  # fields that a motion may lack
TRUTHS = {"accelerometer": "specific_force", "gyroscope": "angular_rate"}
OWN = {"accelerometer": "f", "gyroscope": "w"}  # signals of that field
EFFECT_NAME = re.compile(r"[a-z][a-z0-9_]{0,49}")
TERM = re.compile(r"[A-Za-z](?=.{0,19}$)[A-Za-z0-9_]*\*?[A-Za-z0-9_]*")
RESERVED = ("auto", "all", "none")
NUMBER = re.compile(r"(?<![\w.])\d+\.?\d*(?:e[-+]?\d+)?")
PROBES, ALIKE = 200, 1e-9  # places; largest relative difference, by rounding, of values that are equal
MOST_TERMS, LONGEST_TEXT, LONGEST_UNIT = 12, 500, 30  # above every built-in effect; they limit pages and fits
REQUIRED = ("name", "owner", "sensors", "meaning")


class DeclaredEffect(Effect):
    """An effect by a file, whose equation a subclass has; ``definition``: the content of a user's file."""

    def __init__(self, declared: Declaration, definition: dict[str, Any] | None = None) -> None:
        self.declared, self.definition = declared, definition
        for name in Effect.__annotations__.keys() & Declaration.__annotations__.keys():
            setattr(self, name, getattr(declared, name))
        self._parameters = {sensor: declared.parameters_of(sensor) for sensor in declared.sensors}

    def parameters(self, sensor: str) -> tuple[EffectParameter, ...]:
        """Return the parameters that the file declares."""
        return self._parameters[sensor]

    def limits(self, sensor: str) -> dict[str, float]:
        """Return the declared limits as ``<effect>_<parameter>``, and under ``<effect>`` the largest of them."""
        sizes: dict[str, float] = {}
        for term, size in self.declared.limits.items():
            names = [name for _, name in self.declared.coefficients(term)] if "*" in term else [term]
            sizes |= {f"{self.name}_{name}": size[sensor] if isinstance(size, dict) else size for name in names}
        return {self.name: max(sizes.values()), **sizes} if sizes else {}


class FormulaEffect(DeclaredEffect):
    """An effect whose terms are formulas."""

    of_samples = True

    def __init__(self, declared: Declaration, definition: dict[str, Any] | None = None) -> None:
        super().__init__(declared, definition)
        terms = list(declared.terms.values())
        self._by_axis, self._shared = [t for t in terms if not t.shared], [t for t in terms if t.shared]
        self._names = sorted({signal for term in terms for signal in term.signals})
        fields = {SIGNALS[name].field for name in self._names}
        self.needs_swing = "temperature_rate" in fields
        self.needs = tuple(f for f in OPTIONAL_FIELDS if f in fields or (f == "temperature" and self.needs_swing))
        self.needs_clock = "time" in self._names
        self.needs_motion = all(t.signals & OF_THE_MOTION for t in terms)
        if self._shared or declared.axes != AXES:
            self.layout = Layout.SHARED
        else:
            self.layout = Layout.PER_AXIS if any(t.by_axis for t in terms) else Layout.EVERY_AXIS
        varies = " and ".join(n for n in self._names if n != "u") or "what the sensor measures"
        self.excitation = self.excitation or f"recordings in which {varies} changes, on every axis concerned"
        repeated = f"repeat the recordings at other values of {varies}, with all else as it was"
        self.experiment = self.experiment or repeated

    def fields(self, sensor: str, values: Values) -> set[str]:
        """Return the fields of ``Motion`` that the formulas name."""
        return {SIGNALS[signal].field or TRUTHS[sensor] for signal in self._names}

    def in_c(self, values: Values) -> list[str]:
        """Return the sum for each axis as a C expression, with the terms in the order of ``reading``."""
        rows: dict[str, list[str]] = {axis: [] for axis in AXES}
        coefficients = iter(values.tolist())
        for axis in (*self.declared.axes, ""):
            for term in self._by_axis if axis else self._shared:
                factor = c_number(next(coefficients))
                for a in axis or AXES:
                    formula = term.formulas.get(a) or term.formulas[""]
                    rows[a].append(f"{factor} * {formula.in_c(AXES.index(a))}")
        return [" + ".join(products) or "0" for products in rows.values()]

    def regressors(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        """Return the values of the formulas in the shape of the layout.

        Raises ``InputError`` if a value is not finite where its signals are finite, or the recording lacks a signal.
        """
        signals = {name: self._signal(name, sensor, motion) for name in self._names}
        own, shared = ([_value(t, signals, len(motion.time)) for t in terms] for terms in (self._by_axis, self._shared))
        out = np.concatenate(own, axis=1) if self.layout == Layout.EVERY_AXIS else _stacked(own, len(motion.time))
        if self.layout == Layout.SHARED:
            columns = [AXES.index(axis) * len(own) + j for axis in self.declared.axes for j in range(len(own))]
            out = np.concatenate([per_axis(out)[:, :, columns], _stacked(shared, len(motion.time))], axis=2)
        if not np.isfinite(out).all():
            self._check_finite(signals, motion)
        return np.asarray(K @ out) if self.declared.adds_to == "truth" else out

    def reading(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        """Return what the effect adds to the reading, summed term by term: (n, 3) array, g or deg/s."""
        if self.layout == Layout.SHARED:
            return super().reading(sensor, motion, K, values)
        signals = {name: self._signal(name, sensor, motion) for name in self._names}
        added, product = np.zeros((2, 3, len(motion.time))).transpose(0, 2, 1)  # contiguous axis by axis: faster
        for term, coefficients in zip(self._by_axis, values.reshape(3, -1).T, strict=True):
            added += np.multiply(_value(term, signals, len(motion.time)), coefficients, out=product)
        if not np.isfinite(added).all():
            self._check_finite(signals, motion)
        return added

    def _signal(self, name: str, sensor: str, motion: Motion) -> Values | None:
        """Return a signal, (n, 1) array; (n, 3) for u; None for the angle or rate where there is no turn axis."""
        if name == "u":
            return truth(sensor, motion)
        if name == "speed":
            return length(motion.angular_rate)[:, None]
        field, place = SIGNALS[name].field, SIGNALS[name].place
        values: Values | None = turning_direction(motion) if field == "direction" else getattr(motion, field)
        if values is not None:
            return values[(slice(None), *place, None)]
        if name in OF_THE_TURN:
            return None
        problem = f"effect {self.name} depends on the {name}, but the recording{_of(motion, '')} holds none"
        raise InputError(f"{problem}; record it, or remove the effect from the configuration")

    def _check_finite(self, signals: MotionSignals, motion: Motion) -> None:
        """Raise ``InputError`` for a formula that is not finite where its signals are finite."""
        for axis, formula in (item for term in (*self._by_axis, *self._shared) for item in term.formulas.items()):
            used = {name: signal for name, signal in _of_axis(signals, axis).items() if name in formula.signals}
            if len(used) < len(formula.signals):
                continue
            value, *given = np.broadcast_arrays(formula(used), *used.values())
            rows, columns = np.nonzero(~np.isfinite(value) & np.logical_and.reduce(np.isfinite(given)))
            if len(rows):
                i, c = int(rows[0]), int(columns[0])
                places = ", ".join(f"{name} = {signal[i, c]:.6g}" for name, signal in zip(used, given, strict=True))
                raise InputError(
                    f"effect {self.name}: {formula.text} is not finite at {motion.time[i]:.6g} s{_of(motion)}, where "
                    f"{places}; write the formula so that it has a value everywhere (band, maximum), or leave it out"
                )


def _of_axis(signals: MotionSignals, axis: str) -> dict[str, Values]:
    """Return the known signals, with u of one axis; of all axes if ``axis`` is empty."""
    known = {name: signal for name, signal in signals.items() if signal is not None}
    if axis and "u" in known:
        c = AXES.index(axis)
        known["u"] = known["u"][:, c : c + 1]
    return known


def _value(term: Term, signals: MotionSignals, n: int) -> Values:
    """Return a term's value, (n, 1) or (n, 3) array; zeros where the motion has no turn axis for its signals."""
    parts = []
    for axis, formula in term.formulas.items():
        known = _of_axis(signals, axis)
        part = formula(known) if formula.signals <= known.keys() else np.zeros(1)
        parts.append(part if part.ndim == 2 else np.broadcast_to(part, (n, 1)))
    return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)


def _stacked(values: list[Values], n: int) -> Values:
    """Stack q arrays, (n, 1) or (n, 3), to an (n, 3, q) array."""
    out = np.empty((n, 3, len(values)))
    for j, value in enumerate(values):
        out[:, :, j] = value
    return out


def _of(motion: Motion, before: str = " of recording") -> str:
    return f"{before} {motion.recording}" if motion.recording else ""


@dataclass(frozen=True)
class Term:
    """A term of an effect: its formulas, and a coefficient for each axis or for all."""

    unit: str | dict[str, str]  # of the coefficient, for both sensors or by sensor
    meaning: str = ""
    formulas: dict[str, Formula] = field(default_factory=dict)  # by axis, "": every axis; none for an effect in Python
    shared: bool = False  # the formulas are a vector with one coefficient

    @property
    def signals(self) -> frozenset[str]:
        """The signals in the formulas."""
        return frozenset[str]().union(*(formula.signals for formula in self.formulas.values()))

    @property
    def by_axis(self) -> bool:
        """Whether the value differs between the axes."""
        return len(self.formulas) > 1 or "u" in self.signals

    @property
    def text(self) -> str:
        """The text of the formulas."""
        return ", ".join(formula.text for formula in self.formulas.values())


@dataclass(frozen=True, kw_only=True)
class Declaration:
    """The checked content of the file of an effect."""

    name: str
    owner: Owner
    sensors: tuple[str, ...]
    meaning: str
    terms: dict[str, Term] = field(default_factory=dict)
    axes: tuple[str, ...] = AXES
    adds_to: str = "reading"
    limits: dict[str, float | dict[str, float]] = field(default_factory=dict)
    contains: tuple[str, ...] = ()
    prior: str = ""
    needs_both_directions: bool = False
    excitation: str = ""
    experiment: str = ""
    experiment_by_hand: str = ""
    source: str = ""
    typical_share: float = 0.5
    proposed: bool = False
    shown_by: str = ""
    scales_with: str = ""
    built_in: bool = False
    python: str = ""
    parameters: dict[str, Term] = field(default_factory=dict)

    def coefficients(self, term: str) -> list[tuple[str, str]]:
        """Return axis and name of each coefficient of a term; the axis is empty where the axes share a coefficient."""
        if "*" in term:
            return [(a, term.replace("*", a)) for a in self.axes]
        if term in self.terms and not self.terms[term].shared:
            return [(a, f"{term}_{a}") for a in self.axes]
        return [("", term)]

    def parameters_of(self, sensor: str) -> tuple[EffectParameter, ...]:
        """Return the coefficients: those of x, of y, of z, then the shared ones."""
        found: dict[str, list[EffectParameter]] = {axis: [] for axis in (*self.axes, "")}
        for name, term in {**self.terms, **self.parameters}.items():
            unit = term.unit if isinstance(term.unit, str) else term.unit[sensor]
            meaning = term.meaning or f"coefficient of {term.text}"
            for axis, coefficient in self.coefficients(name):
                found[axis].append(EffectParameter(coefficient, unit, f"{meaning}, {axis} axis" if axis else meaning))
        return tuple(parameter for of_axis in found.values() for parameter in of_axis)


def read_declaration(
    given: Mapping[str, Any], where: str, lines: Callable[[], Mapping[tuple[str, ...], int]] = dict, *,
    built_in: bool = False,
) -> Declaration:  # fmt: skip
    """Check the content of an effect's file.

    ``where``: the file, for messages; ``lines``: returns the line of each key, called for a message only; ``built_in``:
    whether the file may name a class and its ``parameters``. Raises ``ConfigurationError`` at the first fault, with
    file, line, and what is expected.
    """
    checks = {**CHECKS, **BUILT_IN_CHECKS} if built_in else CHECKS
    try:
        declared = Declaration(**fields(checks, REQUIRED)(given))
        _check_consistency(declared)
    except WrongValueError as wrong:
        found, path = lines(), tuple(map(str, wrong.path))
        line = next((found[path[:n]] for n in range(len(path), 0, -1) if path[:n] in found), None)
        raise ConfigurationError(str(wrong), f"{where}:{line}" if line else where) from None
    return declared


def _line(longest: int) -> Check:
    """Return the check of a text on one line; line breaks become spaces."""

    def check(given: object) -> str:
        text = " ".join(given.split()) if isinstance(given, str) else ""
        if not text or len(text) > longest or not text.isprintable():
            raise expected(f"a text of 1 to {longest} characters", given)
        return text

    return check


def _name(given: object) -> str:
    if not isinstance(given, str) or not EFFECT_NAME.fullmatch(given) or given in RESERVED:
        raise WrongValueError(f"{given!r} is no name of an effect; use small letters, digits and _, at most 50")
    return given


def _some_of(known: tuple[str, ...]) -> Check:
    def check(given: object) -> tuple[str, ...]:
        listed = given if isinstance(given, (list, tuple)) else ()
        found = tuple(v for v in known if v in listed)
        if not found or len(found) != len(listed):
            raise expected(f"a list of some of {', '.join(known)}", given)
        return found

    return check


def _by_sensor(check: Check) -> Check:
    """Return the check of a value, or of a mapping of sensors to values."""
    of_sensors = fields(dict.fromkeys(SENSORS, check))
    return lambda given: of_sensors(given) if isinstance(given, dict) else check(given)


def _size(given: object) -> float:
    if isinstance(given, bool) or not isinstance(given, (int, float)) or not 0.0 < given < inf:
        raise expected("a number above 0", given)
    return float(given)


def _formulas(given: Any) -> dict[str, Formula]:  # noqa: ANN401
    """Return the formula of each axis, or one under the key "" for all axes."""
    if not isinstance(given, (dict, list)):
        return {"": _formula(given)}
    texts = dict(zip(AXES, given, strict=False)) if isinstance(given, list) else given
    if len(given) != len(AXES) or set(texts) != set(AXES):
        raise WrongValueError("one formula, a list of three (x, y, z), or a mapping of x, y and z is expected")
    return {axis: _formula(texts[axis]) for axis in AXES}


def _formula(text: object) -> Formula:
    if isinstance(text, bool) or not isinstance(text, (str, int, float)):
        raise WrongValueError(f"a formula is text, not {text!r}")
    try:
        return parse(text if isinstance(text, str) else repr(text))
    except ConfigurationError as error:
        raise WrongValueError(error.message) from None


def _term(given: Any) -> Term:  # noqa: ANN401
    found = fields({"formula": _formulas, **TERM_CHECKS}, ("formula", "unit"))(given)
    return Term(formulas=found.pop("formula"), shared=isinstance(given["formula"], list), **found)


TEXT = _line(LONGEST_TEXT)
TERM_CHECKS: dict[str, Check] = {"unit": _by_sensor(_line(LONGEST_UNIT)), "meaning": TEXT}
CHECKS: dict[str, Check] = {
    "name": _name,
    "owner": one_of(*Owner),
    "sensors": _some_of(SENSORS),
    "meaning": TEXT,
    "terms": each(_term),
    "axes": _some_of(AXES),
    "adds_to": one_of("reading", "truth"),
    "limits": each(_by_sensor(_size)),
    "contains": lambda given: tuple(items(text)(given)),
    "needs_both_directions": flag,
    "excitation": TEXT,
    "experiment": TEXT,
    "experiment_by_hand": TEXT,
    "source": TEXT,
    "typical_share": _size,
}
BUILT_IN_CHECKS: dict[str, Check] = {
    "built_in": flag,
    "proposed": flag,
    "prior": TEXT,
    "shown_by": TEXT,
    "scales_with": TEXT,
    "python": TEXT,
    "parameters": each(lambda given: Term(**fields(TERM_CHECKS, ("unit",))(given))),
}


def _check_consistency(declared: Declaration) -> None:
    """Raise ``WrongValueError`` for the first part that contradicts another."""
    terms = declared.terms
    if not (declared.python or 1 <= len(terms) <= MOST_TERMS):
        raise WrongValueError(f"{len(terms)} terms; from 1 to {MOST_TERMS} are expected", "terms")
    for name, term in {**terms, **declared.parameters}.items():
        path = "terms" if name in terms else "parameters", name
        if not TERM.fullmatch(name):
            raise WrongValueError(f"{name!r} is no name of a term; use letters, digits and _, at most 20", *path)
        _check_sensors(declared, term.unit, "unit", *path, "unit")
        if wrong := name in terms and _wrong_term(declared, name, term):
            raise WrongValueError(wrong, *path)
    names = [n for term in terms for _, n in declared.coefficients(term)]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise WrongValueError(f"two coefficients would be called {twice[0]}; rename a term", "terms")
    if declared.limits and set(declared.limits) != set(terms):
        raise WrongValueError(f"a limit for each term is expected ({', '.join(terms)}), or none at all", "limits")
    for name, size in declared.limits.items():
        _check_sensors(declared, size, "limit", "limits", name)


def fitted_anyway(declared: Declaration) -> dict[str, str]:
    """Return the terms that any fit has in bias and matrix, with what they are, in words."""
    found: dict[str, str] = {}
    for name, term in declared.terms.items():
        formulas = [(term.formulas.get(a) or term.formulas[""]).text for a in AXES]
        for sensor in declared.sensors:
            if what := _of_bias_and_matrix(sensor, formulas):
                found[name] = f"for the {sensor} the formula is {what}, whatever is recorded: that is fitted anyway"
    return found


def _of_bias_and_matrix(sensor: str, formulas: Sequence[str]) -> str:
    """Return the parameters of bias and matrix whose change a term equals at any signals; empty for other terms.

    ``formulas``: of x, y and z. Each is evaluated at signals of sizes from 0.001 to 1000 and near its own numbers.
    """
    rng = np.random.default_rng(0)
    numbers = [float(text) for text in NUMBER.findall(" ".join(formulas))]
    sizes = rng.choice([-1.0, 1.0], PROBES) * 10.0 ** rng.uniform(-3.0, 3.0, (len(SIGNALS), PROBES))
    near = np.repeat(numbers, PROBES) * (1.0 + 0.1 * rng.standard_normal((len(SIGNALS), PROBES * len(numbers))))
    drawn = dict(zip(SIGNALS, np.concatenate([sizes, near], axis=1), strict=True))
    own = [drawn[f"{OWN[sensor]}{a}"] for a in AXES]
    base, constant = np.stack([np.ones_like(own[0]), *own], axis=1), True
    adds = False
    for formula, u in zip(formulas, own, strict=True):
        values = np.broadcast_to(parse(formula)({**drawn, "u": u}), len(u))
        known = np.isfinite(values)
        if np.count_nonzero(known) < PROBES // 4:
            return ""
        scale = np.linalg.norm(base[known], axis=0)
        solved, *_ = np.linalg.lstsq(base[known] / scale, values[known])
        if np.abs(base[known] / scale @ solved - values[known]).max() > ALIKE * np.abs(values[known]).max():
            return ""
        constant &= bool(np.abs(solved[1:]).max() <= ALIKE * np.abs(solved[0]))
        adds |= bool(values[known].any())
    if not adds:
        return ""
    return "a constant, which is the bias" if constant else "a combination of bias and matrix"


def _check_sensors(declared: Declaration, given: object, what: str, *path: str) -> None:
    """Raise ``WrongValueError`` if a mapping does not have one value for each sensor of the effect."""
    if isinstance(given, dict) and set(given) != set(declared.sensors):
        raise WrongValueError(f"a {what} for each of {', '.join(declared.sensors)} is expected", *path)


def _wrong_term(declared: Declaration, name: str, term: Term) -> str:
    """Return how a term contradicts the rest of the file; empty if it does not."""
    if not term.signals:
        return "the formula names no signal: a constant is the bias, which is fitted anyway"
    not_in_a_log = sorted(s for s in term.signals if not SIGNALS[s].c)
    if declared.owner == Owner.SENSOR and not_in_a_log:
        found = " and ".join(not_in_a_log)
        return f"owner is sensor, but field logs do not have {found}; write owner: table"
    if term.shared and "*" in name:
        return "a vector has one coefficient: its name has no star"
    if declared.adds_to == "truth" and not term.shared:
        return "what is added to the truth is a vector: a list of three formulas is expected"
    return ""
