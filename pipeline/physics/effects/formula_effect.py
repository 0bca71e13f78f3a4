"""Evaluate effects whose terms are formulas: by numpy in the fit, as C in ``calibration.h``.

    z_c = sum over terms of p_tc h_t(signals)          (a coefficient for each axis c in ``axes``)
        + sum over vector terms of p_t h_tc(signals)   (one coefficient for all axes)

where p are the coefficients, which are fitted, and h are formulas in the signals of ``pipeline.physics.formula``. A
formula with the table's angle or rate is 0 in a recording without a turn axis. With ``adds_to: truth`` the terms change
the specific force or the rate; the reading changes by K times the terms, with K the inverse of the calibration matrix.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.core.errors import InputError
from pipeline.core.records import AXES, Motion, Values
from pipeline.physics.effects.base import Effect, EffectParameter, Layout, length, per_axis, truth, turning_direction
from pipeline.physics.formula import OF_THE_MOTION, SIGNALS, c_number

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.physics.effects.declaration import Declaration, Term

    Signals = Mapping[str, Values | None]  # None: the recording has no turn axis

AS_DECLARED = (
    *("name", "owner", "sensors", "contains", "prior", "needs_both_directions", "meaning", "excitation", "experiment"),
    *("experiment_by_hand", "source", "typical_share", "proposed", "shown_by"),
)
OF_THE_TURN = ("angle", "rate")
OPTIONAL_FIELDS = ("temperature", "angle", "rate", "level")  # fields that a motion may lack
TRUTHS = {"accelerometer": "specific_force", "gyroscope": "angular_rate"}


class DeclaredEffect(Effect):
    """An effect with name, owner, parameters and texts from a file; a subclass has its equation.

    ``definition``: the content of the file of a user's effect.
    """

    def __init__(self, declared: Declaration, definition: dict[str, Any] | None = None) -> None:
        self.declared, self.definition = declared, definition
        for name in AS_DECLARED:
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
        self.needs = tuple(field for field in OPTIONAL_FIELDS if field in fields)
        self.needs_clock = "time" in self._names
        self.needs_motion = all(t.signals & OF_THE_MOTION for t in terms)
        if self._shared or declared.axes != AXES:
            self.layout = Layout.SHARED
        else:
            self.layout = Layout.PER_AXIS if any(t.by_axis for t in terms) else Layout.EVERY_AXIS
        varies = " and ".join(n for n in self._names if n != "u") or "what the sensor measures"
        self.excitation = self.excitation or f"recordings in which {varies} changes, on every axis concerned"
        self.experiment = (
            self.experiment or f"repeat the recordings at other values of {varies}, with all else as it was"
        )

    def fields(self, sensor: str, values: Values) -> set[str]:
        """Return the fields of ``Motion`` that the formulas name."""
        del values
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
        del values
        signals = {name: self._signal(name, sensor, motion) for name in self._names}
        own, shared = (
            [_value(term, signals, len(motion.time)) for term in terms] for terms in (self._by_axis, self._shared)
        )
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
        raise InputError(
            f"effect {self.name} depends on the {name}, but the recording{_of(motion, '')} holds none; "
            "record it, or remove the effect from the configuration"
        )

    def _check_finite(self, signals: Signals, motion: Motion) -> None:
        """Raise ``InputError`` for a formula that is not finite where its signals are finite."""
        for axis, formula in (each for term in (*self._by_axis, *self._shared) for each in term.formulas.items()):
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


def _of_axis(signals: Signals, axis: str) -> dict[str, Values]:
    """Return the known signals, with u of one axis; of all axes if ``axis`` is empty."""
    known = {name: signal for name, signal in signals.items() if signal is not None}
    if axis and "u" in known:
        c = AXES.index(axis)
        known["u"] = known["u"][:, c : c + 1]
    return known


def _value(term: Term, signals: Signals, n: int) -> Values:
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
