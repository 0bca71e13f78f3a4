"""A recording, the samples of one file, and the noise of one sensor.

Units: time in integer nanoseconds since power-on, specific force in g (9.80665 m/s^2), angular rate in deg/s, angles in
deg, temperature in degC. A channel that the file does not contain is ``None``.

    noise[n] = white * w[n] + wander * m[n]

with ``w`` independent standard normal and ``m`` a stationary first-order Gauss-Markov process of unit variance and
autocorrelation ``exp(-|t| / correlation_time)``.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

# The arrays of all annotations: quantities, samples that are chosen, whole numbers, places of samples.
Values: TypeAlias = "NDArray[np.float64]"
Mask: TypeAlias = "NDArray[np.bool_]"
Integers: TypeAlias = "NDArray[np.int64]"
Index: TypeAlias = "NDArray[np.intp]"

AXES = ("x", "y", "z")
SENSORS = ("accelerometer", "gyroscope")
NANOSECONDS = 1_000_000_000
CLIPPED_OR_STUCK = 0b110  # bits 1 and 2 of ``Recording.flags``
# Arrays of a recording with a row for each sample.
OF_SAMPLES = (
    "time_ns", "accelerometer", "gyroscope", "temperature", "table_angle", "table_rate", "table_attitude", "flags",
)  # fmt: skip
MEDIAN_STEP = 0.9539  # median of |w[n+1] - w[n]| of white noise with standard deviation 1: 0.67449 sqrt(2)


@dataclass(frozen=True)
class Note:
    """A machine-readable remark on an input: what was found or repaired, how often and where.

    ``first`` and ``last`` line of the file concerned count from 1; 0 where lines do not apply. ``start_s`` and
    ``end_s`` are the times of the first and the last sample concerned, in the clock of the file.
    """

    code: str
    count: int
    first: int
    last: int
    detail: str
    start_s: float | None = None
    end_s: float | None = None


@dataclass(frozen=True)
class Encoding:
    """How a stored integer becomes a value: ``value = (count - offset) * scale``.

    Raw counts stay integers in every intermediate file, so that nothing is lost before the fit.
    """

    scale: float
    offset: float = 0.0

    def decode(self, counts: Values) -> Values:
        """Return the values of counts: the one formula by which counts become values, to the last bit."""
        values: Values = (counts - self.offset) * self.scale
        return values

    def encode(self, values: Values) -> NDArray[np.int64] | None:
        """Return the counts that decode to exactly these values, or None where there are none."""
        with np.errstate(invalid="ignore", over="ignore"):
            counts = np.rint(values / self.scale + self.offset)
            exact = np.array_equal(self.decode(counts), values) and bool(np.all(np.abs(counts) < 2**53))
        return counts.astype(np.int64) if exact else None


@dataclass(frozen=True)
class Recording:
    """The samples of one recording.

    Attributes
    ----------
    name : str
        Name in the procedure, for example ``accel_x``.
    role : str
        ``accelerometer`` or ``gyroscope`` (turns for that sensor), ``rests`` (rests and moves without a table),
        ``validation`` (held out from every fit) or ``static`` (pins the noise model).
    axis : str or None
        Body axis that the table turns about (``x``, ``y``, ``z``), None where there is no single axis.
    time_ns : (n,) array of int64, ns since power-on
    accelerometer, gyroscope : (n, 3) arrays, g and deg/s, or None
    temperature, table_angle, table_rate : (n,) arrays, degC, deg, deg/s, or None
        Angle and rate are about the turn axis, the angle not wrapped; in held-out motion the magnitude of the rate.
    table_attitude : (n, 4) array, or None
        Unit quaternion (w, x, y, z), body to level with z up.
    flags : (n,) array of uint16, or None
        Bit 0: a gap before this sample. Bit 1: clipped. Bit 2: stuck. Bit 3: repaired.
    source : dict
        ``file``, ``sha256``, ``rows`` of the input.
    filter : dict
        Name and settings of the filter that was applied; ``delay_s`` of its output (0 where it is zero-phase), and
        ``noise_gain``, the factor on the standard deviation of white noise.
    encodings : dict of str to Encoding
        Columns that came as integers.
    setup : str
        Which of several tables, mountings or sessions it was made in; empty where there is one alone.
    up : str
        ``+x``, ``-z`` ..: the body axis that points up throughout a turn about a vertical axis; empty elsewhere, where
        the table's angle says which one does.
    clock_shared : bool
        Whether the time between this recording and the unit's others is known (their times do not overlap).
    """

    name: str
    role: str
    axis: str | None
    time_ns: NDArray[np.int64]
    accelerometer: Values | None = None
    gyroscope: Values | None = None
    temperature: Values | None = None
    table_angle: Values | None = None
    table_rate: Values | None = None
    table_attitude: Values | None = None
    flags: NDArray[np.uint16] | None = None
    source: dict[str, Any] = field(default_factory=dict)
    notes: tuple[Note, ...] = ()
    filter: dict[str, Any] = field(default_factory=lambda: {"name": "none", "delay_s": 0.0, "noise_gain": 1.0})
    encodings: dict[str, Encoding] = field(default_factory=dict)
    clock_shared: bool = True
    setup: str = ""
    up: str = ""

    @cached_property
    def time(self) -> Values:
        """Time of each sample: (n,) array, s since power-on."""
        seconds: Values = self.time_ns // NANOSECONDS + (self.time_ns % NANOSECONDS) / NANOSECONDS
        return seconds

    @property
    def samples(self) -> int:
        """Number of samples."""
        return len(self.time_ns)

    @cached_property
    def interval(self) -> float:
        """Median sampling interval, s."""
        return float(median(np.diff(self.time_ns))) / NANOSECONDS if self.samples > 1 else float("nan")

    @cached_property
    def cache(self) -> dict[Any, Any]:
        """Results computed from this recording that several steps use: smoothed temperature, reference motions."""
        return {}

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Which samples ingest did not flag as clipped or stuck: (n,) array. A sample after a gap is valid."""
        if self.flags is None:
            return np.ones(self.samples, bool)
        return np.asarray((self.flags & CLIPPED_OR_STUCK) == 0)

    def reading(self, sensor: str) -> Values | None:
        """Return the (n, 3) readings of ``accelerometer`` (g) or ``gyroscope`` (deg/s), or None."""
        return self.accelerometer if sensor == "accelerometer" else self.gyroscope

    def select(self, index: NDArray[Any] | slice) -> Self:
        """Return the recording with only the samples of ``index`` (slice, mask or integers)."""
        return replace(self, **{n: v[index] for n in OF_SAMPLES if (v := getattr(self, n)) is not None})


