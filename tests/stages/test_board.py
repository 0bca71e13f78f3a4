"""The stage calibration finds how the chips of a board sit, and states why where it cannot."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from board_simulator import by_hand, draw_chip, hand_board
from stage_files import write_pack

from pipeline.app.steps.batch import Job
from pipeline.app.steps.calibration import _on_board
from pipeline.core.pack import FAILED_SUFFIX, Pack
from pipeline.core.settings import Board
from pipeline.ingest.arrow import to_parquet
from pipeline.simulation.description import shipped_settings
from tests.published import TESTED, validation_document

if TYPE_CHECKING:
    from pathlib import Path


def test_the_reference_of_a_board_says_how_the_others_sit(tmp_path: Path) -> None:
    rng = np.random.default_rng(11)
    place = np.array([0.03, -0.02, 0.01])
    pair = draw_chip(rng, np.eye(3), np.zeros(3)), draw_chip(rng, np.eye(3), place)
    chips = hand_board(rng, pair, by_hand(rng, rests=24))
    names = [chip.unit for chip in chips]
    kept = dict.fromkeys(("accelerometer", "gyroscope"), TESTED)
    files = {
        "ingest": {f"{c.unit}.parquet": to_parquet(c.recordings) for c in chips},
        "validate": {f"{n}.json": validation_document(n, kept) for n in names} | {f"lost{FAILED_SUFFIX}": {}},
    }
    for sensor in ("accelerometer", "gyroscope"):
        files[sensor] = {f"{c.unit}.json": c.calibrations[sensor].to_json() for c in chips}
    inputs = {stage: Pack(write_pack(tmp_path / f"{stage}.zip", own)) for stage, own in files.items()}
    shipped = shipped_settings(sensor="mpu6050")
    units = {chip.unit: shipped.replaced(sensor=chip.sensor_model) for chip in chips}
    job = Job("calibration", units, {}, inputs, tmp_path / "out.zip", tmp_path)
    board = Board(name="B1", chips=[*names, "lost"])
    found = _on_board(job, names[0], board)
    assert found["chips"]["lost"] == {"refused": "lost could not be calibrated"}
    parts = [found["chips"][names[1]]["parameters"][f"lever_arm_{a}"] for a in "xyz"]
    assert all(abs(p["value"] - t) < 1.5 * p["expanded_uncertainty"] for p, t in zip(parts, place, strict=True))
    assert _on_board(job, names[1], board) == {"name": "B1", "reference": names[0], "chips": {}}
