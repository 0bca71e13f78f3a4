"""Simple functional forms that a residual may have in one covariate v, as formulas that a user's effect file may hold.

    harmonic, ripple : (1 or u) (a cos(n A) + b sin(n A)), A the table's angle, n = 1 to 12, u the rate of a gyroscope
    polynomial       : sum over p = 1 to d of a_p x^p, d = 2 to 5, x the covariate centred and scaled to its span
    step, band       : a where v > v_0; or a (1 + tanh((v - v_0) / w)) / 2; a where the speed lies between two values
    exponential      : a exp(-(v - v_min) / s), which decays, or a exp((v - v_max) / s), which grows

Places, widths and constants are scanned: first coarsely over the span, then about the best.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from pipeline.diagnosis.words import listed
from pipeline.model.effects.base import truth, unit_of
from pipeline.model.formula import parse

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from pipeline.diagnosis.residual_regression import Curves
    from pipeline.estimation.observations import Observations
    from pipeline.model.formula import Formula
    from pipeline.records import Motion

    Values = NDArray[np.float64]

CYCLES = range(1, 13)
ORDER = 5  # as DEGREE of the tests that find a dependence (pipeline.diagnosis.residual_dependence)
PLACES = 40  # a step is then placed to 1/80 of the span before the fine scan
FINE = 12  # places to each side of the best, down to a twelfth of the coarse distance
WIDTHS = (0.25, 0.5, 1.0, 2.0, 4.0)  # of the coarse distance
CONSTANTS = tuple(np.geomspace(0.06, 1.5, 9))  # of the span; steps of 1.5, then FACTORS about the best
FACTORS = tuple(np.geomspace(0.6, 1.6, 9))
SAME_SPEED = 0.02  # relative difference of speeds that are one speed of the procedure
UNITS = {"temperature": "degC", "time": "s", "speed": "deg/s", "angle": "deg"}


@dataclass(frozen=True)
class Form:
    """A functional form that is tried."""

    kind: str
    signal: str
    formulas: tuple[str, ...]  # one for each coefficient
    words: str  # a noun phrase, in which {size} stands for its size
    scanned: int = 1  # how many nonlinear parameters were scanned to find it
    place: float = 0.0  # of a step, or the constant of an exponential: where a finer scan begins
    combination: dict[int, float] = field(default_factory=dict)  # of the scan's columns; empty: its own formula


def columns_of(formulas: Iterable[str], sensor: str) -> Curves:
    """Return what evaluates formulas: motion to (n, q) columns, or to (n, 3, q) where one contains ``u``."""
    parsed = [parse(text) for text in formulas]

    def columns(motion: Motion) -> Values:
        signals = signals_of(motion)
        if not any("u" in formula.signals for formula in parsed):
            return np.stack([_value(formula, signals) for formula in parsed], axis=1)
        u = truth(sensor, motion)
        each = [[_value(f, signals | {"u": u[:, c]}) for f in parsed] for c in range(3)]
        return np.stack([np.stack(axis, axis=1) for axis in each], axis=1)

    return columns


def _value(formula: Formula, signals: dict[str, Values | None]) -> Values:
    """Return a formula's values, zero in a recording that lacks one of its signals."""
    known = {name: value for name, value in signals.items() if value is not None}
    size = len(known["time"])
    return np.broadcast_to(formula(known), (size,)) if formula.signals <= set(known) else np.zeros(size)


def signals_of(motion: Motion) -> dict[str, Values | None]:
    """Return the signals of the formula language in a motion, without ``u``."""
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
    """The sorted values of a signal over all rows."""

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
        """Return where steps are tried: evenly over the span; for a speed, between the speeds that were held."""
        if self.signal != "speed":
            return self.low + self.size * (np.arange(PLACES) + 0.5) / PLACES
        moving = self.values[self.values > SAME_SPEED * self.high / PLACES]
        held = np.unique(np.quantile(moving, np.linspace(0.0, 1.0, PLACES)) if len(moving) else moving)
        held = np.concatenate([[0.0], held])
        apart = np.diff(held) > SAME_SPEED * held[1:]
        middle: Values = 0.5 * (held[1:] + held[:-1])
        return middle[apart]

    def rounded(self, value: float) -> float:
        """Return a value to a ten-thousandth of the span, which keeps formulas short."""
        return round(value, max(0, 4 - int(np.floor(np.log10(self.size)))))


def harmonics(factor: str = "") -> list[Form]:
    """Return the harmonics of the table's angle; with the factor ``u`` those in proportion to the rate."""
    return [harmonic(factor, [n]) for n in CYCLES]


