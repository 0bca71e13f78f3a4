"""Whatever happens to a text log, no number is read that it does not hold, and nothing is left out or repaired unsaid.

A text log has no checksum: a digit that turned into another digit is a number like any other. So two things are held.
Of any bytes: what is read without a note is, row by row, what an independent reader finds in the text. Of damage that
leaves digits alone (lines, cells and columns lost, doubled, merged or moved, foreign bytes, cut files): the log is
refused, noted, or what is read are rows of the log as it was, one after the other.
"""

from __future__ import annotations

import copy
import csv
from typing import TYPE_CHECKING, Any

import numpy as np
from bad_logs import FILE, HEADER, ROWS, VALUES, text
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sample_logs import SENSOR, procedure, profile
from unit_settings import ingest_of

from pipeline.core.errors import InputError
from pipeline.ingest.read import read_recordings

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from pipeline.core.records import Recording

CANONICAL = profile("canonical_csv")
COUNT = 150
SOUND = text(ROWS[:COUNT])
LINES = SOUND.split(b"\n")[:-1]
PROFILES = ({}, {"bad_rows": "drop"}, {"nan": "gap"}, {"bad_rows": "drop", "nan": "gap"}, {"delimiter": "auto"})
ALONE = settings(
    max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)


def read(folder: Path, content: bytes, changes: dict[str, Any], share: float) -> Recording | None:
    """Return the recording, None where it is refused."""
    ingest = copy.deepcopy(CANONICAL)
    ingest["csv"] |= changes
    ingest["checks"] = {"repaired_rows": share, "missing_time": share}
    (folder / FILE).write_bytes(content)
    try:
        return read_recordings(procedure("log"), ingest_of(ingest), SENSOR, folder)[0]
    except InputError:
        return None


def numbers(recording: Recording) -> np.ndarray:
    assert recording.accelerometer is not None
    assert recording.gyroscope is not None
    return np.column_stack([recording.accelerometer, recording.gyroscope])


@st.composite
def edited(draw: st.DrawFn) -> bytes:
    """Return the log with some bytes changed, inserted or deleted anywhere."""
    data = bytearray(SOUND)
    for _ in range(draw(st.integers(1, 3))):
        place, length = draw(st.integers(0, len(data) - 1)), draw(st.integers(0, 3))
        alphabet = st.one_of(st.sampled_from(list(b"0123456789.,-+eE \t\r\n\"';xXnaif_\0")), st.integers(0, 255))
        data[place : place + length] = bytes(draw(st.lists(alphabet, max_size=3)))
    return bytes(data)


@ALONE
@given(content=edited(), changes=st.sampled_from(PROFILES))
def test_what_is_read_without_a_note_is_what_the_text_says(
    tmp_path: Path, content: bytes, changes: dict[str, Any]
) -> None:
    recording = read(tmp_path, content, changes, 0.05)
    if recording is None or {n.code for n in recording.notes} - {"N-JITTER", "N-DELIM", "N-IGNORED", "N-ORDER"}:
        return
    rows = [r for r in csv.reader(content.decode().splitlines()) if r]
    names = [n.strip() for n in rows[0]]
    said = np.array([[float(row[names.index(n)]) for n in HEADER.split(",")] for row in rows[1:]])
    np.testing.assert_array_equal(numbers(recording), said[:, 1:])
    np.testing.assert_array_equal(np.diff(recording.time_ns), np.diff(np.rint(said[:, 0] * 1e9)))


def cut(draw: st.DrawFn, _lines: list[bytes]) -> bytes:
    return SOUND[: draw(st.integers(0, len(SOUND)))]


def line_lost(draw: st.DrawFn, lines: list[bytes]) -> bytes:
    del lines[draw(st.integers(0, COUNT))]
    return b"\n".join(lines) + b"\n"


def line_doubled(draw: st.DrawFn, lines: list[bytes]) -> bytes:
    lines.insert(draw(st.integers(0, COUNT + 1)), lines[draw(st.integers(0, COUNT))])
    return b"\n".join(lines) + b"\n"


