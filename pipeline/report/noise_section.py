"""Noise at rest: overlapping Allan deviation of each axis beside the noise model and the data sheet.

    sigma^2(tau) = white^2 dt / tau + 2 s^2 T / tau (1 - T / (2 tau) (3 - 4 e^(-tau/T) + e^(-2 tau/T)))

where

    white : standard deviation of one sample's white noise; a data sheet's density D gives white^2 dt = D^2 / 2
    dt    : sampling interval, s
    s, T  : standard deviation and correlation time of the bias wander (first-order Gauss-Markov)

Source: IEEE Std 952-1997, annex C. The rest is the static recording, else the longest rest of all recordings.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.records import SENSOR_UNITS
from pipeline.report.chart import AXES_LEGEND, Figure, Layer, Line, Panel, chart
from pipeline.report.numbers import number
from pipeline.signal.allan import allan_deviation
from pipeline.signal.rests import rests_from_table

if TYPE_CHECKING:
    from pipeline.records import Recording
    from pipeline.report.axis import Values

JSON = dict[str, Any]
FEWEST = 60  # samples of a rest: two decades of averaging times are drawn
LONGEST = 4096  # samples, beyond which long averaging times use means: an hour's rest then costs what a minute's does
GAP = 1.5  # intervals from which a step of time is a gap
UNEVEN = 0.5  # rms scatter of the sampling intervals, relative, above which averages over equal times mean nothing
PER_DECADE = 8  # averaging times
SURE = 4.0  # averages of the longest time drawn; of fewer the deviation is a guess
# Factor between white noise and data sheet from which a cause is named: the digital filters of an MPU-6050 (5 to
# 260 Hz) change the white noise of a sample by sqrt(52) = 7 at one sampling rate, its ranges by 2 to 8.
FAR = 5.0
NEAR = 1.3  # factor between both that counts as the same: data sheets state typical values to about 30 %
SOURCES = {
    "static": "this rest",
    "rests": "the rests of the recordings",
    "residual": "the residual of a smooth turn",
    "data_sheet": "the data sheet",
}


def allan(
    sensor: str, recordings: list[Recording], noise: JSON | None, sheet: JSON, wander: JSON | None
) -> Figure | None:
    """Draw the Allan deviation of each axis; None where no recording holds a rest.

    ``noise``: the noise model; ``sheet``: the sensor's section of the configuration; ``wander``: that which the fit of
    the diagnosis needed.
    """
    found = _longest_rest(sensor, recordings)
    if found is None:
        return None
    (recording, values), unit = found, SENSOR_UNITS[sensor]
    noise = noise if noise and noise.get("white") else {}
    tau, deviation = deviations(values, recording.interval)
    sure = tau <= len(values) * recording.interval / SURE
    tau, deviation = tau[sure], deviation[sure]
    models = _models(noise, sheet, recording.interval, tau)
    layers: list[Layer] = [Line(tau, deviation[:, c], c) for c in range(3)]
    layers += [Line(tau, v, colour, style) for _, v, colour, style in models]
    some = [(tau[k], deviation[k].mean()) for k in (0, len(tau) // 2, -1)]
    told = ", ".join(f"{number(float(v))} {unit} at {number(float(t))} s" for t, v in some)
    filtered = "" if recording.filter.get("name", "none") == "none" else ", after the filter"
    rest = f"{recording.name}, {number(len(values) * recording.interval)} s at rest{filtered}."
    caption = " ".join([rest, *_sentences(noise, wander, unit)])
    legend = (*AXES_LEGEND, *((f"c{colour}", name) for name, _, colour, _ in models))
    return chart(
        Figure(f"{sensor}-allan", _finding(noise, sheet, recording.interval, unit), caption, legend),
        f"Allan deviation, mean of the axes: {told}.",
        [Panel(layers, f"Allan deviation, {unit}", 190, logarithmic=True)],
        "averaging time, s",
        kind="log",
    )


def _longest_rest(sensor: str, recordings: list[Recording]) -> tuple[Recording, Values] | None:
    """Return the recording with the longest rest, a static one if there is one, and the readings in it."""
    static: list[tuple[Recording, Values]] = []
    rests: list[tuple[Recording, Values]] = []
    for recording in recordings:
        reading = recording.reading(sensor)
        if reading is None or recording.role == "validation" or _uneven(recording):
            continue
        if recording.role == "static":
            static.append((recording, reading))
        else:
            rests += [(recording, reading[r.start : r.stop]) for r in rests_from_table(recording) if r.accepted]
    for found in (static, rests):
        known = [(recording, values[np.isfinite(values).all(axis=1)]) for recording, values in found]
        longest = max(known, key=lambda rest: len(rest[1]), default=None)
        if longest is not None and len(longest[1]) >= FEWEST:
            return longest
    return None


def _uneven(recording: Recording) -> bool:
    """Return whether intervals scatter too much for averages over equal times."""
    steps = np.diff(recording.time_ns) / (1e9 * recording.interval) if recording.samples > 1 else np.ones(1)
    return bool(np.sqrt(np.mean((steps[steps <= GAP] - 1.0) ** 2)) > UNEVEN)


def deviations(values: Values, interval: float) -> tuple[Values, Values]:
    """Return averaging times and overlapping Allan deviations of (n, 3) readings; long times from means of samples."""
    tau, deviation = allan_deviation(values[:LONGEST], interval, PER_DECADE)
    size = -(-len(values) // LONGEST)
    if size == 1:
        return tau, deviation
    means = values[: len(values) // size * size].reshape(-1, size, 3).mean(axis=1)
    late, of_means = allan_deviation(means, interval * size, PER_DECADE)
    near, far = tau < late[0] * 4.0, late >= late[0] * 4.0  # means of 4 and more values
    return np.concatenate([tau[near], late[far]]), np.concatenate([deviation[near], of_means[far]])


def expected(white_density: float, wander: float, time: float, tau: Values) -> Values:
    """Return the Allan deviation of white noise, given ``white sqrt(dt)``, and Gauss-Markov wander: (m,) array."""
    x = tau / time
    bend = (3.0 - 4.0 * np.exp(-x) + np.exp(-2.0 * x)) / (2.0 * x)
    variance = white_density**2 / tau + 2.0 * wander**2 / x * np.maximum(1.0 - bend, 0.0)
    return np.asarray(np.sqrt(variance), np.float64)


def _models(noise: JSON, sheet: JSON, interval: float, tau: Values) -> list[tuple[str, Values, int, str]]:
    """Return name, values, colour and style of the lines of the noise model and of the data sheet."""
    out: list[tuple[str, Values, int, str]] = []
    if noise:
        white = _rms(noise["white"]) * np.sqrt(interval)
        wander, time = _rms(noise.get("wander") or [0.0]), float(noise.get("correlation_time_s") or 100.0)
        out.append(("noise model", expected(white, wander, time, tau), 5, "model"))
        if wander > 0:
            out.append(("its white noise alone", white / np.sqrt(tau), 4, "dashed"))
    if sheet.get("noise_density"):
        wander, time = float(sheet.get("bias_wander") or 0.0), float(sheet.get("wander_time_s") or 100.0)
        density = float(sheet["noise_density"]) / np.sqrt(2.0)
        out.append(("data sheet", expected(density, wander, time, tau), 3, "dashed"))
    return out


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _finding(noise: JSON, sheet: JSON, interval: float, unit: str) -> str:
    """Return the white noise, its ratio to that of the data sheet, and a likely cause of a large ratio."""
    if not noise:
        return "Allan deviation at rest"
    white = _rms(noise["white"])
    head = f"White noise {number(white)} {unit} a sample"
    if not sheet.get("noise_density"):
        return head
    ratio = white / (float(sheet["noise_density"]) * np.sqrt(0.5 / interval))
    if 1.0 / NEAR < ratio < NEAR:
        return f"{head}, as the data sheet says"
    cause = ""
    if ratio > FAR:
        cause = ": vibration at rest, another range, or a column in another unit"
    elif ratio < 1.0 / FAR:
        cause = ": a filter in the sensor, smoothed or repeated samples, or a column in another unit"
    return f"{head}, {number(ratio, 2)} × that of the data sheet{cause}"


def _sentences(noise: JSON, wander: JSON | None, unit: str) -> list[str]:
    """Return white noise and wander, at rest and as the fit needed them."""
    said = []
    if noise:
        source, white = SOURCES.get(str(noise.get("source")), "the recordings"), ", ".join(map(number, noise["white"]))
        said.append(f"White noise of a sample, from {source}: {white} {unit} on x, y, z.")
        if any(noise.get("wander") or []):
            time = number(noise.get("correlation_time_s"))
            said.append(f"Bias wander {number(_rms(noise['wander']))} {unit}, correlation time {time} s.")
    if not wander or wander.get("standard_deviation") is None:
        return said
    if not wander.get("ratio"):
        return [*said, "The fit needs no bias wander."]
    needed = f"The fit needs a wander of {number(wander['standard_deviation'])} {unit}, "
    needed += f"correlation time {number(wander.get('time_s'))} s"
    if wander.get("expected") is not None:
        needed += f", against {number(wander['expected'])} expected"
    if wander.get("inflated"):
        needed += ": it is inflated; the noise model may contain a slow effect that is missing in the model"
    return [*said, f"{needed}."]
