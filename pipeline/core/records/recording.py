"""The data classes of a recording, of the noise of a sensor and of the motion of the body; attitudes and axis maps.

Units: time in integer nanoseconds since power-on, specific force in g (9.80665 m/s^2), angular rate in deg/s, angles in
deg, temperature in degC. A channel that the file does not contain is ``None``.

    noise[n] = white * w[n] + wander * m[n]

with ``w`` independent standard normal and ``m`` a stationary first-order Gauss-Markov process of unit variance and
autocorrelation ``exp(-|t| / correlation_time)``.

Quaternions are (w, x, y, z), body to level with z up. The angular rate follows from their derivative,

    omega = 2 vec(conj(q) dq/dt)

by a quintic spline through the components: at 0.12 s between samples and 200 deg/s its truncation error is below
1e-3 deg/s; the error of a central difference is 1 %.

An axis map rotates readings from the sensor's axes to the body's,

    body[m_i] = s_i * reading_i,   axis_map[i] = s_i m_i

where axis i of the reading points along the body axis m_i with the sign s_i. Some chips have a left-handed
accelerometer frame and a right-handed gyroscope frame, so that each sensor may have a separate map.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, partial, wraps
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, Self, TypeAlias, TypeVar, cast

import numpy as np

from imu_logs.units import AXES, SECOND_NS, TRIADS
from pipeline.core.errors import ConfigurationError
from pipeline.core.records.budget import as_json, with_arrays

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Mapping, Sequence

    from numpy.typing import NDArray
    from scipy.interpolate import BSpline

    from imu_logs.log import Index, Integers, Mask, Note, Values
    from pipeline.core.settings import Sensor

ReturnedQuantity = TypeVar("ReturnedQuantity")
Arguments = ParamSpec("Arguments")
OfRecording: TypeAlias = "Callable[Concatenate[Recording, Arguments], ReturnedQuantity]"
STRAIGHT = ("+x", "+y", "+z")

BETWEEN_ATTITUDES_S = 1000.0  # between the blocks of a file of attitudes, whose times are not known
NOISE_OF_ROWS = "noise_of_rows"  # in the source of means: standard deviation of each by white noise, by sensor
CLIPPED_OR_STUCK = 0b110  # bits 1 and 2 of ``Recording.flags``
# Arrays of a recording with a row for each sample.
OF_SAMPLES = (
    "time_ns", "accelerometer", "gyroscope", "temperature", "table_angle", "table_rate", "table_attitude", "flags",
)  # fmt: skip
MEDIAN_SIZE = 1.4826  # standard deviation over median absolute deviation of a normal distribution
MEDIAN_STEP = 0.9539  # median of |w[n+1] - w[n]| of white noise with standard deviation 1: 0.67449 sqrt(2)
SPLINE_PART, SPLINE_MARGIN = 50_000, 100  # samples
# Of a motion: they follow from the log. Those with three axes would have most of a long recording's memory.
DEFERRED = (
    *("specific_force", "angular_rate", "angular_acceleration", "specific_force_rate", "level", "direction"),
    *("angle", "rate", "still", "reference_valid"),
)


class Quantities(dict["tuple[Hashable, ...]", Any]):
    """What is computed once, by all that it depends on."""

    def once(self, key: tuple[Hashable, ...], compute: Callable[[], ReturnedQuantity]) -> ReturnedQuantity:
        """Return what was computed at the first call with a key."""
        if key not in self:
            self[key] = compute()
        found: ReturnedQuantity = self[key]
        return found


@dataclass(frozen=True)
class Recording:
    """The samples of one recording."""

    name: str  # in the procedure, for example accel_x
    # ``accelerometer`` or ``gyroscope`` (turns for that sensor), ``rests`` (rests and moves without a table),
    # ``validation`` (held out from every fit) or ``static`` (determines the noise model)
    role: str
    axis: str | None  # body axis of the table's turns (x, y, z), None without a single axis
    time_ns: Integers  # (n,), ns since power-on
    accelerometer: Values | None = None  # (n, 3), g
    gyroscope: Values | None = None  # (n, 3), deg/s
    temperature: Values | None = None  # (n,), degC
    table_angle: Values | None = None  # (n,), deg about the turn axis, not wrapped
    table_rate: Values | None = None  # (n,), deg/s about the turn axis; in held-out motion its magnitude
    table_attitude: Values | None = None  # (n, 4), unit quaternion (w, x, y, z), body to level with z up
    flags: NDArray[np.uint16] | None = None  # (n,), bit 0: a gap before this sample, 1: clipped, 2: stuck, 3: repaired
    source: dict[str, Any] = field(default_factory=dict)  # of the input: file, sha256, rows
    notes: tuple[Note, ...] = ()
    # the applied filter: name, settings, delay of its output (0 if it is zero-phase), factor on white noise
    filter: dict[str, Any] = field(default_factory=lambda: {"name": "none", "delay_s": 0.0, "noise_gain": 1.0})
    clock_shared: bool = True  # whether the time between this recording and the unit's others is known
    setup: str = ""  # table, mounting or session of the recording; empty if the unit has only one
    kind: str = ""  # in the sheet of the recordings (``pipeline.ingest.recordings_sheet``); empty without
    # Body axis (+x, -z ..) that points up during a turn about a vertical axis; empty for other turns, where it follows
    # from the table's angle.
    up: str = ""
    sense: int = 1  # 1 if the table's log counts right-handed about the body axis, -1 if left-handed

    @cached_property
    def time(self) -> Values:
        """Time of each sample: (n,) array, s since power-on."""
        seconds: Values = self.time_ns // SECOND_NS + (self.time_ns % SECOND_NS) / SECOND_NS
        return seconds

    @property
    def time_steps(self) -> Values:
        """Time from each sample to the next: (n - 1,) array, s."""
        return np.diff(self.time)

    @property
    def samples(self) -> int:
        """Number of samples."""
        return len(self.time_ns)

    @cached_property
    def interval(self) -> float:
        """Median sampling interval, s."""
        return float(median(np.diff(self.time_ns))) / SECOND_NS if self.samples > 1 else float("nan")

    @cached_property
    def of_readings(self) -> Quantities:
        """The quantities that are declared ``once``, by function and arguments."""
        return Quantities()

    @cached_property
    def of_log(self) -> Quantities:
        """Those that are declared ``once_of_log``; those of several recordings are with the log of the first."""
        return Quantities()

    def __getstate__(self) -> dict[str, Any]:
        """Return what is copied to another process: not the quantities, which contain functions."""
        return {name: value for name, value in vars(self).items() if name not in {"of_readings", "of_log"}}

    def with_readings(self, **fields: Any) -> Self:  # noqa: ANN401  (of the dataclass)
        """Return the recording with other readings, flags, filter or role, and the same quantities of its log."""
        changed = replace(self, **fields)
        vars(changed)["of_log"] = self.of_log
        return changed

    def with_source(self, source: dict[str, Any], *unread: Callable[..., object]) -> Self:
        """Return the recording with other names of its files; ``unread``: quantities that are no longer kept."""
        changed = object.__new__(type(self))
        known = {"of_readings": self.of_readings, "of_log": self.of_log}
        kept = {name: Quantities({k: v for k, v in of.items() if k[0] not in unread}) for name, of in known.items()}
        vars(changed).update(vars(self), source=source, **kept)
        return changed

    @property
    def table_seconds(self) -> float:
        """Seconds of the table's clock per second of the sensor's clock, after alignment; 1 for a common clock."""
        return 1.0 + 1e-6 * float(self.source.get("table_clock", {}).get("drift_ppm", 0.0))

    @cached_property
    def logged_rate(self) -> Values | None:
        """Rate of the table, deg/s: the logged rate, else central differences of its angle; None without both."""
        if self.table_rate is not None or self.table_angle is None or self.samples < 2:
            return self.table_rate
        return np.asarray(np.gradient(self.table_angle, self.time))

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Mask of the samples that ingest did not flag as clipped or stuck: (n,). A sample after a gap is valid."""
        if self.flags is None:
            return np.ones(self.samples, bool)
        return np.asarray((self.flags & CLIPPED_OR_STUCK) == 0)

    def reading(self, sensor: str) -> Values | None:
        """Return the (n, 3) readings of ``accelerometer`` (g) or ``gyroscope`` (deg/s), or None."""
        return self.accelerometer if sensor == "accelerometer" else self.gyroscope

    @property
    def readings(self) -> dict[str, Values]:
        """The (n, 3) readings of each sensor that the recording has, g and deg/s."""
        return {sensor: values for sensor in TRIADS if (values := self.reading(sensor)) is not None}

    def noted(self, *notes: Note) -> Self:
        """Return the recording with further notes."""
        return replace(self, notes=(*self.notes, *notes))

    def select(self, index: NDArray[Any] | slice) -> Self:
        """Return the recording with only the samples of ``index`` (slice, mask or integers)."""
        return replace(self, **{n: v[index] for n in OF_SAMPLES if (v := getattr(self, n)) is not None})


