"""Compare the thesis with many seeds and with the campaign: its conclusions, the evidence for its errata, its scatter.

A conclusion is confirmed, refuted, no difference or not decided. A comparison of two procedures is the mean over seeds
of the difference of their held-out errors at the same seed, with its 95 % interval by Student's t. It is decided if the
interval does not contain zero. An interval within 1 % of the error is no difference, whatever its sign.

The evidence is from the printed tables and from the campaign. The agreement of a quantity is, over devices, procedures
and elements,

    largest |ours - other|,    and the number of differences within the bound

where

other : the median of the printed biases (accelerometer: they differ between procedures by up to 0.006 g), the true
    scale factors (O M S), the printed row (gyroscope), or the staged method on the same recordings (Cholesky and LU, as
    a share of the expanded uncertainty of the difference)

The selection of the largest samples explains a share of the printed scatter of O and S. For a device, over its printed
rows and the axes y and z (x is the reference of O),

    D_O = sqrt(mean (1 - O)^2),    D_S = sqrt(mean (S M - S_0)^2)

are computed for the printed values and over all seeds. S_0 is the true scale factor. S is multiplied by M, because the
printed M contains the bias (see the errata), which shifts S and is no scatter. Noise and lost samples do not explain
``sqrt(max(0, D_printed^2 - D_seeds^2))``. A table that vibrates like the home-made one is the upper bound for the
effect of vibration on the precise table.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from imu_research.thesis.seeds import CAUSES, INTERVAL_S, LOST, TIME_CONSTANT_S
from imu_research.thesis.tables import (
    ACCELEROMETER,
    AXES,
    CONTINUOUS,
    DEVICES,
    GYROSCOPE,
    RATES,
    STOPS,
    Results,
    in_words,
    matrix_of,
    read_printed,
    values,
)
from pipeline.core.files import JSON
from pipeline.core.records import Values
from pipeline.output.pages.comparison import MeanWithUncertainty, mean_of
from pipeline.physics.effects.base import STANDARD_GRAVITY

Place = tuple[str, str]  # set of recordings and method

CONFIRMED, REFUTED, NO_DIFFERENCE, NOT_DECIDED = "confirmed", "refuted", "no difference", "not decided"
CSS_CLASSES = {CONFIRMED: "good", REFUTED: "bad", NO_DIFFERENCE: "warn", NOT_DECIDED: "warn"}  # CSS classes
SMALLEST = 0.01  # of the error: smaller differences are negligible
EQUAL_RATE_SHARE = 0.05  # of the error: largest difference between rates that count as equal
EQUATIONS_AS = {"printed": "as printed", "staged": "errata corrected"}
FINDINGS_OF_FILTERS = {
    "same-gain": "growth behind a filter of the same gain without delay",
    "zero-phase": "growth behind the filter run both ways, its gain twice,",
}
MATRICES = {"cholesky-printed": "forward matrix, as printed", "cholesky": "inverted"}
BANGKOK = 9.783  # m/s^2, WGS 84 normal gravity at 13.7 deg N
TRUE_SCALE = {
    "mpu6050-1": (1.001, 0.994, 0.980),
    "mpu6050-2": (0.993, 0.996, 0.986),
    "stim300": (1.002, 1.003, 0.998),
}  # by least squares, table 5.23
BIAS_KEYS = [f"b_{a}_g" for a in AXES]


class FindingLine(NamedTuple):
    """One comparison: what is compared, the two means, the difference with its interval, and the verdict."""

    what: str
    first: MeanWithUncertainty
    second: MeanWithUncertainty
    difference: MeanWithUncertainty
    verdict: str


def verdict_of(lines: Sequence[FindingLine]) -> str:
    """Return the common verdict of all comparisons of a conclusion, or the count of each verdict."""
    counts = {v: n for v in CSS_CLASSES if (n := sum(line.verdict == v for line in lines))}
    return ", ".join(v if n == len(lines) else f"{v} in {n} of {len(lines)}" for v, n in counts.items())


class Errors:
    """Held-out errors of the study by set of recordings, method and seed: deg/s, or mg for accelerometers."""

    def __init__(self, rows: pd.DataFrame) -> None:
        judged = rows[(rows["cause"] == CAUSES.index(LOST)) & rows["error"].notna()]
        errors = judged["error"].where(judged["set"].str.contains("-gyro-"), 1000.0 * judged["error"])
        self._errors = judged.assign(error=errors).set_index(["set", "method", "seed"])["error"].sort_index()

    def mean(self, name: str, method: str) -> MeanWithUncertainty:
        """Return the mean over seeds."""
        return mean_of(self._errors[name, method])

    def line(self, what: str, smaller: Place, larger: Place) -> FindingLine:
        """Compare two (set, method); the thesis concludes that the first has the smaller error."""
        first = self._errors[smaller]
        return _compared(what, first, self._errors[larger], SMALLEST * mean_of(first).value)

    def lines(
        self, what: str, smaller: str, larger: str, methods: Mapping[str, str] = EQUATIONS_AS
    ) -> list[FindingLine]:
        """Compare two procedures on each device by each method."""
        return [
            self.line(f"{name}, {reading}: {what}", (f"{device}-{smaller}", method), (f"{device}-{larger}", method))
            for method, reading in methods.items()
            for device, name in DEVICES.items()
        ]

    def against_the_best(
        self, procedure_name: str, others: Iterable[str], methods: Mapping[str, str]
    ) -> list[FindingLine]:
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

    def growth(self, what: str, device: str, smaller: str, larger: str) -> FindingLine:
        """Compare how two methods' errors grow from continuous 1 to 30 deg/s."""
        grown = []
        for method in (smaller, larger):
            slow, fast = (self._errors[f"{device}-continuous-{rate}dps", method] for rate in (1, 30))
            grown.append((fast - slow).dropna())
        fastest = self._errors[f"{device}-continuous-30dps", larger]
        return _compared(what, grown[0], grown[1], SMALLEST * mean_of(fastest).value)

    def alike(self, device: str, procedures: Iterable[str], method: str) -> FindingLine:
        """Judge whether the worst procedure of a device is within 5 % of the best."""
        best, *_, worst = self.ordered(device, procedures, method)
        what = f"{DEVICES[device]}: {_short(best)} against {_short(worst)}"
        line = self.line(what, (f"{device}-{best}", method), (f"{device}-{worst}", method))
        (low, high), least = line.difference.interval, EQUAL_RATE_SHARE * line.first.value
        return line._replace(verdict=CONFIRMED if high < least else REFUTED if low > least else NOT_DECIDED)

    def ordered(self, device: str, procedures: Iterable[str], method: str) -> list[str]:
        """Sort procedures by a device's mean error, the smallest first."""
        return sorted(procedures, key=lambda procedure: self.mean(f"{device}-{procedure}", method).value)


