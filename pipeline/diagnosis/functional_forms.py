"""A grammar of effects that the catalogue may not hold, as formulas of an effect file, each with the unit that it has.

    form   := factor, or modulator * factor        modulator := u, abs(u), u ** 2, u ** 3, fx, fy, fz, speed, T, time
    factor := s ** p | abs(u) | sign(u) | step(s - a) | (1 + tanh((s - a) / w)) / 2 | exp(+-(s - a) / c)
              | cos and sin(n angle) | band(speed, a, b) | polynomial in (s - a) / w           T = temperature - 25

What a function is applied to has no unit, by construction; the unit of a product is the product of the units, and that
of a coefficient follows: unit of the sensor over unit of the form. Complexity counts a form's signals, functions,
powers and cycles; its scanned constants a, w, c count as parameters of the fit.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from pipeline.diagnosis.words import listed
from pipeline.model.effects.base import truth, unit_of
from pipeline.model.formula import Formula, parse

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from pipeline.diagnosis.residual_regression import Curves
    from pipeline.estimation.observations import Observations
    from pipeline.records import Motion, Values

CYCLES = range(1, 13)
POWERS = range(1, 6)
ORDER = 5  # of a polynomial; as DEGREE of the tests that find a dependence (pipeline.diagnosis.residual_dependence)
PLACES = 20  # a step is then placed to 1/40 of the span before the finer scans
SPEEDS = 40  # at most, between which steps are tried
SHARPEST = 1.0 / 80.0  # width of a soft step, share of the span: smoothed temperatures make a sharp one as wide as that
CONSTANTS = tuple(np.geomspace(0.06, 1.5, 9))  # of the span; the finer scans close the factors of 1.5 between them
FINER = 4  # places or constants to each side of the best, in each finer scan
WIDTHS = (0.5, 1.0, 2.0)  # of a soft step, in those of the scan before
SAME_SPEED = 0.02  # relative difference of speeds that are one speed of the procedure
UNITS = {"temperature": "degC", "time": "s", "speed": "deg/s", "angle": "deg"} | {f"f{a}": "g" for a in "xyz"}
ORIGIN = "(temperature - 25)"  # powers of the temperature count from that of data sheets, as the catalogue's
NAMES = {"u": "the axis' own signal", "speed": "the speed", "time": "the time", ORIGIN: "the temperature above 25 degC"}


def columns_of(formulas: Iterable[str], sensor: str) -> Curves:
    """Return what evaluates formulas: motion to (n, q) columns, or to (n, 3, q) where one contains ``u``."""
    parsed = [parse(text) for text in formulas]

    def columns(motion: Motion) -> Values:
        signals = signals_of(motion)
        if not any("u" in formula.signals for formula in parsed):
            return np.stack([value(formula, signals) for formula in parsed], axis=1)
        u = truth(sensor, motion)
        each = [[value(f, signals | {"u": u[:, c]}) for f in parsed] for c in range(3)]
        return np.stack([np.stack(axis, axis=1) for axis in each], axis=1)

    return columns


def value(formula: Formula, signals: dict[str, Values | None]) -> Values:
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
        moving = self.values[self.values > SAME_SPEED * self.high / SPEEDS]
        held = np.unique(np.quantile(moving, np.linspace(0.0, 1.0, SPEEDS)) if len(moving) else moving)
        held = np.concatenate([[0.0], held])
        apart = np.diff(held) > SAME_SPEED * held[1:]
        middle: Values = 0.5 * (held[1:] + held[:-1])
        return middle[apart]

    def rounded(self, value: float) -> float:
        """Return a value to a ten-thousandth of the span, which keeps formulas short."""
        return round(value, max(0, 4 - int(np.floor(np.log10(self.size)))))


@dataclass(frozen=True)
class Factor:
    """A function of one signal: its columns as formulas, its exponents of units, and what was scanned to find it."""

    kind: str
    signal: str
    texts: tuple[str, ...]
    words: str  # a noun phrase
    complexity: int = 2  # its signal and its function
    power: int = 0  # of the signal's unit; 0: without a unit
    constants: tuple[float, ...] = ()  # scanned


@dataclass(frozen=True)
class Form:
    """A functional form that is tried: a factor, or its product with a modulator."""

    factor: Factor
    modulator: Factor | None = None

    @property
    def kind(self) -> str:
        """Kind of the factor; ``ripple`` for harmonics in proportion to the axis' own signal."""
        ripple = self.factor.kind == "harmonic" and self.modulator is not None and self.modulator.texts == ("u",)
        return "ripple" if ripple else self.factor.kind

    @property
    def formulas(self) -> tuple[str, ...]:
        """One for each coefficient."""
        times = f"{self.modulator.texts[0]} * " if self.modulator else ""
        return tuple(f"{times}{text}" for text in self.factor.texts)

    @property
    def covariate(self) -> str:
        """The covariate of ``pipeline.diagnosis.residual_dependence`` that the form is told by."""
        signals = [self.factor.signal, *([self.modulator.signal] if self.modulator else [])]
        known = {"speed": "rate"}
        order = ["angle", "temperature", "time", "rate"]
        named = [known.get(name, name) for name in signals]
        of_force = any(name.startswith("f") or name == "u" for name in signals)
        return next((name for name in order if name in named), "specific_force" if of_force else "rate")

    @property
    def scanned(self) -> int:
        """How many nonlinear parameters were scanned to find it."""
        return len(self.factor.constants)

    @property
    def complexity(self) -> int:
        """Number of choices that the grammar takes to state it."""
        return self.factor.complexity + (self.modulator.complexity if self.modulator else 0)

    def refines(self, other: Form) -> bool:
        """Return whether it differs from another form by its constants alone, as two steps do."""
        same = self.factor.kind == other.factor.kind and self.factor.signal == other.factor.signal
        return same and bool(self.factor.constants)

    @property
    def name(self) -> tuple[str, ...]:
        """What stays the same when its constants change."""
        scanned = (self.factor.kind, self.factor.signal, str(self.scanned))
        own = scanned if self.factor.constants else self.factor.texts
        return (*own, *(self.modulator.texts if self.modulator else ()))

    def unit(self, sensor: str) -> str:
        """Return the unit of a coefficient: that of the sensor over that of the form."""
        exponents = Counter({unit_of(sensor): 1})
        for factor in filter(None, (self.factor, self.modulator)):
            exponents[UNITS.get(factor.signal, unit_of(sensor))] -= factor.power
        own = exponents.pop(unit_of(sensor))
        above = unit_of(sensor) if own == 1 else "1"
        below = {**({unit_of(sensor): own} if own < 0 else {}), **{u: e for u, e in exponents.items() if e < 0}}
        return above + "".join(f"/{_power(unit, -e)}" for unit, e in below.items()) if below else above

    def described(self) -> str:
        """Return the form as a noun phrase, in which ``{size}`` stands for its size."""
        times = ""
        if self.modulator:
            text = self.modulator.texts[0]
            name = "the rate" if self.kind == "ripple" else NAMES.get(text, text)
            times = f" in proportion to {name}"
        height = self.factor.kind in ("step", "band") and not times
        lead = (
            ", amplitude {size}" if self.factor.kind == "harmonic" else ", of {size}" if height else ", {size} in all"
        )
        return f"{self.factor.words}{times}{lead}"


