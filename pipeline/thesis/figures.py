"""The figures of the thesis's chapter 5, drawn from the campaign.

Error per procedure, held-out motion, error before and after for each device and table, and the comparison of methods.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.estimation.correction import apply_correction
from pipeline.records import SENSOR_UNITS
from pipeline.report.chart import AXES_LEGEND, Figure, Panel, Samples, chart
from pipeline.report.group_charts import Point, curves, stems
from pipeline.report.held_out_section import held_out_over_time
from pipeline.report.numbers import number
from pipeline.thesis.conclusions import Errors
from pipeline.thesis.results import CONTINUOUS, DEVICES, RATES, STOPS, in_words, procedure_of
from pipeline.thesis.seeds import CAUSES, device_of
from pipeline.thesis.tables import read_printed
from pipeline.validation.samples import samples_of_motion

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    import pandas as pd

    from pipeline.records import Noise
    from pipeline.thesis.agreement import Scatter
    from pipeline.thesis.results import Results

PROCEDURES = {"accelerometer": (*STOPS, *CONTINUOUS), "gyroscope": RATES}
BELOW = {
    "accelerometer": "stop and go, rest in s; continuous, deg/s",
    "gyroscope": "rate, deg/s",
}
FILTERS = {
    "staged": "RC low-pass",
    "same-gain": "the same gain without delay",
    "zero-phase": "run both ways, the gain twice",
    "unfiltered": "no filter",
}
PRINTED_AND_OURS = ("printed", "ours, as printed", "ours, errata corrected")


def all_figures(
    printed: Path, results: Results, rows: pd.DataFrame, scatter: Sequence[Scatter], noise: Noise
) -> list[Figure]:
    """Return the figures in the order of the thesis's groups, numbered on the page.

    Parameters
    ----------
    printed : Path
    results : Results
    rows : DataFrame
        Of the study over seeds.
    scatter : sequence of Scatter
    noise : Noise
        That samples of held-out motion are given; it does not matter for what is drawn.
    """
    told = _printed_errors(printed)
    out: list[Figure | None] = []
    for sensor, shown in (("accelerometer", ("stop-10s", "continuous-1dps")), ("gyroscope", ("gyro-100dps",))):
        for device in DEVICES:
            out.append(_motion(results, device, sensor, shown[0]))
            out += [_before_and_after(results, f"{device}-{p}-printed", sensor, noise) for p in shown]
            out.append(_per_procedure(results, told, device, sensor))
        own = "stop-1s" if sensor == "accelerometer" else "gyro-60dps"
        out.append(_before_and_after(results, f"mpu6050-1-mark2-{own}-printed", sensor, noise))
        out.append(_methods(results, printed, sensor))
    out.append(_tables(results, told))
    out.append(_speed(rows))
    out += [_scatter(scatter, quantity) for quantity in ("O", "S")]
    return [figure for figure in out if figure is not None]


def _printed_errors(printed: Path) -> dict[tuple[str, str, str], float]:
    """Return the printed mean |e| after, by device, table and procedure."""
    rows = [r for t in read_printed(printed / "errors.csv").values() for r in t if r["metric"] == "mean_abs_error"]
    return {(r["device"].lower(), r["rate_table"], procedure_of(r)): float(r["after"]) for r in rows}


def _motion(results: Results, device: str, sensor: str, procedure: str) -> Figure | None:
    """Draw what the sensor read in the held-out motion."""
    recording = next((r for r in results.recordings(f"{device}-{procedure}-printed") if r.role == "validation"), None)
    if recording is None:
        return None
    reading, x = np.asarray(recording.reading(sensor)), recording.time - recording.time[0]
    caption = f"{recording.samples} samples that reached the logger, in {number(float(x[-1]))} s; no fit sees them."
    finding = f"{DEVICES[device]}, {sensor}: the held-out motion"
    return chart(
        Figure(f"motion-{device}-{sensor}", finding, caption, AXES_LEGEND),
        f"{recording.samples} samples in {number(float(x[-1]))} s.",
        [Panel([Samples(x, reading)], f"reading, {SENSOR_UNITS[sensor]}", 150)],
        "time, s",
    )


def _before_and_after(results: Results, unit: str, sensor: str, noise: Noise) -> Figure | None:
    """Draw e before and after calibration over the held-out motion."""
    recording = next((r for r in results.recordings(unit) if r.role == "validation"), None)
    if recording is None:
        return None
    samples = samples_of_motion(sensor, recording, noise, {"gravity_g": 1.0})
    if samples is None:
        return None
    corrected = apply_correction(results.correction(unit, sensor), samples.reading)
    before, after = (np.linalg.norm(v, axis=1) - samples.magnitude for v in (samples.reading, corrected))
    name = unit.removesuffix("-printed")
    drawn = held_out_over_time(f"held-out-{name}", sensor, recording, before, after)
    means = [number(float(np.mean(np.abs(e)))) for e in (before, after)]
    finding = f"{_in_words(name)}: mean |e| goes from {means[0]} to {means[1]} {SENSOR_UNITS[sensor]}"
    return replace(drawn, finding=finding, caption="Staged, as printed; below, after alone.")


def _in_words(name: str) -> str:
    device = device_of(name)
    table, procedure = "", name.removeprefix(f"{device}-")
    if procedure.startswith("mark2-"):
        table, procedure = ", home-made table", procedure.removeprefix("mark2-")
    return f"{DEVICES[device]}{table}, {in_words(procedure)}"


def _per_procedure(results: Results, told: dict[tuple[str, str, str], float], device: str, sensor: str) -> Figure:
    """Draw the error after calibration by procedure: printed, and ours in both readings."""
    groups = {}
    for procedure in PROCEDURES[sensor]:
        ours = [results.error(f"{device}-{procedure}-{m}", sensor) or 0.0 for m in ("printed", "staged")]
        groups[_short(procedure)] = [told[device, "acutronic", procedure], *ours]
    finding = f"{DEVICES[device]}, {sensor}: error after calibration by procedure"
    figure = Figure(f"procedures-{device}-{sensor}", finding, legend=_legend(PRINTED_AND_OURS))
    return stems(figure, groups, f"mean |e| after, {SENSOR_UNITS[sensor]}", BELOW[sensor])


def _legend(texts: Iterable[str]) -> tuple[tuple[str, str], ...]:
    return tuple((f"c{i}", text) for i, text in enumerate(texts))


def _short(procedure: str) -> str:
    value = procedure.partition("-")[2]
    return value.removesuffix("dps") if value.endswith("dps") else f"{value[:-1]} s"


def _methods(results: Results, printed: Path, sensor: str) -> Figure:
    """Draw the change of the error by the methods of tables 5.24 and 5.26."""
    rows = [r for t in read_printed(printed / "method_comparison.csv").values() for r in t if r["sensor"] == sensor]
    told = {(r["device"].lower(), r["method"] == "staged"): float(r["mean_error_after"]) for r in rows}
    other = {"accelerometer": ("stop-1s", ("printed", "staged", "least-squares")),
             "gyroscope": ("gyro-20dps", ("staged", "cholesky-printed", "cholesky"))}  # fmt: skip
    procedure, methods = other[sensor]
    groups = {
        name: [told[device, True], told[device, False]]
        + [results.error(f"{device}-{procedure}-{m}", sensor) or 0.0 for m in methods]
        for device, name in DEVICES.items()
    }
    names = {
        "accelerometer": ("staged, as printed", "staged, errata corrected", "least squares"),
        "gyroscope": ("staged", "Cholesky and LU, forward matrix", "Cholesky and LU, inverted"),
    }[sensor]
    printed_names = ("printed: staged", "printed: least squares" if sensor == "accelerometer" else "printed: Cholesky")
    finding = (
        "Accelerometer: the corrected stages leave little more than least squares"
        if sensor == "accelerometer"
        else "Gyroscope: inverted, Cholesky and LU leave what the stages leave"
    )
    caption, legend = f"From the recordings of {procedure}.", _legend((*printed_names, *names))
    figure = Figure(f"methods-{sensor}", finding, caption, legend)
    return stems(figure, groups, f"mean |e| after, {SENSOR_UNITS[sensor]}", "device")


def _tables(results: Results, told: dict[tuple[str, str, str], float]) -> Figure:
    """Draw the error after calibration on both tables, as a share of that before."""
    groups = {}
    for sensor, procedure in (("accelerometer", "stop-1s"), ("gyroscope", "gyro-60dps")):
        before = results.error(f"mpu6050-1-{procedure}-printed", sensor, "raw") or 1.0
        printed_before = {"accelerometer": 0.069, "gyroscope": 1.724}[sensor]
        for table, infix in (("acutronic", ""), ("mark2", "mark2-")):
            ours = [results.error(f"mpu6050-1-{infix}{procedure}-{m}", sensor) or 0.0 for m in ("printed", "staged")]
            share = [told["mpu6050-1", table, procedure] / printed_before, *(v / before for v in ours)]
            short = {"accelerometer": "accel.", "gyroscope": "gyro"}[sensor]
            groups[f"{short}{', home' if infix else ''}"] = [100.0 * v for v in share]
    figure = Figure("tables", "The home-made table leaves more of the error", "MPU6050 (1).", _legend(PRINTED_AND_OURS))
    return stems(figure, groups, "after, % of before", "sensor; home: on the home-made table")


def _speed(rows: pd.DataFrame) -> Figure:
    """Draw the error of continuous rotation by rate, behind each filter."""
    errors = Errors(rows)
    points = []
    for method, name in FILTERS.items():
        for procedure in CONTINUOUS:
            mean = errors.mean(f"mpu6050-2-{procedure}", method)
            rate = float(procedure.split("-")[1].removesuffix("dps"))
            points.append(Point(_short(procedure), mean.value, interval=mean.interval, x=rate, series=name))
    caption = (
        "MPU6050 (2), errata corrected; means over seeds with their 95 % intervals. The filter is on the turns and on "
        "the held-out motion, so without one more noise is left there; how an error grows with the rate is its own."
    )
    finding = "With the filter's gain the error grows at 30 deg/s, and more where it runs twice"
    figure = Figure("speed", finding, caption, _legend(FILTERS.values()))
    return curves(figure, points, "mean |e| after, g", "rate, deg/s", named=False)


def _scatter(scatter: Sequence[Scatter], quantity: str) -> Figure:
    """Draw the printed scatter beside what picking explains, cause by cause."""
    own = [s for s in scatter if s.quantity == quantity]
    groups = {DEVICES[s.device]: [s.printed, *s.seeds.values()] for s in own}
    finding = f"Scatter of {quantity}: printed, and by picking single samples"
    figure = Figure(f"scatter-{quantity}", finding, legend=_legend(("printed", *CAUSES)))
    return stems(figure, groups, f"rms deviation of {quantity}", "device")
