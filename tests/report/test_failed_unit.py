"""The page and document of a unit that fails in a fit keep what ingest and the rests say of its recordings."""

import json
from pathlib import Path

from hand_session import hand_held
from stage_files import documents, write_pack

from pipeline.app.config.compose import Composer
from pipeline.app.steps import batch
from pipeline.core.pack import Pack
from pipeline.core.settings import Stated
from pipeline.ingest.arrow import to_parquet
from pipeline.unit import STEPS


def test_a_unit_that_fails_in_the_fit_shows_its_files_and_rests(tmp_path: Path) -> None:
    recordings = [r for r in hand_held("mpu6050", 3).recordings if r.role == "rests"]
    settings = Composer(tmp_path).unit("U1", ["procedure=multi_position", "sensor=mpu6050"])
    part = settings.replaced(stated=Stated(config_sha256="0")).only(STEPS["report"].settings)
    (tmp_path / "part.json").write_text(json.dumps({"units": {"U1": part}}))
    failure = {"unit": "U1", "stage": "fit/accelerometer", "code": "not_observable", "message": "alike", "file": None}
    files = {name: {} for name in batch.INPUTS["report"]} | {"calibration": {"U1.failed.json": failure}}
    files["filter"] = {"U1.parquet": to_parquet(recordings), "U1.noise.json": None}
    packs = {name: write_pack(tmp_path / f"{name}.zip", each) for name, each in files.items()}
    arguments = [word for name, pack in packs.items() for word in (f"--{name}", str(pack))]
    batch.main(
        "report", ["--config", str(tmp_path / "part.json"), *arguments, "--output", str(tmp_path / "report.zip")]
    )
    document = documents(tmp_path / "report.zip")["U1.calibration.json"]
    assert [i["recording"] for i in document["inputs"]] == ["recording"]
    used, held = (document["rests"][f"rests_{use}"] for use in ("used", "held_out"))
    assert len(held) == (len(used) + len(held) + 1) // 3 > 3
    page = Pack(tmp_path / "report.zip").read("U1.html").decode()
    assert f"{len(used) + len(held) + len(document['rests']['rests_left_out'])} rests, " in page
    assert "Segments found" in page
    assert "<td>held out</td>" in page
