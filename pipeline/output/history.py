"""Record the changes of each run of a campaign in ``results/<campaign>/history/<number>.json``.

The first file holds every unit. Each later file holds the units whose configuration, recordings or results differ from
the previous ones. A run that changes nothing writes no file.

The state of a unit is::

    {"status", "error", "config_sha256", "config": {section: digest}, "recordings": {file: digest},
     "overrides": {key: value}, "accelerometer": {"effects", "error", "floor", "vector_error", "vector_floor",
     "verdict", "selected", "uncertainty"} or null, "gyroscope": likewise}

where ``error`` is the held-out rms error of the magnitude after the last step, ``floor`` its noise floor, in g or
deg/s, ``vector_error`` and ``vector_floor`` the same of the vector, where the attitude is known, and ``uncertainty``
the largest expanded uncertainty of ``bias`` and ``matrix``. ``sections`` of an entry holds the values of each
configuration section that no earlier entry contains, by digest.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from imu_logs.units import SENSORS
from pipeline.core.errors import InputError, shortened
from pipeline.core.files import JSON, write_json
from pipeline.core.verdicts import Error, error_of

HISTORY_FOLDER = "history"
VALUES = "values"  # key of a state: the values of each configuration section
DIGEST_DIGITS = 16  # of a digest
MAX_VALUE_LENGTH = 60  # characters of a value; a longer one is cut and ends in its digest
NAMED_CHANGES = 4  # changed values and recordings that a text names


@dataclass(frozen=True)
class StateChange:
    """The differences between two states of a unit.

    ``added``, ``removed``: effects of each sensor; ``settings``: other overrides, each as ``key: before -> after``;
    ``other``: texts about recordings, values of the configuration and status.
    """

    added: dict[str, list[str]]
    removed: dict[str, list[str]]
    settings: list[str]
    other: list[str]

    def words(self, sensor: str | None = None) -> list[str]:
        """Return the change as a list of texts, with the effects of one sensor or of both."""
        effects = []
        for s in SENSORS if sensor is None else (sensor,):
            name = f"{s}." if sensor is None else ""
            effects += [f"+ {name}{effect}" for effect in self.added[s]]
            effects += [f"\N{MINUS SIGN} {name}{effect}" for effect in self.removed[s]]
        return [*effects, *self.settings, *self.other]


def digest(value: Any) -> str:  # noqa: ANN401  (any JSON value)
    """Return a digest of a value."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:DIGEST_DIGITS]


def flat(value: Any, above: str = "") -> dict[str, str]:  # noqa: ANN401  (any JSON value)
    """Flatten a section: return its values as texts, by dotted key."""
    if isinstance(value, dict) and (value or not above):
        return {k: v for key, part in value.items() for k, v in flat(part, f"{above}.{key}" if above else key).items()}
    text = value if isinstance(value, str) else json.dumps(value)
    if len(text) > MAX_VALUE_LENGTH:
        text = f"{text[: MAX_VALUE_LENGTH - DIGEST_DIGITS]}... ({digest(value)})"
    return {above: text}


def unit_state(
    calibration: JSON,
    validation: JSON | None,
    diagnosis: JSON | None,
    overrides: Mapping[str, str],
    config: Mapping[str, str] | None = None,
) -> JSON:
    """Return the state of a unit from its published documents.

    ``overrides``: key to value; ``config``: section of the configuration to digest.
    """
    error, files = (calibration.get("error") or {}).get("code"), calibration.get("inputs") or []
    state = {"status": calibration.get("status"), "error": error, "config_sha256": calibration.get("config_sha256")}
    recordings = {f["file"]: _digest(f) for f in files}
    state |= {"config": dict(config or {}), "recordings": recordings, "overrides": dict(overrides)}
    for sensor in SENSORS:
        fitted = calibration.get(sensor)
        held_out, diagnosed = (validation or {}).get(sensor) or {}, (diagnosis or {}).get(sensor) or {}
        last, error = (held_out.get("steps") or [{}])[-1], error_of(held_out)
        vector = {"vector_error": error.after, "vector_floor": error.floor} if error.kind == "vector" else {}
        state[sensor] = fitted and {
            "effects": [effect["name"] for effect in fitted.get("effects") or []],
            "error": last.get("rms_error"),
            "floor": held_out.get("noise_floor"),
            **vector,
            "verdict": diagnosed.get("verdict"),
            "selected": diagnosed.get("selected") or [],
            "uncertainty": _largest(fitted.get("expanded_uncertainty") or {}),
        }
    return state


