"""The temperature between the steps of a coarse thermometer, against a simulated truth."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from pipeline.checks.checks import refined
from pipeline.core.records import Recording
from pipeline.physics.signal.filters import temperature_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

STARTS = (10.0, 420.0, 900.0, 1500.0)  # s, of recordings of five minutes


def warmth(time: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the temperature of a body that warms by 4.3 degC in a room that changes by 0.3 degC."""
    return np.asarray(24.1 - 4.3 * np.exp(-time / 310.0) + 0.15 * np.sin(2.0 * np.pi * time / 3000.0))


def recordings(step: float, noise: float = 0.03) -> list[Recording]:
    """Return recordings whose thermometer reads in steps, with noise before it is rounded."""
    rng, out = np.random.default_rng(3), []
    for k, start in enumerate(STARTS):
        time = start + 0.12 * np.arange(2500)
        read = np.rint((warmth(time) + noise * rng.standard_normal(len(time))) / step) * step
        out.append(Recording(f"r{k}", "rests", None, np.rint(time * 1e9).astype(np.int64), temperature=read))
    return out


def errors(given: list[Recording]) -> NDArray[np.float64]:
    """Return the errors of the smoothed temperature, less their mean, which a bias holds."""
    off = np.concatenate([temperature_of(r) - warmth(r.time) for r in given])
    return np.asarray(off - off.mean())


@pytest.mark.parametrize(("step", "times"), [(0.5, 3.0), (1.0, 2.0)])
def test_the_temperature_between_two_steps_follows_from_the_times_of_the_steps(step: float, times: float) -> None:
    coarse = recordings(step)
    fine = refined(coarse)
    assert errors(fine).std() < errors(coarse).std() / times
    assert np.abs(errors(fine)).max() < 0.2 * step
    assert [[note.code for note in r.notes] for r in fine] == [["N-STEPS"]] * 4
    assert f"steps of {step:g} degC" in fine[0].notes[0].detail


def test_other_thermometers_are_left_as_they_are() -> None:
    coarse = recordings(0.5)
    constant = [replace(r, temperature=np.full(r.samples, 25.0)) for r in coarse]
    apart = [replace(r, clock_shared=False) for r in coarse]
    absent = [replace(coarse[0], temperature=None), *coarse[1:]]
    for given in (recordings(0.003), recordings(0.5, noise=0.6), constant, apart, absent, []):
        assert all(found is r for found, r in zip(refined(given), given, strict=True))
