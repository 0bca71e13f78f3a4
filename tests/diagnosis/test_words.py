"""What a diagnosis says: no sentence contradicts another, and no experiment is one that the unit already has."""

from typing import Any

import numpy as np
import pytest

from pipeline.core.records import SensorDiagnosis, TableEvidence
from pipeline.core.verdicts import Verdict
from pipeline.estimation.posterior import Answers
from pipeline.evaluation.diagnosis.findings import next_experiment
from pipeline.evaluation.diagnosis.words import PLUS_MINUS, in_words, times_of
from pipeline.physics.effects import catalogue
from tests.published import candidate


def part(verdict: str, selected: list[str], answers: list[tuple[list[str], float]]) -> dict[str, Any]:
    ranking = [
        {
            "effect": name,
            "parameters": {"r_x": {"value": 8e-4, "unit": "m", "standard_uncertainty": 2e-5}},
            "explained_share": 1.0,
            "delta_bic": 900.0,
            "plausible": True,
            "look_alikes": [{"effect": "inner_lever_arms", "share": 1.0}],
            "held_out_error_before": None,
            "held_out_error_after": None,
        }
        for name in selected
    ]
    sets = [{"effects": names, "probability": p} for names, p in answers]
    return {
        "verdict": verdict, "residual_over_noise": 1.5, "selected": selected, "ranking": ranking, "answer_set": sets,
        "unexplained": [], "not_observable": [], "next_experiment": "",
    }  # fmt: skip


def test_the_fit_without_the_effects_is_named() -> None:
    one = in_words(part("missing_effect", ["lever_arm"], [(["lever_arm"], 0.97)]), "accelerometer")
    assert one[1] == "The misfit of the fit, without this effect, is 1.5 times its noise."
    two = in_words(part("missing_effect", ["lever_arm", "hysteresis"], []), "accelerometer")
    assert "without these effects" in two[1]
    none = in_words(part("nothing_missing", [], [([], 0.97)]), "accelerometer")
    assert none[1] == "The misfit of the fit is 1.5 times its noise."
    assert one.count(PLUS_MINUS) == 1
    assert PLUS_MINUS not in none


LIKELY = [(["quadratic_nonlinearity"], 0.69), ([], 0.24)]


@pytest.mark.parametrize(("answers", "likely"), [([([], 0.91)], False), (LIKELY, True)])
def test_an_answer_more_probable_than_nothing_is_the_headline(
    answers: list[tuple[list[str], float]], *, likely: bool
) -> None:
    lines = in_words(part("nothing_missing", [], answers), "accelerometer")
    assert lines[0].startswith("No effect was selected" if likely else "Nothing that these recordings can show")
    assert ("the most probable answer is quadratic nonlinearity (0.69)" in lines[0]) is likely
    assert ("What is missing" in " ".join(lines)) is not likely


@pytest.mark.parametrize("on_table", [True, False])
def test_the_next_experiment_distinguishes_the_most_probable_answer_from_nothing(*, on_table: bool) -> None:
    class Found:
        sensor = "accelerometer"
        diagnosis = SensorDiagnosis(Verdict.NOTHING_MISSING, [], on_table=TableEvidence(None, ()) if on_table else None)
        answers = Answers([(("quadratic_nonlinearity",), 0.6), (("cubic_nonlinearity",), 0.25), ((), 0.15)], {})

        @staticmethod
        def advice(_verdict: str) -> str:
            return "to make bias temperature observable"

    said = next_experiment("nothing_missing", [], Found())  # type: ignore[arg-type]
    assert said.startswith("to distinguish quadratic nonlinearity (0.6) from nothing (0.15): ")
    assert ("centrifuge" in said) is on_table
    document = part("nothing_missing", [], LIKELY)
    document |= {"next_experiment": said, "to_distinguish": said.removeprefix("to distinguish ")}
    assert " ".join(in_words(document, "accelerometer")).lower().count(said) == 1
    Found.answers = Answers([((), 0.9), (("quadratic_nonlinearity",), 0.1)], {})
    assert next_experiment("nothing_missing", [], Found()) == Found.advice("")  # type: ignore[arg-type]


