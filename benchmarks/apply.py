"""What compensating a log costs, beside reading and writing it unchanged: ``python benchmarks/apply.py``.

Both run in a process of their own, one after the other, on the same log of an hour at 1 kHz (3.6 million samples);
CPU seconds are of user and system, without imports. Unchanged means, for CSV, that pyarrow reads the numbers and writes
them, block by block; for MCAP, that every chunk is unpacked, its checksum compared, packed again at the level of the
recorder (zstd, 3) and written. ``--official`` adds the format's own library, on the first part of the log.

``--sample`` measures a sample by itself: ``CompensationStream.apply`` and the C header.
"""

from __future__ import annotations

import argparse
import importlib
import json
import subprocess
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from measuring import in_own_process

if TYPE_CHECKING:
    from collections.abc import Callable

from pipeline.core.records import Coefficient, FittedEffect, SensorCalibration

EFFECTS = {
    "linear": {},
    "temperature": {"gyroscope": {"bias_temperature": 0.1, "g_sensitivity": 0.05}},
    "fixed point": {
        "accelerometer": {"scale_factor_asymmetry": 1e-3, "scale_factor_temperature": 1e-4},
        "gyroscope": {"bias_temperature": 0.1, "g_sensitivity": 0.05},
    },
}
COLUMNS = ["time_s", *(f"accel_{a}_g" for a in "xyz"), *(f"gyro_{a}_dps" for a in "xyz"), "temperature_degc"]


def write_calibration(path: Path, effects: dict[str, dict[str, float]]) -> None:
    from pipeline.physics.effects import effect  # noqa: PLC0415

    generator = np.random.default_rng(2)
    document: dict[str, Any] = {"unit": "U1", "sensor": "mpu6050", "status": "ok", "schema_version": 1, "error": None}
    for sensor in ("accelerometer", "gyroscope"):
        chosen = []
        for name, size in effects.get(sensor, {}).items():
            parameters = {
                p.name: Coefficient(size * generator.uniform(-1, 1), p.unit, 0.0)
                for p in effect(name).parameters(sensor)
            }
            chosen.append(FittedEffect(name, parameters))
        matrix = np.eye(3) + generator.uniform(-0.03, 0.03, (3, 3))
        document[sensor] = SensorCalibration(
            sensor, generator.uniform(-0.1, 0.1, 3), matrix, effects=tuple(chosen)
        ).to_json()
    path.write_text(json.dumps(document))


def write_csv(path: Path, samples: int) -> None:
    import pyarrow as pa  # noqa: PLC0415
    from pyarrow import csv  # noqa: PLC0415

    generator = np.random.default_rng(0)
    with path.open("wb") as stream:
        stream.write((",".join(COLUMNS) + "\n").encode())
        for start in range(0, samples, 100_000):
            n = min(100_000, samples - start)
            index = np.arange(start, start + n)
            force = np.round(generator.normal(0, 1, (n, 3)), 6)
            rate = np.round(generator.normal(0, 50, (n, 3)), 5)
            columns = [np.round(1e-3 * index, 3), *force.T, *rate.T, np.round(25 + 1e-6 * index, 3)]
            table = pa.table(dict(zip(COLUMNS, columns, strict=True)))
            csv.write_csv(table, stream, csv.WriteOptions(include_header=False))


def write_mcap(path: Path, samples: int) -> None:
    """Write what a recorder writes: quantised readings in zstd chunks, and a temperature ten times a second."""
    from mcap.writer import Writer  # noqa: PLC0415

    from imu_logs.mcap_write import DEFINITIONS, IMU, TEMPERATURE, as_messages, imu_table  # noqa: PLC0415

    generator = np.random.default_rng(1)
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=1 << 20)
        writer.start(profile="ros2")
        imu, temperature = (
            writer.register_channel(topic, "cdr", writer.register_schema(kind, "ros2msg", DEFINITIONS[kind].encode()))
            for topic, kind in (("/imu/data", IMU), ("/imu/temperature", TEMPERATURE))
        )
        for start in range(0, samples, 100_000):
            n = min(100_000, samples - start)
            stamps = 1_700_000_000_000_000_000 + 1_000_000 * np.arange(start, start + n)
            force = np.rint(generator.normal(0, 5000, (n, 3))) / 16384
            rate = np.rint(generator.normal(0, 5000, (n, 3))) / 131
            warmth = as_messages(stamps, "imu", np.column_stack([25 + 1e-9 * (stamps - stamps[0]), np.zeros(n)]))
            messages = imu_table(stamps, {"accelerometer": force, "gyroscope": rate})
            for i, (stamp, row) in enumerate(zip(stamps.tolist(), messages, strict=True)):
                writer.add_message(imu, stamp, row.tobytes(), stamp)
                if i % 100 == 0:
                    writer.add_message(temperature, stamp, warmth[i].tobytes(), stamp)
        writer.finish()


