"""A grammar of effects outside the catalogue: formulas of an effect file, each with its unit.

    form   := factor, or modulator * factor        modulator := u, abs(u), u ** 2, u ** 3, fx, fy, fz, speed, T, time
    factor := s ** p | abs(u) | sign(u) | step(s - a) | (1 + tanh((s - a) / w)) / 2 | exp(+-(s - a) / c)
              | cos and sin(n angle) | band(speed, a, b) | polynomial in (s - a) / w           T = temperature - 25

The arguments of functions have no unit. The unit of a product is the product of the units; that of a coefficient is the
unit of the sensor over that of the form. Complexity counts the signals, functions, powers and cycles of a form. Its
scanned constants a, w, c count as parameters of the fit.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import TypeAlias

import numpy as np

from pipeline.core.records import Motion, Values
from pipeline.estimation.observations import Observations
from pipeline.estimation.ranking import by_size
from pipeline.physics.effects.base import truth, unit_of
from pipeline.physics.effects.equations import CURVE_DEGREE
from pipeline.physics.formula import Formula, parse

CYCLES = range(1, 13)
POWERS = range(1, 6)
COARSE_STEP_POSITIONS = 20  # of a step in the coarse scan, which places it to 1/40 of the span
SPEEDS = 40  # largest number of speeds between which steps are tried
SHARPEST = 1.0 / 80.0  # least width of a soft step, share of the span: smoothing makes a sharp step this wide
# share of the span; the finer scans close the factors of 1.5 between them
CONSTANTS = tuple(np.geomspace(0.06, 1.5, 9))
FINER = 4  # places or constants to each side of the best one in each finer scan
SOFT_STEP_WIDTHS = (0.5, 1.0, 2.0)  # of a soft step in a finer scan, over that of the scan before
SAME_SPEED = 0.02  # relative difference of values that are one speed of the procedure
SIGNAL_UNITS = {"temperature": "degC", "time": "s", "speed": "deg/s", "angle": "deg"} | {f"f{a}": "g" for a in "xyz"}
ORIGIN = "(temperature - 25)"  # data sheets and the catalogue also state powers of the temperature above 25 degC
SIGNAL_WORDS = {
    "u": "the axis' own signal",
    "speed": "the speed",
    "time": "the time",
    ORIGIN: "the temperature above 25 degC",
}
Curves: TypeAlias = "Callable[[Motion], Values]"  # to (n, 1, q), or (n, 3, q) if they differ between the axes


def columns_of(formulas: Iterable[str], sensor: str) -> Curves:
    """Return the function from motion to the values of formulas: (n, 1, q), or (n, 3, q) if one contains ``u``.

    The values are zero in a recording without a signal of the formula.
    """
    parsed = [parse(text) for text in formulas]

    def columns(motion: Motion) -> Values:
        signals = signals_of(motion, sensor)
        return np.stack(np.broadcast_arrays(*(values_of(formula, signals) for formula in parsed)), axis=2)

    return columns


def values_of(formula: Formula, signals: Mapping[str, Values]) -> Values:
    """Return the values of a formula, zero without one of its signals: (n, 1) array, or (n, 3) with ``u``."""
    shape = len(signals["u"]), 3 if "u" in formula.signals else 1
    return np.broadcast_to(formula(signals) if formula.signals <= signals.keys() else np.zeros(()), shape)


def signals_of(motion: Motion, sensor: str) -> dict[str, Values]:
    """Return the signals of the formula language that a motion holds: (n, 1) arrays, ``u`` (n, 3)."""
    speed = np.sqrt(np.einsum("ij,ij->i", motion.angular_rate, motion.angular_rate))
    of_one = {"time": motion.time, "temperature": motion.temperature, "angle": motion.angle, "rate": motion.rate}
    found = {name: value[:, None] for name, value in {**of_one, "speed": speed}.items() if value is not None}
    for c, axis in enumerate("xyz"):
        found[f"f{axis}"], found[f"w{axis}"] = motion.specific_force[:, c, None], motion.angular_rate[:, c, None]
    return found | {"u": truth(sensor, motion)}


def available_signals(observations: Observations) -> list[str]:
    """Return those of speed, temperature and time that all recordings hold; the speed if the table turns."""
    motions = [part.motion for part in observations.parts]
    names = ["speed"] if any(np.any(~m.still) for m in motions) else []
    names += ["temperature"] if all(m.temperature is not None for m in motions) else []
    return names + (["time"] if observations.clock_shared else [])


class Span:
    """The sorted values of a signal in all rows, the smallest and the largest, and the difference of these."""

    def __init__(self, signal: str, values: Values) -> None:
        self.signal, self.values = signal, np.sort(values)
        self.low, self.high = float(self.values[0]), float(self.values[-1])
        self.size = max(self.high - self.low, 1e-12)

    @classmethod
    def of(cls, observations: Observations, signal: str) -> Span:
        """Return the span of a signal."""
        known = (signals_of(part.motion, observations.sensor) for part in observations.parts)
        return cls(signal, np.concatenate([each[signal][:, 0] for each in known if signal in each]))

    def places(self) -> Values:
        """Return the places of steps in the coarse scan: evenly over the span, or between constant speeds."""
        if self.signal != "speed":
            return self.low + self.size * (np.arange(COARSE_STEP_POSITIONS) + 0.5) / COARSE_STEP_POSITIONS
        moving = self.values[self.values > SAME_SPEED * self.high / SPEEDS]
        speeds = np.unique(np.quantile(moving, np.linspace(0.0, 1.0, SPEEDS)) if len(moving) else moving)
        speeds = np.concatenate([[0.0], speeds])
        middle: Values = 0.5 * (speeds[1:] + speeds[:-1])
        return middle[np.diff(speeds) > SAME_SPEED * speeds[1:]]

    def rounded(self, value: float) -> float:
        """Return a value to a ten-thousandth of the span, which keeps formulas short."""
        return round(value, max(0, 4 - int(np.floor(np.log10(self.size)))))


@dataclass(frozen=True)
class Factor:
    """A function of one signal."""

    kind: str
    signal: str
    texts: tuple[str, ...]  # its columns as formulas
    words: str  # a noun phrase
    complexity: int = 2  # its signal and its function
    power: int = 0  # of the signal's unit; 0: without a unit
    constants: tuple[float, ...] = ()  # scanned
    origin: float = 0.0  # of the signal in an exponential

    def values(self, signal: Values) -> Values:
        """Return the values of a factor with constants, without parsing its formula."""
        if self.kind == "band":
            low, high = (float(f"{place:.5g}") for place in self.constants)
            return np.logical_and(signal >= low, signal <= high).astype(float)
        if self.kind == "step":
            above, widths = signal - float(f"{self.constants[0]:.7g}"), self.constants[1:]
            return 0.5 * (1.0 + np.tanh(above / float(f"{widths[0]:.3g}"))) if widths else np.heaviside(above, 1.0)
        sign = 1.0 if self.kind == "growth" else -1.0
        return np.asarray(np.exp(sign * (signal - self.origin) / self.constants[0]))


@dataclass(frozen=True)
class Form:
    """A functional form: a factor, or its product with a modulator."""

    factor: Factor
    modulator: Factor | None = None

    @property
    def kind(self) -> str:
        """Kind of the factor; ``ripple`` for harmonics in proportion to the axis' own signal."""
        ripple = self.factor.kind == "harmonic" and self.modulator is not None and self.modulator.texts == ("u",)
        return "ripple" if ripple else self.factor.kind

    @property
    def is_height(self) -> bool:
        """Whether its coefficient is the height of a step or band."""
        return self.factor.kind in ("step", "band") and self.modulator is None

    @property
    def signals(self) -> set[str]:
        """The signals of factor and modulator."""
        return {factor.signal for factor in (self.factor, self.modulator) if factor}

    @property
    def formulas(self) -> tuple[str, ...]:
        """One for each coefficient."""
        times = f"{self.modulator.texts[0]} * " if self.modulator else ""
        return tuple(f"{times}{text}" for text in self.factor.texts)

    @property
    def covariate(self) -> str:
        """The covariate of ``pipeline.evaluation.diagnosis.residual_dependence`` that stands for the form."""
        slow = next((name for name in ("angle", "temperature", "time") if name in self.signals), None)
        return slow or ("rate" if "speed" in self.signals else "specific_force")

    @property
    def scanned(self) -> int:
        """Number of scanned constants."""
        return len(self.factor.constants)

    @property
    def complexity(self) -> int:
        """Number of choices of the grammar."""
        return self.factor.complexity + (self.modulator.complexity if self.modulator else 0)

    def refines(self, other: Form) -> bool:
        """Return whether two factors differ in their constants alone, as two steps do."""
        same = self.factor.kind == other.factor.kind and self.factor.signal == other.factor.signal
        return same and bool(self.factor.constants)

    @cached_property
    def name(self) -> tuple[str, ...]:
        """What all forms have in common that differ in their constants alone."""
        scanned = (self.factor.kind, self.factor.signal, str(self.scanned))
        factor = scanned if self.factor.constants else self.factor.texts
        return (*factor, *(self.modulator.texts if self.modulator else ()))

    def unit(self, sensor: str) -> str:
        """Return the unit of a coefficient: that of the sensor over that of the form."""
        exponents = Counter({unit_of(sensor): 1})
        for factor in filter(None, (self.factor, self.modulator)):
            exponents[SIGNAL_UNITS.get(factor.signal, unit_of(sensor))] -= factor.power
        above = unit_of(sensor) if exponents[unit_of(sensor)] == 1 else "1"
        below = [(f"({u})" if "/" in u else u) + (f"^{-e}" if e < -1 else "") for u, e in exponents.items() if e < 0]
        return "/".join([above, *below])


