"""Simulate the recordings of a case, with exact geometry, and with noise and physics that the diagnosis does not model.

Additional noise continues over all recordings of a unit:

    ar_06, ar_09 : first-order autoregression with that coefficient, of the white noise's standard deviation
    random_walk  : sigma_b sqrt(t / T), the sensor file's wander sigma_b per its correlation time T
    one_over_f   : amplitudes of a spectrum 1/f, scaled to three times the sensor file's wander

and physics in a functional form that is not in the catalogue, with a separate size and sign on each axis:

    gear_mesh        : A cos(5 angle)
    temperature_step : A (1 + tanh((x - 1/2) / 0.04)) / 2
    saturation       : A tanh(4 x)
    exponential      : A (exp(3 x) - 1) / (exp(3) - 1)
    band             : A where 4 < |omega| < 7 deg/s

where x is the true temperature, scaled from 0 at the coldest sample of the unit to 1 at the warmest, and A is
``AMPLITUDE``.

The signal-to-noise ratio of a hidden effect is

    lambda = sum over axes of s^T C^-1 (s - P s)

where

    s : the signal of the effect in an axis: readings of the unit minus readings without the effect, at the same noise
    C : covariance of the true white noise and bias wander (``pipeline.estimation.gauss_markov``)
    P : the projection, in the metric C^-1, onto bias, truth and the signals of the other hidden effects

A test with known noise and equation gains lambda in 2 log L on average. A selection needs a gain of 40 to 100
(``pipeline.estimation.gates.min_gain``). The rounding to whole counts differs between the two simulations and adds
c^2 / 6 per sample on average, where c is one count; this is subtracted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import scipy

from imu_logs.yaml_file import read_yaml
from imu_research.study.cases import COURSES, INTERVAL_BY_HAND_S, INTERVAL_S, SIZES_FILE, StudyCase
from pipeline.core.records import SENSORS, Recording, Values
from pipeline.core.settings import DataSheet
from pipeline.estimation.engine import scaled_inverse
from pipeline.estimation.gates import min_gain
from pipeline.estimation.gauss_markov import Blocks, GaussMarkov, Setting
from pipeline.physics.effects import catalogue, effect
from pipeline.physics.effects.base import truth
from pipeline.physics.kinematics import reference_motion
from pipeline.simulation.campaign import Streams, random_environment, simulate_unit
from pipeline.simulation.description import Course, UnitDescription, shipped_settings
from pipeline.simulation.trajectory import Planned, random_gimbals

PERFECT = {"angle_accuracy_deg": 0.0, "rate_error": (0.0, 0.0, 0.0), "direction_deg": [[0.0, 0.0]] * 3}
OF_WHITE = {"ar_06": 0.6, "ar_09": 0.9}  # coefficient of the autoregression
AMPLITUDE: dict[str, dict[str, float]] = read_yaml(SIZES_FILE)["amplitude"]  # by shape and sensor
CURVES: dict[str, Callable[[Values], Values]] = {  # of the scaled temperature
    "temperature_step": lambda x: 0.5 + 0.5 * np.tanh((x - 0.5) / 0.04),
    "saturation": lambda x: np.tanh(4.0 * x),
    "exponential": lambda x: np.expm1(3.0 * x) / np.expm1(3.0),
}
WITHHELD = "withheld"
GAUSS_MARKOV = ("normal", "wander")  # families of noise for which lambda is known


def withheld_of(case: StudyCase) -> Recording:
    """Return motion on the table after the recordings of a case, which no step of a run sees."""
    motion = random_gimbals(Course.validation_s, Course.validation_rate_dps, np.random.default_rng([case.seed, 2]))
    return recordings_of(case, [Planned(WITHHELD, "validation", None, motion)])[-1]


def recordings_of(case: StudyCase, extra: Sequence[Planned] = ()) -> list[Recording]:
    """Return the recordings of a case, and of motion after them, without its truth."""
    sensor_model = shipped_settings(sensor=case.model).sensor
    noise_settings = {
        sensor: {
            "bias_wander": case.wander * sensor_model.of(sensor).bias_wander,
            "noise_density": 0.0 if case.noise in OF_WHITE else sensor_model.of(sensor).noise_density,
        }
        for sensor in SENSORS
    }
    course = COURSES.get(case.procedure, COURSES["stop_and_go"])
    if case.by_hand:
        course = {"positions": case.rests} if case.rests else {}
    unit = UnitDescription(
        "unit",
        sensor=case.model,
        table=case.table,
        procedure=case.procedure if case.by_hand else "thermal_ramp" if case.kind == "lag" else "three_axis_turns",
        course=course,
        interval_s=_interval(case),
        lost=0.1 if case.noise == "lost" else 0.0,
        accelerometer=noise_settings["accelerometer"],
        gyroscope=noise_settings["gyroscope"],
        effects={f"{case.sensor}.{name}": values for name, values in case.hidden.items()},
        temperature={} if case.room_degc is None else {"drift": case.room_degc},
        imperfections=PERFECT,  # errors of the table would be effects that are not in the truth of the case
    )
    recordings, _ = simulate_unit(unit, case.seed, case.number, extra)
    if case.procedure == "at_rest":
        recordings = [
            r.select((r.table_rate == 0.0) & (np.diff(r.table_angle, prepend=0.0) == 0.0))
            if r.table_angle is not None and r.table_rate is not None
            else r  # held-out motion
            for r in recordings
            if r.role != "gyroscope"
        ]
    rng = np.random.default_rng([case.seed, case.number, 1])
    for sensor in SENSORS:
        recordings = _with_noise(recordings, sensor, case, sensor_model.of(sensor), rng)
    if case.shape:
        recordings = _with_shape(recordings, case)
    if case.noise == "cold":
        recordings = [replace(r, temperature=None) for r in recordings]
    if case.noise == "coarse":
        recordings = [replace(r, temperature=np.round(2.0 * np.asarray(r.temperature)) / 2.0) for r in recordings]
    return recordings


def _with_noise(
    recordings: list[Recording], sensor: str, case: StudyCase, data_sheet: DataSheet, rng: np.random.Generator
) -> list[Recording]:
    """Add noise that the simulator does not have to one sensor, continuous over all recordings of the unit."""
    first = min(float(r.time[0]) for r in recordings)
    last = max(float(r.time[-1]) for r in recordings)
    noise, interval, wander = case.noise, _interval(case), data_sheet.bias_wander
    count = int((last - first) / interval) + 2
    if noise in OF_WHITE:
        drive = np.sqrt(1.0 - OF_WHITE[noise] ** 2) * rng.standard_normal((count, 3))
        drive[0] = rng.standard_normal(3)
        added = data_sheet.white(INTERVAL_S) * scipy.signal.lfilter([1.0], [1.0, -OF_WHITE[noise]], drive, axis=0)
    elif noise == "random_walk":
        step = wander * np.sqrt(interval / data_sheet.wander_time_s)
        added = np.cumsum(step * rng.standard_normal((count, 3)), axis=0)
    elif noise == "one_over_f":
        shape = np.concatenate([[0.0], 1.0 / np.sqrt(np.fft.rfftfreq(count)[1:])])
        spectrum = np.fft.rfft(rng.standard_normal((count, 3)), axis=0) * shape[:, None]
        values = np.fft.irfft(spectrum, count, axis=0)
        added = 3.0 * wander * (values / values.std(axis=0))
    else:
        return recordings
    return [_added(r, sensor, added[np.rint((r.time - first) / interval).astype(int)]) for r in recordings]


def _interval(case: StudyCase) -> float:
    return INTERVAL_BY_HAND_S if case.by_hand else INTERVAL_S


def _with_shape(recordings: list[Recording], case: StudyCase) -> list[Recording]:
    """Add physics in a functional form that is not in the catalogue."""
    if case.shape in CURVES:
        room = random_environment(Streams(case.seed, case.number)["room"])
        room = room if case.room_degc is None else replace(room, drift=case.room_degc)
        temperatures = [room.temperature(r.time) for r in recordings]
        seen = np.concatenate([w for w, r in zip(temperatures, recordings, strict=True) if r.name != WITHHELD])
        low, high = float(seen.min()), float(seen.max())
        signals = [CURVES[case.shape]((w - low) / (high - low)) for w in temperatures]
    else:
        signals = [_of_motion(case.shape, r) for r in recordings]
    size = AMPLITUDE[case.shape][case.sensor] * np.array(case.amplitude)
    return [_added(r, case.sensor, signal[:, None] * size) for r, signal in zip(recordings, signals, strict=True)]


def _of_motion(shape: str, recording: Recording) -> Values:
    if shape == "gear_mesh" and recording.table_angle is not None and recording.role != "static":
        return np.asarray(np.cos(np.radians(5.0 * recording.table_angle)), np.float64)
    motion = reference_motion(recording, 1.0)
    if shape == "band" and motion is not None:
        speed = np.linalg.norm(motion.angular_rate, axis=1)
        return np.asarray((speed > 4.0) & (speed < 7.0), np.float64)
    return np.zeros(recording.samples)


def _added(recording: Recording, sensor: str, values: Values) -> Recording:
    added: dict[str, Any] = {sensor: np.asarray(recording.reading(sensor)) + values}
    return replace(recording, **added)


def signals_left(case: StudyCase) -> dict[str, float]:
    """Return lambda of each hidden effect; empty by hand, or for other noise than white and Gauss-Markov."""
    if not case.hidden or case.by_hand or case.noise not in GAUSS_MARKOV:
        return {}
    recordings = _used(case)

    def reading(recordings: list[Recording]) -> Values:
        return np.concatenate([np.asarray(r.reading(case.sensor)) for r in recordings])

    signals = []
    for name in case.hidden:
        others = {other: values for other, values in case.hidden.items() if other != name}
        signals.append(reading(recordings) - reading(_used(replace(case, hidden=others))))
    bench = shipped_settings(sensor=case.model, table="acutronic")
    data_sheet, gravity = bench.sensor.of(case.sensor), bench.table.gravity_g
    motions = [motion for r in recordings if (motion := reference_motion(r, gravity)) is not None]
    time = np.concatenate([r.time for r in recordings])
    base = np.concatenate([truth(case.sensor, motion) for motion in motions])
    columns = np.column_stack([np.ones(len(time)), base, *signals])
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    white, n = data_sheet.white(INTERVAL_S), len(time)
    each = Blocks(np.arange(n), np.ones(n), time, np.zeros(n), np.zeros(n, np.int64))
    noise = GaussMarkov(each, [Setting(case.wander * data_sheet.bias_wander / white, data_sheet.wander_time_s)])
    products = noise.products(columns / size)[0] * np.outer(size, size) / white**2
    rounding = 3 * n / (6.0 * data_sheet.counts_per_unit**2 * white**2)
    found = dict.fromkeys(case.hidden, -rounding)
    for column in range(4, len(size)):  # its squared norm minus that of its projection
        others_of_axis = [*range(4), *(c for c in range(4 + (column - 4) % 3, len(size), 3) if c != column)]
        cross = products[others_of_axis, column]
        inverse = scaled_inverse(products[np.ix_(others_of_axis, others_of_axis)])
        found[list(case.hidden)[(column - 4) // 3]] += float(products[column, column] - cross @ inverse @ cross)
    return {name: max(0.0, value) for name, value in found.items()}


def at_detection(case: StudyCase) -> StudyCase:
    """Scale the effect of a case of the families ``limit`` to the stated share of its detection size.

    At the detection size, lambda is the threshold of the selection. lambda grows as the square of the size; a time
    constant is not scaled. Cases of other families are returned unchanged.
    """
    if case.kind != "limit":
        return case
    ((name, values),) = case.hidden.items()
    count = len(values)
    samples = 3.0 * sum(r.samples for r in _used(case))
    gate = min_gain(effect(name), case.sensor, count, samples, len(catalogue()))
    share = int(case.family.partition("_")[2]) / 100.0 * np.sqrt(gate / signals_left(case)[name])
    kept = [p.name == "time_constant" for p in effect(name).parameters(case.sensor)]
    return replace(case, hidden={name: np.where(kept, values, share * np.array(values)).tolist()})


def _used(case: StudyCase) -> list[Recording]:
    """Return the recordings that a fit uses, in order of time."""
    return sorted((r for r in recordings_of(case) if r.role in SENSORS), key=lambda r: int(r.time_ns[0]))
