"""The sheet of a unit's recordings: its kinds, and errors that name row and column."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from pipeline.core.errors import IngestError, MissingInputError
from pipeline.ingest.recordings_sheet import direction_of, read_sheet

if TYPE_CHECKING:
    from pathlib import Path

HEADER = "file,kind,axis,angle_deg,angle_accuracy_deg,held_out,label\n"


def sheet(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "recordings.csv"
    path.write_text(text)
    return path


def test_each_row_is_a_recording_by_the_name_of_its_file(tmp_path: Path) -> None:
    rows = "a.csv,rest\n# a remark\n\nt.csv,turn,0 0 -2,361.3,0.1,yes\nt.mcap,turn,-y,,,no,tilted\n"
    found = read_sheet(sheet(tmp_path, HEADER + rows))
    assert list(found) == ["a", "t.csv", "t.mcap"]
    assert [entry.role for entry in found.values()] == ["rests", "validation", "rests"]
    turn = found["t.csv"]
    assert (turn.kind, turn.direction, turn.angle_deg, turn.angle_accuracy_deg) == (
        "turn",
        [0.0, 0.0, -1.0],
        361.3,
        0.1,
    )
    assert found["t.mcap"].direction == [0.0, -1.0, 0.0]
    assert found["t.mcap"].angle_deg is None


def test_columns_may_be_left_out_and_in_another_order(tmp_path: Path) -> None:
    assert read_sheet(sheet(tmp_path, "kind,file\nmoves,all.csv\n"))["all"].kind == "moves"


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        (HEADER + "a.csv,rests\n", 2, ["column kind", "'rests'", "attitudes"]),
        (HEADER + "a.csv,rest\nb.csv,turn,w\n", 3, ["column axis", "'w'", "three numbers"]),
        (HEADER + "b.csv,turn,1 2\n", 2, ["column axis", "'1 2'"]),
        (HEADER + "b.csv,turn,0 0 0\n", 2, ["column axis"]),
        (HEADER + "b.csv,turn,x,none\n", 2, ["column angle_deg", "'none'"]),
        (HEADER + "b.csv,turn,x,0\n", 2, ["column angle_deg", "not 0"]),
        (HEADER + "b.csv,turn,x,360,-1\n", 2, ["column angle_accuracy_deg", "'-1'"]),
        (HEADER + "b.csv,rest,x\n", 2, ["column axis", "this is rest"]),
        (HEADER + "b.csv,rest,,,,maybe\n", 2, ["column held_out", "yes or nothing"]),
        (HEADER + ",rest\n", 2, ["column file"]),
        (HEADER + "b.csv,rest\nb.csv,rest\n", 3, ["column file", "two rows"]),
        (HEADER + "b.csv,rest,,,,yes\n", 1, ["column held_out", "none is left to fit"]),
        (HEADER + "b.csv,rest,,,,,,9\n", 2, ["8 cells", "7 columns"]),
        ("file,sort\nb.csv,rest\n", 1, ["column 'sort' is unknown", "columns are file, kind"]),
        ("file,axis\nb.csv,x\n", 1, ["column 'kind' is missing"]),
        (HEADER, 1, ["no row names a file"]),
    ],
)
def test_an_error_names_row_and_column(tmp_path: Path, text: str, line: int, words: list[str]) -> None:
    with pytest.raises(IngestError) as refusal:
        read_sheet(sheet(tmp_path, text))
    assert str(refusal.value.file).endswith(f"recordings.csv:{line}")
    assert all(word in refusal.value.message for word in words), refusal.value.message


def test_a_missing_sheet_is_named_with_its_columns(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError, match="columns file, kind"):
        read_sheet(tmp_path / "recordings.csv")


def test_three_numbers_are_a_direction() -> None:
    assert direction_of("3 0 4") == pytest.approx([0.6, 0.0, 0.8])
    assert direction_of("+z") == [0.0, 0.0, 1.0]
    assert direction_of("--z") is None
