"""Recordings and profiles that the tests of the file formats share."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from unit_settings import sheet_of

from pipeline.core.records import Recording
from pipeline.core.settings import Procedure, RecordingFile, Sensor

REPOSITORY = Path(__file__).parents[1]
REFERENCE = REPOSITORY.parent / "shared" / "data"

SENSOR = Sensor(
    name="test",
    axis_map=["+x", "+y", "+z"],
    accelerometer=sheet_of(full_scale=2.0),
    gyroscope=sheet_of(full_scale=250.0),
)


def profile(name: str) -> dict[str, Any]:
    """Return an ingest profile that ships, without Hydra."""
    text = (REPOSITORY / "configs" / "ingest" / f"{name}.yaml").read_text()
    loaded: dict[str, Any] = yaml.safe_load(text.replace("${ingest.instance}", "0"))
    if "defaults" in loaded:
        return {**profile("canonical_csv"), **{k: v for k, v in loaded.items() if k != "defaults"}}
    return loaded


def procedure(*names: str, optional: tuple[str, ...] = ()) -> Procedure:
    """Return a procedure of recordings about x whose files bear their names."""
    entries = {
        n: RecordingFile(file=n, role="accelerometer", axis="x", optional=n in optional) for n in (*names, *optional)
    }
    return Procedure(name="test", table="test", folder="", recordings=entries, holdout_every=0)


def make_recording(samples: int = 200, start_ns: int = 0, seed: int = 1, name: str = "accel_x") -> Recording:
    """Return a recording of a turn about x with every channel, numbers with all their bits."""
    generator = np.random.default_rng(seed)
    angle = np.linspace(0.0, 350.0, samples)
    radians = np.radians(angle)
    force = np.stack([0 * angle, np.sin(radians), np.cos(radians)], axis=1)
    return Recording(
        name=name,
        role="accelerometer",
        axis="x",
        time_ns=start_ns + 10_000_000 * np.arange(samples, dtype=np.int64),
        accelerometer=force + 1e-3 * generator.normal(size=(samples, 3)),
        gyroscope=generator.normal(size=(samples, 3)),
        temperature=25.0 + generator.normal(size=samples),
        table_angle=angle,
        table_rate=np.full(samples, 35.0) + generator.normal(size=samples),
        table_attitude=np.stack([np.cos(radians / 2), np.sin(radians / 2), 0 * angle, 0 * angle], axis=1),
    )


def channels(recording: Recording) -> dict[str, Any]:
    names = ("time_ns", "accelerometer", "gyroscope", "temperature", "table_angle", "table_rate", "table_attitude")
    return {n: getattr(recording, n) for n in (*names, "flags")}


def assert_same_bits(one: Recording, other: Recording) -> None:
    """Fail unless every channel is equal, or absent in both."""
    for name, value in channels(one).items():
        twin = getattr(other, name)
        assert (value is None) == (twin is None), name
        if value is not None:
            assert value.dtype == twin.dtype, name
            np.testing.assert_array_equal(value, twin, err_msg=name, strict=True)
