"""The effects that a fit can hold: which are possible, plausible and available, and where their parameters start."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import ConfigurationError, NotObservableError
from pipeline.estimation.design import Term
from pipeline.model.effects import catalogue, effect
from pipeline.model.effects.base import parameter_limits
from pipeline.model.effects.sessions import OWN

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.observations import Observations
    from pipeline.model.effects.base import Effect
    from pipeline.records import SensorCalibration

SECOND = {"accelerometer": (), "gyroscope": ("table_encoder_error",)}  # exact look-alikes of a likelier effect


def parameter_names(sensor: str, effects: Sequence[Effect]) -> list[str]:
    """Return ``<effect>.<parameter>`` for each parameter."""
    return [f"{e.name}.{p.name}" for e in effects for p in e.parameters(sensor)]


def starts_of(names: Sequence[str], sensor: str, known: SensorCalibration | None = None) -> list[list[Term]]:
    """Return the terms from which a fit starts, every combination of the effects' starts.

    Parameters
    ----------
    names : sequence of str
    sensor : str
    known : SensorCalibration, optional
        Its fitted effects start where they are.

    Raises
    ------
    ConfigurationError
        If an effect is unknown, named twice, contained in another, or not one of this sensor.
    """
    if len(set(names)) != len(names):
        raise ConfigurationError(f"effects.{sensor} names an effect twice: {', '.join(names)}")
    for name in names:
        within = [n for n in effect(name).contains if n in names]
        if within:
            raise ConfigurationError(
                f"effects.{sensor} names {name} and {within[0]}, which it contains: name one of them"
            )
    fitted = {} if known is None else {e.name: e.values for e in known.effects}
    combinations: list[list[Term]] = [[]]
    for name in names:
        this = effect(name)
        if sensor not in this.sensors:
            raise ConfigurationError(
                f"effects.{sensor} names {name}, which is an effect of the {this.sensors[0]} alone"
            )
        values = [fitted[name]] if name in fitted else this.starts(sensor)
        combinations = [[*before, Term(this, v)] for before in combinations for v in values]
    return combinations


def limits_of(sensor: str, sheet: Mapping[str, Any]) -> dict[str, NDArray[np.float64]]:
    """Return the limits of plausibility of every effect's parameters, absolute values.

    Parameters
    ----------
    sensor : str
    sheet : mapping
        ``effects`` of the sensor's data sheet: ``<effect>`` for all its parameters, ``<effect>_<parameter>`` for one
        or, without the axis, for some of them.
    """
    given = sheet.get("effects") or {}
    found = {}
    for name, this in catalogue().items():
        limits = parameter_limits(this, sensor, given) if sensor in this.sensors else np.array([np.inf])
        if np.all(np.isfinite(limits)):
            found[name] = limits
    return found


def candidates_for(observations: Observations, configured: Sequence[str]) -> list[Effect]:
    """Return the effects that could be missing and whose needs the recordings meet."""
    found = []
    for name, this in catalogue().items():
        if name in configured or observations.sensor not in this.sensors or observations.sensor in this.unseen:
            continue
        if name == "earth_rotation" and observations.earth:
            continue
        if this.needs_clock and not observations.clock_shared:
            continue
        complete = all(part.motion.temperature is not None for part in observations.parts)
        if "temperature" in this.needs and not complete:
            continue
        if any(this.available(part.motion) for part in observations.parts):
            found.append(this)
    second = SECOND[observations.sensor]
    return sorted(found, key=lambda e: (e.name in second, e.name))


def require_available(observations: Observations, names: Sequence[str]) -> None:
    """Refuse effects whose needs the recordings do not meet.

    Raises
    ------
    NotObservableError
        Naming the effect and what to record.
    """
    setups = {part.motion.setup for part in observations.parts}
    for own in OWN:
        if setups <= {name.partition("@")[2] for name in names if name.startswith(f"{own}@")}:
            base = "matrix" if own == "mounting" else "bias"
            raise NotObservableError(
                f"{own} of its own in every setup ({', '.join(sorted(setups))}) cannot be told from the {base}: "
                "leave it out for one of them, the reference of the others"
            )
    for name in names:
        this = effect(name)
        lacking = [need for need in this.needs if all(getattr(p.motion, need) is None for p in observations.parts)]
        without = [p.name for p in observations.parts for need in this.needs if getattr(p.motion, need) is None]
        if lacking or ("temperature" in this.needs and without):
            raise NotObservableError(
                f"{name} needs {', '.join(lacking or ['temperature'])}, which "
                f"{'no recording holds' if lacking else 'is missing in ' + ', '.join(without)}; "
                f"record it, or take {name} out of effects.{observations.sensor}"
            )
        if this.needs_clock and not observations.clock_shared:
            raise NotObservableError(
                f"{name} needs the time between the recordings, but their times overlap (each starts at 0?): "
                f"record them on one clock, or take {name} out of effects.{observations.sensor}"
            )
