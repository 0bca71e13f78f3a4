"""Run the cases of a study in several processes, and store the diagnosis of each.

    <directory>/truth.jsonl      the hidden effects of each case, and their signal-to-noise ratio
    <directory>/results.jsonl    the diagnosis of each case, and a digest of the code

A case that has a result is not run again, so that a study can be interrupted and extended.

A result has the diagnosis and the held-out error after the selected effects are added. The diagnosis gets the
recordings and the composed configuration of a unit, never the truth. Every step calls the same function as the stage of
a run.
"""

from __future__ import annotations

import json
import os
import time
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from pipeline.config import code_digest, load_campaign
from pipeline.diagnosis.diagnose import diagnose
from pipeline.errors import ConfigurationError
from pipeline.estimation.effects import fit as fit_effects
from pipeline.estimation.noise import estimate_noise
from pipeline.estimation.stages import fit_stage
from pipeline.model.effects import leaving_out
from pipeline.preprocessing.coarse_temperature import refined
from pipeline.records import SENSORS, Recording, SensorCalibration
from pipeline.study.bench import at_detection, recordings_of, signals_left
from pipeline.study.cases import REFERENCE, Case, draw
from pipeline.validation.heldout import validate

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence


TRUTH, RESULTS = "truth.jsonl", "results.jsonl"
JSON = dict[str, Any]
HELD_OUT = ("single", "pairs", "triples", "one_axis", "shape", "cycle")


def run_study(
    directory: Path,
    families: Sequence[str],
    count: int,
    seed: int,
    *,
    processes: int,
    progress: Callable[[int, int], None],
) -> None:
    """Run the first ``count`` cases of each family that have no result in ``directory``.

    ``progress`` is called with the numbers of finished and of all cases. Raises ``ConfigurationError`` if the directory
    has cases of another seed.
    """
    directory.mkdir(parents=True, exist_ok=True)
    others = {line["seed"] for line in read_lines(directory / TRUTH)} - {seed}
    if others:
        raise ConfigurationError(
            f"holds cases of seed {min(others)}, not {seed}; choose another directory, or that seed",
            str(directory / TRUTH),
        )
    done = {line["key"] for line in read_lines(directory / RESULTS)}
    code = code_digest("pipeline.study.run")
    planned = [(family, number, seed) for number in range(count) for family in families]
    planned = [item for item in planned if draw(*item).key not in done]
    with (
        (directory / TRUTH).open("a", encoding="utf-8") as truth,
        (directory / RESULTS).open("a", encoding="utf-8") as results,
    ):
        for number, (hidden, entries) in enumerate(_judged(planned, processes), start=1):
            truth.write(json.dumps(hidden) + "\n")
            results.write("".join(json.dumps({**entry, "code": code}) + "\n" for entry in entries))
            truth.flush()
            results.flush()
            progress(number, len(planned))


def _judged(planned: Sequence[tuple[str, int, int]], processes: int) -> Iterator[tuple[JSON, list[JSON]]]:
    if processes == 1:
        yield from map(_judged_or_fault, planned)
        return
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # a process is one core
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        yield from pool.map(_judged_or_fault, planned, chunksize=4)


def _judged_or_fault(planned: tuple[str, int, int]) -> tuple[JSON, list[JSON]]:
    """Return the truth and the results of a case; an exception is a result and does not end the study."""
    case = at_detection(draw(*planned))
    hidden = {**case.to_json(), "signal_left": signals_left(case)}
    try:
        return hidden, judge(case)
    except Exception as error:  # noqa: BLE001  (any exception is a result of the case)
        return hidden, [{"key": case.key, "sensor": case.sensor, "error": f"{type(error).__name__}: {error}"}]


def read_lines(path: Path) -> list[JSON]:
    """Return the entries of a file with one JSON document per line; none if the file does not exist."""
    if not path.is_file():
        return []
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line]


