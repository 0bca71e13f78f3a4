"""Rows of a fit follow duration and motion, and keep the information of every effect."""

from __future__ import annotations

import numpy as np
import pytest
from unit_settings import settings_of

from pipeline.estimation import turns
from pipeline.estimation.design import Design, EffectColumns
from pipeline.estimation.gauss_markov import WHITE_SETTING
from pipeline.estimation.observations import Observations, observe
from pipeline.estimation.ranking import MIN_NEW_COLUMN_SHARE, without
from pipeline.physics.effects import catalogue, effect
from pipeline.physics.kinematics import table_motion
from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import UnitDescription

TABLE = settings_of().table
COURSE = {
    "rates_dps": [60.0],
    "step_deg": 30.0,
    "dwell_s": 0.5,
    "validation_s": 0.0,
    "static_s": 0.0,
    "warm_up_rest_s": 1.0,
}
LOSS = 0.01  # of the information


def observed(sensor: str, interval_s: float) -> Observations:
    unit = UnitDescription("U1", interval_s=interval_s, course=COURSE)
    return observe(sensor, simulate_unit(unit, 3, 0)[0], TABLE)


def information(observations: Observations, terms: list[EffectColumns]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the information of each effect by white noise, the base projected out, and the norms of its columns."""
    found = []
    for term in terms:
        design = Design(observations, [term], np.eye(3), np.ones(3), project=True)
        products, _ = design.products([WHITE_SETTING])
        found.append((without(products, np.arange(12))[0, 12:-1, 12:-1], design.sizes()[12:-1]))
    return found


@pytest.mark.parametrize("many", [turns.MANY_ROWS, 0])
@pytest.mark.parametrize("sensor", ["accelerometer", "gyroscope"])
def test_no_effect_loses_more_than_a_hundredth_of_its_information(
    sensor: str, many: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(turns, "MANY_ROWS", many)
    rows = observed(sensor, 0.004)
    monkeypatch.setattr(turns, "MANY_ROWS", 10**6)
    monkeypatch.setattr(turns, "ROW_DEG", 1e-9)
    single = observed(sensor, 0.004)
    assert rows.samples == single.samples
    assert len(rows.weight) < 0.7 * len(single.weight)
    motions = [part.motion for part in rows.parts]
    terms = [
        EffectColumns(this, this.starts(sensor)[0], full=True)
        for this in catalogue().values()
        if sensor in this.sensors and not this.moves and not this.of_turns and all(map(this.available, motions))
    ]
    assert len(terms) > 12
    for term, (few, _), (all_of_them, size) in zip(
        terms, information(rows, terms), information(single, terms), strict=True
    ):
        over = np.outer(size, size) + 1e-300
        values, vectors = np.linalg.eigh(all_of_them / over)
        excited = values > MIN_NEW_COLUMN_SHARE**2
        shown = vectors[:, excited] / np.sqrt(values[excited])
        kept = np.linalg.eigvalsh(shown.T @ (few / over) @ shown)
        assert kept.min(initial=1.0) > 1.0 - LOSS, term.effect.name


def test_the_number_of_rows_does_not_follow_the_sampling_rate() -> None:
    counts = [len(observed("gyroscope", interval).weight) for interval in (0.01, 0.0025)]
    assert counts[1] < 1.5 * counts[0]


def test_white_noise_within_rows_is_that_of_the_samples() -> None:
    rows = observed("gyroscope", 0.005)
    free = rows.samples - len(rows.weight)
    sigma = np.sqrt(rows.scatter / free)
    unit = UnitDescription("U1", interval_s=0.005, course=COURSE)
    white = simulate_unit(unit, 3, 0)[1]["gyroscope"]["noise"]["white"]
    assert sigma == pytest.approx(np.full(3, white), rel=0.03)


@pytest.mark.parametrize(
    ("name", "value"), [("time_offset", 0.008), ("time_offset", -0.003), ("low_pass_lag", 0.02), ("clock_rate", 60.0)]
)
def test_shifted_means_by_integrals_are_those_of_the_samples(name: str, value: float) -> None:
    """Corners of 100 deg/s^2 in a row of four samples, of both motions: 2 dt 100 / 96 = 2.1e-3 deg/s; noise is 0.05."""
    unit = UnitDescription("U1", interval_s=0.001, course=COURSE)
    recording = next(r for r in simulate_unit(unit, 3, 0)[0] if r.role == "gyroscope")
    motion = table_motion(recording, TABLE)
    assert motion is not None
    groups, shifted = turns.rows_of(motion, recording.valid), effect(name)
    rows, samples = (shifted.moved(each, np.array([value])) for each in (groups.motion(motion), motion))
    assert groups.count.max() > turns.ALL_SAMPLES
    for field, most in {"angular_rate": 2.1e-3, "specific_force": 2e-6, "level": 2e-6, "angle": 1e-3}.items():
        difference = getattr(rows, field) - groups.means(getattr(samples, field))
        assert np.abs(difference).max() < most, field
    np.testing.assert_array_equal(rows.reference_valid, groups.all(samples.reference_valid))
