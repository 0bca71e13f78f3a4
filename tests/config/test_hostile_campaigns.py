"""A campaign from a stranger: what its files may be, and what they may cost and read."""

import os
import resource
import time
from pathlib import Path

import pytest

from pipeline.app.config import load_campaign
from pipeline.core.errors import ConfigurationError
from pipeline.simulation.description import read_description

LFS_POINTER = f"version https://git-lfs.github.com/spec/v1\noid sha256:{'4d7a2146' * 8}\nsize 12345\n"
FILES = (
    "units.csv",
    "campaign.yaml",
    "simulation.yaml",
    "devices/U1.yaml",
    "effects/mine.yaml",
    "configs/table/t.yaml",
)
BOMB = "a: &a [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 10)}]\n" for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)
TABLE = (Path(__file__).parents[2] / "configs" / "table" / "acutronic.yaml").read_text()


def campaign(directory: Path, sheet: str | bytes = "unit\nU1\n", **files: str) -> Path:
    own = directory / "bench"
    own.mkdir()
    (own / "units.csv").write_bytes(sheet if isinstance(sheet, bytes) else sheet.encode())
    for name, text in files.items():
        put(own, name, text)
    return own


def put(own: Path, name: str, text: str) -> None:
    (own / name).parent.mkdir(parents=True, exist_ok=True)
    (own / name).write_text(text)


def refused(own: Path, **settings: object) -> str:
    with pytest.raises(ConfigurationError) as error:
        load_campaign({"campaign": str(own), **settings})
    return str(error.value)


@pytest.mark.parametrize("file", FILES)
def test_only_regular_files_and_links_to_them_are_read(tmp_path: Path, file: str) -> None:
    own = campaign(tmp_path, **{"campaign.yaml": "simulate: true\n", "simulation.yaml": "units: []\n"})
    path = own / file
    path.parent.mkdir(exist_ok=True, parents=True)
    for make, what in (
        (lambda: os.mkfifo(path), "is a FIFO; a regular file"),
        (lambda: path.symlink_to("/dev/zero"), "is a device; a regular file"),
        (lambda: path.symlink_to("absent"), "is a symbolic link to absent, which does not exist"),
        (lambda: path.write_text(LFS_POINTER), "is a Git LFS pointer, not the file itself: run git lfs pull"),
        (path.mkdir, "is a directory; a regular file"),
    ):
        path.unlink(missing_ok=True)
        make()
        assert f"{file}: {what}" in refused(own)
    path.rmdir()
    real = tmp_path / "real"
    real.write_text("unit\nU2\n" if file == "units.csv" else "{}\n")
    path.symlink_to(real)
    if file in ("units.csv", "campaign.yaml", "simulation.yaml", "configs/table/t.yaml"):
        load_campaign({"campaign": str(own)})


@pytest.mark.parametrize("file", [f for f in FILES if f.endswith("yaml") and "effects" not in f])
@pytest.mark.parametrize(
    ("text", "message"),
    [
        (BOMB, "values, each alias (*) counted with all that it stands for"),
        ("a: &a [*a]", "alias *a has no anchor before it"),
        ("[" * 100_000, "is nested more than 50 deep"),
        ("a: &b [1]\n" + "".join(f"a{i}: &b [*b]\n" for i in range(60)), "anchor|nested"),
        ("a: !!python/object/apply:os.getpid []", "is not YAML: could not determine a constructor"),
        ("a: 1\na: 2\n", "'a' stands twice"),
    ],
    ids=["bomb", "endless", "deep", "chain", "tag", "twice"],
)
def test_a_yaml_file_costs_no_more_than_its_size_explains(tmp_path: Path, file: str, text: str, message: str) -> None:
    own = campaign(tmp_path, **{file: text})
    before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    if file == "simulation.yaml":
        with pytest.raises(ConfigurationError) as error:
            read_description(own / file)
        said = str(error.value)
    else:
        said = refused(own)
    assert any(m in said for m in message.split("|")), said
    assert file in said
    assert time.process_time() - start < 2.0
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


