"""Define a calibrated sensor in the unit of a format, and the functions that several formats need.

truth = matrix @ (reading - bias - effects),    reading = bias + K @ truth + effects,    K = matrix^-1

White noise n and random walk k, for estimators with only these two terms, follow from the terms identified at rest:

    n^2 = N^2 + sum 2 G^2 T  (T < ``MIN_EXPORTED_TIME_S``)
    k^2 = K^2 + sum 3 sigma^2(t) / t  (other processes) + 3 (2 ln 2 / pi)^2 B^4 / n^2

A fast Gauss-Markov process is white over the averaging times of estimators. Of another process the walk has the Allan
variance sigma^2 at the longest time measured, t = L / 9 for a rest of length L (9 averages determine it to 25 %, IEEE
Std 952): the process is bounded, so that the walk with its first increments, 2 G^2 / T, grows beyond it. The walk for a
bias instability B has the Allan variance of B at the averaging time at which the white noise has it. n is continuous:
the standard deviation of a sample is n sqrt(rate). For an axis without a slow term, the walk is the lesser of its upper
limit and the walk for the bias wander in the configuration, s sqrt(2 / T). The value of a sensor is the root mean
square of its axes. If no term was identified, both follow from the configuration, with ``n = noise_density / sqrt(2)``,
because its density is one-sided. Quantisation, ramps and sinusoids are not included.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from math import comb
from typing import Any

import numpy as np
import scipy

from pipeline.core.files import JSON
from pipeline.core.records import AXES, BIAS, SENSORS, STRAIGHT, Reduced, SensorCalibration, Values, maps_of_log
from pipeline.core.settings import DataSheet
from pipeline.estimation.noise_terms import allan_variance
from pipeline.physics.compensation import MIN_EXPORTED_TIME_S
from pipeline.physics.effects import owner_of
from pipeline.physics.effects.base import OF_THE_BIAS, REFERENCE_TEMPERATURE, STANDARD_GRAVITY, Owner
from pipeline.physics.statements import sentences

UNIT_FACTORS = {"g": 1.0, "m/s^2": STANDARD_GRAVITY, "deg/s": 1.0, "rad/s": float(np.pi / 180.0)}
SI = {"accelerometer": "m/s^2", "gyroscope": "rad/s"}
AVERAGING_S = 1.0  # averaging time of the effective density in remarks
FEWEST_AVERAGES = 9  # of a rest at the longest averaging time: 1 / sqrt(2 (9 - 1)) = 25 % (IEEE Std 952, annex C)
INSTABILITY_FLOOR = 2.0 * np.log(2.0) / np.pi  # Allan variance of a bias instability of 1 (IEEE Std 952)
TEMPERATURES = [-40.0, 85.0]  # degC, the widest specified range of such parts
ORDER = 4  # coefficients of a polynomial of third order in the temperature


@dataclass(frozen=True)
class SensorFigures:
    """The figures of a sensor that exports need; None: its file does not state them."""

    counts_per_unit: float | None = None  # counts per g or deg/s
    noise_density: float | None = None  # one-sided, g/sqrt(Hz) or deg/s/sqrt(Hz)
    bias_wander: float | None = None  # standard deviation, g or deg/s
    wander_time_s: float | None = None  # its correlation time
    noise_origin: str | None = None  # in words, of figures from another program's file

    @classmethod
    def of(cls, data_sheet: DataSheet) -> SensorFigures:
        """Return the figures of a sensor in the configuration of a unit."""
        return cls(**{f.name: getattr(data_sheet, f.name) for f in fields(cls) if f.name != "noise_origin"})


def noise(figures: Mapping[str, JSON]) -> dict[str, float | None]:
    """Return Kalibr's four noise parameters in m/s^2 and rad/s; None for unknown ones; by ``noise_figures``."""
    parameters: dict[str, float | None] = {}
    for sensor, known in figures.items():
        for name, key in (("noise_density", "white"), ("random_walk", "walk")):
            value = known[key]
            parameters[f"{sensor}_{name}"] = None if value is None else float(value * UNIT_FACTORS[SI[sensor]])
    return parameters


