"""Repeat the comparisons of the thesis over many seeds.

A row is for one seed, set of recordings, cause of disturbance and method, with

    error = mean |e_n| of the held-out motion (Sudsanguan 2019, eqs 5.1 to 5.4), with the noise of the same seed

For the accelerometer as printed, a row also has the parameters from the stages: O of y and z, M, b, and S (mean of both
sides). "zero-phase" runs the RC filter forwards and backwards, which squares its gain. "same-gain" does so with a
shorter time constant tau', which gives the gain of the causal filter without its delay:

    |H|^2 = 1 - tau (dt + tau) omega^2,   2 tau' (dt + tau') = tau (dt + tau)      for small omega

The estimates are those of the stages of a fit, by the functions that these call. Of the thesis's methods the study does
not run the steps themselves: the uncertainty would take ten times as long as all the rest.

Each seed adds new noise to the same exact readings:

    reading = round(c (exact + white + wander)) / c,   then a share of the samples is lost

The motion of the precise table is the same for every seed, so that its exact readings are simulated once. The errors of
the home-made table are drawn for each seed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from imu_research.thesis.tables import AXES, DEVICES, SILENT
from pipeline.core.records import SENSORS, Mask, NotCalibrated, Recording, Values
from pipeline.core.records.calibration import corrected
from pipeline.core.settings import Settings
from pipeline.estimation.accelerometer import staged as accelerometer
from pipeline.estimation.gyroscope import cholesky_lu
from pipeline.estimation.gyroscope import staged as gyroscope
from pipeline.evaluation.held_out.samples import samples_of_motion
from pipeline.physics.measurement import linear_truth
from pipeline.physics.signal.filters import apply_filter
from pipeline.simulation.campaign import received, simulate_unit
from pipeline.simulation.description import Description, UnitDescription, read_description, shipped_settings
from pipeline.simulation.sensor import SimulatedSensor, bias_wander
from pipeline.unit import run_checked

FOUND = ("O_y", "O_z", "M", "b_x", "b_y", "b_z", "S_x", "S_y", "S_z")
SEED_COLUMNS = ("set", "seed", "cause", "method", *FOUND, "error")
TIME_CONSTANT_S = 0.12  # of campaign.yaml
INTERVAL_S = 0.12  # of simulation.yaml
SAME_GAIN_S = (np.sqrt(INTERVAL_S**2 + 2.0 * TIME_CONSTANT_S * (INTERVAL_S + TIME_CONSTANT_S)) - INTERVAL_S) / 2.0
# Causes of disturbance; each includes the causes before it.
SHEET_NOISE = "noise of the sensor file, up to half the sampling rate"
WHOLE_BAND_NOISE = "noise of the sensor's whole bandwidth, folded into the samples"
LOST = "and samples lost on the radio link"
SHAKEN = "and a table that shakes like the home-made one"
CAUSES = (SHEET_NOISE, WHOLE_BAND_NOISE, LOST, SHAKEN)
SHAKING = {"shaking_g": 0.05, "vibration_hz": 7.3}  # g and Hz, of Mark 2 in simulation.yaml
Row = dict[str, Any]


@dataclass(frozen=True)
class RecordingSet:
    """One set of recordings of ``simulation.yaml``: its description, its number there, and the campaign's seed."""

    unit: UnitDescription
    number: int
    campaign_seed: int

    @classmethod
    def named(cls, description: Description, name: str) -> RecordingSet:
        """Return the set with a name."""
        number = [u.unit for u in description.units].index(name)
        return cls(description.units[number], number, description.seed)

    @property
    def sensor(self) -> str:
        """The sensor for which the recordings are made; readings of the other sensor are not used."""
        return "gyroscope" if "-gyro" in self.unit.unit else "accelerometer"

    @cached_property
    def still(self) -> list[Recording]:
        """The recordings without noise or loss."""
        return _exact(self.unit, self.campaign_seed, self.number)

    @cached_property
    def shaken(self) -> list[Recording]:
        """The same on a vibrating table."""
        shaking = replace(self.unit, imperfections={**self.unit.imperfections, **SHAKING})
        return _exact(shaking, self.campaign_seed, self.number)

    def drawn(self, seed: int, cause: str = LOST) -> list[tuple[Recording, Mask]]:
        """Return the complete recordings of one seed, and which of their samples are received.

        They are disturbed by ``cause`` and the causes before it in ``CAUSES``.
        """
        exact = self.still if self.unit.table == "acutronic" else _exact(self.unit, seed, self.number)
        if cause == SHAKEN:
            exact = self.shaken
        data_sheet = shipped_settings(sensor=self.unit.sensor).sensor.of(self.sensor)
        given = getattr(self.unit, self.sensor)
        if cause != SHEET_NOISE and "noise_density" in given:
            data_sheet = data_sheet.replaced(noise_density=given["noise_density"])  # of the whole bandwidth
        lost = self.unit.lost if cause in (LOST, SHAKEN) else 0.0
        link, noise = (np.random.default_rng([seed, self.number, k]) for k in (0, 1 + SENSORS.index(self.sensor)))
        simulated = SimulatedSensor(self.sensor, data_sheet, np.zeros(3), np.eye(3))
        wander = bias_wander([r.time for r in exact], data_sheet.wander_time_s, noise)
        out = []
        for recording, slow in zip(exact, wander, strict=True):
            white = data_sheet.white(recording.interval) * noise.standard_normal(slow.shape)
            reading = simulated.quantised(
                np.asarray(recording.reading(self.sensor)) + white + data_sheet.bias_wander * slow
            )
            readings: dict[str, Any] = {s: reading if s == self.sensor else None for s in SENSORS}
            out.append((replace(recording, **readings), received(recording.samples, lost, link)))
        return out