def judge(case: Case) -> list[JSON]:
    """Return the results of a case: one entry, or one for each sensor where nothing is hidden."""
    recordings = refined(recordings_of(case))
    out = []
    for sensor in SENSORS if case.kind == "null" else (case.sensor,):
        began = time.process_time()
        result = say(recordings, case.model, sensor, case.left_out, case.method)
        result |= {"key": case.key, "sensor": sensor, "cpu_s": time.process_time() - began}
        if case.left_out:
            result["whole"] = say(recordings, case.model, sensor, method=case.method)
        if case.kind in HELD_OUT:
            result["held_out"] = _held_out(recordings, case.model, sensor, result["selected"], case.method)
        out.append(result)
    return out


def say(
    recordings: list[Recording], model: str, sensor: str, left_out: Sequence[str] = (), method: str = REFERENCE
) -> JSON:
    """Diagnose recordings, and return the part of the diagnosis that a study scores.

    ``left_out``: effects to remove from the catalogue; ``method``: by which the base is calibrated.
    """
    settings = settings_of(model, method)
    noise = estimate_noise(sensor, recordings, settings["sensor"][sensor])
    calibration = calibrated(recordings, sensor, settings)
    with leaving_out(left_out):
        document = diagnose(calibration, recordings, noise, settings)
    entries = {entry["effect"]: entry for entry in document["ranking"]}
    selected = [entries[name] for name in document["selected"]]
    return {
        "verdict": document["verdict"],
        "selected": document["selected"],
        "plausible": all(entry["plausible"] for entry in selected),
        "inflated": bool((document["wander"] or {}).get("inflated")),
        "look_alikes": {
            entry["effect"]: {alike["effect"]: alike["share"] for alike in entry["look_alikes"]} for entry in selected
        },
        "not_observable": [entry["effect"] for entry in document["not_observable"]],
        "unexplained": [entry["covariate"] for entry in document["unexplained"]],
        "residual_over_noise": document["residual_over_noise"],
        **{key: document[key] for key in ("probability", "answer_set", "upper_limit")},
        "delta_bic": [entry["delta_bic"] for entry in selected],
    }


def calibrated(recordings: list[Recording], sensor: str, settings: JSON) -> SensorCalibration:
    """Return the calibration after all stages of the configured method."""
    found: SensorCalibration | None = None
    for stage in settings["method"]["stages"][sensor]:
        found = fit_stage(sensor, stage, recordings, found, settings)
    assert found is not None  # noqa: S101  (every method has a stage)
    return found


def _held_out(recordings: list[Recording], model: str, sensor: str, names: Sequence[str], method: str) -> JSON:
    """Return the held-out error before and after the effects are added, and the noise floor.

    It is the error of the vector where the attitude is logged, else of the magnitude.
    """
    settings = settings_of(model, method)
    noise = estimate_noise(sensor, recordings, settings["sensor"][sensor])
    fits = {"before": (calibrated(recordings, sensor, settings), settings)}
    if names:
        adding = {**settings, "effects": {**settings["effects"], sensor: list(names)}}
        fits["after"] = fit_effects(sensor, recordings, fits["before"][0], adding), adding
    errors = {}
    for when, (calibration, used) in fits.items():
        found = validate(calibration, recordings, noise, used)
        last = found["steps"][-1]
        vector = last["vector_rms_error"] is not None and found["vector_noise_floor"] is not None
        errors[when] = last["vector_rms_error" if vector else "rms_error"]
        if when == "before":
            errors["floor"] = found["vector_noise_floor" if vector else "noise_floor"]
    return {key: errors.get(key, errors["before"]) for key in ("before", "after", "floor")}


@cache
def settings_of(model: str, method: str = REFERENCE) -> JSON:
    """Return the configuration of a unit as a run composes and checks it, with defaults for all other settings."""
    with TemporaryDirectory() as folder:
        (Path(folder) / "units.csv").write_text(f"unit,sensor,method\nU1,{model},{method}\n", encoding="utf-8")
        return load_campaign({"campaign": folder}).units["U1"].config
