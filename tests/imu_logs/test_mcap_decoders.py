"""Columns of ROS messages are those of two independent decoders, to the last bit, whatever the definition."""

from __future__ import annotations

from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap_ros1.decoder import DecoderFactory as Ros1Factory
from mcap_ros2.decoder import DecoderFactory as Ros2Factory
from ros_messages import FIRST_NS, INNER, NAME, NUMBERS, STEP_NS, RandomField, RandomLog
from rosbags.typesys import Stores, get_typestore
from unit_settings import ingest_of

from imu_logs.message_read import read_log
from imu_logs.profile import mcap_format

if TYPE_CHECKING:
    from pathlib import Path

    from imu_logs.log import Log

AXES = ("accel_x", "accel_y", "accel_z")
MAP = {
    "time": {"field": "header.stamp"},
    **{channel: {"field": f"wanted{i}", "unit": "g"} for i, channel in enumerate(AXES)},
}
INNER_NAME = INNER.replace("/msg/", "/")
counts = st.sampled_from([0, 0, 1, 3, -1])
plain = st.builds(RandomField, st.sampled_from([*NUMBERS, "string"]), counts)
any_field = st.one_of(plain, st.builds(RandomField, st.just(INNER_NAME), counts))
logs = st.builds(
    RandomLog,
    before=st.lists(any_field, max_size=4).map(tuple),
    between=st.lists(any_field, max_size=3).map(tuple),
    inner=st.lists(plain, min_size=1, max_size=3).map(tuple),
    wanted=st.lists(st.sampled_from(NUMBERS), min_size=3, max_size=3).map(tuple),
    alike=st.booleans(),
    messages=st.integers(2, 9),
    seed=st.integers(0, 2**20),
    chunk_size=st.sampled_from([1, 300, 1 << 20]),
    compression=st.sampled_from(list(CompressionType)),
    little_endian=st.booleans(),
)


def read(path: Path, **mcap: Any) -> Log:
    return read_log(path, mcap_format(ingest_of({"mcap": mcap})))


def official(path: Path, factory: Any) -> list[Any]:
    reader = make_reader(BytesIO(path.read_bytes()), decoder_factories=[factory])
    return [m.decoded_message for m in reader.iter_decoded_messages(topics=["/sample"])]


def compare(table: Log, messages: list[Any], count: int) -> None:
    assert table.time_ns.tolist() == [FIRST_NS + i * STEP_NS for i in range(count)]
    for index, channel in enumerate(AXES):
        expected = np.array([float(getattr(m, f"wanted{index}")) for m in messages])
        assert table.values[channel].tobytes() == expected.tobytes()


@pytest.mark.parametrize("number", [pytest.param(25, id="few"), pytest.param(2000, id="many", marks=pytest.mark.fuzz)])
def test_columns_are_those_of_two_decoders(tmp_path: Path, number: int) -> None:
    path = tmp_path / "log.mcap"
    seen = set()

    @settings(max_examples=number, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
    @given(logs)
    def check(log: RandomLog) -> None:
        log.write(path)
        table = read(path, topics={"/sample": MAP})
        compare(table, official(path, Ros2Factory()), log.messages)
        store = get_typestore(Stores.ROS2_HUMBLE)
        log.definition(store=store)
        compare(table, [store.deserialize_cdr(data, NAME) for data in log.encoded()[1]], log.messages)
        seen.update(n.code for n in table.notes)

    check()
    assert "N-FALLBACK" in seen


@pytest.mark.parametrize("number", [pytest.param(6, id="few"), pytest.param(200, id="many", marks=pytest.mark.fuzz)])
def test_columns_of_ros_1_are_those_of_two_decoders(tmp_path: Path, number: int) -> None:
    path = tmp_path / "log.mcap"

    @settings(max_examples=number, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
    @given(logs)
    def check(log: RandomLog) -> None:
        ros1 = RandomLog(**{**vars(log), "ros": 1})
        ros1.write(path)
        table = read(path, topics={"/sample": MAP})
        compare(table, official(path, Ros1Factory()), log.messages)
        store = get_typestore(Stores.ROS1_NOETIC)
        ros1.definition(store=store)
        compare(table, [store.deserialize_ros1(data, NAME) for data in ros1.encoded()[1]], log.messages)

    check()
