"""Filtered readings beside a log of the angle alone: what a filter still holds of a doubtful rate is left out."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from bench_session import CONTINUOUS, STOP_AND_GO, WHITE, Session, record
from unit_settings import filter_of, settings_of

from pipeline.estimation.noise import estimate_noise
from pipeline.estimation.observations import observe
from pipeline.estimation.selection import select
from pipeline.evaluation.diagnosis.residual_dependence import dependences
from pipeline.physics.signal.filters import apply_filter
from pipeline.simulation.description import shipped_settings

if TYPE_CHECKING:
    from pipeline.core.records import Recording

SHEET = shipped_settings(sensor="mpu6050").sensor
TABLE = settings_of().table


def filtered(recordings: list[Recording], name: str = "rc_low_pass") -> list[Recording]:
    return [apply_filter(r, shipped_settings(filter=name).filter) for r in recordings]


def without_rates(recordings: list[Recording]) -> list[Recording]:
    return [replace(r, table_rate=None) if r.table_angle is not None else r for r in recordings]


@pytest.mark.parametrize("name", ["rc_low_pass", "low_pass"])
def test_the_filtered_rate_of_every_sample_that_is_used_is_that_of_a_log_with_rates(name: str) -> None:
    recordings = record(Session(3))
    known = {part.name: part for part in observe("gyroscope", filtered(recordings, name), TABLE).parts}
    for part in observe("gyroscope", filtered(without_rates(recordings), name), TABLE).parts:
        everything = next(r for r in filtered(recordings, name) if r.name == part.name)
        exact = apply_filter(
            replace(everything, gyroscope=known_rate(everything), accelerometer=None), filter_of(name)
        ).gyroscope
        assert exact is not None
        at = np.searchsorted(everything.time, part.motion.time)
        error = np.abs(part.motion.angular_rate - exact[at]).max()
        assert error < 0.1 * WHITE["gyroscope"], part.name
        assert len(at) > (0.25 if part.name.startswith("gyro") else 0.0) * len(known[part.name].weight)


def known_rate(recording: Recording) -> np.ndarray:
    """The table's own rate as a vector."""
    assert recording.axis is not None
    assert recording.table_rate is not None
    rate = np.zeros((recording.samples, 3))
    rate[:, "xyz".index(recording.axis)] = recording.table_rate
    return rate


def test_the_accelerometer_keeps_its_rests_as_the_angle_says_what_gravity_does() -> None:
    recordings = record(Session(3))
    with_rates = observe("accelerometer", filtered(recordings), TABLE)
    without = observe("accelerometer", filtered(without_rates(recordings)), TABLE)
    rests = [sum(int(np.sum(part.motion.still)) for part in found.parts) for found in (with_rates, without)]
    assert rests[1] > 0.85 * rests[0]


def test_no_effect_of_timing_is_invented_in_twenty_filtered_units_without_one() -> None:
    for seed in range(20):
        course = (STOP_AND_GO, CONTINUOUS)[seed % 2]
        session = Session(700 + seed, replace(course, validation_s=0.0), static=seed % 4 < 2)
        recordings = filtered(without_rates(record(session)))
        noise = estimate_noise("gyroscope", recordings, SHEET.gyroscope)
        found = select(observe("gyroscope", recordings, TABLE), [], noise, SHEET.gyroscope)
        assert found.names == [], seed
        assert dependences(found) == [], seed
