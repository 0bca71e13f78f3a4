"""By how much an attitude is off over held-out motion, before and after calibration."""

from __future__ import annotations

import numpy as np

from pipeline.report.axes import span
from pipeline.report.figure import JSON, Figure
from pipeline.report.numbers import number
from pipeline.report.shapes import Line
from pipeline.report.svg import Panel, chart

SMALLEST = 1e-3  # deg; a logarithm needs one


def attitude_over_time(found: JSON) -> Figure | None:
    """Draw the angle of the gyroscope alone, and the tilt of the fused attitude; None where there is none.

    Parameters
    ----------
    found : dict
        Part ``attitude`` of a validation.
    """
    curve = found.get("curve")
    if not curve:
        return None
    drift, tilt = found["drift_deg"], found.get("tilt_rms_deg")
    after = "one minute" if found["seconds"] == 60.0 else f"{number(found['seconds'])} s"
    finding = f"After {after} the attitude is {number(drift['after'])}° off, uncalibrated {number(drift['before'])}°"
    panels = [_panel(curve, "drift", "gyroscope alone, deg")]
    words = f"Gyroscope alone after {after}: {number(drift['before'])} deg before, {number(drift['after'])} deg after."
    if tilt:
        panels.append(_panel(curve, "tilt", "fused tilt, deg"))
        words += (
            f" Tilt of the fused attitude, rms: {number(tilt['before'])} deg before, {number(tilt['after'])} deg after."
        )
    svg = chart("attitude-error", finding, words, panels, "time, s")
    caption = (
        f"Angle to the table's attitude in {found['recording']}, which no fit saw, on a logarithmic axis. Above: the "
        f"gyroscope integrated from the table's attitude at the start (the figure of {after} is the root mean square "
        "over all starts)."
    )
    if tilt:
        caption += " Below: the vertical of a complementary filter that also takes the accelerometer."
    return Figure(svg, caption, (("c3", "before"), ("c2", "after")), finding)


def _panel(curve: JSON, name: str, label: str) -> Panel:
    time = np.array(curve["time_s"], float)
    before, after = (np.log10(np.maximum(np.array(curve[f"{name}_{w}"], float), SMALLEST)) for w in ("before", "after"))
    # the start, where both are right, would stretch a logarithmic axis
    seen = [values[len(values) // 50 + 1 :] for values in (before, after)]
    lines = [Line(time, np.maximum(v, min(map(np.min, seen))), c) for v, c in ((before, 3), (after, 2))]
    return Panel([*lines], label, 110, limits=span([*seen], 0.06), logarithmic=True)
