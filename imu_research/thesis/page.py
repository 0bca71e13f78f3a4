"""Render the page of the thesis: its tables and figures with ours, its errata, and a verdict on each conclusion.

A letter marks each cell that differs from the printed one by more than a quarter, and refers to the reason. The figures
follow chapter 5: error per procedure, held-out motion, error before and after, and the comparison of methods.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from operator import itemgetter
from pathlib import Path

import numpy as np
import pandas as pd

from imu_logs.yaml_file import read_yaml
from imu_research.thesis.findings import CSS_CLASSES, Errors, agreements, conclusions, evidence, scatters, verdict_of
from imu_research.thesis.seeds import CAUSES, device_of
from imu_research.thesis.tables import (
    CONTINUOUS,
    DEVICES,
    RATES,
    SILENT,
    STOPS,
    Results,
    all_tables,
    in_words,
    read_printed,
)
from pipeline.core.files import JSON
from pipeline.core.records import SENSOR_UNITS
from pipeline.core.records.calibration import corrected, steps_of
from pipeline.evaluation.held_out.samples import samples_of_motion
from pipeline.output.pages.chart import AXES_LEGEND, Figure, Panel, SampleMarks, chart
from pipeline.output.pages.comparison import MeanWithUncertainty
from pipeline.output.pages.group_charts import Point, curves, stems
from pipeline.output.pages.held_out_section import held_out_over_time
from pipeline.output.pages.pages import MINUS, NOTHING, number, template
from pipeline.simulation.description import shipped_settings

PROCEDURES = {"accelerometer": (*STOPS, *CONTINUOUS), "gyroscope": RATES}
BELOW = {"accelerometer": "stop and go, rest in s; continuous, deg/s", "gyroscope": "rate, deg/s"}
FILTER_NAMES = {
    "staged": "RC low-pass",
    "same-gain": "the same gain without delay",
    "zero-phase": "run both ways, the gain twice",
    "unfiltered": "no filter",
}
OURS = ("printed", "ours, as printed", "ours, errata corrected")


def render(campaign: Path, folder: Path) -> str:
    """Render ``thesis.html`` from a campaign with ``printed/`` and ``seeds.csv``, and the folder of its results."""
    printed, results = campaign / "printed", Results(folder)
    rows = pd.read_csv(campaign / "seeds.csv")
    scatter = scatters(printed, rows)
    cells = all_tables(printed, results)
    explanations = read_yaml(printed / "explanations.yaml")
    cells["key"] = [key_of(explanations, c) if c["large"] else "" for c in cells.to_dict("records")]
    page: str = template("thesis.html").render(
        tables=cells.groupby("table", sort=False),
        text=_text,
        figures=all_figures(printed, results, rows, scatter),
        evidence=evidence(printed, results, rows),
        conclusions=conclusions(rows),
        verdict_of=verdict_of,
        kinds=CSS_CLASSES,
        difference=_difference,
        agreements=agreements(printed, results).to_dict("records"),
        explanations=sorted((e for e in explanations if e["key"] in set(cells["key"])), key=itemgetter("key")),
        scatter=scatter.to_dict("records"),
        devices=DEVICES,
        causes=CAUSES,
        seeds=rows["seed"].nunique(),
        cells=len(cells),
        large=cells["large"].sum(),
    )
    return page


def _text(value: float, digits: int, sign: str = "") -> str:
    """Format the value of a cell with ``digits`` decimals, and with its sign where ``sign`` is ``+``."""
    if math.isnan(value):
        return NOTHING
    rounded = f"{value:{sign}.{digits}f}"
    return rounded.lstrip("+-") if float(rounded) == 0.0 else rounded.replace("-", MINUS)


def _difference(estimate: MeanWithUncertainty) -> tuple[str, str]:
    """Format a difference and its interval, rounded to two digits of half the interval."""
    half = estimate.expanded_uncertainty or 0.0
    decimals = max(0, 1 - math.floor(math.log10(half))) if half > 0.0 else 3
    value, low, high = (f"{v:+z.{decimals}f}".replace("-", MINUS) for v in (estimate.value, *estimate.interval))
    return value, f"{low} to {high}"


def key_of(explanations: Sequence[JSON], cell: JSON) -> str:
    """Return the key of the first explanation whose pattern matches a cell; empty for none."""
    place = "|".join(cell[name] for name in ("table", "block", "row", "column"))
    return next((str(e["key"]) for e in explanations if re.search(e["where"], place)), "")


def all_figures(printed: Path, results: Results, rows: pd.DataFrame, scatter: pd.DataFrame) -> list[Figure]:
    """Return the figures in the order of the thesis's groups; ``rows``: of the study over seeds."""
    errors = read_printed(printed, "errors")
    printed_errors = errors[errors["metric"] == "mean_abs_error"].set_index("set")["after"]
    methods = read_printed(printed, "method_comparison").set_index(["sensor", "device", "method"])["mean_error_after"]
    out: list[Figure | None] = []
    for sensor, shown in (("accelerometer", ("stop-10s", "continuous-1dps")), ("gyroscope", ("gyro-100dps",))):
        for device in DEVICES:
            out.append(_motion(results, device, sensor, shown[0]))
            out += [_before_and_after(results, f"{device}-{p}", sensor) for p in shown]
            out.append(_per_procedure(results, printed_errors, device, sensor))
        procedure = "stop-1s" if sensor == "accelerometer" else "gyro-60dps"
        out.append(_before_and_after(results, f"mpu6050-1-mark2-{procedure}", sensor))
        out.append(_methods(results, methods[sensor], sensor))
    out += [_tables(results, printed_errors), _speed(rows), _scatter(scatter, "O"), _scatter(scatter, "S")]
    return [figure for figure in out if figure is not None]


