"""What the name of a column says: which channel it may hold, and in which unit."""

from __future__ import annotations

import re

from pipeline.io.units import BRACKETS, CHANNELS, SPELLINGS, UNITS, unit_in_brackets

WORD = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d")
MERGED = re.compile(r"(a|ac|acc|accl|accel|f|g|gy|gyr|gyro|w|omega|rot)([xyz])")
SENSOR_WORDS = {
    "accelerometer": {"a", "ac", "acc", "accl", "accel", "accelerometer", "acceleration", "f", "force"},
    "gyroscope": {"g", "gy", "gyr", "gyro", "gyroscope", "w", "omega", "rotation", "rot", "angular"},
}
NO_SENSOR = {"mag", "magnetometer", "magnetic", "gravity", "table", "encoder", "user", "variance", "covariance", "bias"}
TIME_FIRST = {"t", "ts", "sec", "secs", "tow", "utc", "epoch", "elapsed", "date"}
TIME_WORDS = {"time", "timestamp", "datetime", "millis", "micros", "seconds", "ticks", "zeit", "tiempo", "temps"}
TABLE_WORDS = {"table", "turntable", "encoder", "enc"}
OTHERS = {
    "temperature": {"temp", "temperature", "tmp"},
    "table_angle": {"angle", "position", "pos", "deg", "encoder", "enc"},
    "table_rate": {"rate", "speed", "velocity", "vel", "dps"},
}
UNIT_ENDINGS = (
    ("m/s^2", ("m s 2", "mps 2", "ms 2")), ("deg/s", ("dps", "deg s", "degps")),
    ("rad/s", ("rad s", "rads", "radps", "rad")), ("degC", ("degc", "deg c", "c")), ("mg", ("mg",)), ("g", ("g",)),
    ("s", ("s", "sec")), ("ms", ("ms", "millis")), ("us", ("us", "micros")), ("ns", ("ns",)), ("deg", ("deg",)),
)  # fmt: skip


def words_of(name: str) -> list[str]:
    """Return the words of a name in lower case, what stands in brackets at its end as an axis or left out."""
    bracket = BRACKETS.search(name)
    axis = bracket is not None and bracket.group(1).strip().lower() in ("0", "1", "2", "3", "x", "y", "z")
    text = name if axis or bracket is None else name[: bracket.start()]
    words = [w.lower() for w in WORD.findall(text)]
    merged = [(w, MERGED.fullmatch(w)) for w in words]
    return [part for w, found in merged for part in (found.groups() if found else (w,))]


def axis_of(words: list[str]) -> str:
    """Return the axis that a name ends in, or has before its unit: ``x``, ``y``, ``z`` or a digit; empty for none."""
    return next((w for w in reversed(words) if w in ("x", "y", "z", "0", "1", "2", "3")), "")


def sensor_of(words: list[str]) -> str:
    """Return the sensor that a name names, empty for none, ``?`` where it is an axis alone."""
    axis = axis_of(words)
    if not axis or set(words) & NO_SENSOR:
        return ""
    before = words[: len(words) - 1 - words[::-1].index(axis)]
    for sensor, known in SENSOR_WORDS.items():
        if set(before) & known:
            return sensor
    return "" if before else "?"


def is_time(words: list[str]) -> bool:
    """Return whether a name names a time of the sensor's clock."""
    return bool(words) and not set(words) & TABLE_WORDS and (words[0] in TIME_FIRST or bool(set(words) & TIME_WORDS))


def other_channel(name: str, words: list[str]) -> str:
    """Return the channel beside time and readings that a name names, empty for none."""
    canonical = [c for c in CHANNELS[6:] if name.lower().startswith(c)]
    if canonical:
        return canonical[0]
    if set(words) & OTHERS["temperature"]:
        return "temperature"
    if set(words) & TABLE_WORDS:
        return next((c for c in ("table_rate", "table_angle") if set(words) & OTHERS[c]), "")
    return ""


def stated_unit(name: str, channel: str) -> tuple[str | None, str]:
    """Return the unit of a channel that a name states, in brackets or in its last words, and how.

    Parameters
    ----------
    name : str
    channel : str
        ``accel_x``, ``time`` ...; a unit that it cannot have is none.
    """
    unit = unit_in_brackets(name)
    if unit in UNITS[channel]:
        return unit, f"the name says {unit}"
    words = [w.lower() for w in WORD.findall(name)]
    while words and words[-1] in ("x", "y", "z", "0", "1", "3"):
        words = words[:-1]
    ending = " ".join(words)
    for unit, spellings in UNIT_ENDINGS:
        for spelling in spellings:
            alone = ending == spelling and spelling in TIME_WORDS
            if unit in UNITS[channel] and (alone or ending.endswith(f" {spelling}")):
                return unit, f"the name says {unit}"
    found = SPELLINGS.get(words[-1]) if len(words) > 1 else None
    return (found, f"the name says {found}") if found in UNITS[channel] else (None, "")
