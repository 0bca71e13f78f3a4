"""ROS 1 bags and SQLite files of ROS 2 bags, read by ``rosbags``; the messages are decoded as those of an MCAP file.

ROS 2 wrote no message definitions into a bag before version Iron; then those of ``rosbags`` for Humble are used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.io.message_logs import LogReader, rows_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pipeline.io.mcap_chunk import Rows

RUN_SIZE = 4096  # messages of one topic that are decoded together


class BagReader(LogReader):
    """One pass over a bag."""

    def messages(self) -> Iterator[Rows]:
        """Yield the messages of each connection in runs, in the order of the recorder's times."""
        if self.file.suffix.lower() == ".bag":
            from rosbags.rosbag1 import Reader  # noqa: PLC0415  (an extra)
        else:
            from rosbags.rosbag2 import Reader  # type: ignore[assignment]  # noqa: PLC0415  (an extra)
        with Reader(self.file) as bag:
            numbers = {c.id: self._channel(c) for c in bag.connections}
            waiting: dict[int, list[tuple[int, bytes]]] = {c.id: [] for c in bag.connections}
            for connection, time, data in bag.messages(bag.connections):
                run = waiting[connection.id]
                run.append((time, data))
                if len(run) == RUN_SIZE:
                    yield _joined(numbers[connection.id], run)
                    run.clear()
            for key, run in waiting.items():
                if run:
                    yield _joined(numbers[key], run)

    def _channel(self, connection: Any) -> int:  # noqa: ANN401  (rosbags.interfaces.Connection)
        ros1 = self.file.suffix.lower() == ".bag"
        text = connection.msgdef.data
        if not ros1 and connection.msgdef.format.name != "MSG":
            text = _humble(connection.msgtype)
        known = ("ros1msg" if ros1 else "ros2msg") if text else "no"
        schema = (connection.msgtype, known, text.encode())
        return self.define(connection.topic, "ros1" if ros1 else "cdr", schema, {})


def _humble(kind: str) -> str:
    """Return the definition of a message type of ROS 2 Humble; empty for another type, whose topic is then not read."""
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415  (an extra)

    store = get_typestore(Stores.ROS2_HUMBLE)
    return store.generate_msgdef(kind, ros_version=2)[0] if kind in store.fielddefs else ""


def _joined(channel: int, run: list[tuple[int, bytes]]) -> Rows:
    sizes = np.array([len(data) for _, data in run], np.int64)
    data = np.frombuffer(b"".join(data for _, data in run), np.uint8)
    return rows_of(channel, data, np.cumsum(sizes) - sizes, sizes, np.array([time for time, _ in run], np.int64))