@dataclass(frozen=True, eq=False)
class Same:
    """A value as an argument of a quantity that is computed ``once``: two are equal if the values are one object."""

    value: object

    def __hash__(self) -> int:
        """Return the hash of the object's identity."""
        return id(self.value)

    def __eq__(self, other: object) -> bool:
        """Return whether the other value is the same object."""
        return isinstance(other, Same) and self.value is other.value


def once(compute: OfRecording[Arguments, ReturnedQuantity]) -> OfRecording[Arguments, ReturnedQuantity]:
    """Declare a quantity of a recording: it follows from the recording and further arguments, which have a hash.

    The function computes it at the first call, and the recording keeps it. The steps of a unit pass on its recordings
    (``UnitRecordings``), so that each motion of the table, smoothed temperature, list of rests and row of a fit is
    computed once a unit. Callers must not change it.
    """
    return _kept(compute, lambda recording: recording.of_readings)


def once_of_log(compute: OfRecording[Arguments, ReturnedQuantity]) -> OfRecording[Arguments, ReturnedQuantity]:
    """Declare a quantity as ``once`` that depends on no readings, flags, filter or role (``with_readings``)."""
    return _kept(compute, lambda recording: recording.of_log)


def _kept(
    compute: OfRecording[Arguments, ReturnedQuantity], quantities: Callable[[Recording], Quantities]
) -> OfRecording[Arguments, ReturnedQuantity]:
    @wraps(compute)
    def quantity(recording: Recording, /, *arguments: Arguments.args, **named: Arguments.kwargs) -> ReturnedQuantity:
        key = quantity, arguments, *sorted(named.items())
        return quantities(recording).once(key, lambda: quantity.__wrapped__(recording, *arguments, **named))

    return quantity


