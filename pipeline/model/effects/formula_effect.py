"""Effects whose terms are formulas: compiled to numpy for the fit, to C for ``calibration.h``.

    z_c = sum over terms of p_tc h_t(signals)          (a coefficient for each axis c in ``axes``)
        + sum over vector terms of p_t h_tc(signals)   (one coefficient for all axes)

where p are the coefficients, which are fitted, and h formulas in the signals of ``pipeline.model.formula``; those of
the table's angle and rate count 0 in a recording without a turn axis. With ``adds_to: truth`` the terms change the
specific force or the rate itself; the reading changes by K times that, K the inverse of the calibration matrix.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import InputError
from pipeline.model.effects.base import Effect, Layout, length, truth, turning_direction
from pipeline.model.formula import OF_THE_MOTION, SIGNALS, c_number
from pipeline.records import AXES

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from pipeline.model.effects.base import Parameter
    from pipeline.model.effects.declaration import Declaration, Term
    from pipeline.model.formula import Formula
    from pipeline.records import Motion

OF_THE_TURN = ("angle", "rate")
NEEDED = ("temperature", "angle", "rate", "level")  # fields that a motion may lack
TRUTHS = {"accelerometer": "specific_force", "gyroscope": "angular_rate"}


class DeclaredEffect(Effect):
    """An effect whose name, owner, parameters and texts stand in a file; its equation is a subclass.

    Parameters
    ----------
    declared : Declaration
    definition : dict, optional
        Of a user's own, the content of the file.
    """

    declared: Declaration

    def __init__(self, declared: Declaration, definition: dict[str, Any] | None = None) -> None:
        self.declared, self.definition = declared, definition
        self.name, self.owner, self.sensors = declared.name, declared.owner, declared.sensors
        self.contains, self.needs_both_directions = declared.contains, declared.needs_both_directions
        self.meaning = declared.meaning
        self.excitation, self.experiment = declared.excitation or "", declared.experiment or ""
        self.source = declared.source or ""

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return the parameters that the file declares."""
        return self.declared.parameters_of(sensor)

    def limits(self, sensor: str) -> dict[str, float]:
        """Return the limits that the file declares, keyed as those of a data sheet; its own name: the largest."""
        sizes: dict[str, float] = {}
        for term, size in self.declared.limits.items():
            names = [name for _, name in self.declared.coefficients(term)] if "*" in term else [term]
            value = size if isinstance(size, float) else size[sensor]  # type: ignore[index]
            sizes |= {f"{self.name}_{name}": value for name in names}
        return {self.name: max(sizes.values()), **sizes} if sizes else {}


