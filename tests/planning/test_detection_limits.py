"""The smallest sizes that a plan names, against units in which effects of such sizes are hidden."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pipeline.app.detection_limits import noise_sums
from pipeline.app.plan import FAULTLESS, ROOM, plan_of, stated_noise
from pipeline.core.records import SENSORS
from pipeline.estimation.design import EffectColumns, ordinary_base
from pipeline.estimation.gates import passes
from pipeline.estimation.gauss_markov import Blocks, Setting, selection_grid
from pipeline.estimation.observations import observe
from pipeline.estimation.ranking import Ranking
from pipeline.estimation.selection import select
from pipeline.physics.effects import catalogue, effect
from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import UnitDescription, shipped_settings

UNITS = 20
FACTOR = 1.5
MOST = 15  # of 20: were only half of the units found, as many would be with a probability of 2 %
COURSE = {"step_deg": 15.0, "both_directions": True, "validation_s": 0.0, "static_s": 60.0, "pause_s": 10.0}
PROCEDURE = UnitDescription(
    "U", course={**COURSE, "warm_up_rest_s": 10.0}, interval_s=0.2, imperfections=FAULTLESS, temperature=ROOM
)
PAIRS = [
    ("lever_arm", "scale_factor_asymmetry"),
    ("quadratic_nonlinearity", "g_sensitivity"),
    ("bias_temperature", "table_rate_ripple"),
]


@pytest.fixture(scope="module")
def planned() -> dict[str, dict[str, Any]]:
    document = plan_of(PROCEDURE)
    return {sensor: {e["effect"]: e for e in document[sensor]["effects"]} for sensor in SENSORS}


def _found(planned: dict[str, dict[str, Any]], names: dict[str, str], factor: float) -> dict[str, int]:
    """Return in how many units the effect of each sensor passes the gate, at a factor of its smallest size."""
    shipped = shipped_settings(sensor=PROCEDURE.sensor, table=PROCEDURE.table)
    found = dict.fromkeys(SENSORS, 0)
    for number in range(UNITS):
        signs = np.random.default_rng([number, 7])
        hidden = {
            f"{sensor}.{name}": [
                factor * v * signs.choice([-1.0, 1.0]) for v in planned[sensor][name]["sizes"].values()
            ]
            for sensor, name in names.items()
        }
        recordings, _ = simulate_unit(replace(PROCEDURE, effects=hidden), 2, number)
        for sensor, name in names.items():
            noise = stated_noise(shipped.sensor.of(sensor), PROCEDURE.interval_s, long_rest=True)
            observations = observe(sensor, recordings, shipped.table)
            start = ordinary_base(observations, noise)
            term = EffectColumns(effect(name), np.zeros(len(hidden[f"{sensor}.{name}"])))
            ranking = Ranking(observations, start, start, {name: term}, selection_grid(noise))
            score = ranking.scores([], {})[0]
            found[sensor] += passes(score, sensor, len(catalogue()))
    return found


@pytest.mark.parametrize("pair", PAIRS, ids=" and ".join)
def test_half_of_the_units_are_found_within_a_factor_of_the_planned_size(
    planned: dict[str, dict[str, Any]], pair: tuple[str, str]
) -> None:
    names = dict(zip(SENSORS, pair, strict=True))
    above = _found(planned, names, FACTOR)
    below = _found(planned, names, 1.0 / FACTOR)
    assert all(count >= MOST for count in above.values()), above
    assert all(count <= UNITS - MOST for count in below.values()), below


def test_an_effect_of_twice_the_planned_size_is_named(planned: dict[str, dict[str, Any]]) -> None:
    shipped = shipped_settings(sensor=PROCEDURE.sensor, table=PROCEDURE.table)
    hidden = {"accelerometer": "lever_arm", "gyroscope": "scale_factor_asymmetry"}
    for number in range(4):
        sizes = {f"{s}.{name}": [2.0 * v for v in planned[s][name]["sizes"].values()] for s, name in hidden.items()}
        recordings, _ = simulate_unit(replace(PROCEDURE, effects=sizes), 4, number)
        for sensor, name in hidden.items():
            noise = stated_noise(shipped.sensor.of(sensor), PROCEDURE.interval_s, long_rest=True)
            assert select(observe(sensor, recordings, shipped.table), [], noise, shipped.sensor.of(sensor)).names == [
                name
            ]


def test_an_effect_is_taken_for_its_simpler_look_alike_where_the_plan_says_so(
    planned: dict[str, dict[str, Any]],
) -> None:
    entry = planned["accelerometer"]["bias_temperature_quadratic"]
    assert entry["taken_for"] == "bias_temperature"
    values = [1.5 * v for v in entry["sizes"].values()]
    unit = replace(PROCEDURE, effects={"accelerometer.bias_temperature_quadratic": values})
    shipped = shipped_settings(sensor=unit.sensor, table=unit.table)
    for number in range(4):
        recordings, _ = simulate_unit(unit, 3, number)
        noise = stated_noise(shipped.sensor.accelerometer, unit.interval_s, long_rest=True)
        observations = observe("accelerometer", recordings, shipped.table)
        assert select(observations, [], noise, shipped.sensor.accelerometer).names == ["bias_temperature"]


def test_the_expected_sum_of_squares_is_the_trace_of_two_covariances() -> None:
    rng = np.random.default_rng(5)
    cells, each = 12, 4
    time = np.sort(rng.uniform(0.0, 300.0, cells))
    clock = np.repeat([0, 1], [7, cells - 7])
    weight = rng.integers(1, 5, cells * each).astype(float)
    of = np.repeat(np.arange(cells), each)
    grouped = Blocks(np.arange(0, cells * each, each), np.bincount(of, weight), time, np.zeros(cells), clock)

    def covariance(setting: Setting) -> np.ndarray:
        R = np.exp(-np.abs(np.subtract.outer(time, time)) / setting.time)
        R[:7, 7:] = R[7:, :7] = 0.0
        return np.diag(1.0 / weight) + setting.ratio**2 * R[np.ix_(of, of)]

    true = Setting(0.4, 80.0)
    settings = [Setting(0.0, 1.0), Setting(0.1, 30.0), true, Setting(2.0, 600.0)]
    samples = float(cells * each)
    direct = [np.trace(np.linalg.solve(covariance(s), covariance(true))) for s in settings]
    assert noise_sums(grouped, samples, settings, true) == pytest.approx(direct, rel=1e-9)
    assert direct[2] == pytest.approx(samples)
