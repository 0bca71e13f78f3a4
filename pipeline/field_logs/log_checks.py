"""Checks whether a log suits the calibration that is applied to it. They only warn; the output is written.

    rest  : a window of 100 samples whose scatter is at most twice that of the quietest tenth of the windows, and at
            most twice that of successive differences (no slow motion); its specific force is well above its scatter
    error : ||a| - 1 g| or |w| of a rest's mean reading, before and after compensation

The right calibration brings rests nearer to 1 g and to zero rate, and some of them near. If it does not, the log was
compensated already, belongs to another unit or sensor, or is read with other axes or units; or the sensor has changed.
Between two rests gravity turns in the body by at most the integral of |w| (minus its value at rest): a gyroscope that
integrates to less than half of the turn is not read in deg/s.

``apply`` writes numbers rounded to 12 decimals without trailing zeros: 9 of 10 cells have 12 decimals. Sensors give
fewer digits, programs that write doubles give more.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.io.units import FORCE_UNITS
from pipeline.records import SENSORS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import pyarrow as pa

    from pipeline.records import Mask, Values


DECIMALS = 12  # that ``apply`` writes: far below any sensor's resolution, above the rounding of a double
RANGES = {"accelerometer": "specific_force_g", "gyroscope": "angular_rate_dps"}  # of ``calibrated_range``
# Conventions: the bias of a low-cost sensor, some % of 1 g, adds to a reading in one direction and not in another; a
# room, and a chip from one power-on to the next, change by 1 degC.
STRONGER, WARMER = 0.1, 1.0  # share of the largest magnitude; degC
WINDOW = 100  # samples: 0.1 to 1 s at usual rates
MOST_WINDOWS = 20_000  # 2 million samples, 6 MB: the memory stays bounded
QUIET, QUIETEST = 2.0, 0.1  # ratio of scatters, and share of the windows, as the module's description states
FEWEST_RESTS = 3  # directions of gravity, for three axes
DIRECTED = 0.1  # scatter over mean of a rest's specific force: its direction is known to 0.1 / sqrt(100) rad = 0.6 deg
# Error after over error before. Where errors of both kinds are alike, by chance: a drift as large as the bias, three
# components each, P(F(3, 3) < 1/9) = 4 %. An accelerometer is judged in three directions or more, and where the
# correction is at least half of the error after it.
WORSE = {"accelerometer": 1.2, "gyroscope": 3.0}
# g and deg/s: a larger change of the bias is unusual. By the temperature limits of the MPU-6050 (1.4 mg/degC and 0.32
# deg/s/degC, configs/sensor/mpu6050.yaml) it takes 36 degC and 16 degC.
CHANGED = {"accelerometer": 0.05, "gyroscope": 5.0}
KNOWN = 5.0  # standard errors of a rest's mean that the error after is above
APART_DEG = 30.0  # orientations that count as different; the least turn of gravity that is compared with the rate
NEAR = 0.15  # a median |a| this near to a unit's factor is read in that unit
STRANGE_G = (0.5, 2.0)  # median |a| of a log; walking, driving and flying stay within
CELLS, LEAST_CELLS, SHARE = 200, 10, 0.6  # of a column; the share of cells with 12 decimals, 0.9 expected
WHOLE = 10  # different whole numbers that are no chance


class LogChecks:
    """Statistics of a log, block by block, in bounded memory.

    ``compensated``: evidence that the log was compensated before; else empty. ``calibrated_range``: as the
    calibration has it.
    """

    def __init__(self, calibrated_range: Mapping[str, Any] | None = None) -> None:
        self.samples = self.reversed = self.repeated = self.kept = 0
        self.first_reversed = ""
        self.last_time = -np.inf
        self.windows: list[dict[str, Values]] = []
        self.whole: dict[str, bool] = {}
        self.compensated = ""
        self.ranges = {
            key: (low, high)
            for key, known in (calibrated_range or {}).items()
            for low, high in [known if isinstance(known, list) else (-np.inf, known)]
        }
        self.extremes: dict[str, list[float]] = {}  # samples beyond, lowest and highest value

    def check_decimals(self, columns: Sequence[pa.Array], decimal: str) -> None:
        """Check whether the readings of a text log have the decimals that ``apply`` writes."""
        cells = [str(cell) for column in columns for cell in column[:CELLS].to_pylist()]
        decimals = [cell.partition(decimal)[2] for cell in cells if "e" not in cell.lower()]
        full = sum(len(text) == DECIMALS for text in decimals)
        if (
            len(decimals) >= LEAST_CELLS
            and full > SHARE * len(decimals)
            and not any(len(text) > DECIMALS or (len(text) == DECIMALS and text[-1] == "0") for text in decimals)
        ):
            self.compensated = f"the readings have {DECIMALS} decimals, as this command writes them"

    def add(
        self,
        raw: Mapping[str, Values],
        calibrated: Mapping[str, Values],
        time: Values | None,
        temperature: Values | None = None,
    ) -> None:
        """Add a block: (n, 3) readings of each sensor in g or deg/s, (n,) times in s and temperatures in degC."""
        self._add_extremes(raw, temperature)
        if time is not None and len(time):
            step = np.diff(time, prepend=self.last_time)
            back = np.flatnonzero(step < 0)
            if len(back) and not self.reversed:
                self.first_reversed = f"sample {self.samples + int(back[0]) + 1}, {time[back[0]]:.9g} s"
            self.reversed += len(back)
            self.repeated += int(np.count_nonzero(step == 0))
            self.last_time = float(time[-1])
        self.samples += len(next(iter(raw.values()), ()))
        for sensor, values in raw.items():
            known = values[np.isfinite(values)]
            if self.whole.get(sensor, True) and len(known):
                self.whole[sensor] = bool(np.all(known[:WINDOW] == np.round(known[:WINDOW]))) and (
                    sensor in self.whole or len(np.unique(known[: 10 * WINDOW])) >= WHOLE
                )
        self._add_windows(raw, calibrated, time)

    def _add_extremes(self, raw: Mapping[str, Values], temperature: Values | None) -> None:
        """Count the samples beyond the calibrated range."""
        values = {RANGES[s]: np.linalg.norm(v, axis=1) for s, v in raw.items()}
        values |= {} if temperature is None else {"temperature_degc": temperature}
        for key in values.keys() & self.ranges.keys():
            low, high = self.ranges[key]
            margin = WARMER if key == "temperature_degc" else STRONGER * high
            beyond = values[key][(values[key] < low - margin) | (values[key] > high + margin)]
            if len(beyond):
                count, least, most = self.extremes.get(key, [0, np.inf, -np.inf])
                self.extremes[key] = [count + len(beyond), min(least, beyond.min()), max(most, beyond.max())]

    def _beyond(self, calibrated: set[str]) -> list[str]:
        """Return what of the log lies beyond the calibrated range."""
        found = []
        for key, (count, least, most) in sorted(self.extremes.items()):
            low, high = self.ranges[key]
            told = f"{count:.0f} of {self.samples} samples are beyond what the recordings of the calibration contain: "
            if key == "temperature_degc":
                what = f"temperatures from {least:.1f} to {most:.1f} degC, calibrated from {low:.1f} to {high:.1f} degC"
                todo = "record turns at these temperatures (procedure thermal_ramp)"
            else:
                sensor = next(s for s, k in RANGES.items() if k == key)
                if sensor not in calibrated:
                    continue
                quantity, unit = ("specific force", "g") if sensor == "accelerometer" else ("angular rate", "deg/s")
                what = f"{quantity} up to {most:.3g} {unit}, calibrated up to {high:.3g} {unit}"
                todo = f"record motion that reaches this {quantity}"
            found.append(
                f"{told}{what}. There the calibration extrapolates, and its stated uncertainty does not hold: {todo} "
                "and calibrate with it, or do not rely on these samples"
            )
        return found

    def _add_windows(self, raw: Mapping[str, Values], calibrated: Mapping[str, Values], time: Values | None) -> None:
        """Keep means and scatter of the windows of a block."""
        count = min(len(next(iter(raw.values()), ())) // WINDOW, MOST_WINDOWS - self.kept)
        if count <= 0:
            return
        self.kept += count
        part: dict[str, Values] = {}
        for sensor, values in raw.items():
            cut = values[: count * WINDOW].reshape(count, WINDOW, 3)
            part[sensor] = cut.mean(axis=1)
            part[f"{sensor} scatter"] = np.sqrt(np.sum(cut.var(axis=1), axis=1))
            part[f"{sensor} noise"] = np.sqrt(np.sum(np.diff(cut, axis=1) ** 2, axis=2).mean(axis=1) / 2.0)
            done = calibrated[sensor][: count * WINDOW].reshape(count, WINDOW, 3)
            part[f"{sensor} size"] = np.linalg.norm(done, axis=2).mean(axis=1)  # a matrix may hold the factor
            part[f"{sensor} after"] = done.mean(axis=1)
        if time is not None:
            part["time"] = time[: count * WINDOW].reshape(count, WINDOW).mean(axis=1)
        self.windows.append(part)

    def warnings(self, calibrated: set[str]) -> list[str]:
        """Return what contradicts that the calibration of these sensors belongs to this log; often nothing."""
        found = [f"{self.compensated}: the log is compensated already"] if self.compensated else []
        if self.reversed:
            found.append(
                f"the time runs backwards at {self.reversed} of {self.samples} samples, first at "
                f"{self.first_reversed}: effects of the time and the smoothing of the temperature are wrong there; "
                "sort the log by its time"
            )
        if self.repeated:
            found.append(f"the time of {self.repeated} of {self.samples} samples is that of the sample before")
        found += [
            f"all readings of the {sensor} are whole numbers: they look like raw counts, and are read in "
            f"{'g' if sensor == 'accelerometer' else 'deg/s'}; --ingest names a profile with unit: counts"
            for sensor in SENSORS
            if self.whole.get(sensor)
        ]
        found += self._beyond(calibrated)
        if self.windows:
            table = {k: np.concatenate([w[k] for w in self.windows]) for k in self.windows[0]}
            kept = np.all([np.isfinite(v.reshape(len(v), -1)).all(axis=1) for v in table.values()], axis=0)
            table = {k: v[kept] for k, v in table.items()}
            if kept.any():
                found += self._units(table) + self._rests(table, calibrated)
        return found

    def _units(self, table: Mapping[str, Values]) -> list[str]:
        """Compare the median of |a| with 1 g."""
        if "accelerometer" not in table or self.whole.get("accelerometer"):
            return []
        size = float(np.median(table["accelerometer size"]))
        if STRANGE_G[0] <= size <= STRANGE_G[1]:
            return []
        alike = [unit for unit, factor in FORCE_UNITS.items() if abs(size / factor - 1.0) < NEAR]
        cause = f"the readings look like {alike[0]}" if alike else "another unit, another range, or no rest in the log"
        told = f"half of the log has |a| above {size:.3g} g, expected about 1 g: {cause}"
        return [f"{told}; --ingest names a profile with the unit of each column"]

    def _rests(self, table: Mapping[str, Values], calibrated: set[str]) -> list[str]:
        """Compare the errors of rests before and after compensation."""
        present = [s for s in SENSORS if s in table]
        still = np.ones(len(table[present[0]]), bool)
        for sensor in present:
            scatter = table[f"{sensor} scatter"]
            still &= scatter <= QUIET * np.minimum(np.quantile(scatter, QUIETEST), table[f"{sensor} noise"])
        if "accelerometer" in table:
            size = np.linalg.norm(table["accelerometer"], axis=1)
            still &= table["accelerometer scatter"] < DIRECTED * size
        if np.count_nonzero(still) < FEWEST_RESTS:
            return []
        found, worse, far = [], [], []
        for sensor in (s for s in present if s in calibrated):
            raw, done = table[sensor][still], table[f"{sensor} after"][still]
            before, after = _error(sensor, raw), _error(sensor, done)
            known = float(np.median(table[f"{sensor} scatter"][still])) / np.sqrt(WINDOW)
            change = np.linalg.norm(done, axis=1) - np.linalg.norm(raw, axis=1)
            enough = len(_directions(raw)) >= FEWEST_RESTS and np.sqrt(np.mean(change**2)) > after / 2.0
            unit = "g from 1 g" if sensor == "accelerometer" else "deg/s from zero"
            if (sensor == "gyroscope" or enough) and after > max(WORSE[sensor] * before, KNOWN * known):
                worse.append(f"the {sensor} is {before:.2g} {unit} before and {after:.2g} after")
            least = float(np.min(_distances(sensor, done)))
            if least > CHANGED[sensor]:
                far.append(f"the {sensor} is at least {least:.2g} {unit}")
        if worse:
            found.append(
                f"compensation takes the {np.count_nonzero(still)} quietest windows away from rest: "
                f"{'; '.join(worse)}. The log is compensated already, or of another unit or sensor, or read with "
                "other axes or units; or the sensor has changed since it was calibrated"
            )
        elif far:
            found.append(
                f"none of the {np.count_nonzero(still)} quietest windows is at rest after compensation: "
                f"{'; '.join(far)}. The log is of another unit or sensor, or read with another profile, axes or units; "
                "the sensor has changed since it was calibrated; or it moves throughout the log"
            )
        return found + self._turned(table, still)

    @staticmethod
    def _turned(table: Mapping[str, Values], still: Mask) -> list[str]:
        """Compare the turns of gravity between rests with the integrated rate."""
        if not {"accelerometer", "gyroscope", "time"} <= set(table):
            return []
        at = np.flatnonzero(still)
        up = table["accelerometer"][at] / np.linalg.norm(table["accelerometer"][at], axis=1)[:, None]
        angle = np.degrees(np.arccos(np.clip(np.sum(up[1:] * up[:-1], axis=1), -1.0, 1.0)))
        step = np.diff(table["time"], prepend=table["time"][0])
        rate = table["gyroscope after"] - table["gyroscope after"][at].mean(axis=0)  # whatever is subtracted as bias
        path = np.cumsum(np.linalg.norm(rate, axis=1) * np.clip(step, 0.0, None))[at]
        moved = angle > APART_DEG
        turned, integral = float(angle[moved].sum()), float(np.diff(path)[moved].sum())
        if turned == 0.0 or integral > turned / 2.0:
            return []
        cause = "rad/s" if abs(np.degrees(integral) / turned - 1.0) < 1.0 else "another unit or range"
        told = f"gravity turns by {turned:.3g} deg between rests, over which the gyroscope integrates to {integral:.3g}"
        return [f"{told} deg: its readings look like {cause}; --ingest names a profile with the unit of each column"]


def _distances(sensor: str, means: Values) -> Values:
    """Return the distance of each rest from 1 g or from zero rate."""
    size = np.linalg.norm(means, axis=1)
    return np.asarray(np.abs(size - 1.0) if sensor == "accelerometer" else size)


def _error(sensor: str, means: Values) -> float:
    """Return the rms distance of rests from 1 g or from zero rate."""
    return float(np.sqrt(np.mean(_distances(sensor, means) ** 2)))


def _directions(means: Values) -> list[Values]:
    """Return directions of the means that are apart from each other."""
    found: list[Values] = []
    for mean in means / np.linalg.norm(means, axis=1)[:, None]:
        if all(mean @ other < np.cos(np.radians(APART_DEG)) for other in found):
            found.append(mean)
    return found
