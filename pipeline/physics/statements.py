"""State what a calibration contradicts or leaves open: limits of the sensor file, open effects, rows left out.

A parameter far outside the limits of the sensor model nearly always means another range, unit or column. With

    reading = bias + K truth + ...,    K = matrix^-1 = P R

where

    P : (3, 3) symmetric, ``(K K^T)^(1/2)``: scale factors on its diagonal, cross-axis sensitivities off it
    R : (3, 3) rotation, of the unit against the table or its case: no property of the sensor

A parameter p with the expanded uncertainty U and the data sheet's limit L is implausible where

    |p| - 2 U > max(4 L, F)

and outside the data sheet's limit where ``|p| > L``: one list, ``beyond_limits``, which the run stores and all pages,
the summary, the certificate and the terminal show.

A data sheet states L as a bound, or as one standard deviation. Four of these are exceeded by a good sensor's 12
parameters in 12 * 6.3e-5 = 0.08 % of units; 2 U are four standard uncertainties. F is what a low-cost sensor is allowed
(MPU-6000/6050 product specification 3.4, relative to its range): the sheet of a better one holds for its own mounting
and its own bench, and the STIM300 of the founding thesis departs from its sheet by 17 L in bias and 10 L in scale
factor.

Open effects are those of the sensor file that the recordings leave open, with their largest change of bias and matrix.

The expanded uncertainty U is valid if these effects are absent. With each as a rectangular distribution within +-a, a
its largest change of a parameter (JCGM 100:2008, 4.3.7):

    U_open = k sqrt((U / k)^2 + sum a^2 / 3)

Earth's rotation and the sensor's clock are such effects where the budget does not include them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from imu_logs.units import TRIADS
from pipeline.core.errors import ConfigurationError, shortened
from pipeline.core.records import (
    AXES,
    BASE,
    BASE_NAMES,
    BIAS_NAMES,
    LIMIT,
    MATRIX_NAMES,
    NOT_ESTIMATED,
    SENSOR_UNITS,
    FittedEffect,
    SensorCalibration,
    Values,
    base_values,
    shaped,
)
from pipeline.core.settings import DataSheet
from pipeline.core.verdicts import WITH_THEM
from pipeline.physics.effects import effect, effect_of
from pipeline.physics.effects.base import parameter_limits

DIFFERENT = 1.1  # ratio of both uncertainties above which pages, terminal and certificate state both
NAMED_EFFECTS = 4  # in a sentence
NEGLIGIBLE = 1e-3  # of U of every parameter: a change below it is not listed
OF_BUDGET = {"time base": "clock_rate", "Earth's rotation": "earth_rotation"}  # source that is not included: its effect
ESTIMATE_IT = (
    "choose a method that estimates it (method=rests_and_moves by hand, method=reference_least_squares on a table)"
)
NOT_DIAGNOSED = "the diagnosis failed, so that it is not known what the recordings show"
LEFT_OUT_REASONS = {"N-STUCK": "stuck", "N-CLIP": "clipped", "N-DISTURBED": "glitches or knocks"}
LEFT_OUT_REASONS |= {"N-SHAKEN": "shaken at rest", "N-MOVED": "moving"}
MULTIPLE = 4.0  # see above
LOW_COST_BIAS = {"accelerometer": 0.08 / 2.0, "gyroscope": 20.0 / 250.0}  # share of the range, see above
LOW_COST_SCALE, LOW_COST_CROSS = 0.03, 0.02  # see above
EQUAL_SPREAD = 0.1  # relative spread of the three scale factors that have one cause
FACTOR_DISTANCE = 0.03  # relative distance from a factor by which it is recognised, as a low-cost scale factor's limit
MISTAKEN_FACTORS = {
    "accelerometer": {
        9.80665: "in m/s^2, and read as g",
        1000.0: "in mg, and read as g",
        1.0 / 9.80665: "in g, and read as m/s^2",
    },
    "gyroscope": {
        np.pi / 180.0: "in rad/s, and read as deg/s",
        180.0 / np.pi: "in deg/s, and read as rad/s",
        1000.0: "in mdeg/s, and read as deg/s",
        1.0 / 6.0: "in revolutions a minute, and read as deg/s",
    },
}
NAMED_PARAMETERS = 5  # parameters beyond the limits that a line names
RANGE_RATIOS = [2.0**n for n in range(-6, 7) if n]  # ratios of the ranges of one sensor: neighbours differ by two
CAUSES_OF_BIAS = "an offset of raw counts that is not subtracted, another column, or a damaged axis"
OF_CROSS_AXIS = "another column or axis map, or a unit that moved on the table between recordings"
OF_FRAME = "the angles between the calibrated axes and the case"
NO_FRAME = "how the case lies to turn axes, faces and zeros is not stated (table.seat_deg, procedure.faces)"
OF_EFFECT = "another effect that looks alike, or an error of the table, its log or the time stamps"
Entry = dict[str, Any]
# name, value, uncertainty, unit, limit, floor, likely cause
LimitRow = tuple[str, float, float, str, float, float, str]


def with_open(sensor: str, fit: SensorCalibration, hidden: Mapping[str, Mapping[str, str] | None]) -> dict[str, Any]:
    """Return ``open`` and ``uncertainty_with_open`` of a sensor's part of ``calibrations/<unit>.json``.

    ``hidden``: of each sensor, the effects that are not observable with their reasons; None where the diagnosis failed.
    """
    parameters = fit.parameters
    U, k = (values[BASE] for values in (parameters.expanded_uncertainty, parameters.coverage_factor))
    found = list(_open(sensor, fit, hidden, U))
    u_open = np.sqrt((U / k) ** 2 + sum((a**2 / 3.0 for _, a, _ in found), np.zeros(len(U))))
    largest = [{"effect": name, "up_to": shaped(a), "reason": reason} for name, a, reason in found]
    return {"open": largest, "uncertainty_with_open": shaped(k * u_open)}


def _open(
    sensor: str, calibration: SensorCalibration, hidden: Mapping[str, Mapping[str, str] | None], U: Values
) -> Iterator[tuple[str, Values, str]]:
    """Yield name, largest change of bias and matrix, (12,), and reason of each open effect.

    A change by a contained effect that the recordings show is not open. Nor is an effect that is proportional to one
    that they show and that is not in the model, such as a lag of the thermometer where the bias does not depend on it.
    """
    reasons: dict[str, str] = {}
    for name in calibration.at_limits:
        owner, _, plain = name.rpartition(".")
        of_sensor = hidden.get(owner or sensor)
        reason = NOT_DIAGNOSED if of_sensor is None else of_sensor.get(plain)
        if reason:
            reasons[name] = reason
    for name in [*reasons]:
        owner, _, plain = name.rpartition(".")
        other = f"{owner}.{effect(plain).scales_with}".lstrip(".")
        if other in calibration.at_limits and other not in reasons:
            del reasons[name]
    fitted = {e.name for e in calibration.effects}
    contained = {f"{name.rpartition('.')[0]}.{other}".lstrip(".") for name in reasons
                 for other in effect(name.rpartition(".")[2]).contains}  # fmt: skip
    for name, reason in reasons.items():
        owner, _, plain = name.rpartition(".")
        within = [f"{owner}.{other}".lstrip(".") for other in effect(plain).contains]
        known = [other for other in within if other in calibration.at_limits and other not in reasons]
        seen = [_largest(calibration, other) for other in known]
        a = np.clip(_largest(calibration, name) - np.max([*seen, np.zeros(len(U))], axis=0), 0.0, None)
        if name not in contained | fitted and np.any(a > NEGLIGIBLE * U):
            yield name, a, reason
    for entry in calibration.budget.not_included if calibration.budget else ():
        if entry.up_to and entry.source in OF_BUDGET:
            bias = np.full(3, entry.up_to.get("bias", 0.0))
            up_to = entry.up_to.get("matrix", 0.0) * np.abs(calibration.matrix)
            yield OF_BUDGET[entry.source], base_values(bias, up_to), entry.reason


def _largest(calibration: SensorCalibration, name: str) -> Values:
    """Return the largest change of bias and matrix by an effect, (12,)."""
    return np.asarray(np.abs(calibration.at_limits[name]).sum(axis=1))


def both_figures(part: Mapping[str, Any] | None) -> dict[str, tuple[float, float]]:
    """Return U without and with the open effects, of each parameter of bias and matrix where they differ by over 10 %.

    ``part``: a sensor's part of ``calibrations/<unit>.json``; empty without ``uncertainty_with_open``.
    """
    wide = (part or {}).get("uncertainty_with_open")
    if part is None or not wide:
        return {}
    pairs = zip(BASE_NAMES, *(map(float, _flat(each)) for each in (part["expanded_uncertainty"], wide)), strict=True)
    return {name: (U, open_) for name, U, open_ in pairs if open_ > DIFFERENT * U}


def _flat(values: Mapping[str, Any]) -> Values:
    return base_values(np.array(values["bias"], float), np.array(values["matrix"], float))


def open_words(part: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    """Return the open effects of a sensor with both uncertainties, and what they mean; empty without a difference."""
    both = both_figures(part)
    if part is None or not both:
        return []
    figures: list[str] = []
    for kind, unit in (("bias", f" {part['unit']}"), ("matrix", "")):
        U, wide = np.max([pair for name, pair in both.items() if name.startswith(kind)] or [(0.0, 0.0)], axis=0)
        figures += [f"{kind} is up to {wide:.2g}{unit} in place of {U:.2g}"] if wide else []
    names = [entry["effect"].replace("_", " ").replace(".", ": ") for entry in part["open"]]
    source = f"{', '.join(shortened(names, NAMED_EFFECTS))}{WITH_THEM}{', of the '.join(figures)})"
    return [(source, "these recordings leave them open, and U is valid if they are absent")]


def implausible(rows: Sequence[LimitRow]) -> list[Entry]:
    """Return the fitted parameters of ``limited`` that are outside the data sheet's limits, the largest ratio first.

    An entry has ``parameter``, ``value``, ``unit``, ``limit`` of the sensor file, ``ratio`` of the two and
    ``likely_cause``.
    """
    far = [row for row in rows if abs(row[1]) - 2.0 * row[2] > max(MULTIPLE * row[4], row[5])]
    return [_entry(row) | {"likely_cause": row[-1]} for row in far]


def beyond_limits(rows: Sequence[LimitRow]) -> list[Entry]:
    """Return as ``implausible``, without a cause, the parameters beyond the limit, the largest ratio first."""
    return [_entry(row) for row in rows if abs(row[1]) > row[4]]


def beyond_words(part: Mapping[str, Any] | None) -> str:
    """Return the entries of ``beyond_limits`` in a calibration in words: ``bias y (250 %), ...``; empty for none."""
    entries = (part or {}).get("beyond_limits") or []
    return ", ".join(shortened([f"{_plain(e)} ({100.0 * e['ratio']:.3g} %)" for e in entries], NAMED_PARAMETERS))


def _entry(row: LimitRow) -> Entry:
    name, value, _, unit, limit, *_ = row
    return {"parameter": name, "value": value, "unit": unit, "limit": limit, "ratio": abs(value) / limit}


def limited(sensor: str, part: Mapping[str, Any], data_sheet: DataSheet) -> list[LimitRow]:
    """Return the rows of all parameters that the sensor file limits, the largest ratio first.

    ``part`` is the sensor's part of ``calibrations/<unit>.json``, ``data_sheet`` the figures of the sensor.
    """
    rows = [*_of_bias_and_matrix(sensor, part, data_sheet), *limited_effects(sensor, part, data_sheet.effects)]
    return sorted(rows, key=lambda row: -abs(row[1]) / row[4])


def without_rotation(matrix: Values) -> Values:
    """Return P of ``matrix^-1 = P R``: (3, 3) symmetric array."""
    K = np.linalg.inv(matrix)
    squares, axes = np.linalg.eigh(K @ K.T)
    return np.asarray((axes * np.sqrt(squares)) @ axes.T)


def _of_bias_and_matrix(sensor: str, part: Mapping[str, Any], data_sheet: DataSheet) -> Iterator[LimitRow]:
    """Yield the rows of biases, scale factors and cross-axis sensitivities."""
    K, P = np.linalg.inv(np.array(part["matrix"], float)), without_rotation(np.array(part["matrix"], float))
    spread = part["expanded_uncertainty"]
    of_matrix = np.abs(K) @ np.array(spread["matrix"], float) @ np.abs(K)  # dK = -K dM K
    floor, unit = LOW_COST_BIAS[sensor] * data_sheet.full_scale, SENSOR_UNITS[sensor]
    for name, value, uncertainty in zip(BIAS_NAMES, part["bias"], spread["bias"], strict=True):
        yield name, float(value), float(uncertainty), unit, data_sheet.bias, floor, CAUSES_OF_BIAS
    scale, limit = _scale_cause(sensor, np.diag(P)), data_sheet.scale_factor
    for i, a in enumerate(AXES):
        yield f"scale_factor_{a}", float(P[i, i] - 1.0), float(of_matrix[i, i]), "1", limit, LOW_COST_SCALE, scale
    for i, j in ((0, 1), (0, 2), (1, 2)):
        name, limit = f"cross_axis_{AXES[i]}{AXES[j]}", data_sheet.cross_axis
        yield name, float(P[i, j]), float(of_matrix[i, j]), "1", limit, LOW_COST_CROSS, OF_CROSS_AXIS


def limited_effects(sensor: str, part: Mapping[str, Any], limits: Mapping[str, float]) -> Iterator[LimitRow]:
    """Yield the rows of the effects' parameters that have an uncertainty and a limit; ``limits``: of the effects."""
    for entry in part.get("effects") or []:
        try:
            effect = effect_of(FittedEffect(entry["name"], {}, entry.get("definition")))
        except ConfigurationError:
            continue  # an effect in Python that is not loaded here: its limits are unknown
        sizes = parameter_limits(effect, sensor, limits)
        for (symbol, p), limit in zip(entry["parameters"].items(), sizes, strict=True):
            spread = p.get("expanded_uncertainty")
            if np.isfinite(limit) and spread is not None:
                name, value = f"{entry['name']}.{symbol}", float(p["value"])
                yield name, value, float(spread), p["unit"], float(limit), 0.0, OF_EFFECT


