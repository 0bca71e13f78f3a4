"""Settings for tests: shipped options with other values, and an ideal sensor, table and procedure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.core.settings import SECTIONS, DataSheet, Filter, Ingest, Procedure, Section, Sensor, Settings, Table
from pipeline.estimation.noise import with_noises
from pipeline.simulation.description import shipped_settings

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.core.records import Recording, UnitRecordings

IDEAL_SHEET = {
    "full_scale": 1e6,
    "counts_per_unit": 1e12,
    "noise_density": 1e-12,
    "bias_wander": 0.0,
    "wander_time_s": 100.0,
    "bias": 1.0,
    "scale_factor": 0.1,
    "cross_axis": 0.1,
    "effects": {},
}
IDEAL: dict[str, Section] = {
    "sensor": Sensor.model_validate(
        {"name": "ideal", "axis_map": ["+x", "+y", "+z"], "accelerometer": IDEAL_SHEET, "gyroscope": IDEAL_SHEET}
    ),
    "table": Table.model_validate(
        {
            "name": "ideal",
            "motion": "logged",
            "gravity_g": 1.0,
            "latitude_deg": None,
            "azimuth_deg": None,
            "angle_accuracy_deg": 0.0,
            "rate_accuracy": 0.0,
            "orthogonality_deg": 0.0,
        }
    ),
    "procedure": Procedure.model_validate(
        {"name": "ideal", "table": "ideal", "folder": "{unit}", "recordings": {}, "holdout_every": 0}
    ),
}


def sheet_of(**values: Any) -> DataSheet:
    """Return the figures of an ideal sensor with other values."""
    return DataSheet.model_validate(IDEAL_SHEET | values)


def settings_of(base: Settings | None = None, /, **values: Any) -> Settings:
    """Return settings with other values.

    ``base``: shipped defaults with the ideal sensor, table and procedure, if none is given. ``values``: by section, the
    name of a shipped option, a section, or other values by their name, at any depth; ``**{"table.gravity_g": 1.01}`` is
    one value.
    """
    found = base or shipped_settings().replaced(**IDEAL)
    options = {name: value for name, value in values.items() if isinstance(value, str) and name in SECTIONS}
    shipped = shipped_settings(**options)
    found = found.replaced(**{name: getattr(shipped, name) for name in options})
    for path, value in values.items():
        section, *keys = path.split(".")
        if isinstance(value, Section) and not keys:
            found = found.replaced(**{section: value})
        elif path not in options:
            other = value
            for key in reversed(keys):
                other = {key: other}
            content = _merged(getattr(found, section).json_value, other)
            found = found.replaced(**{section: SECTIONS[section].model_validate(content, strict=False)})
    return found


def filter_of(name: str, /, **values: Any) -> Filter:
    """Return a shipped filter with other values, which are not checked."""
    return shipped_settings(filter=name).filter.replaced(**values)


def ingest_of(content: Mapping[str, Any]) -> Ingest:
    """Return an ingest profile from the content of its file."""
    return Ingest.model_validate(
        {"name": "test", **{k: v for k, v in content.items() if v is not None and k != "defaults"}}
    )


def _merged(content: Any, values: Any) -> Any:
    """Return a JSON value in which other values replace those of the same name."""
    if not (isinstance(content, dict) and isinstance(values, dict)):
        return values
    return content | {name: _merged(content.get(name), value) for name, value in values.items()}


def with_noise(recordings: Sequence[Recording], settings: Settings) -> UnitRecordings:
    """Return recordings with their noise, as the step filter does."""
    return with_noises(recordings, settings.sensor)
