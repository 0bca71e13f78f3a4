"""A unit's calibration as an object that compensates arrays, logs and streams.

    truth = matrix @ (reading - bias - sum of effects(truth))        (solved in ``pipeline.model.inversion``)

Effects look at the other signals of the same log, calibrated too. Everything is causal, so that a log in one piece, the
same log in blocks and the samples of a running sensor one by one give the same numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.model.calibration_file import read_calibration, sensor_of
from pipeline.model.compensation_stream import Compensated, CompensationStream
from pipeline.model.effects import register
from pipeline.model.inversion import compensate
from pipeline.records import SENSORS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.records import SensorCalibration

__all__ = ["Compensated", "Compensation", "CompensationStream", "compensate", "load"]

SMOOTHING_S = 3.0


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
            Memory of the line through the temperature's past (``pipeline.model.fading_line``); 0 takes it as it is.

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
        known = {s: c for s in SENSORS if (c := self.calibration(s)) is not None}
        return CompensationStream(self.unit, known, smoothing)

    def calibration(self, sensor: str) -> SensorCalibration | None:
        """Return the calibration of ``accelerometer`` or ``gyroscope``."""
        return self.accelerometer if sensor == "accelerometer" else self.gyroscope


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
        If the file does not exist, is no calibration, or is the record of a failed unit; it names file, key and what
        was expected (``pipeline.model.calibration_file``).
    ConfigurationError
        If an effect is not known, or is one in Python whose file is not given.
    """
    if python_effects:
        from pipeline.model.effects.files import load_python_effect  # noqa: PLC0415  (only where there are any)

        for python_file in python_effects:
            register(load_python_effect(python_file))
    file = Path(path)
    document = read_calibration(file)
    accelerometer, gyroscope = (sensor_of(document, sensor, file) for sensor in SENSORS)
    return Compensation(accelerometer, gyroscope, str(document.get("unit", "")))