def _scale_cause(sensor: str, factors: np.ndarray) -> str:
    mean = float(np.mean(factors))
    if np.ptp(factors) > EQUAL_SPREAD * mean:
        return "another column, counts per unit or axis map of this axis, or a damaged axis"
    unit = next((u for f, u in MISTAKEN_FACTORS[sensor].items() if abs(mean / f - 1.0) < FACTOR_DISTANCE), None)
    if unit is not None:
        return f"readings {mean:.4g} times the truth: they are {unit}; set the unit of their columns in ingest"
    column = TRIADS[sensor][0]
    setting = f"set sensor.{sensor}.range, and counts_per_unit of the columns ({column} ...) if ingest states its own"
    if any(abs(mean / f - 1.0) < FACTOR_DISTANCE for f in RANGE_RATIOS):
        return f"readings {mean:.4g} times the truth: the sensor was set to another range; {setting}"
    return f"readings {mean:.4g} times the truth: the sensor was probably set to another range or unit; {setting}"


def sentences(sensor: str, part: Mapping[str, Any] | None) -> list[str]:
    """Return a sentence for each cause of implausible parameters; ``part``: of ``calibrations/<unit>.json``."""
    by_cause: dict[str, list[Entry]] = {}
    for entry in (part or {}).get("implausible") or []:
        by_cause.setdefault(entry["likely_cause"], []).append(entry)
    found = []
    for cause, entries in by_cause.items():
        worst = max(entries, key=lambda e: e["ratio"])
        names = ", ".join(map(_plain, entries))
        unit = "" if worst["unit"] == "1" else f" {worst['unit']}"
        found.append(
            f"Implausible for this model of {sensor}: {names}; {_plain(worst)} is {worst['value']:+.4g}{unit}, "
            f"{worst['ratio']:.3g} times the data sheet's limit of {worst['limit']:.4g}{unit}. Likely cause: {cause}. "
            f"Where it is meant so: sensor.{sensor}.accept_implausible=true."
        )
    return found


