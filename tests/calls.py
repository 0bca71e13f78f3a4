"""Which functions are called, and how often, of a unit's steps and of what is computed once; what code imports."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from contextlib import contextmanager
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from pipeline.estimation.design import Design
from pipeline.unit import STEPS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from pipeline.estimation.observations import Observations

Calls = Counter[tuple[str, str]]  # function, and recording if it has one
ONCE_A_RECORDING = (
    "pipeline.physics.kinematics._motion_of_turn",
    "pipeline.physics.kinematics._motion_of_attitude",
    "pipeline.physics.signal.filters.smooth_temperature",
    "pipeline.physics.signal.encoder_rate._rate_of",
    "pipeline.physics.signal.rests.find_rests",
    "pipeline.physics.signal.rests.rests_from_table",
)
ONCE_A_RECORDING_AND_SENSOR = ("pipeline.estimation.observations._part",)
OF_STEPS = tuple(f"pipeline.app.steps.{step.function}" for step in STEPS.values())


@contextmanager
def counted(functions: Iterable[str]) -> Iterator[Calls]:
    """Count the calls of functions; of a quantity that is declared ``once``, the computations."""
    calls: Calls = Counter()

    def counting(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **keywords: Any) -> Any:
            first = arguments[0] if arguments else None
            calls[name, str(getattr(first, "name", "") if not hasattr(first, "shape") else first[0])] += 1
            return function(*arguments, **keywords)

        return call

    with pytest.MonkeyPatch.context() as patch:
        for path in functions:
            module, _, name = path.rpartition(".")
            function = getattr(import_module(module), name)
            if computed := getattr(function, "__wrapped__", None):
                patch.setattr(function, "__wrapped__", counting(name, computed))
            else:
                patch.setattr(path, counting(name, function))
        yield calls


@contextmanager
def designs() -> Iterator[Counter[tuple[Any, ...]]]:
    """Count the designs that are built, by sensor and all values that determine the design."""
    built: Counter[tuple[Any, ...]] = Counter()
    build = Design.__init__

    def counting(design: Design, observations: Observations, terms: Any, *values: Any, **options: Any) -> None:
        arrays = (observations.reading, observations.weight, *values, *(options.get(n) for n in ("target", "base")))
        of_terms = tuple((t.effect.name, t.values.tobytes(), t.full) for t in terms)
        of_values = tuple(None if value is None else np.asarray(value).tobytes() for value in arrays)
        built[observations.sensor, of_terms, of_values, observations.angle_deg, options.get("project", False)] += 1
        build(design, observations, terms, *values, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Design, "__init__", counting)
        yield built


def names(calls: Calls) -> set[str]:
    return {name for name, _ in calls}


def imported_by(code: str, *packages: str) -> list[str]:
    """Return the modules of some packages that a new interpreter has imported after it has run the code."""
    listed = f"import sys; print(*(m for m in sys.modules if m.split('.')[0] in {packages!r}))"
    done = subprocess.run([sys.executable, "-c", f"{code}\n{listed}"], capture_output=True, text=True, check=True)
    return done.stdout.split()
