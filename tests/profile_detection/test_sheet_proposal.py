"""The sheet that is proposed for a folder of recordings, against what was recorded."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.app.config.compose import Composer
from pipeline.app.profile_detection.recording_facts import proposed_sheet
from tests.study.listed_recordings import Unit, at_rest, joined, on_table, turned

if TYPE_CHECKING:
    from pathlib import Path

UP = np.array([0.0, 0.6, 0.8])


def recorded(folder: Path, gyroscope: np.ndarray) -> list[str]:
    """Rows that are proposed for a rest, turns about x, -y and z, and means; ``gyroscope``: its axes as wired."""
    folder.mkdir()
    unit = Unit(folder, np.random.default_rng(3))
    unit.K["gyroscope"] = gyroscope @ unit.K["gyroscope"]
    unit.write("still", "rest,,,,", *at_rest(10.0, UP))
    for name, axis, angle in (("a", 0, 360.0), ("b", 1, -720.0), ("c", 2, 90.0)):
        parts = joined(at_rest(4.0, UP), turned(angle, 90.0, np.eye(3)[axis], UP))
        unit.write(name, "turn,,,,", *parts)
    (folder / "means.csv").write_text("accel_x_g,accel_y_g,accel_z_g\n0,0,1\n1,0,0\n")
    settings = Composer(folder).unit("unit", ["sensor=mpu6050", "procedure=listed"])
    return proposed_sheet(folder, settings).splitlines()[1:]


def test_kinds_axes_senses_and_whole_turns_are_proposed(tmp_path: Path) -> None:
    *turns, means, still = recorded(tmp_path / "U1", np.eye(3))
    assert [means, still] == ["means.csv,attitudes", "still.csv,rest"]
    assert turns[:2] == ["a.csv,turn,x,", "b.csv,turn,-y,"]
    kind, axis, angle = turns[2].split(",")[1:4]
    assert (kind, axis) == ("turn", "z")
    assert abs(float(angle) - 90.0) < 4.0


def test_files_with_the_angle_or_rate_of_a_table_are_proposed_with_its_axis(tmp_path: Path) -> None:
    unit = Unit(tmp_path, np.random.default_rng(3))
    unit.write("still", "rest,,,,", *at_rest(10.0, UP))
    for axis, logged in enumerate(("angle", "rate", "angle")):
        on_table(unit, "ag", axis, logged)
    proposed = [
        proposed_sheet(tmp_path, Composer(tmp_path).unit("unit", ["sensor=mpu6050", "procedure=listed", *more]))
        for more in ((), ("table=single_axis", "table.sense=-1"))
    ]
    of_tables = [[f"table_{a}.csv,table,{sign}{a}" for a in "xyz"] for sign in ("", "-")]
    assert [text.splitlines()[1:] for text in proposed] == [["still.csv,rest", *rows] for rows in of_tables]


def test_reversed_and_exchanged_axes_of_the_gyroscope_are_found_from_gravity(tmp_path: Path) -> None:
    reversed_x = np.diag([-1.0, 1.0, 1.0])
    assert any("axis_map=[-x, +y, +z]" in row for row in recorded(tmp_path / "U1", reversed_x))
    exchanged = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert any("axis_map=[+y, +x, +z]" in row for row in recorded(tmp_path / "U2", exchanged))
