"""How well the clock of a table's own log is found: ``python benchmarks/table_clock.py --units 100 --interval 0.02``.

Simulated recordings beside a log at 100 Hz with a hidden clock: root mean square errors of offset and drift, the median
of their stated standard uncertainties, and how often the truth lies within two of them (Clopper-Pearson, 95 %).
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from simulated_logs import as_table, beside_a_table, clock_errors

from imu_research.figures import clopper_pearson
from pipeline.ingest.clock_alignment import align


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--units", type=int, default=100)
    parser.add_argument("--interval", type=float, default=0.02, help="of the sensor, s")
    arguments = parser.parse_args()
    found: dict[str, list[tuple[float, float, float, float]]] = {}
    spent = 0.0
    for seed in range(arguments.units):
        recordings, truth = beside_a_table(seed, arguments.interval, wrapped=True)
        for name in (n for n in recordings if f"{n}_table" in recordings and n != "static"):
            tables = as_table(recordings[name]), as_table(recordings[f"{name}_table"])
            begun = time.process_time()
            aligned = align(*tables)
            spent += time.process_time() - begun
            found.setdefault(name, []).append(clock_errors(aligned, recordings[name], truth))
    for name, errors in found.items():
        offset, u_offset, drift, u_drift = np.array(errors).T
        print(
            f"{name:<11} offset {1e3 * np.sqrt(np.mean(offset**2)):.4f} ms (stated {1e3 * np.median(u_offset):.4f}), "
            f"drift {np.sqrt(np.mean(drift**2)):.2f} ppm (stated {np.median(u_drift):.2f})"
        )
    every = np.concatenate([np.array(e) for e in found.values()])
    for name, error, stated in (("offset", every[:, 0], every[:, 1]), ("drift", every[:, 2], every[:, 3])):
        n, k = len(error), int(np.sum(np.abs(error) < 2.0 * stated))
        low, high = clopper_pearson(k, n)
        print(f"{name}: {k} of {n} within two standard uncertainties: {k / n:.3f} ({low:.3f} to {high:.3f})")
    print(f"{spent / len(every):.3f} CPU s a recording")


if __name__ == "__main__":
    main()
