"""Packs: what is read is what was written, or refused, whatever happened to the file."""

from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from stage_files import write_pack

from pipeline.core.errors import DamagedFileError
from pipeline.core.pack import Pack, as_bytes, directory_of, new_pack

FILES = {"U1.json": {"bias": [0.1, -0.2]}, "U1.html": "<p>\N{DEGREE SIGN}C</p>" * 40, "U1.parquet": bytes(range(256))}


@pytest.fixture(scope="module")
def content(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return write_pack(tmp_path_factory.mktemp("pack") / "filter.zip", FILES).read_bytes()


def test_members_are_read_as_they_were_written_and_written_the_same_again(tmp_path: Path, content: bytes) -> None:
    path = write_pack(tmp_path / "below" / "again.zip", FILES)
    assert path.read_bytes() == content
    pack = Pack(path)
    assert pack.names() == list(FILES)
    assert pack.json("U1.json") == FILES["U1.json"]
    assert pack.read("U1.html").decode() == FILES["U1.html"]
    assert pack.read("U1.parquet") == FILES["U1.parquet"]
    assert "U2.json" not in pack


def test_files_that_were_deflated_by_the_version_before_are_read(tmp_path: Path) -> None:
    with ZipFile(tmp_path / "report.zip", "w", ZIP_DEFLATED) as archive:
        archive.writestr("U1.html", as_bytes(FILES["U1.html"]))
    pack = Pack(tmp_path / "report.zip")
    assert (pack.names(), pack.read("U1.html")) == (["U1.html"], as_bytes(FILES["U1.html"]))
    assert "U1.html" in pack
    assert pack.digest("U1.html") == Pack(write_pack(tmp_path / "new.zip", FILES)).digest("U1.html")


def test_files_that_are_published_one_by_one_are_not_compressed(tmp_path: Path) -> None:
    with new_pack(tmp_path / "report.zip", compressed=False) as add:
        add({name: as_bytes(FILES[name]) for name in ("U1.html", "U1.json")})
    assert as_bytes(FILES["U1.html"]) in (tmp_path / "report.zip").read_bytes()
    assert Pack(tmp_path / "report.zip").read("U1.html") == as_bytes(FILES["U1.html"])


@settings(max_examples=150)
@given(st.data())
def test_a_changed_byte_is_refused_or_changes_nothing(
    tmp_path_factory: pytest.TempPathFactory, content: bytes, data: st.DataObject
) -> None:
    damaged = bytearray(content)
    damaged[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
    path = tmp_path_factory.getbasetemp() / "damaged.zip"
    path.write_bytes(damaged)
    pack, said = Pack(path), []
    for name, was in FILES.items():
        try:
            assert pack.read(name) == as_bytes(was)
        except DamagedFileError as error:
            said.append(str(error))
    assert all(
        text.startswith(str(path)) and "run the same command again: snakemake writes the file anew" in text
        for text in said
    )


@pytest.mark.parametrize("left", [0.0, 0.3, 0.99])
def test_a_short_or_missing_pack_is_refused(tmp_path: Path, content: bytes, left: float) -> None:
    path = tmp_path / "filter.zip"
    with pytest.raises(DamagedFileError):
        Pack(path).read("U1.json")
    path.write_bytes(content[: int(left * len(content))])
    with pytest.raises(DamagedFileError):
        Pack(path).read("U1.json")


def test_a_pack_that_is_not_finished_has_no_name(tmp_path: Path) -> None:
    def stopped(path: Path) -> None:
        with new_pack(path) as add:
            add({"new": b"new"})
            raise RuntimeError

    path = write_pack(tmp_path / "filter.zip", {"old": "old"})
    with pytest.raises(RuntimeError):
        stopped(path)
    assert Pack(path).names() == ["old"]


def test_the_list_of_members_tells_packs_of_one_size_apart(tmp_path: Path) -> None:
    one, other = (write_pack(tmp_path / f"{n}.zip", {"U1.parquet": bytes([n] * 9)}) for n in (1, 2))
    assert one.stat().st_size == other.stat().st_size
    assert directory_of(str(one)) != directory_of(str(other))
    assert directory_of(str(one)) == directory_of(str(write_pack(tmp_path / "3.zip", {"U1.parquet": bytes([1] * 9)})))
