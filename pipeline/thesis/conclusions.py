"""Test the conclusions of the thesis over many seeds: confirmed, refuted, no difference or not decided.

A comparison of two procedures is the mean over seeds of the difference of their held-out errors at the same seed, with
its 95 % interval by Student's t. It is decided if the interval does not contain zero. An interval within 1 % of the
error is no difference, whatever its sign.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pipeline.report.comparison import Estimate, mean_of
from pipeline.thesis.seeds import CAUSES, INTERVAL_S, LOST, TIME_CONSTANT_S
from pipeline.thesis.tables import CONTINUOUS, DEVICES, RATES, STOPS, in_words

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    import pandas as pd

    Place = tuple[str, str]  # set of recordings and method


CONFIRMED, REFUTED, NONE, OPEN = "confirmed", "refuted", "no difference", "not decided"
KINDS = {CONFIRMED: "good", REFUTED: "bad", NONE: "warn", OPEN: "warn"}  # CSS classes
SMALLEST = 0.01  # of the error: smaller differences are negligible
ALIKE = 0.05  # of the error: largest difference between rates that count as equal
READINGS = {"printed": "as printed", "staged": "errata corrected"}
FILTERS = {
    "same-gain": "growth behind a filter of the same gain without delay",
    "zero-phase": "growth behind the filter run both ways, its gain twice,",
}
MATRICES = {"cholesky-printed": "forward matrix, as printed", "cholesky": "inverted"}


class Line(NamedTuple):
    """One comparison: what is compared, the two means, the difference with its interval, and the verdict."""

    what: str
    first: Estimate
    second: Estimate
    difference: Estimate
    verdict: str


def verdict_of(lines: Sequence[Line]) -> str:
    """Return the common verdict of all comparisons of a conclusion, or the count of each verdict."""
    counts = {v: n for v in KINDS if (n := sum(line.verdict == v for line in lines))}
    return ", ".join(v if n == len(lines) else f"{v} in {n} of {len(lines)}" for v, n in counts.items())


class Errors:
    """Held-out errors of the study by set of recordings, method and seed: deg/s, or mg for accelerometers."""

    def __init__(self, rows: pd.DataFrame) -> None:
        judged = rows[(rows["cause"] == CAUSES.index(LOST)) & rows["error"].notna()]
        errors = judged["error"].where(judged["set"].str.contains("-gyro-"), 1000.0 * judged["error"])
        self._errors = judged.assign(error=errors).set_index(["set", "method", "seed"])["error"].sort_index()

    def mean(self, name: str, method: str) -> Estimate:
        """Return the mean over seeds."""
        return mean_of(self._errors[name, method])

    def line(self, what: str, smaller: Place, larger: Place) -> Line:
        """Compare two (set, method); the thesis concludes that the first has the smaller error."""
        first = self._errors[smaller]
        return _compared(what, first, self._errors[larger], SMALLEST * mean_of(first).value)

    def lines(self, what: str, smaller: str, larger: str, methods: Mapping[str, str] = READINGS) -> list[Line]:
        """Compare two procedures on each device by each method."""
        return [
            self.line(f"{name}, {reading}: {what}", (f"{device}-{smaller}", method), (f"{device}-{larger}", method))
            for method, reading in methods.items()
            for device, name in DEVICES.items()
        ]

    def against_the_best(self, procedure_name: str, others: Iterable[str], methods: Mapping[str, str]) -> list[Line]:
        """Compare a procedure with the best of the others on each device by each method."""
        return [
            self.line(
                f"{name}{reading and ', '}{reading}: {_short(procedure_name)} against the best other, {_short(best)}",
                (f"{device}-{procedure_name}", method),
                (f"{device}-{best}", method),
            )
            for method, reading in methods.items()
            for device, name in DEVICES.items()
            for best in self.ordered(device, others, method)[:1]
        ]

    def growth(self, what: str, device: str, smaller: str, larger: str) -> Line:
        """Compare how two methods' errors grow from continuous 1 to 30 deg/s."""
        grown = []
        for method in (smaller, larger):
            slow, fast = (self._errors[f"{device}-continuous-{rate}dps", method] for rate in (1, 30))
            grown.append((fast - slow).dropna())
        fastest = self._errors[f"{device}-continuous-30dps", larger]
        return _compared(what, grown[0], grown[1], SMALLEST * mean_of(fastest).value)

    def alike(self, device: str, procedures: Iterable[str], method: str) -> Line:
        """Judge whether the worst procedure of a device is within 5 % of the best."""
        best, *_, worst = self.ordered(device, procedures, method)
        what = f"{DEVICES[device]}: {_short(best)} against {_short(worst)}"
        line = self.line(what, (f"{device}-{best}", method), (f"{device}-{worst}", method))
        (low, high), least = line.difference.interval, ALIKE * line.first.value
        return line._replace(verdict=CONFIRMED if high < least else REFUTED if low > least else OPEN)

    def ordered(self, device: str, procedures: Iterable[str], method: str) -> list[str]:
        """Sort procedures by a device's mean error, the smallest first."""
        return sorted(procedures, key=lambda procedure: self.mean(f"{device}-{procedure}", method).value)


