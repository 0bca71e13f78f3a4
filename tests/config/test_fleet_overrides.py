"""Overrides by sensor model, lot and device; where each value comes from; what jobs are told of many units."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.__main__ import main
from pipeline.app.config import Campaign, load_campaign
from pipeline.app.config.options import parse
from pipeline.app.config.stage_settings import in_common, settings_in_memory
from pipeline.app.steps.batch import merge_common
from pipeline.core.errors import ConfigurationError

HYDRA = OverridesParser.create()
SHEET = """unit,serial,lot,sensor,filter,overrides
U1,S1,L1,mpu6050,,
U2,S2,L1,stim300,,
U3,S3,L2,mpu6050,,filter.cutoff_hz=6
U4,S4,L2,stim300,high_pass,
U5,S5,,mpu6050,,
U6,S5,,mpu6050,,
"""
SETTINGS = """
overrides: [filter=low_pass, filter.cutoff_hz=1, table.gravity_g=0.991]
models: {stim300: [filter.cutoff_hz=2, table.gravity_g=0.992]}
lots: {L2: [filter.cutoff_hz=3, table.gravity_g=0.993]}
"""
DEVICES = {
    "S4": "overrides: [filter.cutoff_hz=4]",
    "S5": "overrides: [filter.cutoff_hz=5, filter.order=3]",
    "U6": "overrides: [filter.order=1, table=mark2]",
}


@pytest.fixture
def fleet(tmp_path: Path) -> Path:
    directory = tmp_path / "fleet"
    (directory / "devices").mkdir(parents=True)
    (directory / "units.csv").write_text(SHEET)
    (directory / "campaign.yaml").write_text(SETTINGS)
    for name, text in DEVICES.items():
        (directory / "devices" / f"{name}.yaml").write_text(text)
    return directory


def load(directory: Path, **settings: object) -> Campaign:
    return load_campaign({"campaign": str(directory), **settings})


def test_sheet_and_device_state_the_mounting(fleet: Path) -> None:
    (fleet / "devices" / "U1.yaml").write_text(
        "overrides:\n- table.sense=-1\n- procedure.recordings.gyro_z.up=-z\n- sensor.gyroscope.axis_map=[+x,-y,-z]\n"
    )
    found = settings_in_memory(load(fleet).units["U1"], "ingest")
    assert found.table.sense == -1
    assert found.procedure.recordings["gyro_z"].up == "-z"
    assert found.sensor.gyroscope.axis_map == ["+x", "-y", "-z"]


def test_a_device_is_stronger_than_its_lot_and_a_lot_than_its_model(fleet: Path) -> None:
    units = load(fleet).units
    told = {n: (u.config.filter.cutoff_hz, u.config.table.gravity_g) for n, u in units.items()}
    assert told == {
        "U1": (1, 0.991),
        "U2": (2, 0.992),
        "U3": (6, 0.993),
        "U4": (4, 0.993),
        "U5": (5, 0.991),
        "U6": (5, 0.991),
    }
    assert [units[u].config.filter.name for u in ("U3", "U4")] == ["low_pass", "high_pass"]
    assert [units[u].config.filter.order for u in ("U5", "U6")] == [3, 1]
    assert units["U6"].config.table.name == "mark2"
    run = load(fleet, overrides="filter.cutoff_hz=8", unit_overrides={"U4": ["filter.cutoff_hz=9"]}).units
    assert [run[u].config.filter.cutoff_hz for u in run] == [8, 8, 8, 9, 8, 8]


def test_the_model_is_the_one_that_a_unit_ends_up_with(fleet: Path) -> None:
    changed = load(fleet, unit_overrides={"U1": ["sensor=stim300"]}).units["U1"].config
    assert (changed.sensor.name, changed.filter.cutoff_hz) == ("stim300", 2)


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("campaign.yaml", "models: {mpu605: [filter=none]}", "models: no sensor config is called 'mpu605'; nearest"),
        ("campaign.yaml", "models: {mpu6050: [sensor=stim300]}", "models, mpu6050: the overrides of a model cannot"),
        ("campaign.yaml", "models: [filter=none]", "models: a mapping of names to lists of overrides is expected"),
        ("campaign.yaml", "lots: {L3: [filter=none]}", "lots: no lot of units.csv is called 'L3'"),
        ("campaign.yaml", "lots: {L1: [batch_size=3]}", "lots, L1: batch_size=3 is a setting of the run"),
        ("devices/S9.yaml", "overrides: []", "no unit or serial 'S9' in units.csv"),
        ("devices/S1.yaml", "overides: []", "S1.yaml: overides: unknown key; nearest: overrides"),
        ("devices/S1.yaml", "- filter=none", "S1.yaml: a mapping is expected"),
        ("devices/S1.yaml", "overrides: [batch_size=3]", "batch_size=3: is a setting of the run, not of a device"),
        ("devices/S1.yaml", "overrides: [filter.cutof_hz=3]", "unit U1: filter.cutof_hz=3: unknown key"),
        ("devices/S1.yaml", "overrides: {", "S1.yaml:2: is not YAML"),
    ],
)
def test_overrides_that_concern_nobody_or_are_no_overrides_are_refused(
    fleet: Path, file: str, text: str, message: str
) -> None:
    (fleet / file).write_text(text)
    with pytest.raises(ConfigurationError) as refused:
        load(fleet)
    assert message in str(refused.value)


def printed(capsys: pytest.CaptureFixture[str], *argv: str) -> tuple[str, dict[str, str]]:
    """Return what ``config`` prints, and the origin of each value by its dotted key."""
    assert main(["config", *argv]) == 0
    text = capsys.readouterr().out
    origins: dict[str, str] = {}
    branch: list[str] = []
    for line in text.splitlines():
        if line.startswith("#"):
            continue
        depth = (len(line) - len(line.lstrip())) // 2
        branch = [*branch[:depth], line.split(":")[0].strip()]
        if " # " in line:
            origins[".".join(branch)] = line.split(" # ")[1]
    return text, origins


def test_config_prints_the_resolved_configuration_and_the_origin_of_each_value(
    fleet: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text, origins = printed(capsys, "U4", "sensor.gyroscope.bias=3", "--campaign", str(fleet))
    resolved = load(fleet, overrides="sensor.gyroscope.bias=3").units["U4"].config
    assert yaml.safe_load(text) == resolved.configuration
    assert {
        key: origins[key]
        for key in (
            "unit", "sensor.name", "sensor.gyroscope.bias", "sensor.gyroscope.full_scale", "table.name",
            "table.gravity_g", "filter.name", "filter.cutoff_hz", "filter.order", "method.name", "ingest.name",
            "limits.gyroscope.bias", "sensor.gyroscope.repeatability_bias",
        )
    } == {
        "unit": "units.csv",
        "sensor.name": "units.csv line 5, column sensor",
        "sensor.gyroscope.bias": "command line, overrides=",
        "sensor.gyroscope.full_scale": "configs/sensor/stim300.yaml",
        "table.name": "default of procedure three_axis_turns",
        "table.gravity_g": "campaign.yaml, lots, L2",
        "filter.name": "units.csv line 5, column filter",
        "filter.cutoff_hz": "devices/S4.yaml",
        "filter.order": "configs/filter/high_pass.yaml",
        "method.name": "default of table acutronic with procedure three_axis_turns",
        "ingest.name": "default, configs/config.yaml",
        "limits.gyroscope.bias": "configs/config.yaml",
        "sensor.gyroscope.repeatability_bias": "not set anywhere: the default",
    }  # fmt: skip
    (weaker,) = re.findall(r"campaign.yaml, models, stim300 +filter.cutoff_hz=2 +(.*)", text)
    assert weaker == "(a stronger one stands below)"


def test_config_says_where_an_unknown_unit_or_a_refused_override_stands(
    fleet: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["config", "U7", "--campaign", str(fleet)]) == 2
    assert "no unit 'U7'; nearest: U6; valid: U1" in capsys.readouterr().err
    assert main(["config", "U1", "--campaign", str(fleet), "filter.order=x"]) == 2  # an option may stand before
    assert 'unit U1: filter.order="x": input should be a valid integer' in capsys.readouterr().err


@settings(max_examples=40)
@given(st.from_regex(r"[a-z_]{1,8}(\.[a-z_]{1,8}){0,2}=-?[0-9]{1,20}(\.[0-9]{0,20})?", fullmatch=True))
def test_numbers_are_read_as_hydra_reads_them(text: str) -> None:
    (key, value), override = parse(text), HYDRA.parse_override(text)
    assert (key, type(value), value) == (override.key_or_group, type(override.value()), override.value())


@settings(max_examples=60)
@given(
    st.from_regex(r"[a-z_]{1,8}(\.[a-z_]{1,8}){0,2}=[A-Za-z_][A-Za-z0-9_./-]{0,12}", fullmatch=True)
    | st.sampled_from(["a=" + word for word in ("null", "NULL", "true", "False", "nan", "Inf", "inf.", "nul", "e-5")])
)
def test_words_and_paths_are_read_as_hydra_reads_them(text: str) -> None:
    (key, value), override = parse(text), HYDRA.parse_override(text)
    read = override.value()
    assert (key, type(value)) == (override.key_or_group, type(read))
    assert value == read or (value != value and read != read)  # noqa: PLR0124  (both NaN)


JSON = st.recursive(
    st.integers(0, 2) | st.none() | st.lists(st.integers(0, 1), max_size=1),
    lambda below: st.dictionaries(st.sampled_from("abc"), below, max_size=3),
    max_leaves=6,
)
PART = st.dictionaries(st.sampled_from("abcd"), JSON, max_size=4)


@given(st.dictionaries(st.sampled_from(["U1", "U2", "U3", "U4"]), PART, max_size=4))
def test_what_units_have_in_common_is_told_once_and_put_together_again(parts: dict[str, Any]) -> None:
    common, own = in_common(parts)
    told = json.loads(json.dumps({"common": common, "units": own}))
    assert merge_common(told) == {"units": parts}
