"""Run the cases of a study in several processes, and store the diagnosis of each.

    <directory>/truth.jsonl      the hidden effects of each case, and their signal-to-noise ratio
    <directory>/results.jsonl    the diagnosis of each case, and a digest of the code

A case that has a result is not run again, so that a study can be interrupted and extended.

A case goes through the steps of a run (``pipeline.unit``): its recordings are checked and filtered, both sensors are
fitted, validated and diagnosed. The steps get the recordings and the composed configuration of a unit, never the truth.
A result has the diagnosis and the held-out error after the selected effects are added. A case that a step refuses has
the refusal as its result.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Literal

import numpy as np

from imu_research.study.bench import GAUSS_MARKOV, at_detection, recordings_of, signals_left, withheld_of
from imu_research.study.cases import METHODS, StudyCase, draw
from pipeline.app.config import code_digest
from pipeline.app.one_unit import ConfiguredUnit, unit_of_recordings, unit_row
from pipeline.core.errors import CannotCalibrateError, ConfigurationError, PipelineError
from pipeline.core.files import JSON
from pipeline.core.records import SENSORS, NotCalibrated, SensorCalibration
from pipeline.estimation.harm import harmful_on_held_out
from pipeline.estimation.stages import stage_module
from pipeline.evaluation.held_out.error_breakdown import errors_of
from pipeline.evaluation.held_out.samples import HeldOutCase
from pipeline.physics.effects import leaving_out
from pipeline.simulation.description import shipped_settings
from pipeline.unit import STEPS, UnitState, tasks_of

TRUTH_FILE, RESULTS_FILE = "truth.jsonl", "results.jsonl"
FAMILIES_WITH_HELD_OUT_ERRORS = ("single", "pairs", "triples", "one_axis", "shape", "cycle", "hand")


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
    others = {line["seed"] for line in read_lines(directory / TRUTH_FILE)} - {seed}
    if others:
        raise ConfigurationError(
            f"holds cases of seed {min(others)}, not {seed}; choose another directory, or that seed",
            str(directory / TRUTH_FILE),
        )
    done = {line["key"] for line in read_lines(directory / RESULTS_FILE)}
    code = code_digest(*code_of_study())
    planned = [(family, number, seed) for number in range(count) for family in families]
    planned = [item for item in planned if draw(*item).key not in done]
    with (
        (directory / TRUTH_FILE).open("a", encoding="utf-8") as truth,
        (directory / RESULTS_FILE).open("a", encoding="utf-8") as results,
    ):
        for number, (hidden, entries) in enumerate(_judged(planned, processes), start=1):
            truth.write(json.dumps(hidden) + "\n")
            results.write("".join(json.dumps({**entry, "code": code}) + "\n" for entry in entries))
            truth.flush()
            results.flush()
            progress(number, len(planned))


def code_of_study() -> list[str]:
    """Return the modules that determine a result: this one, and those that the steps of a run import by name."""
    methods = [unit_row([f"method={method}"]).config.method.stages for method in METHODS]
    chains = [{s: [*(stages.of(s) or ()), "effects"] for s in SENSORS} for stages in methods]
    tasks = [task for chain in chains for task in tasks_of(chain)]
    steps = {f"pipeline.app.steps.{STEPS[task.step].function.partition('.')[0]}" for task in tasks}
    return [__name__, *sorted(steps | {stage_module(t.sensor, t.stage) for t in tasks if t.sensor})]


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
        result = {"key": case.key, "sensor": case.sensor, "error": f"{type(error).__name__}: {error}"}
        return hidden, [result | ({"refused": error.code} if isinstance(error, PipelineError) else {})]


def read_lines(path: Path) -> list[JSON]:
    """Return the entries of a file with one JSON document per line; none if the file does not exist."""
    if not path.is_file():
        return []
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line]


def judge(case: StudyCase) -> list[JSON]:
    """Return the results of a case: one entry, or one for each sensor where nothing is hidden."""
    began = time.process_time()
    unit, state = diagnose_case(case)
    whole = unit.run_to("diagnose", first="diagnose", state=replace(state)) if case.left_out else None
    out = []
    for sensor in SENSORS if case.kind == "null" else (case.sensor,):
        result: JSON = {"key": case.key, "sensor": sensor} | scored(state, sensor)
        if case.kind == "null":
            ranking = _part(state, sensor, "diagnosis")["ranking"]
            result["gains"] = {entry["effect"]: entry["delta_bic"] for entry in ranking}
        if whole:
            result["whole"] = scored(whole, sensor)
        if case.kind in FAMILIES_WITH_HELD_OUT_ERRORS:
            result["held_out"] = held_out_errors(unit, state, case, result["selected"])
        out.append(result)
    spent = (time.process_time() - began) / len(out)
    return [result | {"cpu_s": spent} for result in out]


def diagnose_case(case: StudyCase) -> tuple[ConfiguredUnit, UnitState]:
    """Run the steps up to the diagnosis, without the effects that the case leaves out of the catalogue.

    Raises ``PipelineError`` if a step refuses the unit.
    """
    options = {"sensor": case.model, "table": case.table, "method": case.method}
    options |= {"procedure": case.procedure} if case.by_hand else {}
    unit = unit_of_recordings(recordings_of(case), [f"{group}={option}" for group, option in options.items()])
    with leaving_out(case.left_out):
        return unit, unit.run_to("diagnose")


def scored(state: UnitState, sensor: str) -> JSON:
    """Return the part of a sensor's diagnosis that a study scores; raises ``CannotCalibrateError`` without one."""
    document = _part(state, sensor, "diagnosis")
    entries = {entry["effect"]: entry for entry in document["ranking"]}
    selected = [entries[name] for name in document["selected"]]
    return {
        "verdict": document["verdict"],
        "selected": document["selected"],
        "offered": bool(document["override"]),
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


def errors_with(unit: ConfiguredUnit, state: UnitState, sensor: str, names: Sequence[str]) -> tuple[JSON, UnitState]:
    """Return the held-out error before and after effects are added to a validated unit, the noise floor, and the unit.

    It is the error of the vector where the attitude is logged, else of the magnitude. Raises ``CannotCalibrateError``
    if the recordings do not determine the effects.
    """
    before, floor = _error(state, sensor)
    added = state
    if names:
        others = {other: fit for other, fit in state.fits.items() if other != sensor}
        adding = unit.with_effects(sensor, names)
        adding = replace(adding, stages={sensor: adding.stages[sensor]})
        added = adding.run_to("validate", first="fit", state=replace(state, fits=others))
    return {"before": before, "after": _error(added, sensor)[0], "floor": floor}, added


def held_out_errors(unit: ConfiguredUnit, state: UnitState, case: StudyCase, names: Sequence[str]) -> JSON:
    """Return the errors of ``errors_with``, and whether the error is ``raised`` significantly.

    That is judged (``pipeline.estimation.harm``) on motion that no step saw or, by hand, at the held-out rests.
    """
    errors, added = errors_with(unit, state, case.sensor, names)
    return {**errors, "raised": bool(names) and _raised(state, added, case)}


def _raised(state: UnitState, added: UnitState, case: StudyCase) -> bool:
    """Return whether the error of a unit rises significantly with the effects that were added."""
    known, settings = state.recordings, shipped_settings(sensor=case.model, table=case.table)
    fits = [fit for each in (state, added) if isinstance(fit := each.fits[case.sensor], SensorCalibration)]
    noise = known.noises[case.sensor] if known else None
    if known is None or noise is None or len(fits) < 2:
        return False
    if case.noise in GAUSS_MARKOV:  # the true wander
        data_sheet = settings.sensor.of(case.sensor)
        wander = np.full(3, case.wander * data_sheet.bias_wander)
        noise = replace(noise, wander=wander, correlation_time=data_sheet.wander_time_s)
    seen = [r for r in known.filtered if case.by_hand or r.role != "validation"]
    recordings = [*seen, *([] if case.by_hand else [withheld_of(case)])]
    errors, times = errors_of(fits, HeldOutCase(fits[0], recordings, noise, settings).held_out_samples())
    return bool(harmful_on_held_out(["what was added"], errors, times, noise))


def _error(state: UnitState, sensor: str) -> tuple[float, float]:
    """Return the held-out error of a sensor after its last stage, and the noise floor."""
    part = _part(state, sensor, "validation")
    last = part["steps"][-1]
    vector = last["vector_rms_error"] is not None and part["vector_noise_floor"] is not None
    return last["vector_rms_error" if vector else "rms_error"], part["vector_noise_floor" if vector else "noise_floor"]


def _part(state: UnitState, sensor: str, document: Literal["validation", "diagnosis"]) -> JSON:
    """Return the part of a sensor in a document of its unit."""
    fit = state.fits[sensor]
    if isinstance(fit, NotCalibrated):
        raise CannotCalibrateError(fit.reason)
    return dict(getattr(state, document)[sensor])
