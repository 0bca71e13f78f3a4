"""Accelerometer and gyroscope at rates of their own: averages against exact integrals, the density of noise, gaps."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
import pytest
from unit_settings import ingest_of

from imu_logs.message_read import read_log
from imu_logs.profile import mcap_format
from pipeline.core.errors import IngestError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from imu_logs.log import Log

G = 9.80665
FORCE = {f"accel_{a}": {"field": f"v[{i}]", "unit": "m/s^2"} for i, a in enumerate("xyz")}
RATE = {f"gyro_{a}": {"field": f"v[{i}]", "unit": "deg/s"} for i, a in enumerate("xyz")}
TIME: dict[str, Any] = {"time": {"field": "t", "unit": "ns"}}


def times(rate_hz: float, seconds: float, start_ns: int) -> NDArray[np.int64]:
    return start_ns + np.rint(np.arange(int(seconds * rate_hz)) * (1e9 / rate_hz)).astype(np.int64)


def read(path: Path, force: tuple[Any, Any], rate: tuple[Any, Any]) -> Log:
    """Write two topics, each (times in ns, (n,) readings along all axes), and read them."""
    with h5py.File(path, "w") as file:
        for name, (t, v) in {"acc": force, "gyr": rate}.items():
            file[f"{name}/t"], file[f"{name}/v"] = t, np.repeat(v[:, None], 3, axis=1)
    topics = {"/acc": {**TIME, **FORCE}, "/gyr": {**TIME, **RATE}}
    return read_log(path, mcap_format(ingest_of({"mcap": {"topics": topics, "sensor_clock": "own"}})))


@pytest.mark.parametrize(("force_hz", "rate_hz"), [(100.0, 400.0), (250.0, 400.0), (63.0, 200.0), (400.0, 100.0)])
def test_the_faster_sensor_is_averaged_about_the_rows_of_the_slower(
    force_hz: float, rate_hz: float, tmp_path: Path
) -> None:
    t_force, t_rate = times(force_hz, 20.0, 5_000_000_000), times(rate_hz, 20.0, 5_001_234_567)

    def turn(t: Any) -> Any:
        return 30.0 * np.sin(2 * np.pi * 0.5 * t)

    def integral(t: Any) -> Any:
        return -30.0 * np.cos(2 * np.pi * 0.5 * t) / (2 * np.pi * 0.5)

    table = read(tmp_path / "log.h5", (t_force, G * turn(t_force / 1e9)), (t_rate, turn(t_rate / 1e9)))
    slow = t_force if force_hz < rate_hz else t_rate
    rows = np.searchsorted(slow, table.time_ns)
    assert table.time_ns.tolist() == slow[rows].tolist()
    assert len(rows) > len(slow) - 8
    edges = (slow[:-1] + slow[1:]) / 2e9
    mean = ((integral(edges[1:]) - integral(edges[:-1])) / np.diff(edges))[rows - 1]
    own, other = ("accel_y", "gyro_y") if force_hz < rate_hz else ("gyro_y", "accel_y")
    np.testing.assert_allclose(table.values[own], turn(slow[rows] / 1e9), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(table.values[other], mean, rtol=0, atol=7e-4)  # the trapezoids of a sine: h^2 w^2 / 12
    assert "N-AVERAGED" in {n.code for n in table.notes}


@pytest.mark.parametrize("force_hz", [50.0, 125.0, 180.0])
def test_the_density_of_white_noise_is_kept(force_hz: float, tmp_path: Path) -> None:
    """Of 200 s at 400 Hz: the variance of means of 1 s, times 1 s, is the density of the noise at 400 Hz."""
    generator, ratios = np.random.default_rng(7), []
    t_force, t_rate = times(force_hz, 200.0, 0), times(400.0, 200.0, 1_234_567)
    for _ in range(4):
        noise = generator.normal(size=len(t_rate))
        table = read(tmp_path / "log.h5", (t_force, np.ones(len(t_force))), (t_rate, noise))
        seconds = int(force_hz)
        means = table.values["gyro_x"][: len(table.time_ns) // seconds * seconds].reshape(-1, seconds).mean(axis=1)
        ratios.append(np.var(means, ddof=1) * 400.0)
    count = 4 * 199
    assert abs(np.mean(ratios) - 1.0) < 3.3 * np.sqrt(2.0 / count)  # 99.9 % of chi-squared


def test_rows_in_a_gap_of_the_faster_sensor_are_left_out(tmp_path: Path) -> None:
    t_force, t_rate = times(100.0, 10.0, 0), times(400.0, 10.0, 0)
    keep = (t_rate < 4_000_000_000) | (t_rate > 4_200_000_000)
    table = read(tmp_path / "log.h5", (t_force, np.ones(1000)), (t_rate[keep], np.ones(int(keep.sum()))))
    assert not ((table.time_ns > 4_005_000_000) & (table.time_ns < 4_195_000_000)).any()
    assert len(table.time_ns) == pytest.approx(1000 - 21 - 2, abs=3)
    np.testing.assert_allclose(table.values["gyro_x"], 1.0)


def test_topics_of_other_times_are_refused(tmp_path: Path) -> None:
    late = times(400.0, 10.0, 60_000_000_000)
    with pytest.raises(IngestError, match="do not cover those of the other sensor in time"):
        read(tmp_path / "log.h5", (times(100.0, 10.0, 0), np.ones(1000)), (late, np.ones(len(late))))
