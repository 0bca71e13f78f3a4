from __future__ import annotations

import json
import os
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

import pipeline
from pipeline.core.errors import ConfigurationError, ConvergenceError, InputError, MissingInputError, PipelineError
from pipeline.core.records import SENSORS, Coefficient, FittedEffect, Motion, SensorCalibration
from pipeline.physics.compensation import BLOCK, Compensation, load
from pipeline.physics.effects import catalogue, effect_from
from pipeline.physics.effects.base import Owner
from pipeline.physics.measurement import ExponentialRegression, compensate, predicted_reading

SIZE = {"accelerometer": 2e-3, "gyroscope": 1e-5}
EFFECTS = [(s, e.name) for s in SENSORS for e in catalogue().values() if e.owner == Owner.SENSOR and s in e.sensors]


def motion(n: int = 400, seed: int = 0, dt: float = 0.01) -> Motion:
    """A smooth random motion whose fields are consistent with backward differences of its signals."""
    rng = np.random.default_rng(seed)
    time = 5.0 + dt * np.arange(n)
    phase, speed = rng.uniform(0, 6, (2, 3)), rng.uniform(0.5, 3.0, (2, 3))
    force = np.sin(time[:, None] * speed[0] + phase[0])
    rate = 80.0 * np.sin(time[:, None] * speed[1] + phase[1])
    zero = np.zeros((1, 3))
    return Motion(
        time=time,
        specific_force=force,
        angular_rate=rate,
        angular_acceleration=np.concatenate([zero, np.diff(rate, axis=0) / np.diff(time)[:, None]]),
        specific_force_rate=np.concatenate([zero, np.diff(force, axis=0) / np.diff(time)[:, None]]),
        temperature=25.0 + 0.5 * (time - 5.0),
        temperature_rate=np.where(time > 5.0, 0.5, 0.0),
        angle=None,
        rate=None,
        axis=None,
        still=np.zeros(n, bool),
    )


def fitted(name: str, sensor: str, seed: int = 1) -> FittedEffect:
    rng, this, m = np.random.default_rng(seed), catalogue()[name], motion()
    parameters = {}
    columns = this.columns(sensor, m, np.eye(3), np.ones(len(this.parameters(sensor))))
    most = 0.1 * np.max(np.abs(truth(sensor, m))) / np.max(np.abs(columns), axis=(0, 1), initial=1e-300)
    for p, limit in zip(this.parameters(sensor), most, strict=True):
        value = 120.0 if p.unit == "s" else rng.uniform(-1, 1) * min(SIZE[sensor], limit)
        parameters[p.name] = Coefficient(value, p.unit, 0.0)
    return FittedEffect(name, parameters)


def calibration(sensor: str, effects: tuple[FittedEffect, ...] = ()) -> SensorCalibration:
    rng = np.random.default_rng(7)
    return SensorCalibration(
        sensor, bias=rng.uniform(-0.1, 0.1, 3), matrix=np.eye(3) + rng.uniform(-0.03, 0.03, (3, 3)), effects=effects
    )


def truth(sensor: str, m: Motion) -> np.ndarray:
    return m.specific_force if sensor == "accelerometer" else m.angular_rate


@pytest.mark.parametrize("sensor", SENSORS)
def test_linear_compensation_inverts_the_measurement_equation(sensor: str) -> None:
    m, c = motion(), calibration(sensor)
    found = compensate(c, predicted_reading(c, m), m)
    assert np.max(np.abs(found - truth(sensor, m))) < 1e-12 * max(1.0, np.max(np.abs(truth(sensor, m))))


@pytest.mark.parametrize(("sensor", "name"), EFFECTS)
def test_every_effect_of_a_sensor_is_inverted(sensor: str, name: str) -> None:
    m, c = motion(), calibration(sensor, (fitted(name, sensor),))
    reading = predicted_reading(c, m)
    assert np.max(np.abs(reading - predicted_reading(calibration(sensor), m))) > 1e-6
    assert np.max(np.abs(compensate(c, reading, m) - truth(sensor, m))) < 1e-9


@pytest.mark.parametrize(("sensor", "name"), EFFECTS)
def test_every_effect_is_inverted_from_the_logs_own_signals(sensor: str, name: str) -> None:
    m = motion()
    unit = {s: calibration(s, (fitted(name, s),) if s == sensor else ()) for s in SENSORS}
    found = Compensation(**unit).apply(
        predicted_reading(unit["accelerometer"], m), predicted_reading(unit["gyroscope"], m), m.temperature, m.time
    )
    assert np.max(np.abs(found.accelerometer - m.specific_force)) < 1e-9
    assert np.max(np.abs(found.gyroscope - m.angular_rate)) < 1e-9


