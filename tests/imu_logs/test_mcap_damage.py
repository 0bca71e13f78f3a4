"""Damaged and cut logs: refused, or read to the same last bit; never anything else."""

from __future__ import annotations

from dataclasses import replace
from io import BytesIO
from typing import TYPE_CHECKING

import pytest
from damaged_logs import RECORDERS, Tally, cuts, flips, log_of, messages_of, read_messages, same_bits, table_of
from mcap.writer import Writer

from pipeline.core.errors import IngestError

if TYPE_CHECKING:
    from pathlib import Path

FEW = pytest.param(60, 20, id="few")
MANY = pytest.param(2000, 200, id="many", marks=pytest.mark.fuzz)


@pytest.mark.parametrize(("flipped", "cut"), [FEW, MANY])
@pytest.mark.parametrize("recorder", RECORDERS)
def test_damage_never_changes_a_value_in_silence(tmp_path: Path, recorder: str, flipped: int, cut: int) -> None:
    whole = log_of(recorder, tmp_path)
    truth, messages = table_of(whole), messages_of(whole)
    bits, ends = Tally(), Tally()
    for damaged in flips(whole, flipped, seed=11):
        bits.take(damaged, truth, messages)
    for damaged in cuts(whole, cut):
        ends.take(damaged, truth, messages)
    print(recorder, len(whole), "bytes; flips:", dict(bits.beside), "cuts:", dict(ends.beside))  # noqa: T201
    assert bits.strange + ends.strange == []
    assert bits.ours["wrong"] == ends.ours["wrong"] == 0
    assert bits.ours["refused"] > flipped / 2
    assert ends.ours["refused"] == ends.ours.total() > cut / 2


@pytest.mark.parametrize("recorder", ["zstd, data checksum", "lz4", "uncompressed"])
def test_cut_log_gives_its_complete_chunks_on_request(tmp_path: Path, recorder: str) -> None:
    whole = log_of(recorder, tmp_path, samples=20)
    truth = table_of(whole)
    kept = set()
    for damaged in cuts(whole, 40):
        try:
            table = table_of(damaged, allow_truncated=True)
        except IngestError as error:
            assert error.code in {"truncated", "not_mcap"}  # noqa: PT017
            continue
        rows = len(table.time_ns)
        kept.add(rows)
        assert table.notes[0].code == "N-TRUNCATED"
        assert "messages in" in table.notes[0].detail
        beginning = {n: truth.values[n][:rows] for n in table.values}  # the first chunk lacks some topics
        assert same_bits(table, replace(truth, time_ns=truth.time_ns[:rows], values=beginning))
    assert len(kept) > 5
    assert max(kept) == len(truth.time_ns)  # of a file that has lost nothing but its end


@pytest.mark.parametrize("of_channel", [False, True])
@pytest.mark.parametrize("change", [-1, 1])
def test_a_summary_that_counts_other_messages_is_refused(change: int, *, of_channel: bool) -> None:
    stream = BytesIO()
    writer = Writer(stream)
    writer.start()
    channel = writer.register_channel("/imu", "json", 0)
    for n in range(5):
        writer.add_message(channel, n, b"{}", n)
    counts = writer._Writer__statistics  # type: ignore[attr-defined]
    if of_channel:
        counts.channel_message_counts[channel] += change
    else:
        counts.message_count += change
        counts.channel_message_counts.clear()
    writer.finish()
    with pytest.raises(IngestError, match=rf"the summary says {5 if of_channel else 5 + change} messages"):
        read_messages(stream.getvalue())


def test_a_summary_with_a_wrong_checksum_is_refused(tmp_path: Path) -> None:
    damaged = bytearray(log_of("zstd", tmp_path))
    damaged[-12] ^= 1  # the last field of the footer, before eight magic bytes
    with pytest.raises(IngestError, match="the checksum of the summary is wrong"):
        read_messages(bytes(damaged))


def test_cut_log_without_chunks_is_refused_even_on_request(tmp_path: Path) -> None:
    whole = log_of("unchunked, data checksum", tmp_path)
    with pytest.raises(IngestError, match="not every message lies in a chunk with a checksum") as caught:
        table_of(whole[: len(whole) // 2], allow_truncated=True)
    assert caught.value.code == "truncated"
