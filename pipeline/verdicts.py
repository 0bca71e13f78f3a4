"""The verdicts of a diagnosis on one sensor; ``pipeline.diagnosis.verdict`` decides which applies."""

from __future__ import annotations

from enum import StrEnum


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


WITH_THEM = ", with which the largest U is "  # between open effects and the uncertainty, in summary.csv and sentences
