"""The Allan deviation at rest, beside what the noise model and the data sheet say.

    sigma^2(tau) = white^2 dt / tau + (2 s^2 T / tau) (1 - (T / (2 tau)) (3 - 4 e^(-tau/T) + e^(-2 tau/T)))

where

    white : standard deviation of one sample's white noise; a data sheet's density D gives white^2 dt = D^2 / 2
    dt    : sampling interval, s
    s, T  : standard deviation and correlation time of the bias wander (first-order Gauss-Markov)

Source: IEEE Std 952-1997, annex C. The rest is the static recording, else the longest rest of all recordings. It is
averaged to at most ``LONGEST`` values beyond the first decades, so that an hour's rest costs no more than a minute's.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.report.figure import AXES_LEGEND, JSON, UNITS, Figure
from pipeline.report.numbers import number
from pipeline.report.shapes import Layer, Line
from pipeline.report.svg import Panel, chart
from pipeline.signal.allan import allan_deviation
from pipeline.signal.rests import rests_from_table

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.records import Recording

FEWEST, LONGEST = 60, 4096
GAP, UNEVEN = 1.5, 0.5  # of the median interval: a gap, and a scatter that no average over equal times stands for
PER_DECADE = 8
SURE = 4.0  # averages of the longest time drawn; of fewer the deviation is a guess
# Factor between both from which a cause is named: the MPU-6050's digital filters of 5 to 260 Hz change the white noise
# of a sample by sqrt(52) = 7 at one sampling rate, a range by 2 to 8.
FAR = 5.0
NEAR = 1.3  # factor between what was found and a data sheet that counts as the same


def allan(
    sensor: str, recordings: list[Recording], noise: JSON | None, sheet: JSON, wander: JSON | None
) -> Figure | None:
    """Draw the Allan deviation of each axis; None where no recording holds a rest.

    Parameters
    ----------
    sensor : str
    recordings : list of Recording
    noise : dict or None
        The noise model: ``white, wander, correlation_time_s, source``.
    sheet : dict
        The sensor's section of the configuration.
    wander : dict or None
        That of the diagnosis: what the fit needed.
    """
    found = longest_rest(sensor, recordings)
    if found is None:
        return None
    recording, values = found
    tau, deviation = deviations(values, recording.interval)
    sure = tau <= len(values) * recording.interval / SURE
    tau, deviation = tau[sure], deviation[sure]
    layers: list[Layer] = [Line(np.log10(tau), np.log10(np.maximum(deviation[:, c], 1e-300)), c) for c in range(3)]
    curves = _curves(noise, sheet, recording.interval, tau)
    layers += [Line(np.log10(tau), np.log10(v), colour, style) for _, v, colour, style in curves]
    finding, words = _finding(sensor, noise, sheet, recording.interval), _words(sensor, noise, wander)
    at = [0, len(tau) // 2, len(tau) - 1]
    values_said = ", ".join(
        f"{number(float(deviation[k].mean()))} {UNITS[sensor]} at {number(float(tau[k]))} s" for k in at
    )
    svg = chart(
        f"{sensor}-allan",
        f"{sensor}: {finding}",
        f"Allan deviation, mean of the axes: {values_said}.",
        [Panel(layers, f"Allan deviation, {UNITS[sensor]}", 190, logarithmic=True)],
        "averaging time, s",
        logarithmic=True,
    )
    filtered = "" if recording.filter.get("name", "none") == "none" else ", after the filter"
    legend = (*AXES_LEGEND, *((f"c{colour}", name) for name, _, colour, _ in curves))
    return Figure(
        svg,
        f"{recording.name}, {number(values.shape[0] * recording.interval)} s at rest{filtered}. {words}",
        legend,
        finding,
    )


def longest_rest(sensor: str, recordings: list[Recording]) -> tuple[Recording, NDArray[np.float64]] | None:
    """Return the recording with the longest rest, a static one if there is one, and the readings in it."""
    usable = [r for r in recordings if r.role != "validation" and r.reading(sensor) is not None and not _uneven(r)]
    best: tuple[Recording, NDArray[np.float64]] | None = None
    for recording in sorted(usable, key=lambda r: r.role != "static"):
        if best is not None and best[0].role == "static" != recording.role:
            break
        reading = recording.reading(sensor)
        assert reading is not None  # noqa: S101
        spans = [(0, recording.samples)]
        if recording.role != "static":
            spans = [(r.start, r.stop) for r in rests_from_table(recording) if r.accepted]
        for start, stop in spans:
            values = reading[start:stop]
            values = values[np.isfinite(values).all(axis=1)]
            if len(values) >= FEWEST and (best is None or len(values) > len(best[1])):
                best = recording, values
    return best


def _uneven(recording: Recording) -> bool:
    """Return whether intervals scatter too much for averages over equal times."""
    steps = np.diff(recording.time_ns) / (1e9 * recording.interval) if recording.samples > 1 else np.ones(1)
    within = steps[steps <= GAP]
    return bool(np.sqrt(np.mean((within - 1.0) ** 2)) > UNEVEN)


def deviations(values: NDArray[np.float64], interval: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return averaging times and overlapping Allan deviations of (n, 3) readings; long rests by averages of samples."""
    tau, deviation = allan_deviation(values[:LONGEST], interval, PER_DECADE)
    together = -(-len(values) // LONGEST)
    if together == 1:
        return tau, deviation
    whole = len(values) // together
    means = values[: whole * together].reshape(whole, together, 3).mean(axis=1)
    late, longer = allan_deviation(means, interval * together, PER_DECADE)
    near = tau < late[0] * 4.0
    far = late >= late[0] * 4.0
    return np.concatenate([tau[near], late[far]]), np.concatenate([deviation[near], longer[far]])


def expected(white_density: float, wander: float, time: float, tau: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the Allan deviation of white noise and Gauss-Markov wander: (m,) array.

    Parameters
    ----------
    white_density : float
        ``white sqrt(dt)``.
    wander, time : float
        Standard deviation, and correlation time in s.
    tau : (m,) array, s
    """
    x = tau / time
    bend = (3.0 - 4.0 * np.exp(-x) + np.exp(-2.0 * x)) / (2.0 * x)
    variance = white_density**2 / tau + 2.0 * wander**2 / x * np.maximum(1.0 - bend, 0.0)
    return np.asarray(np.sqrt(variance), np.float64)


Curve = tuple[str, "NDArray[np.float64]", int, str]


def _curves(noise: JSON | None, sheet: JSON, interval: float, tau: NDArray[np.float64]) -> list[Curve]:
    """Return the lines of the noise model and of the data sheet."""
    out: list[Curve] = []
    if noise and noise.get("white"):
        white = _rms(noise["white"]) * np.sqrt(interval)
        wander, time = _rms(noise.get("wander") or [0.0]), float(noise.get("correlation_time_s") or 100.0)
        out.append(("noise model", expected(white, wander, time, tau), 5, "model"))
        if wander > 0:
            out.append(("its white noise alone", white / np.sqrt(tau), 4, "dashed"))
    if sheet.get("noise_density"):
        wander, time = float(sheet.get("bias_wander") or 0.0), float(sheet.get("wander_time_s") or 100.0)
        out.append(
            ("data sheet", expected(float(sheet["noise_density"]) / np.sqrt(2.0), wander, time, tau), 3, "dashed")
        )
    return out


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _finding(sensor: str, noise: JSON | None, sheet: JSON, interval: float) -> str:
    """Return what the white noise is, and whether the data sheet says the same."""
    if not noise or not noise.get("white"):
        return "Allan deviation at rest"
    white, unit = _rms(noise["white"]), UNITS[sensor]
    head = f"White noise {number(white)} {unit} a sample"
    if not sheet.get("noise_density"):
        return head
    ratio = white / (float(sheet["noise_density"]) * np.sqrt(0.5 / interval))
    if 1.0 / NEAR < ratio < NEAR:
        return f"{head}, as the data sheet says"
    cause = ""
    if ratio > FAR:
        cause = ": vibration at rest, another range, or a unit that is not that of the column"
    elif ratio < 1.0 / FAR:
        cause = ": a filter in the sensor, smoothed or repeated samples, or a unit that is not that of the column"
    return f"{head}, {number(ratio, 2)} × that of the data sheet{cause}"


def _words(sensor: str, noise: JSON | None, wander: JSON | None) -> str:
    """Return what was found of white noise and wander, at rest and by the fit."""
    unit, said = UNITS[sensor], ""
    if noise and noise.get("white"):
        source = {
            "static": "this rest",
            "rests": "the rests of the recordings",
            "residual": "what a smooth turn leaves",
            "data_sheet": "the data sheet",
        }.get(str(noise.get("source")), "the recordings")
        white = ", ".join(number(v) for v in noise["white"])
        said = f"White noise of a sample, from {source}: {white} {unit} on x, y, z. "
        if any(noise.get("wander") or []):
            said += (
                f"Bias wander {number(_rms(noise['wander']))} {unit} over {number(noise.get('correlation_time_s'))} s. "
            )
    if not wander or wander.get("standard_deviation") is None:
        return said.strip()
    if not wander.get("ratio"):
        return f"{said}The fit needs no bias wander."
    said += (
        f"The fit needs a wander of {number(wander['standard_deviation'])} {unit} over {number(wander.get('time_s'))} s"
    )
    if wander.get("expected") is not None:
        said += f", against {number(wander['expected'])} expected"
    if wander.get("inflated"):
        return f"{said}: it is inflated, so something slow may be missing that the noise model has swallowed."
    return f"{said}."