def everything() -> dict[str, SensorCalibration]:
    return {s: calibration(s, tuple(fitted(n, t, 3) for t, n in EFFECTS if t == s)) for s in SENSORS}


def test_all_effects_of_both_sensors_are_inverted_together() -> None:
    m, unit = motion(), everything()
    readings = [predicted_reading(unit[s], m) for s in SENSORS]
    accelerometer, gyroscope = Compensation(**unit).apply(*readings, m.temperature, m.time)
    assert np.max(np.abs(accelerometer - m.specific_force)) < 1e-9
    assert np.max(np.abs(gyroscope - m.angular_rate)) < 1e-9


def own_effect(sensor: str) -> FittedEffect:
    """An effect from formulas, which the calibration carries with it."""
    definition = {
        "name": "own",
        "meaning": "my own",
        "sensors": [sensor],
        "owner": "sensor",
        "terms": {
            "p": {"formula": "tanh(u / 50) * exp(-time / 100) + sqrt(speed + 1)", "unit": "1"},
            "q": {"formula": "tanh(alphax / 500) * (temperature - 25)", "unit": "1"},
        },
    }
    made = effect_from(definition, "test")
    names = [p.name for p in made.parameters(sensor)]
    values = np.random.default_rng(5).uniform(-1e-3, 1e-3, len(names))
    parameters = {n: Coefficient(v, "1", 0.0) for n, v in zip(names, values, strict=True)}
    return FittedEffect("own", parameters, made.definition)


def some_steady_some_moving() -> dict[str, SensorCalibration]:
    """Effects that one round takes off: none looks at a truth that another changes."""
    return {
        "accelerometer": calibration("accelerometer", (fitted("bias_temperature", "accelerometer"),)),
        "gyroscope": calibration("gyroscope", (fitted("g_sensitivity", "gyroscope"), fitted("warm_up", "gyroscope"))),
    }


def one_after_the_other() -> dict[str, SensorCalibration]:
    """A gyroscope that is solved by fixed point, and an accelerometer that looks at what it has found."""
    cubic = fitted("cubic_nonlinearity", "gyroscope")  # as strong as makes the number of rounds vary
    return {
        "accelerometer": calibration("accelerometer", (fitted("inner_lever_arms", "accelerometer"),)),
        "gyroscope": calibration("gyroscope", (cubic.at([2e-6] * len(cubic.parameters)),)),
    }


