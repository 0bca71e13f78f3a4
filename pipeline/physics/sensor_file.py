"""Complete a sensor's file (``configs/sensor``): figures of a chosen range, and figures that its data sheet omits.

``ranges`` maps a full scale to counts per unit; the override ``sensor.accelerometer.range=6`` sets ``full_scale`` and
``counts_per_unit`` of that range. A figure that is null or absent is taken from ``generic``, and its name is listed in
``assumed``. The same applies to all figures of a sensor that the chip does not have. Full scale and counts are never
taken from ``generic`` for a sensor that the chip has.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from imu_logs.units import SENSORS
from pipeline.core.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.core.settings import DataSheet, Sensor

REQUIRED_FIGURES = ("noise_density", "bias_wander", "wander_time_s", "bias", "scale_factor", "cross_axis", "effects")


def completed(sensor: Mapping[str, Any], generic: Mapping[str, Any]) -> dict[str, Any]:
    """Return a sensor's file in which figures that are not stated are taken from ``generic``."""
    out = dict(sensor)
    for part in SENSORS:
        data_sheet = dict(sensor.get(part) or {k: generic[part][k] for k in ("full_scale", "counts_per_unit")})
        missing = [key for key in REQUIRED_FIGURES if data_sheet.get(key) is None]
        if missing:
            out[part] = data_sheet | {key: generic[part][key] for key in missing} | {"assumed": missing}
    return out


def range_settings(key: str, value: Any, sensor: Mapping[str, Any]) -> list[tuple[str, Any]]:  # noqa: ANN401  (the user's)
    """Return the settings that an override makes: itself, or the figures of the range that it chooses.

    Raises ``ConfigurationError`` if the sensor's file does not list the range.
    """
    group, _, rest = key.partition(".")
    part, _, leaf = rest.partition(".")
    if group != "sensor" or part not in SENSORS or leaf != "range":
        return [(key, value)]
    ranges = {float(full): counts for full, counts in ((sensor.get(part) or {}).get("ranges") or {}).items()}
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number or float(value) not in ranges:
        known = ", ".join(f"{full:g}" for full in sorted(ranges)) or "none: set full_scale and counts_per_unit"
        raise ConfigurationError(f"{key}={value}: the sensor's file lists the ranges {known}")
    return [(f"sensor.{part}.full_scale", float(value)), (f"sensor.{part}.counts_per_unit", ranges[float(value)])]


def settings_of_ranges(data_sheets: Mapping[str, DataSheet], wanted: Sequence[float | None]) -> list[str]:
    """Return the overrides that set the range of the accelerometer, g, then of the gyroscope, deg/s; None: unchanged.

    ``data_sheets``: of the sensors that the chip has. An override sets ``range`` where the sensor's file lists ranges,
    else full scale and counts per unit. Raises ``ConfigurationError`` if there are more ranges than sensors, one is not
    positive, or the file does not list it.
    """
    if len(wanted) > len(data_sheets) or not all(value is None or value > 0.0 for value in wanted):
        raise ConfigurationError("--range takes the range of the accelerometer in g, then of the gyroscope in deg/s")
    found = []
    for (part, data_sheet), value in zip(data_sheets.items(), wanted, strict=False):
        if value is not None and data_sheet.ranges:
            range_settings(f"sensor.{part}.range", value, {part: data_sheet.json_value})  # refuses an unknown range
            found.append(f"sensor.{part}.range={value:g}")
        elif value is not None:
            counts = data_sheet.counts_per_unit * data_sheet.full_scale / value
            found += [f"sensor.{part}.full_scale={value:g}", f"sensor.{part}.counts_per_unit={counts:.10g}"]
    return found


def assumed_figures(sensor: Sensor) -> str:
    """Return the sentence that lists the figures of a ``completed`` sensor from ``generic``; empty for none."""
    parts = [f"{', '.join(found)} of the {part}" for part in SENSORS if (found := sensor.of(part).assumed)]
    figures = ", and ".join(parts)
    stated = not parts or sensor.name == "generic"
    return "" if stated else f"the file of the sensor {sensor.name} does not state {figures}: generic's are used"


def without_overridden(sensor: dict[str, Any], keys: set[str]) -> dict[str, Any]:
    """Remove figures that an override states (``sensor.gyroscope.bias``) from the ``assumed`` list of a sensor."""
    for part in SENSORS:
        data_sheet = sensor.get(part) if isinstance(sensor, dict) else None
        data_sheet = data_sheet if isinstance(data_sheet, dict) else {}
        assumed = data_sheet.get("assumed")
        remaining = [key for key in assumed or () if f"sensor.{part}.{key}" not in keys]
        if assumed and len(remaining) < len(assumed):
            sensor = {**sensor, part: {**data_sheet, "assumed": remaining}}
    return sensor
