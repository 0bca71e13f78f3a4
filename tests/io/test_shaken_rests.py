"""A dwell of the table in which someone leant on it is left out as a whole, counted and said; nothing else is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bench_session import CONTINUOUS, SIZE, STOP_AND_GO, Session, record, values_of
from unit_settings import settings_of, with_noise

from pipeline.core.records import Note, Recording
from pipeline.estimation.stages import fit_stage
from pipeline.ingest.disturbances import leave_out_disturbances, leave_out_shaken_rests

SETTINGS = settings_of(sensor={"accelerometer": {"bias_wander": 1e-4, "cross_axis": 0.02}})
METHODS = {"reference": "reference_least_squares", "magnitude": "nonlinear_least_squares"}


def note(code: str, rows: np.ndarray, detail: str) -> Note:
    return Note(code, int(rows.size), int(rows[0]), int(rows[-1]), detail)


def dwell(recording: Recording, number: int) -> slice:
    """Return the samples of a dwell."""
    assert recording.table_rate is not None
    edges = np.flatnonzero(np.diff((np.abs(recording.table_rate) < 0.02).astype(int)))
    return slice(int(edges[2 * number + 1]) + 1, int(edges[2 * number + 2]) + 1)


def leant_on(recording: Recording, kind: str, size: float) -> Recording:
    """Return a recording in which the first half of a dwell is moved or shaken, g."""
    rest = dwell(recording, 20)
    half = slice(rest.start + 1, (rest.start + rest.stop) // 2 + 1)
    assert recording.accelerometer is not None
    force = recording.accelerometer.copy()
    rng = np.random.default_rng(3)
    shaken = rng.standard_normal(force[half].shape)
    force[half] += size * (shaken if kind == "shaken" else np.array([1.0, -0.5, 0.3]))
    return replace(recording, accelerometer=force)


@pytest.fixture(scope="module")
def clean() -> list[Recording]:
    return record(Session(3, STOP_AND_GO))


@pytest.mark.parametrize(("kind", "size"), [("shaken", 0.2), ("shaken", 0.03), ("leant on", 0.05), ("leant on", 0.02)])
def test_half_a_dwell_that_was_disturbed_costs_the_calibration_nothing(
    clean: list[Recording], kind: str, size: float
) -> None:
    spoilt = [leant_on(clean[0], kind, size), *clean[1:]]
    kept = [leave_out_disturbances(leave_out_shaken_rests(r, note), note, 0.02) for r in spoilt]
    assert [n.code for r in kept for n in r.notes] == ["N-SHAKEN"]
    assert "1 of " in kept[0].notes[0].detail
    assert kept[0].flags is not None
    for method in METHODS.values():
        good, mended, wrong = (
            fit_stage("accelerometer", method, with_noise(r, SETTINGS), None, SETTINGS) for r in (clean, kept, spoilt)
        )
        assert good.covariance is not None
        u = np.sqrt(np.diag(good.covariance))[:12]
        known = u > 0.0

        def off(found: object, good: object = good, u: np.ndarray = u, known: np.ndarray = known) -> float:
            a, b = (np.concatenate([c.bias, c.matrix.ravel()]) for c in (found, good))  # type: ignore[attr-defined]
            return float(np.max(np.abs(a - b)[known] / u[known]))

        assert off(mended) < 0.5
        assert off(wrong) > off(mended)


@pytest.mark.parametrize("sensor", ["accelerometer", "gyroscope"])
def test_what_a_sensor_does_is_never_taken_for_a_shaken_table(sensor: str) -> None:
    rng = np.random.default_rng(2)
    for name in SIZE[sensor]:
        for course in (STOP_AND_GO, CONTINUOUS):
            hidden = {sensor: {name: values_of(sensor, name, rng)}}
            assert all(leave_out_shaken_rests(r, note) is r for r in record(Session(7, course, hidden))), name


def test_one_glitch_is_left_to_the_glitches(clean: list[Recording]) -> None:
    assert clean[0].accelerometer is not None
    force = clean[0].accelerometer.copy()
    force[dwell(clean[0], 20).start + 6] += 0.8
    recording = replace(clean[0], accelerometer=force)
    assert leave_out_shaken_rests(recording, note) is recording


def test_a_bench_that_shakes_in_every_rest_keeps_them(clean: list[Recording]) -> None:
    assert clean[0].accelerometer is not None
    force = clean[0].accelerometer + 0.05 * np.random.default_rng(1).standard_normal(clean[0].accelerometer.shape)
    recording = replace(clean[0], accelerometer=force)
    assert leave_out_shaken_rests(recording, note) is recording