def digests(values: Sequence[Values]) -> list[bytes]:
    """Return the same bytes for forms whose values differ by a factor alone."""
    found: dict[int, bytes] = {}
    for index in by_size(each.size for each in values):
        flat = np.stack([values[k].ravel() for k in index])
        size = np.linalg.norm(flat, axis=1, keepdims=True)
        first = np.take_along_axis(flat, np.argmax(np.abs(flat) > 1e-6 * size, axis=1)[:, None], axis=1)
        scale = np.where(size > 0.0, size * np.sign(first), 1.0)
        found |= zip(index, (row.tobytes() for row in np.round(flat / scale, 9)), strict=True)
    return [found[k] for k in range(len(values))]


def power(signal: str, p: int) -> Factor:
    """Return a power of a signal, in its own unit."""
    base = ORIGIN if signal == "temperature" else signal
    text = base if p == 1 else f"{base} ** {p}"
    return Factor("power", signal, (text,), f"a part in proportion to {text}", 1 + (p > 1), p)


def _function(name: str, p: int) -> Factor:
    """Return a function of ``u``, whose unit is that of ``u`` to the power p."""
    return Factor("magnitude", "u", (f"{name}(u)",), f"a part in proportion to {name}(u)", 2, p)


def modulators(signals: Iterable[str]) -> list[Factor | None]:
    """Return the modulators of a factor; None: no modulator."""
    of_u = [power("u", 1), _function("abs", 1), power("u", 2), power("u", 3)]
    return [None, *of_u, *(power(name, 1) for name in signals)]


