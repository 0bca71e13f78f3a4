"""What the thesis concludes, judged over many seeds: confirmed, refuted, no difference or not decided.

A comparison of two procedures is the mean over seeds of the difference of their held-out errors, drawn with the same
number, with its 95 % interval by Student's t. It is decided where the interval leaves zero on one side; an interval
that lies within 1 % of the error itself is no difference, whatever its sign.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pipeline.report.comparison import Estimate, mean_of
from pipeline.report.numbers import number
from pipeline.thesis.results import CONTINUOUS, DEVICES, RATES, STOPS, in_words
from pipeline.thesis.seeds import CAUSES, INTERVAL_S, LOST, TIME_CONSTANT_S

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    import pandas as pd


CONFIRMED, REFUTED, NONE, OPEN = "confirmed", "refuted", "no difference", "not decided"
KINDS = {CONFIRMED: "good", REFUTED: "bad", NONE: "warn", OPEN: "warn"}  # CSS classes
SMALLEST = 0.01  # of the error: differences within it are none
ALIKE = 0.05  # of the error: by how much rates that are called alike may differ
WHY_SPEED = (
    "A delay shifts all angles of a turn equally: it changes neither the 90 deg between two extremes nor their height. "
    "So it does not affect the stages, as long as they leave out the rests at the ends of a turn, which are not late: "
    "fitted together with them, 30 deg/s shifts the bias of x by 12 mg and appears as an asymmetry of 1.6 %. The "
    "filter's gain does affect them: a turn at 30 deg/s loses {loss} % of its amplitude, and twice as much where the "
    "filter runs both ways. Without a filter, the rate has hardly any effect (see the verdict above)."
)
READINGS = {"printed": "as printed", "staged": "errata corrected"}


class Line(NamedTuple):
    """One comparison: what is compared, the two means, the difference with its interval, and the verdict."""

    what: str
    first: Estimate
    second: Estimate
    difference: Estimate
    verdict: str


class Conclusion(NamedTuple):
    """A conclusion of the thesis (``says``), its comparisons, why they come out so (``remark``), what is compared."""

    says: str
    unit: str
    lines: list[Line]
    remark: str = ""
    compared: str = "Mean |e| after"

    @property
    def verdict(self) -> str:
        """Return the verdict that all lines share, else the counts of each."""
        counts = {v: sum(line.verdict == v for line in self.lines) for v in KINDS}
        found = [v for v, n in counts.items() if n]
        return found[0] if len(found) == 1 else ", ".join(f"{v} in {counts[v]} of {len(self.lines)}" for v in found)


class Errors:
    """Held-out errors of the study by set of recordings, method and seed: deg/s, of the accelerometer mg."""

    def __init__(self, rows: pd.DataFrame) -> None:
        judged = rows[(rows["cause"] == CAUSES.index(LOST)) & rows["error"].notna()]
        errors = judged["error"].where(judged["set"].str.contains("-gyro-"), 1000.0 * judged["error"])
        self._errors = judged.assign(error=errors).set_index(["set", "method", "seed"])["error"].sort_index()

    def mean(self, name: str, method: str) -> Estimate:
        """Return the mean over seeds."""
        return mean_of(self._errors[name, method])

    def line(self, what: str, smaller: tuple[str, str], larger: tuple[str, str]) -> Line:
        """Compare two (set, method), of which the thesis says that the first has the smaller error."""
        first = self._errors[smaller]
        return _compared(what, first, self._errors[larger], SMALLEST * mean_of(first).value)

    def lines(self, what: str, smaller: str, larger: str, methods: Mapping[str, str] = READINGS) -> list[Line]:
        """Compare two procedures on each device by each method."""
        return [
            self.line(f"{name}, {reading}: {what}", (f"{device}-{smaller}", method), (f"{device}-{larger}", method))
            for method, reading in methods.items()
            for device, name in DEVICES.items()
        ]

    def growth(self, what: str, device: str, smaller: str, larger: str) -> Line:
        """Compare how two methods' errors grow from continuous 1 to 30 deg/s."""
        grown = []
        for method in (smaller, larger):
            slow, fast = (self._errors[f"{device}-continuous-{rate}dps", method] for rate in (1, 30))
            grown.append((fast - slow).dropna())
        fastest = self._errors[f"{device}-continuous-30dps", larger]
        return _compared(what, grown[0], grown[1], SMALLEST * mean_of(fastest).value)

    def ordered(self, device: str, procedures: Iterable[str], method: str) -> list[str]:
        """Return a device's sets of recordings, the smallest mean error first."""
        return sorted((f"{device}-{p}" for p in procedures), key=lambda name: self.mean(name, method).value)


def _compared(what: str, first: pd.Series[float], second: pd.Series[float], smallest: float) -> Line:
    """Compare the smaller value of each seed with the larger one."""
    difference = mean_of((second - first).dropna())
    low, high = difference.interval
    verdict = CONFIRMED if low > 0.0 else REFUTED if high < 0.0 else OPEN
    if max(abs(low), abs(high)) < smallest:
        verdict = NONE
    return Line(what, mean_of(first), mean_of(second), difference, verdict)