def noisy_log(unit: dict[str, SensorCalibration], n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    m = motion(n)
    rng = np.random.default_rng(2)
    a, g = (predicted_reading(unit[s], m) + 1e-3 * rng.standard_normal((n, 3)) for s in SENSORS)
    g[100:120] = 0.0  # no turn: its last direction is kept
    a[n // 2, 1] = g[n // 3, 0] = np.nan
    return a, g, m.temperature + 0.05 * rng.standard_normal(n), m.time + 1e-4 * rng.uniform(size=n)


@pytest.mark.parametrize("size", [1, 7, 150])
@pytest.mark.parametrize("effects", ["all", "own", "one round", "in turn", "none"])
def test_samples_one_by_one_and_blocks_give_the_same_numbers_as_one_piece_to_the_last_bit(
    size: int, effects: str
) -> None:
    unit = {
        "all": everything,
        "own": lambda: {s: calibration(s, (own_effect(s),)) for s in SENSORS},
        "one round": some_steady_some_moving,
        "in turn": one_after_the_other,
        "none": lambda: {s: calibration(s) for s in SENSORS},
    }[effects]()
    log = noisy_log(unit, 240)
    whole = Compensation(**unit).apply(*log)
    stream = Compensation(**unit).stream()
    parts = [stream.apply(*(signal[i : i + size] for signal in log)) for i in range(0, 240, size)]
    for sensor in SENSORS:
        np.testing.assert_array_equal(np.concatenate([getattr(p, sensor) for p in parts]), getattr(whole, sensor))
    assert np.isnan(whole.accelerometer).any(axis=1).sum() < 10


def test_a_long_log_gives_the_numbers_of_its_samples() -> None:
    unit = everything()
    log = noisy_log(unit, 2 * BLOCK + 100)
    whole = Compensation(**unit).apply(*log)
    stream = Compensation(**unit).stream()
    stream.apply(*(signal[: BLOCK - 50] for signal in log))
    for i in range(BLOCK - 50, BLOCK + 50):
        sample = stream.apply(*(signal[i] for signal in log))
        np.testing.assert_array_equal(sample.gyroscope, whole.gyroscope[i])


def test_samples_of_single_precision_are_not_copied_as_a_whole() -> None:
    unit = some_steady_some_moving()
    log = [signal.astype(np.float32) for signal in noisy_log(unit, 60 * BLOCK)]
    tracemalloc.start()
    found = Compensation(unit["accelerometer"], None).apply(*log)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found.gyroscope is log[1]
    assert peak < found.accelerometer.nbytes + 0.5 * log[0].nbytes


def test_effects_of_the_bench_are_not_applied_to_a_field_log() -> None:
    tilt = fitted("lever_arm", "accelerometer")
    m, c = motion(), calibration("accelerometer", (tilt,))
    reading = predicted_reading(calibration("accelerometer"), m)
    found = Compensation(c, None).apply(reading, m.angular_rate, m.temperature, m.time).accelerometer
    assert found == pytest.approx(m.specific_force, abs=1e-12)


def test_a_single_sample_is_compensated() -> None:
    c = calibration("accelerometer")
    reading = c.bias + np.linalg.solve(c.matrix, [0.0, 0.0, 1.0])
    accelerometer, gyroscope = Compensation(c, None).apply(accelerometer=list(reading))
    assert accelerometer == pytest.approx(np.array([0.0, 0.0, 1.0]), abs=1e-12)
    assert gyroscope is None


def test_a_sensor_that_is_not_calibrated_passes_through_unchanged() -> None:
    readings = motion().angular_rate
    _, gyroscope = Compensation(calibration("accelerometer"), None).apply(gyroscope=readings)
    assert np.array_equal(gyroscope, readings)


def test_a_missing_reading_stays_missing_and_alone() -> None:
    m, unit = motion(), everything()
    a, g = (predicted_reading(unit[s], m) for s in SENSORS)
    a[100, 1] = np.nan
    found = Compensation(**unit).apply(a, g, m.temperature, m.time)
    assert np.isnan(found.accelerometer[100]).all()
    assert np.isfinite(np.delete(found.accelerometer, 100, 0)).all()


def test_temperature_noise_does_not_reach_the_reading() -> None:
    m = motion(3000, dt=0.12)
    effect = fitted("bias_temperature", "gyroscope").at([0.16] * 3)
    c = calibration("gyroscope", (effect,))
    noisy = m.temperature + 0.05 * np.random.default_rng(0).standard_normal(3000)
    reading = predicted_reading(c, m)
    smooth = Compensation(None, c).apply(gyroscope=reading, temperature=noisy, time=m.time)
    plain = Compensation(None, c).apply(gyroscope=reading, temperature=noisy, time=m.time, smoothing=0)
    after = [np.std(found.gyroscope[500:] - m.angular_rate[500:]) for found in (smooth, plain)]
    assert after[1] == pytest.approx(0.16 * 0.05, rel=0.05)
    assert after[0] < 0.3 * after[1]


def test_the_line_through_the_past_is_the_literal_weighted_fit() -> None:
    rng = np.random.default_rng(4)
    time = np.cumsum(rng.uniform(0.05, 0.4, 80))
    temperature = 20.0 + rng.standard_normal(80)
    found = ExponentialRegression(3.0).apply(time, temperature)
    for n in (1, 2, 10, 79):
        root = np.exp(0.5 * (time[: n + 1] - time[n]) / 3.0)
        design = np.stack([root, root * (time[: n + 1] - time[n])], 1)
        expected = np.linalg.lstsq(design, root * temperature[: n + 1], rcond=None)[0][0]
        assert found[n] == pytest.approx(expected, abs=1e-8)


def test_a_ramp_of_temperature_passes_without_lag_and_a_gap_is_bridged() -> None:
    time = 0.1 * np.arange(200)
    ramp = 20.0 + 0.3 * time
    broken = ramp.copy()
    broken[100:110] = np.nan
    assert ExponentialRegression(3.0).apply(time, broken) == pytest.approx(ramp, abs=1e-7)


@pytest.mark.parametrize(
    ("name", "missing"), [("g_sensitivity", "accelerometer"), ("bias_temperature", "temperature"), ("warm_up", "time")]
)
def test_a_missing_signal_is_named(name: str, missing: str) -> None:
    c = calibration("gyroscope", (fitted(name, "gyroscope"),))
    with pytest.raises(InputError, match=f"{name}, which needs {missing}"):
        Compensation(None, c).apply(gyroscope=np.zeros((4, 3)))


def test_time_that_does_not_increase_is_refused_where_rates_are_needed() -> None:
    c = calibration("accelerometer", (fitted("inner_lever_arms", "accelerometer"),))
    with pytest.raises(InputError, match="does not increase"):
        Compensation(c, None).apply(np.ones((3, 3)), np.ones((3, 3)), time=[0.0, 0.1, 0.1])


def test_nothing_to_compensate_is_refused() -> None:
    with pytest.raises(InputError, match="nothing to compensate"):
        Compensation(None, None).apply(temperature=[25.0])


def test_shapes_that_do_not_match_are_refused() -> None:
    with pytest.raises(InputError, match="shape"):
        Compensation(None, None).apply(np.zeros((4, 3)), np.zeros((5, 3)))


def test_a_reading_far_out_of_range_is_named() -> None:
    effect = fitted("cubic_nonlinearity", "accelerometer")
    effect = effect.at([5e-3] * len(effect.parameters))
    reading = np.zeros((5, 3))
    reading[3, 1] = 400.0
    with pytest.raises(ConvergenceError, match=r"reading of 400 \(sample 4"):
        Compensation(calibration("accelerometer", (effect,)), None).apply(reading)


def test_an_effect_without_an_implementation_is_named() -> None:
    strange = FittedEffect("phase_of_the_moon", {"a": Coefficient(1.0, "1", 0.0)})
    with pytest.raises(ConfigurationError, match="phase_of_the_moon"):
        Compensation(calibration("accelerometer", (strange,)), None).apply(np.zeros((1, 3)))


def write(path: Path, **changes: object) -> Path:
    unit = everything()
    document = {
        "unit": "U1",
        "schema_version": 1,
        "status": "ok",
        "error": None,
        **{s: unit[s].to_json() for s in SENSORS},
        **changes,
    }
    path.write_text(json.dumps(document), encoding="utf-8")
    return path


def test_a_calibration_file_compensates_as_the_fit_does(tmp_path: Path) -> None:
    m, unit = motion(), everything()
    readings = [predicted_reading(unit[s], m) for s in SENSORS]
    found = pipeline.load_calibration(write(tmp_path / "U1.json")).apply(*readings, m.temperature, m.time)
    assert np.max(np.abs(found.gyroscope - m.angular_rate)) < 1e-9


def test_a_missing_calibration_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError, match=r"U9\.json"):
        load(tmp_path / "U9.json")


def test_a_failed_unit_is_refused_with_its_cause(tmp_path: Path) -> None:
    failed = {"status": "failed", "error": {"code": "bad_input", "message": "no rest was found", "file": None}}
    with pytest.raises(InputError, match="no rest was found"):
        load(write(tmp_path / "U1.json", **failed))


def test_a_file_that_is_no_calibration_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "U1.json"
    for text in ("{", "[]", "{}", "[" * 100_000):
        file.write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match="no calibration"):
            load(file)
    os.mkfifo(tmp_path / "pipe")
    pointer = tmp_path / "pointer.json"
    pointer.write_text(f"version https://git-lfs.github.com/spec/v1\noid sha256:{'4d7a2146' * 8}\nsize 12345\n")
    with pytest.raises(InputError, match=r"this is a Git LFS pointer, not the file itself: run git lfs pull$"):
        load(pointer)
    for path, kind in ((tmp_path, "a directory"), (tmp_path / "pipe", "a FIFO"), (Path("/dev/null"), "a device")):
        with pytest.raises(InputError, match=f"this is .*{kind}"):
            load(path)