def _power(unit: str, exponent: int) -> str:
    inside = f"({unit})" if "/" in unit else unit
    return inside if exponent == 1 else f"{inside}^{exponent}"


def power(signal: str, p: int) -> Factor:
    """Return a power of a signal, in its own unit."""
    base = ORIGIN if signal == "temperature" else signal
    text = base if p == 1 else f"{base} ** {p}"
    return Factor("power", signal, (text,), f"a part in proportion to {text}", 1 + (p > 1), p)


def modulators(signals: Sequence[str]) -> list[Factor | None]:
    """Return what a factor may be multiplied with; None: nothing."""
    absolute = Factor("magnitude", "u", ("abs(u)",), "a part in proportion to abs(u)", 2, 1)
    of_u = [power("u", 1), absolute, power("u", 2), power("u", 3)]
    return [None, *of_u, *(power(name, 1) for name in signals if name not in ("u", "angle"))]


def factors(spans: dict[str, Span], *, turning: bool) -> list[Factor]:
    """Return the factors with one column, constants as in the coarse scan, and the harmonics."""
    found = [power(name, p) for name in spans for p in POWERS] + [power("u", p) for p in POWERS]
    found += [Factor("magnitude", "u", (f"{f}(u)",), f"a part in proportion to {f}(u)", 2, p) for f, p in OF_SIGN]
    for span in spans.values():
        if span.signal in ("temperature", "time", "speed"):
            found += [step(span, a) for a in span.places()]
        if span.signal in ("temperature", "time"):
            found += [step(span, a, span.size / PLACES) for a in span.places()]
            found += [exponential(span, c * span.size, growth=g) for c in CONSTANTS for g in (False, True)]
    return found + ([harmonic(n) for n in CYCLES] if turning else [])


OF_SIGN = (("abs", 1), ("sign", 0))


