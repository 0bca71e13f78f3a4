"""Score a study: count the right diagnoses, as shares with n and a 95 % interval (Wilson's, by scipy).

A *case* is the truth of a unit and the diagnosis of one of its sensors (``imu_research.study.result``). A selected
look-alike counts as the hidden effect where the diagnosis states that it reproduces over 95 % of the other's signal.

Answer sets, probabilities and upper limits of the posterior are scored, too. For them the truth of a case is the set of
its hidden effects, or the empty set where nothing is hidden or observable; look-alikes do not count. An upper limit is
compared with each parameter of a hidden effect that was not selected.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pandas as pd

from imu_research.figures import MeasuredFigure, clopper_pearson, clustered_share, share
from pipeline.core.verdicts import Verdict
from pipeline.estimation.gates import MIN_DELTA_BIC, MIN_DELTA_BIC_OF_SLOW
from pipeline.output.pages.chart import Dots, Figure, LineMark, Panel, chart
from pipeline.physics.effects import effect
from pipeline.physics.effects.equations import OTHER_PREFIX

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from imu_research.study.result import ScoredCase

Z = 1.96  # standard normal quantile of a 95 % interval
OF_WHICH = "... of those in which each stands out (lambda >= 100)"
# Families with effects of the catalogue at the usual size and wander.
IN_THE_CATALOGUE = ("single", "pairs", "triples", "one_axis")
MAY_HIDE = ("single", "small", "tiny", "one_axis", "pairs", "pairs_wander", "triples")
LOOK_ALIKE_SIGNAL_SHARE = 0.95  # share of a signal above which effects are look-alikes, as on the pages
EXCESS = 0.05  # of the noise floor: smallest held-out excess that is counted
GATES = (6.0, 8.0, MIN_DELTA_BIC, 12.0, 14.0, 16.0, 20.0, MIN_DELTA_BIC_OF_SLOW)  # at which false selections count
OF_SENSOR_FILE = ("white", "normal")  # noise of the families that the sensor file describes
GOOD = ("null_white", "null_normal", "null_sensors", "null_hand_white", "null_hand_normal")  # all as the sensor file
STANDS_OUT = 100.0  # lambda: the largest that a selection needs
DOUBTFUL_VERDICTS = (Verdict.REFERENCE_IN_DOUBT, Verdict.UNEXPLAINED, Verdict.FLOOR_IN_DOUBT)
SETS = (
    "single", "one_axis", "staged", "lost", "coarse", "cold", "pairs", "pairs_wander", "triples", "unseen", "null",
)  # fmt: skip  # families whose truth is a set of effects of the catalogue that the recordings can show
# Family: the share of the detection size, and the goal of the median limit over the truth.
LIMIT_GOALS = {"limit_30": ("0.3", 4.0), "limit_60": ("0.6", 2.2), "limit_100": ("1", 1.6)}
EDGES = (0.0, 0.01, 0.03, 0.1, 0.3, 0.5, 0.7, 0.9, 0.97, 0.99, 1.0)  # of stated probabilities
EDGES_OF_SETS = (0.0, 0.95, 0.96, 0.97, 0.98, 0.985, 0.99, 0.995, 0.998, 0.999, 1.0)  # of sets with at least 0.95
Probability = Literal["effects", "single answers", "answer sets"]
PROBABILITIES: tuple[Probability, ...] = ("effects", "single answers", "answer sets")
GOAL, FAMILY_GOAL, SIZE_GOAL = ">= 93.6 %", ">= 90 %", 3.0
STYLE = (
    "<style>.chart{background:#fff}text{font:12px sans-serif;fill:#57606a}.e{text-anchor:end}.m{text-anchor:middle}"
    "path{fill:none;stroke:currentColor;stroke-width:1.5;vector-effect:non-scaling-stroke}.grid{stroke:#d0d7de}"
    ".dots{stroke-width:6;stroke-linecap:round}.dashed{stroke-dasharray:4}.c2{color:#1d5fbf}.c5{color:#8b949e}</style>"
)


def named(case: ScoredCase, hidden: str, name: str) -> bool:
    """Return whether a selected effect is the hidden one or its declared look-alike."""
    return name == hidden or case.look_alikes.get(name, {}).get(hidden, 0.0) > LOOK_ALIKE_SIGNAL_SHARE


def first_is_right(case: ScoredCase) -> bool:
    """Return whether the hidden effect, or its declared look-alike, was selected first."""
    return bool(case.selected) and named(case, next(iter(case.hidden)), case.selected[0])


def exact(case: ScoredCase) -> bool:
    """Return whether exactly the hidden effects, or their declared look-alikes, were selected."""
    hidden = [name for name in case.hidden if name not in case.selected]
    selected = [name for name in case.selected if name not in case.hidden]
    for name in hidden:
        alike = next((s for s in selected if named(case, name, s)), None)
        if alike is None:
            return False
        selected.remove(alike)
    return not selected


def no_other(case: ScoredCase) -> bool:
    """Return whether nothing was selected, or the hidden effect, or its declared look-alike; no other one."""
    return not case.selected or exact(case)


def not_seen(case: ScoredCase) -> bool:
    """Return whether an unobservable hidden effect is listed as not observable, and was not selected."""
    name = next(iter(case.hidden))
    return name in case.not_observable and name not in case.selected


def warned(case: ScoredCase) -> bool:
    """Return whether there is a warning: a doubtful verdict, a size beyond the limit, or more wander than expected."""
    return bool(case.verdict in DOUBTFUL_VERDICTS or not case.plausible or case.inflated)


def outside_answered(case: ScoredCase) -> bool:
    """Return whether one of the answers is an effect outside the catalogue."""
    return any(name.startswith(OTHER_PREFIX) for answer in case.answer_set or [] for name in answer)


def not_silent(case: ScoredCase) -> bool:
    """Return whether no effect was selected, or with a warning; for effects that are not in the catalogue."""
    return not case.selected or warned(case)


def hard_to_replace(case: ScoredCase) -> bool:
    """Return whether the complete catalogue names the removed effect first, and it has no look-alike above 0.95."""
    name, whole = case.left_out[0], case.whole
    if whole is None or whole.selected[:1] != [name]:
        return False
    return max(whole.look_alikes[name].values(), default=0.0) <= LOOK_ALIKE_SIGNAL_SHARE


def harmless(case: ScoredCase) -> bool:
    """Return whether what is offered does not raise the error significantly where no step saw it."""
    return case.held_out is not None and not case.held_out.raised


def excess_gone(case: ScoredCase) -> float | None:
    """Return the share of the held-out excess over the noise floor that was removed; None for an excess below 5 %."""
    held = case.held_out
    if held is None or held.before is None or held.before < (1.0 + EXCESS) * held.floor:
        return None
    return (held.before - held.after) / (held.before - held.floor)


def stands_out(case: ScoredCase) -> bool:
    """Return whether each hidden effect has lambda >= 100 (``signal_left``)."""
    return bool(case.signal_left) and min(case.signal_left.values()) >= STANDS_OUT


# Family, what is counted, how it is judged, goal.
SCORED_FAMILIES: list[tuple[str, str, Callable[[ScoredCase], bool], str]] = [
    ("single", "one effect at the sensor file's size: named first", first_is_right, ">= 98 %"),
    ("single", "... and nothing else named", exact, ""),
    ("small", "one effect, x0.3: named first", first_is_right, ""),
    ("tiny", "one effect, x0.1: named first", first_is_right, ""),
    ("one_axis", "one effect on one axis: named first", first_is_right, ""),
    ("staged", "one effect, base calibrated stage by stage: named first", first_is_right, ""),
    ("lost", "one effect, a tenth of the samples lost: named first", first_is_right, ""),
    ("coarse", "one effect, temperature in steps of 0.5 degC: named first", first_is_right, ""),
    ("cold", "one effect, no temperature: named first", first_is_right, ""),
    ("pairs", "two effects: exactly these", exact, ">= 95 %"),
    ("pairs_wander", "two effects, five times the wander: exactly these", exact, ">= 85 %"),
    ("triples", "three effects: exactly these", exact, ""),
    ("lag", "bias over temperature and the lag of the thermometer, in a chamber: exactly these", exact, ""),
    ("hand_multi_position", "by hand, rests in 15 to 40 attitudes, one effect: no other named", no_other, ">= 98 %"),
    ("hand_ferraris", "by hand, faces and turns, one effect: no other named", no_other, ">= 98 %"),
    ("hand_orientations_24", "by hand, 24 orientations, one effect: no other named", no_other, ">= 98 %"),
    ("unseen", "cannot be seen: said so, and not selected", not_seen, "100 %"),
    ("removed", "taken out of the catalogue: no other one without a warning", not_silent, ">= 95 %"),
]


def _judged(cases: Sequence[ScoredCase], right: Callable[[ScoredCase], bool]) -> pd.Series[bool]:
    """Return for each case whether ``right`` is true; False for a fault.

    A case is labelled with its key, and with its sensor where both sensors are scored.
    """
    both = [family_of(case) == "null" and not case.error for case in cases]
    labels = [f"{case.key} {case.sensor}" if b else case.key for case, b in zip(cases, both, strict=True)]
    return pd.Series([not case.error and right(case) for case in cases], labels, dtype=bool)


def family_of(case: ScoredCase) -> str:
    """Return the family of a case; one family for all noises with nothing hidden."""
    return "null" if case.family.startswith("null") else case.family


def accepted(cases: Sequence[ScoredCase]) -> list[MeasuredFigure]:
    """Return the share of the units that no step of a run refused."""
    taken = pd.Series([not case.refused for case in cases], [case.key for case in cases], dtype=bool)
    return share("all families: no step of a run refuses the unit", taken, "100 %")


def family_scores(cases: Sequence[ScoredCase]) -> list[MeasuredFigure]:
    """Return the scores of every family that was run, and the share of the held-out excess that was removed."""
    found: list[MeasuredFigure] = []
    for family, name, right, goal in SCORED_FAMILIES:
        family_cases = [c for c in cases if c.family == family]
        if family == "removed":
            family_cases = [c for c in family_cases if c.error or hard_to_replace(c)]
        found += share(name, _judged(family_cases, right), goal)
        strong = [c for c in family_cases if stands_out(c)]
        if family in MAY_HIDE and len(strong) < len(family_cases):
            found += share(OF_WHICH, _judged(strong, right))
    for family in sorted({c.family for c in cases if family_of(c) == "null"}):
        family_cases = [c for c in cases if c.family == family]
        name = f"nothing hidden, {family.removeprefix('null_')}: nothing selected"
        found += share(name, _judged(family_cases, lambda case: not case.selected), ">= 99 %")
    good = [c for c in cases if c.family in GOOD and not c.refused]
    sure = _judged(good, lambda case: case.verdict not in DOUBTFUL_VERDICTS)
    found += share("nothing hidden, all as the sensor file: the verdict states no doubt", sure, ">= 99 %")
    by_hand = [c for c in cases if c.family.startswith("hand_")]
    seen = [c for c in by_hand if not c.error and not set(c.hidden) <= set(c.not_observable)]
    found += share("by hand, one effect that the recordings can show: named first", _judged(seen, first_is_right))
    added = [c for c in cases if c.offered and c.held_out is not None and c.held_out.before is not None]
    offered = "an effect is offered: it does not raise the held-out error"
    found += share(offered, _judged(added, harmless), ">= 99 %")
    return found + mean_excess_gone(c for c in cases if c.family in IN_THE_CATALOGUE)


def false_selections(cases: Iterable[ScoredCase]) -> list[list[Any]]:
    """Return in how many units with nothing hidden an effect would pass some gates, on a table and by hand.

    A unit counts where the largest delta BIC of an effect, in either sensor, is above the gate. Below the gate in
    force, an effect that is not observable is not counted. Rows: recordings, noise, effects (slow or others, see
    ``pipeline.estimation.gates``), n, a count for each of ``GATES``, and the exact 95 % interval of the share at the
    gate in force (Clopper and Pearson, Biometrika 26, 1934).
    """
    rows = []
    for (*row, kind), gains in sorted(_largest_gains(cases).items(), reverse=True):
        low, high = clopper_pearson(_passing(gains, kind), len(gains))
        counts = [sum(gain > gate for gain in gains) for gate in GATES]
        rows.append([*row, kind, len(gains), *counts, f"{100 * low:.3f} to {100 * high:.2f} %"])
    return rows


def false_selection_rates(cases: Iterable[ScoredCase]) -> list[MeasuredFigure]:
    """Return the share of the units with nothing hidden in which an effect passes the gate, and its exact interval."""
    found: dict[tuple[str, str], list[float]] = {}
    for (recorded, _, kind), gains in _largest_gains(cases).items():
        found.setdefault((recorded, kind), []).extend(gains)
    words = {"slow": "a slow", "other": "another"}
    return [
        MeasuredFigure(
            f"nothing hidden, {recorded}: units in which {words[kind]} effect passes its gate",
            _passing(gains, kind) / len(gains),
            len(gains),
            "<= 0.1 %",
            clopper_pearson(_passing(gains, kind), len(gains)),
        )
        for (recorded, kind), gains in sorted(found.items())
    ]


def _largest_gains(cases: Iterable[ScoredCase]) -> dict[tuple[str, str, str], list[float]]:
    """Return the largest delta BIC in each unit with nothing hidden, by recordings, noise and kind of effects."""
    largest: dict[tuple[str, str, str], dict[str, float]] = {}
    for case in cases:
        if case.gains is None:
            continue
        gains = {"slow": [-np.inf], "other": [-np.inf]}
        for name, gain in case.gains.items():
            gains["slow" if effect(name).of_the_room(case.sensor) else "other"].append(gain)
        recorded = "by hand" if case.family.startswith("null_hand") else "on a table"
        noise = "as the sensor file" if case.noise in OF_SENSOR_FILE else "other"
        for kind, of_kind in gains.items():
            units = largest.setdefault((recorded, noise, kind), {})
            units[case.key] = max(*of_kind, units.get(case.key, -np.inf))
    return {row: [*units.values()] for row, units in largest.items()}


def _passing(gains: Iterable[float], kind: str) -> int:
    return sum(gain > (MIN_DELTA_BIC_OF_SLOW if kind == "slow" else MIN_DELTA_BIC) for gain in gains)


def mean_excess_gone(cases: Iterable[ScoredCase]) -> list[MeasuredFigure]:
    """Return the mean of ``excess_gone`` over the units that have it; an empty list for fewer than two units."""
    gone = [excess_gone(case) for case in cases if not case.error]
    values = np.array([value for value in gone if value is not None])
    if len(values) < 2:
        return []
    mean, half = float(values.mean()), Z * float(values.std(ddof=1) / np.sqrt(len(values)))
    least = f"held-out excess over the noise floor that is gone with what was selected, mean (least {values.min():.0%})"
    return [MeasuredFigure(least, mean, len(values), ">= 98 %", (mean - half, mean + half))]


def true_set(case: ScoredCase) -> list[str]:
    """Return the effects of the right answer."""
    return [] if family_of(case) == "unseen" else sorted(case.hidden)


def in_the_set(case: ScoredCase) -> bool:
    """Return whether the truth is one of the answers."""
    return true_set(case) in [sorted(answer) for answer in case.answer_set or []]


def best_is_exact(case: ScoredCase) -> bool:
    """Return whether the most probable answer is the truth or its declared look-alikes."""
    return _is_exactly(case, case.answer_set[0] if case.answer_set else [])


def _is_exactly(case: ScoredCase, effects: list[str]) -> bool:
    """Return whether effects are exactly the truth of a set or its declared look-alikes."""
    return exact(replace(case, selected=effects, hidden={name: [] for name in true_set(case)}))


def answered(cases: Iterable[ScoredCase]) -> list[ScoredCase]:
    """Return the cases of families with answer sets, including faults."""
    return [c for c in cases if family_of(c) in SETS and (c.error or c.answer_set is not None)]


def answer_scores(cases: Sequence[ScoredCase]) -> list[MeasuredFigure]:
    """Return the scores of answer sets and upper limits: how often they contain the truth, and their sizes."""
    known = answered(cases)
    found = share("truth in the 95 % answer set", _judged(known, in_the_set), GOAL)
    for family in SETS:
        family_cases = [c for c in known if family_of(c) == family]
        found += share(f"... {family}", _judged(family_cases, in_the_set), "" if family == "triples" else FAMILY_GOAL)
    found += share("most probable answer: exactly the truth", _judged(known, best_is_exact))
    found += share("... selected: exactly the truth", _judged(known, lambda c: _is_exactly(c, c.selected)))
    over = {size: ratios(cases, family) for family, (size, _) in LIMIT_GOALS.items()}
    for size, each in over.items():
        found += share(f"upper limits at {size} x the detection size: above the truth", pd.Series(each >= 1.0), GOAL)
    sizes = [len(case.answer_set) for case in known if case.answer_set is not None]
    found += (
        [MeasuredFigure("answers in a set, mean", float(np.mean(sizes)), len(sizes), f"<= {SIZE_GOAL:g}")]
        if sizes
        else []
    )
    for size, goal in LIMIT_GOALS.values():
        name = f"upper limit at {size} x the detection size over the truth, median"
        if len(over[size]):
            found.append(MeasuredFigure(name, float(np.median(over[size])), len(over[size]), f"<= {goal:g}"))
    return found


def ratios(cases: Iterable[ScoredCase], family: str) -> np.ndarray:
    """Return the ratios of upper limits to true parameters of hidden effects that were not selected: (n,) array."""
    over = []
    for case in cases:
        if case.family == family and not case.error:
            (name, values), *_ = case.hidden.items()
            limits = case.upper_limit.get(name, [])
            over += [limit / abs(value) for limit, value in zip(limits, values, strict=False) if value]
    return np.array(over)


def stated_and_true(cases: Sequence[ScoredCase], of: Probability) -> list[list[tuple[float, bool]]]:
    """Return for each case the stated probabilities of effects, of answers or of its answer set, and what is true."""
    found = []
    for case in answered(cases):
        if case.error:
            continue
        true, answers = true_set(case), [sorted(answer) for answer in case.answer_set or []]
        found.append(
            {
                "effects": [(stated, name in true) for name, stated in case.probability.items()],
                "single answers": [(p, each == true) for p, each in zip(case.answer_probability, answers, strict=True)],
                "answer sets": [(min(1.0, sum(case.answer_probability)), true in answers)],
            }[of]
        )
    return found


def reliability(cases: Sequence[ScoredCase], of: Probability = "effects") -> list[MeasuredFigure]:
    """Return the share that is true in each bin of stated probability, with its 99 % interval clustered by unit.

    The name is the bin's mean stated probability, which the interval should contain.
    """
    stated = stated_and_true(cases, of)
    edges = EDGES_OF_SETS if of == "answer sets" else EDGES
    rows = []
    for low, high in zip(edges, [*edges[1:-1], np.inf], strict=False):
        inside = [[(p, t) for p, t in each if low <= p < high] for each in stated]
        values = [p for each in inside for p, _ in each]
        if values:
            mean = float(np.mean(values))
            true = [np.array([t for _, t in each]) for each in inside]
            rows += clustered_share(f"{mean:.4f}", true, f"contains {100.0 * mean:.4g} %")
    return rows


def stated_shares(cases: Sequence[ScoredCase]) -> list[MeasuredFigure]:
    """Return the bins of ``reliability`` of all probabilities, each with a name that says of what it is."""
    return [
        figure._replace(name=f"{of}, stated {figure.name}") for of in PROBABILITIES for figure in reliability(cases, of)
    ]


def reliability_diagram(cases: Sequence[ScoredCase]) -> str:
    """Return a chart of true shares against stated probabilities as an SVG file; empty without probabilities."""
    bins = reliability(cases)
    if not bins:
        return ""
    said, true = np.array([float(b.name) for b in bins]), np.array([b.value for b in bins])
    low, high = np.array([b.interval for b in bins]).T
    ends = np.array([0.0, 1.0])
    total = sum(b.total for b in bins)
    title = f"Probabilities of effects against the share of them that is there (n = {total})"
    figure = Figure("reliability", title)
    points = "; ".join(
        f"said {at:.2g}: {round(b.value * b.total)} of {b.total}" for at, b in zip(said, bins, strict=True)
    )
    panel = Panel(
        [LineMark(ends, ends, 5, "dashed"), Dots(said, true, 2, low, high)], "true share", 300, limits=(0.0, 1.0)
    )
    drawn = chart(figure, points, [panel], "said probability; bars: 99 % intervals", margin=0.02)
    head, tail = str(drawn.svg).replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1).split("</title>", 1)
    return f"{head}</title>{STYLE}{tail}\n"