@pytest.mark.parametrize(
    "text", ["${oc.env:IMU_SECRET}", "${${sensor.name}:IMU_SECRET}", "x${oc.env:IMU_SECRET,y}", "${oc.env:IMU_SECRET"]
)
def test_no_resolver_is_run_wherever_it_stands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setenv("IMU_SECRET", "hunter2")
    own = campaign(tmp_path, "unit,table\nU1,\n")
    override = f"'procedure.folder=\"{text}\"'"[1:-1]
    said = [refused(own, overrides=[override]), refused(own, unit_overrides={"U1": [override]})]
    put(own, "campaign.yaml", f"overrides: ['{override}']\n")
    said.append(refused(own))
    put(own, "campaign.yaml", "{}")
    put(own, "devices/U1.yaml", f"overrides: ['{override}']\n")
    said.append(refused(own))
    put(own, "devices/U1.yaml", "{}")
    for table in (TABLE.replace("motion: logged", f"motion: '{text}'"), f"defaults: [{{other: '{text}'}}]\n{TABLE}"):
        put(own, "configs/table/mine.yaml", table)
        (own / "units.csv").write_text("unit,table\nU1,mine\n")
        said.append(refused(own))
    assert all("hunter2" not in s for s in said), said
    assert all("a reference is ${group.key}" in s or "is not a Hydra override" in s for s in said), said


def test_references_to_settings_stay_and_do_not_multiply(tmp_path: Path) -> None:
    own = campaign(tmp_path)
    loaded = load_campaign({"campaign": str(own), "overrides": ['procedure.folder="raw/${sensor.name}/{unit}"']})
    assert loaded.units["U1"].config.procedure.folder == "raw/generic/U1"
    for value, message in {
        "${sensor.accelerometer}": "is a group of settings",
        "${table.rate_accuracy}": "is a group of settings or a reference",
        "${sensor.nmae}": "no setting is called sensor.nmae",
    }.items():
        overrides = [f"table.gravity_g={value}", "table.rate_accuracy=${table.gravity_g}"]
        assert message in refused(own, overrides=overrides)


@pytest.mark.parametrize(
    ("sheet", "message"),
    [
        ("unit,overide\nU1,\n", "column 'overide' is not known; nearest: overrides"),
        ("unit,procedur\nU1,\n", "nearest: procedure"),
        ("unit,Lots\nU1,\n", "nearest: lot"),
        ("unit;serial\nU1;S1\n", "separated by semicolons, where commas are expected; save it again"),
        ("unit\nU1\nu1\n", "line 3: units 'U1' and 'u1' differ in upper and lower case only"),
        ("unit\n..\n", "line 2: unit '..': use letters"),
        (f"unit\n{'x' * 201}\n", "has 201 characters; 200 is the limit"),
        ("unit\nU1.failed\n", "a name cannot end in .failed"),
        ("unit,note\nU1,a\0b\n", "line 2: column 'note' holds a control character"),
        (f"unit,note\nU1,{'x' * 200_000}\n", "field larger than field limit"),
        ("unit,note\nU1,gr\u00fcn\n".encode("latin-1"), "byte 15 is not UTF-8; save it as UTF-8 text"),
        ("unit\nU1\n".encode("utf-16"), "it is UTF-16"),
    ],
)
def test_a_sheet_that_is_not_meant_so_is_refused(tmp_path: Path, sheet: str | bytes, message: str) -> None:
    assert message in refused(campaign(tmp_path, sheet))


def test_odd_names_of_units_and_columns_of_ones_own_are_taken(tmp_path: Path) -> None:
    names = ["con", ".hidden", "-x", "...", "x" * 200]
    own = campaign(tmp_path, "unit,plot,rate_dps\n" + "".join(f"{n},a,1\n" for n in names))
    assert list(load_campaign({"campaign": str(own)}).units) == names


@pytest.mark.parametrize("name", ["a,b", "a{b}", "a'b c", "{unit}", 'a"b\\c'])
def test_a_campaign_with_configs_of_its_own_may_lie_anywhere(tmp_path: Path, name: str) -> None:
    (tmp_path / name).mkdir()
    own = campaign(tmp_path / name, "unit,table\nU1,mine\n", **{"configs/table/mine.yaml": TABLE})
    assert load_campaign({"campaign": str(own)}).units["U1"].config.table.name == "mine"


@pytest.mark.parametrize("name", [b"a\xffb", b"a\nb"], ids=["not UTF-8", "line end"])
def test_a_path_that_no_page_can_name_is_refused(tmp_path: Path, name: bytes) -> None:
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + name))
    folder.mkdir()
    assert "in UTF-8, is expected; rename it" in refused(campaign(folder))
    (tmp_path / "good").mkdir()
    assert "in UTF-8, is expected; rename it" in refused(campaign(tmp_path / "good"), results=str(folder))