def nearest_density(effective: Mapping[str, Any]) -> JSON:
    """Return the effective density of a diagnosis whose averaging time is nearest to ``AVERAGING_S``."""
    densities: list[JSON] = effective["densities"]
    return min(densities, key=lambda d: abs(np.log(d["averaging_time_s"] / AVERAGING_S)))


def noise_figures(sensor: str, sheet: SensorFigures | None, document: Mapping[str, Any]) -> JSON:
    """Return white noise and walk of a sensor in g or deg/s, their intervals (or None), origins and doubts.

    Raises ``KeyError`` without a measurement and figures of the noise.
    """
    identified = (document.get("noise") or {}).get(sensor) or {}
    of_axes = (identified.get("axes") or {}).values()
    axes = [axis["terms"] for axis in of_axes if axis["terms"]]
    if not axes and (sheet is None or sheet.wander_time_s is None):
        raise KeyError("noise_density" if sheet is None else "bias_wander")
    sheet = sheet or SensorFigures()
    density, wander, time = sheet.noise_density, sheet.bias_wander, sheet.wander_time_s
    white = None if density is None else density / np.sqrt(2.0)
    walk = None if wander is None or not time else wander * np.sqrt(2.0 / time)
    origin = sheet.noise_origin or "of the sensor's configuration"
    figures: JSON = {"white": white, "white_interval": None, "white_origin": origin}
    figures |= {"walk": walk, "walk_interval": None}
    doubts = [identified.get("doubts"), *(axis.get("doubts") for axis in of_axes)]
    figures["doubts"] = list(dict.fromkeys(doubt for of_part in doubts for doubt in of_part or []))
    figures["walk_origin"] = sheet.noise_origin or "for the bias wander of the sensor's configuration"
    if not axes:
        return figures
    longest_s = identified["length_s"] / FEWEST_AVERAGES
    of_white, walks = zip(*(_white_and_walk(terms, longest_s) for terms in axes), strict=True)
    whites = [w for w in of_white if w is not None]
    if whites:
        figures["white"], *interval = _rms(whites)
        figures["white_interval"] = _known(interval)
        figures["white_origin"] = f"measured at rest ({identified['source']}), root mean square of the axes"
    measured = [w for w in walks if w is not None]
    limits = [t["random_walk"].get("upper_limit") for t, w in zip(axes, walks, strict=True) if w is None]
    bounds = [bound for limit in limits if (bound := min((v for v in (limit, walk) if v), default=None)) is not None]
    if measured or bounds:
        figures["walk"] = _rms([w[0] for w in measured] + bounds)
    if measured and bounds:
        figures["walk_origin"] = (
            f"measured at rest on {len(measured)} of {len(axes)} axes; on the others it is the lesser of the sensor's "
            "configuration and the upper limit"
        )
    elif measured:
        figures |= {"walk_origin": "measured at rest", "walk_interval": _known(_rms(measured)[1:])}
    elif bounds:
        limit = f"{UNIT_FACTORS[SI[sensor]] * max(v for v in limits if v):.3g} {SI[sensor]}/sqrt(s)"
        figures["walk_origin"] = (
            f"not found at rest ({identified['length_s']:.3g} s), below {limit}: the lesser of the sensor's "
            "configuration and this limit"
        )
    return figures


def _known(interval: list[float]) -> list[float] | None:
    return interval if np.all(np.isfinite(interval)) else None


def _white_and_walk(terms: JSON, longest_s: float) -> list[Values | None]:
    """Return white noise and walk of an axis, each with the ends of its interval, (3,); None without a term.

    ``longest_s``: the longest averaging time measured.
    """

    def intervals(*parts: JSON) -> list[Values]:
        ends = (p["interval"] or (np.nan, np.nan) for p in parts)
        return [np.array([p["value"], *e], float) for p, e in zip(parts, ends, strict=True) if p["value"] is not None]

    processes = [(part, part["correlation_time_s"]["value"]) for part in terms["gauss_markov"]]
    fast = [np.sqrt(2.0 * time) * v for part, time in processes if time < MIN_EXPORTED_TIME_S for v in intervals(part)]
    slow = [
        np.sqrt(3.0 * allan_variance("gauss_markov", 1.0, np.array([longest_s]), time)[0] / longest_s) * value
        for part, time in processes
        if time >= MIN_EXPORTED_TIME_S
        for value in intervals(part)
    ]
    white, walk = [*intervals(terms["white"]), *fast], [*intervals(terms["random_walk"]), *slow]
    if white:
        density = np.sqrt(np.sum(np.square(white), axis=0))[0]
        walk += [np.sqrt(3.0) * INSTABILITY_FLOOR / density * b**2 for b in intervals(terms["bias_instability"])]
    return [np.sqrt(np.sum(np.square(parts), axis=0)) if parts else None for parts in (white, walk)]