def _exact(unit: UnitDescription, seed: int, number: int) -> list[Recording]:
    silent = {"noise_density": 0.0, "bias_wander": 0.0}
    without = replace(
        unit, accelerometer={**unit.accelerometer, **silent}, gyroscope={**unit.gyroscope, **silent}, lost=0.0
    )
    return [replace(r, temperature=None) for r in simulate_unit(without, seed, number)[0]]


@dataclass(frozen=True)
class Drawn:
    """The turns of one seed and the held-out motion of its device, with the same filter on both."""

    turns_set: RecordingSet
    seed: int
    held_out: Recording
    cause: str = LOST
    filter: str = "rc_low_pass"

    def filtered(self, recording: Recording) -> Recording:
        """Filter a recording."""
        if self.filter == "unfiltered":
            return recording
        time_constant = SAME_GAIN_S if self.filter == "same-gain" else TIME_CONSTANT_S
        shipped = shipped_settings(filter="rc_low_pass").filter
        causal = self.filter == "rc_low_pass"
        return apply_filter(recording, shipped.replaced(time_constant_s=float(time_constant), zero_phase=not causal))

    def turns(self) -> list[Recording]:
        """Return the filtered turns."""
        return [
            self.filtered(recording.select(kept)) for recording, kept in self.turns_set.drawn(self.seed, self.cause)
        ]

    def staged_accelerometer(self, *, as_printed: bool) -> tuple[Row, Row]:
        """Return the parameters from the stages, and the error after them."""
        estimator = accelerometer.Estimator.of(self.turns(), self._settings(as_printed=as_printed))
        found: dict[str, float] = {}
        chain = accelerometer.CorrectedForces()
        for name in accelerometer.STAGE_EQUATIONS:
            chain = estimator.after([name], chain)
            found |= {k: v for k, (v, _) in chain.values.items()}
        row = {f"b_{a}": found[f"b_{a}"] for a in AXES}
        row |= {f"{q}_{a}": (found[f"{q}_P_{a}"] + found[f"{q}_N_{a}"]) / 2.0 for q in "OS" for a in AXES}
        row["M"] = (found["M_P_x"] + found["M_N_x"]) / 2.0  # the same on all axes
        return row, self._accelerometer_error(partial(corrected, chain.steps))

    def least_squares_accelerometer(self) -> Row:
        """Return the error after nonlinear least squares."""
        settings = self._settings()  # without a filter: the turns are filtered
        unit = run_checked(self.turns(), {"accelerometer": ["nonlinear_least_squares"]}, settings)
        fitted = unit.fits["accelerometer"]
        assert not isinstance(fitted, NotCalibrated)  # noqa: S101  (turns about three axes)
        return self._accelerometer_error(partial(linear_truth, fitted))

    def _settings(self, *, as_printed: bool = False) -> Settings:
        unit = self.turns_set.unit
        shipped = shipped_settings(sensor=unit.sensor, table=unit.table, procedure=unit.procedure)
        return shipped.replaced(
            method=shipped.method.replaced(as_printed=as_printed), procedure=shipped.procedure.replaced(holdout_every=0)
        )

    def _accelerometer_error(self, correct: Callable[[Values], Values]) -> Row:
        """Return the mean |e| of the held-out motion, corrected."""
        reading = self.filtered(self.held_out).accelerometer
        return {"error": float(np.mean(np.abs(np.linalg.norm(correct(np.asarray(reading)), axis=1) - 1.0)))}

    def gyroscope(self) -> Iterator[tuple[str, Row]]:
        """Yield method and error of the staged method, and of Cholesky and LU as printed and inverted."""
        turns, settings = self.turns(), self._settings()
        found = gyroscope.estimates_of(turns, settings)
        bias = found.theta[0]
        A = cholesky_lu.forward_of(turns, bias, settings.table).A
        matrices = {
            "staged": gyroscope.follow(found.response, list(gyroscope.STAGE_EQUATIONS)).contract()[1],
            "cholesky-printed": cholesky_lu.calibration_matrix(A, as_printed=True),
            "cholesky": cholesky_lu.calibration_matrix(A, as_printed=False),
        }
        motion = samples_of_motion("gyroscope", self.filtered(self.held_out), SILENT, settings.table)
        assert motion is not None  # noqa: S101  (the table logs its rate)
        for method, matrix in matrices.items():
            error = np.linalg.norm((motion.reading - bias) @ matrix.T, axis=1) - motion.magnitude
            yield method, {"error": float(np.mean(np.abs(error)))}


