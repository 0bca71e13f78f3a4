"""How fast a canonical CSV is read, beside a bare typed pyarrow read: ``python benchmarks/csv_read.py``.

Each reads the same file in a process of its own; CPU seconds are of user and system, of all threads, without imports.
The bare read gives typed columns and no more: no hash, no checks of lines, numbers or times, no units. ``hash`` is the
SHA-256 alone that our read holds: half of a bare read on processors without instructions for it. ``--marks`` adds the
search for gaps, clipped and stuck readings and implausible units that a recording goes through.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import json
import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pyarrow as pa
from measuring import in_own_process
from pyarrow import csv

NAMES = (
    "time_s", "accel_x_g", "accel_y_g", "accel_z_g", "gyro_x_dps", "gyro_y_dps", "gyro_z_dps", "temperature_degc",
    "table_angle_deg",
)  # fmt: skip
DECIMALS = (3, 6, 6, 6, 5, 5, 5, 3, 5)
PROFILE = Path(__file__).parents[1] / "configs" / "ingest" / "canonical_csv.yaml"
BLOCK_BYTES = 1 << 24


def write_log(path: Path, rows: int) -> None:
    """Write a log of a turning sensor with noise, 1 kHz."""
    generator = np.random.default_rng(1)
    with path.open("wb") as stream:
        stream.write((",".join(NAMES) + "\n").encode())
        for start in range(0, rows, 500_000):
            count = min(500_000, rows - start)
            second = 1e-3 * np.arange(start, start + count)
            angle = 10.0 * second
            force = [0.01 * second**0, np.sin(np.radians(angle)), np.cos(np.radians(angle))]
            columns = [second, *(f + 1e-3 * generator.standard_normal(count) for f in force)]
            columns += [w + 0.05 * generator.standard_normal(count) for w in (10.0, 0.0, 0.0)]
            columns += [25.0 + 1e-4 * second, angle]
            whole = (np.rint(c * 10.0**d).astype(np.int64) for c, d in zip(columns, DECIMALS, strict=True))
            table = pa.table({n: pa.array(w / 10.0**d) for n, w, d in zip(NAMES, whole, DECIMALS, strict=True)})
            csv.write_csv(table, stream, csv.WriteOptions(include_header=False))


def read_ours(path: Path) -> tuple[int, list[float]]:
    import imu_logs  # noqa: PLC0415  (a process loads its own reader only)

    log = imu_logs.read(path, PROFILE)
    return len(log.time_ns), [float(log.time_ns[-1]) / 1e9, *(float(v[-1]) for v in log.values.values())]


def read_marked(path: Path) -> tuple[int, list[float]]:
    from imu_logs.profile import Checks, load_profile  # noqa: PLC0415
    from pipeline.core.settings import Ingest, RecordingFile  # noqa: PLC0415
    from pipeline.ingest.read import read_table, to_recording  # noqa: PLC0415
    from pipeline.simulation.description import shipped_settings  # noqa: PLC0415

    generic = shipped_settings(sensor="generic").sensor
    scales = {"accelerometer": 16.0, "gyroscope": 2000.0}
    sensor = generic.replaced(**{s: generic.of(s).replaced(full_scale=scale) for s, scale in scales.items()})
    entry = RecordingFile(file="log", role="rests", axis=None, optional=False)
    ingest = Ingest.model_validate(load_profile(PROFILE).model_dump())
    recording = to_recording("log", entry, read_table([path], ingest), sensor, Checks())
    assert recording.accelerometer is not None  # noqa: S101
    return recording.samples, []


def read_bare(path: Path) -> tuple[int, list[float]]:
    table = csv.read_csv(
        path,
        read_options=csv.ReadOptions(block_size=BLOCK_BYTES),
        convert_options=csv.ConvertOptions(column_types=dict.fromkeys(NAMES, pa.float64()), null_values=[]),
    )
    return table.num_rows, [float(table.column(n)[-1].as_py()) for n in NAMES]


def read_hash(path: Path) -> tuple[int, list[float]]:
    with path.open("rb") as stream:
        hashlib.file_digest(stream, "sha256")
    return 0, []


READERS = {"bare": read_bare, "ours": read_ours, "hash": read_hash, "marked": read_marked}


def read_once(reader: str, path: Path) -> None:
    if reader != "bare":
        importlib.import_module("pipeline.ingest.read")
        for module in ("imu_logs.text_read", "imu_logs.yaml_file"):
            importlib.import_module(module)
    start = time.process_time()
    count, last = READERS[reader](path)
    cpu = time.process_time() - start
    rss = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({"rows": count, "cpu_s": cpu, "peak_rss_mb": rss, "last": last}))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=5_000_000)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--marks", action="store_true", help="also with the search for gaps, clipped, stuck readings")
    parser.add_argument("--read", nargs=2, metavar=("READER", "FILE"))
    options = parser.parse_args()
    if options.read:
        read_once(options.read[0], Path(options.read[1]))
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.csv"
        write_log(path, options.rows)
        print(f"{options.rows} x {len(NAMES)}, {path.stat().st_size / 1e6:.1f} MB")
        ratios: dict[str, list[float]] = {}
        for _ in range(options.repeat):
            readers = ("bare", "ours", "hash", *(["marked"] if options.marks else []))
            found = {r: in_own_process(__file__, "--read", r, str(path)) for r in readers}
            if not np.allclose(found["bare"]["last"], found["ours"]["last"], rtol=1e-13):
                sys.exit("the readers differ")
            for name, figures in found.items():
                figures.pop("last")
                ratios.setdefault(name, []).append(figures["cpu_s"] / found["bare"]["cpu_s"])
                print(f"{name:7} {', '.join(f'{k} {v:,.4g}' for k, v in figures.items())}, x {ratios[name][-1]:.2f}")
        print(", ".join(f"{name} x {np.median(r):.2f}" for name, r in ratios.items() if name != "bare") + " (median)")


if __name__ == "__main__":
    main()
