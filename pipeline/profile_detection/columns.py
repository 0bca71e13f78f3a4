"""Which columns of an unknown log may hold time, readings, temperature and the table's log."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipeline.io.units import TRIADS
from pipeline.profile_detection.column_names import axis_of, is_time, other_channel, sensor_of, words_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.profile_detection.text_layout import Shape

COUNTING = 0.98  # share of steps by exactly 1
SCATTER = 0.2  # of intervals over their median: times of arrival, not of sampling
TEMPERATURE_RANGE = (-60.0, 130.0)


@dataclass
class Columns:
    """Where the channels of a log may be, by index of column.

    Attributes
    ----------
    shape : Shape
    time : int or None
    counter : int or None
        A column that counts samples.
    arrival : int or None
        A time that scatters beside a counter without a gap, which then is the time.
    triads : dict of str to (int, int, int)
        Sensor to its x, y, z.
    others : dict of str to int
        ``temperature``, ``table_angle`` ...
    steady : bool
        Whether time, or what counts samples, never falls back.
    remarks : list of str
    """

    shape: Shape
    time: int | None = None
    counter: int | None = None
    arrival: int | None = None
    triads: dict[str, tuple[int, int, int]] = field(default_factory=dict)
    others: dict[str, int] = field(default_factory=dict)
    steady: bool = True
    remarks: list[str] = field(default_factory=list)


def find_columns(shape: Shape) -> Columns:
    """Return where the channels of a log may be."""
    found = Columns(shape)
    words = {i: words_of(shape.names[i]) if shape.header else [] for i in shape.numbers}
    _find_time(found, words)
    for sensor in (*TRIADS, "?"):
        named = {i: w for i, w in words.items() if sensor_of(w) == sensor}
        triad = _triad(named)
        if triad is not None:
            found.triads[sensor] = triad
            _tell_others(found, sensor, named)
    bare = found.triads.pop("?", None)
    if bare is not None and not found.triads:
        found.triads[_sensor_of_file(shape, bare)] = bare
        found.remarks.append(f"taken as the {next(iter(found.triads))} by the file's name and numbers; check it")
    if not shape.header:
        _triads_without_names(found)
    for i, w in words.items():
        channel = other_channel(shape.names[i], w)
        if channel and channel not in found.others and _possible(channel, shape.numbers[i]):
            found.others[channel] = i
    texts = [n for i, n in enumerate(shape.names) if i not in shape.numbers]
    if texts:
        found.remarks.append(f"left out, as not all of it is numbers: {', '.join(texts)}")
    return found


def _find_time(found: Columns, words: dict[int, list[str]]) -> None:
    numbers = found.shape.numbers
    rising = [i for i, v in numbers.items() if len(v) > 2 and bool(np.all(np.diff(v) > 0))]
    counters = [i for i, v in numbers.items() if _counts(v)]
    named = [i for i in numbers if is_time(words[i])]
    unnamed = [] if found.shape.header else [i for i in rising if i not in counters]
    candidates = [i for i in named if i in rising] or named or unnamed
    gap_free = [i for i in counters if i not in candidates and bool(np.all(np.diff(numbers[i]) == 1.0))]
    if candidates and gap_free and _scatters(numbers[candidates[0]]):
        found.arrival, found.counter = candidates[0], gap_free[0]
    elif candidates:
        found.time = candidates[0]
    elif counters:
        found.counter = counters[0]
    index = found.counter if found.time is None else found.time
    found.steady = index is None or index in rising
    if index is not None and index not in rising:
        back = int(np.count_nonzero(np.diff(numbers[index]) <= 0))
        found.remarks.append(
            f"{found.shape.names[index]} does not increase at {back} rows: sessions one after the other (session: 1, "
            "2 .. reads one of them), or a counter that overflows"
        )


def _scatters(time: NDArray[np.float64]) -> bool:
    steps = np.diff(time)
    return bool(np.std(steps) > SCATTER * abs(float(np.median(steps)))) and bool(time[-1] > time[0])


def _counts(values: NDArray[np.float64]) -> bool:
    return len(values) > 2 and bool(np.mean(np.diff(values) == 1.0) > COUNTING)


def _possible(channel: str, values: NDArray[np.float64]) -> bool:
    low, high = TEMPERATURE_RANGE
    return channel != "temperature" or low < float(np.median(values)) < high


def _triad(words: dict[int, list[str]]) -> tuple[int, int, int] | None:
    """Return the columns of x, y and z among those of one sensor, the first that ends so where there are several."""
    axes: dict[str, int] = {}
    for index, w in words.items():
        axes.setdefault(axis_of(w), index)
    for names in ("xyz", "012", "123"):
        if set(names) <= axes.keys():
            x, y, z = (axes[n] for n in names)
            return x, y, z
    return None


def _tell_others(found: Columns, sensor: str, words: dict[int, list[str]]) -> None:
    """Tell of further columns that may be the same sensor: another one of the board, or filtered readings."""
    groups: dict[tuple[str, ...], dict[int, list[str]]] = {}
    for index, w in words.items():
        at = len(w) - 1 - w[::-1].index(axis_of(w))
        groups.setdefault((*w[:at], *w[at + 1 :]), {})[index] = w
    triads = [t for group in groups.values() if (t := _triad(group)) is not None]
    if len(triads) > 1:
        texts = [", ".join(found.shape.names[i] for i in t) for t in triads]
        taken = ", ".join(found.shape.names[i] for i in found.triads[sensor])
        others = "; ".join(text for text in texts if text != taken)
        what = sensor if sensor != "?" else "sensor"
        found.remarks.append(f"{len(triads)} triads may be the {what}: taken {taken}; the others are {others}; choose")


def _sensor_of_file(shape: Shape, triad: tuple[int, int, int]) -> str:
    stem = Path(shape.path).stem.lower()
    if "gyr" in stem or "angular" in stem or "rotation" in stem:
        return "gyroscope"
    if "acc" in stem:
        return "accelerometer"
    return "accelerometer" if _spread(shape, triad) < 0.5 else "gyroscope"


def _spread(shape: Shape, triad: tuple[int, int, int]) -> float:
    """Return the relative spread of a vector's length: small for gravity."""
    norm = np.linalg.norm(np.column_stack([shape.numbers[i] for i in triad]), axis=1)
    low, middle, high = np.quantile(norm, [0.16, 0.5, 0.84])
    return float((high - low) / max(middle, 1e-30))


def _triads_without_names(found: Columns) -> None:
    """Find the sensors by what columns hold: gravity keeps its length."""
    shape = found.shape
    free = [i for i, v in shape.numbers.items() if i not in (found.time, found.counter) and np.ptp(v) > 0]
    groups = list(zip(free[::3], free[1::3], free[2::3], strict=False))
    if len(groups) == 1:
        sensor = _sensor_of_file(shape, groups[0])
        found.triads[sensor] = groups[0]
        found.remarks.append(f"no names: columns {groups[0]} are taken as the {sensor}'s x, y, z; check it")
    elif groups:
        first = min(range(len(groups)), key=lambda i: _spread(shape, groups[i]))
        found.triads["accelerometer"] = groups[first]
        found.triads["gyroscope"] = next(g for i, g in enumerate(groups) if i != first)
        text = (
            f"no names: columns {groups[first]} are taken as the accelerometer's x, y, z, for their length varies by "
        )
        text += f"{_spread(shape, groups[first]):.1%} only, {found.triads['gyroscope']} as the gyroscope's; check it"
        found.remarks.append(text)
