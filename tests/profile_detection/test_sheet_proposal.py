"""The sheet that is proposed for a folder of recordings, against what was recorded."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np
import pytest

from imu_logs.profile import checks_of
from pipeline.app.config.compose import Composer
from pipeline.app.recording_facts import SUITS_FERRARIS, facts, proposed_sheet, rests_in_short, suits_ferraris
from pipeline.core.settings import RecordingFile
from pipeline.ingest.arrow import write_recording
from pipeline.ingest.read import read_table, to_recording
from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import UnitDescription
from tests.study.listed_recordings import Unit, at_rest, joined, on_table, rotation, turned

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


def test_of_six_faces_and_turns_in_one_file_the_procedure_that_determines_more_is_named(tmp_path: Path) -> None:
    recordings, _ = simulate_unit(UnitDescription("U", table="hand", procedure="ferraris"), 7, 0)
    write_recording(tmp_path / "all.csv", recordings[0])
    settings = Composer(tmp_path).unit("unit", ["sensor=mpu6050", "procedure=listed"])
    assert proposed_sheet(tmp_path, settings).splitlines()[1:] == ["all.csv,moves", f"# all.csv: {SUITS_FERRARIS}"]
    assert not suits_ferraris(simulate_unit(UnitDescription("U", table="hand", procedure="multi_position"), 7, 0)[0][0])


def test_times_of_rests_are_those_of_windows(tmp_path: Path) -> None:
    unit, axis = Unit(tmp_path, np.random.default_rng(3)), np.eye(3)[0]
    parts = joined(
        at_rest(6.0, UP), turned(90.0, 90.0, axis, UP), at_rest(5.0, rotation(axis, np.array([-np.pi / 2.0]))[0] @ UP)
    )
    unit.write("moved", "moves,,,,", *parts)
    settings = Composer(tmp_path).unit("unit", ["sensor=mpu6050", "procedure=listed"])
    entry = RecordingFile(file="moved.csv", role="rests", axis=None, optional=False)
    read = to_recording(
        "moved",
        entry,
        read_table([tmp_path / "moved.csv"], settings.ingest),
        settings.sensor,
        checks_of(settings.ingest),
    )
    (words,) = [text for label, text in facts(read) if label == "rests"]
    found = re.findall(r"([\d.]+) to ([\d.]+)", words.partition("from the start: ")[2])
    assert np.array(found, float) == pytest.approx(
        np.array([[0.0, 6.0], [read.time[-1] - 5.0, read.time[-1]]]), abs=0.6
    )
    assert rests_in_short(read).startswith("moved: 2, the first at ")


def test_what_is_said_not_to_have_moved_is_proposed_as_a_rest(tmp_path: Path) -> None:
    unit = Unit(tmp_path, np.random.default_rng(3))
    unit.write("still", "rest,,,,", *at_rest(4.0, UP))  # the edges of a rest, 0.5 s, are left out of it
    settings = Composer(tmp_path).unit("unit", ["sensor=mpu6050", "procedure=listed"])
    assert proposed_sheet(tmp_path, settings).splitlines()[1:] == ["still.csv,rest"]


# Temperature in degC and the accelerometer's z in m/s^2 of the unit chamber of data/published, cooled and heated.
CHAMBER = """
51.6 -9.686 31.3 -9.739 18.9 -9.697 10.0 -9.618 2.2 -9.486 -4.8 -9.343 -10.2 -9.202 -14.6 -9.138 -17.6 -9.038
-12.3 -9.157 -4.5 -9.302 4.2 -9.451 13.5 -9.534 22.9 -9.580 42.8 -9.583 62.6 -9.514 72.4 -9.455"""


def test_a_sweep_of_temperature_that_moves_the_readings_is_proposed_as_a_soak(tmp_path: Path) -> None:
    unit = Unit(tmp_path, np.random.default_rng(3))
    warmth, z = np.array(CHAMBER.split(), float).reshape(-1, 2).T
    warmth, z = (np.interp(np.arange(6000), np.linspace(0, 6000, len(v)), v) for v in (warmth, z / 9.80665))
    rate = np.outer(warmth, [1e-4, 3e-4, 5e-5])
    unit.write("chamber", "soak,,,,", np.outer(z, [0.01, -0.01, 1.0]), rate, warmth=warmth, hz=2.0)
    settings = Composer(tmp_path).unit("unit", ["sensor=mpu6050", "procedure=listed"])
    assert proposed_sheet(tmp_path, settings).splitlines()[1:] == ["chamber.csv,soak"]


def test_means_are_proposed_as_attitudes_by_a_profile_that_counts_rows(tmp_path: Path) -> None:
    up = np.random.default_rng(3).normal(size=(24, 3))
    np.savetxt(tmp_path / "means.log", up / np.linalg.norm(up, axis=1, keepdims=True), delimiter=",")
    columns = ", ".join(f"accel_{axis}: {{column: {k}, unit: g}}" for k, axis in enumerate("xyz"))
    (tmp_path / "configs" / "ingest").mkdir(parents=True)
    profile = f"name: means\ncsv:\n  header: false\n  rate_hz: 1\n  columns: {{{columns}}}\nmcap: {{}}\n"
    (tmp_path / "configs" / "ingest" / "means.yaml").write_text(profile)
    settings = Composer(tmp_path).unit("unit", ["sensor=generic", "procedure=listed", "ingest=means"])
    assert proposed_sheet(tmp_path, settings).splitlines()[1:] == ["means.log,attitudes"]
