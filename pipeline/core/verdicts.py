"""The verdicts of a diagnosis on one sensor, and what they and other findings mean for the units of a campaign.

``pipeline.evaluation.diagnosis.verdict`` decides which verdict applies.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Any, NamedTuple

from imu_logs.units import SENSORS

WITH_THEM = " (with which U of the "  # between open effects and the uncertainty, in summary.csv and sentences
MARK_ABOVE_FLOORS = 3.0  # error over noise floor above which a unit is marked, and no verdict is shown as good
# the same of the angle after held-out moves by hand, over that by noise alone: those of a published Xsens miss by 5.9
# with its g-sensitivity left out, else by 1.7
MARK_AFTER_MOVES = 5.0
FAILED, INCOMPLETE, IMPLAUSIBLE, NOT_HELD_OUT = "failed", "incomplete", "implausible", "not_held_out"
NOT_CONVERGED, WORSE_THAN_RAW = "not_converged", "worse_than_raw"
FAR, BEYOND_ACCEPTANCE, READY = "far_above_noise", "beyond_acceptance", "ready"
SETTING = re.compile(r"\(([a-z_.]+=\w+)\)")  # a setting within a next step
FIGURES = {  # what decides a verdict: in the words of pages, index, terminal and ``summary.csv``, and its size
    "evidence": ("evidence for", "delta BIC {:.0f}"),
    "held_out": ("held-out error", ""),  # over the noise: see ``Error``
    "misfit": ("misfit of the fit", "{:.3g} x noise"),
    "scatter": ("scatter of the moves", "{:.3g} x noise"),
    "angle": ("angle after held-out moves", "{:.3g} x noise"),
    "angle_expected": ("angle after held-out moves", "{:.3g} x the largest expected"),
    "dependence": ("dependence of the residual on", ""),
    "check": ("check of the recordings", ""),
    "static": ("mean of the static recording", "{:.3g} x the largest expected"),
    "agreement": ("matrix on held-out motion", "{:.3g} x U"),
    "below": ("held-out error", "{:.3g} x the least expected"),
    "method": ("difference from a free fit", ""),
    "held": ("parameters that the sensor file determines", ""),
    "probability": ("probability of", ""),
}
DECIDED = re.compile(r"(?P<figure>.+), (?P<times>\S+) x (?P<of>.+)")


class Verdict(StrEnum):
    """A verdict, in the order in which lists name them: what can be added first, then what is in doubt."""

    MISSING_EFFECT = "missing_effect"
    REFERENCE_IN_DOUBT = "reference_in_doubt"  # table, held-out motion or static recording contradict each other
    UNEXPLAINED = "unexplained"
    FLOOR_IN_DOUBT = "floor_in_doubt"  # the estimate of the noise
    LEFT_BY_METHOD = "left_by_method"  # the approximations of the chosen method leave more than noise
    NOT_ENOUGH_DATA = "not_enough_data"
    NOTHING_MISSING = "nothing_missing"

    @property
    def css_class(self) -> str:
        """Class of the style sheet on the pages."""
        return {Verdict.NOT_ENOUGH_DATA: "", Verdict.NOTHING_MISSING: "good"}.get(self, "warn")


def css_class(verdict: str | None) -> str:
    """Return the class of a verdict of a document; empty for a sensor without one."""
    return Verdict(verdict).css_class if verdict in set(Verdict) else ""


DOUBTS = {Verdict.REFERENCE_IN_DOUBT, Verdict.UNEXPLAINED, Verdict.FLOOR_IN_DOUBT, Verdict.LEFT_BY_METHOD}


class Kind(NamedTuple):
    """A kind of problem."""

    name: str  # in lists
    meaning: str
    step: str  # where a diagnosis names none
    css_class: str = "warn"


KINDS = {  # the most urgent first
    FAILED: Kind("failed", "no calibration", "correct the cause, then run the same command again", "bad"),
    INCOMPLETE: Kind(
        "not complete", "a stage after the fit failed; the calibration does not depend on it",
        "read the cause on the unit's page", "bad",
    ),
    WORSE_THAN_RAW: Kind(
        "worse than raw", "the fit has a larger held-out error than the raw readings: the sensor is not calibrated",
        "read the cause on the unit's page", "bad",
    ),
    NOT_CONVERGED: Kind(
        "not converged", "the fit did not converge: parameters and uncertainties are in doubt",
        "record more, or fit fewer effects", "bad",
    ),
    Verdict.MISSING_EFFECT: Kind("effect missing", "the model lacks an effect that the recordings show", "add it"),
    IMPLAUSIBLE: Kind(
        "implausible", "a parameter is above four times the data sheet's limit",
        "check range, unit and columns, which the unit's page names",
    ),
    Verdict.REFERENCE_IN_DOUBT: Kind(
        "reference in doubt", "recordings contradict each other", "check table log and mounting, and record again"
    ),
    Verdict.UNEXPLAINED: Kind(
        "unexplained", "something exceeds the noise, and no effect of the catalogue explains it",
        "record what the unit's page proposes",
    ),
    Verdict.FLOOR_IN_DOUBT: Kind(
        "noise in doubt", "the noise estimate may be too large, and hide an effect", "record static again"
    ),
    Verdict.LEFT_BY_METHOD: Kind(
        "method too coarse", "approximations of method or filter cause an error above the noise",
        "calibrate with a method that fits the full matrix (method=reference_least_squares)",
    ),
    FAR: Kind(
        "far above noise",
        f"the held-out error is above {MARK_ABOVE_FLOORS:g} x noise, or the angle after held-out moves above "
        f"{MARK_AFTER_MOVES:g} x; the uncertainty of the calibration explains it, but does not show that it is good",
        "record more",
    ),
    Verdict.NOT_ENOUGH_DATA: Kind(
        "not enough data", "the recordings cannot show whether an effect is missing", "record more turns or poses"
    ),
    NOT_HELD_OUT: Kind(
        "not held out",
        "the error is that of the samples of the fit",
        "record held-out motion (validation; in a sheet, held_out=yes in the row of a file with moves or a turn)",
    ),
    BEYOND_ACCEPTANCE: Kind("fails its limits", "beyond a limit of acceptance", "see the unit's page", "bad"),
    READY: Kind("ready", "calibrated; nothing that the recordings can show is missing", "apply it", "good"),
}  # fmt: skip


def decided_words(figure: str, size: float | None = None, named: str = "") -> str:
    """Return the figure that decided a verdict in words: ``scatter of the moves, 7.2 x noise``."""
    words, sized = FIGURES[figure]
    return ", ".join(filter(None, [f"{words} {named}".rstrip(), "" if size is None else sized.format(size)]))


def figure_and_size(words: str) -> tuple[str, str]:
    """Return the two parts of ``decided_words``; the size may be empty."""
    figure, _, size = words.rpartition(", ")
    return (figure, size) if figure and re.search(r"\d", size) else (words, "")


class Error(NamedTuple):
    """The held-out rms error of a sensor before and after calibration, and what noise alone gives, in its unit."""

    kind: str  # "vector" where the attitude is known in every sample, else "magnitude"
    before: float | None
    after: float | None
    floor: float | None

    @property
    def ratio(self) -> float | None:
        """Error after calibration over the noise floor."""
        return self.after / self.floor if self.after is not None and self.floor else None


class Problem(NamedTuple):
    """What keeps units from being ready: a line of a campaign's page and of the terminal."""

    kind: str  # of ``KINDS``
    what: str  # sensors, with missing effects
    units: list[str]  # the worst first
    ratios: tuple[float, float] | None  # smallest and largest error over noise floor
    step: str  # what to do next
    effects: tuple[str, ...] = ()  # ``sensor.effect`` that are missing
    decided: str = ""  # the figure that decided a verdict, with its range in the units


