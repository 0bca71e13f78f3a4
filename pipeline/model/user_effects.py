"""Effects of a user's own: from formulas, or from a Python file that the user names.

    z_c = sum over terms of p_tc h_t(signals)          (a coefficient for each axis c in ``axes``)
        + sum over vector terms of p_t h_tc(signals)   (one coefficient for all axes)

where

p : coefficients, which are fitted
h : formulas in the signals of ``pipeline.model.formula``; those of the table's angle and rate count 0 in a recording
    without a turn axis

The effect is added to the reading as it stands, whoever owns it.
"""

from __future__ import annotations

import json
from functools import lru_cache
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from pipeline.errors import ConfigurationError, InputError
from pipeline.model.effect_definition import OF_THE_TABLE, read_definition
from pipeline.model.effects import effect
from pipeline.model.effects.base import Effect, Layout, Parameter, length, truth
from pipeline.records import AXES

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from pipeline.model.effect_definition import Definition, TermDefinition
    from pipeline.model.formula import Formula
    from pipeline.records import FittedEffect, Motion

VECTORS = {
    "specific_force": ("fx", "fy", "fz"),
    "angular_rate": ("wx", "wy", "wz"),
    "angular_acceleration": ("alphax", "alphay", "alphaz"),
}
FIELDS = {name: field for field, names in VECTORS.items() for name in names} | {
    "speed": "angular_rate",
    **{name: name for name in ("temperature", "time", "rate", "angle")},
}
TRUTHS = {"accelerometer": "specific_force", "gyroscope": "angular_rate"}


