"""Find the layout of an unknown text log, and its likely columns of time, readings, temperature and table log.

The result only serves to propose a profile. It is never applied without the user's request.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from imu_logs import units
from imu_logs.errors import IngestError
from imu_logs.files import BINARY, is_binary
from imu_logs.log import Values
from imu_logs.profile import COMMENTED, DROP, GAP

Triad = tuple[int, int, int]

COUNTING = 0.98  # share of steps by exactly 1
FEW = 0.01  # share of rows at which it falls: between sessions
MOSTLY = 0.2  # share of rows at which the time of a log without names rises
FEWEST_RISES = 4  # of a time, per fall; a noisy reading falls as often as it rises
MAX_INTERVAL_SCATTER = 0.2  # of intervals, relative to their median: above, times are of arrival, not of sampling
OF_A_RATE = 0.5  # relative spread of the length of a rate, and more; of a specific force in flight less
LARGEST_SPREAD = 0.2  # relative, of the length of a vector that is gravity: a walk
LOW_COST_ERROR = 0.12  # bias and scale factor of a low-cost sensor in one position
TEMPERATURE_RANGE = (-60.0, 130.0)  # degC, of electronics and their tests

OFFSETS = (32768.0, 8192.0, 2048.0)  # middle of unsigned 16, 14 and 12 bits
NEAR_OFFSET = 1 / 16  # of the offset, for median rates: 16 deg/s of +-250 deg/s, above usual biases

WORD = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d")
MERGED = re.compile(r"(a|ac|acc|accl|accel|f|g|gy|gyr|gyro|w|om|omega|rot|rate)([xyz])")
IN_G = re.compile(r"[xyz]_?g", re.IGNORECASE)  # a rate, or a specific force in g
AXIS_WORDS = ("x", "y", "z", "0", "1", "2", "3")
WORDS = {meaning: set(words.split()) for meaning, words in units.NAMES["words"].items()}
NO_SENSOR = WORDS["no_readings"]  # of other sensors, of estimates, and of acceleration without gravity
BODY_RATES = ("p", "q", "r")  # about x, y and z, in aeronautics (ISO 1151-1)
COMMENTS = ("#", "%", "//")  # starts of lines that are no data
NOT_FINITE = ("", "nan", "-nan", "inf", "-inf", "+inf", "null", "none")  # cells without a number
MAX_BAD_ROWS = 0.01  # of the rows; a column with more of other text is no column of numbers
SQUARED = (["s"], ["ms"], ["mps"])  # words before a 2 that is an exponent, not an axis
LINES_TRIED = 400  # with each separator
TEXT_TRIED = 1 << 16  # bytes that show whether a file is a text
BYTES_OF_A_CHARACTER = 4  # at most, of UTF-8
MOST_ROWS_OF_NAMES = 2  # above the last one: of the sensor, of the channel
SINCE_1970_S = (1e9, 4e9)  # 2001 to 2096
MAX_PARSED_ROWS = 200_000  # that are parsed; limits the time
MIN_ROWS = MIN_COLUMNS = 3  # of the log of a three-axis sensor
SEPARATORS = (",", ";", "\t", "|", " ")
NUMBER = {
    ".": re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?"),
    ",": re.compile(r"[+-]?(\d+,?\d*|,\d+)([eE][+-]?\d+)?"),
}
STATED_NUMBER = re.compile(r"[\s,;:=]+(\d+(\.\d+)?)\s*(hz)?\s*$", re.IGNORECASE)
RATE_KEY = re.compile(r"(fs|odr|(sampl\w*[ _]?)?(rate|freq\w*))\b", re.IGNORECASE)


@dataclass
class Columns:
    """The indices of the columns that probably contain the channels of a log."""

    log: UnknownLog
    time: int | None = None
    counter: int | None = None  # of samples
    arrival: int | None = None  # a time with scattering intervals; a counter without gaps then gives the time
    triads: dict[str, Triad] = field(default_factory=dict)  # sensor to its x, y, z
    others: dict[str, int] = field(default_factory=dict)  # temperature, table_angle ..
    steady: bool = True  # time, or the counter of samples, never decreases
    turn: tuple[float, str] | None = None  # counts per turn of the table's encoder, and the evidence
    remarks: list[str] = field(default_factory=list)
    guessed: bool = False  # the triads follow from their numbers alone

    def free(self) -> list[int]:
        """Return the columns of numbers that are assigned to no channel."""
        used = {*self.of_time(), *self.others.values(), *sum(self.triads.values(), ())}
        return [i for i in self.log.numbers if i not in used]

    def of_time(self) -> set[int]:
        """Return the columns of the time, of a counter, and those that repeat it, as arrays of one recording may."""
        numbers, taken = self.log.numbers, {self.time, self.counter, self.arrival} - {None}
        return {i for i in numbers if any(np.array_equal(numbers[i], numbers[t]) for t in taken if t is not None)}


def whole(values: Values) -> bool:
    """Return whether all values are integers."""
    return bool(np.all(values == np.rint(values)))


def words_of(name: str) -> list[str]:
    """Return the words of a name in lower case, without brackets at its end unless they contain an axis."""
    bracket = units.BRACKETS.search(name)
    axis = bracket is not None and bracket.group(1).strip().lower() in AXIS_WORDS
    words = [w.lower() for w in WORD.findall(name if axis or bracket is None else name[: bracket.start()])]
    merged = [(w, MERGED.fullmatch(w)) for w in words]
    return [part for w, match in merged for part in (match.groups() if match else (w,))]


def stated_unit(name: str, channel: str) -> tuple[str | None, str]:
    """Return the unit that a name states for a channel, in brackets or in its last words, and the evidence."""
    unit = units.unit_in_brackets(name)
    words = [w.lower() for w in WORD.findall(name)]
    while words and (words[-1] in ("x", "y", "z", "0", "1", "3") or (words[-1] == "2" and words[-2:-1] not in SQUARED)):
        words = words[:-1]
    ending = " ".join(words)
    if unit not in units.UNITS[channel]:
        matching = [
            candidate
            for candidate, spellings in units.NAMES["endings"].items()
            for s in spellings
            if candidate in units.UNITS[channel]
            and (ending.endswith(f" {s}") or (ending == s and s in WORDS["time_first"] | WORDS["time"]))
        ]
        unit = matching[0] if matching else units.SPELLINGS.get(words[-1]) if len(words) > 1 else None
    return (unit, f"the name says {unit}") if unit in units.UNITS[channel] else (None, "")


def find_columns(log: UnknownLog) -> Columns:
    """Return the columns that probably contain the channels of a log."""
    columns = Columns(log)
    words = {i: words_of(log.names[i]) if log.named else [] for i in log.numbers}
    _find_time(columns, words)
    times = columns.of_time()
    for sensor in (*units.TRIADS, "?"):
        named = {i: w for i, w in words.items() if i not in times and sensor_of(w) == sensor}
        triad = _triad(named)
        if triad is not None:
            columns.triads[sensor] = triad
            _remark_on_other_triads(columns, sensor, named)
    for sensor, triad in _triads_by_one_letter(log).items():
        if not times & set(triad):
            columns.triads.setdefault(sensor, triad)
    _find_forces_in_g(columns)
    axes_only = columns.triads.pop("?", None)
    if axes_only is not None and not columns.triads:
        columns.triads[_sensor_of_file(log, axes_only)] = axes_only
        columns.remarks.append(f"taken as the {next(iter(columns.triads))} by the file's name and numbers; check it")
    if not log.named or (log.arrays and not columns.triads):
        _find_triads_without_names(columns)
    for i, w in words.items():
        channel = _other_channel(log.names[i], w)
        low, high = TEMPERATURE_RANGE
        values = log.numbers[i]
        possible = low < float(np.median(values)) < high
        if channel and channel not in columns.others and (channel != "temperature" or possible or whole(values)):
            columns.others[channel] = i
        elif w == ["t"] and possible and not _advances(values):  # a column called T, which could also be a time
            columns.others.setdefault("temperature", i)
    return columns


def _find_forces_in_g(columns: Columns) -> None:
    """Take xg, yg, zg as a specific force in g if they have its size."""
    triad, names = columns.triads.get("gyroscope"), columns.log.names
    named = triad is not None and len(columns.triads) == 1 and all(IN_G.fullmatch(names[i]) for i in triad)
    if triad and named and is_gravity(columns.log, triad):
        columns.triads = {"accelerometer": triad}


def _triads_by_one_letter(log: UnknownLog) -> dict[str, Triad]:
    """Find triads of names that differ in one letter x, y, z next to the name of a sensor: axr, ayr, azr."""
    groups: dict[tuple[str, str], dict[str, int]] = {}
    for index in log.numbers if log.named else ():
        name = log.names[index].lower()
        for at in (i for i, letter in enumerate(name) if letter in "xyz"):
            groups.setdefault((name[:at], name[at + 1 :]), {})[name[at]] = index
    triads: dict[str, Triad] = {}
    single = {words_of(log.names[i])[0]: i for i in log.numbers if log.named and len(words_of(log.names[i])) == 1}
    if set(BODY_RATES) <= single.keys() and any(
        stated_unit(log.names[single[n]], units.GYROSCOPE[0])[0] for n in BODY_RATES
    ):
        triads["gyroscope"] = (single["p"], single["q"], single["r"])
    for (before, after), axes in groups.items():
        adjacent = {*re.findall("[a-z]+$", before), *re.findall("^[a-z]+", after)}
        for sensor in units.TRIADS:
            if len(axes) == len("xyz") and adjacent & WORDS[sensor]:
                triads.setdefault(sensor, (axes["x"], axes["y"], axes["z"]))
    return triads


def _axis_of(words: list[str]) -> str:
    """Return the last word that is an axis; empty for none."""
    return next((w for w in reversed(words) if w in AXIS_WORDS), "")


def sensor_of(words: list[str]) -> str:
    """Return the sensor that a name states, empty for none, ``?`` if the name is only an axis."""
    axis = _axis_of(words)
    if not axis or set(words) & NO_SENSOR:
        return ""
    before = words[: len(words) - 1 - words[::-1].index(axis)]
    return next((s for s in units.TRIADS if set(before) & WORDS[s]), "" if before else "?")


def _other_channel(name: str, words: list[str]) -> str:
    """Return the channel other than time and readings that a name states, empty for none."""
    canonical = [c for c in units.CHANNELS[6:] if name.lower().startswith(c)]
    if canonical:
        return canonical[0]
    if set(words) & WORDS["temperature"] and not set(words) & WORDS["other_temperature"]:
        return "temperature"
    if set(words) & WORDS["table"]:
        return next((c for c in ("table_rate", "table_angle") if set(words) & WORDS[c]), "")
    return ""


def _find_time(columns: Columns, words: dict[int, list[str]]) -> None:
    """Find the column of the time, or of a counter of samples."""
    numbers = columns.log.numbers
    rising = [i for i, v in numbers.items() if len(v) > 2 and bool(np.all(np.diff(v) > 0))]
    counters = [i for i, v in numbers.items() if len(v) > 2 and bool(np.mean(np.diff(v) == 1.0) > COUNTING)]
    of_sensor = {i: w for i, w in words.items() if w and not set(w) & WORDS["table"]}
    named = [i for i, w in of_sensor.items() if w[0] in WORDS["time_first"] or set(w) & WORDS["time"]]
    of_arrays = [i for i, v in numbers.items() if columns.log.arrays and _never_falls(v)]
    first = [i for i in of_arrays if columns.log.names[i].partition(" [")[0].endswith("[0]")]
    counting = {i for i, w in of_sensor.items() if set(w) & WORDS["counter"] and not set(w) & WORDS["time"]}
    counters += [i for i in rising if i in counting and i not in counters]
    if not columns.log.named:  # a time that some rows repeat or that starts again; a slow reading may rise, too
        steps = {i: np.diff(v) for i, v in numbers.items() if v[0] >= 0}
        rising = [i for i, d in steps.items() if np.mean(d > 0) > MOSTLY and np.mean(d < 0) < FEW]
        rising = [i for i in rising if i <= rising[0] + 1]
    unnamed = [i for i in sorted({*rising, *first}) if i not in counters and (not columns.log.named or i in of_sensor)]
    alike = all(np.array_equal(numbers[i], numbers[unnamed[0]]) for i in unnamed[1:])  # of each array of a recording
    unnamed = unnamed if not columns.log.named or (unnamed and alike) else []
    candidates = [i for i in named if i in rising] or [i for i in named if _advances(numbers[i])] or unnamed
    gap_free = [i for i in counters if i not in candidates and bool(np.all(np.diff(numbers[i]) == 1.0))]
    intervals = np.diff(numbers[candidates[0]]) if candidates else np.zeros(1)
    if gap_free and intervals.sum() > 0 and np.std(intervals) > MAX_INTERVAL_SCATTER * abs(float(np.median(intervals))):
        columns.arrival, columns.counter = candidates[0], gap_free[0]
    elif candidates:
        columns.time = candidates[0]
    elif counters:
        columns.counter = counters[0]
    index = columns.counter if columns.time is None else columns.time
    falls = 0 if index is None else int(np.count_nonzero(np.diff(numbers[index]) < 0))
    columns.steady = falls == 0  # a time that repeats is of samples in bursts
    if index is not None and falls:
        columns.remarks.append(
            f"{columns.log.names[index]} does not increase at {falls} rows: several sessions (session: 1, "
            "2 .. reads one of them), or a counter that overflows"
        )


def _never_falls(values: Values) -> bool:
    """Return whether numbers rise, or repeat the one before, like the times of samples in bursts."""
    return len(values) > MIN_ROWS and bool(np.all(np.diff(values) >= 0)) and bool(values[-1] > values[0])


def _advances(values: Values) -> bool:
    """Return whether numbers rise far more often than they fall, like times of several sessions."""
    steps = np.diff(values)
    return int(np.count_nonzero(steps > 0)) > FEWEST_RISES * int(np.count_nonzero(steps < 0))


def _triad(words: dict[int, list[str]]) -> Triad | None:
    """Return the columns of x, y and z among the columns of one sensor: the first of each axis."""
    axes = {_axis_of(w): index for index, w in reversed(words.items())}
    for names in ("xyz", "012", "123"):
        if set(names) <= axes.keys():
            x, y, z = (axes[n] for n in names)
            return x, y, z
    return None


def _remark_on_other_triads(columns: Columns, sensor: str, words: dict[int, list[str]]) -> None:
    """Add a remark on other triads for the same sensor: a second sensor of the board, or filtered readings."""
    groups: dict[tuple[str, ...], dict[int, list[str]]] = {}
    for index, w in words.items():
        at = len(w) - 1 - w[::-1].index(_axis_of(w))
        groups.setdefault((*w[:at], *w[at + 1 :]), {})[index] = w
    triads = [t for group in groups.values() if (t := _triad(group)) is not None]
    if len(triads) > 1:
        taken = ", ".join(columns.log.names[i] for i in columns.triads[sensor])
        others = "; ".join(", ".join(columns.log.names[i] for i in t) for t in triads if t != columns.triads[sensor])
        what = sensor if sensor != "?" else "sensor"
        remark = f"{len(triads)} triads may be the {what}: taken {taken}; the others are {others}; choose"
        columns.remarks.append(remark)


def _sensor_of_file(log: UnknownLog, triad: Triad) -> str:
    stem = Path(log.path).stem.lower()
    if "gyr" in stem or "angular" in stem or "rotation" in stem:
        return "gyroscope"
    return "accelerometer" if "acc" in stem or _spread(log, triad, _offset(log, [triad])) < 0.5 else "gyroscope"


def _offset(log: UnknownLog, triads: Sequence[Triad]) -> float:
    """Return the offset of unsigned counts, about which the readings of one sensor lie; 0 for other numbers."""
    readings = np.array([[log.numbers[i] for i in triad] for triad in triads])
    medians, unsigned = np.median(readings, axis=2), whole(readings) and readings.min() >= 0.0
    for offset in OFFSETS if unsigned and readings.max() < 2.0 * OFFSETS[0] else ():
        if np.abs(medians - offset).max(axis=1).min() < NEAR_OFFSET * offset:
            return offset
    return 0.0


def _spread(log: UnknownLog, triad: Triad, offset: float) -> float:
    """Return the relative spread of the length of a vector minus its offset, which is small for gravity."""
    norm = np.linalg.norm(np.column_stack([log.numbers[i] for i in triad]) - offset, axis=1)
    low, middle, high = np.quantile(norm, [0.16, 0.5, 0.84])
    return float((high - low) / max(middle, 1e-30))


def is_gravity(log: UnknownLog, triad: Triad) -> bool:
    """Return whether the length of vectors is gravity in g or m/s^2, or about it; a pressure in hPa would be mg."""
    size = float(np.median(np.linalg.norm([log.numbers[i] for i in triad], axis=0)))
    near = any(abs(size / units.FORCE_UNITS[unit] - 1.0) < LOW_COST_ERROR for unit in ("g", "m/s^2"))
    return near and _spread(log, triad, 0.0) < OF_A_RATE


def _find_triads_without_names(columns: Columns) -> None:
    """Find the triads of a log without names: the length of the accelerometer's vector varies least."""
    log = columns.log
    other = tuple(word for word in NO_SENSOR if len(word) > len("xyz") - 1)
    arrays: dict[str, list[int]] = {}
    for i, v in log.numbers.items():
        if i not in columns.of_time() and np.ptp(v) > 0 and not any(word in log.names[i].lower() for word in other):
            arrays.setdefault(log.names[i].partition("[")[0] if "[" in log.names[i] else "", []).append(i)
    groups = [triad for a in arrays.values() for triad in zip(a[::3], a[1::3], a[2::3], strict=False)]

    def called(triad: Triad) -> str:
        return f"columns {triad}" if not log.named else ", ".join(log.names[i] for i in triad)

    if len(groups) == 1:
        sensor = _sensor_of_file(log, groups[0])
        columns.triads[sensor] = groups[0]
        columns.guessed = "gyr" not in Path(log.path).stem.lower()
        columns.remarks.append(f"no names: {called(groups[0])} are taken as the {sensor}'s x, y, z; check it")
    elif groups:
        offset = _offset(log, groups)
        of_gravity = [group for group in groups if is_gravity(log, group)]
        force = min(of_gravity or groups, key=lambda group: _spread(log, group, offset))
        rate = next(group for group in groups if group != force)
        if not of_gravity and _spread(log, force, offset) > LARGEST_SPREAD:
            columns.remarks.append("no names, and no three columns have the length of gravity: state the columns")
            return
        columns.triads |= {"accelerometer": force, "gyroscope": rate}
        columns.guessed = True
        columns.remarks.append(
            f"no names: {called(force)} are taken as the accelerometer's x, y, z, because their length varies by only "
            f"{_spread(log, force, offset):.1%}, and {called(rate)} as the gyroscope's; check it"
        )


