"""What a plan says of rests and moves by hand, against units in which effects of such sizes are hidden."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.app.plan import ROOM, changes, of_sensor, select_by_hand, simulate_procedure
from pipeline.estimation.gates import passes
from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import UnitDescription

POSITIONS = UnitDescription("U", table="hand", procedure="multi_position", temperature=ROOM)
SIX = replace(POSITIONS, procedure="six_positions")
UNITS, MOST, FACTOR = 12, 10, 1.5  # were only half of the units found, 10 of 12 would be with a probability of 2 %


def test_half_of_the_units_are_found_within_a_factor_of_the_planned_size_by_hand() -> None:
    rehearsal = simulate_procedure(POSITIONS)
    planned = {e["effect"]: e for e in of_sensor("accelerometer", rehearsal)["effects"]}
    sizes = np.array(list(planned["quadratic_nonlinearity"]["sizes"].values()))
    found = {FACTOR: 0, 1.0 / FACTOR: 0}
    for factor in found:
        for number in range(UNITS):
            signs = np.random.default_rng([number, 7]).choice([-1.0, 1.0], len(sizes))
            hidden = {"accelerometer.quadratic_nonlinearity": (factor * sizes * signs).tolist()}
            recordings, _ = simulate_unit(replace(POSITIONS, effects=hidden), 2, number)
            selection = select_by_hand("accelerometer", replace(rehearsal, recordings=recordings))
            score = selection.first.scores["quadratic_nonlinearity"]
            found[factor] += passes(score, "accelerometer", len(selection.candidates))
    assert found[FACTOR] >= MOST, found
    assert found[1.0 / FACTOR] <= UNITS - MOST, found


def test_by_hand_no_table_and_no_lever_arm_can_be_seen() -> None:
    part = of_sensor("accelerometer", simulate_procedure(POSITIONS))
    reasons = {entry["effect"]: entry["reason"] for entry in part["not_observable"]}
    assert reasons["table_tilt"] == "there is no table"
    assert "the heading of the unit" in reasons["lever_arm"]
    assert not reasons.keys() & {entry["effect"] for entry in part["effects"]}


def test_six_positions_show_no_nonlinearity_and_more_positions_are_proposed() -> None:
    part = of_sensor("accelerometer", simulate_procedure(SIX))
    assert "quadratic_nonlinearity" in {entry["effect"] for entry in part["not_observable"]}
    assert "--procedure multi_position" in [change.options for change in changes(SIX)]