def conclusions(rows: pd.DataFrame) -> list[Conclusion]:
    """Return the verdicts on what the thesis concludes, from the rows of the study over seeds."""
    errors = Errors(rows)
    with_unfiltered = {**READINGS, "unfiltered": "errata corrected, no filter"}
    matrices = {"cholesky-printed": "forward matrix, as printed", "cholesky": "inverted"}
    return [
        _best_procedure(errors),
        Conclusion(
            "At equal duration continuous 1 deg/s beats stop 1 s",
            "mg",
            errors.lines("continuous 1 deg/s against stop 1 s", "continuous-1dps", "stop-1s"),
        ),
        Conclusion(
            "Continuous rotation gets worse as the rate grows; 30 deg/s is worst",
            "mg",
            errors.lines("continuous 1 deg/s against 30 deg/s", "continuous-1dps", "continuous-30dps", with_unfiltered),
            "As printed on the MPU6050, fewer samples at 30 deg/s lie less far above the peaks: that outweighs the "
            "filter.",
        ),
        _filter(errors),
        _gyroscope_rates(errors),
        _best_rate(errors),
        _staged_against_least_squares(errors),
        Conclusion(
            "The staged method beats Cholesky and LU (table 5.26)",
            "deg/s",
            [
                errors.line(f"{name}, {reading}", (f"{device}-gyro-20dps", "staged"), (f"{device}-gyro-20dps", method))
                for method, reading in matrices.items()
                for device, name in DEVICES.items()
            ],
            "The printed advantage is the inversion that was left out (erratum 4).",
        ),
        _tables(errors, "accelerometer", "mg", (("stop-1s", "printed"), ("stop-1s", "staged"))),
        _tables(errors, "gyroscope", "deg/s", (("gyro-60dps", "staged"),)),
    ]


def _best_procedure(errors: Errors) -> Conclusion:
    """Compare stop 10 s with the best of the others."""
    lines = []
    for method, reading in READINGS.items():
        for device, name in DEVICES.items():
            rival = errors.ordered(device, (*STOPS[:2], *CONTINUOUS), method)[0]
            what = f"{name}, {reading}: stop 10 s against the best other, {in_words(rival.removeprefix(device + '-'))}"
            lines.append(errors.line(what, (f"{device}-stop-10s", method), (rival, method)))
    return Conclusion(
        "The best accelerometer procedure is stop and go with 10 s",
        "mg",
        lines,
        "As printed, the excess of the largest sample over the peak grows with the number of samples (stop 10 s has "
        "200 times those of continuous 30 deg/s), the scale factor decreases with it, and the longest procedure is "
        "worst. With fitted sinusoids the noise of the held-out motion remains, equal for all procedures up to "
        "10 deg/s on the MPU6050. On the STIM300, whose noise is low, 10 deg/s is better by a tenth: the filter "
        "attenuates the turn as much as the held-out motion.",
    )


def _filter(errors: Errors) -> Conclusion:
    """Compare how the error grows with the rate behind the campaign's filter and behind one without delay."""
    tried = {
        "same-gain": "growth behind a filter of the same gain without delay",
        "zero-phase": "growth behind the filter run both ways, its gain twice,",
    }
    lines = [
        errors.growth(f"{name}, errata corrected: {what} against that behind the causal one", device, method, "staged")
        for method, what in tried.items()
        for device, name in DEVICES.items()
    ]
    return Conclusion(
        "Speed hurts because the filter is late (erratum 9); without its delay it would not",
        "mg",
        lines,
        WHY_SPEED.format(loss=number(100.0 * (1.0 - gain_of_filter(30.0)), 2)),
        "Growth of mean |e| after from continuous 1 to 30 deg/s",
    )


def gain_of_filter(rate: float) -> float:
    """Return what the campaign's filter leaves of the amplitude of a turn at ``rate`` deg/s."""
    k = INTERVAL_S / (INTERVAL_S + TIME_CONSTANT_S)
    return float(k / abs(1.0 - (1.0 - k) * np.exp(-1j * np.radians(rate) * INTERVAL_S)))


def _gyroscope_rates(errors: Errors) -> Conclusion:
    """Judge whether the worst rate is within 5 % of the best."""
    lines = []
    for device, name in DEVICES.items():
        best, *_, worst = errors.ordered(device, RATES, "staged")
        line = errors.line(f"{name}: {_rate(best)} against {_rate(worst)}", (best, "staged"), (worst, "staged"))
        (low, high), least = line.difference.interval, ALIKE * line.first.value
        lines.append(line._replace(verdict=CONFIRMED if high < least else REFUTED if low > least else OPEN))
    return Conclusion("The gyroscope's rates are all alike (here: the best and the worst within 5 %)", "deg/s", lines)


def _best_rate(errors: Errors) -> Conclusion:
    lines = []
    for device, name in DEVICES.items():
        rival = errors.ordered(device, [rate for rate in RATES if rate != "gyro-100dps"], "staged")[0]
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
    return Conclusion("The staged method beats nonlinear least squares (table 5.24)", "mg", lines)


def _tables(errors: Errors, sensor: str, unit: str, sets: Sequence[tuple[str, str]]) -> Conclusion:
    lines = [
        errors.line(
            f"{in_words(procedure)}, {READINGS[method]}: precise against home-made",
            (f"mpu6050-1-{procedure}", method),
            (f"mpu6050-1-mark2-{procedure}", method),
        )
        for procedure, method in sets
    ]
    return Conclusion(f"The home-made table calibrates the {sensor} worse than the precise one", unit, lines)


def _rate(name: str) -> str:
    return f"{name.rpartition('-')[2].removesuffix('dps')} deg/s"