@dataclass(frozen=True)
class UnknownLog:
    """The columns of an unknown text log, or of a topic of a message log."""

    path: str
    csv: dict[str, Any]  # the section ``csv`` of a profile, without columns
    keys: list[str | int]  # of each column in a profile: name, index, or path of a field
    names: list[str]  # of the columns; for a field, with the unit that the file states
    numbers: dict[int, Values]  # columns with only finite numbers
    evidence: dict[str, str] = field(default_factory=dict)  # by key of ``csv``
    remarks: list[str] = field(default_factory=list)
    texts: dict[int, tuple[str, ...]] = field(default_factory=dict)  # the other columns
    topic: str | None = None
    arrays: bool = False  # the columns are those of arrays, acc[0], whose names need not say what they hold

    @property
    def named(self) -> bool:
        """Whether the columns have names."""
        return self.names != _numbered(len(self.names))


def find_layout(data: bytes, path: str) -> UnknownLog:
    """Split a text into columns; raises ``IngestError`` if it contains no table of numbers."""
    if is_binary(data[:TEXT_TRIED]):
        raise IngestError(f"{BINARY} (it starts with the bytes {data[:4].hex(' ')})", path, code="foreign")
    numbered = [(i, line) for i, line in enumerate(_decoded(data).splitlines()) if line.strip()]
    lines, places = [line for _, line in numbered], [i for i, _ in numbered]
    tried = [_try(lines[:LINES_TRIED], separator, decimal) for separator in SEPARATORS for decimal in NUMBER]
    width, start, separator, decimal = max(tried, key=lambda t: (t[0], -t[1]))
    names, skip, comment, by_index = _names(lines, start, separator)
    start = start if by_index or comment else skip + 1
    rate_hz, rate_line = _stated_rate(lines[:start])
    if start == 0 and (e4_rate := _rate_of_empatica(lines, separator)) is not None:
        rate_hz, rate_line, start, skip = e4_rate, lines[1].strip(), 2, 2
    parsed = lines[start : start + MAX_PARSED_ROWS]
    rows = [cells for cells in _cells(parsed, separator) if len(cells) == len(names)]
    bad = _bad_rows(rows, decimal)
    rows = [cells for i, cells in enumerate(rows) if i not in bad]
    numbers = _numbers(rows, decimal)
    if width < MIN_COLUMNS or len(rows) < MIN_ROWS or not numbers:
        first = " / ".join(lines[:3])[:150]
        hint = "a row of numbers for each sample is expected, with a separator between them and their names above"
        raise IngestError(
            f"no table of numbers was found in it; it starts with {first!r}", path, code="no_table", hint=hint
        )
    odd = len(parsed) - len(rows) - len(bad)
    skip = start if by_index else skip
    csv_section = {
        "delimiter": "whitespace" if separator == " " else separator,
        "decimal": decimal,
        "header": False if by_index else COMMENTED if comment is not None else True,
        "skip_lines": places[skip] if skip and comment is None else 0,
        "comment": comment,
        "rate_hz": rate_hz,
    }
    evidence = {"rate_hz": f"the file states {rate_line!r}"} if rate_hz is not None else {}
    texts = {i: cells for i, cells in enumerate(zip(*rows, strict=True)) if i not in numbers}
    remarks = [f"{odd} rows have another number of fields than the others"] if odd else []
    if bad:
        kinds = {"nan": GAP} if all(bad.values()) else {"bad_rows": DROP, **({"nan": GAP} if any(bad.values()) else {})}
        csv_section |= kinds
        what = f"{len(bad)} of {len(bad) + len(rows)} rows hold a cell that is no number: each is left out, and noted"
        evidence |= dict.fromkeys(kinds, what)
    keys = [*(range(len(names)) if by_index else names)]
    return UnknownLog(path, csv_section, keys, names, numbers, evidence, remarks, texts)