def _motion(results: Results, device: str, sensor: str, procedure: str) -> Figure | None:
    """Draw the readings of the sensor in the held-out motion."""
    held_out = results.recordings(f"{device}-{procedure}-printed", "validation")
    if not held_out:
        return None
    recording = held_out[0]
    reading, x = np.asarray(recording.reading(sensor)), recording.time - recording.time[0]
    caption = f"{recording.samples} samples that reached the logger, in {number(float(x[-1]))} s; no fit sees them."
    finding = f"{DEVICES[device]}, {sensor}: the held-out motion"
    return chart(
        Figure(f"motion-{device}-{sensor}", finding, caption, AXES_LEGEND),
        f"{recording.samples} samples in {number(float(x[-1]))} s.",
        [Panel([SampleMarks(x, reading)], f"reading, {SENSOR_UNITS[sensor]}", 150)],
        "time, s",
    )


def _before_and_after(results: Results, name: str, sensor: str) -> Figure | None:
    """Draw the error e before and after calibration over the held-out motion."""
    held_out = results.recordings(f"{name}-printed", "validation")
    samples = samples_of_motion(sensor, held_out[0], SILENT, shipped_settings().table) if held_out else None
    if samples is None:
        return None
    calibrated = corrected(steps_of(results.correction(f"{name}-printed", sensor)) or (), samples.reading)
    before, after = (np.linalg.norm(v, axis=1) - samples.magnitude for v in (samples.reading, calibrated))
    drawn = held_out_over_time(f"held-out-{name}", sensor, held_out[0], before, after)
    means = [number(float(np.mean(np.abs(e)))) for e in (before, after)]
    finding = f"{_in_words(name)}: mean |e| goes from {means[0]} to {means[1]} {SENSOR_UNITS[sensor]}"
    return drawn._replace(finding=finding, caption="Staged, as printed; below, after alone.")


def _in_words(name: str) -> str:
    device = device_of(name)
    procedure = name.removeprefix(f"{device}-")
    table = ", home-made table" if procedure.startswith("mark2-") else ""
    return f"{DEVICES[device]}{table}, {in_words(procedure.removeprefix('mark2-'))}"


def _legend(texts: Iterable[str]) -> tuple[tuple[str, str], ...]:
    return tuple((f"c{i}", text) for i, text in enumerate(texts))


def _after(results: Results, name: str, sensor: str, methods: Sequence[str]) -> list[float]:
    """Return the mean |e| after calibration by each method; 0 where a unit failed."""
    return [float(np.nan_to_num(results.errors(f"{name}-{method}", sensor)[1])) for method in methods]


def _per_procedure(results: Results, printed_errors: pd.Series[float], device: str, sensor: str) -> Figure:
    """Draw the error after calibration by procedure: printed, and ours as printed and with errata corrected."""
    groups = {}
    for procedure in PROCEDURES[sensor]:
        name = f"{device}-{procedure}"
        groups[_short(procedure)] = [printed_errors[name], *_after(results, name, sensor, ("printed", "staged"))]
    finding = f"{DEVICES[device]}, {sensor}: error after calibration by procedure"
    figure = Figure(f"procedures-{device}-{sensor}", finding, legend=_legend(OURS))
    return stems(figure, groups, f"mean |e| after, {SENSOR_UNITS[sensor]}", BELOW[sensor])


