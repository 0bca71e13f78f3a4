"""Calibrate the public recordings of data/published and state the errors on what no fit has seen.

    python benchmarks/real_recordings.py [--xsens FOLDER] [--figures FILE]

FOLDER holds ``accelerometer.txt`` and ``gyroscope.txt`` of Tedaldi, Pretto & Menegatti (ICRA 2014). For each unit and
sensor: held-out error before and after calibration, noise floor, and the 99 % interval in which it is expected; and the
angle between predicted and measured gravity after held-out moves.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

from imu_research.figures import MeasuredFigure, write_figures
from pipeline import calibrate_unit

ROOT = Path(__file__).resolve().parents[1]
GRAVITY_G = 9.81744 / 9.80665  # of the place of the recording, as its authors state
EFFECT = "effects.gyroscope=[g_sensitivity]"  # that the diagnosis names
XSENS = """\
unit,sensor,table,procedure,method,ingest,overrides
xsens,generic,hand,multi_position,rests_and_moves,xsens_mti_multi_position,{}
"""


def figures_of(campaign: Path, unit: str) -> list[MeasuredFigure]:
    """Return the figures of a unit."""
    result = calibrate_unit(campaign, unit)
    validation: dict[str, Any] = result.validation
    found = []
    for sensor, scale, measured_in in (("accelerometer", 1000.0, "mg"), ("gyroscope", 1.0, "deg/s")):
        part = validation[sensor]
        if part is None:
            continue
        first, last = (scale * part["steps"][k]["rms_error"] for k in (0, -1))
        ends = part["expected_rms_error"]
        expected = ends and (scale * ends[0], scale * ends[1])
        name = f"{unit} {sensor}"
        found += [
            MeasuredFigure(f"{name}, raw", first, part["samples"], unit=measured_in),
            MeasuredFigure(f"{name}, calibrated", last, part["samples"], interval=expected, unit=measured_in),
            MeasuredFigure(f"{name}, noise floor", scale * part["noise_floor"], part["samples"], unit=measured_in),
        ]
    moves = validation.get("gravity_direction")
    if moves:
        for name, value in (*moves["rms_deg"].items(), ("noise floor", moves["noise_floor_deg"])):
            found.append(MeasuredFigure(f"{unit} move, {name}", value, moves["moves"], unit="deg"))
    return found


def main() -> None:
    """Calibrate and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--xsens", type=Path, help="folder of the recording")
    parser.add_argument("--figures", type=Path, help="file for the figures")
    options = parser.parse_args()
    found = [figure for unit in ("mpu6050", "wearable") for figure in figures_of(ROOT / "data" / "published", unit)]
    if options.xsens:
        if not (options.xsens / "gyroscope.txt").is_file():
            raise SystemExit(f"{options.xsens}: no gyroscope.txt; see the head of this file")
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            (folder / "units.csv").write_text(
                XSENS.format(f"procedure.folder={options.xsens.resolve()}; table.gravity_g={GRAVITY_G}; {EFFECT}")
            )
            found += figures_of(folder, "xsens")
    for figure in found:
        print(*figure.cells)
    if options.figures:
        write_figures(options.figures, found)


if __name__ == "__main__":
    main()