def _short(procedure: str) -> str:
    return in_words(procedure).removeprefix("gyro ")


def _compared(what: str, first: pd.Series[float], second: pd.Series[float], negligible: float) -> Line:
    """Compare the smaller value of each seed with the larger one."""
    difference = mean_of((second - first).dropna())
    low, high = difference.interval
    verdict = CONFIRMED if low > 0.0 else REFUTED if high < 0.0 else OPEN
    if max(abs(low), abs(high)) < negligible:
        verdict = NONE
    return Line(what, mean_of(first), mean_of(second), difference, verdict)


def gain_of_filter(rate: float) -> float:
    """Return the gain of the campaign's filter for the sinusoid of a turn at ``rate`` deg/s."""
    k = INTERVAL_S / (INTERVAL_S + TIME_CONSTANT_S)
    return float(k / abs(1.0 - (1.0 - k) * np.exp(-1j * np.radians(rate) * INTERVAL_S)))


def conclusions(rows: pd.DataFrame) -> dict[str, list[Line]]:
    """Return the comparisons of each conclusion of the thesis, from the rows of the study over seeds."""
    errors, devices = Errors(rows), DEVICES.items()
    unfiltered = {**READINGS, "unfiltered": "errata corrected, no filter"}
    slow, fast, rates = "continuous-1dps", "continuous-30dps", [rate for rate in RATES if rate != "gyro-100dps"]
    growths = [
        errors.growth(f"{name}, errata corrected: {what} against that behind the causal one", device, method, "staged")
        for method, what in FILTERS.items()
        for device, name in devices
    ]
    least_squares = [
        errors.line(
            f"{name}, {reading}: staged against least squares",
            (recordings, method),
            (recordings, "least-squares"),
        )
        for method, reading in READINGS.items()
        for device, name in devices
        for recordings in [f"{device}-{'continuous-0.5dps' if device == 'stim300' else 'stop-1s'}"]
    ]
    cholesky = [
        errors.line(f"{name}, {reading}", (f"{device}-gyro-20dps", "staged"), (f"{device}-gyro-20dps", method))
        for method, reading in MATRICES.items()
        for device, name in devices
    ]
    tables = [
        errors.line(
            f"{in_words(procedure)}, {READINGS[method]}: precise against home-made",
            (f"mpu6050-1-{procedure}", method),
            (f"mpu6050-1-mark2-{procedure}", method),
        )
        for procedure, method in (("stop-1s", "printed"), ("stop-1s", "staged"), ("gyro-60dps", "staged"))
    ]
    return {
        "best_procedure": errors.against_the_best("stop-10s", (*STOPS[:2], *CONTINUOUS), READINGS),
        "equal_duration": errors.lines("continuous 1 deg/s against stop 1 s", slow, "stop-1s"),
        "speed": errors.lines("continuous 1 deg/s against 30 deg/s", slow, fast, unfiltered),
        "delay": growths,
        "rates_alike": [errors.alike(device, RATES, "staged") for device in DEVICES],
        "best_rate": errors.against_the_best("gyro-100dps", rates, {"staged": ""}),
        "least_squares": least_squares,
        "cholesky": cholesky,
        "table_accelerometer": tables[:2],
        "table_gyroscope": tables[2:],
    }
