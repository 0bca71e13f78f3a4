"""What was recorded: length, rate, motion and temperature of each recording, and where it rests."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.records import SENSORS, Recording, Values
from pipeline.report.chart import Figure, Layer, Line, Panel, chart
from pipeline.report.numbers import NOTHING, number
from pipeline.signal.rests import Rest, rests_from_table

JSON = dict[str, Any]
LEFT, LANE, LETTERS = 86, 17, 13  # px of the names, px of a lane, letters of a name
USES = {"used": 1, "held out": 2, "left out": 0}  # of the rests that a fit found by itself, with their colours
LOGGED = 4  # colour of rests from a table's log
NARROWEST = 0.002  # of the axis: a shorter rest is drawn so wide
ANGLE_STEP_S = 0.2  # over which a rate is taken from an angle: an encoder of 0.01 deg gives it to 0.05 deg/s
STILL_ANGLE = 0.1  # deg/s, two steps of such an encoder
STILL = 0.02  # deg/s, below which a table's log is noise of its rate
MARKS = ("after a gap", "clipped", "stuck", "repaired")  # of samples, by the bits of their flags


def files_read(inputs: list[JSON] | None) -> list[JSON]:
    """Return file, hash and rows of each file of ``inputs`` of a calibration, also of those that were joined."""
    files = [file for entry in inputs or [] for file in (entry, *entry.get("joined", []))]
    return [{key: file.get(key) for key in ("file", "sha256", "rows")} for file in files]


def rests_logged(recordings: list[Recording]) -> dict[str, list[Rest]]:
    """Return the rests that a table's log shows, by recording."""
    return {r.name: rests_from_table(r) for r in recordings}


def rest_rows(part: JSON) -> list[JSON]:
    """Return the rests that were found without a table, in order of time: used, held out or left out, and why.

    ``part`` has them in ``rests``, or in the ``details`` of the stages of a fit.
    """
    found = [part.get("rests") or {}, *(stage.get("details") or {} for stage in part.get("stages") or [])]
    rows = [
        {**rest, "use": use}
        for rests in found
        for use in USES
        for rest in rests.get(f"rests_{use.replace(' ', '_')}") or []
    ]
    return sorted(rows, key=lambda row: (row["recording"], row["time_s"]))


def recording_rows(recordings: list[Recording], rests: dict[str, list[Rest]]) -> list[JSON]:
    """Return a row for each recording: what it is for, how long, how fast, how many rests, how warm."""
    return [
        {
            "name": r.name,
            "role": r.role + (f", {r.axis} axis" if r.axis else ""),
            "samples": r.samples,
            "duration": number(_duration(r) if r.samples else None, 4),
            "rate": number(1.0 / r.interval if r.samples > 1 and r.interval > 0 else None, 4),
            "motion": _motion(r, len(rests[r.name])),
            "temperature": _range(r.temperature),
            "flagged": _flagged(r),
        }
        for r in recordings
    ]


def _duration(recording: Recording) -> float:
    return float(recording.time[-1] - recording.time[0])


def _motion(recording: Recording, rests: int) -> str:
    rate, by = recording.table_rate, ""
    if rate is None and recording.table_angle is not None and recording.samples > 1:
        every = max(1, round(ANGLE_STEP_S / recording.interval)) if recording.interval > 0 else 1
        kept = recording.select(slice(None, None, every))
        assert kept.table_angle is not None  # noqa: S101  (as of the whole)
        rate, by = np.diff(kept.table_angle) / np.maximum(np.diff(kept.time), every * 1e-9), ", by its angle"
    if rate is None:
        logged = "the attitude is logged" if recording.table_attitude is not None else "by hand or not logged"
        return "at rest" if recording.role == "static" else logged
    fastest = float(np.max(np.abs(rate), initial=0.0))
    if fastest < (STILL_ANGLE if by else STILL):
        return "at rest"
    kind = "stop-and-go" if rests > 2 else "continuous"
    return f"{kind}, {rests} rest{'s' if rests != 1 else ''}, up to {number(fastest)} deg/s{by}"


