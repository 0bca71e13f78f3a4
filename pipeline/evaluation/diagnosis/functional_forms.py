"""A grammar of effects outside the catalogue: formulas of an effect file, each with its unit.

    form   := factor, or modulator * factor        modulator := u, abs(u), u ** 2, u ** 3, fx, fy, fz, speed, T, time
    factor := s ** p | abs(u) | sign(u) | step(s - a) | (1 + tanh((s - a) / w)) / 2 | exp(+-(s - a) / c)
              | cos and sin(n angle) | band(speed, a, b) | polynomial in (s - a) / w           T = temperature - 25

The arguments of functions have no unit. The unit of a product is the product of the units; that of a coefficient is the
unit of the sensor over that of the form. Complexity counts the signals, functions, powers and cycles of a form. Its
scanned constants a, w, c count as parameters of the fit.

Compute how much further columns explain of the residual, given base, configured and selected effects.

    y_c = X_c beta_c + Z gamma_c + noise,    drop(Z, c) = b^T G^-1 b
    b = Z^T M C^-1 y_c,    G = Z^T M C^-1 Z,    M = 1 - C^-1 X_c (X_c^T C^-1 X_c)^-1 X_c^T

    X_c  : columns of the model on axis c: 1, what K acts on, and every parameter of every effect
    Z    : (n, r) further columns, such as curves in a covariate or the columns of a functional form
    C    : white noise plus bias wander, ``pipeline.estimation.gauss_markov``
    drop : reduction of the whitened sum of squares by them

The coefficients of effects that the axes share are free on each axis: then the axes are separate problems, and no form
explains more than it does. Rounding errors of products are at most ``u sqrt(n) |a| |a'|`` (Higham and Mary 2019,
doi:10.1137/18M1226312). So the remaining sum of squares of a column z, after columns a_k are subtracted with
coefficients x_k, is uncertain by ``e^2 = u sqrt(n) (|z| + sum |x_k| |a_k|)^2``. Below e^2 a column explains nothing.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, product
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
import scipy

from pipeline.estimation.design import CURVE_DEGREE, joined_motions, true_motion
from pipeline.estimation.gauss_markov import WHITE_SETTING, GaussMarkov
from pipeline.estimation.ranking import MIN_LEFT_SQUARE_SHARE, MIN_NEW_COLUMN_SHARE, UNIT_COLUMN_RIDGE
from pipeline.physics.effects.base import truth, unit_of
from pipeline.physics.formula import parse

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from numpy.typing import ArrayLike

    from pipeline.core.records import Index, Mask, Motion, Values
    from pipeline.estimation.observations import Observations
    from pipeline.estimation.selection import Selection


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
UNIT_ROUNDOFF = float(np.finfo(np.float64).eps) / 2.0  # u


def columns_of(formulas: Iterable[str], sensor: str) -> Curves:
    """Return the function from motion to the values of formulas: (n, 1, q), or (n, 3, q) if one contains ``u``.

    The values are zero in a recording without a signal of the formula.
    """
    parsed = [parse(text) for text in formulas]

    def columns(motion: Motion) -> Values:
        n, u = len(motion.time), truth(sensor, motion)
        signals = {name: value for name, value in signals_of(motion).items() if value is not None}
        of_axes = []
        for c in range(3 if any("u" in formula.signals for formula in parsed) else 1):
            known = signals | {"u": u[:, c]}
            values = [np.broadcast_to(f(known), (n,)) if f.signals <= known.keys() else np.zeros(n) for f in parsed]
            of_axes.append(np.stack(values, axis=1))
        return np.stack(of_axes, axis=1)

    return columns


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


def available_signals(observations: Observations) -> list[str]:
    """Return those of speed, temperature and time that all recordings hold; the speed if the table turns."""
    motions = [part.motion for part in observations.parts]
    names = ["speed"] if any(np.any(~m.still) for m in motions) else []
    names += ["temperature"] if all(m.temperature is not None for m in motions) else []
    return names + (["time"] if observations.clock_shared else [])


@dataclass(frozen=True)
class Span:
    """The sorted values of a signal in all rows."""

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
        """Largest less smallest value."""
        return max(self.high - self.low, 1e-12)

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

    def values(self, signal: Values) -> Values | None:
        """Return the values of a step or an exponential without parsing its formula; None for other factors."""
        if self.kind == "step":
            above, widths = signal - float(f"{self.constants[0]:.7g}"), self.constants[1:]
            return 0.5 * (1.0 + np.tanh(above / float(f"{widths[0]:.3g}"))) if widths else np.heaviside(above, 1.0)
        if self.kind in ("exponential", "growth"):
            sign = 1.0 if self.kind == "growth" else -1.0
            return np.asarray(np.exp(sign * (signal - self.origin) / self.constants[0]))
        return None


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


@dataclass(frozen=True)
class FormGain:
    """The improvement of the fit by a functional form."""

    delta_bic: float
    p_value: float
    axes: tuple[int, ...]  # that it improves
    setting: int  # index of its best noise setting


class Whitened(NamedTuple):
    """Whitened columns: deviations from the means of their blocks, (n, q), and these means by noise, (t, q, m)."""

    inside: Values
    means: Values

    def times(self, other: Whitened) -> Values:
        """Return the products with other columns: (t, q, p) array."""
        return np.asarray(self.means @ other.means.transpose(0, 2, 1) + self.inside.T @ other.inside)

    def grams(self, r: int) -> Values:
        """Return the products of the columns of each of m forms of r columns: (t, m, r, r) array."""
        found = np.empty((len(self.means), len(self.means[0]) // r, r, r))
        for i, j in product(range(r), repeat=2):
            found[..., i, j] = np.einsum("tqm,tqm->tq", self.means[:, i::r], self.means[:, j::r])
            found[..., i, j] += np.einsum("nq,nq->q", self.inside[:, i::r], self.inside[:, j::r])
        return found


class Scan:
    """The residual of a selection's fit under every noise setting, and its reduction by further columns.

    ``explained``: curves that are projected out too. ``rows``: the observations of the selection with other weights.
    """

    def __init__(self, selection: Selection, explained: Curves | None = None, rows: Observations | None = None) -> None:
        self.scale = selection.start.scale
        observations = (rows or selection.observations).less_stop_errors
        self.samples = 3.0 * observations.samples
        self.within = float(np.sum(observations.scatter / self.scale**2))
        motions = [true_motion(part, selection.fit.terms) for part in selection.observations.parts]
        self._motions = [motion for motion, _ in joined_motions(motions)]
        self.blocks, self.weight = observations.blocks, observations.weight
        self._label = self.blocks.label(len(self.weight))
        self.settings = WHITE_SETTING, *selection.settings
        self.noise = GaussMarkov(self.blocks, self.settings)
        self._unit = float(UNIT_ROUNDOFF * np.sqrt(observations.samples)) ** 0.5
        # its columns depend on no weight
        self.design = design = selection.fit.design(selection.observations.less_stop_errors)
        A, places = design.columns.columns, [design.places(c)[0] for c in range(3)]
        if explained is not None:
            values, first = self.values(explained), A.shape[1]
            n, versions, q = values.shape
            A = np.concatenate([A, values.reshape(n, -1)], axis=1)
            places = [np.append(first + c % versions * q + np.arange(q), place) for c, place in enumerate(places)]
        self.columns, self.every = A, self.whitened(A)  # model, explained curves and readings of all axes
        self._among = self.every.times(self.every)
        self._fitted: list[tuple[Index, int, Values]] = []  # of each axis: model, residual, inverse of its products
        left = []
        for c, (*known, target) in enumerate(places):
            products = self._among[:, np.array(known)[:, None], known]
            size = np.sqrt(np.einsum("tpp->tp", products))
            size = np.where(size > 0.0, size, 1.0)
            over = size[:, :, None] * size[:, None, :]
            inverse = np.linalg.inv(products / over + UNIT_COLUMN_RIDGE * np.eye(len(known))) / over
            self._fitted.append((np.array(known), target, inverse))
            cross = self._among[:, known, target]
            taken = np.einsum("tp,tpq,tq->t", cross, inverse, cross)
            left.append((self._among[:, target, target] - taken)[1:] / self.scale[c] ** 2)
        logarithms = self.noise.log_determinant[1:] + np.sum(np.log(self.blocks.weight))
        self._penalty: Values = 1.5 * logarithms - np.array([setting.prior for setting in selection.settings])
        self.left: Values = np.stack(left, axis=1)
        self.before = float(self.log_likelihood(self.left.sum(axis=1)).max())

    def values(self, curves: Curves) -> Values:
        """Return the values of curves in all rows: (n, 3, q) array, or (n, 1, q) if they are equal on all axes.

        They depend at a sample on the motion there alone.
        """
        return np.concatenate([curves(motion) for motion in self._motions])

    def whitened(self, columns: Values) -> Whitened:
        """Return (n, q) columns whitened."""
        means = self.means(columns)
        inside = columns - means[self._label]
        inside *= np.sqrt(self.weight)[:, None]
        return Whitened(inside, self.noise.whitened(means))

    def means(self, columns: Values) -> Values:
        """Return the means of (n, q) columns in blocks: (m, q) array."""
        return np.asarray(self.blocks.sums(self.weight[:, None] * columns) / self.blocks.weight[:, None])

    def without_model(self, c: int, one: Whitened, other: Whitened) -> Values:
        """Return the products of columns on an axis without their part in the model, white noise first: (t, q, p)."""
        known, _, inverse = self._fitted[c]
        taken = one.times(self.every)[:, :, known] @ inverse @ self.every.times(other)[:, known]
        return np.asarray((one.times(other) - taken) / self.scale[c] ** 2)

    def squares_without_model(self, c: int, one: Whitened) -> Values:
        """Return the squares of columns on an axis without their part in the model, white noise first: (t, q)."""
        known, _, inverse = self._fitted[c]
        cross = one.times(self.every)[:, :, known]
        own = np.einsum("tqm,tqm->tq", one.means, one.means) + np.einsum("nq,nq->q", one.inside, one.inside)
        return np.asarray((own - np.einsum("tqp,tqp->tq", cross @ inverse, cross)) / self.scale[c] ** 2)

    def log_likelihood(self, rss: Values, within: Values | None = None) -> Values:
        """Return the log likelihood under each noise setting, (t, ...), of whitened sums of squares.

        ``within``: scatter within rows, of the shape of the last axes of ``rss``; by default that of the readings.
        """
        total = np.maximum(rss + (self.within if within is None else within), 1e-300)
        penalty = self._penalty.reshape(-1, *[1] * (rss.ndim - 1))
        found: Values = -0.5 * self.samples * np.log(total / self.samples) - penalty
        return found

    def gains(self, drops: Values, parameters: int | Index) -> Values:
        """Return delta BIC of forms on all three axes from their drops, (t, 3, m), and numbers of parameters: (m,)."""
        rss = self.left.sum(axis=1)[:, None] - drops.sum(axis=1)
        best = self.log_likelihood(rss).max(axis=0)
        found: Values = 2.0 * (best - self.before) - parameters * float(np.log(self.samples))
        return found

    def best_axes(self, drops: Values, columns: int | Index, scanned: int | Index = 0) -> list[FormGain]:
        """Return the gain of each form on the axes that it improves.

        ``drops``: (t, 3, m). ``columns``: number of columns on each axis. ``scanned``: number of scanned constants.
        """
        order = np.argsort(-drops.max(axis=0), axis=0)
        together = np.cumsum(np.take_along_axis(drops, order[None], axis=1), axis=1)
        likelihoods = self.log_likelihood(self.left.sum(axis=1)[:, None, None] - together)
        gained = np.maximum(2.0 * (likelihoods.max(axis=0) - self.before), 0.0)
        k = columns * np.arange(1, 4)[:, None] + scanned
        delta, p = gained - k * float(np.log(self.samples)), scipy.special.chdtrc(k, gained)
        best, at = delta.argmax(axis=0), likelihoods.argmax(axis=0)
        return [
            FormGain(float(delta[a, m]), float(p[a, m]), tuple(sorted(order[: a + 1, m].tolist())), int(at[a, m]))
            for m, a in enumerate(best.tolist())
        ]

    def drops(self, columns: Values) -> Values:
        """Return the drops of m forms of r columns under each noise on each axis: (t, 3, m).

        ``columns``: (n, 3, m, r), or (n, 1, m, r) if they are equal on all axes.
        """
        versions = [self.whitened(each.reshape(len(each), -1)) for each in np.moveaxis(columns, 1, 0)]
        grams = [version.grams(columns.shape[3]) for version in versions]
        return self.drops_of(grams, [version.times(self.every) for version in versions])

    def drops_of(self, grams: Sequence[Values], across: Sequence[Values]) -> Values:
        """Return ``drops`` from products of columns; see ``left_of``."""
        inner, cross, error = self.left_of(grams, across)
        explained, new = each_explains(inner, cross[..., None], error)
        new &= new[0]
        return np.asarray(np.where(new.all(axis=3), explained[..., 0].sum(axis=3), 0.0)[1:])

    def left_of(self, grams: Sequence[Values], across: Sequence[Values]) -> tuple[Values, Values, Values]:
        """Return products of m forms of r columns without their part in the model, white noise first.

        ``grams``: (t, m, r, r), products of the columns of each form, for each axis, or once for all. ``across``: (t,
        m r, k), those with model and readings. Returns (t, 3, m, r, r) products of a form's columns, (t, 3, m, r) with
        the residual, and (t, 3, m, r) the error e of each column. e exceeds the remaining norm of a column that is less
        than ``MIN_NEW_COLUMN_SHARE`` under white noise, or rounding alone under another noise.
        """

        def split(values: Values) -> Values:
            return values.reshape(*values.shape[:-2], *grams[0].shape[1:3], values.shape[-1])

        sizes, found = np.sqrt(np.einsum("pp->p", self._among[0])), []
        for c, (known, target, inverse) in enumerate(self._fitted):
            gram, with_all = grams[c % len(grams)], across[c % len(grams)]
            taken, own = with_all[:, :, known] @ inverse, np.einsum("tmrr->tmr", gram)
            inner = gram - split(taken) @ split(with_all[:, :, known]).swapaxes(-1, -2)
            cross = with_all[:, :, target] - (taken @ self._among[:, known, target, None])[:, :, 0]
            hidden = self._unit * (np.sqrt(own[0]) + (np.abs(taken) @ sizes[known]).reshape(own.shape))
            error = np.maximum(hidden, np.sqrt(MIN_LEFT_SQUARE_SHARE * own))
            error[0] = np.maximum(error[0], MIN_NEW_COLUMN_SHARE * np.sqrt(own[0]))
            scale = self.scale[c]
            found.append((inner / scale**2, cross.reshape(own.shape) / scale**2, error / scale))
        inner, cross, error = (np.stack(each, axis=1) for each in zip(*found, strict=True))
        return inner, cross, error


class ProjectedCurves:
    """Products of q curves and the residual of a scan, after model and explained curves are projected out of them.

    ``values``: as of ``Scan.values``. The products are without white noise alone.
    """

    def __init__(self, scan: Scan, values: Values) -> None:
        self.columns = [scan.whitened(values[:, k]) for k in range(values.shape[1])]
        grams = [each.times(each)[:, None] for each in self.columns]
        found = scan.left_of(grams, [each.times(scan.every) for each in self.columns])
        inner, cross, error = (each[:, :, 0] for each in found)
        self.inner, self.cross, self.error = inner[1:], cross[1:], error[1:]
        first = self.columns[0]
        self.size = np.sqrt(np.sum(first.means[0] ** 2, axis=1) + np.sum(first.inside**2, axis=0))
        self.white: Values = np.mean(inner[0] * scan.scale[:, None, None] ** 2, axis=0)

    def independent(self, index: Iterable[int]) -> list[int]:
        """Return the curves of ``index`` that are independent of base, effects and the curves before them."""
        rest, new = self.white.copy(), []
        for j in index:
            if rest[j, j] > (MIN_NEW_COLUMN_SHARE * self.size[j]) ** 2:
                new.append(int(j))
                rest -= np.outer(rest[:, j], rest[j]) / rest[j, j]
        return new

    def drop(self, index: ArrayLike) -> Values:
        """Return the drops of the first curve, the first two curves and so on: (t, 3, ..., r) array.

        ``index``: (..., r), of several sets of curves.
        """
        return np.asarray(np.cumsum(self._each(np.asarray(index))[0], axis=-1))

    def _each(self, index: Index) -> tuple[Values, Mask]:
        """Return the drop by each curve after those before it, and whether it is independent of them: (t, 3, .., r)."""
        inner, cross = self.inner[:, :, index[..., :, None], index[..., None, :]], self.cross[:, :, index]
        explained, independent = each_explains(inner, cross[..., None], self.error[:, :, index])
        return explained[..., 0], independent

    def coefficients(self, index: Sequence[int], setting: int) -> Values:
        """Return the coefficients of some curves under one noise: (3, r) array, unit of the sensor.

        The coefficient of a curve that depends on those before it is 0.
        """
        inner, cross = self.inner[setting][:, index][:, :, index], self.cross[setting][:, index]
        independent = self._each(np.asarray(index))[1][setting]
        both = np.einsum("cr,cs->crs", independent, independent)
        known = np.where(both, inner, np.eye(len(index)))
        found: Values = np.linalg.solve(known, (cross * independent)[..., None])[..., 0]
        return found


def each_explains(inner: Values, cross: Values, error: Values) -> tuple[Values, Mask]:
    """Return the drop by each of r curves after those before it, (..., r, s), and whether it is independent of them.

    ``inner``: (..., r, r), products of the curves. ``cross``: (..., r, s), their products with s residuals. ``error``:
    (..., r), the rounding error e of each curve.
    """
    explained, independent = np.zeros_like(cross), np.zeros(error.shape, bool)
    for j in range(inner.shape[-1]):  # what is left holds the curves from j on
        pivot = inner[..., 0, 0]
        independent[..., j] = new = pivot > error[..., 0] ** 2
        over = np.where(new, 1.0 / np.where(new, pivot, 1.0), 0.0)
        explained[..., j, :] = cross[..., 0, :] ** 2 * over[..., None]
        taken = inner[..., 1:, 0] * over[..., None]
        cross = cross[..., 1:, :] - taken[..., None] * cross[..., 0, None, :]
        inner = inner[..., 1:, 1:] - taken[..., None] * inner[..., 0, None, 1:]
        error = error[..., 1:] + np.abs(taken) * error[..., 0, None]
    return explained, independent