def study_of(campaign: Path, seeds: Sequence[int], name: str) -> list[Row]:
    """Return the rows of a set of recordings of the campaign's ``simulation.yaml``."""
    description = read_description(campaign / "simulation.yaml")
    turns_set = RecordingSet.named(description, name)
    held_out = RecordingSet.named(description, f"{device_of(name)}-held-out-{turns_set.sensor}")
    rows = []
    for seed in seeds:
        recording, kept = held_out.drawn(seed)[0]
        for cause, method, row in _rows(Drawn(turns_set, seed, recording.select(kept))):
            rows.append({"set": name, "seed": seed, "cause": CAUSES.index(cause), "method": method, **row})
    return rows


def _rows(drawn: Drawn) -> Iterator[tuple[str, str, Row]]:
    """Yield cause, method and row of one seed."""
    name = drawn.turns_set.unit.unit
    if drawn.turns_set.sensor == "gyroscope":
        for method, row in drawn.gyroscope():
            yield LOST, method, row
        return
    parameters, error = drawn.staged_accelerometer(as_printed=True)
    yield LOST, "printed", parameters | error
    yield LOST, "staged", drawn.staged_accelerometer(as_printed=False)[1]
    if drawn.turns_set.unit.table == "acutronic":
        for cause in (c for c in CAUSES if c != LOST):
            yield cause, "printed", replace(drawn, cause=cause).staged_accelerometer(as_printed=True)[0]
    if "-continuous-" in name:
        for method in ("zero-phase", "same-gain", "unfiltered"):
            yield LOST, method, replace(drawn, filter=method).staged_accelerometer(as_printed=False)[1]
    if name.endswith("-stop-1s") or name == "stim300-continuous-0.5dps":
        yield LOST, "least-squares", drawn.least_squares_accelerometer()


def device_of(name: str) -> str:
    """Return the device of a set of recordings."""
    return next(d for d in DEVICES if name.startswith(d))


def sets_of(campaign: Path) -> list[str]:
    """Return the names of the sets of recordings that calibrate a device of the thesis."""
    names = [u.unit for u in read_description(campaign / "simulation.yaml").units]
    return [n for n in names if "-held-out-" not in n and not n.startswith("gy-521")]