def _range(values: Values | None) -> str:
    if values is None or not np.isfinite(values).any():
        return NOTHING
    return f"{np.nanmin(values):.1f} to {np.nanmax(values):.1f}"


def _flagged(recording: Recording) -> str:
    """Return how many samples ingest marked, by kind."""
    if recording.flags is None:
        return ""
    counts = [(int(np.count_nonzero(recording.flags & (1 << bit))), kind) for bit, kind in enumerate(MARKS)]
    return ", ".join(f"{count} {kind}" for count, kind in counts if count)


def environment(recordings: list[Recording], settings: JSON) -> JSON:
    """Return the conditions that influence the result: temperature, recorded time, table (gravity, place), filter."""
    return {
        "temperature": sensor_temperature(recordings),
        "recorded_s": sum(_duration(r) for r in recordings if r.samples),
        "table": settings.get("table") or {},
        "filter": (settings.get("filter") or {}).get("name", "none"),
    }


def sensor_temperature(recordings: list[Recording]) -> str | None:
    """Return the range of the sensor's temperature over all recordings, degC; None where it was not recorded."""
    known = [r.temperature for r in recordings if r.temperature is not None and np.isfinite(r.temperature).any()]
    return _range(np.concatenate(known)) if known else None


def segments(recordings: list[Recording], rests: dict[str, list[Rest]], calibration: JSON) -> Figure | None:
    """Draw where each recording rests, by the table's log or by the calibration; None where no rest is known."""
    drawn = [r for r in recordings if r.samples > 1]
    spans = {r.name: _spans(r, rests[r.name], calibration) for r in drawn}
    if not any(spans.values()):
        return None
    one_file = len({r.source.get("file") for r in drawn}) == 1 < len(drawn)
    first = min(float(r.time[0]) for r in drawn)
    begin = {r.name: float(r.time[0]) - first if one_file else 0.0 for r in drawn}
    narrowest = NARROWEST * max(begin[r.name] + _duration(r) for r in drawn)
    lanes = drawn[::-1]  # the first at the top
    layers: list[Layer] = []
    for y, r in enumerate(lanes, 1):
        layers.append(Line(np.array([0.0, _duration(r)]) + begin[r.name], np.full(2, float(y)), 3))
        for colour in sorted({c for *_, c in spans[r.name]}):
            ends = [(a, max(b, a + narrowest), np.nan) for a, b, c in spans[r.name] if c == colour]
            x = np.ravel(ends) + begin[r.name]
            layers.append(Line(x, np.full(len(x), float(y)), colour, "thick"))
    count, colours = sum(map(len, spans.values())), {c for of in spans.values() for *_, c in of}
    finding = f"{count} rest{'s' if count != 1 else ''} in {len(drawn)} recording{'s' if len(drawn) != 1 else ''}"
    legend = tuple((f"c{c}", f"rest, {use}") for use, c in USES.items() if c in colours) or ((f"c{LOGGED}", "rest"),)
    names = [r.name if len(r.name) <= LETTERS else f"{r.name[: LETTERS - 1]}…" for r in lanes]
    return chart(
        Figure("segments", finding, "Thick: rests that were found; thin: the remaining time.", legend),
        f"Rests of each recording. {'; '.join(f'{name}: {len(of)}' for name, of in spans.items())}.",
        [Panel(layers, "", LANE * len(lanes), limits=(0.5, len(lanes) + 0.5), rows=names)],
        "time since the start of the recording, s",
        left=LEFT,
    )


def _spans(recording: Recording, logged: list[Rest], calibration: JSON) -> list[tuple[float, float, int]]:
    """Return start, end (s since the recording's start) and colour of each rest."""
    start = float(recording.time[0])
    found = {
        (r["time_s"] - start, r["time_s"] - start + r["duration_s"], USES[r["use"]])
        for part in (calibration, *(calibration.get(s) or {} for s in SENSORS))
        for r in rest_rows(part)
        if r["recording"] == recording.name
    }
    time = recording.time - start
    return sorted(found) or [(float(time[r.start]), float(time[r.stop - 1]), LOGGED) for r in logged]
