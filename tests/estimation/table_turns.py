"""Recordings of turns with known truth, from the stated geometry of the table written out by hand."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from bench_session import gauss_markov
from unit_settings import settings_of, with_noise

from pipeline.core.records import Recording, SensorCalibration
from pipeline.estimation.stages import fit_stage

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from pipeline.core.settings import Settings

INTERVAL = 0.12
SHEETS = {
    "accelerometer": {"noise_density": 4e-4, "bias_wander": 1e-4, "wander_time_s": 100.0},
    "gyroscope": {"noise_density": 0.005, "bias_wander": 0.003, "wander_time_s": 100.0},
}


def settings(*, as_printed: bool = False, **table: float) -> Settings:
    return settings_of(table=table, method={"as_printed": as_printed}, sensor=SHEETS)


def specific_force(axis: str, angle_deg: np.ndarray, gravity: float = 1.0) -> np.ndarray:
    """What an ideal sensor feels in a turn: the up vector turned by minus the angle."""
    s, c, o = np.sin(np.radians(angle_deg)), np.cos(np.radians(angle_deg)), np.zeros(len(angle_deg))
    return gravity * np.column_stack({"x": [o, s, c], "y": [-s, o, c], "z": [c, -s, o]}[axis])


def stepped_angle(step: float, dwell: float, stop: float = 360.0, start: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Angle and rate of a table that moves by ``step`` in one interval and rests for ``dwell`` s."""
    samples = round(dwell / INTERVAL)
    rests = np.repeat(np.arange(start, stop + step / 2, step), samples)
    moved = np.concatenate([[False], np.diff(rests) != 0])
    return rests, np.where(moved, step / INTERVAL, 0.0)


def ramped_rate(rates: list[float]) -> np.ndarray:
    """Rest of 5 s, ramp of 0.5 s, steady turn of 6 s, ramp, rest for each rate."""
    ramp = np.linspace(0.0, 1.0, round(0.5 / INTERVAL) + 1)
    rest, turn = np.zeros(round(5.0 / INTERVAL)), np.ones(round(6.0 / INTERVAL))
    return np.concatenate([np.concatenate([rest, r * ramp, r * turn, r * ramp[::-1], rest]) for r in rates])


class Bench:
    """A unit on a table, its noise drawn in the order in which recordings are asked for, on one clock."""

    def __init__(
        self,
        sensor: str,
        bias: ArrayLike,
        K: ArrayLike,
        *,
        c: ArrayLike = (0.0, 0.0, 0.0),
        white: float = 0.0,
        wander_size: float = 0.0,
        seed: int = 0,
        gravity: float = 1.0,
    ) -> None:
        self.sensor, self.bias, self.K, self.c = sensor, np.array(bias, float), np.array(K, float), np.array(c, float)
        self.white, self.gravity, self.clock = white, gravity, 0
        self.rng = np.random.default_rng(seed)
        self._drift = wander_size * gauss_markov(self.rng, 60_000, INTERVAL / 100.0) if wander_size else None

    def reading(self, truth: np.ndarray) -> np.ndarray:
        clean = self.bias + truth @ self.K.T + self.c * np.abs(truth)
        if self._drift is not None:
            clean = clean + self._drift[self.clock : self.clock + len(clean)]
        return clean + self.white * self.rng.standard_normal(clean.shape)

    def turn(self, axis: str, angle: np.ndarray, rate: np.ndarray | None) -> Recording:
        if self.sensor == "accelerometer":
            truth = specific_force(axis, angle, self.gravity)
        else:
            truth = np.zeros((len(angle), 3))
            truth[:, "xyz".index(axis)] = rate
        reading = self.reading(truth)
        ticks = self.clock + np.arange(len(angle))
        self.clock += len(angle) + 250
        return Recording(
            f"{self.sensor}_{axis}",
            self.sensor,
            axis,
            ticks * round(INTERVAL * 1e9),
            **{self.sensor: reading},
            table_angle=angle,
            table_rate=rate,
        )

    def stop_and_go(self, step: float = 5.0, dwell: float = 1.2, axes: str = "xyz", **arc: float) -> list[Recording]:
        return [self.turn(axis, *stepped_angle(step, dwell, **arc)) for axis in axes]

    def continuous(self, rate: float, stop: float = 360.0) -> list[Recording]:
        angle = np.arange(0.0, stop, rate * INTERVAL)
        return [self.turn(axis, angle, np.full(len(angle), rate)) for axis in "xyz"]

    def turns_at(self, rates: dict[str, list[float]] | list[float]) -> list[Recording]:
        rates = rates if isinstance(rates, dict) else dict.fromkeys("xyz", rates)
        out = []
        for axis, values in rates.items():
            rate = ramped_rate(values)
            angle = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2.0 * INTERVAL)])
            out.append(self.turn(axis, angle, rate))
        return out


def run_stages(sensor: str, names: list[str], recordings: list[Recording], config: Settings) -> SensorCalibration:
    """Run the stages of a method, one after the other."""
    calibration = None
    for name in names:
        calibration = fit_stage(sensor, name, with_noise(recordings, config), calibration, config)
    return calibration