def csv_unchanged(log: Path, out: Path, _calibration: Path) -> int:
    from pyarrow import csv  # noqa: PLC0415

    rows = 0
    options = csv.ReadOptions(use_threads=False, block_size=1 << 21)
    with csv.open_csv(log, options) as reader, csv.CSVWriter(out, reader.schema) as writer:
        for batch in reader:
            writer.write_batch(batch)
            rows += batch.num_rows
    return rows


def mcap_unchanged(log: Path, out: Path, _calibration: Path) -> int:
    import zstandard  # noqa: PLC0415
    from mcap.opcode import Opcode  # noqa: PLC0415
    from mcap.records import Chunk  # noqa: PLC0415

    from imu_logs.mcap_file import RECORD_HEAD, McapReader, bytes_of, parsed  # noqa: PLC0415  (only where it is needed)
    from imu_logs.mcap_write import McapCopy  # noqa: PLC0415

    with log.open("rb") as stream, out.open("wb") as target:
        reader, copy = McapReader(stream, str(log)), McapCopy(target)
        for run in reader.runs():
            for i, (head, content) in enumerate(run.records):
                if head[0] == Opcode.CHUNK:
                    chunk = parsed(Chunk, content)
                    chunk.data = zstandard.compress(run.data)
                    packed = bytes_of([chunk])
                    run.records[i] = (packed[:RECORD_HEAD], packed[RECORD_HEAD:])
            copy.copy(run)
        copy.finish(list(reader.schemas.values()), list(reader.channels.values()))
    return reader.count


def applied(log: Path, out: Path, calibration: Path) -> int:
    from pipeline.app.field_logs.stream import compensate_log  # noqa: PLC0415
    from pipeline.physics.compensation import load  # noqa: PLC0415

    return compensate_log(load(calibration), log, out).samples


def mcap_official(log: Path, out: Path, _calibration: Path, most: int = 200_000) -> int:
    from mcap.reader import make_reader  # noqa: PLC0415
    from mcap.writer import Writer  # noqa: PLC0415

    channels: dict[int, int] = {}
    with log.open("rb") as stream, out.open("wb") as target:
        writer = Writer(target)
        writer.start()
        for count, (schema, channel, message) in enumerate(make_reader(stream).iter_messages(log_time_order=False)):
            if count == most:
                break
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data) if schema else 0
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, number)
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    return most


WAYS: dict[str, Callable[[Path, Path, Path], int]] = {
    "csv unchanged": csv_unchanged,
    "csv applied": applied,
    "mcap unchanged": mcap_unchanged,
    "mcap applied": applied,
    "mcap official": mcap_official,
}
MODULES = {
    "csv": ["pyarrow.csv", "pyarrow.compute", "pipeline.app.field_logs.stream", "pipeline.physics.compensation"],
    "mcap": [
        "zstandard",
        "mcap.writer",
        "mcap.reader",
        "pipeline.app.field_logs.mcap_log",
        "pipeline.physics.compensation",
    ],
}


def run_once(way: str, log: str, out: str, calibration: str) -> None:
    for module in MODULES[way.split(maxsplit=1)[0]]:
        importlib.import_module(module)
    start = time.process_time()
    count = WAYS[way](Path(log), Path(out), Path(calibration))
    cpu = time.process_time() - start
    status = Path("/proc/self/status").read_text()  # ru_maxrss would count what the parent had
    peak = int(status.partition("VmHWM:")[2].split()[0]) / 1024
    print(json.dumps({"samples": count, "cpu_s": cpu, "us_a_sample": 1e6 * cpu / count, "peak_mb": peak}))


def measure(way: str, log: Path, out: Path, calibration: Path) -> dict[str, float]:
    found = in_own_process(__file__, "--run", way, str(log), str(out), str(calibration))
    print(f"{way:16}", ", ".join(f"{key} {value:,.4g}" for key, value in found.items()), flush=True)
    return found