def error_of(held_out: Mapping[str, Any] | None) -> Error:
    """Return the error that pages and terminal state; ``held_out``: the sensor's part of a validation."""
    steps = (held_out or {}).get("steps") or [{}]
    ends, floor = (steps[0], steps[-1]), (held_out or {}).get("vector_noise_floor")
    if floor and all(step.get("vector_rms_error") is not None for step in ends):
        return Error("vector", ends[0]["vector_rms_error"], ends[1]["vector_rms_error"], floor)
    before, after = (step.get("rms_error") for step in ends)
    return Error("magnitude", before, after, (held_out or {}).get("noise_floor"))


def error_in_row(row: Mapping[str, Any], sensor: str) -> Error:
    """Return the same from a row of ``summary.csv``."""
    by_vector = _number(row.get(f"{sensor}_vector_noise_floor"))
    kind, prefix = ("vector", f"{sensor}_vector") if by_vector else ("magnitude", sensor)
    return Error(kind, *(_number(row.get(f"{prefix}_{n}")) for n in ("error_before", "error_after", "noise_floor")))


class RowState(NamedTuple):
    """A row of ``summary.csv`` with its errors by sensor, and what keeps the unit from being ready."""

    row: Mapping[str, Any]
    errors: dict[str, Error]
    kinds: dict[str, list[str]]  # the most urgent kind first, each with the sensors concerned


