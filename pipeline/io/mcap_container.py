"""What an MCAP file holds, and the proof that it is all there.

A recorder that closes its file writes a summary: how many messages each channel has, and where each chunk lies. What
was met between the file's two ends is compared with it, so that a lost chunk does not pass for a shorter recording. A
checksum of 0 means that the recorder gave none: then ``verified`` is False, and nothing else follows from it.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mcap.records import Attachment, Channel, Header, Message, Metadata, Schema, Statistics


@dataclass
class Container:
    """What an MCAP file holds.

    Attributes
    ----------
    header : Header or None
    schemas : dict of int to Schema
    channels : dict of int to Channel
    messages : dict of int to list of Message
        Channel to its messages, in the order of the file; filled by ``read_container`` only.
    attachments : list of Attachment
    metadata : list of Metadata
    counts : Counter
        Channel to number of messages.
    chunks : list of int
        Byte at which each chunk begins.
    statistics : Statistics or None
        What the file's summary says.
    chunk_index : list of int
        Bytes at which chunks begin, by the file's summary.
    verified : bool
        Whether every message lies under a checksum; a file may be written without.
    truncated : str
        What is missing at the end of a file whose complete chunks are read on request; else empty.
    sha256 : str
        Of the file.
    """

    header: Header | None = None
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    messages: dict[int, list[Message]] = field(default_factory=dict)
    attachments: list[Attachment] = field(default_factory=list)
    metadata: list[Metadata] = field(default_factory=list)
    counts: Counter[int] = field(default_factory=Counter)
    chunks: list[int] = field(default_factory=list)
    statistics: Statistics | None = None
    chunk_index: list[int] = field(default_factory=list)
    verified: bool = True
    truncated: str = ""
    sha256: str = ""

    @property
    def count(self) -> int:
        """Number of messages."""
        return self.counts.total()

    def define_schema(self, schema: Schema) -> None:
        """Take in a message definition; a second one of the same number has to be the same."""
        if self.schemas.setdefault(schema.id, schema) != schema:
            raise ValueError(f"Schema {schema.id} is defined twice, differently")

    def define_channel(self, channel: Channel) -> None:
        """Take in a channel; a second one of the same number has to be the same."""
        if self.channels.setdefault(channel.id, channel) != channel:
            raise ValueError(f"Channel {channel.id} is defined twice, differently")

    def check_complete(self) -> None:
        """Compare what was met with what the summary says.

        Raises
        ------
        ValueError
            If a part is missing, or messages belong to no channel.
        """
        nameless = sorted(set(self.counts) - set(self.channels))
        if nameless:
            raise ValueError(f"messages of channel {nameless[0]}, which is not defined")
        lost = set(self.chunk_index) - set(self.chunks)
        if lost or (self.chunk_index and not self.truncated and sorted(self.chunk_index) != self.chunks):
            raise ValueError(
                f"the summary lists {len(self.chunk_index)} chunks, and the file holds {len(self.chunks)} where it "
                "may look for them: a part is missing"
            )
        said = self.statistics
        if said is None:
            return
        by_channel = Counter(said.channel_message_counts)
        if said.message_count != self.count or (by_channel and by_channel != self.counts):
            raise ValueError(
                f"the summary says {said.message_count} messages, the file holds {self.count}: a part is missing"
                if said.message_count != self.count
                else f"the summary says {said.message_count} messages, which the file does not hold by channel"
            )
        met = (len(self.chunks), len(self.attachments), len(self.metadata))
        if (said.chunk_count, said.attachment_count, said.metadata_count) != met:
            raise ValueError(
                f"the summary says {said.chunk_count} chunks, {said.attachment_count} attachments and "
                f"{said.metadata_count} metadata records, the file holds {met[0]}, {met[1]} and {met[2]}"
            )