def _rms(values: Sequence[Any]) -> Any:  # noqa: ANN401  (numbers, or lists of them)
    return np.sqrt(np.mean(np.square(values), axis=0)).tolist()


class ExportedSensor:
    """A calibrated sensor in the unit of a format.

    ``effects``: values of those that the sensor causes. ``bench_effects``: names of those of mounting, place,
    recording, table and timing, which no export contains. ``counts``: per g or deg/s, or None. ``held``: what a
    format holds that holds less, fitted to the recordings; bias and matrix are then of it.
    """

    def __init__(
        self, calibration: SensorCalibration, unit: str, sheet: SensorFigures | None, held: Reduced | None = None
    ) -> None:
        self.calibration, self.name, self.unit, self.sheet = calibration, calibration.sensor, unit, sheet
        self.factor, self.held = UNIT_FACTORS[unit], held
        self.own_bias = calibration.bias if held is None else np.array(held.bias)
        self.bias = self.own_bias * self.factor
        self.matrix = calibration.matrix if held is None else np.array(held.matrix)
        self.K: Values = np.asarray(np.linalg.solve(self.matrix, np.eye(3)))
        self.full_K: Values = np.asarray(np.linalg.solve(calibration.matrix, np.eye(3)))
        of_sensor = [e for e in calibration.effects if owner_of(e) == Owner.SENSOR]
        self.effects = {e.name: e.values for e in of_sensor}
        self.bench_effects = [e.name for e in calibration.effects if e not in of_sensor]
        self.counts = None if sheet is None else sheet.counts_per_unit

    @property
    def bias_after_matrix(self) -> Values:
        """The bias in calibrated units: ``matrix @ bias``."""
        return np.asarray(self.matrix @ self.bias)

    @property
    def bias_deviation(self) -> Values:
        """Standard uncertainty of the bias; zeros if it is unknown."""
        return self.calibration.parameters.standard_uncertainty[BIAS] * self.factor

    @property
    def scale(self) -> Values:
        """Scale factors that best replace the full matrix.

        ``s_i = K_ii / |K_i|^2`` minimises ``E (t_i - s_i K_i t)^2`` over all directions of the truth t; K_i: rows of K.
        """
        return np.asarray(np.diag(self.K) / np.sum(self.K**2, axis=1))

    @cached_property
    def scale_error(self) -> float:
        """Root mean square error after a correction by ``scale``, relative to the truth, over all its directions.

        ``sqrt(sum_i (1 - K_ii^2 / |K_i|^2) / 3)``
        """
        return float(np.sqrt(np.sum(1.0 - np.diag(self.full_K) ** 2 / np.sum(self.full_K**2, axis=1)) / 3.0))

    @property
    def follows_temperature(self) -> bool:
        """Whether the bias depends on the temperature."""
        return bool(set(OF_THE_BIAS) & set(self.effects))

    @property
    def bias_polynomial(self) -> Values:
        """Coefficients of the bias in powers 0 to 3 of T - 25 degC: (3, 4) array, one row per axis."""
        polynomial = np.zeros((3, ORDER))
        polynomial[:, 0] = self.own_bias
        polynomial[:, 1] += self.effects.get("bias_temperature", np.zeros(3))
        polynomial[:, 1:3] += self.effects.get("bias_temperature_quadratic", np.zeros(6)).reshape(3, 2)
        polynomial[:, 1:] += self.effects.get("bias_temperature_cubic", np.zeros(9)).reshape(3, 3)
        return polynomial * self.factor

    def bias_at(self, temperature: float) -> Values:
        """Return the bias at a temperature, degC, in the unit of the format."""
        return np.asarray(self.bias_polynomial @ (temperature - REFERENCE_TEMPERATURE) ** np.arange(ORDER))

    @property
    def g_sensitivity(self) -> Values:
        """Change of the reading per specific force, in the unit of the format per g: (3, 3) array."""
        return self.effects.get("g_sensitivity", np.zeros(9)).reshape(3, 3) * self.factor

    @property
    def noise_density(self) -> float:
        """White noise by the sensor's file, unit/sqrt(Hz); 0 if it states none. ``KeyError`` without a file."""
        if self.sheet is None:
            raise KeyError("noise_density")
        return float((self.sheet.noise_density or 0.0) * self.factor)

    @property
    def temperature_polynomials(self) -> tuple[Values, Values]:
        """Coefficients in T, degC, of ``M(T)`` and ``b(T)`` in ``M raw + b``: (3, 3, 4) and (3, 4) arrays.

        A scale factor that depends on the temperature, K + D dT, is inverted to third order: ``M - M D M dT + ...``.
        """
        M, D = self.matrix, np.diag(self.effects.get("scale_factor_temperature", np.zeros(3)))
        powers = [M]
        while len(powers) < ORDER:
            powers.append(-powers[-1] @ D @ M)
        offset = self.bias_polynomial
        added = np.zeros((3, ORDER))
        for i, power in enumerate(powers):
            for j in range(ORDER - i):
                added[:, i + j] -= power @ offset[:, j]
        return shifted(np.stack(powers, axis=2), REFERENCE_TEMPERATURE, 0.0), shifted(added, REFERENCE_TEMPERATURE, 0.0)

    def left_by_matrix(self, part: str) -> list[str]:
        """Return a sentence on the error of a format with only this part of the matrix: full, diagonal or none."""
        if part == "full":
            return []
        # after a correction by only the bias, over all directions of the truth
        error, what = float(np.linalg.norm(np.eye(3) - self.full_K) / np.sqrt(3.0)), f"The matrix of the {self.name} is"
        if part == "diagonal":
            error, what = self.scale_error, f"Cross-axis terms of the {self.name} are"
        size = f"{error:.2g} g at 1 g" if self.name == "accelerometer" else f"{100 * error:.2g} % of the rate"
        return [f"{what} left out: that leaves about {size}."]


