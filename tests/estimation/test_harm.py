"""An effect that raises the error of what a fit leaves out is not added: on tables without held-out motion, by auto."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from bench_session import CONTINUOUS, Session, record
from hand_session import hand_held
from unit_settings import settings_of, with_noise

from imu_research.study.cases import draw
from imu_research.study.run import diagnose_case
from pipeline.estimation import effects, harm
from pipeline.estimation.gyroscope import rests_and_moves
from pipeline.estimation.noise import estimate_noise
from pipeline.estimation.observations import observe
from pipeline.estimation.selection import select
from pipeline.estimation.stages import StageInput

if TYPE_CHECKING:
    from pipeline.core.records import Recording, UnitRecordings
    from pipeline.estimation.multi_position.selection import SelectionByHand

SETTINGS = settings_of(effects={"gyroscope": "auto"}, sensor={"gyroscope": {"accept_implausible": True}})
HIDDEN = {"gyroscope": {"g_sensitivity": np.full(9, 0.05)}}


def turns(*, knocked: bool) -> list[Recording]:
    """Return turns of a gyroscope that has an effect, or that a knock of a second disturbed."""
    course = replace(CONTINUOUS, rates_dps=(30.0, 100.0))
    recordings = record(Session(1, course, {} if knocked else HIDDEN, ramp=10.0))
    found = []
    for r in recordings:
        assert r.gyroscope is not None
        n, rate = r.samples, r.gyroscope.copy()
        rate[int(0.93 * n) : int(0.97 * n)] += 1.0 * (knocked and r.name == "gyro_z")
        found.append(replace(r, gyroscope=rate))
    return [r for r in found if r.role != "validation"]


@pytest.mark.parametrize("knocked", [False, True])
def test_what_a_knock_imitates_is_neither_offered_nor_added_where_nothing_is_held_out(*, knocked: bool) -> None:
    recordings = turns(knocked=knocked)
    noise = estimate_noise("gyroscope", recordings, SETTINGS.sensor.gyroscope)
    observations = observe("gyroscope", recordings, SETTINGS.table)
    selection = select(observations, [], noise, SETTINGS.sensor.gyroscope)
    harmful = harm.harmful_in_turns(selection, harm.fits_of(selection))
    assert ("cubic_nonlinearity" in selection.names, "cubic_nonlinearity" in harmful) == (knocked, knocked)
    assert all("stretches of turns that the fit leaves out" in reason for reason in harmful.values())
    added = effects.fit(StageInput("gyroscope", with_noise(recordings, SETTINGS), None, SETTINGS))
    assert [e.name for e in added.effects] == [name for name in selection.names if name not in harmful]
    assert knocked or selection.names == ["g_sensitivity"]


def test_auto_by_hand_leaves_out_what_raises_the_error_in_left_out_rests(monkeypatch: pytest.MonkeyPatch) -> None:
    unit = hand_held(effects={"gyroscope.g_sensitivity": None})
    recordings: UnitRecordings = with_noise(unit.recordings, unit.settings)
    settings = settings_of(table="hand", procedure={"holdout_every": 3}, effects={"gyroscope": "auto"})
    before = rests_and_moves.fit(StageInput("gyroscope", recordings, None, settings))
    seen: list[tuple[SelectionByHand, harm.LeftOut]] = []

    def judged(selection: SelectionByHand, parts: Any) -> harm.LeftOut:
        seen.append((selection, harm.left_out(selection, parts)))
        return seen[-1][1]

    monkeypatch.setattr(effects, "left_out", judged)
    assert [e.name for e in effects.fit(StageInput("gyroscope", recordings, before, settings)).effects] == [
        "g_sensitivity"
    ]
    ((selection, errors),) = seen
    assert len(errors.of_rests[0]) == len(selection.model.rests.time)  # none that is held out of the published fit
    assert errors.errors[1] < errors.errors[0]
    worse = replace(errors, of_rests=errors.of_rests[::-1], of_moves=errors.of_moves[::-1])
    monkeypatch.setattr(effects, "left_out", lambda *_: worse)
    assert effects.fit(StageInput("gyroscope", recordings, before, settings)) is before


def test_an_effect_for_which_the_rests_of_the_published_fit_are_too_few_is_a_candidate() -> None:
    """Bias, matrix and nine further parameters from the 16 of 24 rests that are not held out: ``add`` would fail."""
    _, state = diagnose_case(draw("hand_orientations_24", 11, 4202))
    part = state.diagnosis["accelerometer"]
    assert (part["verdict"], part["selected"]) == ("unexplained", [])
    (candidate,) = part["candidates"]
    assert candidate["effect"] == "cross_axis_nonlinearity"
    assert candidate["reason"].startswith(
        "the 16 rests of the fit are too few for it: record at least 26 rests in as many "
    )
    assert part["answer_set"][0]["effects"] == ["cross_axis_nonlinearity"]


@pytest.mark.parametrize(
    ("number", "selected"), [(45, ["hysteresis", "warm_up"]), (32, ["scale_factor_asymmetry", "warm_up"])]
)
def test_five_times_the_stated_wander_takes_no_effect_away(number: int, selected: list[str]) -> None:
    """The wander raises the held-out error with the first of two effects; the second is below its gate."""
    case = draw("pairs_wander", number, 5203)
    _, state = diagnose_case(case)
    part = state.diagnosis["accelerometer"]
    assert set(case.hidden) == set(selected)
    assert (part["verdict"], part["selected"], part["candidates"]) == ("missing_effect", selected, [])


def test_the_most_probable_answer_is_selected_below_the_gate_but_a_slow_effect_not_alone() -> None:
    """Earth's rotation on one axis gains a delta BIC of 7; drift in a random walk of the bias 8.6."""
    for family, number, seed, sensor, selected in (
        ("one_axis", 25, 7301, "gyroscope", ["earth_rotation"]),
        ("null_random_walk", 15, 4204, "accelerometer", []),
    ):
        case = draw(family, number, seed)
        _, state = diagnose_case(case)
        assert list(case.hidden) == selected
        assert state.diagnosis[sensor]["selected"] == selected


def test_held_out_motion_and_limits_choose_between_sets_that_fit_alike() -> None:
    """A tilt imitates axes with equal errors; a bias over temperature beyond its limit, drift and warm-up."""
    for family, number, sensor, selected, candidates in (
        ("cold", 40, "accelerometer", ["table_axis_nonorthogonality"], ["table_tilt"]),
        ("triples", 160, "accelerometer", ["rate_dependence", "warm_up", "bias_drift"], []),
    ):
        case = draw(family, number, 4203)
        _, state = diagnose_case(case)
        part = state.diagnosis[sensor]
        assert set(case.hidden) == set(selected)
        assert (part["verdict"], part["selected"]) == ("missing_effect", selected)
        assert [candidate["effect"] for candidate in part["candidates"]] == candidates
        assert sorted(part["answer_set"][0]["effects"]) == sorted(selected)
