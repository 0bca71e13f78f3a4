"""Units that are calibrated by faces and turns by hand: simulated recordings, whole or in parts, and their fits."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from hand_session import Unit
from unit_settings import settings_of

from pipeline.physics.signal.rests import find_rests
from pipeline.physics.signal.segments import cut, held_out_windows
from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import UnitDescription, shipped_settings

PROCEDURE = shipped_settings(procedure="ferraris").procedure


class Session(Unit):
    """A unit whose truth is in the frame of its calibration."""

    def errors(self, sensor: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the error of bias and matrix, its standard uncertainty and degrees of freedom: (12,) arrays."""
        found = self.calibrated(sensor)
        assert found.covariance is not None
        assert found.freedom is not None
        truth = np.append(self.truth[sensor]["bias"], self.truth[sensor]["matrix"])
        error = np.append(found.bias, found.matrix) - truth
        return error, np.sqrt(np.diag(found.covariance))[:12], found.freedom[:12]


def simulated(seed: int, *, procedure: Any = None, **unit: Any) -> Session:
    """Return a simulated unit; ``procedure`` replaces settings of the procedure, ``unit`` those of its description."""
    groups = {"sensor": "mpu6050", "table": "hand", "procedure": "ferraris"}
    recordings, truth = simulate_unit(UnitDescription("U", **groups, **{"interval_s": 0.02, **unit}), seed, 0)
    return Session(recordings, truth, settings_of(settings_of(**groups), procedure=procedure or {}))


def held_out(session: Session) -> Session:
    """Return the session with every second turn held out, as the stage ingest cuts it."""
    first, *others = session.recordings
    parts = cut(first, held_out_windows(first, session.settings.procedure.turns), found=True)
    return replace(session, recordings=[*parts, *others])


def in_parts(session: Session) -> Session:
    """Return six rests and a turn about each axis as windows cut them out of one recording."""
    whole = session.recordings[0]
    rests = [r for r in find_rests(whole) if r.accepted]
    spans = [(f"face_{i}", None, r.start, r.stop) for i, r in enumerate(rests[:6])]
    assert whole.gyroscope is not None
    for before, after in pairwise(rests[6:]):
        angle = np.trapezoid(whole.gyroscope[before.stop : after.start], whole.time[before.stop : after.start], axis=0)
        axis = "xyz"[int(np.argmax(np.abs(angle)))]
        if np.abs(angle).max() > 300.0 and f"{axis}_rot" not in [name for name, *_ in spans]:
            spans.append((f"{axis}_rot", axis, before.start, after.stop))
    parts = []
    for name, axis, start, stop in spans:
        parts.append(replace(whole.select(slice(start, stop)), name=name, axis=axis))
    return replace(session, recordings=[*parts, *session.recordings[1:]])