def factors(spans: dict[str, Span], *, turning: bool) -> list[Factor]:
    """Return the factors of the coarse scan that have one column, and the harmonics."""
    found = [power(name, p) for name in [*spans, "u"] for p in POWERS] + [_function("abs", 1), _function("sign", 0)]
    for span in spans.values():
        if span.signal in ("temperature", "time", "speed"):
            found += [step(span, a) for a in span.places()]
        if span.signal in ("temperature", "time"):
            found += [step(span, a, span.size / COARSE_STEP_POSITIONS) for a in span.places()]
            found += [exponential(span, c * span.size, growth=g) for c in CONSTANTS for g in (False, True)]
    return found + ([harmonic(n) for n in CYCLES] if turning else [])


def harmonic(n: int) -> Factor:
    """Return cosine and sine of n cycles a turn."""
    words = f"{n} cycle{'' if n == 1 else 's'} per turn of the table"
    return Factor("harmonic", "angle", tuple(f"{f}({n} * radians(angle))" for f in ("cos", "sin")), words)


def step(span: Span, place: float, width: float | None = None) -> Factor:
    """Return a step at a place, sharp or over a width."""
    signal, unit, digits = span.signal, SIGNAL_UNITS[span.signal], 0 if span.signal == "time" else 1
    words = f"a step at {place:.{digits}f} {unit}"
    if width is None:
        return Factor("step", signal, (f"step({signal} - {place:.7g})",), words, constants=(place,))
    soft = f"0.5 * (1 + tanh(({signal} - {place:.7g}) / {width:.3g}))"
    over = f"{words}, over about {2 * float(f'{width:.3g}'):.2g} {unit}"
    return Factor("step", signal, (soft,), over, 3, constants=(place, width))