def harmonic(n: int) -> Factor:
    """Return the cosine and sine of so many cycles a turn."""
    words = f"{n} cycle{'' if n == 1 else 's'} per turn of the table"
    return Factor("harmonic", "angle", tuple(f"{f}({n} * radians(angle))" for f in ("cos", "sin")), words)


def step(span: Span, place: float, width: float | None = None) -> Factor:
    """Return a step at a place, sharp or over a width."""
    signal, unit, digits = span.signal, UNITS[span.signal], 0 if span.signal == "time" else 1
    words = f"a step at {place:.{digits}f} {unit}"
    if width is None:
        return Factor("step", signal, (f"step({signal} - {place:.7g})",), words, constants=(place,))
    soft = f"0.5 * (1 + tanh(({signal} - {place:.7g}) / {width:.3g}))"
    over = f"{words}, over about {2 * float(f'{width:.3g}'):.2g} {unit}"
    return Factor("step", signal, (soft,), over, 3, constants=(place, width))


def exponential(span: Span, constant: float, *, growth: bool) -> Factor:
    """Return an exponential that decays from the smallest value, or grows towards the largest."""
    s, signal = float(f"{constant:.4g}"), span.signal
    text = f"({signal} - {span.rounded(span.high):g})" if growth else f"({span.rounded(span.low):g} - {signal})"
    words = f"an exponential of the {signal} that {'grows' if growth else 'decays'} with a constant of {s:.3g} "
    kind = "exponential" if not growth else "growth"
    return Factor(kind, signal, (f"exp({text} / {s:g})",), words + UNITS[signal], constants=(s,))


def bands(span: Span) -> list[Factor]:
    """Return bands between any two of the places of a speed."""
    found = []
    for low, high in combinations(span.places().tolist(), 2):
        text = f"band({span.signal}, {low:.5g}, {high:.5g})"
        words = f"a band from {low:.3g} to {high:.3g} {UNITS[span.signal]}"
        found.append(Factor("band", span.signal, (text,), words, 2, constants=(low, high)))
    return found


def powers(span: Span, name: str) -> tuple[str, ...]:
    """Return the powers 1 to 5 of a signal, centred and scaled to its span; ``u`` and forces are scaled only."""
    middle, half = span.rounded(0.5 * (span.low + span.high)), span.rounded(0.5 * span.size)
    x = f"(({name} - {middle:g}) / {half:g})"
    if name == "u" or name.startswith("f"):
        scale = f"{span.rounded(max(abs(span.low), abs(span.high))):g}"
        x = name if scale == "1" else f"({name} / {scale})"
    return (x, *(f"{x} ** {p}" for p in range(2, ORDER + 1)))


def polynomial(signal: str, formulas: tuple[str, ...], order: int) -> Factor:
    """Return the sum of some powers of a signal."""
    words = f"a polynomial of order {order} in {NAMES.get(signal, signal)}"
    return Factor("polynomial", signal, formulas, words, 1 + len(formulas))


def finer(factor: Factor, span: Span, apart: float) -> Iterator[Factor]:
    """Yield factors of the same kind about one, ``apart`` of the coarse scan's distance between them."""
    steps = apart * np.arange(-FINER, FINER + 1) / FINER
    if factor.kind == "step":
        places = factor.constants[0] + steps * span.size / PLACES
        if len(factor.constants) == 1:
            yield from (step(span, a) for a in places)
            return
        for width in factor.constants[1] * np.array(WIDTHS):
            yield from (step(span, a, max(width, SHARPEST * span.size)) for a in places)
    elif factor.kind in ("exponential", "growth"):
        constants = factor.constants[0] * (CONSTANTS[1] / CONSTANTS[0]) ** steps
        yield from (exponential(span, c, growth=factor.kind == "growth") for c in constants)


def described(form: Form, sizes: Values, axes: Sequence[int], sensor: str) -> str:
    """Return a fitted form as a noun phrase: ``a step at 31.0 degC, of 3.9 mg on x and -2.1 mg on z``.

    ``sizes`` are amplitude, height or whole change on each axis, unit of the sensor; signed where a sign has a meaning.
    """
    unit, scale = unit_of(sensor), 1.0
    if form.kind == "ripple":
        unit, scale = "%", 100.0
    elif sensor == "accelerometer" and float(np.abs(sizes).max()) < 0.1:
        unit, scale = "mg", 1e3
    signed = form.kind in ("step", "band") and form.modulator is None
    values = scale * (sizes if signed else np.abs(sizes))
    return form.described().format(size=listed([f"{values[c]:.3g} {unit} on {'xyz'[c]}" for c in axes]))
