"""The cost of the posterior over effects: CPU time of the diagnosis with it over that without it, unit by unit.

    python benchmarks/posterior_cost.py demo

takes the units of a campaign in one process through the steps of a run, and diagnoses each twice. Its quantities are
those of a run that has validated the unit. Imports, which the units of a job share, are not counted.
"""

from __future__ import annotations

import os
import sys
from contextlib import ExitStack
from typing import TYPE_CHECKING
from unittest.mock import patch

os.environ.setdefault("OMP_NUM_THREADS", "1")

import scipy.special  # noqa: F401  (imported when it is first needed)
from measuring import least

from pipeline.app.config import load_campaign
from pipeline.app.one_unit import unit_of_campaign
from pipeline.estimation.posterior import Answers
from pipeline.evaluation.diagnosis import multi_position, turntable

if TYPE_CHECKING:
    from pipeline.app.one_unit import ConfiguredUnit


def main(name: str) -> None:
    """Print the CPU time of each unit, without the posterior and with it, and the ratio of the sums."""
    campaign = load_campaign({"campaign": name})
    total = {False: 0.0, True: 0.0}
    for unit in campaign.units:
        spent = {with_it: _cost(unit_of_campaign(campaign, unit), with_it=with_it) for with_it in total}
        print(f"{unit:<24} {spent[False]:6.2f} s {spent[True]:6.2f} s")
        total = {with_it: total[with_it] + spent[with_it] for with_it in total}
    print(f"ratio {total[True] / total[False]:.2f} ({total[True]:.1f} s over {total[False]:.1f} s)")


def _cost(unit: ConfiguredUnit, *, with_it: bool) -> float:
    """Return the CPU time of the diagnosis of a unit, s."""
    state = unit.run_to("validate")
    with ExitStack() as bypass:
        for module in () if with_it else (turntable, multi_position):
            bypass.enter_context(patch.object(module, "posterior", lambda *_: Answers([((), 1.0)], {})))
        return least(1, lambda: unit.run_to("diagnose", first="diagnose", state=state))[0]


if __name__ == "__main__":
    main(sys.argv[1])