def shifted(coefficients: Values, before: float, after: float) -> Values:
    """Convert coefficients in T - before, low orders first along the last axis, to coefficients in T - after."""
    step, orders = after - before, range(coefficients.shape[-1])
    change = [[comb(k, j) * step ** (k - j) if j <= k else 0.0 for j in orders] for k in orders]
    return np.asarray(coefficients @ np.array(change), np.float64)


def before_use(document: dict[str, Any]) -> list[str]:
    """Return remarks before the use of an export: conversion to body axes, what is not known by recordings, priors."""
    maps = maps_of_log(document.get("log") or {})
    owners = dict.fromkeys(maps.values(), "sensor") if len(set(maps.values())) == 1 else {m: s for s, m in maps.items()}
    lines = []
    for axis_map, sensor in owners.items():
        if axis_map != STRAIGHT:
            pairs = ", ".join(f"{a} along body {b}" for a, b in zip("xyz", axis_map, strict=True))
            lines.append(f"Turn the readings to body axes first: the {sensor}'s {pairs}.")
    lines += [f"{s}: {text}." for s in SENSORS if (text := (document.get(s) or {}).get("not_determined"))]
    for sensor, prior in (document.get("lot_prior") or {}).items():
        state = prior["refused"] or f"{prior['siblings']} siblings; held-out errors are those without it"
        lines.append(f"With{'out' if prior['refused'] else ''} the prior of {prior['lot']}, {sensor}: {state}.")
    return lines + [line for s in SENSORS for line in sentences(s, document.get(s))]


def lower_times_rotation(K: Values) -> tuple[Values, Values]:
    """Return L (lower triangular, positive diagonal) and Q (orthonormal) with ``K = L Q``."""
    q, r = np.linalg.qr(K.T)
    sign = np.sign(np.diag(r))
    return (r * sign[:, None]).T, (q * sign).T


def rotation_times_lower(matrix: Values) -> tuple[Values, Values]:
    """Return Q (orthonormal) and L (lower triangular, positive diagonal) with ``matrix = Q L``."""
    q, r = np.linalg.qr(matrix[:, ::-1])
    sign = np.sign(np.diag(r))
    return (q * sign)[:, ::-1], (r * sign[:, None])[::-1, ::-1]