def lines_exchanged(draw: st.DrawFn, lines: list[bytes]) -> bytes:
    a, b = draw(st.integers(0, COUNT)), draw(st.integers(0, COUNT))
    lines[a], lines[b] = lines[b], lines[a]
    return b"\n".join(lines) + b"\n"


def lines_merged(draw: st.DrawFn, lines: list[bytes]) -> bytes:
    at = draw(st.integers(0, COUNT - 1))
    lines[at : at + 2] = [draw(st.sampled_from([b"", b",", b" "])).join(lines[at : at + 2])]
    return b"\n".join(lines) + b"\n"


def cell_lost(draw: st.DrawFn, lines: list[bytes]) -> bytes:
    at = draw(st.integers(0, COUNT))
    cells = lines[at].split(b",")
    del cells[draw(st.integers(0, len(cells) - 1))]
    lines[at] = b",".join(cells)
    return b"\n".join(lines) + b"\n"


def cell_replaced(draw: st.DrawFn, lines: list[bytes]) -> bytes:
    at = draw(st.integers(1, COUNT))
    cells = lines[at].split(b",")
    odd = [b"", b"nan", b"NaN", b"inf", b"-inf", b"1e999", b"ERR", b"0x1F", b"1_0", b"--1", b"1..2", b"N/A", b"#", b'"']
    cells[draw(st.integers(0, len(cells) - 1))] = draw(st.sampled_from(odd))
    lines[at] = b",".join(cells)
    return b"\n".join(lines) + b"\n"


def column_lost(draw: st.DrawFn, lines: list[bytes]) -> bytes:
    at, first = draw(st.integers(0, 6)), draw(st.integers(0, COUNT))
    changed = [b",".join(c for i, c in enumerate(line.split(b",")) if i != at) for line in lines[first:]]
    return b"\n".join(lines[:first] + changed) + b"\n"


def columns_exchanged(draw: st.DrawFn, lines: list[bytes]) -> bytes:
    order = draw(st.permutations(range(7)))
    return b"\n".join(b",".join(line.split(b",")[i] for i in order) for line in lines) + b"\n"


def bytes_inserted(draw: st.DrawFn, _lines: list[bytes]) -> bytes:
    """Insert what cannot be part of a number."""
    at = draw(st.integers(0, len(SOUND)))
    foreign = [b"\0", b"\0" * 512, b",", b";", b"\xff", b"\xc2\xb5", b'"', b"#", b"x", b"\r", b"\n", b"\n\n"]
    return SOUND[:at] + draw(st.sampled_from(foreign)) + SOUND[at:]


def header_again(draw: st.DrawFn, lines: list[bytes]) -> bytes:
    lines.insert(draw(st.integers(1, COUNT + 1)), lines[0])
    return b"\n".join(lines) + b"\n"


DAMAGES: tuple[Callable[[st.DrawFn, list[bytes]], bytes], ...] = (
    cut, line_lost, line_doubled, lines_exchanged, lines_merged, cell_lost, cell_replaced, column_lost,
    columns_exchanged, bytes_inserted, header_again,
)  # fmt: skip


@st.composite
def damaged(draw: st.DrawFn) -> bytes:
    return draw(st.sampled_from(DAMAGES))(draw, list(LINES))


@ALONE
@given(content=damaged(), changes=st.sampled_from(PROFILES), share=st.sampled_from([0.001, 0.05]))
def test_damage_is_refused_or_noted_or_leaves_rows_as_they_were(
    tmp_path: Path, content: bytes, changes: dict[str, Any], share: float
) -> None:
    recording = read(tmp_path, content, changes, share)
    if recording is None:
        return
    found = numbers(recording)
    places = [int(np.flatnonzero((VALUES[:COUNT, 1:] == row).all(axis=1))[0]) for row in found]
    assert np.all(np.diff(places) > 0), "rows in another order, or a row twice"
    rest = {n.code for n in recording.notes} - {"N-DELIM", "N-ORDER"}
    assert rest or np.all(np.diff(places) == 1), "rows lost without a note"
