"""What was recorded: length, rate, motion and temperature of each recording, and where it rests."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.records import SENSORS
from pipeline.report.chart import WIDTH, Axis, Figure, svg, text
from pipeline.report.numbers import NOTHING, number, plain
from pipeline.signal.rests import rests_from_table

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.records import Recording
    from pipeline.signal.rests import Rest

JSON = dict[str, Any]
LEFT, RIGHT, ROW, TOP = 86, 14, 17, 4  # px
USES = {"used": 1, "held out": 2, "left out": 0}  # of the rests that a fit found by itself, with their colours
LOGGED = 4  # colour of rests from a table's log
STILL = 0.02  # deg/s, below which a table's log is noise of its rate
MARKS = ("after a gap", "clipped", "stuck", "repaired")  # of samples, by the bits of their flags
Spans = list[tuple[float, float, int]]


def rests_logged(recordings: list[Recording]) -> dict[str, list[Rest]]:
    """Return the rests that a table's log shows, by recording."""
    return {r.name: rests_from_table(r) for r in recordings}


def rest_rows(part: JSON) -> list[JSON]:
    """Return the rests that were found without a table, in order of time: used, held out or left out, and why.

    Parameters
    ----------
    part : dict
        With ``rests``, or with the stages of a fit that tell them in ``details``.
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
            "duration": number(float(r.time[-1] - r.time[0]) if r.samples else None, 4),
            "rate": number(1.0 / r.interval if r.samples > 1 and r.interval > 0 else None, 4),
            "motion": _motion(r, len(rests[r.name])),
            "temperature": _range(r.temperature),
            "flagged": _flagged(r),
        }
        for r in recordings
    ]


def _motion(recording: Recording, rests: int) -> str:
    """Return how a table moved, in words."""
    rate = recording.table_rate
    if rate is None:
        return "at rest" if recording.role == "static" else "by hand or not logged"
    fastest = float(np.max(np.abs(rate), initial=0.0))
    if fastest < STILL:
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
    counts = [(int(np.count_nonzero(recording.flags & (1 << bit))), kind) for bit, kind in enumerate(MARKS)]
    return ", ".join(f"{count} {kind}" for count, kind in counts if count)


def environment(recordings: list[Recording], settings: JSON) -> list[tuple[str, str]]:
    """Return the conditions that influence the result, by name: temperature, gravity, Earth's rotation, filter."""
    table = settings.get("table") or {}
    temperature = sensor_temperature(recordings)
    latitude, azimuth = table.get("latitude_deg"), table.get("azimuth_deg")
    rotation = "not in the model (latitude or azimuth not stated)"
    if latitude is not None and azimuth is not None:
        rotation = f"in the model, latitude {latitude:g}°, azimuth {azimuth:g}°"
    total = sum(float(r.time[-1] - r.time[0]) for r in recordings if r.samples)
    return [
        ("temperature of the sensor", f"{temperature} °C" if temperature else "not recorded"),
        ("recorded", f"{number(total, 4)} s"),
        ("local gravity", f"{table.get('gravity_g') or 1.0:.7g} g"),
        ("Earth's rotation", rotation),
        ("filter", plain((settings.get("filter") or {}).get("name", "none"))),
    ]


def sensor_temperature(recordings: list[Recording]) -> str | None:
    """Return the range of the sensor's temperature over all recordings, degC; None where it was not recorded."""
    known = [r.temperature for r in recordings if r.temperature is not None and np.isfinite(r.temperature).any()]
    return _range(np.concatenate(known)) if known else None


def segments(recordings: list[Recording], rests: dict[str, list[Rest]], calibration: JSON) -> Figure | None:
    """Draw where each recording rests; None where no rest is known.

    Parameters
    ----------
    recordings : list of Recording
    rests : dict of str to list of Rest
        Of ``rests_logged``.
    calibration : dict
        As in its file; ``rests``, or stages in ``details``, hold those that were found without a table.
    """
    drawn = [r for r in recordings if r.samples > 1]
    cut = len({r.source.get("file") for r in drawn}) == 1 < len(drawn)  # from one file: drawn at their time in it
    first = min((float(r.time[0]) for r in drawn), default=0.0)
    lanes = [(r, first if cut else float(r.time[0]), _spans(r, rests[r.name], calibration)) for r in drawn]
    if not any(spans for *_, spans in lanes):
        return None
    x = Axis(0.0, max(float(r.time[-1]) - start for r, start, _ in lanes), LEFT, WIDTH - RIGHT)
    ticks, bottom = x.ticks(6), TOP + ROW * len(lanes)
    out = [f'<path class="grid" d="{"".join(f"M{at:.1f} {TOP}V{bottom}" for at, _ in ticks)}"/>']
    out += [_lane(r, start, spans, x, TOP + ROW * i) for i, (r, start, spans) in enumerate(lanes)]
    out += [text(at, bottom + 13, label, "m") for at, label in ticks]
    out.append(text((LEFT + WIDTH - RIGHT) / 2, bottom + 27, "time since the start of the recording, s", "m"))
    count = sum(len(spans) for *_, spans in lanes)
    finding = f"{count} rest{'s' if count != 1 else ''} in {len(lanes)} recordings"
    words = "; ".join(f"{r.name}: {len(spans)}" for r, _, spans in lanes)
    figure = svg("segments", finding, f"Rests of each recording. {words}.", bottom + 34, "".join(out))
    colours = {colour for *_, spans in lanes for *_, colour in spans}
    legend = tuple((f"c{c}", f"rest, {use}") for use, c in USES.items() if c in colours) or ((f"c{LOGGED}", "rest"),)
    return Figure(figure, "Thick: at rest; thin: in motion.", legend, finding)


def _lane(recording: Recording, origin: float, spans: Spans, x: Axis, top: float) -> str:
    """Return the lane of one recording: its name, a line over its time and a block for each rest."""
    middle, low = top + ROW / 2, top + ROW / 2 - 4
    begin, end = (x.pixels(float(recording.time[k]) - origin) for k in (0, -1))
    name = recording.name if len(recording.name) <= 13 else recording.name[:12] + "…"
    out = text(LEFT - 5, middle + 4, name, "e")
    out += f'<path class="line c3" d="M{begin:.1f} {middle:g}H{end:.1f}"/>'
    scale = (x.stop - x.start) / (x.high - x.low)
    for colour in sorted({s[2] for s in spans}):
        ends = ((begin + scale * a, max(scale * (b - a), 0.8)) for a, b, c in spans if c == colour)
        blocks = "".join(f"M{at:.1f} {low:g}h{width:.1f}v8h-{width:.1f}z" for at, width in ends)
        out += f'<path class="bar c{colour}" d="{blocks}"/>'
    return out


def _spans(recording: Recording, logged: list[Rest], calibration: JSON) -> Spans:
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
