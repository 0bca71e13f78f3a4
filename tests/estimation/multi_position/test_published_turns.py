"""The example sessions of imucal against the equations of Ferraris et al. 1995, implemented here.

imucal (github.com/mad-lab-fau/imucal) calibrates it from nine sections: six rests and three turns, each taken as
-360 deg about a body axis. What the hand did otherwise is in both results; they must agree within their combined
uncertainty.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hand_session import fitted
from unit_settings import settings_of

from pipeline.core.records import SENSORS, Recording, SensorCalibration
from pipeline.core.settings import Window
from pipeline.ingest.read import read_recordings
from pipeline.physics.signal.segments import cut
from pipeline.simulation.description import shipped_settings

DATA = Path(__file__).parents[4] / "shared" / "data" / "ferraris_wearable"
PROCEDURE = shipped_settings(procedure="ferraris").procedure
PARTS = [f"{axis}_{part}" for part in ("p", "a") for axis in "xyz"], [f"{axis}_rot" for axis in "xyz"]
# example_data/example_ferraris_session_list.json of imucal: first sample and the one after the last
SECTIONS = {
    "x_p": (540, 1271), "x_a": (1620, 2361), "y_p": (2814, 3298), "y_a": (3740, 4152), "z_p": (4522, 4975),
    "z_a": (5376, 5983), "x_rot": (6770, 7093), "y_rot": (8081, 8405), "z_rot": (9205, 9512),
}  # fmt: skip
RATE_HZ = 102.4
# tests/snapshots/example_cal.json of imucal: its result for annotated_session.csv, raw counts, g = 9.81 m/s^2, -360 deg
PUBLISHED = {
    "K_a": [208.54567263762615, 208.0011341167055, 214.78455364603022],
    "R_a": [
        [0.9999125214309234, 0.007122056140390757, -0.011145662922687352],
        [-0.007947378455060604, 0.9996887358297629, 0.023648903373787954],
        [0.021342900724016442, -0.010781879507682177, 0.9997140749549175],
    ],
    "b_a": [-6.018868019671572, -48.287874016760156, -28.96636637224333],
    "K_g": [16.67769558952488, 16.187895200550262, 16.253362639451936],
    "R_g": [
        [-0.9999143756542296, -0.0006142300632876558, 0.013071498821540703],
        [0.0055057030733027396, -0.9992594967426224, -0.03808077472097593],
        [-0.01314650914177706, 0.0365074524847183, -0.9992469040284595],
    ],
    "b_g": [1.960686204431737, -4.472837741243746, -3.6511794138670477],
}


def ferraris(force: dict[str, np.ndarray], rate: dict[str, np.ndarray], hz: float, turn_deg: float) -> dict[str, Any]:
    """Return bias and matrix by Ferraris, Grimaldi & Parvis 1995, g and deg/s; readings are parts, (n, 3) each.

    Six rests give ``[y_x y_y y_z]+- = b 1^T +- K``, gravity 1; three turns give ``K_g A = [integral (y - b) dt]_xyz``,
    less the g-sensitivity ``(y+ - y-) / 2``, which the gravity felt in each turn takes off.
    """
    up, down = (np.stack([force[f"{axis}_{part}"].mean(axis=0) for axis in "xyz"], axis=1) for part in "pa")
    b, M = np.diag(up + down) / 2.0, np.linalg.inv((up - down) / 2.0)
    still = np.concatenate([rate[f"{axis}_{part}"] for part in "pa" for axis in "xyz"]).mean(axis=0)
    felt = [np.stack([rate[f"{axis}_{part}"].mean(axis=0) for axis in "xyz"], axis=1) for part in "pa"]
    sensitivity = (felt[0] - felt[1]) / 2.0
    turned = np.stack(
        [np.sum(rate[f"{a}_rot"] - still - (force[f"{a}_rot"] - b) @ M.T @ sensitivity.T, axis=0) / hz for a in "xyz"],
        axis=1,
    )
    return {"accelerometer": (b, M), "gyroscope": (still, np.linalg.inv(turned / turn_deg))}


def of_hand(sensor: str, matrix: np.ndarray) -> np.ndarray:
    """Return the standard uncertainty of bias and matrix by the hand's errors in that method: (12,) array."""
    turns, face = PROCEDURE.turns, np.radians(PROCEDURE.faces.accuracy_deg)
    across = np.radians(turns.axis_accuracy_deg) if sensor == "gyroscope" else face / np.sqrt(2.0)
    along = turns.accuracy_deg / turns.angle_deg if sensor == "gyroscope" else face * np.abs(matrix - np.eye(3)).max()
    bias = 0.0 if sensor == "gyroscope" else face * np.abs(matrix - np.eye(3)).max()
    u = np.full((3, 3), across)
    np.fill_diagonal(u, along)
    return np.append(np.full(3, bias), u)


