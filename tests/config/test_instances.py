"""Several sensors in one log: each unit reads its own, by ``ingest.instance``."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
import yaml

from pipeline.app.config.campaign import load_campaign
from pipeline.app.config.compose import Composer
from pipeline.app.config.stage_settings import settings_of_jobs
from pipeline.app.steps.batch import merge_common
from pipeline.core.errors import ConfigurationError
from pipeline.ingest.read import read_recordings

if TYPE_CHECKING:
    from pathlib import Path

AXES = [f"{s}{a}" for s in "ag" for a in "xyz"]


def write_campaign(directory: Path, readings: dict[str, np.ndarray]) -> None:
    """Write a campaign with one CSV file that holds the (n, 6) readings of several sensors."""
    (directory / "configs" / "ingest").mkdir(parents=True)
    (directory / "raw" / "board").mkdir(parents=True)
    names = ["t_ms", *(f"{sensor}_{axis}" for sensor in readings for axis in AXES)]
    rows = np.column_stack([10.0 * np.arange(len(next(iter(readings.values())))), *readings.values()])
    lines = [",".join(f"{v:.9f}" for v in row) for row in rows]
    (directory / "raw" / "board" / "recording.csv").write_text("\n".join([",".join(names), *lines]) + "\n")
    channels = [f"{s}_{a}" for s in ("accel", "gyro") for a in "xyz"]
    columns = {
        c: {"column": f"${{ingest.instance}}_{axis}", "unit": "g" if c.startswith("accel") else "deg/s"}
        for c, axis in zip(channels, AXES, strict=True)
    }
    profile = {
        "defaults": ["canonical_csv", "_self_"],
        "name": "board",
        "csv": {"columns": {"time": {"column": "t_ms", "unit": "ms"}, **columns}},
    }
    (directory / "configs" / "ingest" / "board.yaml").write_text(yaml.safe_dump(profile))
    shared = ["ingest=board", "procedure=multi_position", "procedure.folder=raw/board"]
    (directory / "campaign.yaml").write_text(yaml.safe_dump({"overrides": shared}))
    units = [f"{sensor}-unit,ingest.instance={sensor}" for sensor in readings]
    (directory / "units.csv").write_text("\n".join(["unit,overrides", *units]) + "\n")


def test_each_unit_of_a_shared_log_has_its_own_readings(tmp_path: Path) -> None:
    generator = np.random.default_rng(5)
    readings = {s: np.array([0, 0, 1, 0, 0, 0]) + 0.01 * generator.normal(size=(200, 6)) for s in ("left", "right")}
    write_campaign(tmp_path, readings)
    campaign = load_campaign({"campaign": str(tmp_path)})
    for sensor, truth in readings.items():
        config = campaign.units[f"{sensor}-unit"].config
        folder = campaign.folder(f"{sensor}-unit")
        recording = read_recordings(config.procedure, config.ingest, config.sensor, folder)[0]
        assert recording.accelerometer is not None
        np.testing.assert_allclose(recording.accelerometer, truth[:, :3], rtol=0, atol=1e-9)
        assert recording.gyroscope is not None
        np.testing.assert_allclose(recording.gyroscope, truth[:, 3:], rtol=0, atol=1e-9)


def test_the_instance_of_a_topic_is_part_of_its_name(tmp_path: Path) -> None:
    composer = Composer(tmp_path)
    topics = [
        list(composer.unit("U1", ["ingest=ardupilot", *layers]).ingest.mcap["topics"])
        for layers in ([], ["ingest.instance=2"])
    ]
    assert topics == [["IMU[0]"], ["IMU[2]"]]


def test_an_instance_that_nothing_refers_to_and_a_missing_one_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="is set, and no name in the profile canonical_csv contains"):
        Composer(tmp_path).unit("U1", ["ingest.instance=1"])
    with pytest.raises(ConfigurationError, match="instance is null; set it"):
        Composer(tmp_path).unit("U1", ["ingest=ardupilot", "ingest.instance=null"])


def test_the_chips_of_a_board_stay_in_one_batch(tmp_path: Path) -> None:
    readings = {s: np.tile([0, 0, 1, 0, 0, 0.0], (50, 1)) for s in ("left", "middle", "right", "other")}
    write_campaign(tmp_path, readings)
    rows = [f"{s}-unit,ingest.instance={s},{'' if s == 'other' else 'B1'}" for s in readings]
    (tmp_path / "units.csv").write_text("\n".join(["unit,overrides,board", *rows]) + "\n")
    campaign = load_campaign({"campaign": str(tmp_path), "overrides": ["batch_size=2"]})
    assert campaign.boards == {"B1": ["left-unit", "middle-unit", "right-unit"]}
    assert list(campaign.batches.values()) == [["left-unit", "middle-unit", "right-unit"], ["other-unit"]]
    content = [json.loads(f["calibration"].content) for f in settings_of_jobs(campaign).values() if "calibration" in f]
    boards = [merge_common(c)["units"] for c in content]
    assert boards[0]["right-unit"]["stated"]["board"] == {"name": "B1", "chips": campaign.boards["B1"]}
    assert boards[1]["other-unit"]["stated"]["board"] is None


def test_chips_of_a_board_with_different_methods_are_refused(tmp_path: Path) -> None:
    write_campaign(tmp_path, {s: np.tile([0, 0, 1, 0, 0, 0.0], (50, 1)) for s in ("left", "right")})
    rows = ["left-unit,ingest.instance=left,B1,", "right-unit,ingest.instance=right,B1,rests_and_moves"]
    (tmp_path / "units.csv").write_text("\n".join(["unit,overrides,board,method", *rows]) + "\n")
    with pytest.raises(ConfigurationError, match="the chips of B1 are estimated together; expected consecutive rows"):
        load_campaign({"campaign": str(tmp_path)})
