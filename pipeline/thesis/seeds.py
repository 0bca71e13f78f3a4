"""The thesis's comparisons over many seeds: a row a seed, set of recordings, cause of disturbance and method.

    error = mean |e_n| of the held-out motion (Sudsanguan 2019, eqs 5.1 to 5.4), with the noise of the same seed

Beside it stand, for the accelerometer, what the stages found: O of y and z, b, and S (mean of both sides). The
estimates are those of the methods themselves; only their uncertainties are left out, which would take most of the time.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.estimation.accelerometer import nonlinear_least_squares, staged
from pipeline.estimation.accelerometer.chain import follow
from pipeline.estimation.accelerometer.extremes import Turn, extremes_of_samples, extremes_of_sinusoids, sinusoids_of
from pipeline.estimation.correction import apply_correction
from pipeline.estimation.gyroscope import bias, cholesky_lu, orthogonality_and_misalignment, scale_factor
from pipeline.model.inversion import linear_truth
from pipeline.records import Noise
from pipeline.signal.filters import apply_filter
from pipeline.simulation.description import read_config, read_description
from pipeline.thesis.recorded import CAUSES, LOST, Set
from pipeline.validation.samples import samples_of_motion

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.records import Recording

    Correct = Callable[[NDArray[np.float64]], NDArray[np.float64]]

FOUND = ("O_y", "O_z", "b_x", "b_y", "b_z", "S_x", "S_y", "S_z")
COLUMNS = ("set", "seed", "cause", "method", *FOUND, "error")
TIME_CONSTANT_S = 0.12  # of campaign.yaml
Row = dict[str, Any]


@dataclass(frozen=True)
class Drawn:
    """The turns of one seed and the held-out motion of its device, with the same filter on both.

    Attributes
    ----------
    own : Set
    seed : int
    held_out : Recording
    cause : str
    filter : str
    """

    own: Set
    seed: int
    held_out: Recording
    cause: str = LOST
    filter: str = "rc_low_pass"

    def filtered(self, recording: Recording) -> Recording:
        """Return a recording behind the filter."""
        if self.filter == "none":
            return recording
        wanted = {**read_config("filter", "rc_low_pass"), "time_constant_s": TIME_CONSTANT_S}
        return apply_filter(recording, {**wanted, "zero_phase": self.filter == "zero-phase"})

    def accelerometer_error(self, correct: Correct) -> float:
        """Return the mean |e| of the held-out motion, corrected."""
        reading = self.filtered(self.held_out).accelerometer
        return float(np.mean(np.abs(np.linalg.norm(correct(np.asarray(reading)), axis=1) - 1.0)))

    def staged_accelerometer(self, *, as_printed: bool, judge: bool = True) -> Row:
        """Return what the stages find, and the error that they leave."""
        turns = self._turns()
        extremes = (
            extremes_of_samples(turns)
            if as_printed
            else extremes_of_sinusoids([[s.coefficients for s in fits] for fits in sinusoids_of(turns)])
        )
        row: Row = {}
        for end, name in enumerate(staged.STAGES, 1):
            chain = follow(extremes, staged.STAGES[:end], 1.0, as_printed=as_printed)
            values = {k: v for k, (v, _) in chain.outcome.values.items()}
            for axis in "xyz":
                if name == "bias":
                    row[f"b_{axis}"] = values[f"b_{axis}"]
                elif name in ("orthogonality", "scale_factor"):
                    letter = "O" if name == "orthogonality" else "S"
                    row[f"{letter}_{axis}"] = (values[f"{letter}_P_{axis}"] + values[f"{letter}_N_{axis}"]) / 2.0
        if judge:
            row["error"] = self.accelerometer_error(partial(apply_correction, {"steps": chain.steps}))
        return row

    def least_squares_accelerometer(self) -> Row:
        """Return the error that nonlinear least squares leaves."""
        turns = [self.filtered(r) for r in self.own.recordings(self.seed, self.cause)]
        fitted = nonlinear_least_squares.fit(turns, None, self._settings())
        return {"error": self.accelerometer_error(partial(linear_truth, fitted))}

    def gyroscope(self, method: str) -> Row:
        """Return the error that the staged method or Cholesky and LU leave, the latter as printed or inverted."""
        settings = self._settings() | {"method": {"as_printed": method == "cholesky-printed"}}
        turns = [self.filtered(r) for r in self.own.recordings(self.seed, self.cause)]
        fitted = bias.fit(turns, None, settings)
        for stage in (orthogonality_and_misalignment, scale_factor) if method == "staged" else (cholesky_lu,):
            fitted = stage.fit(turns, fitted, settings)
        silent = Noise(np.zeros(3), np.zeros(3), 100.0, "none")
        motion = samples_of_motion("gyroscope", self.filtered(self.held_out), silent, settings["table"])
        assert motion is not None  # noqa: S101  (the table logs its rate)
        error = np.linalg.norm(linear_truth(fitted, motion.reading), axis=1) - motion.magnitude
        return {"error": float(np.mean(np.abs(error)))}

    def _turns(self) -> list[Turn]:
        """Return what the staged method sees of the turns; their motion is the same for every seed."""
        turns = []
        drawn = self.own.drawn(self.seed, self.cause)
        for (angle, used), (recording, kept) in zip(self.own.settled, drawn, strict=True):
            reading = np.asarray(self.filtered(recording.select(kept)).accelerometer)
            turns.append(Turn(angle[kept & used], reading[used[kept]], [], []))
        return turns

    def _settings(self) -> dict[str, Any]:
        unit = self.own.unit
        table, sensor = read_config("table", unit.table), read_config("sensor", unit.sensor)
        return {"table": table, "sensor": sensor, "procedure": {"holdout_every": 0}, "method": {"as_printed": False}}


def study(campaign: Path, sets: Sequence[str], seeds: Sequence[int]) -> Iterator[Row]:
    """Yield the rows of some sets of recordings.

    Parameters
    ----------
    campaign : Path
        With ``simulation.yaml``.
    sets : sequence of str
        Names in it.
    seeds : sequence of int
    """
    description = read_description(campaign / "simulation.yaml")
    for name in sets:
        own = Set.named(description, name)
        sensor = "gyroscope" if "-gyro-" in name else "accelerometer"
        held_out = Set.named(description, f"{device_of(name)}-held-out-{sensor}")
        for seed in seeds:
            held_out_of_seed = held_out.recordings(seed)[0]
            for cause, method, row in _rows(Drawn(own, seed, held_out_of_seed), sensor):
                yield {"set": name, "seed": seed, "cause": CAUSES.index(cause), "method": method, **row}


def _rows(drawn: Drawn, sensor: str) -> Iterator[tuple[str, str, Row]]:
    """Yield cause, method and row of one seed."""
    name = drawn.own.unit.unit
    if sensor == "gyroscope":
        for method in ("staged", "cholesky-printed", "cholesky"):
            yield LOST, method, drawn.gyroscope(method)
        return
    yield LOST, "printed", drawn.staged_accelerometer(as_printed=True)
    yield LOST, "staged", drawn.staged_accelerometer(as_printed=False)
    if drawn.own.unit.table == "acutronic":
        for cause in (c for c in CAUSES if c != LOST):
            yield cause, "printed", replace(drawn, cause=cause).staged_accelerometer(as_printed=True, judge=False)
    if "-continuous-" in name:
        for method, chosen in (("zero-phase", "zero-phase"), ("unfiltered", "none")):
            yield LOST, method, replace(drawn, filter=chosen).staged_accelerometer(as_printed=False)
    if name.endswith("-stop-1s") or name == "stim300-continuous-0.5dps":
        yield LOST, "least-squares", drawn.least_squares_accelerometer()


def device_of(name: str) -> str:
    """Return the device of a set of recordings."""
    return next(d for d in ("mpu6050-1", "mpu6050-2", "stim300") if name.startswith(d))


def sets_of(campaign: Path) -> list[str]:
    """Return the sets of recordings that calibrate a device of the thesis."""
    names = [u.unit for u in read_description(campaign / "simulation.yaml").units]
    return [n for n in names if "-held-out-" not in n and not n.startswith("gy-521")]


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write rows as CSV, with five digits."""
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(COLUMNS)
        for row in rows:
            values = [row.get(c, "") for c in COLUMNS]
            writer.writerow([f"{v:.5g}" if isinstance(v, float) else v for v in values])


def read_rows(path: Path) -> list[Row]:
    """Read rows back; a value that is not there is None."""
    text = ("set", "method")
    with path.open(encoding="utf-8", newline="") as stream:
        return [
            {k: v if k in text else float(v) if v else None for k, v in row.items()} for row in csv.DictReader(stream)
        ]
