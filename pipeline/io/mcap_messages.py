"""All messages of an MCAP file, each by itself: for looking at files, and as a proof of the walk over them."""

from __future__ import annotations

from io import BytesIO
from typing import TYPE_CHECKING

from mcap.records import Message

from pipeline.io.mcap_walk import Walk

if TYPE_CHECKING:
    from pipeline.io.mcap_container import Container


def read_container(data: bytes, path: str, *, allow_truncated: bool = False) -> Container:
    """Return all that an MCAP file holds, each message by itself.

    Parameters
    ----------
    data : bytes
        The whole file.
    path : str
        For messages.
    allow_truncated : bool
        Whether the complete chunks of a file without end are read.

    Raises
    ------
    IngestError
        If a byte is damaged or missing; never anything else.
    """
    walk = Walk(BytesIO(data), path, allow_truncated=allow_truncated)
    for rows in walk.rows():
        messages = walk.found.messages.setdefault(rows.channel, [])
        columns = [rows.heads[n].tolist() for n in ("log_time", "publish_time", "sequence")]
        for log_time, publish_time, sequence, payload in zip(*columns, rows.payloads(), strict=True):
            messages.append(
                Message(
                    channel_id=rows.channel,
                    log_time=log_time,
                    data=payload,
                    publish_time=publish_time,
                    sequence=sequence,
                )
            )
    return walk.found
