"""CPU seconds of a whole calibration by hand, in-process: the published recording of an Xsens MTi, 51,175 samples.

    nice python benchmarks/by_hand.py FOLDER [--times 5]

FOLDER holds ``accelerometer.txt`` and ``gyroscope.txt``. Prints the least of some runs for each part: both fits from
the recording in memory (rests, accelerometer, gyroscope), and the gyroscope with g-sensitivity.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

from pipeline.estimation.accelerometer import nonlinear_least_squares
from pipeline.estimation.effects import fit as fit_effects
from pipeline.estimation.gyroscope import rests_and_moves
from pipeline.io.read import read_recordings
from pipeline.simulation.description import read_config

if TYPE_CHECKING:
    from collections.abc import Callable

    from pipeline.records import SensorCalibration


def least(times: int, work: Callable[[], Any]) -> tuple[float, Any]:
    """Return the least CPU time of some runs, s, and the last result."""
    found, result = [], None
    for _ in range(times):
        began = time.process_time()
        result = work()
        found.append(time.process_time() - began)
    return min(found), result


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--times", type=int, default=5)
    options = parser.parse_args()
    settings: dict[str, Any] = {
        "sensor": read_config("sensor", "generic"),
        "table": read_config("table", "hand") | {"gravity_g": 9.81744 / 9.80665},
        "procedure": read_config("procedure", "multi_position"),
        "method": {"as_printed": False},
        "effects": {"accelerometer": [], "gyroscope": ["g_sensitivity"]},
    }
    ingest = read_config("ingest", "canonical_csv") | read_config("ingest", "xsens_mti_multi_position")
    read, recordings = least(
        1, lambda: read_recordings(settings["procedure"], ingest, settings["sensor"], options.folder)
    )

    def both() -> SensorCalibration:
        nonlinear_least_squares.fit(recordings, None, settings)
        return rests_and_moves.fit(recordings, None, settings)

    fits, gyroscope = least(options.times, both)
    effects, _ = least(options.times, lambda: fit_effects("gyroscope", recordings, gyroscope, settings))
    print(f"reading {read:.2f} s, both fits {fits:.2f} s, effect g_sensitivity {effects:.2f} s")


if __name__ == "__main__":
    main()
