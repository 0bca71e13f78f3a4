"""What was recorded: each recording's length, rate, motion and temperature, and where it rests and moves."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.records import SENSORS
from pipeline.report.axes import Scale, tick_label, tick_step, ticks
from pipeline.report.figure import JSON, Figure
from pipeline.report.numbers import NOTHING, number
from pipeline.report.svg import WIDTH, frame, text
from pipeline.report.tables import rest_rows
from pipeline.signal.rests import rests_from_table

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.records import Recording
    from pipeline.signal.rests import Rest

LEFT, RIGHT, ROW, TOP = 86, 14, 17, 4
FOUND = (("used", 1), ("held_out", 2), ("left_out", 0))  # of the rests that a fit found by itself; their colours
Spans = list[tuple[float, float, int]]


def rests_logged(recordings: list[Recording]) -> dict[str, list[Rest]]:
    """Return the rests that a table's log shows, by recording."""
    return {r.name: rests_from_table(r) for r in recordings}


def recording_rows(recordings: list[Recording], rests: dict[str, list[Rest]]) -> list[JSON]:
    """Return a row a recording: what it is for, how long, how fast, how many rests, how warm.

    Parameters
    ----------
    recordings : list of Recording
    rests : dict of str to list of Rest
        Of ``rests_logged``.
    """
    return [
        {
            "name": r.name,
            "role": r.role + (f", {r.axis} axis" if r.axis else ""),
            "samples": r.samples,
            "duration": number(float(r.time[-1] - r.time[0]) if r.samples else None, 4),
            "rate": number(1.0 / r.interval if r.samples > 1 and r.interval > 0 else None, 4),
            "motion": _motion(r, len(rests[r.name])),
            "temperature": _range(r.temperature),
            "flagged": _flagged(r),
        }
        for r in recordings
    ]


def environment(recordings: list[Recording], settings: JSON) -> list[tuple[str, str]]:
    """Return the conditions that influence the result, by name: temperature, gravity, Earth's rotation, filter."""
    table = settings.get("table") or {}
    warm = sensor_temperature(recordings)
    latitude, azimuth = table.get("latitude_deg"), table.get("azimuth_deg")
    chosen = (settings.get("filter") or {}).get("name", "none")
    total = sum(float(r.time[-1] - r.time[0]) for r in recordings if r.samples)
    return [
        ("temperature of the sensor", f"{warm} °C" if warm else "not recorded"),
        ("recorded", f"{number(total, 4)} s"),
        ("local gravity", f"{table.get('gravity_g') or 1.0:.7g} g"),
        (
            "Earth's rotation",
            "not in the model (latitude or azimuth not stated)"
            if latitude is None or azimuth is None
            else f"in the model, latitude {latitude:g}°, azimuth {azimuth:g}°",
        ),
        ("filter", chosen.replace("_", " ")),
    ]


def sensor_temperature(recordings: list[Recording]) -> str | None:
    """Return the range of the sensor's temperature over all recordings, degC; None where it was not recorded."""
    warm = [r.temperature for r in recordings if r.temperature is not None and np.isfinite(r.temperature).any()]
    return _range(np.concatenate(warm)) if warm else None