def row_lengths(F: Values) -> tuple[Values, Values]:
    """Return the lengths of the rows as a diagonal matrix, and the rows of unit length."""
    length = np.linalg.norm(F, axis=1)
    return np.diag(length), F / length[:, None]


@lru_cache(1)  # two formats have the factors
def accelerometer_frame(accelerometer: ExportedSensor | None, gyroscope: ExportedSensor | None) -> dict[str, Any]:
    """Return Kalibr's factors of both matrices, in the frame i in which the accelerometer's is lower triangular.

    ``a_meas = M_a f_i + b_a``, ``w_meas = M_g C w_i + A C f_i + b_w`` with M_a, M_g lower triangular and C a rotation.
    The factors are exact: ``K_a = M_a Q``, ``f_i = Q f``, ``K_g Q^T = M_g C``, ``A = G Q^T C^T``, G the g-sensitivity.
    """
    M_a, Q = (np.eye(3), np.eye(3)) if accelerometer is None else lower_times_rotation(accelerometer.K)
    frame = {"M_a": M_a, "T_i_b": pose(Q, np.zeros(3))}
    if gyroscope is None:
        return frame | {"M_g": np.eye(3), "C": np.eye(3), "A": np.zeros((3, 3))}
    M_g, C = lower_times_rotation(gyroscope.K @ Q.T)
    A = gyroscope.g_sensitivity / STANDARD_GRAVITY @ Q.T @ C.T
    return frame | {"M_g": M_g, "C": C, "A": A}


def pose(rotation: Values, place: Values) -> Values:
    """Return the (4, 4) transform T with ``p_i = T p_b``; rotation: from b to i; place: origin of i in axes of b."""
    R = np.asarray(rotation)
    return np.block([[R, (0.0 - R @ np.asarray(place))[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


def lever_arm_of(chip: dict[str, Any]) -> list[float]:
    """Return the position of a chip on a board, m; zeros for lever arms that could not be estimated."""
    parameters = (chip["parameters"].get(f"lever_arm_{axis}") for axis in AXES)
    return [p["value"] if p else 0.0 for p in parameters]


def static_transform(rotation: Values, place: Values) -> str:
    """Return the pose of a chip in the axes of the reference chip as options of ``static_transform_publisher``."""
    values = [*place, *scipy.spatial.transform.Rotation.from_matrix(np.asarray(rotation).T).as_quat().tolist()]
    return " ".join(f"--{n} {v:.9g}" for n, v in zip(("x", "y", "z", "qx", "qy", "qz", "qw"), values, strict=True))


def sampling_rate(document: dict[str, Any]) -> float:
    """Return the sampling rate of the first recording with a rate, Hz; 0 if none has one."""
    rates = [i["rate_hz"] for i in document.get("inputs", []) if i.get("rate_hz")]
    return float(rates[0]) if rates else 0.0


def temperatures(document: Mapping[str, Any]) -> list[float]:
    """Return the range of temperatures of a calibration's recordings, degC; if it is not known, ``TEMPERATURES``."""
    known = document.get("calibrated_range") or {}
    return known.get("soaked_degc") or known.get("temperature_degc") or TEMPERATURES


OF_POSES = (accelerometer_frame, lever_arm_of, pose, rotation_times_lower, row_lengths, static_transform, np.matmul)
OF_FIGURES = (nearest_density, sampling_rate, temperatures, np.sqrt)
TEMPLATE_FUNCTIONS: dict[str, Any] = {function.__name__: function for function in (*OF_POSES, *OF_FIGURES)} | {
    "identity": np.eye(3),
    "lower_half": np.triu_indices(3)[::-1],  # column by column
    "scaled": lambda value, factor: None if value is None else float(value * factor),
    "rint": lambda values: np.rint(values).astype(int).tolist(),
    "FACTORS": UNIT_FACTORS,
    "RADIAN": UNIT_FACTORS["rad/s"],
    "REFERENCE_TEMPERATURE": REFERENCE_TEMPERATURE,
    "SI": SI,
    "STANDARD_GRAVITY": STANDARD_GRAVITY,
    "clip": lambda value, limits: float(np.clip(value, *limits)),
}
