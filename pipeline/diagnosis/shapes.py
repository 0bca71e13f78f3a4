"""Simple shapes that a residual may have in one covariate, as formulas that a user's own effect file may hold.

    harmonic    : a cos(n A) + b sin(n A), A the angle of the table, n = 1 to 12 cycles a turn
    ripple      : u (a cos(n A) + b sin(n A)), u the rate about the axis, of a gyroscope
    polynomial  : sum over p = 1 to d of a_p x^p, d = 2 to 5, x the covariate centred and scaled to its span
    step        : a where the covariate is above a value; or a (1 + tanh((v - v_0) / w)) / 2
    band        : a where the speed lies between two values
    exponential : a exp(-(v - v_min) / s), which dies out, or a exp((v - v_max) / s), which grows

Places, widths and constants are scanned: first coarsely over the span, then about the best.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.model.effects.base import truth
from pipeline.model.formula import parse

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.observations import Observations
    from pipeline.records import Motion

    Values = NDArray[np.float64]

CYCLES = range(1, 13)
ORDER = 5
PLACES = 40
FINE = 12  # places to each side of the best, down to a twelfth of the coarse distance
WIDTHS = (0.25, 0.5, 1.0, 2.0, 4.0)  # of the coarse distance
CONSTANTS = tuple(np.geomspace(0.06, 1.5, 9))  # of the span
SAME_SPEED = 0.02


@dataclass(frozen=True)
class Shape:
    """A shape that is tried.

    Attributes
    ----------
    kind : str
    signal : str
    formulas : tuple of str
        One for each coefficient.
    scanned : int
        How many nonlinear parameters were scanned to find it.
    figures : dict
        Those parameters: ``at``, ``width``, ``low``, ``high``, ``cycles``, ``order``, ``constant``.
    combination : dict of int to float
        Of which columns of the scan a single column is made; empty: its own formulas are columns.
    """

    kind: str
    signal: str
    formulas: tuple[str, ...]
    scanned: int
    figures: dict[str, Any] = field(default_factory=dict)
    combination: dict[int, float] = field(default_factory=dict)


def columns_of(formulas: Sequence[str], sensor: str) -> Callable[[Motion], Values]:
    """Return what evaluates formulas: motion to (n, q) columns, or to (n, 3, q) where one looks at ``u``."""
    parsed = [parse(text) for text in formulas]

    def columns(motion: Motion) -> Values:
        signals = signals_of(motion)
        if not any("u" in formula.signals for formula in parsed):
            return np.stack([_value(formula, signals) for formula in parsed], axis=1)
        u = truth(sensor, motion)
        each = [[_value(f, signals | {"u": u[:, c]}) for f in parsed] for c in range(3)]
        return np.stack([np.stack(axis, axis=1) for axis in each], axis=1)

    return columns


def _value(formula: Callable[..., Values], signals: dict[str, Values | None]) -> Values:
    size = len(signals["time"])  # type: ignore[arg-type]  # a motion always has times
    known = {name: value for name, value in signals.items() if value is not None}
    if not formula.signals <= set(known):  # type: ignore[attr-defined]
        return np.zeros(size)
    return np.broadcast_to(formula(known), (size,))


def signals_of(motion: Motion) -> dict[str, Values | None]:
    """Return the signals of the formula language that a motion tells, but ``u``."""
    found: dict[str, Values | None] = {
        "time": motion.time,
        "temperature": motion.temperature,
        "angle": motion.angle,
        "rate": motion.rate,
        "speed": np.sqrt(np.einsum("ij,ij->i", motion.angular_rate, motion.angular_rate)),
    }
    for c, axis in enumerate("xyz"):
        found[f"f{axis}"], found[f"w{axis}"] = motion.specific_force[:, c], motion.angular_rate[:, c]
    return found


@dataclass(frozen=True)
class Span:
    """The values of a signal over all rows, sorted: where shapes may lie."""

    signal: str
    values: Values

    @classmethod
    def of(cls, observations: Observations, signal: str) -> Span:
        """Return the span of a signal."""
        found = [v for part in observations.parts if (v := signals_of(part.motion)[signal]) is not None]
        return cls(signal, np.sort(np.concatenate(found)))

    @property
    def low(self) -> float:
        """Smallest value."""
        return float(self.values[0])

    @property
    def high(self) -> float:
        """Largest value."""
        return float(self.values[-1])

    @property
    def size(self) -> float:
        """Largest less smallest."""
        return max(self.high - self.low, 1e-12)

    def places(self) -> Values:
        """Return where steps are tried: evenly over the span; between the speeds that were held, for a speed."""
        if self.signal != "speed":
            return self.low + self.size * (np.arange(PLACES) + 0.5) / PLACES
        moving = self.values[self.values > SAME_SPEED * self.high / PLACES]
        held = np.unique(np.quantile(moving, np.linspace(0.0, 1.0, PLACES)) if len(moving) else moving)
        held = np.concatenate([[0.0], held])
        apart = np.diff(held) > SAME_SPEED * held[1:]
        middle: Values = 0.5 * (held[1:] + held[:-1])
        return middle[apart]


def harmonics(factor: str = "") -> list[Shape]:
    """Return the harmonics of the table's angle; with the factor ``u`` those in proportion to the rate."""
    return [
        Shape(
            "ripple" if factor else "harmonic",
            "angle",
            tuple(f"{factor and factor + ' * '}{function}({n} * radians(angle))" for function in ("cos", "sin")),
            1,
            {"cycles": [n]},
        )
        for n in CYCLES
    ]


