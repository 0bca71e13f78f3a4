"""Several tables, mountings and switching-ons of one unit in one estimate, with what is each one's own beside it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from bench_session import BIAS, CONTINUOUS, STOP_AND_GO, K, Session, record
from scipy.spatial.transform import Rotation
from stage_files import load_recordings, save_recordings
from unit_settings import settings_of

from pipeline.core.errors import ConfigurationError, NotObservableError
from pipeline.estimation.generalized_least_squares import fit_joint
from pipeline.physics.effects import effect
from pipeline.physics.effects.base import truth
from pipeline.physics.kinematics import reference_motion

if TYPE_CHECKING:
    from pipeline.core.records import Recording

SETTINGS = settings_of()
TILT = {"precise": np.array([0.02, -0.03]), "home": np.array([0.35, -0.2])}
LEAN = np.array([0.1, -0.08, 0.05, 0.12, -0.06, 0.09])
THETA = np.array([2.0, -1.5, 1.0])  # as by eye
SHIFT = {"accelerometer": np.array([3e-3, -2e-3, 4e-3]), "gyroscope": np.array([0.2, -0.1, 0.3])}


def on_two_tables(seed: int, home: dict[str, np.ndarray] | None = None, theta: np.ndarray = THETA) -> list[Recording]:
    """Stop-and-go on a precise table; days later slow and fast continuous turns on a home-made one, mounted anew."""
    first = record(Session(seed, STOP_AND_GO, {"accelerometer": {"table_tilt": TILT["precise"]}}))
    second = record(Session(seed + 1, CONTINUOUS, {"accelerometer": home or {"table_tilt": TILT["home"]}}))
    found = [replace(r, setup="precise", clock_shared=False) for r in first]
    for recording in second:
        changed: dict[str, np.ndarray] = {}
        motion = reference_motion(recording)
        assert motion is not None or recording.role == "static"
        for sensor, shift in SHIFT.items():
            reading = recording.reading(sensor)
            assert reading is not None
            u = np.zeros_like(reading) if motion is None else truth(sensor, motion)
            turned = u @ Rotation.from_rotvec(np.radians(theta)).as_matrix()
            changed[sensor] = reading + shift + (turned - u) @ K[sensor].T
        own = {"name": f"{recording.name}_home", "setup": "home", "clock_shared": False}
        found.append(replace(recording, **changed, **own))
    return found


def errors_in_u(calibration: Any, sensor: str, hidden: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    u = np.sqrt(np.diag(calibration.covariance))
    off = {"bias": (calibration.bias - BIAS[sensor]) / u[:3]}
    off["matrix"] = (calibration.matrix - np.linalg.inv(K[sensor])).ravel() / u[3:12]
    at = 12
    for fitted in calibration.effects:
        values = fitted.values
        off[fitted.name] = (values - hidden[fitted.name]) / u[at : at + len(values)]
        at += len(values)
    return off


def test_two_tables_are_one_estimate_and_each_ones_own_errors_are_found() -> None:
    hidden = {
        "table_tilt@precise": TILT["precise"],
        "table_tilt@home": TILT["home"],
        "mounting@home": THETA,
        "bias@home": SHIFT["accelerometer"],
    }
    recordings = on_two_tables(20)
    found = fit_joint("accelerometer", recordings, list(hidden), None, SETTINGS)
    off = errors_in_u(found, "accelerometer", hidden)
    assert found.converged
    assert max(np.abs(v).max() for v in off.values()) < 4.0, off
    u = np.sqrt(np.diag(found.covariance if found.covariance is not None else np.zeros((12, 12))))
    assert u[12:16].max() < 0.01  # deg of either tilt
    assert u[16:19].max() < 0.01  # deg of the mounting
    together = fit_joint("accelerometer", recordings, ["table_tilt"], None, SETTINGS)
    assert np.abs(errors_in_u(together, "accelerometer", {"table_tilt": TILT["home"]})["matrix"]).max() > 10.0


def test_the_leaning_axes_of_one_of_two_tables_are_found() -> None:
    home = {"table_tilt": TILT["home"], "table_axis_nonorthogonality": LEAN}
    hidden = {"table_tilt@precise": TILT["precise"], "table_axis_nonorthogonality@home": LEAN}
    hidden |= {"table_tilt@home": TILT["home"], "bias@home": SHIFT["accelerometer"]}
    found = fit_joint("accelerometer", on_two_tables(40, home, 0.0 * THETA), list(hidden), None, SETTINGS)
    off = errors_in_u(found, "accelerometer", hidden)
    assert max(np.abs(v).max() for v in off.values()) < 4.0, off


def test_the_gyroscope_of_two_mountings_too() -> None:
    hidden = {"mounting@home": THETA, "bias@home": SHIFT["gyroscope"]}
    found = fit_joint("gyroscope", on_two_tables(30), list(hidden), None, SETTINGS)
    off = errors_in_u(found, "gyroscope", hidden)
    assert max(np.abs(v).max() for v in off.values()) < 4.0, off


def test_a_mounting_of_its_own_in_every_setup_is_no_mounting_but_the_matrix() -> None:
    with pytest.raises(NotObservableError, match=r"a separate mounting in every setup \(home, precise\)"):
        fit_joint("accelerometer", on_two_tables(20), ["mounting@home", "mounting@precise"], None, SETTINGS)


def test_what_moves_the_motion_in_time_is_no_setups_own() -> None:
    with pytest.raises(ConfigurationError, match="name time_offset"):
        effect("time_offset@home")


def test_the_setup_goes_with_the_recording(tmp_path: Any) -> None:
    recordings = [replace(r, setup="home") for r in record(Session(1))[:1]]
    save_recordings(tmp_path / "r.parquet", recordings)
    assert load_recordings(tmp_path / "r.parquet")[0].setup == "home"
