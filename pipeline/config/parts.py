"""Each stage's own part of the configuration, in a file that is named after its content.

A job cannot read a setting that is not in its part, and the name of the file is a parameter of its rule; so changing a
setting reruns exactly the stages that read it.
"""

from __future__ import annotations

import hashlib
import json
from typing import TYPE_CHECKING, Any

from pipeline.atomic import write_atomically
from pipeline.config.user_effects import effects_for

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

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
    "sensor.{sensor}.noise_density",
    "sensor.{sensor}.bias_wander",
    "sensor.{sensor}.wander_time_s",
)
SENSORS_AND_TABLE = ("sensor", "table", "procedure.holdout_every")
READS: dict[str, tuple[str, ...]] = {
    "ingest": (
        "ingest",
        "procedure.folder",
        "procedure.recordings",
        "sensor.axis_map",
        "sensor.accelerometer.full_scale",
        "sensor.gyroscope.full_scale",
    ),
    "filter": ("filter",),
    "fit": FIT,
    "effects": (*FIT, "effects.{sensor}", "sensor.{sensor}.effects"),
    "calibration": (
        "sensor.name",
        "sensor.axis_map",
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
    "gather": (),
}


def config_sha256(config: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a unit's whole configuration as canonical JSON, without what a certificate states."""
    return hashlib.sha256(_canonical({k: v for k, v in config.items() if k != "certificate"})).hexdigest()


def part(config: Mapping[str, Any], stage: str, sensor: str = "") -> dict[str, Any]:
    """Return what a stage reads of a unit's configuration.

    Parameters
    ----------
    config : mapping
        The unit's whole configuration.
    stage : str
        Key of ``READS``; other names are stages of a fit.
    sensor : str
        The sensor of a stage of a fit.
    """
    whole = {**config, "config_sha256": config_sha256(config)} if stage in ("calibration", "report") else config
    out: dict[str, Any] = {}
    for key in READS.get(stage, FIT):
        path = key.format(sensor=sensor).split(".")
        source: Any = whole
        target = out
        for step in path[:-1]:
            source = source[step]
            target = target.setdefault(step, {})
        target[path[-1]] = source[path[-1]]
    return out


def write_part(campaign: Campaign, stage: str, units: Sequence[str], sensor: str = "") -> str:
    """Write a stage's part of the configuration of some units, unless it is there; return the file's path."""
    content: dict[str, Any] = {"units": {u: part(campaign.units[u].config, stage, sensor) for u in units}}
    content |= effects_for(stage, sensor, [campaign.units[u].config for u in units])
    if stage in ("ingest", "report"):
        content["campaign"] = campaign.name
    if stage == "report":
        for unit in units:
            row = campaign.units[unit].row
            content["units"][unit] |= {
                "row": {c: row[c] for c in ("serial", "lot", "date") if row.get(c)},
                "command": campaign.command(unit),
            }
    if stage == "ingest":
        content["directory"] = str(campaign.recorded)
    if stage == "gather":
        content = {"campaign": campaign.name, "rows": {u: campaign.units[u].row for u in units}}
        content["compare"] = campaign.compare
        content["page"] = campaign.page
        compared = {u for c in campaign.compare for g in c["groups"] for u in g["units"]}
        content["truths"] = {u: str(campaign.truth(u)) for u in sorted(compared)}
    text = _canonical(content)
    name = f"{stage}-{sensor}" if sensor else stage
    path = campaign.results / "configs" / f"{name}-{hashlib.sha256(text).hexdigest()[:16]}.json"
    if not path.is_file():
        write_atomically(path, text)
    return str(path)


def _canonical(value: Any) -> bytes:  # noqa: ANN401  (any JSON value)
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
