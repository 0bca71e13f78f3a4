"""Every built-in effect computes what it computed when its equation was written out in Python, before it was a formula.

``data/columns_of_effects.npz`` holds columns and readings of that code at random motions: five samples of every signal,
three turn axes, K and parameters at random.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bench_session import random_motion

from pipeline.physics.effects import built_in

STORED = np.load(Path(__file__).parent / "data" / "columns_of_effects.npz")
CASES = sorted({tuple(key.split(".")[:3]) for key in STORED.files if key.endswith(".columns")})


@pytest.mark.parametrize(("name", "sensor", "seed"), CASES)
def test_columns_and_readings_are_those_of_the_equation_in_python(name: str, sensor: str, seed: str) -> None:
    effect = built_in()[name]
    rng = np.random.default_rng(7)
    K = np.eye(3) + 0.05 * rng.standard_normal((3, 3))
    values = rng.uniform(0.1, 1.0, len(effect.parameters(sensor)))
    for what, found in (
        ("columns", effect.columns(sensor, random_motion(int(seed)), K, values)),
        ("reading", effect.reading(sensor, random_motion(int(seed)), K, values)),
    ):
        expected = STORED[f"{name}.{sensor}.{seed}.{what}"]
        np.testing.assert_allclose(found, expected, rtol=1e-14, atol=1e-14 * np.abs(expected).max())


def test_names_and_units_of_parameters_are_those_of_published_calibrations() -> None:
    for key in STORED.files:
        name, what = key.split(".")[0], key.rpartition(".")[2]
        if what == "parameters":
            effect = built_in()[name]
            found = [f"{s} {p.name} {p.unit}" for s in effect.sensors for p in effect.parameters(s)]
            assert found == STORED[key].tolist(), name


def test_owner_and_needs_are_those_of_published_calibrations() -> None:
    for key in STORED.files:
        if key.endswith(".says"):
            e = built_in()[key.split(".")[0]]
            needs = ["needs", *e.needs, str(e.needs_clock), "nonlinear", *e.nonlinear]
            stored = STORED[key].tolist()
            end = stored.index("contains")
            assert [str(e.owner), str(e.layout), *e.sensors, *needs] == stored[:end], e.name
            assert {*stored[end + 1 :]} & built_in().keys() <= {*e.contains}, e.name
