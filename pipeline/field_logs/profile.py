"""How the logs of a unit are laid out, as far as compensating them asks: ingest profile and axes of the sensor."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import ConfigurationError, InputError
from pipeline.io.axes import STRAIGHT, axis_matrix, maps_of_log

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

EPOCH_AFTER_S = 1e8  # 3 years: no sensor has been on for longer


def _canonical() -> dict[str, Any]:
    names = {"time": ("time_s", "s"), "temperature": ("temperature_degc", "degC")}
    names |= {f"accel_{a}": (f"accel_{a}_g", "g") for a in "xyz"}
    names |= {f"gyro_{a}": (f"gyro_{a}_dps", "deg/s") for a in "xyz"}
    return {"csv": {"columns": {channel: {"column": c, "unit": unit} for channel, (c, unit) in names.items()}}}


@dataclass(frozen=True)
class LogProfile:
    """How the logs of a unit are laid out.

    Attributes
    ----------
    ingest : mapping
        The ingest profile, with the sections ``csv`` and ``mcap``; the canonical one by default.
    axis_maps : mapping
        Sensor to the body axis that each of its reading axes points along; straight where it is not named.
    """

    ingest: Mapping[str, Any] = field(default_factory=_canonical)
    axis_maps: Mapping[str, Sequence[str]] = field(default_factory=dict)

    @classmethod
    def of_calibration(cls, document: Mapping[str, Any], file: str) -> LogProfile:
        """Return the profile with which a unit was calibrated, from ``calibrations/<unit>.json``.

        Raises
        ------
        InputError
            If ``log`` is not what a run writes there.
        """
        log = document.get("log")
        if log is None:
            return cls()
        try:
            maps = maps_of_log({"axis_map": log["axis_map"]})
            for axis_map in maps.values():
                axis_matrix(axis_map)
            found = cls({**log["ingest"]}, maps)
        except (KeyError, TypeError, ConfigurationError) as error:
            told = "log is not what a run writes; expected ingest, an object, and axis_map, for example [+x, +y, +z]"
            raise InputError(f"{told}; got {error}", file) from None
        return found

    def to_body(self, sensor: str, readings: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (n, 3) readings of a sensor in the body's axes."""
        axis_map = tuple(self.axis_maps.get(sensor, STRAIGHT))
        if axis_map == STRAIGHT:
            return readings
        matrix = axis_matrix(axis_map)
        turned: NDArray[np.float64] = readings[:, np.argmax(np.abs(matrix), axis=1)] * matrix.sum(axis=1)
        return turned
