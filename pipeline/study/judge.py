"""What the diagnosis says of a case, and what adding it does to the held-out error: one line of a study's results.

The diagnosis gets recordings and the data sheet, never the truth.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from pipeline.diagnosis.diagnose import diagnose
from pipeline.estimation.joint import fit_joint
from pipeline.estimation.reference import fit_reference
from pipeline.model.effects import leaving_out
from pipeline.records import SENSORS
from pipeline.signal.noise import estimate_noise
from pipeline.simulation.description import read_config
from pipeline.study.bench import recordings_of
from pipeline.validation.heldout import validate

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.records import Noise, Recording, SensorCalibration
    from pipeline.study.cases import Case

JSON = dict[str, Any]
HELD_OUT = ("single", "pairs", "triples", "one_axis")


def judge(case: Case) -> list[JSON]:
    """Return what is said of a case: one entry, or one for each sensor where nothing is hidden.

    Parameters
    ----------
    case : Case
    """
    recordings = recordings_of(case)
    sensors = SENSORS if case.family.startswith("null") else (case.sensor,)
    out = []
    for sensor in sensors:
        began = time.process_time()
        said = say(recordings, case.model, sensor, left_out=case.left_out)
        said |= {"key": case.key, "sensor": sensor, "cpu_s": time.process_time() - began}
        if case.left_out:
            said["whole"] = say(recordings, case.model, sensor)
        if case.family in HELD_OUT and said["selected"]:
            said["held_out"] = held_out(recordings, case.model, sensor, said["selected"])
        out.append(said)
    return out


def say(recordings: list[Recording], model: str, sensor: str, left_out: Sequence[str] = ()) -> JSON:
    """Return the diagnosis of recordings, as far as a study judges it."""
    settings = settings_of(model)
    noise = estimate_noise(sensor, recordings, settings["sensor"][sensor])
    calibration = fit_reference(sensor, recordings, None, settings)
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


def held_out(recordings: list[Recording], model: str, sensor: str, names: Sequence[str]) -> JSON:
    """Return the held-out error before and after the effects are added, and the floor.

    The vector error where the attitude is logged, else that of the magnitude.
    """
    settings = settings_of(model)
    noise = estimate_noise(sensor, recordings, settings["sensor"][sensor])
    plain = fit_reference(sensor, recordings, None, settings)
    full = fit_joint(sensor, recordings, list(names), noise, settings, plain)
    before, floor = _error(plain, recordings, noise, settings)
    after, _ = _error(full, recordings, noise, settings)
    return {"before": before, "after": after, "floor": floor}


def _error(
    calibration: SensorCalibration, recordings: list[Recording], noise: Noise, settings: JSON
) -> tuple[float, float]:
    found = validate(calibration, recordings, noise, settings)
    last = found["steps"][-1]
    if last["vector_rms_error"] is not None and found["vector_noise_floor"] is not None:
        return last["vector_rms_error"], found["vector_noise_floor"]
    return last["rms_error"], found["noise_floor"]


def settings_of(model: str) -> JSON:
    """Return the sections of a unit's configuration that fit, diagnosis and validation read."""
    return {
        "sensor": read_config("sensor", model),
        "table": read_config("table", "acutronic"),
        "procedure": read_config("procedure", "three_axis_turns"),
        "method": {"as_printed": False},
        "effects": {"accelerometer": [], "gyroscope": []},
        "limits": {},
    }