def state_of(row: Mapping[str, Any] | RowState) -> RowState:
    """Return the state of a row; a state as it is."""
    if isinstance(row, RowState):
        return row
    errors = {sensor: error_in_row(row, sensor) for sensor in SENSORS}
    return RowState(row, errors, _kinds(row, errors))


def _number(value: Any) -> float | None:  # noqa: ANN401  (a cell: a number, a text of it, or nothing)
    if isinstance(value, str):
        value = float(value or "nan")
    return float(value) if value is not None and -math.inf < value < math.inf else None


def _kinds(row: Mapping[str, Any], errors: Mapping[str, Error]) -> dict[str, list[str]]:
    if row.get("status") != "ok":
        return {FAILED: []}
    causes = (row.get("incomplete") or "").split("; ")
    found: dict[str, list[str]] = {INCOMPLETE: []} if row.get("incomplete") else {}
    if str(row.get("pass")).lower() == "false":
        found[BEYOND_ACCEPTANCE] = []
    for sensor in SENSORS:
        verdict, ratio = row.get(f"{sensor}_verdict") or Verdict.NOTHING_MISSING, errors[sensor].ratio
        if any(cause.startswith(("diagnose: ", f"diagnose/{sensor}: ")) for cause in causes):
            verdict = Verdict.NOTHING_MISSING  # it is not known, and the kind is INCOMPLETE
        quiet = verdict in (Verdict.NOTHING_MISSING, Verdict.NOT_ENOUGH_DATA)
        kinds = [] if verdict == Verdict.NOTHING_MISSING else [str(verdict)]
        kinds += [FAR] * bool(quiet and ((ratio or 0.0) > MARK_ABOVE_FLOORS or _far_after_moves(row, sensor)))
        kinds += [
            kind for kind in (WORSE_THAN_RAW, NOT_CONVERGED, IMPLAUSIBLE, NOT_HELD_OUT) if row.get(f"{sensor}_{kind}")
        ]
        for kind in kinds:
            found.setdefault(kind, []).append(sensor)
    return {kind: found[kind] for kind in KINDS if kind in found} if len(found) > 1 else found


def moves_over_noise(validation: Mapping[str, Any]) -> float | None:
    """Return the mean angle after held-out moves by hand over that by noise alone; None without them."""
    found = validation.get("gravity_direction") or {}
    floor = found.get("noise_floor_deg")
    return found["mean_deg"]["after"] / floor if floor else None


def turn_errors(validation: Mapping[str, Any]) -> dict[str, float]:
    """Return the rms error of the angle of a sheet's held-out turns, deg, before and after; empty without them."""
    turns = validation.get("turns") or ()
    squares = {name: [(t["angle_deg"][name] - t["stated_deg"]) ** 2 for t in turns] for name in ("before", "after")}
    return {name: (sum(each) / len(turns)) ** 0.5 for name, each in squares.items()} if turns else {}


