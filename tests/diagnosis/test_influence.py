"""What drives a finding, and how well the model fits: recordings in which alone an effect shows, and simulations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bench_session import STOP_AND_GO, Session, record
from unit_settings import settings_of

from pipeline.estimation.generalized_least_squares import fit_terms
from pipeline.estimation.noise import estimate_noise
from pipeline.estimation.observations import observe
from pipeline.estimation.selection import Selection, select
from pipeline.evaluation.diagnosis.residual_dependence import goodness_of_fit
from pipeline.evaluation.diagnosis.turntable import influence
from pipeline.simulation.description import shipped_settings

SHEET = shipped_settings(sensor="mpu6050").sensor
TABLE = settings_of().table
SHORT = replace(STOP_AND_GO, validation_s=0.0)


def selected(sensor: str, effects: dict[str, list[float]]) -> Selection:
    recordings = record(Session(3, SHORT, effects={sensor: {n: np.array(v) for n, v in effects.items()}}))
    noise = estimate_noise(sensor, recordings, SHEET.of(sensor))
    return select(observe(sensor, recordings, TABLE), [], noise, SHEET.of(sensor))


def test_an_asymmetry_on_one_axis_is_driven_by_the_turns_about_it_and_gone_without_them() -> None:
    selection = selected("gyroscope", {"scale_factor_asymmetry": [0.0, 2e-3, 0.0]})
    assert selection.names == ["scale_factor_asymmetry"]
    (found,) = influence(selection, selection.names)
    first, *others = found["recordings"]
    assert first["recording"] == "gyro_y"
    assert first["share"] == pytest.approx(1.0, abs=0.05)
    assert sum(entry["share"] for entry in found["recordings"]) == pytest.approx(1.0)
    assert found["depends_on"] == ["gyro_y"]
    assert all(entry["delta_bic_without"] > 50.0 for entry in others)
    assert {stretch["recording"] for stretch in found["seconds"]} == {"gyro_y"}
    part = next(p for p in selection.observations.parts if p.name == "gyro_y")
    for stretch in found["seconds"]:
        assert part.motion.time[0] <= stretch["from_s"] <= stretch["to_s"] <= part.motion.time[-1]


def test_an_effect_in_every_recording_depends_on_none_and_its_gain_is_that_of_the_fit() -> None:
    values = [0.1, 0.08, -0.1, 0.09, 0.1, 0.1, -0.1, 0.1, 0.1]
    selection = selected("gyroscope", {"g_sensitivity": values})
    (found,) = influence(selection, selection.names)
    assert found["depends_on"] == []
    assert max(entry["share"] for entry in found["recordings"]) < 0.6
    left = next(e for e in found["recordings"] if e["recording"] == "gyro_x")
    kept = tuple(p for p in selection.observations.parts if p.name != "gyro_x")
    rest = replace(selection.observations, parts=kept)  # an independent fit of the other recordings
    settings = [selection.fit.setting]
    fits = [fit_terms(rest, terms, selection.fit, settings) for terms in ([], selection.fit.terms)]
    gain = 2.0 * (fits[1].log_likelihood - fits[0].log_likelihood)
    assert left["delta_bic_without"] == pytest.approx(gain - 9 * np.log(3.0 * rest.samples), rel=0.02)
    change = np.abs(fits[1].terms[0].values - selection.fit.terms[0].values)
    uncertainty = np.sqrt(np.diag(selection.fit.covariance)[12:])
    assert left["change"] == pytest.approx(float(np.max(change / uncertainty)), rel=0.1)


def test_the_share_of_worse_simulations_is_even_for_a_complete_model_and_none_for_one_that_misses_a_curve() -> None:
    shares = []
    for seed in range(5):
        recordings = record(Session(40 + seed, SHORT))
        noise = estimate_noise("gyroscope", recordings, SHEET.gyroscope)
        complete = select(observe("gyroscope", recordings, TABLE), [], noise, SHEET.gyroscope)
        shares.append(goodness_of_fit(complete)["share_worse"])
    assert min(shares) > 0.005  # five even shares: p = 0.025
    assert 0.1 < float(np.mean(shares)) < 0.9  # mean of five even shares, +- 3.1 standard errors
    bent = []
    for r in recordings:
        angle = np.zeros(r.samples) if r.table_angle is None else r.table_angle
        bent.append(replace(r, gyroscope=r.reading("gyroscope") + 0.02 * np.cos(np.radians(5.0 * angle))[:, None]))
    missing = select(observe("gyroscope", bent, TABLE), [], noise, SHEET.gyroscope)
    assert goodness_of_fit(missing) == {"share_worse": 0.0, "simulations": 199}
