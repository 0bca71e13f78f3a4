"""Temperature as a regressor.

A thermometer's own noise in a regressor would bias what is fitted to it (errors in variables), and a moving average is
biased at the ends of a file. So the temperature is smoothed by a locally linear kernel:

    T(t) = a,  (a, b) = argmin sum_i exp(-(t_i - t)^2 / (2 h^2)) (T_i - a - b (t_i - t))^2

where h is the bandwidth; a straight ramp passes it unchanged, at the ends of a file too. A corner of a ramp does not:
it is rounded by 0.4 h times the change of slope. So h is halved as long as half of it gives another temperature, by
more than the thermometer's noise s allows:

    max_t |T_h(t) - T_{h/2}(t)| > 6 s sqrt(5 dt / (sqrt(pi) h))

Sources: Fan & Gijbels, Local Polynomial Modelling and Its Applications, 1996, section 3.2; the choice of h after
Lepski, Theory of Probability and Its Applications 35, 1991.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.records import noise_of_steps

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.records import Recording

BLOCK = 256  # cells at once: their kernels stay in the processor's cache
NARROWEST_S = 0.5  # below the thermal time constant of a package, which is seconds
ROUNDING = 1e-12  # relative: some thousand roundings of a double
DISTINCT, AT_ENDS = 6.0, 5.0  # standard deviations; by how much the variance is larger at the ends of a file


def smooth_temperature(
    time: NDArray[np.float64], temperature: NDArray[np.float64], bandwidth: float = 10.0
) -> NDArray[np.float64]:
    """Return a smoothed temperature log: (n,) array, degC; ``time`` increases.

    ``bandwidth``, s, is the largest standard deviation of the kernel; 10 s averages over about 30 s.
    """
    if len(time) < 3 or time[-1] == time[0]:
        return _local_line(time, temperature, bandwidth)
    step = np.abs(np.diff(temperature))
    noise, least = float(noise_of_steps(step)), ROUNDING * float(np.abs(temperature).max())
    if noise == 0.0 and step.any():  # coarse: half of a count says nothing
        noise = float(step[step > 0].min())
        least += 0.5 * noise
    interval = (time[-1] - time[0]) / (len(time) - 1)
    smooth = _local_line(time, temperature, bandwidth)
    while bandwidth > max(NARROWEST_S, 4.0 * interval):
        finer = _local_line(time, temperature, bandwidth / 2.0)
        allowed = max(DISTINCT * noise * float(np.sqrt(AT_ENDS * interval / (np.sqrt(np.pi) * bandwidth))), least)
        if float(np.abs(smooth - finer).max()) <= allowed:
            break
        smooth, bandwidth = finer, bandwidth / 2.0
    return smooth


def temperature_of(recording: Recording) -> NDArray[np.float64]:
    """Return the smoothed temperature of a recording that logs it: (n,) array, degC; shared."""
    assert recording.temperature is not None  # noqa: S101
    if "temperature" not in recording.cache:
        recording.cache["temperature"] = smooth_temperature(recording.time, recording.temperature)
    found: NDArray[np.float64] = recording.cache["temperature"]
    return found


def _local_line(time: NDArray[np.float64], temperature: NDArray[np.float64], bandwidth: float) -> NDArray[np.float64]:
    """Return the value of the local line at each time: (n,) array, degC."""
    cell = np.floor((time - time[0]) / (bandwidth / 5.0)).astype(np.int64)
    cell = np.concatenate([[0], np.cumsum(cell[1:] != cell[:-1])])  # without empty ones, as times increase
    count = np.bincount(cell)
    t = np.bincount(cell, time) / count
    value = np.bincount(cell, temperature) / count
    level = np.empty_like(t)
    for start in range(0, len(t), BLOCK):
        block = slice(start, start + BLOCK)
        near = slice(*np.searchsorted(t, [t[block][0] - 5 * bandwidth, t[block][-1] + 5 * bandwidth]))
        x, n, v = (t[near] - t[block][0]) / bandwidth, count[near], value[near] - value[start]
        at = (t[block] - t[block][0]) / bandwidth
        weights = np.exp(-0.5 * (x - at[:, None]) ** 2)
        s0, s1, s2, r0, r1 = (weights @ np.stack([n, n * x, n * x * x, n * v, n * x * v], 1)).T
        s1, s2, r1 = s1 - at * s0, s2 - at * (2.0 * s1 - at * s0), r1 - at * r0  # about the cell itself
        determinant = s0 * s2 - s1 * s1
        alone = determinant <= 1e-12 * s0 * s0
        line = np.where(alone, r0 / s0, (s2 * r0 - s1 * r1) / np.where(alone, 1.0, determinant))
        level[block] = value[start] + line
    if len(t) == 1:
        return np.full_like(time, level[0])
    smooth: NDArray[np.float64] = np.interp(time, t, level)
    # np.interp holds the end cells' means; go on along their slope instead.
    before, after = time < t[0], time > t[-1]
    smooth[before] = level[0] + (time[before] - t[0]) * (level[1] - level[0]) / (t[1] - t[0])
    smooth[after] = level[-1] + (time[after] - t[-1]) * (level[-1] - level[-2]) / (t[-1] - t[-2])
    return smooth
