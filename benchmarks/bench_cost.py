"""What the determination of the bench costs where a bench follows the convention: CPU time with it over that without.

    python benchmarks/bench_cost.py --units 20 --seed 5

simulates units on a three-axis table and takes each through check, fit, held-out error and diagnosis twice in one
process, with the determination of mounting, seats and errors of the angle and without it, in alternating order. Also
printed is the largest difference of a parameter over its expanded uncertainty.
"""

from __future__ import annotations

import argparse
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from unittest.mock import patch

import numpy as np

from pipeline.app.one_unit import unit_of_recordings
from pipeline.core.records import coverage_factor
from pipeline.simulation.campaign import simulate_unit

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "study"))
from bench_units import drawn

BYPASSED = {
    "pipeline.checks.checks.check_mounting": lambda recordings, _: list(recordings),
    "pipeline.estimation.candidates.bench_effects": lambda *_: [],
    "pipeline.estimation.reference_least_squares.bench_effects": lambda *_: [],
    "pipeline.estimation.observations._lost_at_stops": lambda *_: np.zeros(1),
}


def main() -> None:
    """Print CPU time of both ways, their ratio, and how far the parameters differ."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--units", type=int, default=20)
    parser.add_argument("--seed", type=int, default=5)
    options = parser.parse_args()
    spent: dict[bool, list[float]] = {True: [], False: []}
    largest = 0.0
    for number in range(-2, options.units):  # the first two, one of each sensor model, load modules and are not counted
        description, _ = drawn("plain", options.seed, abs(number), 0.0)
        layers = [f"sensor={description.sensor}", f"table={description.table}", "method=reference_least_squares"]
        found = {}
        for with_it in (True, False) if number % 4 < 2 else (False, True):
            recordings, _ = simulate_unit(description, options.seed, abs(number))
            with ExitStack() as bypass:
                for name, other in {} if with_it else BYPASSED.items():
                    bypass.enter_context(patch(name, other))
                begin = time.process_time()
                found[with_it] = [*unit_of_recordings(recordings, layers).run_to("diagnose").fits.values()]
                if number >= 0:
                    spent[with_it].append(time.process_time() - begin)
        for here, there in zip(found[True], found[False], strict=True):
            U = coverage_factor(here.freedom[:12]) * np.sqrt(np.diag(here.covariance)[:12])
            off = np.concatenate([here.bias - there.bias, (here.matrix - there.matrix).ravel()])
            largest = max(largest, float(np.abs(off / U).max()))
    ratios = np.array(spent[True]) / np.array(spent[False])
    error = 1.96 * ratios.std(ddof=1) / np.sqrt(len(ratios))
    print(f"{sum(spent[True]):.1f} s over {sum(spent[False]):.1f} s; ratio {ratios.mean():.3f} +- {error:.3f}")
    print(f"parameters differ by at most {largest:.2g} of their expanded uncertainty")


if __name__ == "__main__":
    main()
