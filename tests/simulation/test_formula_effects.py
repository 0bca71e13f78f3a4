"""Formulas hidden in simulated units: exactly what they say, whether the campaign knows them or not."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import yaml

from pipeline.app.commands.simulate import main
from pipeline.core.errors import ConfigurationError
from pipeline.physics.effects import catalogue, effect_from, forget, register
from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import UnitDescription

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

GEAR = {"A": {"formula": "cos(5 * radians(angle))", "unit": "deg/s"}}
COURSE = {"step_deg": 90, "dwell_s": 0.5, "validation_s": 0, "static_s": 0}
EXACT = {"interval_s": 0.12, "course": COURSE, "sensor": "stim300"}


@pytest.fixture(autouse=True)
def registry() -> Iterator[None]:
    yield
    forget()


def gyroscope_of_y(effects: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
    recordings, truth = simulate_unit(UnitDescription("U1", effects=effects, **EXACT), 3, 0)
    turn = next(r for r in recordings if r.name == "gyro_y")
    return turn.gyroscope, turn.table_angle, truth


def test_a_formula_known_to_the_simulation_alone_is_added_to_the_reading() -> None:
    plain, angle, _ = gyroscope_of_y({})
    hidden, _, truth = gyroscope_of_y({"gyroscope.gear_mesh": {"terms": GEAR, "values": [0.03, -0.02, 0.05]}})
    expected = np.cos(5 * np.radians(angle))[:, None] * [0.03, -0.02, 0.05]
    np.testing.assert_allclose(hidden - plain, expected, atol=2e-3)  # the angle errors of the table, five times
    assert np.abs(expected).max() > 0.04
    assert "gear_mesh" not in catalogue()
    assert truth["gyroscope"]["effects"]["gear_mesh"] == {"A_x": 0.03, "A_y": -0.02, "A_z": 0.05}
    assert truth["gyroscope"]["definitions"]["gear_mesh"]["terms"] == GEAR


@pytest.mark.parametrize(("own", "share"), [({}, 0.5), ({"typical_share": 0.1}, 0.1)])
def test_a_registered_effect_is_hidden_by_its_name_and_has_a_typical_size(own: dict[str, float], share: float) -> None:
    definition = {"name": "gear_mesh", "owner": "table", "sensors": ["gyroscope"], "meaning": "Mesh.", "terms": GEAR}
    register(effect_from({**definition, **own, "limits": {"A": 0.1}}, "gear_mesh.yaml"))
    named, _, truth = gyroscope_of_y({"gyroscope.gear_mesh": None})
    sizes = truth["gyroscope"]["effects"]["gear_mesh"]
    assert all(0.06 * share < abs(size) < 0.14 * share for size in sizes.values())
    values = list(sizes.values())
    inline, _, _ = gyroscope_of_y({"gyroscope.gear_mesh": {"terms": GEAR, "values": values}})
    np.testing.assert_array_equal(named, inline)


def test_a_wrong_formula_in_a_description_is_refused_with_its_place() -> None:
    with pytest.raises(ConfigurationError, match=r"effects: gyroscope\.gear: terms\.A\.formula: .*no signal is called"):
        gyroscope_of_y({"gyroscope.gear": {"terms": {"A": {"formula": "angel", "unit": "deg/s"}}, "values": 1}})
    with pytest.raises(ConfigurationError, match="no limit of this effect, so no typical size; give one"):
        gyroscope_of_y({"gyroscope.gear": {"terms": GEAR}})


def test_the_command_hides_effects_of_the_campaigns_own_files(tmp_path: Path) -> None:
    (tmp_path / "effects").mkdir()
    definition = {"name": "tip", "owner": "sensor", "sensors": ["accelerometer"], "meaning": "Tips."}
    definition |= {"terms": {"d": {"formula": "step(fz)", "unit": "g"}}}
    (tmp_path / "effects" / "tip.yaml").write_text(yaml.safe_dump(definition))
    unknown = {"gyroscope.mesh": {"terms": GEAR, "values": 0.02}, "accelerometer.tip": [0.1, 0.2, 0.3]}
    unit = {"unit": "U1", "course": COURSE, "effects": unknown}
    (tmp_path / "simulation.yaml").write_text(yaml.safe_dump({"seed": 2, "units": [unit]}))
    assert main([str(tmp_path), "--quiet"]) == 0
    truth = json.loads((tmp_path / "truth" / "U1.json").read_text())
    assert truth["accelerometer"]["effects"]["tip"] == {"d_x": 0.1, "d_y": 0.2, "d_z": 0.3}
    assert {abs(v) for v in truth["gyroscope"]["effects"]["mesh"].values()} == {0.02}
