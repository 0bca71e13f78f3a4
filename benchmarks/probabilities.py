"""Compares stated probabilities with the share that is true, for sizes that a study seldom hides.

    python benchmarks/probabilities.py prior|uniform|near --n 700 [--seed 991] [--processes 2] [--figures FILE]

prior: each effect is hidden with its prior probability, at a scale and size drawn from the prior of the posterior
    (``pipeline.estimation.evidence``). There the share should be the stated probability.
uniform: the same effects, each parameter uniform within the sensor file's limit.
near: one effect at 0.5 to 1.5 times the size at which a selection just passes its gate (uniform). The prior draws few
    such sizes, so that the share may be smaller.

The truth of a unit is the set of its hidden effects without those that are stated as not observable. Bins are those of
the study (``imu_research.study.scores.reliability``): of effects, of single answers and of answer sets.
"""

from __future__ import annotations

import argparse
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING

os.environ.setdefault("OMP_NUM_THREADS", "1")  # a process is one core

import numpy as np

from imu_research.figures import clustered_share, write_figures
from imu_research.study.bench import at_detection
from imu_research.study.cases import StudyCase, draw
from imu_research.study.result import ScoredCase
from imu_research.study.run import diagnose_case, scored
from imu_research.study.scores import stated_and_true, stated_shares
from pipeline.core.errors import PipelineError
from pipeline.core.records import SENSORS
from pipeline.estimation.candidates import limits_of
from pipeline.estimation.evidence import LIMIT_SCALES, SCALE_PRIOR
from pipeline.estimation.posterior import INCLUSION
from pipeline.estimation.selection import DELAYS
from pipeline.physics.effects import effect
from pipeline.simulation.description import shipped_settings

if TYPE_CHECKING:
    from collections.abc import Callable

# Both need a chamber. Without one, the cubic effect is not observable, and its other terms are those of the quadratic.
NOT_SIMULATED = ("temperature_lag", "bias_temperature_cubic")
OF_DETECTION = 0.5, 1.5  # times the detection size
TIME_CONSTANTS_S = 90.0, 400.0  # of a warm-up, as in a study


def of_prior(number: int, seed: int, *, uniform: bool = False) -> StudyCase:
    """Draw effects from the prior, and their sizes from it or uniformly within the limits."""
    rng = np.random.default_rng([seed, number, 7])
    sensor = str(rng.choice(SENSORS))
    procedure = str(rng.choice(["stop_and_go", "continuous", "one_way"], p=[0.5, 0.3, 0.2]))
    limits = limits_of(sensor, shipped_settings(sensor="mpu6050", table="acutronic").sensor.of(sensor))
    while True:
        names = [name for name in limits if name not in NOT_SIMULATED and rng.random() < INCLUSION]
        within = any(name in effect(other).contains for name in names for other in names)
        if not within and not set(DELAYS) <= set(names):
            break
    hidden = {}
    for name in names:
        scale = float(rng.choice(LIMIT_SCALES, p=np.exp(SCALE_PRIOR) / np.exp(SCALE_PRIOR).sum()))
        count = len(limits[name])
        values = limits[name] * (rng.uniform(-1.0, 1.0, count) if uniform else scale * rng.standard_normal(count))
        if name == "warm_up":
            values[3] = np.exp(rng.uniform(*np.log(TIME_CONSTANTS_S)))
        hidden[name] = (np.abs(values) if name == DELAYS[1] else values).tolist()
    return StudyCase("single", number, seed, "mpu6050", sensor, procedure, hidden)


def near_gate(number: int, seed: int) -> StudyCase:
    """Draw one effect near its detection size."""
    case = at_detection(draw("limit_100", number, seed))
    share = float(np.random.default_rng([seed, number, 8]).uniform(*OF_DETECTION))
    ((name, values),) = case.hidden.items()
    kept = [p.name == "time_constant" for p in effect(name).parameters(case.sensor)]
    return replace(case, hidden={name: np.where(kept, values, share * np.array(values)).tolist()})


DRAWN: dict[str, Callable[[int, int], StudyCase]] = {
    "prior": of_prior,
    "uniform": partial(of_prior, uniform=True),
    "near": near_gate,
}


def diagnosed(sizes: str, seed: int, number: int) -> ScoredCase | None:
    """Return the truth and the diagnosis of a unit; None where a step refuses it: an effect far beyond its limit."""
    case = DRAWN[sizes](number, seed)
    try:
        _, state = diagnose_case(case)
    except PipelineError:
        return None
    found = scored(state, case.sensor)
    hidden = {name: values for name, values in case.hidden.items() if name not in found["not_observable"]}
    # "single" is a family whose answer sets are scored.
    return ScoredCase.from_json({**case.to_json(), **found, "key": case.key, "family": "single", "hidden": hidden})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sizes", choices=DRAWN)
    parser.add_argument("--n", type=int, default=700)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=991)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--figures", type=Path)
    options = parser.parse_args()
    numbers = range(options.first, options.first + options.n)
    with ProcessPoolExecutor(options.processes, get_context("spawn")) as pool:
        found = list(pool.map(partial(diagnosed, options.sizes, options.seed), numbers, chunksize=4))
    cases = [case for case in found if case is not None]
    sys.stdout.write(f"{len(found) - len(cases)} of {len(found)} units refused\n")
    sets = [true for each in stated_and_true(cases, "answer sets") for true in each]
    mean = 100.0 * float(np.mean([probability for probability, _ in sets]))
    # Clustered by unit: a unit has one set.
    name, goal = f"all answer sets, stated {mean:.4g} %", f"contains {mean:.4g} %"
    of_sets = clustered_share(name, [np.array([true]) for _, true in sets], goal)
    figures = [*of_sets, *stated_shares(cases)]
    if options.sizes == "near":
        figures = [figure._replace(goal="") for figure in figures]
    sys.stdout.write("\n".join(" | ".join(map(str, figure.cells)) for figure in figures) + "\n")
    write_figures(options.figures, figures)


if __name__ == "__main__":
    main()
