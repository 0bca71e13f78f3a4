"""Pass or fail of a unit, from the checks that its validation made of the limits that its configuration sets.

A unit without any limit is neither pass nor fail; a unit that failed is fail.
"""

from __future__ import annotations

from typing import Any

from pipeline.records import SENSORS

JSON = dict[str, Any]
UNITS = {"accelerometer": "g", "gyroscope": "deg/s"}


def checks(validation: JSON | None) -> list[JSON]:
    """Return each limit beside its figure: ``sensor, name, value, limit, unit, pass``.

    Parameters
    ----------
    validation : dict or None
        As in its file.
    """
    return [
        {**check, "sensor": sensor, "unit": "" if check["name"] == "scale_factor" else UNITS[sensor]}
        for sensor in SENSORS
        for check in ((validation or {}).get(sensor) or {}).get("limits") or []
    ]


def verdict(calibration: JSON, validation: JSON | None) -> bool | None:
    """Return whether the unit passes: None where nothing was to be checked."""
    if calibration.get("status") != "ok":
        return False
    judged = [bool(check["pass"]) for check in checks(validation)]
    return all(judged) if judged else None


def final_step(held_out: JSON | None) -> JSON:
    """Return the last step of a validation: everything that was fitted is on."""
    steps = (held_out or {}).get("steps") or [{}]
    last: JSON = steps[-1]
    return last