Change = tuple[str, str, str]
MATRIX = '"matrix": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]'
FAULTS: list[Change] = [
    ('"schema_version": 1, ', "", "schema_version is missing; this version reads 1 and 2"),
    ('"schema_version": 1, ', '"schema_version": 3, ', "schema_version is 3; this version reads 1 and 2"),
    ('"schema_version": 1, ', '"schema_version": true, ', "schema_version is True; this version reads 1 and 2"),
    (
        '"status": "ok"',
        '"status": "fine"',
        "status: 'ok' is expected, not .fine.; take the file as the run published it",
    ),
    ('"status": "ok"', '"status": "ok", "status": "ok"', 'the key "status" stands twice'),
    (
        '"bias": [0.0, 0.0, 0.0], "m',
        '"bias": [0.0, 0.0], "m',
        r"gyroscope.bias: a list of 3 values is expected, not \[0.0, 0.0\]",
    ),
    ('"bias": [0.0, 0.0, 0.0], "m', '"bias": [0.0, NaN, 0.0], "m', "holds the number NaN"),
    (
        '"bias": [0.0, 0.0, 0.0], "m',
        '"bias": [0.0, 1e999, 0.0], "m',
        r"gyroscope.bias\[1\]: a finite number is expected, not Infinity",
    ),
    (
        '"bias": [0.0, 0.0, 0.0], "m',
        '"bias": ["0", 0.0, 0.0], "m',
        r"gyroscope.bias\[0\]: a finite number is expected, not \"0\"",
    ),
    (
        '"bias": [0.0, 0.0, 0.0], "m',
        '"bias": [true, 0.0, 0.0], "m',
        r"gyroscope.bias\[0\]: a finite number is expected, not true",
    ),
    (
        MATRIX,
        '"matrix": [[1.0, 0.0], [0.0, 1.0]]',
        r"gyroscope.matrix: a list of 3 values is expected, not \[\[1.0, 0.0\]",
    ),
    (MATRIX, MATRIX.replace("[[1.0", "[[0.0"), "gyroscope.matrix is singular or nearly so"),
    (MATRIX, MATRIX.replace("1.0", "16384.0"), "gyroscope.matrix multiplies readings by 1.64e.04 to 1.64e.04"),
    ('"unit": "deg/s", "bias"', '"unit": "rad/s", "bias"', "gyroscope.unit: 'deg/s' is expected, not .rad/s."),
    ('"accelerometer": null, ', "", "accelerometer is missing"),
    ('"covariance": {', '"covariance": 3, "x": {', "gyroscope.covariance: a mapping of names is expected, not 3"),
    ('"converged": true, ', "", "gyroscope: converged is missing"),
    ('"name": "g_sensitivity"', '"name": "moon"', r"gyroscope.effects\[0\]: .*moon"),
    (
        '"name": "g_sensitivity"',
        '"nam": "g_sensitivity"',
        r"gyroscope.effects\[0\].nam: unknown key; nearest: name; valid: name, parameters, definition",
    ),
    ('"name": "g_sensitivity"', '"name": "hysteresis"', "no effect of the gyroscope"),
    (
        '"G_xx": {"value": 0.05',
        '"G_xx": {"value": "0.05"',
        r"effects\[0\].parameters.G_xx.value: a finite number is expected, not \"0.05\"",
    ),
    ('"G_xx": {', '"G_q": {', r"parameters \(g_sensitivity\) are G_q, .*; expected G_xx"),
    ('"unit": "deg/s/g"', '"unit": "rad/s/g"', r"G_xx.unit \(g_sensitivity\) is .rad/s/g.; expected 'deg/s/g'"),
]