def _far_after_moves(row: Mapping[str, Any], sensor: str) -> str:
    """Return the angle after held-out moves by hand in words if a unit is marked for it; else an empty text."""
    over = _number(row.get(f"{sensor}_moves_over_noise")) or 0.0
    return decided_words("angle", over) if over > MARK_AFTER_MOVES else ""


def far_by_moves(state: RowState, sensor: str) -> str:
    """Return the angle after held-out moves in words, where it alone makes a sensor far above noise."""
    near = (state.errors[sensor].ratio or 0.0) <= MARK_ABOVE_FLOORS
    return _far_after_moves(state.row, sensor) if near and sensor in state.kinds.get(FAR, []) else ""


def largest_over_noise(state: RowState) -> float | None:
    """Return the largest error over noise of a unit: of its sensors, and of the angle after held-out moves."""
    figures = [(state.errors[s].ratio, _number(state.row.get(f"{s}_moves_over_noise"))) for s in SENSORS]
    return max((figure for pair in figures for figure in pair if figure), default=None)


def problems(rows: Sequence[Mapping[str, Any] | RowState], *, once: bool = False) -> list[Problem]:
    """Group the units of a campaign by what keeps them from being ready, the most urgent first.

    ``once``: each unit by its most urgent problem alone.
    """
    groups: dict[tuple[str, tuple[str, ...]], list[tuple[float, str, str, list[str], list[str]]]] = {}
    for row, errors, kinds in map(state_of, rows):
        for kind, sensors in [*kinds.items()][: 1 if once else None]:
            effects: tuple[str, ...] = ()
            if kind == Verdict.MISSING_EFFECT:
                names = [(s, (row.get(f"{s}_selected") or "").split(";")) for s in sensors]
                effects = tuple(f"{s}.{name}" for s, chosen in names for name in chosen if name)
            ratio, worst = max(((errors[s].ratio or 0.0, s) for s in sensors), default=(0.0, ""))
            step = row.get(f"{worst}_next_step") or ""
            by = [row.get(f"{s}_decided_by") or "" for s in sorted(sensors, key=lambda s: s != worst)]
            if kind == FAR:
                by = [next(filter(None, (_far_after_moves(row, s) for s in sensors)), "")]
                moved = [_number(row.get(f"{s}_moves_over_noise")) or 0.0 for s in sensors]
                ratio = max(ratio, *(over for over in moved if over > MARK_AFTER_MOVES), 0.0)
            groups.setdefault((kind, effects), []).append((ratio, str(row["unit"]), step, sensors, by))
    order, found = [*KINDS], []
    for (kind, effects), entries in sorted(groups.items(), key=lambda group: order.index(group[0][0])):
        entries.sort(key=lambda entry: -entry[0])
        known = [ratio for ratio, *_ in entries if ratio]
        of = [s for s in SENSORS if any(s in entry[3] for entry in entries)]
        what = ", ".join(effects).replace("_", " ").replace(".", ": ") if effects else ", ".join(of)
        step = KINDS[kind].step
        if kind in set(Verdict) - {Verdict.MISSING_EFFECT} and entries[0][2]:
            others = len({entry[2] for entry in entries}) > 1
            step = entries[0][2] + f" ({entries[0][1]}; the pages of the others state theirs)" * others
        units, span = [unit for _, unit, *_ in entries], (known[-1], known[0]) if known else None
        texts = [text for entry in entries for text in entry[4]]
        decided = _decided(texts) if kind in DOUBTS or (kind == FAR and all(texts)) else ""
        found.append(Problem(kind, what, units, span, step, effects, decided))
    return found


def _decided(texts: Sequence[str]) -> str:
    """Return the figure that decided the verdict on the first of some units, with its range in all that it decided."""
    first = DECIDED.fullmatch(texts[0])
    if first is None:
        return texts[0]
    same = [each for each in map(DECIDED.fullmatch, texts) if each and each.group(1, 3) == first.group(1, 3)]
    times = sorted((each["times"] for each in same), key=float)
    return f"{first['figure']}, {' to '.join(dict.fromkeys((times[0], times[-1])))} x {first['of']}"
