"""The charts of what a residual depends on: covariates, the worst first, and harmonics of the turn."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.report.bars import columns
from pipeline.report.figure import AXES, AXES_LEGEND, JSON, UNITS, Figure
from pipeline.report.harmonics import harmonic_noise, harmonics
from pipeline.report.numbers import number
from pipeline.report.residuals import BinnedMean, Residual, covariates, white_noise
from pipeline.report.shapes import Band, Layer, Means
from pipeline.report.svg import Panel, chart

if TYPE_CHECKING:
    from numpy.typing import NDArray

FLAT = 2.0  # mean square of the means over noise and wander, below which they are flat


def residual_figures(sensor: str, found: list[Residual], noise: JSON | None) -> list[Figure]:
    """Draw binned means of the residual against each covariate (worst first), and its harmonics of the turn.

    Parameters
    ----------
    sensor : str
    found : list of Residual
    noise : dict or None
        The noise model: ``white, wander, correlation_time_s``.
    """
    wander = np.array((noise or {}).get("wander") or [0.0] * 3, float)
    time = float((noise or {}).get("correlation_time_s") or 100.0)
    figures = [_covariate(sensor, label, mean, wander) for label, mean in covariates(found, wander).items()]
    for residual in found:
        amplitudes = harmonics(residual)
        if amplitudes is not None:
            level = harmonic_noise(residual, _white(residual, noise), wander, time)
            figures.append(_harmonics(sensor, residual.recording.name, amplitudes, level))
    return figures


def _white(residual: Residual, noise: JSON | None) -> NDArray[np.float64]:
    """Return the white noise of a sample after the filter, of the noise model where there is one."""
    if not noise or not noise.get("white"):
        return white_noise(residual.error)
    return float(residual.recording.filter.get("noise_gain", 1.0)) * np.array(noise["white"], float)


def _covariate(sensor: str, label: str, mean: BinnedMean, wander: NDArray[np.float64]) -> Figure:
    unit, name = UNITS[sensor], label.split(",", maxsplit=1)[0]
    words = name.replace("force ", "force along ")
    excess = mean.excess(wander)
    top = 1.05 * max(float(np.nanmax(np.abs(mean.mean) + 2 * mean.error)), 2.2 * float(wander.max()))
    ends = mean.centre[[0, -1]]
    panels = []
    for i in range(3):
        band: list[Layer] = []
        if wander[i] > 0:
            band.append(Band(ends, np.full(2, -2.0 * wander[i]), np.full(2, 2.0 * wander[i]), 5))
        layers: list[Layer] = [*band, Means(mean.centre, mean.mean[:, i], 2 * mean.error[:, i], i)]
        panels.append(Panel(layers, f"{AXES[i]}, {unit}", height=64, levels={"": 0.0}, limits=(-top, top)))
    finding = _finding(words, mean, wander, excess, (unit, label.rsplit(", ", maxsplit=1)[-1]))
    svg = chart(
        f"{sensor}-residual-{name.replace(' ', '-')}",
        f"{sensor}: {finding}",
        f"Means in bins; on the worst axis their mean square is {number(excess)} times what noise and wander give.",
        panels,
        label,
        angle=name == "angle",
    )
    return Figure(svg, finding=finding, quiet=excess < FLAT)


def _finding(words: str, mean: BinnedMean, wander: NDArray[np.float64], excess: float, units: tuple[str, str]) -> str:
    if excess < FLAT:
        return f"Flat against {words}, within the noise"
    spread = np.abs(mean.mean) / np.sqrt(mean.error**2 + wander**2)
    row, axis = np.unravel_index(int(np.nanargmax(spread)), spread.shape)
    at, size = f"{number(float(mean.centre[row]))} {units[1]}", f"{number(float(mean.mean[row, axis]))} {units[0]}"
    return f"Not flat against {words}: {size} on {AXES[axis]} at {at}, {number(float(spread[row, axis]), 2)} σ"


def _harmonics(sensor: str, name: str, amplitudes: NDArray[np.float64], level: NDArray[np.float64]) -> Figure:
    unit = UNITS[sensor]
    ratio = amplitudes / np.maximum(level[:, None], 1e-300)
    ratio[0] = 0.0  # a bias
    cycles, axis = np.unravel_index(int(np.argmax(ratio)), ratio.shape)
    if ratio.max() > 1.0:
        size = number(float(amplitudes[cycles, axis]), 2)
        finding = (
            f"{name}: {cycles} cycle{'s' if cycles != 1 else ''} a turn on {AXES[axis]}, {size} {unit}, above the noise"
        )
    else:
        finding = f"{name}: no harmonic of the turn above the noise"
    svg = columns(
        f"{sensor}-harmonics-{name}",
        f"{sensor}: {finding}",
        "; ".join(f"{k} cycles: {', '.join(number(v, 2) for v in row)}" for k, row in enumerate(amplitudes.tolist())),
        {str(k): row for k, row in enumerate(amplitudes.tolist())},
        f"amplitude, {unit}",
        x_label="cycles a turn",
        levels=level.tolist(),
    )
    return Figure(svg, legend=AXES_LEGEND, finding=finding, quiet=ratio.max() <= 1.0)