def _decoded(data: bytes) -> str:
    """Return the text without byte order mark: UTF-8, or another code of one byte a character."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        cut = error.start > len(data) - BYTES_OF_A_CHARACTER
        return data.decode("utf-8-sig", "replace") if cut else data.decode("latin-1")


def _stated_rate(lines: Sequence[str]) -> tuple[float | None, str]:
    """Return the sampling rate that a line above the table states, and the line."""
    stated = ((STATED_NUMBER.search(line), line.strip()) for line in lines if RATE_KEY.search(line))
    rates = ((float(match.group(1)), line) for match, line in stated if match)
    return next((rate for rate in rates if rate[0]), (None, ""))


def _rate_of_empatica(lines: list[str], separator: str) -> float | None:
    """Return the rate of an export of Empatica's E4: its first row repeats the start, its second one the rate in Hz."""
    first, second = ([*dict.fromkeys(cell.strip() for cell in cells)] for cells in _cells(lines[:2], separator))
    if len(first) == len(second) == 1 and NUMBER["."].fullmatch(first[0]) and NUMBER["."].fullmatch(second[0]):
        return float(second[0]) if SINCE_1970_S[0] < float(first[0]) < SINCE_1970_S[1] else None
    return None


def _cells(lines: Sequence[str], separator: str) -> list[list[str]]:
    if separator == " ":
        return [line.split() for line in lines]
    try:
        return list(csv.reader(lines, delimiter=separator, skipinitialspace=True))
    except csv.Error:  # a field that is too long, of a text that is no table
        return [[line] for line in lines]


