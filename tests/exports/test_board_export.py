"""``board.yaml`` and the explanation of a board, by points and vectors that are turned by hand."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from test_formats import document, settings

from pipeline.output.exports import exports
from pipeline.output.exports.reading import explain_board

if TYPE_CHECKING:
    from pipeline.core.settings import Settings

__all__ = ["settings"]
PLACE = [0.03, -0.02, 0.01]
TURN = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # x of the reference is -y of the chip


def parameter(value: float, unit: str, *, observable: bool = True) -> dict[str, Any]:
    found = {"value": value, "unit": unit, "standard_uncertainty": 1e-4, "expanded_uncertainty": 2e-4}
    return found | {"observable": observable}


@pytest.fixture
def on_board() -> dict[str, Any]:
    parameters = {f"lever_arm_{a}": parameter(v, "m", observable=a != "z") for a, v in zip("xyz", PLACE, strict=True)}
    parameters["time_offset_gyroscope"] = parameter(0.004, "s")
    lost = {
        "parameter": "lever_arm",
        "direction": [0, 0, 1],
        "expanded_uncertainty": 0.6,
        "unit": "m",
        "reason": "slow",
    }
    chip = {"rotation": TURN.tolist(), "parameters": parameters, "not_observable": [lost], "doubts": []}
    chips = {"B": chip, "C": {"refused": "C could not be calibrated"}}
    return document({}) | {"unit": "A", "board": {"name": "B7", "reference": "A", "chips": chips}}


def test_poses_are_those_of_the_chips(on_board: dict[str, Any], settings: Settings) -> None:
    text = exports(on_board, settings)["board.yaml"]
    chain = yaml.safe_load(text)
    assert list(chain) == ["imu0", "imu1"]
    T = np.array(chain["imu1"]["T_i_b"])
    np.testing.assert_allclose(T @ [*PLACE, 1.0], [0, 0, 0, 1], atol=1e-15)  # the chip is the origin of its axes
    np.testing.assert_allclose(T @ [1.03, -0.02, 0.01, 1.0], [0, -1, 0, 1], atol=1e-15)
    np.testing.assert_array_equal(chain["imu0"]["T_i_b"], np.eye(4))
    assert chain["imu1"]["time_offset"] == 0.004
    assert "C: not estimated: C could not be calibrated" in text
    assert "not observable: lever_arm along [0, 0, 1]: slow" in text


def test_the_static_transform_places_the_chip_in_the_axes_of_the_reference(
    on_board: dict[str, Any], settings: Settings
) -> None:
    line = re.search(r"static_transform_publisher .*", exports(on_board, settings)["board.yaml"])
    assert line
    told = dict(re.findall(r"--(\S+) (\S+)", line[0]))
    assert (told["frame-id"], told["child-frame-id"]) == ("A", "B")
    np.testing.assert_allclose([float(told[a]) for a in "xyz"], PLACE, rtol=1e-9)
    quaternion = [float(told[f"q{a}"]) for a in "xyzw"]
    # tf2: the pose turns vectors of the child into those of the parent
    np.testing.assert_allclose(Rotation.from_quat(quaternion).apply([0.0, -1.0, 0.0]), [1.0, 0.0, 0.0], atol=1e-9)


def test_only_the_reference_of_a_board_has_the_file(settings: Settings) -> None:
    other = document({}) | {"board": {"name": "B7", "reference": "A", "chips": {}}}
    assert "board.yaml" not in exports(document({}), settings)
    assert "board.yaml" not in exports(other, settings)


def test_the_explanation_names_what_is_not_observable(on_board: dict[str, Any]) -> None:
    text = explain_board(on_board)
    assert "board B7: reference chip A" in text
    assert re.search(r"lever_arm_x +0.03 ± 0.0002 m$", text, re.MULTILINE)
    assert re.search(r"lever_arm_z +0.01 ± 0.0002 m   not observable$", text, re.MULTILINE)
    assert "C: not estimated: C could not be calibrated" in text