def read(folder: Path, file: str, counts: tuple[float, float] | None, hz: float) -> tuple[list[Recording], Any]:
    """Return a session as one recording, and the settings of a run."""
    (folder / "recording.csv").write_bytes((DATA / file).read_bytes())
    plain = shipped_settings(ingest="canonical_csv").ingest
    columns: dict[str, Any] = dict.fromkeys(plain.csv["columns"])
    for channel, short, unit, k in (("accel", "acc", "m/s^2", 0), ("gyro", "gyr", "deg/s", 1)):
        scale = {"unit": "counts", "counts_per_unit": counts[k]} if counts else {"unit": unit}
        columns |= {f"{channel}_{axis}": {"column": f"{short}_{axis}", **scale} for axis in "xyz"}
    ingest = plain.replaced(csv=plain.csv | {"columns": columns, "rate_hz": hz})
    full_scales = {f"sensor.{name}.full_scale": 2000.0 for name in SENSORS}
    settings = settings_of(sensor="generic", table="hand", procedure="ferraris", **full_scales)
    return read_recordings(PROCEDURE, ingest, settings.sensor, folder), settings


def difference(found: SensorCalibration, other: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return the difference of bias and matrix over its combined standard uncertainty, noise of the bias included."""
    assert found.covariance is not None
    own, hand = np.sqrt(np.diag(found.covariance))[:12], of_hand(found.sensor, other[1])
    hand[:3] = np.hypot(hand[:3], own[:3])
    return (np.append(found.bias, found.matrix) - np.append(*other)) / np.hypot(own, hand)


@pytest.fixture(autouse=True)
def _published_sessions() -> None:
    if not DATA.is_dir():
        pytest.skip("reference data not beside the repository")


@pytest.mark.parametrize("sensor", SENSORS)
def test_the_example_session_agrees_with_ferraris_1995(tmp_path: Path, sensor: str) -> None:
    recordings, settings = read(tmp_path, "example_ferraris_session.csv", None, RATE_HZ)
    whole = recordings[0]
    assert whole.accelerometer is not None
    assert whole.gyroscope is not None
    force, rate = ({n: v[a:b] for n, (a, b) in SECTIONS.items()} for v in (whole.accelerometer, whole.gyroscope))
    found = fitted(sensor, recordings, settings)
    assert np.abs(difference(found, ferraris(force, rate, RATE_HZ, -360.0)[sensor])).max() < 2.0
    if sensor == "gyroscope":
        turns = found.stages[-1].details.turns
        assert [(t.axis, t.stated_deg) for t in turns] == [("x", -360.0), ("y", -360.0), ("z", -360.0)]
        assert max(abs(t.angle_deg - t.stated_deg) for t in turns) < 2.0 * PROCEDURE.turns.accuracy_deg
    else:
        assert sum(found.stages[-1].details.rests_on_faces.values()) == 13


@pytest.mark.parametrize("sensor", SENSORS)
def test_the_session_in_parts_agrees_with_the_published_calibration(tmp_path: Path, sensor: str) -> None:
    counts = 2080.0, 16.4  # a g, a deg/s
    recordings, settings = read(tmp_path, "annotated_session.csv", counts, 204.8)
    names = np.array([line.split(",", 1)[0] for line in (DATA / "annotated_session.csv").read_text().splitlines()[1:]])
    windows = []
    for name in (*PARTS[0], *PARTS[1]):
        own = np.flatnonzero(names == name)
        axis = name[0] if name in PARTS[1] else None
        start, stop = float(own[0]) / 204.8, float(own[-1] + 1) / 204.8
        windows.append(Window.model_validate({"role": "rests", "axis": axis, "start_s": start, "stop_s": stop}))
    parts = cut(recordings[0], windows)
    found = fitted(sensor, parts, settings)
    # K R of the published file is counts a m/s^2 or deg/s. Its turns are taken as -360 deg; the readings show +360.
    short, per_unit, sign = {"accelerometer": ("a", 9.81, 1.0), "gyroscope": ("g", 1.0, -1.0)}[sensor]
    scale = counts[0] if sensor == "accelerometer" else counts[1]
    K = sign * np.diag(PUBLISHED[f"K_{short}"]) @ np.array(PUBLISHED[f"R_{short}"]) * per_unit / scale
    assert np.abs(difference(found, (np.array(PUBLISHED[f"b_{short}"]) / scale, np.linalg.inv(K)))).max() < 2.0


def test_the_equations_above_are_those_of_the_published_calibration() -> None:
    lines = [line.split(",") for line in (DATA / "annotated_session.csv").read_text().splitlines()[1:]]
    names, values = np.array([line[0] for line in lines]), np.array([line[2:] for line in lines], float)
    force, rate = ({n: values[names == n, c : c + 3] for n in (*PARTS[0], *PARTS[1])} for c in (0, 3))
    found = ferraris(force, rate, 204.8, -360.0)
    for sensor, short, unit in (("accelerometer", "a", 9.81), ("gyroscope", "g", 1.0)):
        K = np.diag(PUBLISHED[f"K_{short}"]) @ np.array(PUBLISHED[f"R_{short}"]) * unit
        assert found[sensor][0] == pytest.approx(PUBLISHED[f"b_{short}"], abs=1e-9)
        assert np.linalg.inv(found[sensor][1]) == pytest.approx(K, rel=1e-9, abs=1e-9)
