"""The thesis's recordings drawn again and again: the exact readings once, the noise for every seed.

    reading = round(c (exact + white + wander)) / c,   then a share of the samples is lost

The motion of the precise table is the same for every seed, so its exact readings are simulated once. The home-made
table errs anew each time, and is simulated anew.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.estimation.turns import parts_of
from pipeline.records import SENSORS
from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import read_config
from pipeline.simulation.sensor import SimulatedSensor, bias_wander

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.estimation.turns import Part
    from pipeline.records import Recording
    from pipeline.simulation.description import Description, UnitDescription

# What disturbs the readings, one cause after the other added.
SHEET = "noise of the data sheet, up to half the sampling rate"
WHOLE = "noise of the sensor's whole bandwidth, folded into the samples"
LOST = "and samples lost on the radio link"
SHAKEN = "and a table that shakes like the home-made one"
CAUSES = (SHEET, WHOLE, LOST, SHAKEN)
SHAKING = {"shaking_g": 0.05, "vibration_hz": 7.3}  # g and Hz, of Mark 2 in simulation.yaml


@dataclass(frozen=True)
class Set:
    """One set of recordings of ``simulation.yaml``.

    Attributes
    ----------
    unit : UnitDescription
    number : int
        In the description.
    campaign_seed : int
        Of the campaign: the motions are those of its recordings.
    """

    unit: UnitDescription
    number: int
    campaign_seed: int

    @classmethod
    def named(cls, description: Description, name: str) -> Set:
        """Return the set of a name."""
        number = [u.unit for u in description.units].index(name)
        return cls(description.units[number], number, description.seed)

    @property
    def sensor(self) -> str:
        """The sensor that the recordings are made for; the other one's readings are left out."""
        return "gyroscope" if "-gyro" in self.unit.unit else "accelerometer"

    @property
    def sheet(self) -> dict[str, Any]:
        """The sensor's data sheet, with the noise of its whole bandwidth."""
        sheet: dict[str, Any] = read_config("sensor", self.unit.sensor)[self.sensor]
        given = getattr(self.unit, self.sensor)
        return {**sheet, **{key: given[key] for key in ("noise_density",) if key in given}}

    @cached_property
    def still(self) -> list[Recording]:
        """The recordings without noise or loss."""
        return _exact(self.unit, self.campaign_seed, self.number)

    @cached_property
    def shaken(self) -> list[Recording]:
        """The same on a table that shakes."""
        shaking = replace(self.unit, imperfections={**self.unit.imperfections, **SHAKING})
        return _exact(shaking, self.campaign_seed, self.number)

    @cached_property
    def parts(self) -> list[Part]:
        """The recordings without noise or loss, with the table's motion."""
        return parts_of(self.still, "accelerometer", read_config("table", self.unit.table), "the study")

    def recordings(self, seed: int, cause: str = LOST) -> list[Recording]:
        """Return the recordings of one seed, disturbed by a cause and those before it in ``CAUSES``."""
        return [recording.select(kept) for recording, kept in self.drawn(seed, cause)]

    def drawn(self, seed: int, cause: str = LOST) -> list[tuple[Recording, NDArray[np.bool_]]]:
        """Return the recordings of one seed, whole, and which of their samples arrive."""
        exact = self.still if self.unit.table == "acutronic" else _exact(self.unit, seed, self.number)
        if cause == SHAKEN:
            exact = self.shaken
        link, noise = (np.random.default_rng([seed, self.number, k]) for k in (0, 1 + SENSORS.index(self.sensor)))
        sheet = read_config("sensor", self.unit.sensor)[self.sensor] if cause == SHEET else self.sheet
        out = []
        for recording, reading in zip(exact, _noisy(self.sensor, sheet, exact, noise), strict=True):
            kept = link.random(recording.samples) >= (self.unit.lost if cause in (LOST, SHAKEN) else 0.0)
            kept[[0, -1]] = True
            own: dict[str, Any] = {s: reading if s == self.sensor else None for s in SENSORS}
            out.append((replace(recording, **own), kept))
        return out


def _exact(unit: UnitDescription, seed: int, number: int) -> list[Recording]:
    silent = {"noise_density": 0.0, "bias_wander": 0.0}
    without = replace(
        unit, accelerometer={**unit.accelerometer, **silent}, gyroscope={**unit.gyroscope, **silent}, lost=0.0
    )
    return [replace(r, temperature=None) for r in simulate_unit(without, seed, number)[0]]


def _noisy(
    sensor: str, sheet: dict[str, Any], exact: list[Recording], rng: np.random.Generator
) -> list[NDArray[np.float64]]:
    """Return the readings of a sensor in each recording, with white noise and bias wander, in whole counts."""
    simulated = SimulatedSensor(sensor, sheet, np.zeros(3), np.eye(3))
    wander = bias_wander([r.time for r in exact], sheet["wander_time_s"], rng)
    out = []
    for recording, slow in zip(exact, wander, strict=True):
        reading = recording.reading(sensor)
        assert reading is not None  # noqa: S101  (simulated sets hold both sensors)
        white = simulated.white(recording.interval) * rng.standard_normal(reading.shape)
        out.append(simulated.quantised(reading + white + sheet["bias_wander"] * slow))
    return out
