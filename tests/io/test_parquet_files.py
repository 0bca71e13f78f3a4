"""Recordings between the stages: every bit comes back."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from pyarrow import parquet
from sample_logs import SENSOR, assert_same_bits, make_recording, procedure, profile
from stage_files import load_recordings, save_recordings
from unit_settings import ingest_of

from pipeline.core.errors import InputError
from pipeline.core.records import Note, Recording
from pipeline.ingest import arrow
from pipeline.ingest.read import read_recordings

if TYPE_CHECKING:
    from pathlib import Path


def unit() -> list[Recording]:
    """Return three recordings that hold different channels."""
    full = make_recording(120)
    noted = replace(
        full,
        flags=np.arange(120, dtype=np.uint16) % 3,
        notes=(Note("N-GAP", 1, 2, 3, "a gap – noted"),),
        source={"file": "raw/U1/accel_x.csv", "sha256": "ab" * 32, "rows": 120},
        filter={"name": "rc_low_pass", "delay_s": 0.1, "noise_gain": np.float64(0.3)},
        clock_shared=False,
    )
    bare = replace(
        make_recording(7, seed=2, name="static"), role="static", axis=None, table_angle=None, temperature=None
    )
    force_only = replace(make_recording(33, seed=3, name="b"), gyroscope=None, table_attitude=None, table_rate=None)
    return [noted, bare, force_only]


def test_every_recording_comes_back_whole(tmp_path: Path) -> None:
    save_recordings(tmp_path / "U1.parquet", unit())
    loaded = load_recordings(tmp_path / "U1.parquet")
    assert len(loaded) == 3
    for one, other in zip(unit(), loaded, strict=True):
        assert_same_bits(one, other)
        for name in ("name", "role", "axis", "source", "notes", "filter", "clock_shared"):
            assert getattr(one, name) == getattr(other, name), name


@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)
@given(
    values=hnp.arrays(np.float64, (4, 3), elements=st.floats(allow_nan=True, allow_infinity=True)),
    times=hnp.arrays(np.int64, 4),
)
def test_any_bits_come_back(tmp_path: Path, values: np.ndarray, times: np.ndarray) -> None:
    saved = Recording("a", "rests", None, times, accelerometer=values)
    save_recordings(tmp_path / "a.parquet", [saved])
    (loaded,) = load_recordings(tmp_path / "a.parquet")
    assert loaded.accelerometer is not None
    assert loaded.accelerometer.tobytes() == values.tobytes()
    assert loaded.time_ns.tobytes() == times.tobytes()


def test_recording_without_samples_comes_back(tmp_path: Path) -> None:
    empty = make_recording(5).select(slice(0, 0))
    save_recordings(tmp_path / "a.parquet", [empty, make_recording(5), empty, make_recording(6), empty])
    loaded = load_recordings(tmp_path / "a.parquet")
    assert [r.samples for r in loaded] == [0, 5, 0, 6, 0]
    assert [len(r.reading("gyroscope")) for r in loaded] == [0, 5, 0, 6, 0]


def counts(folder: Path) -> list[Recording]:
    ingest = profile("mpu6050_multi_position")
    ingest["csv"]["skip_lines"] = 0
    generator = np.random.default_rng(5)
    rows = generator.integers(-32768, 32767, (300, 6))
    rows[:, 2] = 16384
    text = "ax,ay,az,gx,gy,gz\n" + "".join(",".join(map(str, r)) + "\n" for r in rows.tolist())
    (folder / "accel_x.csv").write_text(text)
    return read_recordings(
        procedure("accel_x"), ingest_of(ingest), SENSOR.replaced(axis_map=["+x", "-z", "+y"]), folder
    )


def test_counts_come_back_to_the_last_bit(tmp_path: Path) -> None:
    (recording,) = counts(tmp_path)
    save_recordings(tmp_path / "a.parquet", [recording])
    assert_same_bits(load_recordings(tmp_path / "a.parquet")[0], recording)


def test_writing_again_gives_the_same_bytes(tmp_path: Path) -> None:
    save_recordings(tmp_path / "a.parquet", unit())
    save_recordings(tmp_path / "b.parquet", load_recordings(tmp_path / "a.parquet"))
    assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.parquet", "b.parquet"]


def test_the_recordings_of_a_unit_are_one_row_group(tmp_path: Path) -> None:
    save_recordings(tmp_path / "a.parquet", unit())
    metadata = parquet.read_metadata(tmp_path / "a.parquet")
    assert [metadata.row_group(i).num_rows for i in range(metadata.num_row_groups)] == [120 + 7 + 33]


@pytest.mark.parametrize("least", [1, 100, 127, 1000])
def test_long_recordings_have_row_groups_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, least: int
) -> None:
    monkeypatch.setattr(arrow, "MIN_ROW_GROUP", least)
    monkeypatch.setattr(arrow, "ROW_GROUP", 50)
    save_recordings(tmp_path / "a.parquet", unit())
    metadata = parquet.read_metadata(tmp_path / "a.parquet")
    rows = [metadata.row_group(i).num_rows for i in range(metadata.num_row_groups)]
    apart = [50, 50, 20, 7, 33] if least == 1 else [50, 50, 20, 40] if least == 100 else [50, 50, 27, 33]
    assert rows == ([50, 50, 50, 10] if least == 1000 else apart)
    for one, other in zip(unit(), load_recordings(tmp_path / "a.parquet"), strict=True):
        assert_same_bits(one, other)


def test_a_channel_is_decoded_when_it_is_used_first_and_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    decoded: list[list[str] | None] = []
    read = parquet.ParquetFile.read_row_groups

    def counted(self: Any, groups: list[int], columns: list[str] | None = None, **options: Any) -> Any:
        decoded.append(columns)
        return read(self, groups, columns, **options)

    monkeypatch.setattr(parquet.ParquetFile, "read_row_groups", counted)
    save_recordings(tmp_path / "a.parquet", unit())
    loaded = load_recordings(tmp_path / "a.parquet")
    assert [r.samples for r in loaded] == [120, 7, 33]
    assert decoded == [["time_ns"]]
    for recording in loaded * 2:
        assert recording.accelerometer is not None
    assert decoded[1:] == [["accel_x", "accel_y", "accel_z"]]


def rewrite(path: Path, change: dict[str, Any]) -> None:
    """Change the description in a file, as another version of the writer might."""
    table = parquet.read_table(path)
    text = json.dumps({**json.loads(table.schema.metadata[b"recordings"]), **change}).encode()
    parquet.write_table(table.replace_schema_metadata({b"recordings": text}), path)


def test_unknown_schema_version_is_refused(tmp_path: Path) -> None:
    save_recordings(tmp_path / "a.parquet", unit())
    rewrite(tmp_path / "a.parquet", {})
    assert len(load_recordings(tmp_path / "a.parquet")) == 3
    rewrite(tmp_path / "a.parquet", {"schema_version": 99})
    with pytest.raises(InputError, match="schema_version 99 is not known to this version"):
        load_recordings(tmp_path / "a.parquet")


def test_parquet_of_another_program_is_refused(tmp_path: Path) -> None:
    parquet.write_table(pa.table({"x": [1, 2]}), tmp_path / "a.parquet")
    with pytest.raises(InputError, match="holds no recordings"):
        load_recordings(tmp_path / "a.parquet")


def test_metadata_that_is_no_data_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="object cannot be stored"):
        save_recordings(tmp_path / "a.parquet", [replace(make_recording(3), source={"file": object()})])
    assert list(tmp_path.iterdir()) == []
