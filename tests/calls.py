"""Which functions are called, and how often: of the steps of a unit, and of what is computed once a recording."""

from __future__ import annotations

from collections import Counter
from contextlib import contextmanager
from importlib import import_module
from typing import TYPE_CHECKING, Any

import pytest

from pipeline.unit import STEPS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

Calls = Counter[tuple[str, str]]  # function, and recording if it has one
ONCE_A_RECORDING = (
    "pipeline.model.kinematics._motion_of_turn",
    "pipeline.model.kinematics._motion_of_attitude",
    "pipeline.signal.filters.smooth_temperature",
    "pipeline.signal.encoder_rate._rate_of",
    "pipeline.signal.rests._rests_by_hand",
    "pipeline.signal.rests._rests_by_table",
)
OF_STEPS = tuple(f"pipeline.stages.{step.function}" for step in STEPS.values())


@contextmanager
def counted(functions: Iterable[str]) -> Iterator[Calls]:
    """Replace functions by ones that count their calls."""
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
            patch.setattr(path, counting(name, getattr(import_module(module), name)))
        yield calls


def names(calls: Calls) -> set[str]:
    """Return the names of the called functions."""
    return {name for name, _ in calls}
