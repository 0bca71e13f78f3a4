"""Good units: simulated with known truth, each with a seed of its own.

Kinds differ in sensor, motion, format and in what is logged; one has a hidden effect in each sensor, which the
configuration holds, so that nothing is missing in any of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from unit_copy import ATTITUDE, Copy, Truth, table_of

from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import UnitDescription

LENGTHS: dict[str, Any] = {"validation_s": 90.0, "static_s": 90.0, "warm_up_rest_s": 15.0}
STEPS = {**LENGTHS, "step_deg": 10.0, "dwell_s": 1.5, "rates_dps": (30.0, 100.0), "both_directions": True}
CONTINUOUS = {**LENGTHS, "accelerometer_rates_dps": (5.0, 20.0), "rates_dps": (20.0, 60.0), "both_directions": True}
ONE_WAY = {**STEPS, "rates_dps": (40.0,), "both_directions": False}
SENSORS = ("accelerometer", "gyroscope")
KNOWN = {"gyroscope": "g_sensitivity", "accelerometer": "quadratic_nonlinearity"}
HIDDEN: dict[str, Any] = {f"{sensor}.{name}": None for sensor, name in KNOWN.items()}
BASES: dict[str, dict[str, Any]] = {
    "steps": {"course": STEPS},
    "steps_mcap": {"course": STEPS, "format": "mcap"},
    "continuous_rate": {"course": CONTINUOUS, "no_attitude": True},
    "continuous_mcap": {"course": CONTINUOUS, "format": "mcap"},
    "stim": {"course": STEPS, "sensor": "stim300"},
    "stim_mcap": {"course": CONTINUOUS, "sensor": "stim300", "format": "mcap"},
    "one_way": {"course": ONE_WAY},
    "no_static": {"course": {**STEPS, "static_s": 0.0}},
    "fast_log": {"course": {**STEPS, "step_deg": 15.0}, "interval_s": 0.04},
    "known": {"course": STEPS, "effects": HIDDEN, "overrides": [f"effects.{s}=[{n}]" for s, n in KNOWN.items()]},
    "hidden": {"course": STEPS, "effects": HIDDEN},
    "by_hand": {"procedure": "multi_position", "table": "hand", "interval_s": 0.02, "course": {"positions": 30},
                "method": "rests_and_moves"},
}  # fmt: skip
TABLE = [name for name in BASES if name != "by_hand"]


def good_unit(base: str, seed: int, name: str = "unit", *, varied: bool = False) -> Copy:
    """Return a good unit of a kind; its random numbers follow from the seed, its course too where it is varied."""
    described = dict(BASES[base])
    if varied and base != "by_hand":
        described["course"] = described["course"] | _course(described["course"], np.random.default_rng(seed))
    wanted = described.pop("format", "csv")
    no_attitude, overrides = described.pop("no_attitude", False), described.pop("overrides", [])
    method = described.pop("method", "")
    unit = UnitDescription(name, **described)
    recordings, known = simulate_unit(unit, seed, 0)
    tables = {r.name: table_of(r) for r in recordings}
    if no_attitude:
        for column in ATTITUDE:
            tables["validation"].pop(column)
    truth = {}
    for sensor in SENSORS:
        hidden = () if overrides else tuple(known[sensor]["effects"])
        truth[sensor] = Truth(np.array(known[sensor]["bias"]), np.array(known[sensor]["matrix"]), hidden)
    row = {"sensor": unit.sensor, "table": unit.table, "procedure": unit.procedure, "method": method}
    return Copy(
        name, base, unit.sensor, wanted, unit.interval_s, tables, truth,
        row=row, overrides=list(overrides),
    )  # fmt: skip


def _course(usual: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """Return another course of the same kind."""
    rate = float(rng.choice([20.0, 45.0, 60.0, 100.0]))
    found: dict[str, Any] = {
        "rates_dps": (rate,) if rng.random() < 0.4 else (rate, 1.5 * rate),
        "validation_rate_dps": float(rng.uniform(20.0, 60.0)),
        "validation_s": float(rng.uniform(60.0, 180.0)),
    }
    if "step_deg" in usual:
        found |= {"step_deg": float(rng.choice([5.0, 10.0, 15.0])), "dwell_s": float(rng.uniform(1.0, 2.5))}
    if usual["static_s"]:
        found["static_s"] = float(rng.uniform(60.0, 180.0))
    return found
