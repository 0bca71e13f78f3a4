"""Each stage's own part of the configuration, in a file that is named after its content.

A job cannot read a setting that is not in its part, and the name of the file is a parameter of its rule; so changing a
setting reruns exactly the stages that read it. What is the same for all units of a batch stands in it once.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

from pipeline.config.user_effects import effects_for
from pipeline.files import write_atomically

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from pipeline.config.campaign import Campaign

# Dotted keys that a stage reads; {sensor} is the sensor that the stage is about.
ACCURACIES = (
    "angle_accuracy_deg",
    "rate_accuracy",
    "orthogonality_deg",
    "wobble_deg",
    "levelling_deg",
    "gravity_accuracy_g",
    "azimuth_accuracy_deg",
    "clock_accuracy_ppm",
)
BOTH = ("accelerometer", "gyroscope")
NOISE = ("noise_density", "bias_wander", "wander_time_s")
FIT = (
    "table.motion",
    "table.gravity_g",
    "table.latitude_deg",
    "table.azimuth_deg",
    *(f"table.{key}" for key in ACCURACIES),
    "procedure.holdout_every",
    "method.{sensor}",
    "method.as_printed",
    "sensor.{sensor}.full_scale",
    "sensor.{sensor}.counts_per_unit",
    *(f"sensor.{{sensor}}.{key}" for key in NOISE),
    *(f"sensor.{{sensor}}.effects.{key}" for key in ("bias_temperature", "scale_factor_temperature")),
    *(f"sensor.{{sensor}}.{key}" for key in ("repeatability_bias", "repeatability_scale_factor")),
    "sensor.temperature_accuracy_degc",
    "uncertainty.monte_carlo",
)
SENSORS_AND_TABLE = ("sensor", "table", "procedure.holdout_every")
# Effects that explain a departure of table, clock or gyroscope, whose limits the checks of the recordings read.
LIMITS_OF_CHECKS = (
    "time_offset",
    "low_pass_lag",
    "clock_rate",
    "table_encoder_error",
    "table_rate_ripple",
    "table_backlash",
    "table_tilt",
    "table_axis_nonorthogonality",
    "g_sensitivity",
    "g_squared_sensitivity",
    "bias_drift",
    "bias_temperature",
    "warm_up",
)
READS: dict[str, tuple[str, ...]] = {
    "ingest": (
        "ingest",
        "procedure.folder",
        "procedure.recordings",
        "procedure.mounting_tolerance_deg",
        "table.motion",
        "table.rate_accuracy",
        "table.sense",
        "table.zero_deg",
        "table.angle_accuracy_deg",
        "table.orthogonality_deg",
        "sensor.axis_map",
        *(f"sensor.{sensor}.{key}" for sensor in BOTH for key in ("axis_map", "full_scale")),
        *(f"sensor.{sensor}.effects.{name}" for sensor in BOTH for name in LIMITS_OF_CHECKS),
        *(f"sensor.{sensor}.{key}" for sensor in BOTH for key in ("bias", "scale_factor", "cross_axis", *NOISE)),
        "table.gravity_g",
    ),
    "filter": ("filter", *(f"sensor.{sensor}.{key}" for sensor in BOTH for key in NOISE)),
    "fit": FIT,
    "effects": (*FIT, "effects.{sensor}", "sensor.{sensor}.effects"),
    "calibration": (
        "sensor.name",
        "sensor.axis_map",
        "sensor.accelerometer",
        "sensor.gyroscope",
        "table.name",
        "procedure.name",
        "method",
        "ingest.csv",
        "ingest.mcap",
        "config_sha256",
    ),
    "validate": (*SENSORS_AND_TABLE, "limits"),
    "diagnose": (*SENSORS_AND_TABLE, "effects", "method"),
    "export": ("sensor", "table.gravity_g"),
    "report": (
        "sensor",
        "table",
        "procedure",
        "method",
        "filter",
        "ingest",
        "effects",
        "limits",
        "certificate",
        "config_sha256",
    ),
}
WITH_DIGEST = [stage for stage, keys in READS.items() if "config_sha256" in keys]


def config_sha256(config: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a unit's whole configuration as canonical JSON, without what a certificate states."""
    return hashlib.sha256(_canonical({k: v for k, v in config.items() if k != "certificate"})).hexdigest()


