"""The charts of a unit's page, each with its caption and legend."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.report.axes import span
from pipeline.report.bars import Bar, bars, columns
from pipeline.report.numbers import number
from pipeline.report.residuals import BinnedMean, Residual, covariates, harmonics, white_noise
from pipeline.report.shapes import Band, Layer, Line, Means, Samples
from pipeline.report.svg import Panel, chart
from pipeline.report.tables import step_label

if TYPE_CHECKING:
    from markupsafe import Markup
    from numpy.typing import NDArray

    from pipeline.records import Recording

JSON = dict[str, Any]
AXES = "xyz"
UNITS = {"accelerometer": "g", "gyroscope": "deg/s"}
AXES_LEGEND = (("c0", "x"), ("c1", "y"), ("c2", "z"))


@dataclass(frozen=True)
class Figure:
    """A chart, a sentence below it, and its legend as (CSS class, text) pairs."""

    svg: Markup
    caption: str
    legend: tuple[tuple[str, str], ...] = ()


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
    source = "of the noise model" if sigma is not None else "from its own sample-to-sample scatter"
    sigma = white_noise(residual.error) if sigma is None else sigma
    layers: list[Layer] = [Samples(x, residual.reading[:, i], i) for i in range(3)]
    layers += [Line(x, residual.predicted[:, i], 5, "model") for i in range(3)]
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
        f"{name}: readings and model (thin line); below, reading minus model, its mean over short stretches, and the "
        f"band of ±2 σ {source}. "
        f"{100 * outside:.1f} % of the residuals lie outside of it; white noise alone puts 4.6 % there."
    )
    svg = chart(
        f"{sensor}-{name}",
        f"{sensor}, {name}: measurement and model",
        f"Root mean square of the residual: {', '.join(number(r) for r in rms(residual.error))} {unit} on x, y, z.",
        panels,
        "table angle, deg" if angle else "time, s",
        angle=bool(angle),
    )
    return Figure(svg, caption, (*AXES_LEGEND, ("c5", "model")))


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
    svg = chart(
        f"{sensor}-held-out",
        f"{sensor}: error in held-out motion",
        f"Root mean square {number(rms(raw[:, None])[0])} {unit} before, {number(rms(calibrated[:, None])[0])} after.",
        panels,
        "time, s",
    )
    what = "specific force minus gravity" if sensor == "accelerometer" else "angular rate minus the table's rate"
    return Figure(
        svg,
        f"{recording.name}, which no fit saw: magnitude of the {what}, before and after calibration; below, after "
        "alone with the band of ±2 noise floors.",
        (("c3", "before"), ("c2", "after")),
    )


def staircase(sensor: str, held_out: JSON, *, vector: bool) -> Figure | None:
    """Draw the held-out error step by step, raw to stages to calibrated to effects, above the noise floor.

    ``vector`` chooses the error of the vector instead of the magnitude's; None where it is not known.
    """
    key, floor_key = ("vector_rms_error", "vector_noise_floor") if vector else ("rms_error", "noise_floor")
    steps, floor = held_out.get("steps", []), held_out.get(floor_key)
    if not steps or all(s.get(key) is None for s in steps):
        return None
    rows = [Bar(step_label(s["name"]), s.get(key), 3 if s["name"] == "raw" else 2) for s in steps]
    kind = "vector" if vector else "magnitude"
    svg = bars(
        f"{sensor}-staircase-{kind}",
        f"{sensor}: held-out error of the {kind}, step by step",
        "; ".join(f"{r.label} {number(r.value)}" for r in rows) + f"; noise floor {number(floor)} {UNITS[sensor]}",
        rows,
        f"root mean square error, {UNITS[sensor]} (logarithmic)",
        levels={"noise floor": floor} if floor else {},
    )
    return Figure(svg, f"Held-out error of the {kind}, as each step is added; the line is what noise alone leaves.")


def ranking(sensor: str, diagnosis: JSON) -> Figure | None:
    """Draw the evidence for each effect that helps: its delta BIC on a logarithmic axis, with the gate at 10."""
    found = [r for r in diagnosis.get("ranking", []) if (r.get("delta_bic") or 0.0) > 1.0][:12]
    if not found:
        return None
    rows = [
        Bar(
            r["effect"].replace("_", " ")
            + "".join(f" (like {a['effect'].replace('_', ' ')})" for a in (r.get("look_alikes") or [])[:1]),
            r["delta_bic"],
            2 if r["effect"] in diagnosis.get("selected", []) else 4,
        )
        for r in found
    ]
    svg = bars(
        f"{sensor}-ranking",
        f"{sensor}: evidence for missing effects",
        "; ".join(f"{r.label} {number(r.value)}" for r in rows),
        rows,
        "ΔBIC (logarithmic): larger is stronger evidence",
        levels={"strong evidence": 10.0},
    )
    return Figure(svg, "Evidence for each effect beyond the configured model; above 10 is strong.")


def residual_figures(sensor: str, found: list[Residual]) -> list[Figure]:
    """Draw binned means of the residual against each covariate (worst first), and its harmonics of the turn."""
    figures = [_covariate(sensor, label, mean) for label, mean in covariates(found).items()]
    for residual in found:
        amplitudes = harmonics(residual)
        if amplitudes is not None:
            figures.append(_harmonics(sensor, residual, amplitudes))
    return figures


def _covariate(sensor: str, label: str, mean: BinnedMean) -> Figure:
    unit, slug = UNITS[sensor], label.split(",", maxsplit=1)[0]
    top = 1.05 * float(np.nanmax(np.abs(mean.mean) + 2 * mean.error))
    panels = [
        Panel(
            [Means(mean.centre, mean.mean[:, i], 2 * mean.error[:, i], i)],
            f"{AXES[i]}, {unit}",
            height=64,
            levels={"": 0.0},
            limits=(-top, top),
        )
        for i in range(3)
    ]
    svg = chart(
        f"{sensor}-residual-{slug}",
        f"{sensor}: residual against {slug}",
        f"Means in bins; on the worst axis their mean square is {number(mean.excess)} times what noise gives.",
        panels,
        label,
        angle=slug == "angle",
    )
    return Figure(svg, f"Mean residual against {slug}, with ±2 standard errors; flat at zero if nothing is missing.")


def _harmonics(sensor: str, residual: Residual, amplitudes: NDArray[np.float64]) -> Figure:
    name = residual.recording.name
    svg = columns(
        f"{sensor}-harmonics-{name}",
        f"{sensor}, {name}: harmonics of the residual",
        "; ".join(f"{k} cycles: {', '.join(number(v, 2) for v in row)}" for k, row in enumerate(amplitudes.tolist())),
        {str(k): row for k, row in enumerate(amplitudes.tolist())},
        f"amplitude, {UNITS[sensor]}",
        x_label="cycles a turn",
    )
    caption = (
        f"{name}: residual by cycles a turn. 1: misalignment, tilt, encoder; 2 and 4: quadratic nonlinearity, "
        "asymmetry; 3: cubic nonlinearity."
    )
    return Figure(svg, caption, AXES_LEGEND)