def exponential(span: Span, constant: float, *, growth: bool) -> Factor:
    """Return an exponential that decays from the smallest value, or grows towards the largest."""
    s, signal = float(f"{constant:.4g}"), span.signal
    origin = f"{span.rounded(span.high if growth else span.low):g}"
    text = f"({signal} - {origin})" if growth else f"({origin} - {signal})"
    words = f"an exponential of the {signal} that {'grows' if growth else 'decays'} with a constant of {s:.3g} "
    kind = "growth" if growth else "exponential"
    texts = (f"exp({text} / {s:g})",)
    return Factor(kind, signal, texts, words + SIGNAL_UNITS[signal], constants=(s,), origin=float(origin))


def bands(span: Span) -> list[Factor]:
    """Return bands between any two of the places of a speed."""
    found = []
    for low, high in combinations(span.places().tolist(), 2):
        text = f"band({span.signal}, {low:.5g}, {high:.5g})"
        words = f"a band from {low:.3g} to {high:.3g} {SIGNAL_UNITS[span.signal]}"
        found.append(Factor("band", span.signal, (text,), words, constants=(low, high)))
    return found


def powers(span: Span, name: str) -> tuple[str, ...]:
    """Return the powers 1 to 5 of a signal, scaled to its span and, but for ``u`` and forces, centred."""
    middle, half = span.rounded(0.5 * (span.low + span.high)), span.rounded(0.5 * span.size)
    x = f"(({name} - {middle:g}) / {half:g})"
    if name == "u" or name.startswith("f"):
        scale = f"{span.rounded(max(abs(span.low), abs(span.high))):g}"
        x = name if scale == "1" else f"({name} / {scale})"
    return (x, *(f"{x} ** {p}" for p in range(2, CURVE_DEGREE + 1)))


def polynomial(signal: str, formulas: tuple[str, ...], order: int) -> Factor:
    """Return the sum of some powers of a signal."""
    words = f"a polynomial of order {order} in {SIGNAL_WORDS.get(signal, signal)}"
    return Factor("polynomial", signal, formulas, words, 1 + len(formulas))


def finer(factor: Factor, span: Span, spacing: float) -> Iterator[Factor]:
    """Yield factors of the same kind near one; ``spacing``: their largest distance over that of the coarse scan."""
    steps = spacing * np.arange(-FINER, FINER + 1) / FINER
    if factor.kind == "step":
        places = factor.constants[0] + steps * span.size / COARSE_STEP_POSITIONS
        widths: list[float | None] = [None]
        if len(factor.constants) > 1:
            widths = [max(w * factor.constants[1], SHARPEST * span.size) for w in SOFT_STEP_WIDTHS]
        yield from (step(span, a, width) for width in widths for a in places)
    elif factor.kind in ("exponential", "growth"):
        constants = factor.constants[0] * (CONSTANTS[1] / CONSTANTS[0]) ** steps
        yield from (exponential(span, c, growth=factor.kind == "growth") for c in constants)
