"""What each run of a campaign changed: ``results/<campaign>/history/<number>.json``.

The first file holds every unit, each later file the units whose configuration, recordings or results differ from those
before, so that a fleet's history grows with what changes. A run that changes nothing writes no file.

A unit's state is::

    {"status", "error", "config_sha256", "recordings", "overrides": {key: value},
     "accelerometer": {"effects", "error", "floor", "verdict", "selected"} or null, "gyroscope": likewise}

where ``error`` is the held-out rms error of the last step and ``floor`` its noise floor, in g or deg/s, and
``recordings`` is a digest of the digests of the files that were read.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from pipeline.errors import InputError
from pipeline.files import write_json

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

JSON = dict[str, Any]
FOLDER = "history"
SENSORS = ("accelerometer", "gyroscope")


@dataclass(frozen=True)
class Change:
    """What differs between two states of a unit.

    ``added``, ``removed``: effects of each sensor; ``settings``: others, each as ``key: before -> after``; ``other``:
    recordings, configuration, whether the unit was calibrated.
    """

    added: dict[str, list[str]]
    removed: dict[str, list[str]]
    settings: list[str]
    other: list[str]

    def words(self, sensor: str | None = None) -> list[str]:
        """Return the change as a list of texts, of the effects of one sensor or of both."""
        told = []
        for s in SENSORS if sensor is None else (sensor,):
            name = f"{s}." if sensor is None else ""
            told += [f"+ {name}{effect}" for effect in self.added[s]]
            told += [f"\N{MINUS SIGN} {name}{effect}" for effect in self.removed[s]]
        return [*told, *self.settings, *self.other]


def unit_state(
    calibration: JSON, validation: JSON | None, diagnosis: JSON | None, overrides: Mapping[str, str]
) -> JSON:
    """Return the state of a unit, from its published documents and the overrides of its settings (key to value)."""
    files = "".join(str(f.get("sha256")) for f in calibration.get("inputs") or [])
    state = {
        "status": calibration.get("status"),
        "error": (calibration.get("error") or {}).get("code"),
        "config_sha256": calibration.get("config_sha256"),
        "recordings": hashlib.sha256(files.encode()).hexdigest()[:16] if files else None,
        "overrides": dict(overrides),
    }
    for sensor in SENSORS:
        fitted = calibration.get(sensor)
        held_out, found = (validation or {}).get(sensor) or {}, (diagnosis or {}).get(sensor) or {}
        last = (held_out.get("steps") or [{}])[-1]
        state[sensor] = fitted and {
            "effects": [effect["name"] for effect in fitted.get("effects") or []],
            "error": last.get("rms_error"),
            "floor": held_out.get("noise_floor"),
            "verdict": found.get("verdict"),
            "selected": found.get("selected") or [],
        }
    return state


def read_history(results: Path) -> list[JSON]:
    """Return the entries of a campaign's results, the oldest first; ``InputError`` where a file is no such entry."""
    entries = []
    for file in sorted((results / FOLDER).glob("[0-9]*.json")):
        try:
            entry = json.loads(file.read_text(encoding="utf-8"))
            known = isinstance(entry["run"], int) and isinstance(entry["units"], dict)
        except (OSError, ValueError, KeyError, TypeError):
            known = False
        if not known:
            raise InputError("is no history of runs: remove it, or the whole folder", str(file))
        entries.append(entry)
    return sorted(entries, key=lambda e: int(e["run"]))


def record(results: Path, units: Mapping[str, JSON], settings: Mapping[str, Any]) -> list[JSON]:
    """Append the states of the units (name to state) that differ from the last ones; return all entries.

    ``results`` are those of the campaign, ``settings`` those of the run. Raises ``InputError`` as ``read_history``.
    """
    entries = read_history(results)
    before = {unit: states[-1][1] for unit, states in of_units(entries).items()}
    changed = {unit: state for unit, state in units.items() if before.get(unit) != state}
    gone = [unit for unit, state in before.items() if unit not in units and state]
    if changed or gone:
        number = entries[-1]["run"] + 1 if entries else 1
        now = datetime.now(UTC).isoformat(timespec="seconds")
        entry = {"run": number, "time": now, "settings": dict(settings), "units": changed, "gone": gone}
        write_json(results / FOLDER / f"{number:04d}.json", entry)
        entries.append(entry)
    return entries


def of_units(entries: Sequence[JSON]) -> dict[str, list[tuple[int, JSON]]]:
    """Return the states of each unit with the run that brought them; ``{}`` stands for a unit that has gone."""
    found: dict[str, list[tuple[int, JSON]]] = {}
    for entry in entries:
        for unit, state in entry["units"].items():
            found.setdefault(unit, []).append((entry["run"], state))
        for unit in entry.get("gone") or []:
            found.setdefault(unit, []).append((entry["run"], {}))
    return found


def difference(before: JSON, after: JSON) -> Change:
    """Return what differs in the configuration and the recordings of a unit."""
    fitted = [{s: (state.get(s) or {}).get("effects") or [] for s in SENSORS} for state in (before, after)]
    calibrated = [state.get("status") == "ok" for state in (before, after)]
    added, removed = (
        {s: [e for e in one[s] if e not in other[s]] for s in SENSORS} for one, other in (fitted[::-1], fitted)
    )
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
        other.append("other recordings")
    moved = before.get("config_sha256") != after.get("config_sha256")
    if all(calibrated) and moved and not (settings or any(added.values()) or any(removed.values())):
        other.append("other values in the files of the configuration")
    elif before and not (settings or other or any(added.values()) or any(removed.values())):
        other.append("computed again")
    return Change(added, removed, settings, other)


def dropped(entries: Sequence[JSON]) -> dict[tuple[str, int], list[str]]:
    """Return the effects (``sensor.effect``) that the last run no longer has, by unit and the run that had them."""
    found, states = {}, of_units(entries)
    for unit in entries[-1]["units"]:
        if len(states[unit]) > 1:
            (run, before), (_, after) = states[unit][-2:]
            removed = difference(before, after).removed
            if effects := [f"{sensor}.{effect}" for sensor in SENSORS for effect in removed[sensor]]:
                found[unit, run] = effects
    return found