C_LOOP = """
#include <stdio.h>
#include <time.h>
#include "calibration.h"
int main(void) {
    imu_state state = {0};
    imu_real f[3], w[3], rf[3] = {0.1, 0.2, 1.0}, rw[3] = {10, 20, 30}, sum = 0;
    const clock_t start = clock();
    int i;
    for (i = 0; i < 1000000; ++i) {
        rw[0] = i % 100;
        imu_update(&state, rf, rw, 30, 1e-3 * i, f, w);
        sum += f[0] + w[0];
    }
    printf("%g %g\\n", (double)(clock() - start) / CLOCKS_PER_SEC, (double)sum);
    return 0;
}
"""


def write_header(calibration: Path) -> None:
    """Write the C header of a calibration beside it."""
    from pipeline.output.exports import ExportedUnit, export  # noqa: PLC0415

    files = export("calibration.h", ExportedUnit(json.loads(calibration.read_text()), {}))
    calibration.with_name("calibration.h").write_text(files["calibration.h"])


def in_c(folder: Path, real: str) -> float:
    """Return the CPU time of a sample in C, us."""
    (folder / "loop.c").write_text(C_LOOP)
    command = ["cc", "-std=c99", "-O2", f"-DIMU_REAL={real}", "loop.c", "-o", "loop", "-lm"]
    subprocess.run(command, cwd=folder, check=True)
    return float(subprocess.run([folder / "loop"], capture_output=True, text=True, check=True).stdout.split()[0])


def samples_by_themselves(folder: Path, count: int = 3000) -> None:
    """Time a sample by itself, in an array, and in C."""
    from pipeline.physics.compensation import load  # noqa: PLC0415

    generator = np.random.default_rng(0)
    force, rate = generator.normal(0, 1, (count, 3)), generator.normal(0, 50, (count, 3))
    clock, warmth = 1e-3 * np.arange(count), 25 + 1e-3 * np.arange(count)
    many = [np.tile(force, (100, 1)), np.tile(rate, (100, 1)), np.tile(warmth, 100), 1e-3 * np.arange(100 * count)]
    print("CPU us a sample: by itself, in an array, in C (double, float)")
    for name, effects in EFFECTS.items():
        write_calibration(folder / "U1.json", effects)
        write_header(folder / "U1.json")
        compensation = load(folder / "U1.json")
        stream = compensation.stream()
        start = time.process_time()
        for i in range(count):
            stream.apply(force[i], rate[i], warmth[i], clock[i])
        single = time.process_time() - start
        start = time.process_time()
        compensation.apply(*many)
        whole = time.process_time() - start
        c = ", ".join(f"{in_c(folder, real):.3f}" for real in ("double", "float"))
        print(f"{name:12} {1e6 * single / count:7.1f}, {1e4 * whole / count:.3f}, {c}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=3_600_000)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--kind", choices=["csv", "mcap", "both"], default="both")
    parser.add_argument("--effects", choices=[*EFFECTS], default="temperature")
    parser.add_argument("--official", action="store_true")
    parser.add_argument("--sample", action="store_true")
    parser.add_argument("--run", nargs=4, metavar=("WAY", "LOG", "OUT", "CALIBRATION"))
    options = parser.parse_args()
    if options.run:
        run_once(*options.run)
        return
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if options.sample:
            samples_by_themselves(folder)
            return
        write_calibration(folder / "U1.json", EFFECTS[options.effects])
        for kind in ["csv", "mcap"] if options.kind == "both" else [options.kind]:
            log, out = folder / f"log.{kind}", folder / f"out.{kind}"
            {"csv": write_csv, "mcap": write_mcap}[kind](log, options.samples)
            print(f"{options.samples} samples, {kind}, {log.stat().st_size / 1e6:.0f} MB, effects: {options.effects}")
            ratios = []
            for _ in range(options.repeat):
                ways = (f"{kind} unchanged", f"{kind} applied")
                plain, applied = (measure(way, log, out, folder / "U1.json") for way in ways)
                ratios.append(applied["cpu_s"] / plain["cpu_s"])
            print(f"median ratio     {np.median(ratios):.2f}")
            if options.official and kind == "mcap":
                measure("mcap official", log, out, folder / "U1.json")
            log.unlink()


if __name__ == "__main__":
    main()