def _short(procedure: str) -> str:
    value = procedure.partition("-")[2]
    return value.removesuffix("dps") if value.endswith("dps") else f"{value[:-1]} s"


def _methods(results: Results, printed_errors: pd.Series[float], sensor: str) -> Figure:
    """Draw the change of the error by the methods of tables 5.24 and 5.26."""
    if sensor == "accelerometer":
        procedure, other, methods = "stop-1s", "nonlinear_least_squares", ("printed", "staged", "least-squares")
        legend = ("printed: staged", "printed: least squares", "staged, as printed", "staged, errata corrected",
                  "least squares")  # fmt: skip
        finding = "Accelerometer: the corrected stages leave little more than least squares"
    else:
        procedure, other, methods = "gyro-20dps", "cholesky_lu", ("staged", "cholesky-printed", "cholesky")
        legend = ("printed: staged", "printed: Cholesky", "staged", "Cholesky and LU, forward matrix",
                  "Cholesky and LU, inverted")  # fmt: skip
        finding = "Gyroscope: inverted, Cholesky and LU leave what the stages leave"
    groups = {
        name: [printed_errors[device, m] for m in ("staged", other)]
        + _after(results, f"{device}-{procedure}", sensor, methods)
        for device, name in DEVICES.items()
    }
    figure = Figure(f"methods-{sensor}", finding, f"From the recordings of {procedure}.", _legend(legend))
    return stems(figure, groups, f"mean |e| after, {SENSOR_UNITS[sensor]}", "device")


def _tables(results: Results, printed_errors: pd.Series[float]) -> Figure:
    """Draw the error after calibration on both tables, as a share of the error before."""
    groups = {}
    for sensor, procedure, printed_before in (("accelerometer", "stop-1s", 0.069), ("gyroscope", "gyro-60dps", 1.724)):
        before = np.nan_to_num(results.errors(f"mpu6050-1-{procedure}-printed", sensor)[0], nan=1.0)
        short = {"accelerometer": "accel.", "gyroscope": "gyro"}[sensor]
        for table, infix in (("", ""), (", home", "mark2-")):
            name = f"mpu6050-1-{infix}{procedure}"
            ours = [v / before for v in _after(results, name, sensor, ("printed", "staged"))]
            groups[f"{short}{table}"] = [100.0 * v for v in (printed_errors[name] / printed_before, *ours)]
    figure = Figure("tables", "The home-made table leaves more of the error", "MPU6050 (1).", _legend(OURS))
    return stems(figure, groups, "after, % of before", "sensor; home: on the home-made table")


def _speed(rows: pd.DataFrame) -> Figure:
    """Draw the error of continuous rotation by rate, behind each filter."""
    errors = Errors(rows)
    points = []
    for method, name in FILTER_NAMES.items():
        for procedure in CONTINUOUS:
            mean = errors.mean(f"mpu6050-2-{procedure}", method)
            rate = _short(procedure)
            low, high = (v / 1000.0 for v in mean.interval)
            points.append(Point(rate, mean.value / 1000.0, interval=(low, high), x=float(rate), series=name))
    caption = (
        "MPU6050 (2), errata corrected; means over seeds with their 95 % intervals. The filter also acts on the "
        "held-out motion, so the level without filter contains more noise: compare how the errors grow with the rate."
    )
    finding = "With the filter's gain the error grows at 30 deg/s, and more where it runs twice"
    figure = Figure("speed", finding, caption, _legend(FILTER_NAMES.values()))
    return curves(figure, points, "mean |e| after, g", "rate, deg/s", named=False)


def _scatter(scatter: pd.DataFrame, quantity: str) -> Figure:
    """Draw the printed scatter, and the scatter that the selection of single samples explains, by cause."""
    by_device = scatter[scatter["quantity"] == quantity].set_index("device")[["printed", *CAUSES]]
    groups = {DEVICES[str(device)]: list(row) for device, row in by_device.iterrows()}
    finding = f"Scatter of {quantity}: printed, and by picking single samples"
    figure = Figure(f"scatter-{quantity}", finding, legend=_legend(by_device.columns))
    return stems(figure, groups, f"rms deviation of {quantity}", "device")