def select_settings(config: Mapping[str, Any], stage: str, sensor: str = "") -> dict[str, Any]:
    """Return what a stage reads of a unit's configuration.

    Parameters
    ----------
    config : mapping
        The unit's whole configuration, with its digest for those stages that read it.
    stage : str
        Key of ``READS``; other names are stages of a fit.
    sensor : str
        The sensor of a stage of a fit.
    """
    out: dict[str, Any] = {}
    for *branch, leaf in _paths(stage, sensor):
        source: Any = config
        target = out
        for step in branch:
            source = source[step]
            target = target.setdefault(step, {})
        if leaf in source or branch[-1:] != ["effects"]:  # a data sheet need not limit every effect
            target[leaf] = source[leaf]
    return out


@cache
def _paths(stage: str, sensor: str) -> list[list[str]]:
    return [key.format(sensor=sensor).split(".") for key in READS.get(stage, FIT)]


@dataclass(frozen=True)
class SettingsFile:
    """A stage's part of the configuration of some units, as a file that is named after its content."""

    path: Path
    content: bytes

    def write(self) -> str:
        """Write the file, unless it is there unchanged; return its path."""
        if not self.path.is_file() or self.path.read_bytes() != self.content:
            write_atomically(self.path, self.content)
        return str(self.path)


def settings_file(
    campaign: Campaign, stage: str, units: Sequence[str], sensor: str = "", again: int = 0
) -> SettingsFile:
    """Return a stage's part of the configuration of some units.

    Parameters
    ----------
    campaign : Campaign
    stage : str
        Key of ``READS``; other names are stages of a fit.
    units : sequence of str
    sensor : str
        The sensor of a stage of a fit.
    again : int
        How often the job is repeated because what it wrote has been changed (``pipeline.results_folder``).
    """
    if stage == "gather":
        content = _of_gather(campaign)
    else:
        rows = [campaign.units[u] for u in units]
        digests = [{"config_sha256": r.config_sha256} if stage in WITH_DIGEST else {} for r in rows]
        parts = {r.name: select_settings(r.config | d, stage, sensor) for r, d in zip(rows, digests, strict=True)}
        if stage == "report":
            for unit, each in parts.items():
                row = campaign.units[unit].row
                each["row"] = {c: row[c] for c in ("serial", "lot", "date") if row.get(c)}
                each["run"] = campaign.run_settings(unit)
        content = dict(zip(("common", "units"), in_common(parts), strict=True))
        content |= effects_for(stage, sensor, [r.config for r in rows])
    if stage in ("ingest", "report"):
        content["campaign"] = campaign.name
    if stage == "ingest":
        content["directory"] = str(campaign.recorded)
    if again:
        content["again"] = again
    text = _canonical(content)
    name = f"{stage}-{sensor}" if sensor else stage
    path = campaign.results / "configs" / f"{name}-{hashlib.sha256(text).hexdigest()[:16]}.json"
    return SettingsFile(path, text)


def in_common(parts: Mapping[str, dict[str, Any]]) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """Split the parts of units in what all of them have, and what each has beside it.

    ``pipeline.stages.batch.merge_common`` puts them together again.
    """
    if len(parts) < 2:
        return {}, dict(parts)
    first, *others = parts.values()
    shared: dict[str, Any] = {}
    own = {unit: dict(each) for unit, each in parts.items()}
    for key, value in first.items():
        if all(key in each and each[key] == value for each in others):
            shared[key] = value
            for each in own.values():
                del each[key]
        elif all(isinstance(each.get(key), dict) for each in parts.values()):
            shared[key], below = in_common({unit: each[key] for unit, each in parts.items()})
            for unit, each in own.items():
                each[key] = below[unit]
    return shared, own


def _of_gather(campaign: Campaign) -> dict[str, Any]:
    compared = {u for c in campaign.compare for g in c["groups"] for u in g["units"]}
    return {
        "campaign": campaign.name,
        "batches": campaign.batches,
        "rows": [unit.row for unit in campaign.units.values()],
        "overrides": {name: unit.overrides for name, unit in campaign.units.items() if unit.overrides},
        "run": campaign.run_settings(),
        "compare": campaign.compare,
        "page": campaign.page,
        "truths": {u: str(campaign.truth(u)) for u in sorted(compared)},
    }


def _canonical(value: Any) -> bytes:  # noqa: ANN401  (any JSON value)
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