def errors_of(states: Sequence[JSON], sensor: str) -> list[Error]:
    """Return the error of a sensor in each of some states: of the vector if all have it, else of the magnitude."""
    parts = [state.get(sensor) or {} for state in states]
    vector = all(part.get("vector_error") for part in parts if part.get("error"))
    kind, prefix = ("vector", "vector_") if vector else ("magnitude", "")
    return [Error(kind, None, part.get(f"{prefix}error"), part.get(f"{prefix}floor")) for part in parts]


def _digest(entry: JSON) -> str:
    """Return the digest of a recording: of its file and the files that are joined to it."""
    digests = [str(file.get("sha256")) for file in (entry, *entry.get("joined", []))]
    whole = digests[0] if len(digests) == 1 else hashlib.sha256("".join(digests).encode()).hexdigest()
    return whole[:DIGEST_DIGITS]


def _largest(uncertainty: Mapping[str, Any]) -> dict[str, float]:
    """Return the largest expanded uncertainty of bias and matrix, if they have one."""
    uncertainties = {key: np.asarray(uncertainty.get(key) or np.nan, float) for key in ("bias", "matrix")}
    return {key: float(np.nanmax(values)) for key, values in uncertainties.items() if np.isfinite(values).any()}


def read_history(results: Path) -> list[JSON]:
    """Return the history of a campaign, oldest entry first; ``InputError`` if a file is not an entry."""
    entries = []
    for file in sorted((results / HISTORY_FOLDER).glob("[0-9]*.json")):
        try:
            entry = json.loads(file.read_text(encoding="utf-8"))
            valid = isinstance(entry["run"], int) and isinstance(entry["units"], dict)
        except (OSError, ValueError, KeyError, TypeError):
            valid = False
        if not valid:
            raise InputError("is no history of runs: remove it, or the whole folder", str(file))
        entries.append(entry)
    return sorted(entries, key=lambda e: int(e["run"]))


def record(
    results: Path, units: Mapping[str, JSON], settings: Mapping[str, Any], sections: Mapping[str, Any] | None = None
) -> list[JSON]:
    """Append the states of the units (name to state) that differ from their last ones; return all entries.

    ``results``: folder of the campaign's results; ``settings``: of the run; ``sections``: of all configurations, by
    digest. Raises ``InputError`` like ``read_history``.
    """
    entries = read_history(results)
    last = {unit: states[-1][1] for unit, states in of_units(entries).items()}
    before = {unit: {k: v for k, v in state.items() if k != VALUES} for unit, state in last.items()}
    changed = {unit: state for unit, state in units.items() if before.get(unit) != state}
    gone = [unit for unit, state in before.items() if unit not in units and state]
    if changed or gone:
        number = entries[-1]["run"] + 1 if entries else 1
        now = datetime.now(UTC).isoformat(timespec="seconds")
        recorded = {key for entry in entries for key in entry.get("sections") or {}}
        needed = {key for state in changed.values() for key in (state.get("config") or {}).values()} - recorded
        new = {key: flat(section) for key, section in (sections or {}).items() if key in needed}
        entry = {"run": number, "time": now, "settings": {**settings}, "units": changed, "gone": gone, "sections": new}
        write_json(results / HISTORY_FOLDER / f"{number:04d}.json", entry)
        entries.append(entry)
    return entries


