"""A unit's calibration as an object that compensates arrays, logs and streams.

    truth = matrix @ (reading - bias - sum of effects(truth))        (solved in ``pipeline.model.inversion``)

Effects look at the other signals of the same log, calibrated too. Everything is causal, so that a log in one piece, the
same log in blocks and the samples of a running sensor one by one give the same numbers.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pipeline.errors import ConfigurationError, InputError, MissingInputError
from pipeline.model.effects import register
from pipeline.model.inversion import compensate, sensor_effects, solve
from pipeline.model.log_motion import SIGNALS, LineThroughThePast, LogState, fields_used, log_motion
from pipeline.model.user_effects import effect_of
from pipeline.records import SENSORS, SensorCalibration

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pipeline.records import FittedEffect, Motion

    Truths = dict[str, NDArray[np.float64]]

__all__ = ["Compensated", "Compensation", "CompensationStream", "compensate", "load"]

SMOOTHING_S = 3.0


class Compensated(NamedTuple):
    """Specific force, g, and angular rate, deg/s, of the body; None for a sensor that was not given."""

    accelerometer: NDArray[np.float64] | None
    gyroscope: NDArray[np.float64] | None


@dataclass(frozen=True)
class Compensation:
    """The calibration of a unit, ready to be applied to arrays.

    Attributes
    ----------
    accelerometer, gyroscope : SensorCalibration or None
        None where the unit's sensor is not calibrated: its readings pass through unchanged.
    unit : str
        Name of the unit.
    """

    accelerometer: SensorCalibration | None
    gyroscope: SensorCalibration | None
    unit: str = ""

    def apply(
        self,
        accelerometer: Any = None,  # noqa: ANN401  (what numpy takes for an array)
        gyroscope: Any = None,  # noqa: ANN401
        temperature: Any = None,  # noqa: ANN401
        time: Any = None,  # noqa: ANN401
        *,
        smoothing: float = SMOOTHING_S,
    ) -> Compensated:
        """Return the calibrated readings of a log, or of a single sample.

        Parameters
        ----------
        accelerometer : (n, 3) or (3,) array, g, optional
        gyroscope : (n, 3) or (3,) array, deg/s, optional
        temperature : (n,) array or float, degC, optional
            Needed where a fitted effect depends on it.
        time : (n,) array or float, s since power-on, optional
            Likewise; also with it the temperature is smoothed, causally.
        smoothing : float, s
            Memory of the line through the temperature's past (``pipeline.model.log_motion``); 0 takes it as it is.

        Returns
        -------
        Compensated
            ``accelerometer, gyroscope``, each of the shape that was given.

        Raises
        ------
        InputError
            If neither sensor is given, shapes do not match, or an effect needs a signal that is not given.
        """
        return self.stream(smoothing).apply(accelerometer, gyroscope, temperature, time)

    def stream(self, smoothing: float = SMOOTHING_S) -> CompensationStream:
        """Return an object whose ``apply`` takes a log block by block, with the same result as in one piece."""
        return CompensationStream(self, smoothing)

    def calibration(self, sensor: str) -> SensorCalibration | None:
        """Return the calibration of ``accelerometer`` or ``gyroscope``."""
        return self.accelerometer if sensor == "accelerometer" else self.gyroscope


@dataclass
class CompensationStream:
    """Compensation of one log, block after block."""

    compensation: Compensation
    smoothing: float = SMOOTHING_S
    _state: LogState = field(init=False)
    _effects: dict[str, list[FittedEffect]] = field(init=False)
    _used: dict[str, set[str]] = field(init=False)
    _signals: dict[str, dict[str, set[str]]] = field(init=False)

    def __post_init__(self) -> None:
        """Find out once what the effects need."""
        known = {s: self.compensation.calibration(s) for s in SENSORS}
        self._effects = {s: [] if c is None else sensor_effects(c) for s, c in known.items()}
        looked_at = {s: {e.name: fields_used(s, [e]) for e in effects} for s, effects in self._effects.items()}
        self._used = {s: set().union(*of.values()) for s, of in looked_at.items()}
        self._signals = {
            s: {name: set().union(*(SIGNALS[f] for f in used)) for name, used in of.items()}
            for s, of in looked_at.items()
        }
        self._state = LogState(LineThroughThePast(self.smoothing))

    def apply(
        self,
        accelerometer: Any = None,  # noqa: ANN401
        gyroscope: Any = None,  # noqa: ANN401
        temperature: Any = None,  # noqa: ANN401
        time: Any = None,  # noqa: ANN401
    ) -> Compensated:
        """Return the calibrated readings of the next block; parameters as of ``Compensation.apply``."""
        given = {"accelerometer": accelerometer, "gyroscope": gyroscope, "temperature": temperature, "time": time}
        arrays, single = _checked(given)
        self._require(arrays)
        n = len(next(iter(arrays.values())))
        if n == 0:
            return Compensated(arrays.get("accelerometer"), arrays.get("gyroscope"))
        present = {s: arrays[s] for s in SENSORS if s in arrays}
        used = set().union(*(self._used[s] for s in present))
        clock = arrays.get("time", np.zeros(n))
        warmth = arrays.get("temperature")
        if warmth is not None and "time" in arrays and "temperature" in used and self.smoothing > 0:
            warmth = self._state.smoothing.follow(clock, warmth)
        nothing = np.zeros((n, 3))

        def felt(truths: Truths) -> Motion:
            force, rate = truths.get("accelerometer", nothing), truths.get("gyroscope", nothing)
            return log_motion(
                clock, specific_force=force, angular_rate=rate, temperature=warmth, used=used, state=self._state
            )

        parts = {s: (self.compensation.calibration(s), self._effects[s]) for s in present}
        truths = solve(parts, present, felt)
        self._state.keep(felt(truths))
        shaped = {s: value[0] if single else value for s, value in truths.items()}
        return Compensated(shaped.get("accelerometer"), shaped.get("gyroscope"))

    def _require(self, arrays: dict[str, NDArray[np.float64]]) -> None:
        for sensor in SENSORS:
            if sensor not in arrays:
                continue
            for name, signals in self._signals[sensor].items():
                missing = sorted(signals - set(arrays))
                if missing:
                    raise InputError(
                        f"the {sensor} of unit {self.compensation.unit} was calibrated with the effect {name}, "
                        f"which needs {' and '.join(missing)}: give that too, or calibrate without the effect"
                    )


def load(path: str | Path, python_effects: Sequence[str | Path] = ()) -> Compensation:
    """Read ``calibrations/<unit>.json``.

    Parameters
    ----------
    path : str or Path
    python_effects : sequence of str or Path
        Files of the effects in Python with which it was made; those from formulas come with the calibration.

    Raises
    ------
    InputError
        If the file does not exist, is no calibration, or is the record of a failed unit.
    ConfigurationError
        If a sensor's effect is one in Python whose file is not given.
    """
    if python_effects:
        from pipeline.model.effect_files import load_python_effect  # noqa: PLC0415  (only where there are any)

        for python_file in python_effects:
            register(load_python_effect(python_file))
    file = Path(path)
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise MissingInputError("there is no such calibration", str(file)) from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputError(f"this is no calibration of a unit: {error}", str(file)) from None
    if not isinstance(data, dict) or "status" not in data:
        raise InputError("this is no calibration of a unit: it has no status", str(file))
    if data["status"] != "ok":
        cause = (data.get("error") or {}).get("message", "unknown")
        raise InputError(f"unit {data.get('unit')} failed and has no calibration; cause: {cause}", str(file))
    try:
        parts = {s: None if data.get(s) is None else SensorCalibration.from_json(s, data[s]) for s in SENSORS}
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"this is no calibration of a unit: {error!r}", str(file)) from None
    for c in filter(None, parts.values()):
        _check_calibration(c, str(file))
    return Compensation(parts["accelerometer"], parts["gyroscope"], str(data.get("unit", "")))


def _check_calibration(c: SensorCalibration, file: str) -> None:
    """Refuse numbers that are none, and an effect that is not at hand."""
    if c.bias.shape != (3,) or c.matrix.shape != (3, 3) or not np.isfinite([*c.bias, *c.matrix.flat]).all():
        raise InputError(f"the {c.sensor}'s bias is not 3 or its matrix not 3 x 3 finite numbers", file)
    for fitted in sensor_effects(c):
        try:
            effect_of(fitted)
        except ConfigurationError as error:
            raise ConfigurationError(error.message, file) from None


def _checked(given: dict[str, Any]) -> tuple[dict[str, NDArray[np.float64]], bool]:
    """Return the signals that are given as arrays of one length, and whether it was a single sample."""
    if given["accelerometer"] is None and given["gyroscope"] is None:
        raise InputError("give accelerometer, gyroscope or both: there is nothing to compensate")
    arrays = {name: np.asarray(value, float) for name, value in given.items() if value is not None}
    sensor = next(s for s in SENSORS if s in arrays)
    single = arrays[sensor].ndim == 1
    arrays = {s: a[None] if single and s in SENSORS else np.atleast_1d(a) for s, a in arrays.items()}
    n = len(arrays[sensor])
    for name, array in arrays.items():
        expected = (n, 3) if name in SENSORS else (n,)
        if array.shape != expected:
            raise InputError(f"{name} has the shape {array.shape}; expected {expected}, as of the {sensor}")
    return arrays, single