def _plain(entry: Entry) -> str:
    """Return the name of an entry's parameter in words: ``g sensitivity kg xx`` for ``g_sensitivity.kg_xx``."""
    return str(entry["parameter"]).replace(".", " ").replace("_", " ")


def beyond_uncertainty(part: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    """Return the error sources that are not in the expanded uncertainty U of a sensor and can exceed U.

    Each entry is the source with its size, and the reason why U does not include it. A relative error of the matrix
    changes the scale factors most, so that it is compared with their U. ``part``: of ``calibrations/<unit>.json``.
    """
    found, left_open = [], open_words(part)
    part = part or {}
    listed = {entry["effect"] for entry in part.get("open") or []} if left_open else set()
    for entry in (part.get("uncertainty_budget") or {}).get("not_included", []):
        if OF_BUDGET.get(entry["source"]) in listed:
            continue
        for key, size in entry.get("up_to", {}).items():
            U = part["expanded_uncertainty"][key]
            if size > max(u or 0.0 for u in (U if key == "bias" else np.diag(U))):
                of = f"{size:.2g} {part['unit']} of bias" if key == "bias" else f"{100.0 * size:.2g} % of the matrix"
                found.append((f"{entry['source']}, up to {of}", entry["reason"].partition("; up to ")[0]))
    if part.get("frame_deg", ()) is None:
        found.append((OF_FRAME, NO_FRAME))
    return found + left_open


def frame_words(part: Mapping[str, Any] | None) -> str:
    """Return how well the body frame of a sensor is known against the case; empty where nothing is stated."""
    frame = (part or {}).get("frame_deg")
    sizes = frame and ", ".join(f"{u:.2g}" for u in frame)
    return f"The calibrated axes are known against the case to {sizes} deg about x, y, z (95 %)" if sizes else ""


def not_determined(part: Mapping[str, Any]) -> str:
    """Return which parameters the recordings do not determine, and which would; empty if all are determined."""
    lines = (part.get("uncertainty_budget") or {}).get("contributions") or []
    names = next((str(line["remark"]) for line in lines if line["source"] == LIMIT), "")
    if not names:
        return ""
    if names.startswith(NOT_ESTIMATED):
        kept = names.removeprefix(NOT_ESTIMATED).replace(", ".join(MATRIX_NAMES), "the matrix")
        return f"the method does not estimate {kept}, known by the limit of the sensor file alone: {ESTIMATE_IT}"
    advice = "rest the unit in more attitudes, also half-way between two axes"
    if "bias_" in names or "scale_factor_" in names:
        advice = "rest the unit in more attitudes, each axis up and down, also half-way between two axes"
    if "matrix_" in names:
        about = [axis for axis in "xyz" if f"matrix_{axis}{axis}" in names]
        ways = [f"turn the unit about {' and '.join(about)} by a known angle"] if about else []
        axes = next((d for stage in part["stages"] if (d := stage["details"].get("turn_axes"))), None)
        if axes and axes["stated_deg"] > axes["needed_deg"]:
            needed = np.floor(100.0 * axes["needed_deg"]) / 100.0
            told = f"set procedure.turns.axis_accuracy_deg (now {axes['stated_deg']:g}) to {needed:g} or less"
            ways.append(f"{told}, where the axes of the turns are known so well")
        told = "log the accelerometer too, in rests in many attitudes with moves between them"
        ways.append(f"{told}, or before and after turns by 90 and -90 deg about each axis with gravity across it")
        return f"the recordings do not determine {names} better than the limit of the sensor file: {', or '.join(ways)}"
    return f"the rests do not determine {names} better than the limit of the sensor file: {advice}"


def left_out(inputs: Sequence[Mapping[str, Any]] | None) -> list[str]:
    """Describe the rows of each recording that no fit uses: ``404 of 18,247 rows of gyro_z (3.2 s stuck)``.

    ``inputs``: as in ``calibrations/<unit>.json``. Missing time is stated as a share of the duration.
    """
    found = []
    for entry in inputs or []:
        name, rate, rows = entry.get("recording") or entry.get("file"), entry.get("rate_hz"), entry.get("rows")
        counts: dict[str, list[int]] = {}
        if missing := entry.get("missing_s"):
            found.append(f"{name}: {missing / entry['duration_s']:.3%} of the time is missing")
        for note in entry.get("notes") or []:
            if note["code"] in LEFT_OUT_REASONS:
                counts.setdefault(note["code"], []).append(note["count"])
        for code, each_note in counts.items():
            several = code == "N-CLIP" and len(each_note) > 1  # a note for each channel, some for the same rows
            count = max(each_note) if several else sum(each_note)
            share = f"{'at least ' * several}{count:,}{f' of {rows:,}' if rows else ''} rows of {name}"
            found.append(f"{share} ({f'{count / rate:.2g} s ' if rate else ''}{LEFT_OUT_REASONS[code]})")
    return found
