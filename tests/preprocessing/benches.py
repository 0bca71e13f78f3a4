"""Turns of a unit on benches of any mounting, by rotation matrices and nothing of the package's own kinematics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import unit_settings
from bench_session import BIAS, K
from scipy.spatial.transform import Rotation

from pipeline.checks.bench import signed_axis
from pipeline.core.records import Recording
from pipeline.core.settings import RecordingFile, Settings

INTERVAL_S = 0.12
USUAL_UP = {"x": "+z", "y": "+z", "z": "+x"}
# Rests at 24 angles for the accelerometer, turns both ways between rests for the gyroscope.
STEPS = np.repeat(np.arange(0.0, 361.0, 15.0), 12)
RATE = np.concatenate([np.zeros(40), *[np.append(np.full(50, r), np.zeros(20)) for r in (60.0, -60.0)]])


@dataclass(frozen=True)
class Setup:
    """How a turn is mounted: what points up where the table shows ``zero``, and which way the angle counts."""

    axis: str
    up: str = ""
    sense: int = 1
    zero: float = 0.0
    seat: Any = (0.0, 0.0, 0.0)  # (3,), deg: rotation of the unit in its seat, body frame

    def recording(self, role: str, seed: int = 0, noise: float = 1.0) -> Recording:
        turned = STEPS if role == "accelerometer" else np.cumsum(RATE) * INTERVAL_S
        rate = np.zeros_like(STEPS) if role == "accelerometer" else RATE
        axis, up = signed_axis(f"+{self.axis}"), signed_axis(self.up or USUAL_UP[self.axis])
        seat = Rotation.from_rotvec(np.radians(self.seat)).inv()
        # Seen from the body, up turns backwards about the axis while the body turns forwards.
        force = seat.apply(Rotation.from_rotvec(-np.radians(turned)[:, None] * axis).apply(up))
        omega = seat.apply(rate[:, None] * axis)
        rng = np.random.default_rng([seed, *map(ord, role[0] + self.axis)])
        sizes = {"accelerometer": 8e-4, "gyroscope": 0.01}
        read = {
            s: BIAS[s] + v @ K[s].T + noise * sizes[s] * rng.standard_normal(v.shape)
            for s, v in (("accelerometer", force), ("gyroscope", omega))
        }
        return Recording(
            f"{'accel' if role == 'accelerometer' else 'gyro'}_{self.axis}",
            role,
            self.axis,
            (np.arange(len(turned)) * 120_000_000).astype(np.int64),
            **read,
            table_angle=self.sense * turned + self.zero,
            table_rate=self.sense * rate,
            source={"file": f"{'accel' if role == 'accelerometer' else 'gyro'}_{self.axis}.csv"},
        )

    def entry(self) -> RecordingFile:
        """Return the entry of the recording in the procedure that states the mounting."""
        return entry_of(self.axis).replaced(up=self.up or None, sense=self.sense, zero_deg=self.zero)


def recordings_of(setups: dict[str, Setup], seed: int = 0, **both: Any) -> list[Recording]:
    """Return turns for both sensors, each about every axis, mounted as ``setups`` say of the axis or as usual."""
    roles = ("accelerometer", "gyroscope")
    return [setups.get(a, Setup(a)).recording(role, seed, **both) for role in roles for a in "xyz"]


def entry_of(axis: str) -> RecordingFile:
    """Return the entry of a recording of turns about an axis that states no mounting."""
    return RecordingFile(file="", role="gyroscope", axis=axis, optional=False)


def settings_of(recordings: list[Recording], setups: dict[str, Setup] | None = None, **table: Any) -> Settings:
    """Return settings that state the mounting of some axes."""
    stated = {r.name: (setups or {}).get(r.axis or "", Setup(r.axis or "x")).entry() for r in recordings}
    entries = stated if setups else {r.name: entry_of(r.axis or "x") for r in recordings}
    return stating(entries, **table)


def stating(entries: dict[str, RecordingFile], **table: Any) -> Settings:
    """Return settings with these entries of recordings."""
    ideal = unit_settings.settings_of(table=table)
    return ideal.replaced(procedure=ideal.procedure.replaced(recordings=entries))
