"""Latency and cost of live compensation, sample by sample: ``python benchmarks/live.py``.

Each call by itself in a loop: median, 99 % and 99.9 % quantile of its CPU time, and of its wall time, which on a busy
machine also holds the time of others. ``stream`` is ``CompensationStream.apply``; ``node`` is what the ROS 2 node does
with a message (``MessageCalibrator.imu`` with the copy of the message, without ROS's transport); C is the mean of 10^6
calls of ``imu_update``. The first 1,000 calls are left out.
"""

from __future__ import annotations

import argparse
import copy
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np
from apply import EFFECTS, in_c, write_calibration, write_header

from pipeline.app.field_logs.ros2_node import MessageCalibrator
from pipeline.physics.compensation import load

if TYPE_CHECKING:
    from collections.abc import Callable

    from pipeline.physics.compensation import CompensationStream

WARM_UP = 1000
INTERVAL_NS = 1_000_000  # 1 kHz


def message() -> SimpleNamespace:
    vector = SimpleNamespace(x=0.1, y=-0.2, z=9.7)
    stamp = SimpleNamespace(sec=0, nanosec=0)
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp, frame_id="imu"),
        orientation=SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0),
        linear_acceleration=vector,
        angular_velocity=copy.deepcopy(vector),
        **{f"{name}_covariance": np.zeros(9) for name in ("orientation", "linear_acceleration", "angular_velocity")},
    )


def latencies(call: Callable[[int], object], count: int) -> str:
    """Return the quantiles of a call's CPU time and wall time, us."""
    taken = np.zeros((count, 2))
    for i in range(count):
        start = time.thread_time_ns(), time.perf_counter_ns()
        call(i)
        taken[i] = time.thread_time_ns() - start[0], time.perf_counter_ns() - start[1]
    quantiles = np.quantile(taken[WARM_UP:] / 1e3, [0.5, 0.99, 0.999], axis=0).T
    return " | ".join(f"{q:.0f}" for q in quantiles.ravel())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=21_000)
    count = parser.parse_args().samples
    rng = np.random.default_rng(0)
    force, rate = rng.normal(0, 1, (count, 3)), rng.normal(0, 50, (count, 3))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        print("| effects | way | CPU us, median | 99 % | 99.9 % | wall us, median | 99 % | 99.9 % |")
        for title, effects in EFFECTS.items():
            file = folder / "U1.json"
            write_calibration(file, effects)
            stream, node, sent = load(file).stream(), MessageCalibrator(file, print), message()
            node.temperature(SimpleNamespace(header=message().header, temperature=30.0))

            def one(i: int, stream: CompensationStream = stream) -> None:
                stream.apply(force[i], rate[i], 30.0, 1e-3 * i)

            def received(i: int, node: MessageCalibrator = node, sent: SimpleNamespace = sent) -> None:
                sent.header.stamp.sec, sent.header.stamp.nanosec = divmod(i * INTERVAL_NS, 10**9)
                node.imu(sent)

            print(f"| {title} | stream | {latencies(one, count)} |")
            print(f"| {title} | node | {latencies(received, count)} |")
            write_header(file)
            print(f"| {title} | C | double {in_c(folder, 'double'):.3f}, float {in_c(folder, 'float'):.3f} us mean |")


if __name__ == "__main__":
    main()
