"""What came of a corrupted unit: refused, doubtful, right, or a silent error; by the published files and the truth.

    silent: the sensor is calibrated, the verdict is ``nothing_missing`` or names an effect that is no cause, and
        some |parameter - truth| > 5 U, or
        the held-out error is above 3 times or below 1/3 of its noise floor, or
        the held-out motion is called held out though it shares samples with a fit, or
        the exported sampling rate is off by over 2 %

where U is the stated expanded uncertainty of that parameter.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from imu_research.figures import MeasuredFigure, wilson

if TYPE_CHECKING:
    from collections import Counter
    from pathlib import Path

    from unit_copy import Copy, Truth

MANY_U, MANY_FLOORS, OF_RATE, ALIKE = 5.0, 3.0, 0.02, 0.95
LEAST_U = 1e-9  # of elements that a method fixes
REFUSED, DOUBTFUL, NAMED, RIGHT = "refused", "doubtful", "named", "right"
MARKED, UNSEEN, SILENT = "marked", "unseen", "SILENT"
OUTCOMES = (REFUSED, DOUBTFUL, NAMED, RIGHT, MARKED, UNSEEN, SILENT)


@dataclass(frozen=True)
class Judgement:
    """What came of one sensor of a unit."""

    unit: str
    kind: str
    way: str
    base: str
    sensor: str
    outcome: str
    verdict: str
    reasons: tuple[str, ...]
    message: str
    harmless: bool
    said: str

    @property
    def needless(self) -> bool:
        """Whether it is refused or doubted though nothing that counts was changed."""
        return self.harmless and self.outcome in (REFUSED, DOUBTFUL)

    @property
    def line(self) -> str:
        """One line for a report."""
        wrong = "; ".join(self.reasons)
        return f"{self.unit} {self.base} {self.sensor}: {self.way} {self.said}: {self.verdict}; {wrong}"


def judge(copy: Copy, results: Path) -> list[Judgement]:
    """Return what came of each sensor of a unit, by the files that a run published."""
    calibration = _read(results / "calibrations" / f"{copy.name}.json")
    validation = _read(results / "validations" / f"{copy.name}.json")
    diagnosis = _read(results / "diagnoses" / f"{copy.name}.json")
    if calibration["status"] != "ok":
        error = calibration["error"] or {}
        return [_judged(copy, s, REFUSED, error.get("code", ""), (), str(error.get("message"))) for s in copy.truth]
    turns = _turns(copy, calibration)
    out = []
    for sensor in copy.truth:
        found, held, said = (document.get(sensor) for document in (calibration, validation, diagnosis))
        if found is None:
            out.append(_judged(copy, sensor, REFUSED, "null", (), str(calibration["not_calibrated"].get(sensor))))
            continue
        wrong = [_wrong_parameters(found, copy.truth[sensor], turns[sensor]), _wrong_error(held), _leak(copy, held)]
        wrong.append(_wrong_rate(copy, results / "exports" / copy.name / "kalibr.yaml"))
        out.append(_calibrated(copy, sensor, found, said, [w for w in wrong if w]))
    return out


def shares_of(outcomes: Counter[str]) -> list[MeasuredFigure]:
    """Return the share of each outcome among the sensors of corrupted units; the goal is that none is silent."""
    total = outcomes.total()
    goals = {SILENT: "<= 0 %"}
    return [
        MeasuredFigure(f"corrupted: {o}", outcomes[o] / total, total, goals.get(o, ""), wilson(outcomes[o], total))
        for o in OUTCOMES
    ]


def refused(copy: Copy, message: str) -> list[Judgement]:
    """Return the judgement of a unit whose configuration is refused."""
    return [_judged(copy, sensor, REFUSED, "bad_configuration", (), message) for sensor in copy.truth]


def _calibrated(copy: Copy, sensor: str, found: Any, said: Any, reasons: list[str]) -> Judgement:
    verdict = said["verdict"] if said else "no diagnosis"
    named = verdict == "missing_effect" and _is_cause(said, {*copy.causes, *copy.truth[sensor].hidden})
    whole = f"{verdict} {','.join(said['selected'])}" if said and said["selected"] else verdict
    message = ""
    if named:
        outcome = NAMED
    elif verdict not in ("nothing_missing", "missing_effect") or (verdict == "missing_effect" and not reasons):
        outcome = DOUBTFUL
    elif not reasons:
        outcome = RIGHT
    else:
        outcome = UNSEEN if copy.unseen else MARKED if found.get("implausible") else SILENT
        message = copy.unseen
    return _judged(copy, sensor, outcome, whole, tuple(reasons), message)


def _wrong_parameters(found: Any, truth: Truth, turn: np.ndarray) -> str:
    """Return how far the worst parameter is off, in its expanded uncertainties, where that is too far."""
    worst, where = 0.0, ""
    for name, true in (("bias", truth.bias), ("matrix", turn @ truth.matrix)):
        off = np.abs(np.array(found[name]) - true)
        stated = np.array(found["expanded_uncertainty"][name], float)  # None: nan
        ratio = off / np.maximum(np.nan_to_num(stated), LEAST_U)
        at = np.unravel_index(int(np.argmax(ratio)), ratio.shape)
        if ratio[at] > worst:
            worst, where = float(ratio[at]), f"{name}{[int(i) for i in at]} off by {off[at]:.3g}"
    return f"{where}, {worst:.3g} U" if worst > MANY_U else ""


def _wrong_error(held: Any) -> str:
    if not held or not held.get("steps") or not held.get("noise_floor"):
        return ""
    ratio = held["steps"][-1]["rms_error"] / held["noise_floor"]
    return f"held-out error {ratio:.3g} x the floor" if not 1.0 / MANY_FLOORS <= ratio <= MANY_FLOORS else ""


def _leak(copy: Copy, held: Any) -> str:
    return "called held out, but is not" if copy.leaked and held and held.get("held_out") else ""


def _is_cause(said: Any, known: set[str]) -> bool:
    """Return whether the first selected effect is a cause, or the document says that it looks like one."""
    if not said["selected"]:
        return False
    first = said["selected"][0]
    entry = next(e for e in said["ranking"] if e["effect"] == first)
    alike = {a["effect"] for a in entry["look_alikes"] if a["share"] > ALIKE}
    return bool(({first} | alike) & known)


def _turns(copy: Copy, calibration: dict[str, Any]) -> dict[str, np.ndarray]:
    """Return by which rotation the true matrices differ from the frame of a method that needs no table.

    Its x of the sensor is x of the body, and y lies in the plane of both: the accelerometer's matrix is lower
    triangular, with a positive diagonal. The gyroscope's is in that frame where it is found from the same moves. On a
    table the fit of effects replaces the matrix by that in the frame of the turns.
    """
    methods = calibration["methods"]
    in_turns = calibration["table"] != "hand" and any((calibration["accelerometer"] or {}).get("effects", []))
    free = methods["accelerometer"] == "nonlinear_least_squares" and not in_turns
    turn = np.eye(3)
    if free:
        q, r = np.linalg.qr(copy.truth["accelerometer"].matrix[:, ::-1])
        turn = (q * np.sign(np.diag(r)))[:, ::-1].T
        turn = turn * np.sign(np.linalg.det(turn))  # a mirrored frame is none
    return {"accelerometer": turn, "gyroscope": turn if methods["gyroscope"] == "rests_and_moves" else np.eye(3)}


def _wrong_rate(copy: Copy, path: Path) -> str:
    match = re.search(r"update_rate: *([0-9.eE+-]+)", path.read_text(encoding="utf-8")) if path.is_file() else None
    if match is None or abs(float(match[1]) * copy.interval_s - 1.0) <= OF_RATE:
        return ""
    return f"exported rate {match[1]} Hz instead of {1.0 / copy.interval_s:.4g} Hz"


def _judged(  # noqa: PLR0917  (what a judgement is made of)
    copy: Copy, sensor: str, outcome: str, verdict: str, reasons: tuple[str, ...], message: str
) -> Judgement:
    said = " ".join(f"{k}={v}" for k, v in copy.said.items())
    return Judgement(
        copy.name, copy.kind, copy.way, copy.base, sensor, outcome, verdict, reasons, message, copy.harmless, said
    )


def _read(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
