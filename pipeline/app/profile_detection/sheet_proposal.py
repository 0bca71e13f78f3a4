"""Propose the sheet ``recordings.csv`` for the files of a unit, from what their readings show; the user corrects it.

| readings | kind |
|---|---|
| no time column | ``attitudes`` |
| at rest in one attitude; the temperature changes by 10 degC or more | ``soak``, else ``rest`` |
| a rotation by 45 deg or more about one axis | ``turn``: whole turns where they fit, else the angle to 1 deg |
| three rests or more | ``moves`` |
| anything else | ``slow`` |

Axes of the gyroscope that contradict gravity are found from all motion: the direction u of the specific force in the
body changes by ``du/dt = -omega x u``. Of the 48 maps P of axes and signs, the one with the smallest
``sum |du/dt + P omega x u|^2`` is proposed where it is at most a quarter of that of the given axes.
"""

from __future__ import annotations

from itertools import permutations, product
from typing import TYPE_CHECKING

import numpy as np

from imu_logs.files import SUFFIXES
from imu_logs.profile import checks_of
from pipeline.core.errors import IngestError
from pipeline.core.records import AXES, NOISE_OF_ROWS, Recording, median
from pipeline.core.settings import RecordingFile
from pipeline.ingest.read import read_table, to_recording
from pipeline.physics.signal.rests import find_rests
from pipeline.physics.signal.segments import MAX_AXIS_SINE

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from imu_logs.log import Values
    from pipeline.core.settings import Settings
    from pipeline.physics.signal.rests import Rest

RESTING = 0.8  # share of a recording that lies still
SAME_ATTITUDE_DEG = 5.0
SWEPT_DEGC = 10.0  # as of a sweep that validation shows
LEAST_TURN_DEG = 45.0
WHOLE, ROUND_DEG = 0.05, 1.0  # relative: a scale factor error of 3 %, and a hand; of an angle that is proposed
SMOOTHED_S = 0.2
CLEARER = 0.25  # of the sum of squares, below which another map of axes is proposed
NO_RATE = np.zeros(3)


def proposed_sheet(folder: Path, settings: Settings) -> str:
    """Return the proposed sheet of a folder, with remarks; empty without a file."""
    sheet, remarks, found, rows = settings.procedure.sheet or "", [], list[Recording](), []
    files = [f for f in sorted(folder.glob("*")) if f.suffix in SUFFIXES and f.name != sheet and f.is_file()]
    for path in files:
        entry = RecordingFile(file=path.name, role="rests", axis=None, optional=False)
        try:
            checks = checks_of(settings.ingest)
            table = read_table([path], settings.ingest)
            found.append(to_recording(path.name, entry, table, settings.sensor, checks))
        except IngestError as error:
            if "time" in error.message and error.code == "missing_column":
                rows.append(f"{path.name},attitudes")
            else:
                remarks.append(f"# {path.name} cannot be read: {error.message.splitlines()[0]}")
    still = [r for r in found if _is_still(r) and r.gyroscope is not None]
    bias = median(np.array([np.asarray(r.gyroscope).mean(axis=0) for r in still])) if still else NO_RATE
    rows += [_row(recording, bias) for recording in found]
    wrong = _other_axes(found, bias)
    if wrong:
        remarks.append(
            f"# gravity and turns agree with sensor.gyroscope.axis_map=[{', '.join(wrong)}], not the given one"
        )
    lines = ["file,kind,axis,angle_deg,angle_accuracy_deg,held_out", *sorted(rows), *remarks]
    return "\n".join(lines) if files else ""


def _accepted(recording: Recording) -> list[Rest]:
    return [rest for rest in find_rests(recording) if rest.accepted]


def _is_still(recording: Recording) -> bool:
    """Return whether a recording is at rest in one attitude."""
    if recording.accelerometer is None:
        rate = np.asarray(recording.gyroscope)
        total = np.trapezoid(rate - median(rate), recording.time, axis=0)
        return bool(np.ptp(rate, axis=0).max() < 5.0 and np.abs(total).max() < SAME_ATTITUDE_DEG)
    rests = _accepted(recording)
    u = [recording.accelerometer[r.start : r.stop].mean(axis=0) for r in rests]
    apart = [np.degrees(np.linalg.norm(v / np.linalg.norm(v) - u[0] / np.linalg.norm(u[0]))) for v in u]
    return sum(r.stop - r.start for r in rests) > RESTING * recording.samples and max(apart) < SAME_ATTITUDE_DEG


def _row(recording: Recording, bias: Values) -> str:
    """Return the row of a recording; ``bias``: of the gyroscope at rest in other recordings."""
    if _is_still(recording):
        warm = recording.temperature
        swept = warm is not None and float(np.ptp(warm[np.isfinite(warm)])) >= SWEPT_DEGC
        return f"{recording.name},{'soak' if swept else 'rest'}"
    rests, rate = [] if recording.accelerometer is None else _accepted(recording), recording.gyroscope
    if rate is not None:
        own = np.mean([rate[r.start : r.stop].mean(axis=0) for r in rests], axis=0) if rests else bias
        angle = np.asarray(np.trapezoid(rate - own, recording.time, axis=0), np.float64)
        axis = int(np.argmax(np.abs(angle)))
        size, across = abs(float(angle[axis])), float(np.linalg.norm(np.delete(angle, axis)))
        turned = np.abs(np.trapezoid(np.linalg.norm(rate - own, axis=1), recording.time))
        if size > LEAST_TURN_DEG and across < MAX_AXIS_SINE * size and turned < 2.0 * size:
            name = f"{'-' if angle[axis] < 0.0 else ''}{AXES[axis]}"
            whole = 360.0 * round(size / 360.0)
            stated = "" if whole and abs(size - whole) < WHOLE * whole else f"{ROUND_DEG * round(size / ROUND_DEG):g}"
            return f"{recording.name},turn,{name},{stated}"
    return f"{recording.name},{'moves' if len(rests) > 2 else 'slow'}"


def _other_axes(recordings: Sequence[Recording], bias: Values) -> list[str]:
    """Return the map of the gyroscope's axes that agrees with gravity, if the given one does not; else empty."""
    pairs = []
    for r in recordings:
        if r.accelerometer is None or r.gyroscope is None or NOISE_OF_ROWS in r.source or r.samples < 100:
            continue
        size = max(1, round(SMOOTHED_S / r.interval))
        count = r.samples // size
        force, rate = (v[: count * size].reshape(count, size, 3).mean(axis=1) for v in (r.accelerometer, r.gyroscope))
        u = force / np.linalg.norm(force, axis=1, keepdims=True)
        middle = 0.5 * (u[2:] + u[:-2])
        pairs.append(((u[2:] - u[:-2]) / (2.0 * size * r.interval), np.radians(rate[1:-1] - bias), middle))
    if not pairs:
        return []
    change, omega, u = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
    costs = {}
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        rate = omega[:, order] * signs
        costs[order, signs] = float(np.sum((change + np.cross(rate, u)) ** 2))
    (order, signs), least = min(costs.items(), key=lambda item: item[1])
    if least > CLEARER * costs[(0, 1, 2), (1.0, 1.0, 1.0)]:
        return []
    body = {
        axis: f"{'+' if sign > 0.0 else '-'}{AXES[k]}" for k, (axis, sign) in enumerate(zip(order, signs, strict=True))
    }
    return [body[axis] for axis in range(3)]