def harmonic(factor: str, cycles: Sequence[int]) -> Form:
    """Return harmonics of so many cycles a turn as one form."""
    times = f"{factor} * " if factor else ""
    formulas = tuple(f"{times}{f}({n} * radians(angle))" for n in cycles for f in ("cos", "sin"))
    each = " and ".join(str(n) for n in sorted(cycles))
    rate = " in proportion to the rate" if factor else ""
    words = f"{each} cycle{'' if each == '1' else 's'} per turn of the table{rate}, amplitude {{size}}"
    return Form("ripple" if factor else "harmonic", "angle", formulas, words)


def powers(span: Span, name: str) -> tuple[str, ...]:
    """Return the powers 1 to 5 of a signal, centred and scaled to its span; ``u`` and forces are scaled only."""
    middle, half = span.rounded(0.5 * (span.low + span.high)), span.rounded(0.5 * span.size)
    x = f"(({name} - {middle:g}) / {half:g})"
    if name == "u" or name.startswith("f"):
        scale = f"{span.rounded(max(abs(span.low), abs(span.high))):g}"
        x = name if scale == "1" else f"({name} / {scale})"
    return (x, *(f"{x} ** {p}" for p in range(2, ORDER + 1)))


def steps(span: Span, places: Sequence[float] | Values, widths: Sequence[float] = ()) -> list[Form]:
    """Return sharp steps at some places, or soft ones of some widths each."""
    signal, unit, digits = span.signal, UNITS[span.signal], 0 if span.signal == "time" else 1
    found = []
    for p in places:
        at = float(f"{p:.7g}")
        words = f"a step at {at:.{digits}f} {unit}"
        if not widths:
            found.append(Form("step", signal, (f"step({signal} - {p:.7g})",), f"{words}, of {{size}}", place=at))
        for width in widths:
            soft = f"0.5 * (1 + tanh(({signal} - {p:.7g}) / {width:.3g}))"
            over = f"{words}, over about {2 * float(f'{width:.3g}'):.2g} {unit}, of {{size}}"
            found.append(Form("step", signal, (soft,), over, 2, at))
    return found


def bands(span: Span, places: Values) -> list[Form]:
    """Return bands between any two of some places, as differences of the steps there."""
    found = []
    for i, j in combinations(range(len(places)), 2):
        low, high = float(places[i]), float(places[j])
        text = f"band({span.signal}, {low:.5g}, {high:.5g})"
        words = f"a band from {low:.3g} to {high:.3g} {UNITS[span.signal]} of {{size}}"
        found.append(Form("band", span.signal, (text,), words, 2, combination={i: 1.0, j: -1.0}))
    return found


def exponentials(span: Span, constants: Iterable[float]) -> list[Form]:
    """Return exponentials that decay from the smallest value, or grow towards the largest."""
    found, signal = [], span.signal
    for constant in constants:
        s = span.rounded(constant)
        decay = f"exp(({span.rounded(span.low):g} - {signal}) / {s:g})"
        growth = f"exp(({signal} - {span.rounded(span.high):g}) / {s:g})"
        for text, way in ((decay, "decays"), (growth, "grows")):
            words = f"an exponential of the {signal} that {way} with a constant of {s:.3g} {UNITS[signal]}"
            found.append(Form("exponential", signal, (text,), f"{words}, {{size}} in all", place=s))
    return found


def polynomial(signal: str, formulas: tuple[str, ...], order: int) -> Form:
    """Return the sum of some powers of a signal."""
    of = {"u": "the axis' own signal", "speed": "the speed"}.get(signal, signal)
    words = f"a polynomial of order {order} in {of}, {{size}} over its span"
    return Form("polynomial", signal, formulas, words, 0)


def finer(form: Form, span: Span) -> list[Form]:
    """Return forms of the same kind near one: steps at other places, sharp and soft, or other constants."""
    if form.kind == "step":
        apart = span.size / PLACES
        if span.signal == "speed":
            places = span.places()
            near = places[np.argsort(np.abs(places - form.place))[:3]]
            apart = float(np.ptp(near)) / 2.0
        around = form.place + apart * np.arange(-FINE, FINE + 1) / FINE
        return steps(span, around) + steps(span, around[::3], [apart * w for w in WIDTHS])
    if form.kind == "exponential":
        return exponentials(span, [form.place * f for f in FACTORS])
    return []


def described(form: Form, sizes: Values, axes: Sequence[int], sensor: str) -> str:
    """Return a fitted form as a noun phrase: ``a step at 31.0 degC, of 3.9 mg on x and -2.1 mg on z``.

    ``sizes`` are amplitude, height or whole change on each axis, unit of the sensor; signed where a sign has a meaning.
    """
    unit, factor = unit_of(sensor), 1.0
    if form.kind == "ripple":
        unit, factor = "%", 100.0
    elif sensor == "accelerometer" and float(np.abs(sizes).max()) < 0.1:
        unit, factor = "mg", 1e3
    values = factor * (sizes if form.kind in ("step", "band") else np.abs(sizes))
    return form.words.format(size=listed([f"{values[c]:.3g} {unit} on {'xyz'[c]}" for c in axes]))
