"""Pass or fail: the figures of one unit beside the limits that its configuration sets.

A limit that is null is not checked. A unit without any limit is neither pass nor fail; a unit that failed is fail.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from pipeline.records import SENSORS

JSON = dict[str, Any]


@dataclass(frozen=True)
class Check:
    """One figure beside its limit; ``value`` is None where the unit has no such figure, which is no pass."""

    sensor: str
    quantity: str
    value: float | None
    limit: float
    unit: str

    @property
    def passed(self) -> bool:
        """Whether the figure is known and within the limit."""
        return self.value is not None and self.value <= self.limit

    def to_json(self) -> JSON:
        """Return the check as a plain dict."""
        return {**asdict(self), "passed": self.passed}


def check_limits(calibration: JSON, validation: JSON | None, limits: JSON | None) -> list[Check]:
    """Return every check that the limits ask for.

    Parameters
    ----------
    calibration, validation : dict
        As in their files; ``validation`` may be None.
    limits : dict or None
        The section ``limits`` of the unit's configuration: per sensor, limits by name.
    """
    checks = []
    for sensor in SENSORS:
        part = calibration.get(sensor)
        held_out = (validation or {}).get(sensor)
        for quantity, limit in ((limits or {}).get(sensor) or {}).items():
            if limit is None or (part is None and calibration.get("status") == "ok"):
                continue
            dimensionless = quantity == "scale_factor"
            unit = "" if dimensionless else ("g" if sensor == "accelerometer" else "deg/s")
            checks.append(Check(sensor, quantity, _figure(quantity, part, held_out), float(limit), unit))
    return checks


def verdict(calibration: JSON, checks: list[Check]) -> bool | None:
    """Return whether the unit passes: None where nothing was to be checked."""
    if calibration.get("status") != "ok":
        return False
    return all(c.passed for c in checks) if checks else None


def final_step(held_out: JSON | None) -> JSON:
    """Return the last step of a validation: everything that was fitted is on."""
    steps = (held_out or {}).get("steps") or [{}]
    last: JSON = steps[-1]
    return last


def _figure(quantity: str, part: JSON | None, held_out: JSON | None) -> float | None:
    step = final_step(held_out)
    if quantity == "held_out_max_abs_error":
        ends = [abs(v) for v in (step.get("max_error"), step.get("min_error")) if v is not None]
        return max(ends, default=None)
    if quantity.startswith("held_out_"):
        value: float | None = step.get(quantity.removeprefix("held_out_"))
        return value
    if part is None:
        return None
    if quantity == "bias":
        return float(max(abs(b) for b in part["bias"]))
    if quantity == "scale_factor":
        return float(max(abs(part["matrix"][i][i] - 1.0) for i in range(3)))
    return None