def test_a_probability_is_said_of_effects_that_the_recordings_can_test() -> None:
    hidden = [{"effect": "lever_arm", "reason": "there is no table"}, {"effect": "hysteresis", "reason": "at rest"}]
    none = part("not_enough_data", [], [([], 0.97)]) | {"not_observable": hidden}
    assert "95 % probability" not in " ".join(in_words(none, "accelerometer"))
    few = part("missing_effect", ["warm_up"], [(["warm_up"], 0.97)]) | {"not_observable": hidden}
    said = " ".join(in_words(few, "accelerometer"))
    assert "probability: warm up (0.97). The recordings can test 1 of 3 effects; the others may be present." in said


def test_effects_that_cannot_be_seen_are_grouped_by_reason() -> None:
    reasons = {
        "time_offset": "there is no table",
        "bias_temperature": "the recordings hold no temperature; it needs rests while the sensor warms",
        "low_pass_lag": "there is no table",
        "scale_factor_temperature": "the recordings hold no temperature; it needs each axis up and down",
        "lever_arm": "the heading is unknown",
    }
    hidden = [{"effect": name, "reason": reason} for name, reason in reasons.items()]
    lines = in_words(part("nothing_missing", [], []) | {"not_observable": hidden}, "accelerometer")
    assert lines[-1] == (
        "Not observable: time offset and low pass lag (there is no table); bias temperature and scale factor "
        "temperature (the recordings hold no temperature); lever arm (the heading is unknown)."
    )


def test_an_effect_of_the_bench_is_no_fault_of_the_sensor() -> None:
    found = part("missing_effect", ["lever_arm"], [])
    assert "It is a property of the mounting, not of the sensor." in in_words(found, "accelerometer")
    found["ranking"][0] |= {"held_out_error_before": 2.863e-3, "held_out_error_after": 2.859e-3}
    said = " ".join(in_words(found, "accelerometer"))
    assert "not of the sensor, and the error on held-out motion is the same." in said
    assert "It changes the error" not in said
    found["ranking"][0]["held_out_error_after"] = 2e-3
    assert "by -30 %" in " ".join(in_words(found, "accelerometer"))


@pytest.mark.parametrize(("share", "says"), [(0.98, "any share, half on average"), (0.0, "the model is not complete")])
def test_the_share_of_simulations_says_what_is_expected(share: float, says: str) -> None:
    found = part("nothing_missing", [], []) | {"goodness_of_fit": {"share_worse": share, "simulations": 199}}
    assert says in " ".join(in_words(found, "gyroscope"))


def test_a_tilt_that_is_fixed_is_no_estimate() -> None:
    found = part("missing_effect", ["table_tilt"], [])
    u = {"unit": "deg", "standard_uncertainty": 1e-4}
    found["ranking"][0]["parameters"] = {"d_x": {**u, "value": 1e-9}, "d_y": {**u, "value": 0.02}}
    said = " ".join(in_words(found, "accelerometer"))
    assert "d_x = 0 deg (fixed), d_y = 0.02 +- 0.0002 deg" in said
    assert "the same signal as a common zero of the turns" in said


def test_an_effect_that_contains_another_needs_no_distinction() -> None:
    class Found:
        diagnosis = SensorDiagnosis(
            Verdict.MISSING_EFFECT, [], selected=("lever_arm",), on_table=TableEvidence(None, ())
        )

    (found,) = part("missing_effect", ["lever_arm"], [])["ranking"]
    entries = [candidate("lever_arm", look_alikes={a["effect"]: a["share"] for a in found["look_alikes"]})]
    said = next_experiment("missing_effect", entries, Found())  # type: ignore[arg-type]
    assert said == f"to confirm lever arm: {catalogue()['lever_arm'].experiment}"
    assert "moved by a known distance" in said


def test_a_lag_is_said_in_seconds_by_the_mean_of_the_axes_that_show_it_best() -> None:
    def entry(name: str, values: list[float], errors: list[float]) -> dict[str, Any]:
        pairs = enumerate(zip(values, errors, strict=True))
        return {"effect": name, "parameters": {k: {"value": v, "standard_uncertainty": u} for k, (v, u) in pairs}}

    slope = entry("bias_temperature", [0.1, -0.2, 1e-9], [1e-4] * 3)
    lag = entry("temperature_lag", [3.0, -6.0, 0.5], [0.1, 0.1, 0.5])  # 30 s; the last axis shows nothing
    ((time, u),) = times_of(lag, {"bias_temperature": slope})
    assert time == pytest.approx(30.0, rel=1e-6)
    assert u == pytest.approx(0.1 / np.hypot(0.1, 0.2), rel=1e-6)
    assert not times_of(lag, {})
    assert not times_of(slope, {"bias_temperature": slope})
