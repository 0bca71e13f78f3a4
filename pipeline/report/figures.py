"""The charts of readings, model and held-out error, each with its finding, caption and legend."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.report.axes import span
from pipeline.report.bars import Bar, bars
from pipeline.report.figure import AXES, AXES_LEGEND, JSON, UNITS, Figure, plain
from pipeline.report.limits import final_step
from pipeline.report.numbers import number
from pipeline.report.residuals import Residual, white_noise
from pipeline.report.shapes import Band, Layer, Line, Samples
from pipeline.report.svg import Panel, chart
from pipeline.report.tables import step_label

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.records import Recording

MODEL_POINTS = 150
NOISE = 1.1  # of the band: a residual up to it is noise
ALIKE = 1.2  # factor between a held-out error of the validation and the diagnosis's own, for both to mean the same


def measurement_and_model(sensor: str, residual: Residual, sigma: NDArray[np.float64] | None) -> Figure:
    """Draw readings and model over a turn, and below them the residual of each axis with the band of +-2 sigma.

    Parameters
    ----------
    sensor : str
    residual : Residual
    sigma : (3,) array or None
        Standard deviation of the noise of a sample; from the residual's own scatter where it is None.
    """
    unit, motion = UNITS[sensor], residual.motion
    angle = motion.angle is not None and np.ptp(motion.angle) > 1.0
    x = motion.angle if angle and motion.angle is not None else motion.time
    source = "" if sigma is not None else " Its σ is taken from the sample-to-sample scatter."
    sigma = white_noise(residual.error) if sigma is None else sigma
    layers: list[Layer] = [Samples(x, residual.reading)]
    every = slice(None, None, -(-len(x) // MODEL_POINTS))  # the model has no noise whose extremes could be lost
    few = x[every]
    layers += [Line(few, residual.predicted[every, i], 5, "model") for i in range(3)]
    ends = np.array([x.min(), x.max()])
    top = max(float(np.abs(residual.error).max()), 2.2 * float(sigma.max()))
    panels = [Panel(layers, f"reading, {unit}")]
    for i in range(3):
        band = Band(ends, np.full(2, -2 * sigma[i]), np.full(2, 2 * sigma[i]), 5)
        panels.append(
            Panel(
                [band, Samples(x, residual.error[:, i], i, mean=True)],
                f"{AXES[i]}, {unit}",
                height=56,
                limits=(-top, top),
            ),
        )
    name = residual.recording.name
    outside = float(np.mean(np.abs(residual.error) > 2 * sigma))
    caption = (
        f"{100 * outside:.1f} % of the residuals lie outside the band; white noise alone puts 4.6 % there.{source}"
    )
    ratio = max(r / s for r, s in zip(rms(residual.error), sigma, strict=True))
    finding = f"{name}: reading minus model is {number(ratio)} × the noise" + (
        "" if ratio > NOISE else ", so nothing is left"
    )
    svg = chart(
        f"{sensor}-{name}",
        f"{sensor}: measurement and model. {finding}",
        f"Root mean square of the residual: {', '.join(number(r) for r in rms(residual.error))} {unit} on x, y, z.",
        panels,
        "table angle, deg" if angle else "time, s",
        angle=bool(angle),
    )
    return Figure(svg, caption, (*AXES_LEGEND, ("c5", "model")), finding)


def rms(error: NDArray[np.float64]) -> list[float]:
    """Return the root mean square of each column."""
    values: list[float] = np.sqrt(np.mean(error**2, axis=0)).tolist()
    return values


def held_out_over_time(
    sensor: str, recording: Recording, raw: NDArray[np.float64], calibrated: NDArray[np.float64], floor: float | None
) -> Figure:
    """Draw the error of the magnitude in held-out motion before and after calibration.

    Parameters
    ----------
    sensor : str
    recording : Recording
    raw, calibrated : (n,) array, unit of the sensor
        Magnitude minus reference.
    floor : float or None
        What noise alone would leave.
    """
    unit, x = UNITS[sensor], recording.time - recording.time[0]
    zoom: list[Layer] = [Samples(x, calibrated, 2, mean=True)]
    if floor:
        ends = np.array([x.min(), x.max()])
        zoom.insert(0, Band(ends, np.full(2, -2 * floor), np.full(2, 2 * floor), 5))
    panels = [
        Panel([Samples(x, raw, 3), Samples(x, calibrated, 2)], f"error, {unit}", 120, {"": 0.0}),
        Panel(zoom, f"after, {unit}", 80, limits=span([calibrated, np.array([-2.2, 2.2]) * (floor or 0.0)])),
    ]
    before, after = rms(raw[:, None])[0], rms(calibrated[:, None])[0]
    finding = f"In {recording.name} the error goes from {number(before)} to {number(after)} {unit}"
    svg = chart(
        f"{sensor}-held-out",
        f"{sensor}: {finding}",
        f"Root mean square {number(before)} {unit} before, {number(after)} after.",
        panels,
        "time, s",
    )
    what = "specific force minus gravity" if sensor == "accelerometer" else "angular rate minus the table's rate"
    return Figure(
        svg,
        f"Magnitude of the {what}, before and after calibration, in a recording that no fit saw; below, after alone "
        "with the band of ±2 noise floors.",
        (("c3", "before"), ("c2", "after")),
        finding,
    )


def staircase(sensor: str, held_out: JSON, found: JSON, *, vector: bool) -> Figure | None:
    """Draw the held-out error step by step, raw to stages to calibrated to effects, above the noise floor.

    Parameters
    ----------
    sensor : str
    held_out, found : dict
        The sensor's parts of validation and diagnosis; effects that the diagnosis selected continue the stairs.
    vector : bool
        The error of the vector instead of the magnitude's. None is returned where it is not known.
    """
    key, floor_key = ("vector_rms_error", "vector_noise_floor") if vector else ("rms_error", "noise_floor")
    steps, floor, unit = held_out.get("steps", []), held_out.get(floor_key), UNITS[sensor]
    if not steps or all(s.get(key) is None for s in steps):
        return None
    rows = [Bar(step_label(s["name"]), s.get(key), 3 if s["name"] == "raw" else 2) for s in steps]
    if vector or all(s.get("vector_rms_error") is None for s in steps):
        rows += _if_added(found, final_step(held_out).get(key))
    kind, reached = "vector" if vector else "magnitude", final_step(held_out).get(key)
    finding = f"The error of the {kind} ends at {number(reached)} {unit}"
    if reached and floor:
        finding += f", {number(reached / floor)} × the noise floor"
    if rows[-1].colour == 4:
        finding += f"; with what is missing, at {number(rows[-1].value)}"
    svg = bars(
        f"{sensor}-staircase-{kind}",
        f"{sensor}: {finding}",
        "; ".join(f"{r.label} {number(r.value)}" for r in rows) + f"; noise floor {number(floor)} {unit}",
        rows,
        f"root mean square error, {unit} (logarithmic)",
        levels={"noise floor": floor} if floor else {},
    )
    caption = f"Held-out error of the {kind}, as each step is added; the line is what noise alone leaves."
    added = "if it were added" + (" with the suggested shape" if found.get("suggested_effect") else "")
    return Figure(svg, caption, (("c4", added),) if rows[-1].colour == 4 else (), finding)


def _if_added(found: JSON, reached: float | None) -> list[Bar]:
    """Return the steps that the effects which a diagnosis selected would be, where its errors continue the stairs."""
    entries = {r["effect"]: r for r in found.get("ranking") or []}
    chosen = [entries[name] for name in found.get("selected") or [] if name in entries]
    if not chosen or not reached or any(r.get("held_out_error_after") is None for r in chosen):
        return []
    if not 1.0 / ALIKE < chosen[0]["held_out_error_before"] / reached < ALIKE:
        return []
    return [Bar(f"+ {plain(r['effect'])}, if added", r["held_out_error_after"], 4) for r in chosen]
