"""The cost of the posterior over effects: CPU time of the diagnosis with it over that without it, unit by unit.

    python benchmarks/posterior_cost.py results/demo

takes the stages' files of a run (``results/demo/batches``) and diagnoses every sensor twice in one process, each time
from recordings that were just loaded. Imports, which the units of a job share, are not counted.
"""

from __future__ import annotations

import json
import sys
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import scipy.special  # noqa: F401  (imported when it is first needed)

from pipeline.diagnosis import multi_position, turntable
from pipeline.diagnosis.diagnose import diagnose
from pipeline.estimation.posterior import Answers
from pipeline.pack import Pack
from pipeline.records import SENSORS, Noise, SensorCalibration
from pipeline.stages.unit_files import recordings_of

NOISE = ".noise.json"

if TYPE_CHECKING:
    from collections.abc import Callable


def main(results: Path) -> None:
    """Print the CPU time of each sensor, with the posterior and without it, and the ratio of the sums."""
    settings: dict[str, Any] = {}
    for file in sorted((results / "configs").glob("diagnose-*.json")):
        content = json.loads(file.read_text(encoding="utf-8"))
        settings |= {unit: {**content["common"], **own} for unit, own in content["units"].items()}
    total = {True: 0.0, False: 0.0}
    found = [
        (file.parent, name) for file in sorted(results.glob("batches/*/filter.zip")) for name in Pack(file).names()
    ]
    for batch, unit in [(at, name.removesuffix(NOISE)) for at, name in found if name.endswith(NOISE)]:
        packs = {stage: Pack(batch / f"{stage}.zip") for stage in ("ingest", "filter")}
        fits: dict[str, SensorCalibration | None] = {}
        for sensor in SENSORS:
            stages = [Pack(file).json(f"{unit}.json") for file in (batch / "fit" / sensor).glob("*.zip")]
            data = max(stages, key=lambda found: len(found.get("stages", ())))
            fits[sensor] = None if "not_calibrated" in data else SensorCalibration.from_json(sensor, data)
        stored = packs["filter"].json(f"{unit}{NOISE}")
        noises = {s: noise and Noise.from_json(noise) for s, noise in stored.items()}
        for sensor, fit in fits.items():
            if fit is None:
                continue
            spent = {}
            for with_it in total:
                known = fit, recordings_of(packs, unit), noises[sensor], settings[unit], fits["accelerometer"]
                spent[with_it] = _cost(partial(diagnose, *known), with_it=with_it)
            print(f"{unit:<24} {sensor:<14} {spent[False]:6.2f} s {spent[True]:6.2f} s")
            total = {with_it: total[with_it] + spent[with_it] for with_it in total}
    print(f"ratio {total[True] / total[False]:.2f} ({total[True]:.1f} s over {total[False]:.1f} s)")


def _without(*_: object) -> Answers:
    return Answers([((), 1.0)], {})


def _cost(diagnosed: Callable[[], object], *, with_it: bool) -> float:
    """Return the CPU time of a diagnosis."""
    kept = [(module, module.posterior) for module in (turntable, multi_position)]
    for module, own in kept:
        module.posterior = own if with_it else _without
    began = time.process_time()
    diagnosed()
    spent = time.process_time() - began
    for module, own in kept:
        module.posterior = own
    return spent


if __name__ == "__main__":
    main(Path(sys.argv[1]))