@pytest.mark.parametrize(("old", "new", "message"), FAULTS)
def test_a_fault_in_a_calibration_is_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    entries = {f"G_{a}{b}": Coefficient(0.05, "deg/s/g") for a in "xyz" for b in "xyz"}
    part = SensorCalibration("gyroscope", effects=(FittedEffect("g_sensitivity", entries),)).to_json()
    head = {"schema_version": 1, "unit": "U1", "status": "ok", "error": None}
    text = json.dumps({**head, "accelerometer": None, "gyroscope": part})
    file = tmp_path / "U1.json"
    file.write_text(text, encoding="utf-8")
    assert load(file).accelerometer is None
    assert old in text
    file.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(PipelineError, match=message) as caught:
        load(file)
    assert caught.value.file == str(file)


def test_an_effect_named_twice_and_no_calibrated_sensor_are_refused(tmp_path: Path) -> None:
    part = calibration("gyroscope").to_json()
    twice = {"name": "scale_factor_asymmetry", "parameters": {f"c_{a}": {"value": 0.0, "unit": "1"} for a in "xyz"}}
    with pytest.raises(InputError, match=r"gyroscope.effects\[1\] is scale_factor_asymmetry a second time"):
        load(write(tmp_path / "U1.json", gyroscope={**part, "effects": [twice, twice]}))
    with pytest.raises(InputError, match="are null: there is nothing to apply; reason: no turns"):
        load(write(tmp_path / "U1.json", accelerometer=None, gyroscope=None, not_calibrated={"gyroscope": "no turns"}))
