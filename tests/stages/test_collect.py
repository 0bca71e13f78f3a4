"""Recordings that reach a job in one file give the same as those that it reads where they lie."""

import os
import shutil
from pathlib import Path

from pipeline.app.config import load_campaign, settings_of_jobs
from pipeline.app.results_folder import release_locks
from pipeline.app.steps import batch
from pipeline.core.pack import Pack

DEMO = Path(__file__).parents[2] / "data" / "demo"
SHEET = """unit,overrides
good,
same,procedure.folder=raw/good
beside,"procedure.folder=../elsewhere"
absolute,procedure.folder={folder}
absent,
empty,
text,
pipe,
two,
"""


def members(campaign: Path, *, collected: bool) -> dict[str, bytes]:
    loaded = load_campaign({"campaign": str(campaign), "results": str(campaign.parent / "results")})
    ((name, files),) = [(name, files) for name, files in settings_of_jobs(loaded).items() if "ingest" in files]
    config = loaded.results / "configs" / files["ingest"].name
    config.parent.mkdir(parents=True, exist_ok=True)
    config.write_bytes(files["ingest"].content)
    packs = {stage: loaded.results / "batches" / name / f"{stage}.zip" for stage in ("collect", "ingest")}
    options = [f"--recordings={packs['collect'] if collected else ''}"]
    try:
        if collected:
            batch.main("collect", ["--config", str(config), "--output", str(packs["collect"])])
            campaign.rename(campaign.with_name("away"))
        batch.main("ingest", ["--config", str(config), "--output", str(packs["ingest"]), *options])
    finally:
        release_locks()
    made = Pack(packs["ingest"])
    if collected:
        stored = Pack(packs["collect"]).names()
        assert len(set(stored)) == len(stored)
    return {name: made.read(name) for name in made.names()}


def test_ingest_from_a_pack_of_recordings_writes_the_same_bytes(tmp_path: Path) -> None:
    campaign = tmp_path / "fleet"
    names = [f"{name}.csv" for name in ("accel_x", "accel_y", "accel_z", "gyro_x", "gyro_y", "gyro_z", "validation")]
    folders = [campaign / "raw" / unit for unit in ("good", "text", "pipe", "two")]
    for folder in (*folders, tmp_path / "elsewhere", tmp_path / "other"):
        folder.mkdir(parents=True)
        for name in names:
            shutil.copyfile(DEMO / "raw" / "mpu6050-1" / name, folder / name)
    (campaign / "raw" / "empty").mkdir()
    (campaign / "raw" / "text" / "accel_x.csv").write_text("time_s,accel_x_g\n0,none\n")
    (campaign / "raw" / "pipe" / "accel_x.csv").unlink()
    os.mkfifo(campaign / "raw" / "pipe" / "accel_x.csv")
    (campaign / "raw" / "two" / "accel_x.mcap").write_bytes(b"not read")
    (campaign / "units.csv").write_text(SHEET.format(folder=tmp_path / "other"))
    there = members(campaign, collected=False)
    assert members(campaign, collected=True) == there
    failed = {name.removesuffix(".failed.json") for name in there if name.endswith(".failed.json")}
    assert failed == {"absent", "empty", "text", "pipe"}
    assert b"accel_x.mcap exists too" in there["two.parquet"]
