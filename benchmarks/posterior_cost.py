"""The cost of the posterior over effects: CPU time of the diagnosis with it over that without it, unit by unit.

    python benchmarks/posterior_cost.py results/demo

takes the stages' files of a run (``results/demo/batches``) and diagnoses every sensor twice in one process, each time
from recordings that were just loaded.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

from pipeline.diagnosis import multi_position, turntable
from pipeline.diagnosis.diagnose import diagnose
from pipeline.estimation.posterior import Answers
from pipeline.files import read_json
from pipeline.io.parquet import load_recordings
from pipeline.records import SENSORS, SensorCalibration
from pipeline.stages.unit_files import require_noises


def main(results: Path) -> None:
    """Print the CPU time of each sensor, with the posterior and without it, and the ratio of the sums."""
    settings: dict[str, Any] = {}
    for file in sorted((results / "configs").glob("diagnose-*.json")):
        content = json.loads(file.read_text(encoding="utf-8"))
        settings |= {unit: {**content["common"], **own} for unit, own in content["units"].items()}
    total = {True: 0.0, False: 0.0}
    for file in sorted(results.glob("batches/*/filter/*.parquet")):
        unit, batch = file.stem, file.parents[1]
        fits: dict[str, SensorCalibration | None] = {}
        for sensor in SENSORS:
            stages = [p for p in (batch / "fit" / sensor).glob(f"*/{unit}.json")]
            last = max(stages, key=lambda p: (len(read_json(p).get("stages", ())), p.stat().st_mtime_ns))
            data = read_json(last)
            fits[sensor] = None if "not_calibrated" in data else SensorCalibration.from_json(sensor, data)
        recordings = load_recordings(file)
        noises = require_noises(file.parent, unit, recordings, settings[unit]["sensor"], fits)
        for sensor, fit in fits.items():
            if fit is None:
                continue
            spent = {
                with_it: _cost(fit, load_recordings(file), noises[sensor], settings[unit], fits, with_it)
                for with_it in total
            }
            print(f"{unit:<24} {sensor:<14} {spent[False]:6.2f} s {spent[True]:6.2f} s")
            total = {with_it: total[with_it] + spent[with_it] for with_it in total}
    print(f"ratio {total[True] / total[False]:.2f} ({total[True]:.1f} s over {total[False]:.1f} s)")


def _cost(fit: Any, recordings: Any, noise: Any, settings: Any, fits: Any, with_it: bool) -> float:
    kept = [(module, module.posterior) for module in (turntable, multi_position)]
    if not with_it:
        for module, _ in kept:
            module.posterior = lambda *_: Answers([((), 1.0)], {})
    began = time.process_time()
    diagnose(fit, recordings, noise, settings, fits["accelerometer"])
    spent = time.process_time() - began
    for module, own in kept:
        module.posterior = own
    return spent


if __name__ == "__main__":
    main(Path(sys.argv[1]))