@dataclass(frozen=True)
class Noise:
    """White noise of a sample (before any filter) and Gauss-Markov bias wander: (3,) standard deviations.

    ``source``: ``static`` (a long rest), ``rests`` (in the recordings), ``residual`` (of a fit) or ``data_sheet``.
    ``length``, s, is that of the static rest, else 0; the relative uncertainty of the wander is about
    ``sqrt(correlation_time / length)``.
    """

    white: Values
    wander: Values
    correlation_time: float
    source: str
    length: float = 0.0

    def to_json(self) -> dict[str, Any]:
        """Return the noise as JSON values."""
        return {**vars(self), "white": self.white.tolist(), "wander": self.wander.tolist()}

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Self:
        """Read back what ``to_json`` wrote."""
        return cls(**{**data, "white": np.array(data["white"]), "wander": np.array(data["wander"])})


def noise_of_steps(step: Values, axis: int = 0, *, keepdims: bool = False) -> Values:
    """Return the standard deviation of white noise, ``median |x[n+1] - x[n]| / 0.9539``, along an axis.

    ``step`` are the absolute differences of successive samples. Slow signals and outliers hardly change the result.
    """
    return np.asarray(median(step, axis, keepdims=keepdims) / MEDIAN_STEP)


def median(values: Values, axis: int = 0, *, keepdims: bool = False) -> Values:
    """Return ``numpy.median`` along an axis: for a thousand values in half of its time, for matrices in a fifth."""
    ordered, half = np.sort(values, axis), values.shape[axis] // 2
    one, two, last = (ordered.take(k, axis) for k in (half, half - 1 + values.shape[axis] % 2, -1))
    found = np.where(np.isnan(last), last, 0.5 * (one + two))  # NaN stands last
    return np.expand_dims(found, axis) if keepdims else found
