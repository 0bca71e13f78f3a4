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
        self._parameters: dict[str, tuple[Parameter, ...]] = {}
        self.name, self.owner, self.sensors = declared.name, declared.owner, declared.sensors
        self.contains, self.needs_both_directions = declared.contains, declared.needs_both_directions
        self.meaning = declared.meaning
        self.excitation, self.experiment = declared.excitation or "", declared.experiment or ""
        self.source = declared.source or ""

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return the parameters that the file declares."""
        if sensor not in self._parameters:
            self._parameters[sensor] = self.declared.parameters_of(sensor)
        return self._parameters[sensor]

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
        self._terms = terms = list(declared.terms.values())
        signals = frozenset[str]().union(*(t.signals for t in terms))
        self._names = sorted(signals)
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
        return {SIGNALS[signal].field or TRUTHS[sensor] for signal in self._names}

    def in_c(self, values: NDArray[np.float64]) -> list[str] | None:
        """Return the sum on each axis as a C expression, its terms in the order of ``reading``."""
        rows = dict.fromkeys(AXES, "")
        coefficients = iter(values.tolist())
        for axis in (*self.declared.axes, ""):
            for term in self._terms:
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
        """Return the formulas' values in the shape of the layout.

        Raises
        ------
        InputError
            If a value is not finite where its signals are, or the recording does not hold a signal.
        """
        del values
        n, axes = len(motion.time), self.declared.axes
        signals = {name: self._signal(name, sensor, motion) for name in self._names}
        if self.layout == Layout.EVERY_AXIS:
            out = np.empty((n, len(self._terms)))
            for j, term in enumerate(self._terms):
                _fill(out[:, j : j + 1], term.formula.of[""], signals)
        elif self.layout == Layout.PER_AXIS:
            out = np.empty((n, 3, len(self._terms)))
            for j, term in enumerate(self._terms):
                _fill_axes(out[:, :, j], term, signals)
        else:
            scalar = [t for t in self._terms if not t.formula.shared]
            out = np.zeros((n, 3, len(axes) * len(scalar) + len(self._terms) - len(scalar)))
            for j, term in enumerate(scalar):
                value = np.empty((n, 3))
                _fill_axes(value, term, signals)
                for i, axis in enumerate(axes):
                    out[:, AXES.index(axis), i * len(scalar) + j] = value[:, AXES.index(axis)]
            shared = (t for t in self._terms if t.formula.shared)
            for j, term in enumerate(shared, len(axes) * len(scalar)):
                _fill_axes(out[:, :, j], term, signals)
        if not np.isfinite(out).all():
            self._check_finite(signals, motion)
        return np.asarray(K @ out) if self.declared.adds_to == "truth" else out

    def _signal(self, name: str, sensor: str, motion: Motion) -> NDArray[np.float64] | None:
        """Return a signal: (n, 1) array, u of all axes: (n, 3); None: the angle or rate where there is no turn axis."""
        if name == "u":
            return truth(sensor, motion)
        if name == "speed":
            return length(motion.angular_rate)[:, None]
        field, place = SIGNALS[name].field, SIGNALS[name].place
        found: NDArray[np.float64] | None = (
            turning_direction(motion) if field == "direction" else getattr(motion, field)
        )
        if found is not None:
            for i in place:
                found = found[:, i]
            return found[:, None]
        if name in OF_THE_TURN:
            return None
        raise InputError(
            f"effect {self.name} looks at the {name}, but the recording{_of(motion, '')} holds none; "
            "record one, or take the effect out of the configuration"
        )

    def reading(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return what the effect adds to the reading, summed term by term: (n, 3) array, g or deg/s."""
        if self.layout == Layout.SHARED:
            return super().reading(sensor, motion, K, values)
        signals = {name: self._signal(name, sensor, motion) for name in self._names}
        added, product = np.zeros((2, 3, len(motion.time))).transpose(0, 2, 1)  # axis by axis in memory
        for term, coefficients in zip(self._terms, values.reshape(3, -1).T, strict=True):
            for axis, formula in term.formula.of.items():
                if any(signals[name] is None for name in formula.signals):
                    continue
                at = slice(AXES.index(axis), AXES.index(axis) + 1) if axis else slice(None)
                np.multiply(formula(_of_axis(signals, axis)), coefficients[at], out=product[:, at])
                added[:, at] += product[:, at]
        if not np.isfinite(added).all():
            self._check_finite(signals, motion)
        return added

    def _check_finite(self, signals: dict[str, Any], motion: Motion) -> None:
        """Refuse a formula that is not finite where its signals are."""
        for term in self._terms:
            for axis, formula in term.formula.of.items():
                own = {name: signal for name, signal in _of_axis(signals, axis).items() if name in formula.signals}
                if any(signal is None for signal in own.values()):
                    continue
                value, *given = np.broadcast_arrays(formula(own), *own.values())
                rows, columns = np.nonzero(~np.isfinite(value) & np.logical_and.reduce(np.isfinite(given)))
                if len(rows):
                    i, c = int(rows[0]), int(columns[0])
                    at = ", ".join(f"{name} = {signal[i, c]:.6g}" for name, signal in zip(own, given, strict=True))
                    raise InputError(
                        f"effect {self.name}: {formula.text} is not finite at {motion.time[i]:.6g} s{_of(motion)}, "
                        f"where {at}; write the formula so that it has a value everywhere (band, maximum), or leave it "
                        "out"
                    )


def _of_axis(signals: dict[str, Any], axis: str) -> dict[str, Any]:
    """Return the signals of one axis, of all where none is named."""
    c = AXES.index(axis) if axis else 0
    return {**signals, "u": signals["u"][:, c : c + 1]} if axis and "u" in signals else signals


def _fill_axes(out: NDArray[np.float64], term: Term, signals: dict[str, Any]) -> None:
    """Write a term's value on each axis: (n, 3) array."""
    for axis, formula in term.formula.of.items():
        c = AXES.index(axis) if axis else 0
        _fill(out[:, c : c + 1] if axis else out, formula, _of_axis(signals, axis))


def _fill(out: NDArray[np.float64], formula: Formula, signals: dict[str, Any]) -> None:
    """Write a formula's value: (n, 1) or (n, 3) array; zeros where the motion lacks a signal of the turn."""
    out[:] = 0.0 if any(signals[name] is None for name in formula.signals) else formula(signals)


def _formula_of(term: Term, axis: int) -> Formula:
    """Return the formula of a term for one axis."""
    formulas: dict[str, Formula] = term.formula.of
    return formulas[AXES[axis]] if AXES[axis] in formulas else formulas[""]


def _layout(declared: Declaration) -> Layout:
    """Return the simplest layout that holds the terms."""
    if declared.axes != AXES or any(t.formula.shared for t in declared.terms.values()):
        return Layout.SHARED
    return Layout.PER_AXIS if any(t.by_axis for t in declared.terms.values()) else Layout.EVERY_AXIS


def _of(motion: Motion, before: str = " of recording") -> str:
    return f"{before} {motion.recording}" if motion.recording else ""