def powers(span: Span, signal: str | None = None) -> tuple[str, ...]:
    """Return the powers 1 to 5 of a signal, centred and scaled to its span; of ``u`` and forces only scaled."""
    name = signal or span.signal
    middle, half = _tidy(0.5 * (span.low + span.high), span.size), _tidy(0.5 * span.size, span.size)
    x = f"(({name} - {middle:g}) / {half:g})"
    if name == "u" or name.startswith("f"):
        scale = f"{_tidy(max(abs(span.low), abs(span.high)), span.size):g}"
        x = name if scale == "1" else f"({name} / {scale})"
    return (x, *(f"{x} ** {p}" for p in range(2, ORDER + 1)))


def steps(span: Span, places: Sequence[float] | Values) -> list[Shape]:
    """Return sharp steps at some places."""
    return [
        Shape("step", span.signal, (f"step({span.signal} - {p:.7g})",), 1, {"at": float(f"{p:.7g}")}) for p in places
    ]


def soft_steps(span: Span, places: Sequence[float] | Values, widths: Sequence[float]) -> list[Shape]:
    """Return soft steps at some places, of some widths each."""
    return [
        Shape(
            "step",
            span.signal,
            (f"0.5 * (1 + tanh(({span.signal} - {p:.7g}) / {width:.3g}))",),
            2,
            {"at": float(f"{p:.7g}"), "width": float(f"{width:.3g}")},
        )
        for p in places
        for width in widths
    ]


def bands(span: Span, places: Values) -> list[Shape]:
    """Return bands between any two of some places, as differences of the steps there."""
    return [
        Shape(
            "band",
            span.signal,
            (f"band({span.signal}, {places[i]:.5g}, {places[j]:.5g})",),
            2,
            {"low": float(places[i]), "high": float(places[j])},
            {i: 1.0, j: -1.0},
        )
        for i, j in combinations(range(len(places)), 2)
    ]


def exponentials(span: Span, constants: Sequence[float]) -> list[Shape]:
    """Return exponentials that die out from the smallest value, or grow towards the largest."""
    found = []
    for constant in constants:
        s = _tidy(constant, span.size)
        for start, text in (
            (span.low, f"exp(({_tidy(span.low, span.size):g} - {span.signal}) / {s:g})"),
            (span.high, f"exp(({span.signal} - {_tidy(span.high, span.size):g}) / {s:g})"),
        ):
            grows = start == span.high
            found.append(Shape("exponential", span.signal, (text,), 1, {"constant": s, "grows": grows}))
    return found


def finer(shape: Shape, span: Span) -> list[Shape]:
    """Return shapes of the same kind about one: steps beside it, sharp and soft, and other constants."""
    if shape.kind == "step":
        apart = span.size / PLACES
        if span.signal == "speed":
            places = span.places()
            near = places[np.argsort(np.abs(places - shape.figures["at"]))[:3]]
            apart = float(np.ptp(near)) / 2.0
        beside = shape.figures["at"] + apart * np.arange(-FINE, FINE + 1) / FINE
        return steps(span, beside) + soft_steps(span, beside[::3], [apart * w for w in WIDTHS])
    if shape.kind == "exponential":
        return exponentials(span, [shape.figures["constant"] * f for f in np.geomspace(0.6, 1.6, 9)])
    return []


def _tidy(value: float, span: float) -> float:
    """Return a value to a ten-thousandth of the span, so that the formula is short and loses nothing."""
    digits = max(0, 4 - int(np.floor(np.log10(span))))
    return round(value, digits)
