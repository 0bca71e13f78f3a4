"""Check whether a log matches the calibration that is applied to it. The checks only give warnings.

    rest  : a window of 100 samples whose scatter is at most twice the scatter of the quietest tenth of the windows, and
            at most twice the scatter of successive differences (no slow motion); its specific force is well above its
            scatter
    error : ||a| - 1 g| or |w| of the mean reading of a rest, before and after compensation

The correct calibration reduces the errors of rests, and some of them become small. Otherwise the log is already
compensated, belongs to another unit or sensor, or is read with wrong axes or units; or the sensor has changed.
Between two rests gravity turns in the body by at most the integral of |w| (minus its value at rest). If the gyroscope
integrates to less than half of the turn, its unit is not deg/s.

``apply`` writes numbers rounded to 12 decimals without trailing zeros: 9 of 10 cells have 12 decimals. Sensors give
fewer digits, programs that write doubles give more.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from imu_logs.units import FORCE_UNITS
from pipeline.core.errors import InputError
from pipeline.core.records import SENSORS, Mask, Values, finite_rows

DECIMALS = 12  # in the output of ``apply``: far below the resolution of sensors, above the rounding of a double
TEMPERATURE_RANGE, SOAKED = "temperature_degc", "soaked_degc"  # of ``calibrated_range``
RANGES = {"accelerometer": "specific_force_g", "gyroscope": "angular_rate_dps"}  # of ``calibrated_range``
# Margins of the calibrated range, by convention: the sign of the bias of a low-cost sensor, some % of 1 g, differs
# between directions; the temperature of a room, and of a chip from one power-on to the next, changes by 1 degC.
RANGE_MARGIN, MARGIN_DEGC = 0.1, 1.0  # share of the largest magnitude; degC
WINDOW_SAMPLES = 100  # samples: 0.1 to 1 s at usual rates
MOST_WINDOWS = 20_000  # 2 million samples, 6 MB: limits the memory
QUIET_RATIO, QUIET_SHARE = 2.0, 0.1  # ratio of scatters, and share of the windows; see above
FEWEST_RESTS = 3  # directions of gravity, for three axes
DIRECTED = 0.1  # scatter over mean of a rest's specific force: its direction is known to 0.1 / sqrt(100) rad = 0.6 deg
# Largest ratio of the errors after and before. If a drift is as large as the bias, with three components each, a ratio
# of 3 occurs by chance with P(F(3, 3) < 1/9) = 4 %. An accelerometer is only checked with three directions or more, and
# if the correction is at least half of the error after it.
WORSE_FACTORS = {"accelerometer": 1.2, "gyroscope": 3.0}
# g and deg/s: larger changes of the bias are unusual. By the temperature limits of the MPU-6050 (1.4 mg/degC and 0.32
# deg/s/degC, configs/sensor/mpu6050.yaml) they need 36 degC and 16 degC.
CHANGED = {"accelerometer": 0.05, "gyroscope": 5.0}
SIGNIFICANT_ERRORS = 5.0  # least error after compensation, in standard errors of the mean of a rest
APART_DEG = 30.0  # least angle between different orientations, and least turn of gravity for the check of the rate
# relative difference between the median |a| and the factor of a unit that identifies the unit
UNIT_FACTOR_DISTANCE = 0.15
USUAL_G = (0.5, 2.0)  # median |a| of a log, also of walking, driving and flying
CELLS, LEAST_CELLS, SHARE = 200, 10, 0.6  # of a column; least share of cells with 12 decimals, 0.9 expected
MIN_DIFFERENT_COUNTS = 10  # least number of different integers that indicates raw counts


class LogChecks:
    """Statistics of a log, collected block by block in limited memory; ``calibrated_range``: of the calibration."""

    def __init__(self, calibrated_range: Mapping[str, float | list[float]] | None = None) -> None:
        self.samples = self.reversed = self.repeated = self.window_count = 0
        self.first_reversed = ""
        self.last_time = -np.inf
        self.windows: list[dict[str, Values]] = []
        self.whole: dict[str, bool] = {}
        self.compensated = ""  # evidence that the log is already compensated
        self.ranges = {key: v if isinstance(v, list) else [-np.inf, v] for key, v in (calibrated_range or {}).items()}
        self.soaked = self.ranges.pop(SOAKED, None)  # the temperatures within which a soak determined the bias
        if self.soaked:
            self.ranges[TEMPERATURE_RANGE] = self.soaked
        self.extremes: dict[str, list[float]] = {}  # beyond the range: number of samples, lowest and highest value

    def extrapolated(self, temperature: Values) -> Mask:
        """Return which samples are beyond the soaked temperatures: (n,) array; none without a soak."""
        low, high = self.soaked or (-np.inf, np.inf)
        return np.asarray((temperature < low) | (temperature > high))

    def require_within(self, file: str) -> None:
        """Raise ``InputError`` if samples are beyond the soaked temperatures."""
        if self.soaked and TEMPERATURE_RANGE in self.extremes:
            count, least, most = self.extremes[TEMPERATURE_RANGE]
            message = f"--strict: {count:.0f} samples at {least:.1f} to {most:.1f} degC are beyond the soaked"
            raise InputError(f"{message} temperatures, {self.soaked[0]:.1f} to {self.soaked[1]:.1f} degC", file)

    def check_decimals(self, columns: Sequence[Any], decimal: str) -> None:
        """Check whether the readings of a text log have the decimals that ``apply`` writes."""
        cells = [str(cell) for column in columns for cell in column[:CELLS].to_pylist()]
        decimals = [cell.partition(decimal)[2] for cell in cells if "e" not in cell.lower()]
        full = sum(len(text) == DECIMALS for text in decimals)
        often = len(decimals) >= LEAST_CELLS and full > SHARE * len(decimals)
        if often and not any(len(text) > DECIMALS or (len(text) == DECIMALS and text[-1] == "0") for text in decimals):
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
            finite = values[np.isfinite(values)]
            if self.whole.get(sensor, True) and len(finite):
                self.whole[sensor] = bool(np.all(finite[:WINDOW_SAMPLES] == np.round(finite[:WINDOW_SAMPLES]))) and (
                    sensor in self.whole or len(np.unique(finite[: 10 * WINDOW_SAMPLES])) >= MIN_DIFFERENT_COUNTS
                )
        self._add_windows(raw, calibrated, time)

    def _add_extremes(self, raw: Mapping[str, Values], temperature: Values | None) -> None:
        values = {RANGES[s]: np.linalg.norm(v, axis=1) for s, v in raw.items()}
        values |= {} if temperature is None else {TEMPERATURE_RANGE: temperature}
        for key in values.keys() & self.ranges.keys():
            low, high = self.ranges[key]
            margin = MARGIN_DEGC * (not self.soaked) if key == TEMPERATURE_RANGE else RANGE_MARGIN * high
            beyond = values[key][(values[key] < low - margin) | (values[key] > high + margin)]
            if len(beyond):
                count, least, most = self.extremes.get(key, [0, np.inf, -np.inf])
                self.extremes[key] = [count + len(beyond), min(least, beyond.min()), max(most, beyond.max())]

    def _beyond(self, calibrated: set[str]) -> list[str]:
        warnings = []
        for key, (count, least, most) in sorted(self.extremes.items()):
            low, high = self.ranges[key]
            if key == TEMPERATURE_RANGE:
                what = f"temperatures from {least:.1f} to {most:.1f} degC, calibrated from {low:.1f} to {high:.1f} degC"
                todo = "soak it there" if self.soaked else "record turns at these temperatures (procedure thermal_ramp)"
            else:
                sensor = next(s for s, k in RANGES.items() if k == key)
                if sensor not in calibrated:
                    continue
                quantity, unit = ("specific force", "g") if sensor == "accelerometer" else ("angular rate", "deg/s")
                what = f"{quantity} up to {most:.3g} {unit}, calibrated up to {high:.3g} {unit}"
                todo = f"record motion that reaches this {quantity}"
            warnings.append(
                f"{count:.0f} of {self.samples} samples are beyond what the recordings of the calibration contain: "
                f"{what}. There the calibration extrapolates, and its stated uncertainty does not hold: {todo} "
                "and calibrate with it, or do not rely on these samples"
            )
        return warnings

    def _add_windows(self, raw: Mapping[str, Values], calibrated: Mapping[str, Values], time: Values | None) -> None:
        """Store means and scatter of the windows of a block."""
        count = min(len(next(iter(raw.values()), ())) // WINDOW_SAMPLES, MOST_WINDOWS - self.window_count)
        if count <= 0:
            return
        self.window_count += count
        part: dict[str, Values] = {}
        for sensor, values in raw.items():
            windows = values[: count * WINDOW_SAMPLES].reshape(count, WINDOW_SAMPLES, 3)
            part[sensor] = windows.mean(axis=1)
            part[f"{sensor} scatter"] = np.sqrt(np.sum(windows.var(axis=1), axis=1))
            part[f"{sensor} noise"] = np.sqrt(np.sum(np.diff(windows, axis=1) ** 2, axis=2).mean(axis=1) / 2.0)
            after = calibrated[sensor][: count * WINDOW_SAMPLES].reshape(count, WINDOW_SAMPLES, 3)
            part[f"{sensor} size"] = np.linalg.norm(after, axis=2).mean(axis=1)  # the matrix may contain the unit
            part[f"{sensor} after"] = after.mean(axis=1)
        if time is not None:
            part["time"] = time[: count * WINDOW_SAMPLES].reshape(count, WINDOW_SAMPLES).mean(axis=1)
        self.windows.append(part)

    def warnings(self, calibrated: set[str]) -> list[str]:
        """Return the warnings: signs that the calibration of these sensors does not belong to this log."""
        warnings = [f"{self.compensated}: the log is compensated already"] if self.compensated else []
        if self.reversed:
            warnings.append(
                f"the time runs backwards at {self.reversed} of {self.samples} samples, first at "
                f"{self.first_reversed}: effects of the time and the smoothing of the temperature are wrong there; "
                "sort the log by its time"
            )
        if self.repeated:
            warnings.append(f"the time of {self.repeated} of {self.samples} samples is that of the sample before")
        warnings += [
            f"all readings of the {sensor} are whole numbers: they look like raw counts, and are read in "
            f"{'g' if sensor == 'accelerometer' else 'deg/s'}; --ingest names a profile with unit: counts"
            for sensor in SENSORS
            if self.whole.get(sensor)
        ]
        warnings += self._beyond(calibrated)
        if self.windows:
            table = {k: np.concatenate([w[k] for w in self.windows]) for k in self.windows[0]}
            valid = np.all([finite_rows(v.reshape(len(v), -1)) for v in table.values()], axis=0)
            table = {k: v[valid] for k, v in table.items()}
            if valid.any():
                warnings += self._units(table) + self._rests(table, calibrated)
        return warnings

    def _units(self, table: Mapping[str, Values]) -> list[str]:
        """Compare the median of |a| with 1 g."""
        if "accelerometer" not in table or self.whole.get("accelerometer"):
            return []
        size = float(np.median(table["accelerometer size"]))
        if USUAL_G[0] <= size <= USUAL_G[1]:
            return []
        near = [unit for unit, factor in FORCE_UNITS.items() if abs(size / factor - 1.0) < UNIT_FACTOR_DISTANCE]
        cause = f"the readings look like {near[0]}" if near else "another unit, another range, or no rest in the log"
        contradiction = f"half of the log has |a| above {size:.3g} g, expected about 1 g: {cause}"
        return [f"{contradiction}; --ingest names a profile with the unit of each column"]

    def _rests(self, table: Mapping[str, Values], calibrated: set[str]) -> list[str]:
        """Compare the errors of rests before and after compensation."""
        present = [s for s in SENSORS if s in table]
        still = np.ones(len(table[present[0]]), bool)
        for sensor in present:
            scatter = table[f"{sensor} scatter"]
            still &= scatter <= QUIET_RATIO * np.minimum(np.quantile(scatter, QUIET_SHARE), table[f"{sensor} noise"])
        if "accelerometer" in table:
            size = np.linalg.norm(table["accelerometer"], axis=1)
            still &= table["accelerometer scatter"] < DIRECTED * size
        if np.count_nonzero(still) < FEWEST_RESTS:
            return []
        warnings, worse, far = [], [], []
        for sensor in (s for s in present if s in calibrated):
            raw, compensated = table[sensor][still], table[f"{sensor} after"][still]
            before, after = _error(sensor, raw), _error(sensor, compensated)
            standard_error = float(np.median(table[f"{sensor} scatter"][still])) / np.sqrt(WINDOW_SAMPLES)
            change = np.linalg.norm(compensated, axis=1) - np.linalg.norm(raw, axis=1)
            enough = len(_directions(raw)) >= FEWEST_RESTS and np.sqrt(np.mean(change**2)) > after / 2.0
            unit = "g from 1 g" if sensor == "accelerometer" else "deg/s from zero"
            usual = max(WORSE_FACTORS[sensor] * before, SIGNIFICANT_ERRORS * standard_error)
            if (sensor == "gyroscope" or enough) and after > usual:
                worse.append(f"the {sensor} is {before:.2g} {unit} before and {after:.2g} after")
            least = float(np.min(_distances(sensor, compensated)))
            if least > CHANGED[sensor]:
                far.append(f"the {sensor} is at least {least:.2g} {unit}")
        if worse:
            warnings.append(
                f"compensation takes the {np.count_nonzero(still)} quietest windows away from rest: "
                f"{'; '.join(worse)}. The log is compensated already, or of another unit or sensor, or read with "
                "other axes or units; or the sensor has changed since it was calibrated"
            )
        elif far:
            warnings.append(
                f"none of the {np.count_nonzero(still)} quietest windows is at rest after compensation: "
                f"{'; '.join(far)}. The log is of another unit or sensor, or read with another profile, axes or units; "
                "the sensor has changed since it was calibrated; or it moves throughout the log"
            )
        return warnings + self._turned(table, still)

    @staticmethod
    def _turned(table: Mapping[str, Values], still: Mask) -> list[str]:
        """Compare the turns of gravity between rests with the integrated rate."""
        if not {"accelerometer", "gyroscope", "time"} <= set(table):
            return []
        up = table["accelerometer"][still] / np.linalg.norm(table["accelerometer"][still], axis=1)[:, None]
        angle = np.degrees(np.arccos(np.clip(np.sum(up[1:] * up[:-1], axis=1), -1.0, 1.0)))
        step = np.diff(table["time"], prepend=table["time"][0])
        rate = table["gyroscope after"] - table["gyroscope after"][still].mean(axis=0)  # without a remaining bias
        path = np.cumsum(np.linalg.norm(rate, axis=1) * np.clip(step, 0.0, None))[still]
        moved = angle > APART_DEG
        turned, integral = float(angle[moved].sum()), float(np.diff(path)[moved].sum())
        if turned == 0.0 or integral > turned / 2.0:
            return []
        cause = "rad/s" if abs(np.degrees(integral) / turned - 1.0) < 1.0 else "another unit or range"
        angles = f"gravity turns by {turned:.3g} deg between rests, where the gyroscope integrates to {integral:.3g}"
        return [f"{angles} deg: its readings look like {cause}; --ingest names a profile with the unit of each column"]


def _distances(sensor: str, means: Values) -> Values:
    """Return the distance of each rest from 1 g or from zero rate."""
    size = np.linalg.norm(means, axis=1)
    return np.asarray(np.abs(size - 1.0) if sensor == "accelerometer" else size)


def _error(sensor: str, means: Values) -> float:
    """Return the rms distance of rests from 1 g or from zero rate."""
    return float(np.sqrt(np.mean(_distances(sensor, means) ** 2)))


def _directions(means: Values) -> list[Values]:
    """Return directions of the means that differ by ``APART_DEG`` or more."""
    directions: list[Values] = []
    for mean in means / np.linalg.norm(means, axis=1)[:, None]:
        if all(mean @ other < np.cos(np.radians(APART_DEG)) for other in directions):
            directions.append(mean)
    return directions
