"""The profiles that ship, as Hydra composes them, and the files that they ask for."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest
from calls import imported_by
from sample_logs import procedure, profile
from unit_settings import ingest_of

from imu_logs.profile import csv_formats, mcap_format
from pipeline.app.config.compose import Composer, check_ingest
from pipeline.core.errors import ConfigurationError
from pipeline.ingest.files import candidate_files

if TYPE_CHECKING:
    from pathlib import Path

PROFILES = (
    "canonical_csv",
    "mcap",
    "mcap_fields",
    "arduino_counts",
    "xsens_mti_multi_position",
    "mpu6050_multi_position",
)


@pytest.mark.parametrize("name", PROFILES)
def test_composed_profile_is_sound(tmp_path: Path, name: str) -> None:
    config = Composer(tmp_path).unit("U1", ["procedure=multi_position", "sensor=mpu6050", f"ingest={name}"])
    check_ingest(config.ingest, config.procedure)
    assert config.ingest.name == name
    assert mcap_format(config.ingest).imu_topic is None


@pytest.mark.parametrize(("section", "other"), [("csv", "mcap"), ("mcap", "csv")])
def test_a_profile_without_the_other_section_is_read_with_its_defaults(
    tmp_path: Path, section: str, other: str
) -> None:
    stated = profile("canonical_csv")["csv"] if section == "csv" else {"imu_topic": "/imu"}
    file = tmp_path / "configs" / "ingest" / "mine.yaml"
    file.parent.mkdir(parents=True)
    file.write_text(json.dumps({"name": "mine", section: stated}), encoding="utf-8")
    ingest = Composer(tmp_path).unit("U1", ["procedure=multi_position", "ingest=mine"]).ingest
    assert (getattr(ingest, section), getattr(ingest, other)) == (stated, {})
    assert mcap_format(ingest).imu_topic == (None if section == "csv" else "/imu")


def test_counts_of_the_arduino_profile_follow_the_sensor(tmp_path: Path) -> None:
    layers = ["sensor=mpu6050", "ingest=arduino_counts", "sensor.gyroscope.counts_per_unit=65.5"]
    config = Composer(tmp_path).unit("U1", layers)
    (layout,) = csv_formats(config.ingest)
    scales = {c.channel: c.counts_per_unit for c in layout.columns}
    assert scales["accel_x"] == config.sensor.accelerometer.counts_per_unit == 16384.0
    assert scales["gyro_z"] == 65.5
    assert scales["temperature"] == 340.0


def test_file_names_need_only_the_standard_library() -> None:
    code = (
        "import pipeline.ingest.files as f; from pathlib import Path; from types import SimpleNamespace as S;"
        "f.recording_files(S(recordings={'a': S(file='a', optional=False)}), S(csv={}, mcap={}), Path('.'))"
    )
    assert imported_by(code, "numpy", "pyarrow", "mcap", "yaml", "omegaconf", "pydantic") == []


def test_a_log_of_messages_is_read_without_the_library_for_text() -> None:
    code = "import pipeline.ingest.read, imu_logs.message_read"
    assert imported_by(code, "pyarrow", "scipy", "yaml", "omegaconf") == []


def parts(*files: str) -> dict[str, Any]:
    ingest = profile("xsens_mti_multi_position")
    ingest["csv"]["parts"] = [{**p, "file": f} for p, f in zip(ingest["csv"]["parts"], files, strict=True)]
    return ingest


def test_parts_with_fixed_names_belong_to_the_required_recording() -> None:
    wanted = candidate_files(procedure("recording", optional=("static",)), ingest_of(parts("a.txt", "b.txt")))
    assert wanted["recording"][:3] == [["a.txt", "b.txt"], ["recording.mcap"], ["recording.bag"]]
    assert wanted["static"][0] == ["static.mcap"]


def test_parts_named_after_the_recording_belong_to_each() -> None:
    wanted = candidate_files(procedure("r", optional=("s",)), ingest_of(parts("{file}_acc.txt", "{file}_gyr.txt")))
    assert wanted["r"][:2] == [["r_acc.txt", "r_gyr.txt"], ["r.mcap"]]
    assert wanted["s"][:2] == [["s_acc.txt", "s_gyr.txt"], ["s.mcap"]]


def test_parts_that_do_not_suit_the_procedure_are_refused() -> None:
    with pytest.raises(ConfigurationError, match="this one requires a, b"):
        check_ingest(ingest_of(parts("a.txt", "b.txt")), procedure("a", "b"))


@pytest.mark.parametrize(
    ("index", "change", "message"),
    [
        (0, {"file": ""}, r"parts\[0\].file is ''"),
        (1, {"fil": "x"}, r"parts\[1\].fil is unknown; did you mean file"),
        (1, {"columns": {"accel_x": {"column": 1, "unit": "g"}}}, "needs either a time column"),
        (
            1,
            {"columns": {c: {"column": 0, "unit": u} for c, u in (("time", "s"), ("accel_x", "g"))}},
            "accel_x is in two parts",
        ),
    ],
)
def test_faulty_part_is_refused(index: int, change: dict[str, Any], message: str) -> None:
    ingest = profile("xsens_mti_multi_position")
    ingest["csv"]["parts"][index].update(change)
    with pytest.raises(ConfigurationError, match=message):
        check_ingest(ingest_of(ingest))