class FormulaEffect(DeclaredEffect):
    """An effect whose terms are formulas."""

    def __init__(self, declared: Declaration, definition: dict[str, Any] | None = None) -> None:
        super().__init__(declared, definition)
        terms = declared.terms.values()
        signals = frozenset[str]().union(*(t.signals for t in terms))
        fields = {SIGNALS[s].field for s in signals}
        self.needs = tuple(field for field in NEEDED if field in fields)
        self.needs_clock = "time" in signals
        self.needs_motion = all(t.signals & OF_THE_MOTION for t in terms)
        self.layout = _layout(declared)
        varies = " and ".join(sorted(signals - {"u"})) or "what the sensor measures"
        self.excitation = self.excitation or f"recordings in which {varies} changes, on every axis concerned"
        self.experiment = (
            self.experiment or f"repeat the recordings at other values of {varies}, with all else as it was"
        )

    def fields(self, sensor: str, values: NDArray[np.float64]) -> set[str]:
        """Return the fields of ``Motion`` that the formulas name."""
        del values
        signals = frozenset[str]().union(*(t.signals for t in self.declared.terms.values()))
        return {SIGNALS[signal].field or TRUTHS[sensor] for signal in signals}

    def in_c(self, values: NDArray[np.float64]) -> list[str] | None:
        """Return the sum on each axis as a C expression, its terms in the order of ``reading``."""
        terms, rows = self.declared.terms, dict.fromkeys(AXES, "")
        coefficients = iter(values.tolist())
        for axis in (*self.declared.axes, ""):
            for term in terms.values():
                if term.formula.shared == bool(axis):
                    continue
                factor = c_number(next(coefficients))
                for a in axis or AXES:
                    c = AXES.index(a)
                    product = f"{factor} * {_formula_of(term, c).in_c(c)}"
                    rows[a] += f" + {product}" if rows[a] else product
        return [rows[axis] or "0" for axis in AXES]

    def regressors(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the formulas' values in the shape of the layout."""
        del values
        terms = list(self.declared.terms.values())
        signals = self._signals(sensor, motion)
        if self.layout == Layout.EVERY_AXIS:
            return np.stack([self._value(_formula_of(t, 0), signals, motion) for t in terms], axis=1)
        if self.layout == Layout.PER_AXIS:
            return np.stack([self._of_axes(t, signals, motion) for t in terms], axis=2)
        scalar = [self._of_axes(t, signals, motion) for t in terms if not t.formula.shared]
        columns = []
        for axis in self.declared.axes:
            c = AXES.index(axis)
            for value in scalar:
                columns.append(np.zeros_like(value))
                columns[-1][:, c] = value[:, c]
        columns += [self._of_axes(t, signals, motion) for t in terms if t.formula.shared]
        stacked = np.stack(columns, axis=2)
        return K @ stacked if self.declared.adds_to == "truth" else stacked

    def _of_axes(self, term: Term, signals: list[dict[str, Any]], motion: Motion) -> NDArray[np.float64]:
        """Return a term's value on each axis: (n, 3) array."""
        if not term.by_axis:
            value = self._value(_formula_of(term, 0), signals, motion)
            return np.broadcast_to(value[:, None], (len(value), 3))
        return np.stack([self._value(_formula_of(term, c), signals, motion, c) for c in range(3)], axis=1)

    def _signals(self, sensor: str, motion: Motion) -> list[dict[str, Any]]:
        """Return the signals that the formulas name, for each axis; what the motion lacks is left out."""
        names = sorted(frozenset[str]().union(*(t.signals for t in self.declared.terms.values())))
        common = {name: self._signal(name, motion) for name in names if name != "u"}
        if "u" not in names:
            return [common] * 3
        u = truth(sensor, motion)
        return [{**common, "u": u[:, c]} for c in range(3)]

    def _signal(self, name: str, motion: Motion) -> NDArray[np.float64] | None:
        """Return a signal: (n,) array, or None for the angle and the rate of a recording without a turn axis.

        Raises
        ------
        InputError
            If the recording does not hold it.
        """
        if name == "speed":
            return length(motion.angular_rate)
        field, place = SIGNALS[name].field, SIGNALS[name].place
        found: NDArray[np.float64] | None = (
            turning_direction(motion) if field == "direction" else getattr(motion, field)
        )
        if found is None:
            if name in OF_THE_TURN:
                return None
            raise InputError(
                f"effect {self.name} looks at the {name}, but the recording{_of(motion, '')} holds none; "
                "record one, or take the effect out of the configuration"
            )
        for i in place:
            found = found[:, i]
        return found

    def _value(
        self, formula: Formula, signals: list[dict[str, Any]], motion: Motion, axis: int = 0
    ) -> NDArray[np.float64]:
        """Return a formula's value: (n,) array.

        Raises
        ------
        InputError
            If it is not finite where its signals are.
        """
        n = len(motion.time)
        given: Mapping[str, Any] = {name: signals[axis][name] for name in formula.signals}
        if any(signal is None for signal in given.values()):
            return np.zeros(n)
        value = np.broadcast_to(formula(given), (n,))
        wrong = ~np.isfinite(value)
        if np.any(wrong):
            known = np.all([np.isfinite(signal) for signal in given.values()], axis=0)
            first = np.flatnonzero(wrong & known)
            if len(first):
                i = int(first[0])
                at = ", ".join(f"{name} = {given[name][i]:.6g}" for name in sorted(given))
                raise InputError(
                    f"effect {self.name}: {formula.text} is not finite at {motion.time[i]:.6g} s{_of(motion)}, where "
                    f"{at}; write the formula so that it has a value everywhere (band, maximum), or leave it out"
                )
        return value


def _formula_of(term: Term, axis: int) -> Formula:
    """Return the formula of a term for one axis."""
    return term.formula.of[AXES[axis]] if AXES[axis] in term.formula.of else term.formula.of[""]


def _layout(declared: Declaration) -> Layout:
    """Return the simplest layout that holds the terms."""
    if declared.axes != AXES or any(t.formula.shared for t in declared.terms.values()):
        return Layout.SHARED
    return Layout.PER_AXIS if any(t.by_axis for t in declared.terms.values()) else Layout.EVERY_AXIS


def _of(motion: Motion, before: str = " of recording") -> str:
    return f"{before} {motion.recording}" if motion.recording else ""