def segments(recordings: list[Recording], rests: dict[str, list[Rest]], calibration: JSON) -> Figure | None:
    """Draw where each recording rests; None where no rest is known.

    Parameters
    ----------
    recordings : list of Recording
    rests : dict of str to list of Rest
        Of ``rests_logged``.
    calibration : dict
        As in its file; ``rests``, or stages in ``details``, tell those that were found without a table.
    """
    drawn = [r for r in recordings if r.samples > 1]
    cut = len({r.source.get("file") for r in drawn}) == 1 < len(drawn)  # out of one file: drawn where they lie in it
    first = min((float(r.time[0]) for r in drawn), default=0.0)
    lanes = [(r, first if cut else float(r.time[0]), _spans(r, rests[r.name], calibration)) for r in drawn]
    if not any(spans for *_, spans in lanes):
        return None
    longest = max(float(r.time[-1]) - start for r, start, _ in lanes)
    x, bottom = Scale(0.0, longest, LEFT, WIDTH - RIGHT), TOP + ROW * len(lanes)
    at, step = ticks(0.0, longest, 6), tick_step(0.0, longest, 6)
    out = [f'<path class="grid" d="{"".join(f"M{x.pixels(t):.1f} {TOP}V{bottom}" for t in at)}"/>']
    out += [_lane(r, start, spans, x, TOP + ROW * i) for i, (r, start, spans) in enumerate(lanes)]
    out += [text(x.pixels(t), bottom + 13, tick_label(t, step), "m") for t in at]
    out.append(text((LEFT + WIDTH - RIGHT) / 2, bottom + 27, "time since the start of the recording, s", "m"))
    count = sum(len(spans) for *_, spans in lanes)
    finding = f"{count} rest{'s' if count != 1 else ''} in {len(lanes)} recordings"
    words = "; ".join(f"{r.name}: {len(spans)}" for r, _, spans in lanes)
    svg = frame("segments", finding, f"Rests of each recording. {words}.", bottom + 34, "".join(out))
    kinds = {colour for *_, spans in lanes for *_, colour in spans}
    legend = tuple((f"c{c}", f"rest, {k.replace('_', ' ')}") for k, c in FOUND if c in kinds) or (("c4", "rest"),)
    return Figure(svg, "Thick: at rest; thin: in motion.", legend, finding)


def _lane(recording: Recording, origin: float, spans: Spans, x: Scale, top: float) -> str:
    middle = top + ROW / 2
    begin, end = (x.pixels(float(recording.time[k]) - origin) for k in (0, -1))
    name = recording.name if len(recording.name) <= 13 else recording.name[:12] + "…"
    out = text(LEFT - 5, middle + 4, name, "e")
    out += f'<path class="line c3" d="M{begin:.1f} {middle:g}H{end:.1f}"/>'
    scale, low = (x.stop - x.start) / (x.high - x.low), middle - 4
    for colour in sorted({s[2] for s in spans}):
        ends = ((begin + scale * a, max(scale * (b - a), 0.8)) for a, b, c in spans if c == colour)
        drawn = "".join(f"M{at:.1f} {low:g}h{wide:.1f}v8h-{wide:.1f}z" for at, wide in ends)
        out += f'<path class="bar c{colour}" d="{drawn}"/>'
    return out


def _spans(recording: Recording, logged: list[Rest], calibration: JSON) -> Spans:
    """Return start, end (s since the recording's start) and colour of each rest."""
    start = float(recording.time[0])
    found: Spans = []
    colours = {kind.replace("_", " "): colour for kind, colour in FOUND}
    for part in (calibration, *(calibration.get(s) or {} for s in SENSORS)):
        for r in rest_rows(part):
            if r["recording"] == recording.name:
                found.append((r["time_s"] - start, r["time_s"] - start + r["duration_s"], colours[r["use"]]))
    if found:
        return sorted(set(found))
    time = recording.time - start
    return [(float(time[r.start]), float(time[r.stop - 1]), 4) for r in logged]


def _motion(recording: Recording, rests: int) -> str:
    """Return how a table moved, in words."""
    rate = recording.table_rate
    if rate is None:
        return "at rest" if recording.role == "static" else "by hand or not logged"
    fastest = float(np.max(np.abs(rate), initial=0.0))
    if fastest < 0.02:
        return "at rest"
    kind = "stop-and-go" if rests > 2 else "continuous"
    return f"{kind}, {rests} rest{'s' if rests != 1 else ''}, up to {number(fastest)} deg/s"


def _range(values: NDArray[np.float64] | None) -> str:
    if values is None or not np.isfinite(values).any():
        return NOTHING
    return f"{np.nanmin(values):.1f} to {np.nanmax(values):.1f}"


def _flagged(recording: Recording) -> str:
    """Return how many samples ingest marked, by kind."""
    if recording.flags is None or not recording.flags.any():
        return ""
    kinds = ("after a gap", "clipped", "stuck", "repaired")
    counts = [(int(np.count_nonzero(recording.flags & (1 << bit))), kind) for bit, kind in enumerate(kinds)]
    return ", ".join(f"{count} {kind}" for count, kind in counts if count)