class FormulaEffect(Effect):
    """An effect whose terms are formulas."""

    described: ClassVar[Definition]

    def __reduce__(self) -> tuple[Any, ...]:
        return effect_from, (self.definition, f"effect {self.name}")

    def fields(self, sensor: str) -> set[str]:
        """Return the fields of a motion that the formulas look at."""
        signals = set().union(*(term.signals for term in self.described.terms))
        return {FIELDS.get(signal, TRUTHS[sensor]) for signal in signals}

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return the coefficients: axis by axis those of the scalar terms, then one of each vector term."""
        scalar = [t for t in self.described.terms if not t.shared]
        return tuple(
            Parameter(f"{t.name}_{a}", t.units[sensor], f"coefficient of {t.formulas[0].text}, {a} axis")
            for a in self.described.axes
            for t in scalar
        ) + tuple(
            Parameter(t.name, t.units[sensor], f"coefficient of ({', '.join(f.text for f in t.formulas)})")
            for t in self.described.terms
            if t.shared
        )

    def limits(self, sensor: str) -> dict[str, float]:
        """Return the definition's limits, keyed as those of the data sheet."""
        terms = {t.name: t.limits[sensor] for t in self.described.terms if sensor in t.limits}
        if not terms:
            return {}
        return {self.name: max(terms.values()), **{f"{self.name}_{name}": size for name, size in terms.items()}}

    def regressors(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the formulas' values in the shape of the layout."""
        del K, values
        terms, n = self.described.terms, len(motion.time)
        if self.layout == Layout.EVERY_AXIS:
            return np.stack([self._value(t.formulas[0], sensor, motion) for t in terms], axis=1)
        if self.layout == Layout.PER_AXIS:
            return np.stack([self._of_axes(t, sensor, motion) for t in terms], axis=2)
        scalar = [(t, self._of_axes(t, sensor, motion)) for t in terms if not t.shared]
        columns = []
        for axis in self.described.axes:
            c = AXES.index(axis)
            for _, value in scalar:
                columns.append(np.zeros((n, 3)))
                columns[-1][:, c] = value[:, c]
        columns += [self._of_axes(t, sensor, motion) for t in terms if t.shared]
        return np.stack(columns, axis=2)

    def _of_axes(self, term: TermDefinition, sensor: str, motion: Motion) -> NDArray[np.float64]:
        """Return a term's value on each axis: (n, 3) array."""
        if not term.shared and "u" not in term.signals:
            return np.broadcast_to(self._value(term.formulas[0], sensor, motion)[:, None], (len(motion.time), 3))
        formulas = term.formulas if term.shared else term.formulas * 3
        return np.stack([self._value(f, sensor, motion, c) for c, f in enumerate(formulas)], axis=1)

    def _value(self, formula: Formula, sensor: str, motion: Motion, axis: int = 0) -> NDArray[np.float64]:
        """Return a formula's value: (n,) array.

        Raises
        ------
        InputError
            If it is not finite where its signals are, or the recording holds no temperature.
        """
        n = len(motion.time)
        if any(getattr(motion, name) is None for name in formula.signals & OF_THE_TABLE):
            return np.zeros(n)
        signals = {name: self._signal(name, sensor, motion, axis) for name in formula.signals}
        value = np.broadcast_to(formula(signals), (n,))
        wrong = ~np.isfinite(value)
        if np.any(wrong):
            known = np.all([np.isfinite(signal) for signal in signals.values()], axis=0)
            first = np.flatnonzero(wrong & known)
            if len(first):
                i = int(first[0])
                at = ", ".join(f"{name} = {signals[name][i]:.6g}" for name in sorted(signals))
                raise InputError(
                    f"effect {self.name}: {formula.text} is not finite at {motion.time[i]:.6g} s{_of(motion)}, where "
                    f"{at}; write the formula so that it has a value everywhere (band, maximum), or leave it out"
                )
        return value

    def _signal(self, name: str, sensor: str, motion: Motion, axis: int) -> NDArray[np.float64]:
        if name == "u":
            return truth(sensor, motion)[:, axis]
        if name == "speed":
            return length(motion.angular_rate)
        found: NDArray[np.float64] | None = getattr(motion, FIELDS[name])
        if found is None:
            raise InputError(
                f"effect {self.name} looks at the {name}, but the recording{_of(motion, '')} holds none; "
                "record one, or take the effect out of the configuration"
            )
        return found[:, "xyz".index(name[-1])] if FIELDS[name] in VECTORS else found


def effect_from(
    definition: Mapping[str, Any], where: str, lines: Mapping[tuple[str, ...], int] | None = None
) -> FormulaEffect:
    """Return the effect that a definition describes (``pipeline.model.effect_definition`` says how).

    Parameters
    ----------
    definition : mapping
    where : str
        The file, for messages.
    lines : mapping, optional
        Keys from the top to their line in the file.

    Raises
    ------
    ConfigurationError
        If anything in it is not as it should be.
    """
    described = read_definition(dict(definition), where, lines)
    signals = frozenset().union(*(t.signals for t in described.terms))
    needs = tuple(s for s in ("temperature", "angle", "rate") if s in signals)
    varies = " and ".join(sorted(signals - {"u"})) or "what the sensor measures"
    texts = {
        "excitation": f"recordings in which {varies} changes, on every axis concerned",
        "experiment": f"repeat the recordings at other values of {varies}, with all else as it was",
        "source": f"the user's own, {where}",
        **described.texts,
    }
    attributes = {
        "name": described.name,
        "owner": described.owner,
        "sensors": described.sensors,
        "layout": _layout(described),
        "needs": needs,
        "needs_clock": "time" in signals,
        "described": described,
        **texts,
    }
    made: FormulaEffect = type("FormulaEffect", (FormulaEffect,), attributes)()
    made.definition = described.source
    return made


def effect_of(fitted: FittedEffect) -> Effect:
    """Return the effect that was fitted: from its own definition where it carries one, else from the catalogue.

    Raises
    ------
    ConfigurationError
        If it was defined in Python and the file has not been named, or has changed.
    """
    if fitted.definition is None:
        return effect(fitted.name)
    if "python" not in fitted.definition:
        return _remembered(json.dumps(fitted.definition, sort_keys=True))
    try:
        found = effect(fitted.name)
    except ConfigurationError:
        found = None
    if found is None or found.definition != fitted.definition:
        state = "is not loaded" if found is None else "has another content than the one that was fitted"
        raise ConfigurationError(
            f"the effect {fitted.name} was fitted with the Python file {fitted.definition['python']} (sha256 "
            f"{str(fitted.definition.get('sha256'))[:16]}...), which {state}; name that file: --python-effect FILE, or "
            "in Python load_calibration(path, python_effects=[FILE])"
        )
    return found


def owner_of(fitted: FittedEffect) -> str:
    """Return whose a fitted effect is; a Python file need not be loaded for that."""
    if fitted.definition and "owner" in fitted.definition:
        return str(fitted.definition["owner"])
    return effect_of(fitted).owner


@lru_cache(maxsize=256)
def _remembered(definition: str) -> Effect:
    return effect_from(json.loads(definition), "a calibration's own definition")


def _layout(described: Definition) -> Layout:
    """Return the simplest layout that holds the terms."""
    if described.axes != AXES or any(t.shared for t in described.terms):
        return Layout.SHARED
    return Layout.PER_AXIS if any("u" in t.signals for t in described.terms) else Layout.EVERY_AXIS


def _of(motion: Motion, before: str = " of recording") -> str:
    return f"{before} {motion.recording}" if motion.recording else ""
