"""Samples that arrive in bursts: the sampling times are known here, and are found, or the log is refused."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from foreign_logs import Truth
from sample_logs import SENSOR, procedure
from scipy.io import savemat
from unit_settings import ingest_of

from imu_logs.clocks import find_bursts
from imu_logs.message_read import read_log
from imu_logs.profile import mcap_format
from pipeline.core.errors import IngestError, InputError
from pipeline.ingest.read import read_recordings

if TYPE_CHECKING:
    from pathlib import Path

ROWS = 6000
NOISE = {"accel_x": np.random.default_rng(1).standard_normal(ROWS)}


def read_out(sampled_ms: np.ndarray, period_ms: float, late_ms: float = 0.0) -> np.ndarray:
    """Return the times of a FIFO's readout, ns: every ``period_ms``, late by up to ``late_ms``."""
    readouts = period_ms * np.arange(1, int(sampled_ms[-1] / period_ms) + 3)
    readouts = readouts + late_ms * np.random.default_rng(3).random(len(readouts))
    return np.rint(1e6 * readouts[np.searchsorted(readouts, sampled_ms)]).astype(np.int64)


def rounded(sampled_ms: np.ndarray, resolution_ms: float) -> np.ndarray:
    return np.floor(sampled_ms / resolution_ms).astype(np.int64) * round(resolution_ms * 1e6)


@pytest.mark.parametrize("interval_ms", [10.0, 10.274, 1.0 / 1.125, 0.25])
@pytest.mark.parametrize("kind", ["fifo", "late", "s", "ms"])
def test_the_interval_is_found_within_its_uncertainty(interval_ms: float, kind: str) -> None:
    sampled = interval_ms * np.arange(ROWS) + 0.37 * interval_ms
    ways: dict[str, Any] = {
        "fifo": lambda: read_out(sampled, 25.0 * interval_ms),
        "late": lambda: read_out(sampled, 25.0 * interval_ms, 0.3 * interval_ms),
        "s": lambda: rounded(sampled, 100.0 * interval_ms + 0.001),
        "ms": lambda: rounded(sampled, 1.3 * interval_ms),
    }
    found = find_bursts(ways[kind](), NOISE)
    assert found is not None
    assert found.times is not None, found.lacks
    assert abs(found.interval_ns - 1e6 * interval_ms) < found.uncertainty_ns < 1e-3 * found.interval_ns
    late = found.times - 1e6 * sampled  # a delay that all rows share is no error
    assert np.ptp(late) < 2e6 * interval_ms
    assert np.ptp(np.diff(found.times)) <= 1


@pytest.mark.parametrize(
    ("times", "lacks"),
    [
        (lambda t: np.delete(read_out(t, 80.0), np.s_[2000:2100]), "as if rows were missing"),
        (lambda t: read_out(t, 80.0)[:70], "9 bursts are too few"),
        (lambda t: read_out(t, 80.0)[:800], "only to within 0.0019 of it, where 0.001 is needed"),
        (lambda t: read_out(t, 80.0) + 200_000 * (np.arange(ROWS) % 8), "a FIFO's readout, or a logger that pauses"),
    ],
)
def test_what_does_not_determine_a_clock_gets_none(times: Any, lacks: str) -> None:
    found = find_bursts(times(10.0 * np.arange(ROWS) + 3.0), NOISE)
    assert found is not None
    assert found.times is None
    assert lacks in found.lacks


def test_rows_of_two_sensors_and_repeated_rows_are_no_bursts_of_one_sensor() -> None:
    pairs = np.repeat(10_000_000 * np.arange(ROWS // 2), 2)
    two = {"accel_x": NOISE["accel_x"] + 0.2 * (np.arange(ROWS) % 2)}  # of the noise of a sample
    found = find_bursts(pairs, two)
    assert found is not None
    assert "two sensors" in found.lacks
    moving = {"accel_x": NOISE["accel_x"] + 300.0 * np.sin(0.01 * np.arange(ROWS))}
    of_one = find_bursts(pairs, moving)
    assert of_one is not None
    assert of_one.times is not None
    assert find_bursts(pairs, {"accel_x": np.repeat(NOISE["accel_x"][::2], 2)}) is None  # each row twice


@pytest.mark.parametrize(
    "times_ms",
    [
        10.0 * np.arange(ROWS),
        10.0 * np.arange(ROWS) + 3.0 * np.random.default_rng(2).random(ROWS),
        np.delete(10.0 * np.arange(ROWS + 500), np.s_[1000:1500]),
        10.0 * (np.arange(ROWS) % 500) + 20_000.0 * (np.arange(ROWS) // 500),  # a logger that pauses
    ],
)
def test_samples_that_arrive_one_by_one_are_no_bursts(times_ms: np.ndarray) -> None:
    assert find_bursts(np.rint(1e6 * times_ms).astype(np.int64), NOISE) is None


def test_arrays_in_bursts_are_read_by_the_regular_clock_or_counted_at_the_stated_rate(tmp_path: Path) -> None:
    truth, log = Truth(2400), tmp_path / "log.mat"
    sampled = truth.time_us / 1e3
    fields = {f"accel_{a}": {"field": f"acc[{i}]", "unit": "m/s^2"} for i, a in enumerate("xyz")}
    fields |= {f"gyro_{a}": {"field": f"gyr[{i}]", "unit": "rad/s"} for i, a in enumerate("xyz")}
    timed = {"time": {"field": "t", "unit": "s"}, **fields}
    times = read_out(sampled, 80.0)
    savemat(log, {"t": times / 1e9, "acc": truth.force, "gyr": truth.rate})
    (recording, *_) = read_recordings(procedure("log"), ingest_of({"mcap": {"topics": {"/": timed}}}), SENSOR, tmp_path)
    (note,) = (n for n in recording.notes if n.code == "N-BURSTS")
    assert note.count == len(times) - len(np.unique(times))
    assert f"bursts of 8, 80 ms apart: {note.count} of 2400 rows have no time of their own" in note.detail
    assert "an interval of 10 ms +- 0.0063 ms (95 %)" in note.detail
    assert np.diff(recording.time_ns) == pytest.approx(np.full(2399, 10_000_000), abs=6250)
    assert recording.source["bursts"]["uncertainty_ns"] == pytest.approx(6250, rel=1e-3)
    lost = np.delete(times, np.s_[800:960]) / 1e9
    savemat(log, {"t": lost, "acc": truth.force[160:], "gyr": truth.rate[160:]})
    with pytest.raises(
        InputError, match=r"as if rows were missing; .* count the rows: ingest\.mcap\.rate_hz=100,"
    ) as e:
        read_recordings(procedure("log"), ingest_of({"mcap": {"topics": {"/": timed}}}), SENSOR, tmp_path)
    assert e.value.code == "bursts"
    counted = mcap_format(ingest_of({"mcap": {"topics": {"/": timed}, "rate_hz": 100.0}}))
    assert np.diff(read_log(log, counted).time_ns).tolist() == [10_000_000] * 2239
    two = {"t": np.repeat(sampled[:1200], 2) / 1e3, "acc": truth.force + 0.1 * (np.arange(2400) % 2)[:, None]}
    savemat(log, {**two, "gyr": truth.rate})
    with pytest.raises(IngestError, match="rows differ as those of two sensors"):
        read_log(log, mcap_format(ingest_of({"mcap": {"topics": {"/": timed}}})))
