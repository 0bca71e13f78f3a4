"""The gate of a selection: where it is passed, for which effects it is higher, and that an exchange needs it too."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from pipeline.estimation.gates import MIN_DELTA_BIC, MIN_DELTA_BIC_OF_SLOW, min_delta_bic, min_gain, passes
from pipeline.estimation.multi_position import selection as by_hand
from pipeline.estimation.ranking import Score
from pipeline.estimation.selection import Selection
from pipeline.physics.effects import catalogue, effect

SLOW = {"bias_drift", "bias_temperature", "bias_temperature_quadratic", "warm_up"}
OTHERS = {"scale_factor_temperature", "clock_rate", "time_offset", "quadratic_nonlinearity"}


def scored(name: str, gain: float, parameters: int = 3, equations: float = 5000.0) -> Score:
    delta, p = gain - parameters * np.log(equations), float(stats.chi2.sf(gain, parameters))
    return Score(name, delta, p, parameters, np.zeros(parameters), np.ones(parameters), 0)


@pytest.mark.parametrize("sensor", ["accelerometer", "gyroscope"])
def test_what_depends_on_time_and_temperature_alone_needs_more_evidence(sensor: str) -> None:
    gates = {name: min_delta_bic(effect(name), sensor) for name in SLOW | OTHERS}
    assert gates == dict.fromkeys(SLOW, MIN_DELTA_BIC_OF_SLOW) | dict.fromkeys(OTHERS, MIN_DELTA_BIC)


@pytest.mark.parametrize("name", ["bias_drift", "g_sensitivity"])
@pytest.mark.parametrize(("parameters", "equations"), [(3, 5000.0), (9, 60.0), (1, 6.0)])
def test_the_gain_of_a_plan_is_the_gain_that_a_selection_needs(name: str, parameters: int, equations: float) -> None:
    least = min_gain(effect(name), "gyroscope", parameters, equations, 20)
    for factor, enough in ((0.999, False), (1.001, True)):
        score = scored(name, factor * least, parameters, equations)
        assert passes(score, "gyroscope", 20) is enough
        delta, p = score.delta_bic, stats.chi2.sf(factor * least, parameters)
        assert enough is bool(delta > (MIN_DELTA_BIC_OF_SLOW if name in SLOW else MIN_DELTA_BIC) and 20 * p < 0.01)


def test_after_large_effects_the_gate_exceeds_the_error_of_their_equations() -> None:
    gates = [min_delta_bic(effect("g_sensitivity"), "gyroscope", gain) for gain in (0.0, 1e4, 1e5, 1e6)]
    assert gates == [10.0, 10.0, pytest.approx(20.0), 30.0]


@pytest.mark.parametrize(("delta", "exchanged"), [(MIN_DELTA_BIC - 1.0, False), (MIN_DELTA_BIC_OF_SLOW + 1.0, True)])
def test_an_effect_that_takes_the_place_of_another_passes_the_gate(
    monkeypatch: pytest.MonkeyPatch, *, delta: float, exchanged: bool
) -> None:
    """The effect that is selected adds nothing more, so that every rival is better by more than the difference."""
    rival = scored("bias_drift", delta + 3.0 * np.log(5000.0))
    scores = {"bias_drift": rival, "g_sensitivity": scored("g_sensitivity", 0.0)}
    fit = SimpleNamespace(log_likelihood=0.0, terms=(), state=SimpleNamespace(terms=()))
    common = {"base": fit, "fit": fit, "candidates": dict.fromkeys(catalogue()), "limits": {"bias_drift": np.ones(3)}}
    taken: list[str] = []

    hand = object.__new__(by_hand.SelectionByHand)
    vars(hand).update(common, names=["g_sensitivity"], model=SimpleNamespace(sensor="gyroscope"))
    vars(hand).update(first=SimpleNamespace(scores=scores))
    monkeypatch.setattr(hand, "_without", lambda _: SimpleNamespace(scores=scores), raising=False)
    monkeypatch.setattr(hand, "_remove", lambda _: None, raising=False)
    monkeypatch.setattr(hand, "_add", lambda score, _: taken.append(score.name), raising=False)
    assert hand._exchange() is exchanged

    table = object.__new__(Selection)
    observations = SimpleNamespace(sensor="gyroscope")
    vars(table).update(common, steps={"g_sensitivity": scores["g_sensitivity"]}, observations=observations)
    vars(table).update(noise=None, refused=set())
    monkeypatch.setattr(table, "_given", lambda _: dict(scores), raising=False)
    monkeypatch.setattr(table, "_accept", lambda steps: taken.extend(steps) or False, raising=False)
    assert table._exchange() is exchanged
    assert taken == ["bias_drift", "bias_drift"] * exchanged
