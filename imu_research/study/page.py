"""Render a study as a Markdown page: its scores, and tables of the answers for each hidden effect and size."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from imu_research.figures import MeasuredFigure, wilson
from imu_research.study.cases import FAINT, SIZES
from imu_research.study.scores import (
    GATES,
    accepted,
    answer_scores,
    false_selections,
    family_scores,
    first_is_right,
    mean_excess_gone,
    named,
    outside_answered,
    reliability,
    warned,
)
from pipeline.core.verdicts import Verdict
from pipeline.output.pages.pages import template
from pipeline.physics.effects import effect

if TYPE_CHECKING:
    from imu_research.study.result import ScoredCase


TableRows = list[list[Any]]
LISTED = 40  # cases on the page that miss a goal
OF_SIZE = ("single", "small", "tiny")
OUTCOMES = ("unexplained", "other warning", "answered", "silent", "nothing")  # with physics of another form
BOUNDS = (0.0, 30.0, 60.0, 100.0, 200.0, 500.0, float("inf"))  # of lambda; a selection needs 40 to 100
DIAGRAM = "reliability.svg"


def page(cases: Sequence[ScoredCase], command: str) -> str:
    """Return the page; ``command``: the command that reproduces it."""
    answers, families = table_of(cases), [*accepted(cases), *family_scores(cases)]
    text: str = template("study.md").render(
        command=command,
        code=" and ".join(sorted({f"`{case.code}`" for case in cases if case.code})) or "unknown",
        families=[score.cells for score in families],
        answers=[score.cells for score in answer_scores(cases)],
        by_gate=false_selections(cases),
        gates=[f"> {gate:g}" for gate in GATES],
        reliable=[[f"{float(name):.2g}", *cells] for name, *cells, _ in (bin_.cells for bin_ in reliability(cases))],
        diagram=DIAGRAM,
        by_size=found_at(answers),
        by_signal=by_signal(cases),
        confusions=confusions(answers),
        instead=instead(answers),
        shapes=of_shapes(cases),
        misses=_misses(cases, families),
        faults=[[case.key, case.error] for case in cases if case.error],
        sizes=_sensor_file_sizes(),
    )
    return text


def table_of(cases: Iterable[ScoredCase]) -> pd.DataFrame:
    """Return a row for each diagnosis of a unit with one hidden effect, or with effects left out of the catalogue."""
    used = [c for c in cases if not c.error and (c.left_out or len(c.hidden) == 1)]
    keys = ["family", "model", "sensor"]
    return pd.DataFrame([[getattr(case, key) for key in keys] for case in used], columns=keys).assign(
        hidden=[(case.left_out or list(case.hidden))[0] for case in used],
        said=[_said(case) for case in used],
        left_out=np.array([bool(case.left_out) for case in used], bool),
        alone=np.array([case.selected == list(case.hidden) for case in used], bool),
        first=[first_is_right(case) for case in used],
        warned=["yes" if warned(case) else "no" for case in used],
    )


def _said(case: ScoredCase) -> str:
    return " + ".join(case.selected) or "nothing"


def found_at(answers: pd.DataFrame) -> TableRows:
    """Return for each sensor and effect in how many cases of each size it was selected first, ``n of m``."""
    of_size = answers[answers["family"].isin(OF_SIZE) & (answers["model"] == "mpu6050")]
    count = of_size.pivot_table("first", ["sensor", "hidden"], "family", lambda f: f"{f.sum()} of {len(f)}", "")
    rows = count.reindex(columns=OF_SIZE, fill_value="").itertuples()
    return [[sensor, f"`{name}`", *counts] for (sensor, name), *counts in rows]


def confusions(answers: pd.DataFrame) -> TableRows:
    """Return how often another effect was named for one hidden effect, the most frequent first."""
    wrong = answers[~answers["left_out"] & (answers["family"] != "unseen") & ~answers["alone"]]
    counts = wrong.groupby(["sensor", "hidden", "said"]).size().sort_values(ascending=False, kind="stable")
    return [[sensor, f"`{name}`", other, count] for (sensor, name, other), count in counts.items()]


def instead(answers: pd.DataFrame) -> TableRows:
    """Return the answers for effects that were removed from the catalogue, with or without a warning."""
    counts = answers[answers["left_out"]].groupby(["sensor", "hidden", "said", "warned"]).size()
    return [[sensor, f"`{name}`", *rest, count] for (sensor, name, *rest), count in counts.items()]


def by_signal(cases: Iterable[ScoredCase]) -> TableRows:
    """Return the share of the hidden effects that were selected, by bins of their lambda."""
    found = pd.DataFrame(
        [
            (signal, any(named(case, name, selected) for selected in case.selected))
            for case in cases
            if not case.error and not case.left_out and case.family != "unseen"
            for name, signal in case.signal_left.items()
        ],
        columns=["left", "selected"],
    )
    rows = []
    for bin_, hits in found.groupby(pd.cut(found["left"], BOUNDS, right=False), observed=True)["selected"]:
        low, high = bin_.left, bin_.right
        text = f"{low:g} to {high:g}" if high < BOUNDS[-1] else f"{low:g} and more"
        least, most = wilson(int(hits.sum()), len(hits))
        rows.append([text, len(hits), f"{100 * hits.mean():.0f} %", f"{100 * least:.0f} to {100 * most:.0f} %"])
    return rows


def of_shapes(cases: Sequence[ScoredCase]) -> TableRows:
    """Return a row for each form of unknown physics: the answers, and their effect on the held-out error."""
    rows = []
    for family in sorted({case.family for case in cases if case.shape and not case.error}):
        of_family = [case for case in cases if case.family == family and not case.error]
        outcomes = Counter(map(_outcome, of_family))
        name, count = Counter(map(_said, of_family)).most_common(1)[0]
        gone = "".join(f"{100 * mean.value:.0f} % (n = {mean.total})" for mean in mean_excess_gone(of_family))
        counts = [len(of_family), *(outcomes[outcome] for outcome in OUTCOMES)]
        rows.append([family.replace("_", " "), *counts, f"{name} ({count})", gone])
    return rows


def _outcome(case: ScoredCase) -> str:
    if warned(case):
        return "unexplained" if case.verdict == Verdict.UNEXPLAINED else "other warning"
    if not case.selected:
        return "nothing"
    return "answered" if outside_answered(case) else "silent"


def _misses(cases: Sequence[ScoredCase], scores: Sequence[MeasuredFigure]) -> TableRows:
    by_key = {key: case for case in cases for key in (case.key, f"{case.key} {case.sensor}")}
    keys = [key for score in scores if score.goal for key in score.misses]
    rows = []
    for key in keys[:LISTED]:
        case = by_key[key]
        left = case.signal_left
        hidden = " + ".join(f"{n} ({left[n]:.0f})" if n in left else n for n in case.hidden) or "nothing"
        unit = f"{case.model} {case.sensor} {case.procedure}"
        rows.append([key, unit, hidden, case.error or (" + ".join(case.selected) or case.verdict)])
    more = len(keys) - len(rows)
    return [*rows, *([[f"and {more} more", "", "", ""]] if more else [])]


def _sensor_file_sizes() -> TableRows:
    rows = []
    for model, sensors in SIZES.items():
        for sensor, sizes in sensors.items():
            for name, size in sizes.items():
                values = size if isinstance(size, list) else (size,)
                text = ", ".join(dict.fromkeys(f"{value:.3g}" for value in values))
                units = ", ".join(dict.fromkeys(p.unit for p in effect(name).parameters(sensor)))
                faint = " (hides in the noise)" if name in FAINT[model][sensor] else ""
                rows.append([model, sensor, f"`{name}`{faint}", text, units])
    return rows
