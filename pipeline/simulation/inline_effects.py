"""Effects that a description hides under a formula of its own, known to nobody else.

    effects:
      gyroscope.gear_mesh: {terms: {A: {formula: "cos(5 * radians(angle))", unit: deg/s}}, values: [0.03, 0.03, 0.03]}

The keys are those of an effect's file (``pipeline.model.effect_definition``), of which only ``terms`` is needed, and
``values``: of the parameters, one size, or nothing where there are ``limits``. It does not enter the catalogue: a
diagnosis meets it as something unknown.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.model.user_effects import effect_from
from pipeline.records import SENSORS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.model.effects.base import Effect


def inline_effects(specification: Mapping[str, Any]) -> tuple[dict[str, Effect], dict[str, Any]]:
    """Return the effects that are defined where they are hidden, and what is hidden with their values alone.

    Parameters
    ----------
    specification : mapping
        ``effects`` of a unit's description.

    Returns
    -------
    effects : dict of str to Effect
    specification : dict

    Raises
    ------
    ConfigurationError
        If a definition is not as it should be.
    """
    found: dict[str, Effect] = {}
    values: dict[str, Any] = {}
    for key, given in specification.items():
        values[key] = given
        if isinstance(given, dict):
            sensor, _, name = str(key).rpartition(".")
            usual = {"owner": "table", "sensors": [sensor] if sensor else list(SENSORS), "meaning": "Hidden."}
            definition = {"name": name, **usual, **{k: v for k, v in given.items() if k != "values"}}
            found[name] = effect_from(definition, f"effects: {key}")
            values[key] = given.get("values")
    return found, values