def _short(procedure: str) -> str:
    return in_words(procedure).removeprefix("gyro ")


def _compared(what: str, first: pd.Series[float], second: pd.Series[float], negligible: float) -> FindingLine:
    """Compare the smaller value of each seed with the larger one."""
    difference = mean_of((second - first).dropna())
    low, high = difference.interval
    verdict = CONFIRMED if low > 0.0 else REFUTED if high < 0.0 else NOT_DECIDED
    if max(abs(low), abs(high)) < negligible:
        verdict = NO_DIFFERENCE
    return FindingLine(what, mean_of(first), mean_of(second), difference, verdict)


def gain_of_filter(rate: float) -> float:
    """Return the gain of the campaign's filter for the sinusoid of a turn at ``rate`` deg/s."""
    k = INTERVAL_S / (INTERVAL_S + TIME_CONSTANT_S)
    return float(k / abs(1.0 - (1.0 - k) * np.exp(-1j * np.radians(rate) * INTERVAL_S)))


def conclusions(rows: pd.DataFrame) -> dict[str, list[FindingLine]]:
    """Return the comparisons of each conclusion of the thesis, from the rows of the study over seeds."""
    errors, devices = Errors(rows), DEVICES.items()
    unfiltered = {**EQUATIONS_AS, "unfiltered": "errata corrected, no filter"}
    slow, fast, rates = "continuous-1dps", "continuous-30dps", [rate for rate in RATES if rate != "gyro-100dps"]
    growths = [
        errors.growth(f"{name}, errata corrected: {what} against that behind the causal one", device, method, "staged")
        for method, what in FINDINGS_OF_FILTERS.items()
        for device, name in devices
    ]
    least_squares = [
        errors.line(
            f"{name}, {reading}: staged against least squares", (recordings, method), (recordings, "least-squares")
        )
        for method, reading in EQUATIONS_AS.items()
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
            f"{in_words(procedure)}, {EQUATIONS_AS[method]}: precise against home-made",
            (f"mpu6050-1-{procedure}", method),
            (f"mpu6050-1-mark2-{procedure}", method),
        )
        for procedure, method in (("stop-1s", "printed"), ("stop-1s", "staged"), ("gyro-60dps", "staged"))
    ]
    return {
        "best_procedure": errors.against_the_best("stop-10s", (*STOPS[:2], *CONTINUOUS), EQUATIONS_AS),
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


def evidence(printed: Path, results: Results, rows: pd.DataFrame) -> JSON:
    """Return the evidence for the errata, for ``thesis.html``; ``rows``: of the study over seeds."""
    parameters, errors = (read_printed(printed, name) for name in ("accel_parameters", "errors"))
    a_zero = -0.1285  # of z of MPU6050 (1), table 5.1
    a_max = 1.0 / 0.980 + a_zero  # table 5.23
    first = parameters.iloc[0]
    odd = errors[(errors["metric"] == "max_error") & (errors["before"] * errors["after"] < 0)]
    stop = "mpu6050-1-stop-1s"
    staged = Errors(rows)
    gyroscope = errors[(errors["sensor"] == "gyroscope") & (errors["metric"] == "mean_abs_error")]
    motion = gyroscope.drop_duplicates("device", keep="last").set_index("device")["before"]
    mark2 = parameters[parameters["table"] == "5.7"].iloc[0].to_dict()
    return {
        "scale_factor": {"printed": 1.0 / a_max - a_zero, "meant": 1.0 / (a_max - a_zero)},
        "subtracted_again": _subtracted_again(results),
        "order_of_matrix": _order_of_matrix(results),
        "forward_matrix": _forward_matrix(read_printed(printed, "method_comparison")),
        "product": (values(first, "O_{}") * values(first, "M_{}") * values(first, "S_{}")).tolist(),
        "changed_sign": odd["change_percent"].tolist(),
        "O": [results.parameter(f"{stop}-staged", "accelerometer", "orthogonality", f"O_P_{a}") for a in "yz"],
        "cross_term": np.radians(0.286),
        "errors": [results.errors(f"{stop}-{m}", "accelerometer")[1] for m in ("staged", "least-squares")],
        "gravity": {"bangkok": BANGKOK, "ratio": BANGKOK / STANDARD_GRAVITY},
        "late_deg": 30.0 * TIME_CONSTANT_S,
        "loss_percent": 100.0 * (1.0 - gain_of_filter(30.0)),
        "behind": {
            method: [staged.mean(f"{device}-continuous-30dps", method).value for device in DEVICES]
            for method in ("staged", "same-gain", "unfiltered")
        },
        "O_x": {
            "rows": len(parameters),
            "ones": (parameters["O_x"] == 1.0).sum(),
            "differ": (parameters["O_y"] != parameters["O_z"]).sum(),
        },
        "wrong_side": abs(results.calibration(f"{stop}-staged", "accelerometer")[0][2]),
        "isotropic": float(np.linalg.norm([-3.837, 0.003, 0.255])) / 2.0,  # mean of |u . b| over all directions u
        "motion": [
            {"device": name, "ours": results.errors(f"{d}-gyro-20dps-printed", "gyroscope")[0], "printed": motion[d]}
            for d, name in DEVICES.items()
        ],
        "misalignment": [
            {
                "device": DEVICES[str(device)],
                "of_bias": float(np.prod(np.sqrt(1.0 - of_device[BIAS_KEYS].median() ** 2))),
                "ours": results.parameter(f"{device}-stop-1s-printed", "accelerometer", "misalignment", "M_P_x"),
                "printed": sorted({f"{m:.3f}" for m in of_device["M_x"]}),
            }
            for device, of_device in parameters[parameters["rate_table"] == "acutronic"].groupby("device", sort=False)
        ],
        "bias_of_mark2": {
            "printed": mark2["b_y_g"],
            "errors": [
                results.with_printed("mpu6050-1-mark2-stop-1s", "accelerometer", {**mark2, "b_y_g": b})
                for b in (mark2["b_y_g"], -0.014)
            ],
        },
    }


def _subtracted_again(results: Results) -> float | None:
    """Return the largest bias that the stages subtract a second time, g; None if no unit was calibrated."""
    fits = (results.correction(f"{device}-stop-1s-printed", "accelerometer") or {"steps": []} for device in DEVICES)
    repeated = [
        v for fit in fits for step in [s["subtract"] for s in fit["steps"] if "subtract" in s][1:] for v in step
    ]
    return max(map(abs, repeated), default=None)


def _order_of_matrix(results: Results) -> float:
    """Return the largest difference of M by equation 3.50 from that by 3.49, at the rates of the home-made table."""
    rate = np.diag([60.0 * (1 - e) for e in (-0.027, -0.010, 0.002)])
    _, matrix = results.calibration("mpu6050-1-gyro-60dps-staged", "gyroscope")
    S = rate @ np.linalg.inv(matrix.T)
    return float(np.abs(np.linalg.solve(S.T, rate).T - np.linalg.solve(S, rate)).max())


def _forward_matrix(rows: pd.DataFrame) -> list[JSON]:
    """Return the differences of the printed Cholesky and LU matrix from the staged matrix and from its inverse."""
    found = []
    for device, device_rows in rows[rows["sensor"] == "gyroscope"].groupby("device"):
        matrices = {row["method"]: matrix_of(row, "R") for row in device_rows.to_dict("records")}
        staged, other = matrices["staged"], matrices["cholesky_lu"]
        if staged[2, 2] > 1.9:  # misprint, see erratum 5
            staged[2, 2], staged[1, 2] = 1.007, -0.009
        inverted, presented = (float(np.abs(m - other).max()) for m in (np.linalg.inv(staged), staged))
        found.append({"device": DEVICES[str(device)], "inverted": inverted, "presented": presented})
    return found


def agreements(printed: Path, results: Results) -> pd.DataFrame:
    """Return the agreement of the parameters, with a row for each quantity and method.

    Columns: ``what``, ``method``, ``bound`` (in the quantity's unit), ``largest`` (NaN where no unit was calibrated),
    ``within`` (number of differences within the bound) and ``count``.
    """
    found: list[tuple[str, str, float, list[Values]]] = []
    rows = _on_precise_table(printed, "accel_parameters")
    median = rows.groupby("device")[BIAS_KEYS].median()
    for title, method in reversed(ACCELEROMETER.items()):
        fits = [
            (row, *results.calibration(f"{row['set']}-{method}", "accelerometer")) for row in rows.to_dict("records")
        ]
        off = [bias - median.loc[row["device"]].to_numpy() for row, bias, _ in fits]
        product = [np.diag(matrix) - TRUE_SCALE[row["device"]] for row, _, matrix in fits]
        found.append(("Bias of the accelerometer, g, from the median of the printed", title, 0.002, off))
        found.append(("O M S of the accelerometer, from the truth", title, 0.005, product))
    rows = _on_precise_table(printed, "gyro_parameters")
    for title, method in reversed(GYROSCOPE.items()):
        fits = [(row, *results.calibration(f"{row['set']}-{method}", "gyroscope")) for row in rows.to_dict("records")]
        off = [bias - values(row, "b_{}_dps") for row, bias, _ in fits]
        change = [matrix.T - matrix_of(row, "M") for row, _, matrix in fits]
        found.append(("Bias of the gyroscope, deg/s, from the printed", title, 0.02, off))
        found.append(("Matrix of the gyroscope, from the printed", title, 0.002, change))
    what = "Cholesky and LU from the stages, over the expanded uncertainty of the difference"
    found.append((what, "inverted", 1.0, list(_cholesky(results))))
    out = []
    for what, title, bound, differences in found:
        size = pd.Series(np.abs(np.ravel(differences))).dropna()
        about = {"what": what, "method": title, "bound": bound, "largest": size.max()}
        out.append(about | {"within": (size <= bound).sum(), "count": len(size)})
    return pd.DataFrame(out)


def _on_precise_table(printed: Path, name: str) -> pd.DataFrame:
    rows = read_printed(printed, name)
    return rows[rows["rate_table"] == "acutronic"]


def _cholesky(results: Results) -> Iterator[Values]:
    for name in (f"{device}-{rate}" for device in DEVICES for rate in RATES):
        staged, cholesky = (results.fit(f"{name}-{method}", "gyroscope") for method in ("staged", "cholesky"))
        if staged and cholesky:
            expanded = np.hypot(*(fit["expanded_uncertainty"]["matrix"] for fit in (staged, cholesky)))
            yield (np.array(staged["matrix"]) - cholesky["matrix"]) / expanded


def scatters(printed: Path, seeds: pd.DataFrame) -> pd.DataFrame:
    """Return the scatter of O, S and b of each device on the precise table.

    Columns: ``device``, ``quantity``, ``printed``, one for each of ``CAUSES`` (each includes the causes before it),
    ``unexplained``, and ``share``: the share of the printed variance that noise and lost samples explain.
    """
    rows = _on_precise_table(printed, "accel_parameters")
    seeds = seeds[seeds["method"] == "printed"]
    out = []
    for device in DEVICES:
        device_rows = rows[rows["device"] == device]
        by_cause = seeds[seeds["set"].isin(device_rows["set"])].groupby("cause")
        for quantity, centre in (
            ("O", {"y": 1.0, "z": 1.0}),
            ("S", dict(zip(AXES, TRUE_SCALE[device], strict=True))),
            ("b", dict(zip(AXES, device_rows[BIAS_KEYS].median(), strict=True))),
        ):
            unit = "_g" if quantity == "b" else ""
            columns = [f"{quantity}_{a}" for a in centre]
            printed_values = device_rows[[f"{c}{unit}" for c in columns]].mul(
                device_rows["M_x"] if quantity == "S" else 1.0, axis=0
            )
            row: JSON = {"device": device, "quantity": quantity, "printed": _size(printed_values, centre)}
            for cause, drawn in by_cause:
                found = drawn[columns].mul(drawn["M"] if quantity == "S" else 1.0, axis=0)
                row[CAUSES[cause]] = _size(found, centre)
            row["unexplained"] = np.sqrt(max(0.0, row["printed"] ** 2 - row[LOST] ** 2))
            row["share"] = min(1.0, (row[LOST] / row["printed"]) ** 2)
            out.append(row)
    return pd.DataFrame(out)


def _size(found: pd.DataFrame, centre: dict[str, float]) -> float:
    return float(np.sqrt(np.mean((found.to_numpy() - list(centre.values())) ** 2)))