def of_units(entries: Sequence[JSON]) -> dict[str, list[tuple[int, JSON]]]:
    """Return the states of each unit, each with the number of its run; ``{}`` marks a unit that was removed."""
    histories: dict[str, list[tuple[int, JSON]]] = {}
    sections: JSON = {}
    for entry in entries:
        sections |= entry.get("sections") or {}
        for unit, state in entry["units"].items():
            values = {name: sections.get(key, {}) for name, key in (state.get("config") or {}).items()}
            histories.setdefault(unit, []).append((entry["run"], state | {VALUES: values}))
        for unit in entry.get("gone") or []:
            histories.setdefault(unit, []).append((entry["run"], {}))
    return histories


def difference(before: JSON, after: JSON) -> StateChange:
    """Return the differences between two states of a unit."""
    fitted = [{s: (state.get(s) or {}).get("effects") or [] for s in SENSORS} for state in (before, after)]
    calibrated = [state.get("status") == "ok" for state in (before, after)]
    added, removed = ({s: [e for e in a[s] if e not in b[s]] for s in SENSORS} for a, b in (fitted[::-1], fitted))
    if not all(calibrated):
        removed = {s: [] for s in SENSORS}
    old, new = (state.get("overrides") or {} for state in (before, after))
    keys = [k for k in dict.fromkeys([*old, *new]) if old.get(k) != new.get(k) and not k.startswith("effects")]
    settings = [f"{k}: {old.get(k, 'default')} \N{RIGHTWARDS ARROW} {new.get(k, 'default')}" for k in keys]
    other = []
    if before and calibrated == [True, False]:
        other.append(f"not calibrated: {after.get('error') or 'no longer in units.csv'}")
    elif before and calibrated == [False, True]:
        other.append("calibrated again")
    if all(calibrated) and before.get("recordings") != after.get("recordings"):
        other.append(_named("other recordings", _changed_recordings(before, after)))
    moved = before.get("config_sha256") != after.get("config_sha256")
    values = [v for v in _changed_values(before, after) if v.partition(":")[0] not in keys]
    if all(calibrated) and moved and (values or not (settings or any(added.values()) or any(removed.values()))):
        other.append(_named("other values in the files of the configuration", values))
    elif before and not (settings or other or any(added.values()) or any(removed.values())):
        other.append("computed again")
    return StateChange(added, removed, settings, other)


def _named(what: str, names: Sequence[str]) -> str:
    return f"{what}: {', '.join(shortened(names, NAMED_CHANGES))}" if names else what


def _changed_recordings(before: JSON, after: JSON) -> list[str]:
    """Return the files whose content differs; none if a state of an older version does not list its files."""
    old, new = before.get("recordings"), after.get("recordings")
    if not (isinstance(old, dict) and isinstance(new, dict)):
        return []
    return [file for file in dict.fromkeys([*old, *new]) if old.get(file) != new.get(file)]


def _changed_values(before: JSON, after: JSON) -> list[str]:
    """Return the values of the configuration that differ, except effects, each as ``key: before -> after``."""
    values = ((state.get(VALUES) or {}).items() for state in (before, after))
    old, new = ({f"{s}.{k}": v for s, part in each for k, v in part.items()} for each in values)
    keys = [k for k in dict.fromkeys([*old, *new]) if old.get(k) != new.get(k)] if old and new else []
    defined = {k for k in old.keys() ^ new.keys() if k.startswith("user_effects.")}  # effects, too
    keys = [k for k in keys if not k.startswith("effects.") and k not in defined]
    return [f"{k}: {old.get(k, 'absent')} \N{RIGHTWARDS ARROW} {new.get(k, 'absent')}" for k in keys]


def dropped(entries: Sequence[JSON]) -> dict[tuple[str, int], list[str]]:
    """Return the effects (``sensor.effect``) that the last run no longer has, by unit and run that had them.

    Another method has other effects: those of its stages are not lost.
    """
    lost, states = {}, of_units(entries)
    for unit in entries[-1]["units"]:
        if len(states[unit]) > 1:
            (run, before), (_, after) = states[unit][-2:]
            removed = difference(before, after).removed
            old, new = ((state.get("overrides") or {}).get("method") for state in (before, after))
            if old == new and (effects := [f"{sensor}.{effect}" for sensor in SENSORS for effect in removed[sensor]]):
                lost[unit, run] = effects
    return lost
