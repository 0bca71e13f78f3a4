"""What the thesis concludes, judged over many seeds: confirmed, refuted or not decided.

A comparison of two procedures is the mean over seeds of the difference of their held-out errors, drawn with the same
number, with its 95 % interval by Student's t. It is decided where the interval leaves zero on one side.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from pipeline.report.comparison_statistics import Quantity, mean_of
from pipeline.report.numbers import number
from pipeline.thesis.results import CONTINUOUS, DEVICES, RATES, STOPS, in_words

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.report.comparison_statistics import Estimate
    from pipeline.thesis.seeds import Row

LOST = 2  # index in recorded.CAUSES: what the campaign has
CONFIRMED, REFUTED, OPEN = "confirmed", "refuted", "not decided"
KINDS = {CONFIRMED: "good", REFUTED: "bad", OPEN: "warn"}
READINGS = {"printed": "as printed", "staged": "errata corrected"}


@dataclass(frozen=True)
class Line:
    """One comparison: what is compared, the two means, the difference with its interval, and the verdict."""

    what: str
    first: Estimate
    second: Estimate
    difference: Estimate
    verdict: str


@dataclass(frozen=True)
class Conclusion:
    """A conclusion of the thesis.

    Attributes
    ----------
    says : str
        What the thesis says.
    unit : str
    lines : list of Line
    remark : str
        Why, where that is known.
    """

    says: str
    unit: str
    lines: list[Line] = field(default_factory=list)
    remark: str = ""

    @property
    def verdict(self) -> str:
        """Return the verdict that all lines share, else the counts of each."""
        counts = {v: sum(line.verdict == v for line in self.lines) for v in KINDS}
        held = [v for v, n in counts.items() if n]
        if len(held) == 1:
            return held[0]
        return ", ".join(f"{v} in {n} of {len(self.lines)}" for v, n in counts.items() if n)

    @property
    def kind(self) -> str:
        """Return the CSS class of the verdict."""
        return KINDS.get(self.verdict, "warn")


class Errors:
    """Held-out errors of the study by set, method and seed."""

    def __init__(self, rows: Sequence[Row]) -> None:
        self._errors: dict[tuple[str, str], dict[int, float]] = {}
        for row in rows:
            if row["cause"] == LOST and row["error"] is not None:
                self._errors.setdefault((row["set"], row["method"]), {})[int(row["seed"])] = row["error"]

    def mean(self, name: str, method: str) -> Estimate:
        """Return the mean over seeds."""
        found = mean_of(Quantity(v) for v in self._errors[name, method].values())
        assert found is not None  # noqa: S101  (every key holds a row)
        return found

    def line(self, what: str, smaller: tuple[str, str], larger: tuple[str, str]) -> Line:
        """Return the comparison of what the thesis says has the smaller and the larger error."""
        first, second = self._errors[smaller], self._errors[larger]
        difference = mean_of(Quantity(second[s] - first[s]) for s in first if s in second)
        assert difference is not None  # noqa: S101
        low, high = difference.interval
        verdict = CONFIRMED if low > 0.0 else REFUTED if high < 0.0 else OPEN
        return Line(what, self.mean(*smaller), self.mean(*larger), difference, verdict)

    def extreme(self, names: Sequence[str], method: str, *, largest: bool) -> str:
        """Return the set with the smallest or the largest mean."""
        return sorted(names, key=lambda n: self.mean(n, method).value)[-1 if largest else 0]


def conclusions(rows: Sequence[Row]) -> list[Conclusion]:
    """Return the verdicts on what the thesis concludes.

    Parameters
    ----------
    rows : sequence of dict
        Of the study over seeds.
    """
    errors = Errors(rows)
    return [
        _best_procedure(errors),
        _equal_duration(errors),
        _speed(errors),
        _filter(errors),
        _gyroscope_rates(errors),
        _best_rate(errors),
        _staged_against_least_squares(errors),
        _staged_against_cholesky(errors),
        _tables(errors),
    ]


def _best_procedure(errors: Errors) -> Conclusion:
    """Stop 10 s against the best of the others."""
    lines = []
    for method, reading in READINGS.items():
        for device, name in DEVICES.items():
            others = [f"{device}-{p}" for p in (*STOPS[:2], *CONTINUOUS)]
            rival = errors.extreme(others, method, largest=False)
            what = f"{name}, {reading}: stop 10 s against the best other, {in_words(rival.removeprefix(device + '-'))}"
            lines.append(errors.line(what, (f"{device}-stop-10s", method), (rival, method)))
    return Conclusion(
        "The best accelerometer procedure is stop and go with 10 s",
        "g",
        lines,
        "As printed, more samples make the largest one larger: its excess over the peak grows with the number of "
        "samples "
        "(stop 10 s has 30 times those of continuous 30 deg/s), the scale factor falls with it, and the longest "
        "procedure does worst. With fitted sinusoids what is left on the held-out motion is its own noise; the "
        "procedures differ by less than a hundredth of it, except where the filter weighs in.",
    )


def _equal_duration(errors: Errors) -> Conclusion:
    lines = [
        errors.line(
            f"{name}, {reading}: continuous 1 deg/s against stop 1 s",
            (f"{device}-continuous-1dps", method),
            (f"{device}-stop-1s", method),
        )
        for method, reading in READINGS.items()
        for device, name in DEVICES.items()
    ]
    return Conclusion("At equal duration continuous 1 deg/s beats stop 1 s", "g", lines)


def _speed(errors: Errors) -> Conclusion:
    lines = [
        errors.line(
            f"{name}, {reading}: continuous 1 deg/s against 30 deg/s",
            (f"{device}-continuous-1dps", method),
            (f"{device}-continuous-30dps", method),
        )
        for method, reading in (*READINGS.items(), ("unfiltered", "errata corrected, no filter"))
        for device, name in DEVICES.items()
    ]
    return Conclusion("Continuous rotation gets worse as the rate grows; 30 deg/s is worst", "g", lines)


def _filter(errors: Errors) -> Conclusion:
    lines = [
        errors.line(
            f"{name}, 30 deg/s, errata corrected: zero-phase filter against the causal one",
            (f"{device}-continuous-30dps", "zero-phase"),
            (f"{device}-continuous-30dps", "staged"),
        )
        for device, name in DEVICES.items()
    ]
    return Conclusion(
        "Speed hurts because the filter is late (DIGEST erratum 9); without its delay it would not",
        "g",
        lines,
        "A delay turns all angles of a turn alike: it moves neither the 90 deg between two extremes nor their "
        "height, so "
        "the stages do not feel it. What they feel is the filter's gain, |H| = 1 - (rate RC)^2 / 2: a turn at 30 deg/s "
        "loses 0.2 % of its amplitude (0.8 % with RC = 0.24 s). A zero-phase filter runs twice and loses twice as "
        "much; "
        "no filter loses nothing.",
    )


def _gyroscope_rates(errors: Errors) -> Conclusion:
    """Judge whether the worst rate is within 5 % of the best."""
    lines = []
    for device, name in DEVICES.items():
        names = [f"{device}-{rate}" for rate in RATES]
        best, worst = (errors.extreme(names, "staged", largest=largest) for largest in (False, True))
        line = errors.line(f"{name}: {_rate(best)} against {_rate(worst)}", (best, "staged"), (worst, "staged"))
        alike = line.difference.interval[1] < 0.05 * line.first.value
        apart = line.difference.interval[0] > 0.05 * line.first.value
        verdict = CONFIRMED if alike else REFUTED if apart else OPEN
        lines.append(Line(line.what, line.first, line.second, line.difference, verdict))
    return Conclusion(
        "The gyroscope's rates are all alike (here: the best and the worst within 5 %)",
        "deg/s",
        lines,
        "A turn at 200 deg/s lasts 15 samples, and the filter still remembers the ramp before it.",
    )


def _best_rate(errors: Errors) -> Conclusion:
    lines = []
    for device, name in DEVICES.items():
        others = [f"{device}-{rate}" for rate in RATES if rate != "gyro-100dps"]
        rival = errors.extreme(others, "staged", largest=False)
        what = f"{name}: 100 deg/s against the best other, {_rate(rival)}"
        lines.append(errors.line(what, (f"{device}-gyro-100dps", "staged"), (rival, "staged")))
    return Conclusion("100 deg/s is the best rate by a hair", "deg/s", lines)


def _staged_against_least_squares(errors: Errors) -> Conclusion:
    lines = []
    for method, reading in READINGS.items():
        for device, name in DEVICES.items():
            own = f"{device}-{'continuous-0.5dps' if device == 'stim300' else 'stop-1s'}"
            what = f"{name}, {reading}: staged against least squares"
            lines.append(errors.line(what, (own, method), (own, "least-squares")))
    return Conclusion("The staged method beats nonlinear least squares (table 5.24)", "g", lines)


def _staged_against_cholesky(errors: Errors) -> Conclusion:
    lines = [
        errors.line(f"{name}, {reading}", (f"{device}-gyro-20dps", "staged"), (f"{device}-gyro-20dps", method))
        for method, reading in (("cholesky-printed", "forward matrix, as printed"), ("cholesky", "inverted"))
        for device, name in DEVICES.items()
    ]
    return Conclusion(
        "The staged method beats Cholesky and LU (table 5.26)",
        "deg/s",
        lines,
        "The printed advantage is the inversion that was left out (erratum 4).",
    )


def _tables(errors: Errors) -> Conclusion:
    sets = (("stop-1s", "printed"), ("stop-1s", "staged"), ("gyro-60dps", "staged"))
    lines = [
        errors.line(
            f"{in_words(procedure)}, {READINGS[method]}: precise against home-made",
            (f"mpu6050-1-{procedure}", method),
            (f"mpu6050-1-mark2-{procedure}", method),
        )
        for procedure, method in sets
    ]
    return Conclusion("The home-made table calibrates worse than the precise one", "g, deg/s", lines)


def _rate(name: str) -> str:
    return f"{name.rpartition('-')[2].removesuffix('dps')} deg/s"


def interval_text(estimate: Estimate) -> str:
    """Return ``low to high`` of an estimate's interval."""
    low, high = estimate.interval
    return f"{number(low, 2)} to {number(high, 2)}"
