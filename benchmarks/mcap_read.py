"""How fast a log of sensor_msgs/Imu is read, beside the official decoder: ``python benchmarks/mcap_read.py``.

Both read the same zstd file in a process of their own and build the same columns; CPU seconds are of user and system,
without imports. The official decoder reads the first part of the file only, because it takes minutes for the whole.
"""

from __future__ import annotations

import argparse
import importlib
import json
import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType, Writer
from measuring import in_own_process

from imu_logs.mcap_write import DEFINITIONS, IMU, as_messages

CHUNK = 1 << 20  # bytes
LSB = 1 / 16384
COLUMNS = 6


def write_log(path: Path, messages: int, compression: CompressionType) -> None:
    """Write Imu messages with quantised noise, frame imu_link, 324 bytes each."""
    generator = np.random.default_rng(1)
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=CHUNK, compression=compression)
        writer.start(profile="ros2")
        channel = writer.register_channel(
            "/imu/data", "cdr", writer.register_schema(IMU, "ros2msg", DEFINITIONS[IMU].encode())
        )
        for start in range(0, messages, 100_000):
            count = min(100_000, messages - start)
            stamps = 1_700_000_000_000_000_000 + 1_000_000 * np.arange(start, start + count)
            numbers = np.zeros((count, 37))
            for vector in (slice(13, 16), slice(25, 28)):  # angular velocity and acceleration
                numbers[:, vector] = np.rint(generator.normal(0, 100, (count, 3))) * LSB
            for stamp, row in zip(stamps.tolist(), as_messages(stamps, "imu_link", numbers), strict=True):
                writer.add_message(channel, stamp, row.tobytes(), stamp)
        writer.finish()


def read_ours(path: Path, _messages: int) -> tuple[int, list[float]]:
    from imu_logs.message_read import read_log  # noqa: PLC0415  (a process loads its own reader only)
    from imu_logs.profile import McapFormat  # noqa: PLC0415

    table = read_log(path, McapFormat())
    return len(table.time_ns), [float(v[:1000].sum()) for v in table.values.values()]


def read_official(path: Path, messages: int) -> tuple[int, list[float]]:
    from mcap_ros2.reader import read_ros2_messages  # noqa: PLC0415

    columns: list[list[float]] = [[] for _ in range(COLUMNS + 1)]
    for index, decoded in enumerate(read_ros2_messages(str(path))):
        if index == messages:
            break
        message = decoded.ros_msg
        stamp, force, rate = message.header.stamp, message.linear_acceleration, message.angular_velocity
        row = (stamp.sec * 10**9 + stamp.nanosec, force.x, force.y, force.z, rate.x, rate.y, rate.z)
        for column, value in zip(columns, row, strict=True):
            column.append(value)
    force_columns = [np.array(c) / 9.80665 for c in columns[1:4]]
    values = [*force_columns, *(np.array(c) * (180 / np.pi) for c in columns[4:])]
    return len(columns[0]), [float(v[:1000].sum()) for v in values]


def read_once(reader: str, path: Path, messages: int) -> None:
    read = {"ours": read_ours, "official": read_official}[reader]
    importlib.import_module({"ours": "imu_logs.message_read", "official": "mcap_ros2.reader"}[reader])
    start = time.process_time()
    count, sums = read(path, messages)
    cpu = time.process_time() - start
    rss = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({"messages": count, "cpu_s": cpu, "per_cpu_s": count / cpu, "peak_rss_mb": rss, "sums": sums}))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--messages", type=int, default=1_000_000)
    parser.add_argument("--official-messages", type=int, default=100_000)
    parser.add_argument("--compression", choices=["zstd", "lz4", "none"], default="zstd")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--read", nargs=2, metavar=("READER", "FILE"))
    options = parser.parse_args()
    if options.read:
        read_once(options.read[0], Path(options.read[1]), options.messages)
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "imu.mcap"
        write_log(path, options.messages, CompressionType[options.compression.upper()])
        print(f"{options.messages} sensor_msgs/Imu, {options.compression}, {path.stat().st_size / 1e6:.1f} MB")
        ratios = []
        for _ in range(options.repeat):
            counts = {"ours": options.messages, "official": options.official_messages}
            ours, official = (
                in_own_process(__file__, "--read", reader, str(path), "--messages", str(count))
                for reader, count in counts.items()
            )
            if not np.allclose(ours.pop("sums"), official.pop("sums"), rtol=1e-13):
                sys.exit("the readers differ")
            ratios.append(ours["per_cpu_s"] / official["per_cpu_s"])
            for name, found in (("ours", ours), ("mcap-ros2-support", official)):
                figures = ", ".join(f"{key} {value:,.4g}" for key, value in found.items())
                print(f"{name:18} {figures}")
            print(f"ratio              {ratios[-1]:.1f}")
        print(f"median ratio       {np.median(ratios):.1f}")


if __name__ == "__main__":
    main()