def _numbered(count: int) -> list[str]:
    return [f"column {i}" for i in range(count)]


def _try(lines: list[str], separator: str, decimal: str) -> tuple[int, int, str, str]:
    """Return the number of columns of numbers for a separator and decimal point, and the line where they begin."""
    if not lines or (decimal == "," and (separator == "," or not any("," in line for line in lines))):
        return 0, 0, separator, decimal
    rows = _cells(lines, separator)
    counts = [sum(bool(NUMBER[decimal].fullmatch(c.strip())) for c in cells) for cells in rows]
    widths = [len(cells) for cells in rows]
    width, usual = (int(np.median(x[len(x) // 2 :])) for x in (counts, widths))
    start = next((i for i, (c, w) in enumerate(zip(counts, widths, strict=True)) if c >= width and w == usual), 0)
    return width, start, separator, decimal


def _names(lines: list[str], start: int, separator: str) -> tuple[list[str], int, str | None, bool]:
    """Return the names of the columns, the lines before them, the start of comments, and whether names do not serve.

    Where names repeat, those of several sensors or units of the columns, each is put behind the name above it, and a
    profile refers to the columns by their indices.
    """
    width = len(_cells([lines[start]], separator)[0]) if lines else 0
    line = lines[start - 1].lstrip() if start else ""
    comment = next((mark for mark in COMMENTS if line.startswith(mark)), None)
    above = _cells([line.removeprefix(comment or "").lstrip(comment or "")], separator) if start else []
    names = [c.strip() for c in above[0]] if above else []
    if len(names) == width - 1 and not _cells([lines[start]], separator)[0][-1].strip():
        names.append("")  # the rows end in a separator
    if len(names) == width + 1 and not names[-1]:
        names.pop()  # the header does
    if len(names) != width or any(NUMBER["."].fullmatch(name) for name in names):
        rows = enumerate(_cells(lines[:start], separator))  # names may stand above rows with empty cells
        found = [i for i, row in rows if len(row) == width and not any(NUMBER["."].fullmatch(c) or not c for c in row)]
        if not found:
            return _numbered(width), start, comment, True
        return [c.strip() for c in _cells(lines[found[0] : found[0] + 1], separator)[0]], found[0], None, False
    by_index = not names[0] or len(names) - names.count("") > len({*names} - {""})
    for cells in _cells(lines[max(start - 1 - MOST_ROWS_OF_NAMES, 0) : start - 1][::-1], separator):
        if not by_index or len({*names}) == width or len(cells) != width or not all(cells[1:]):
            break
        pairs = zip(cells, names, strict=True)
        names = [f"{cell} [{n}]".strip() if units.unit_spelt(n) else f"{cell} {n}".strip() for cell, n in pairs]
    return names, start - 1, comment, by_index


def _bad_rows(rows: list[list[str]], decimal: str) -> dict[int, bool]:
    """Return the few rows with a cell that is no number where other rows have one, and whether it is empty or NaN."""
    bad: dict[int, bool] = {}
    for cells in zip(*rows, strict=True):
        others = [i for i, cell in enumerate(cells) if not NUMBER[decimal].fullmatch(cell.strip())]
        if len(others) <= MAX_BAD_ROWS * len(rows):
            bad |= {i: cells[i].strip().lower() in NOT_FINITE and bad.get(i, True) for i in others}
    return bad


def _numbers(rows: list[list[str]], decimal: str) -> dict[int, Values]:
    """Return the columns that contain only finite numbers, by index."""
    columns = {}
    for index, cells in enumerate(zip(*rows, strict=True)):
        try:
            column = np.array([c.replace(",", ".") for c in cells] if decimal == "," else cells, np.float64)
        except ValueError:
            continue
        if np.isfinite(column).all():
            columns[index] = column
    return columns