def files_of_readings(source: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the files with readings of a recording: ``source`` and the joined files, without logs of a table."""
    entries = (source, *source.get("joined", []))  # a joined topic of the same file has no hash
    return [entry for entry in entries if "sha256" in entry and not entry.get("table_only")]


@dataclass(frozen=True)
class WanderLikelihood:
    """Log likelihood of a static recording on a grid of wander values, relative to no wander."""

    correlation_time: Values  # (t,), s
    wander: Values  # (w,), standard deviation in the unit of the sensor
    log_likelihood: Values  # (t, w)


@dataclass(frozen=True)
class Noise:
    """White noise of a sample (before any filter) and Gauss-Markov bias wander: (3,) standard deviations.

    A source is ``static`` (a long rest), ``rests`` (in the recordings), ``residual`` (scatter of windows of 16 samples
    in turns about a local polynomial) or ``data_sheet`` (the sensor file).
    """

    white: Values
    wander: Values
    correlation_time: float  # s
    source: str  # of the white noise
    wander_source: str = "data_sheet"
    time_source: str = "data_sheet"  # of the correlation time
    # s, of the static rest, or of all rests by hand that show the wander, else 0; the wander has a relative uncertainty
    # of about ``sqrt(correlation_time / length)``
    length: float = 0.0
    likelihood: WanderLikelihood | None = None  # None without a static recording
    # each (3,), 0 for an axis whose readings are finer than its noise
    step: Values | None = None  # of the readings that hide the noise (``pipeline.physics.signal.quiet_motion``)
    rounding: Values | None = None  # standard uncertainty of means by these steps

    def to_json(self) -> dict[str, Any]:
        """Return the noise as JSON values."""
        return dict(as_json(self))

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Self:
        """Return the object from the value of ``to_json``."""
        likelihood = data["likelihood"] and WanderLikelihood(**with_arrays(data["likelihood"]))
        return cls(**with_arrays(data) | {"likelihood": likelihood})


@dataclass
class UnitRecordings:
    """The recordings of one unit after checks and filter, and the noise of each sensor.

    The steps of a unit pass them on in memory, with the quantities of each that are computed ``once``.
    """

    filtered: list[Recording]  # with the filter ``none``, those of ingest
    noises: dict[str, Noise | None]  # by sensor, of the filtered readings; None where nothing determines it


def noise_of_steps(step: Values, axis: int = 0, *, keepdims: bool = False) -> Values:
    """Return the standard deviation of white noise, ``median |x[n+1] - x[n]| / 0.9539``, along an axis.

    ``step``: absolute differences of successive samples. Slow signals and outliers hardly change the result.
    """
    return np.asarray(median(step, axis, keepdims=keepdims) / MEDIAN_STEP)


def median(values: Values, axis: int = 0, *, keepdims: bool = False) -> Values:
    """Return the median along an axis; of a thousand values and fewer 2 to 3 times as fast as ``numpy.median``."""
    half, size = values.shape[axis] // 2, values.shape[axis]
    ordered, before = np.partition(values, (half - 1, half, size - 1), axis), (slice(None),) * (axis % values.ndim)
    one, two, last = (ordered[(*before, place)] for place in (half, half - 1 + size % 2, -1))
    middle = np.asarray(0.5 * (one + two))
    unknown = np.isnan(last)  # NaN is sorted last
    if unknown.any() if middle.ndim else unknown:
        middle = np.where(unknown, last, middle)
    return middle[(*before, None)] if keepdims else middle


class _Deferred:
    """A field of a motion; a function in its place returns the value, at the first access."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __get__(self, motion: Motion, _: type[Motion]) -> Values | None:
        value = vars(motion)[self.name]
        if callable(value):
            value = vars(motion)[self.name] = value()
        return cast("Values | None", value)

    def __set__(self, motion: Motion, value: object) -> None:
        vars(motion)[self.name] = value


def _deferring(motion: type[Motion]) -> type[Motion]:
    for name in DEFERRED:
        setattr(motion, name, _Deferred(name))
    return motion


@_deferring
@dataclass(frozen=True, eq=False)
class Motion:
    """The true motion in the body frame, from the log of a table (without noise) or from calibrated signals.

    ``at_offset(offset=tau)`` returns the motion at ``time + tau`` (tau: float or (n,) array, s) on the same
    interpolated trajectory. ``at_lag(lag=tau, offset=0.0)`` returns that motion after a first-order lag with time
    constant tau, s. Both are None if the trajectory between the samples is unknown. For a field of ``DEFERRED``, a
    function that returns it may be passed.
    """

    time: Values  # (n,), s since power-on
    specific_force: Values  # (n, 3), g
    angular_rate: Values  # (n, 3), deg/s
    angular_acceleration: Values  # (n, 3), deg/s^2
    specific_force_rate: Values  # (n, 3), g/s, in the body frame: for gravity alone -omega x f, omega in rad/s
    temperature: Values | None  # (n,), degC, smoothed over 30 s: noise of a regressor would bias the estimates
    angle: Values | None  # (n,), deg
    rate: Values | None  # (n,), deg/s
    axis: int | None  # of the turn
    still: Mask  # (n,), samples at rest, after settling
    at_offset: Callable[..., Motion] | None = None
    at_lag: Callable[..., Motion] | None = None
    level: Values | None = None  # (n, 3, 3), rows: axes of the level frame in the body frame; None: unknown heading
    # (n, 3), unit vector of the current turn or, at rest, of the last turn; zeros before the first turn. None: not
    # computed yet (pipeline.physics.effects.base.turning_direction).
    direction: Values | None = None
    reference_valid: Mask | None = None  # (n,), samples near which the table's log is dense enough for interpolation
    timed_by: str = ""  # clock of the angle that gives the rate, "sensor" or "table"; empty: logged rate
    recording: str = ""
    setup: str = ""  # table, mounting or session of the recording; empty if the unit has only one
    temperature_rate: Values | None = None  # (n,), degC/s, of the smoothed temperature; known where that is

    def has(self, name: str) -> bool:
        """Return whether a field is known; it is not computed."""
        return vars(self)[name] is not None

    def changed(self, **fields: Any) -> Motion:  # noqa: ANN401  (of the dataclass)
        """Return the motion with other fields; unlike ``replace``, it computes no deferred one."""
        found = object.__new__(Motion)  # in a third of the time of the initializer
        vars(found).update(vars(self), **fields)
        return found

    def mapped(self, change: Callable[[NDArray[Any]], NDArray[Any]], **fields: Any) -> Motion:  # noqa: ANN401
        """Return the motion with every array changed, those of ``DEFERRED`` later, and with other fields."""

        def later(name: str) -> NDArray[Any]:
            value = vars(self)[name]  # not by the attribute, which would keep the values of all samples
            return change(value() if callable(value) else value)

        arrays = {n: v for n, v in vars(self).items() if isinstance(v, np.ndarray) and n not in {*DEFERRED, *fields}}
        deferred = {n: partial(later, n) for n in DEFERRED if n not in fields and vars(self)[n] is not None}
        return self.changed(**{n: change(v) for n, v in arrays.items()}, **deferred, **fields)

    def part(self, at: slice) -> Motion:
        """Return the motion at consecutive samples, without the trajectory; the deferred fields stay with this one."""
        arrays = {n: v[at] for n, v in vars(self).items() if isinstance(v, np.ndarray) and n not in DEFERRED}
        deferred = {n: partial(lambda n: getattr(self, n)[at], n) for n in DEFERRED if self.has(n)}
        return self.changed(**arrays, **deferred, at_offset=None, at_lag=None)

    def select(self, index: NDArray[Any]) -> Motion:
        """Return the motion at some samples (a mask or integers), without the trajectory between samples."""
        if index.dtype == bool and index.all():  # without a copy
            return self.changed(at_offset=None, at_lag=None)
        rows = np.flatnonzero(index) if index.dtype == bool else index  # ``take`` needs a quarter of the time of a mask
        return self.mapped(lambda values: values.take(rows, axis=0), at_offset=None, at_lag=None)


def motion_at_rest(time: NDArray[np.float64]) -> Motion:
    """Return the motion of a unit at rest in an unknown attitude: forces and rates are zero."""
    zeros = np.zeros((len(time), 3))
    still = np.ones(len(time), bool)
    return Motion(time, zeros, zeros, zeros, zeros, None, None, None, None, still)


def finite_rows(values: Values) -> Mask:
    """Return whether each row of (n, k) values is finite: (n,); column by column, in a sixth of the time."""
    return np.asarray(np.isfinite(values, order="F").all(axis=1))


def runs_of(mask: Mask) -> Index:
    """Return start and stop of each run of True in a mask: (k, 2) array."""
    padded = np.zeros(len(mask) + 2, bool)
    padded[1:-1] = mask
    return np.flatnonzero(padded[1:] != padded[:-1]).reshape(-1, 2)


def cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``a x b`` of (..., 3) arrays, in half of the time of ``numpy.cross``."""
    product: NDArray[np.float64] = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for c, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        np.subtract(a[..., j] * b[..., k], a[..., k] * b[..., j], out=product[..., c])
    return product


def continuous(attitude: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit quaternions without jumps in sign (q and -q are one attitude): (n, 4) array."""
    q = attitude / np.sqrt(np.einsum("ij,ij->i", attitude, attitude))[:, None]
    flips = np.where(np.einsum("ij,ij->i", q[1:], q[:-1]) < 0, -1.0, 1.0)
    return np.asarray(q * np.concatenate([[1.0], np.cumprod(flips)])[:, None])


def conjugate_product(p: NDArray[np.float64], q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the vector part of ``conj(p) q`` for quaternions of shape (n, 4): (n, 3)."""
    product = cross(p[:, 1:], q[:, 1:])
    for c in range(3):
        np.subtract(p[:, 0] * q[:, 1 + c] - q[:, 0] * p[:, 1 + c], product[:, c], out=product[:, c])
    return product


def rotation_deg(p: NDArray[np.float64], q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``2 vec(conj(p) q)`` in degrees of quaternions of shape (n, 4): (n, 3).

    It is the rotation from p to q where that is small, and the rate in the body frame where q is the derivative of p.
    """
    product = conjugate_product(p, q)
    product *= 2.0
    return np.asarray(np.degrees(product, out=product))


def attitude_matrix(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation matrices of unit quaternions: (n, 4) to (n, 3, 3), body vectors to level vectors."""
    w, x, y, z = q.T
    R: NDArray[np.float64] = np.empty((len(q), 3, 3))
    for i, (a, b, c) in enumerate(((x, y, z), (y, z, x), (z, x, y))):  # the axis and the next two
        j = (i + 1) % 3
        R[:, i, i] = 1.0 - 2.0 * (b * b + c * c)
        R[:, i, j], R[:, j, i] = 2.0 * (a * b - w * c), 2.0 * (a * b + w * c)
    return R


def level_in_body(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the vertical in the body frame, ``R(q)^T e_z``: (n, 3) array."""
    w, x, y, z = q.T
    up: NDArray[np.float64] = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1)
    return up


def quintic_spline(time: NDArray[np.float64], values: NDArray[np.float64]) -> BSpline:
    """Return the quintic spline through (n, m) values, n >= 6.

    Its coefficients are those of splines through parts of the samples: the change by a sample falls to 0.43 from one to
    the next, and to less than rounding over the ``SPLINE_MARGIN``. One system of a long log would have 400 B a sample.
    """
    from scipy.interpolate import BSpline, make_interp_spline  # noqa: PLC0415  (0.3 s, only needed for attitude logs)

    n, coefficients = len(time), []
    for start in range(0, n, SPLINE_PART):
        first, stop = max(start - SPLINE_MARGIN, 0), min(start + SPLINE_PART, n)
        part = slice(first, min(stop + SPLINE_MARGIN, n))
        coefficients.append(make_interp_spline(time[part], values[part], k=5).c[start - first : stop - first])
    knots = np.concatenate([np.full(6, time[0]), time[3:-3], np.full(6, time[-1])])
    return BSpline(knots, np.concatenate(coefficients), 5)


def rate_of_attitude(time: NDArray[np.float64], attitude: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the magnitude of the angular rate, (n,), deg/s, from an (n, 4) attitude at n >= 6 increasing times, s."""
    rate = quintic_spline(time, continuous(attitude))(time, 1)
    return np.asarray(2.0 * np.degrees(np.linalg.norm(rate, axis=1)))


def axis_matrix(axis_map: Sequence[str]) -> Values:
    """Return the (3, 3) signed permutation ``B`` of an axis map, ``body = B @ reading``."""
    entries = [str(a) for a in axis_map]
    if [a for a in entries if a[:1] not in "+-" or a[1:] not in AXES] or sorted(a[1:] for a in entries) != list(AXES):
        raise ConfigurationError(
            f"sensor.axis_map is [{', '.join(entries)}]; it names the body axis that the sensor's x, y and z point "
            "along, each once and with its sign, for example [+y, -x, +z]"
        )
    matrix = np.zeros((3, 3))
    for reading, entry in enumerate(entries):
        matrix[AXES.index(entry[1:]), reading] = 1.0 if entry[0] == "+" else -1.0
    return matrix


def axis_maps(sensor: Sensor | None) -> dict[str, tuple[str, ...]]:
    """Return the axis map of each sensor: its own, else that of the sensor model; straight without a model."""
    return {s: STRAIGHT if sensor is None else tuple(sensor.of(s).axis_map or sensor.axis_map) for s in TRIADS}


def maps_of_log(log: Mapping[str, Any]) -> dict[str, tuple[str, ...]]:
    """Return the axis maps in the section ``log`` of a calibration: one per sensor, in older files one for both."""
    stated = log.get("axis_map") or STRAIGHT
    return {s: tuple(stated[s] if isinstance(stated, dict) else stated) for s in TRIADS}


def in_body_axes(axis_map: Sequence[str], readings: Values) -> Values:
    """Rotate (n, 3) readings to the body's axes; return the same array if the map is straight."""
    if tuple(axis_map) == STRAIGHT:
        return readings
    matrix = axis_matrix(axis_map)
    turned: Values = readings[:, np.argmax(np.abs(matrix), axis=1)] * matrix.sum(axis=1)
    return turned


def map_of_orientation(text: str) -> tuple[str, ...]:
    """Return the axis map of an orientation such as YxZ: body axis j is the reading named by letter j."""
    found = {name.lower(): ("+" if name.isupper() else "-") + body for name, body in zip(text, AXES, strict=True)}
    return tuple(found[axis] for axis in AXES)
