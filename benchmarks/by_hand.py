"""CPU seconds of a whole calibration by hand, in-process: the published recording of an Xsens MTi, 51,175 samples.

    nice python benchmarks/by_hand.py FOLDER [--times 5]

FOLDER holds ``accelerometer.txt`` and ``gyroscope.txt``. Prints the least of some runs for each part: both fits from
the recording in memory (noise, rests, accelerometer, gyroscope), and the gyroscope with g-sensitivity.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

from measuring import least

from pipeline.app.one_unit import unit_row
from pipeline.ingest.read import read_recordings
from pipeline.unit import Task, UnitState, run_checked, run_steps

LAYERS = [
    "sensor=generic", "table=hand", "procedure=multi_position", "ingest=xsens_mti_multi_position",
    f"table.gravity_g={9.81744 / 9.80665}", "effects.gyroscope=[g_sensitivity]",
]  # fmt: skip
METHOD = {"accelerometer": ["nonlinear_least_squares"], "gyroscope": ["rests_and_moves"]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--times", type=int, default=5)
    options = parser.parse_args()
    settings = unit_row(LAYERS).config
    read, recordings = least(
        1, lambda: read_recordings(settings.procedure, settings.ingest, settings.sensor, options.folder)
    )

    def both() -> UnitState:
        return run_checked(list(map(replace, recordings)), METHOD, settings)  # no quantity is known of a copy

    def effects(unit: UnitState) -> UnitState:
        return run_steps(replace(unit), iter([Task("fit", "gyroscope", "effects")]), lambda _: settings)

    fits, unit = least(options.times, both)
    more, _ = least(options.times, lambda: effects(unit))
    print(f"reading {read:.2f} s, both fits with their noise {fits:.2f} s, effect g_sensitivity {more:.2f} s")


if __name__ == "__main__":
    main()
