"""The plan of a procedure as a document: what it would find of each effect, and what to record more.

    {"sensor", "table", "procedure", "course": {how it is run}, "at_a_table", "minutes", "samples", "warnings": [text],
     "accelerometer": {"noise": {"white", "wander"}, "unit",
        "effects": [{"effect", "smallest", "unit", "share_of_limit", "almost_sure", "named", "sizes", "taken_for",
                      "look_alikes": [{"effect", "share"}]}],
        "not_observable": [{"effect", "reason"}], "reason": null | why nothing can be planned},
     "gyroscope": {...}}

Sizes are those that half of the units would show. An effect that would pass only beyond its limit is not observable.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.diagnosis.by_hand_hidden import hidden_effects
from pipeline.diagnosis.observability import not_observable
from pipeline.errors import NotObservableError
from pipeline.estimation.multi_position.rests import by_hand
from pipeline.estimation.observations import observe
from pipeline.estimation.selection import unselected
from pipeline.model.effects import effect
from pipeline.model.effects.base import Owner
from pipeline.planning.expectation import Expectation
from pipeline.planning.extra import changes
from pipeline.planning.rehearsal import limits_broken, rehearse
from pipeline.records import SENSORS
from pipeline.simulation.campaign import course_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.planning.by_hand import HandExpectation
    from pipeline.planning.detection import Detection
    from pipeline.planning.extra import Change
    from pipeline.planning.rehearsal import Rehearsal
    from pipeline.simulation.description import UnitDescription
    from pipeline.simulation.planned import Planned

UNITS = {"accelerometer": "g", "gyroscope": "deg/s"}
Document = dict[str, Any]


def plan_of(unit: UnitDescription, extra: Sequence[Planned] = (), *, half_only: bool = False) -> Document:
    """Return the plan of a procedure.

    Parameters
    ----------
    unit : UnitDescription
        Sensor, table, procedure, course and sampling.
    extra : sequence of Planned
        Further recordings.
    half_only : bool
        Leave out ``almost_sure`` and ``named``.

    Raises
    ------
    ConfigurationError
        If a name is not known or the course cannot be run.
    """
    rehearsal = rehearse(unit, extra)
    return {
        "sensor": unit.sensor,
        "table": unit.table,
        "procedure": unit.procedure,
        "course": {name: _plain(value) for name, value in asdict(course_of(unit)).items()},
        "at_a_table": rehearsal.table["motion"] != "none",
        "minutes": rehearsal.minutes,
        "samples": sum(r.samples for r in rehearsal.recordings),
        "warnings": limits_broken(rehearsal),
        **{sensor: of_sensor(sensor, rehearsal, half_only=half_only) for sensor in SENSORS},
    }


def _plain(value: Any) -> Any:  # noqa: ANN401  (a setting)
    return list(value) if isinstance(value, tuple) else value


def of_sensor(sensor: str, rehearsal: Rehearsal, *, half_only: bool = False) -> Document:
    """Return the plan of one sensor: what it would find in the recordings of a rehearsal."""
    noise = rehearsal.noise[sensor]
    document: Document = {
        "unit": UNITS[sensor],
        "noise": {"white": float(noise.white[0]), "wander": float(noise.wander[0])},
        "effects": [],
        "not_observable": [],
        "reason": None,
    }
    try:
        expectation, hidden = _expectation(sensor, rehearsal)
    except NotObservableError as error:
        return {**document, "reason": error.message}
    for name in sorted(set(expectation.names) - set(hidden)):
        found = expectation.detection(name, half_only=half_only)
        assert found is not None  # noqa: S101  (what the motion does not excite is hidden)
        limited = bool(np.isfinite(expectation.limits[name]).any())
        if limited and found.found > 1.0:
            hidden[name] = _faint(sensor, found)
        else:
            document["effects"].append(_entry(sensor, found, limited=limited))
    document["not_observable"] = [{"effect": n, "reason": hidden[n]} for n in sorted(hidden)]
    return document


def _expectation(sensor: str, rehearsal: Rehearsal) -> tuple[Expectation | HandExpectation, dict[str, str]]:
    """Return what a selection is expected to see, and the effects that it cannot, each with the reason."""
    noise, sheet = rehearsal.noise[sensor], rehearsal.sheets[sensor]
    if by_hand(sensor, rehearsal.recordings):
        from pipeline.planning.by_hand import HandExpectation, select_by_hand  # noqa: PLC0415  (by hand alone)

        selected = select_by_hand(sensor, rehearsal)
        hand = HandExpectation(selected, noise)
        return hand, hidden_effects(selected, [])
    selection = unselected(observe(sensor, rehearsal.recordings, rehearsal.table), [], noise, sheet)
    return Expectation(selection, noise), not_observable(selection, [])


def _entry(sensor: str, found: Detection, *, limited: bool) -> Document:
    parameters = effect(found.effect).parameters(sensor)
    sizes = {p.name: found.found * float(u) for p, u in zip(parameters, found.unit_sizes, strict=True) if u}
    first = float(found.unit_sizes[0])
    return {
        "effect": found.effect,
        "smallest": found.found * first,
        "unit": parameters[0].unit,
        "share_of_limit": found.found if limited else None,
        "almost_sure": _finite(found.sure * first),
        "named": _finite(found.named * first),
        "sizes": sizes,
        "taken_for": found.taken_for,
        "look_alikes": [{"effect": n, "share": s} for n, s in found.look_alikes.items()],
    }


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _faint(sensor: str, found: Detection) -> str:
    this = effect(found.effect)
    unit = this.parameters(sensor)[0].unit
    limit = f"{found.unit_sizes[0]:.2g}{'' if unit == '1' else ' ' + unit}"
    times = f", {found.found:.2g} times that would show" if np.isfinite(found.found) else ""
    return f"even at its limit of {limit} it would hide in the noise{times}; it needs {this.excitation}"


@dataclass(frozen=True)
class Gain:
    """What a change would bring.

    Attributes
    ----------
    change : Change
    minutes : float
        More at the table.
    shown : tuple of str
        ``sensor.effect`` that become observable; one of the table only if neither sensor showed it.
    told : tuple of str
        Those that would no longer be taken for a look-alike.
    factor : float
        Geometric mean of the new smallest sizes over the old ones, of effects that are observable in both.
    """

    change: Change
    minutes: float
    shown: tuple[str, ...]
    told: tuple[str, ...]
    factor: float


def best_changes(unit: UnitDescription, before: Document) -> list[Gain]:
    """Return what each change would bring, the most helpful first.

    First goes the change that shows most effects for each minute that it takes (at least one: nothing is set up in
    less); of those that show nothing new, the one that lowers the smallest sizes most, as a logarithm a minute.

    Parameters
    ----------
    unit : UnitDescription
    before : dict
        Its plan.
    """
    if all(before[sensor]["reason"] for sensor in SENSORS):
        return []
    gains = [_gain(change, before, plan_of(change.unit, change.extra, half_only=True)) for change in changes(unit)]
    return sorted(gains, key=_worth)


def _worth(gain: Gain) -> tuple[float, float]:
    """Return what sorts the most helpful change first."""
    minutes = max(gain.minutes, 1.0)
    return -len(gain.shown) / minutes, float(np.log(gain.factor)) / minutes


def _gain(change: Change, before: Document, after: Document) -> Gain:
    old, new = _entries(before), _entries(after)
    both = old.keys() & new.keys()
    ratios = [np.log(new[key]["smallest"] / old[key]["smallest"]) for key in sorted(both)]
    return Gain(
        change,
        after["minutes"] - before["minutes"],
        tuple(key for key in new if key not in old and not _shared(key, old)),
        tuple(key for key in new if key in both and old[key]["taken_for"] and not new[key]["taken_for"]),
        float(np.exp(np.mean(ratios))) if ratios else 1.0,
    )


def _shared(key: str, old: Mapping[str, Any]) -> bool:
    """Return whether an effect is the table's and the other sensor shows it already."""
    name = key.partition(".")[2]
    return effect(name).owner == Owner.TABLE and any(other.partition(".")[2] == name for other in old)


def _entries(document: Mapping[str, Any]) -> dict[str, Document]:
    """Return the observable effects by ``sensor.effect``."""
    return {f"{s}.{entry['effect']}": entry for s in SENSORS for entry in document[s]["effects"]}
