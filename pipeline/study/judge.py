"""What the diagnosis says of a case, and what adding it does to the held-out error: one line of a study's results.

The diagnosis gets recordings and the configuration of a unit as the product composes it, never the truth; every step is
the function that the stage of a run calls.
"""

from __future__ import annotations

import time
from functools import cache
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from pipeline.config import load_campaign
from pipeline.diagnosis.diagnose import diagnose
from pipeline.estimation.effects_stage import fit_effects
from pipeline.estimation.noise import estimate_noise
from pipeline.model.effects import leaving_out
from pipeline.records import SENSORS
from pipeline.study.bench import recordings_of
from pipeline.study.cases import REFERENCE
from pipeline.validation.heldout import validate

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.records import Noise, Recording, SensorCalibration
    from pipeline.study.cases import Case

JSON = dict[str, Any]
HELD_OUT = ("single", "pairs", "triples", "one_axis", "shape", "cycle")


def judge(case: Case) -> list[JSON]:
    """Return what is said of a case: one entry, or one for each sensor where nothing is hidden.

    Parameters
    ----------
    case : Case
    """
    recordings = recordings_of(case)
    sensors = SENSORS if case.kind == "null" else (case.sensor,)
    out = []
    for sensor in sensors:
        began = time.process_time()
        said = say(recordings, case.model, sensor, case.left_out, case.method)
        said |= {"key": case.key, "sensor": sensor, "cpu_s": time.process_time() - began}
        if case.left_out:
            said["whole"] = say(recordings, case.model, sensor, (), case.method)
        if case.kind in HELD_OUT:
            said["held_out"] = held_out(recordings, case.model, sensor, said["selected"], case.method)
        out.append(said)
    return out


def say(
    recordings: list[Recording], model: str, sensor: str, left_out: Sequence[str] = (), method: str = REFERENCE
) -> JSON:
    """Return the diagnosis of recordings, as far as a study judges it.

    Parameters
    ----------
    recordings : list of Recording
    model, sensor : str
    left_out : sequence of str
        Effects that the catalogue is left without.
    method : str
        By which the base is calibrated.
    """
    settings = settings_of(model, method)
    noise = estimate_noise(sensor, recordings, settings["sensor"][sensor])
    calibration = calibrated(recordings, sensor, settings)
    with leaving_out(left_out):
        document = diagnose(calibration, recordings, noise, settings)
    entries = {entry["effect"]: entry for entry in document["ranking"]}
    return {
        "verdict": document["verdict"],
        "selected": document["selected"],
        "plausible": all(entries[name]["plausible"] for name in document["selected"]),
        "inflated": bool((document["wander"] or {}).get("inflated")),
        "look_alikes": {
            name: {alike["effect"]: alike["share"] for alike in entries[name]["look_alikes"]}
            for name in document["selected"]
        },
        "not_observable": [entry["effect"] for entry in document["not_observable"]],
        "unexplained": [entry["covariate"] for entry in document["unexplained"]],
        "residual_over_noise": document["residual_over_noise"],
        "delta_bic": [entries[name]["delta_bic"] for name in document["selected"]],
    }


def calibrated(recordings: list[Recording], sensor: str, settings: JSON) -> SensorCalibration:
    """Return the calibration after all stages of the configured method."""
    found: SensorCalibration | None = None
    for stage in settings["method"]["stages"][sensor]:
        found = import_module(f"pipeline.estimation.{sensor}.{stage}").fit(recordings, found, settings)
    assert found is not None  # noqa: S101  (every method has a stage)
    return found


def held_out(
    recordings: list[Recording], model: str, sensor: str, names: Sequence[str], method: str = REFERENCE
) -> JSON:
    """Return the held-out error before and after the effects are added, and the floor.

    The vector error where the attitude is logged, else that of the magnitude.
    """
    settings = settings_of(model, method)
    noise = estimate_noise(sensor, recordings, settings["sensor"][sensor])
    plain = calibrated(recordings, sensor, settings)
    adding = {**settings, "effects": {**settings["effects"], sensor: list(names)}}
    before, floor = _error(plain, recordings, noise, settings)
    full = fit_effects(sensor, recordings, plain, adding)
    after = _error(full, recordings, noise, adding)[0] if names else before
    return {"before": before, "after": after, "floor": floor}


def _error(
    calibration: SensorCalibration, recordings: list[Recording], noise: Noise, settings: JSON
) -> tuple[float, float]:
    found = validate(calibration, recordings, noise, settings)
    last = found["steps"][-1]
    if last["vector_rms_error"] is not None and found["vector_noise_floor"] is not None:
        return last["vector_rms_error"], found["vector_noise_floor"]
    return last["rms_error"], found["noise_floor"]


@cache
def settings_of(model: str, method: str = REFERENCE) -> JSON:
    """Return the configuration of a unit as a run composes and checks it; everything else is the default."""
    with TemporaryDirectory() as folder:
        (Path(folder) / "units.csv").write_text(f"unit,sensor,method\nU1,{model},{method}\n", encoding="utf-8")
        return load_campaign({"campaign": folder}).units["U1"].config
