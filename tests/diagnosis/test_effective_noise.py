"""The effective noise of known errors in held-out motion."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from unit_settings import settings_of

from pipeline.core.records import Estimate, Noise, Recording, SensorCalibration, SensorDiagnosis
from pipeline.core.verdicts import Verdict
from pipeline.evaluation.diagnosis.diagnose import effective_noise
from tests.published import candidate

DT, N = 0.01, 60_000
TABLE = settings_of().table
WHITE = Noise(np.full(3, 0.05), np.zeros(3), 100.0, "static")
NOTHING = SensorDiagnosis(Verdict.NOTHING_MISSING, [])


def turning(extra: np.ndarray[Any, Any] | float = 0.0, seed: int = 1) -> Recording:
    """Return readings of a unit that turns about x at a rate of 40 deg/s or more, with white noise and an error."""
    t = np.arange(N) * DT
    rate = 60.0 + 20.0 * np.sin(0.2 * t)
    reading = 0.05 * np.random.default_rng(seed).standard_normal((N, 3))
    reading[:, 0] += rate + extra
    return Recording("validation", "validation", None, (t * 1e9).astype(np.int64), gyroscope=reading, table_rate=rate)


def test_white_noise_alone_has_its_own_density_at_every_averaging_time() -> None:
    found = effective_noise(SensorCalibration("gyroscope"), [turning()], WHITE, TABLE, NOTHING)
    assert found is not None
    assert found["white"] == pytest.approx(0.05 * np.sqrt(DT))
    assert found["recordings"] == ["validation"]
    assert found["motion"]["duration_s"] == pytest.approx(N * DT, rel=1e-3)
    assert found["motion"]["rate_dps"] == pytest.approx(20.0 / np.sqrt(2.0), rel=0.05)
    assert [d["averaging_time_s"] for d in found["densities"]] == [0.1, 1.0, 10.0]
    for entry, spread in zip(found["densities"], (0.04, 0.12, 0.4), strict=True):
        assert entry["over_white"] == pytest.approx(1.0, abs=spread)


def test_an_error_that_follows_the_motion_counts_more_the_longer_it_lasts() -> None:
    t = np.arange(N) * DT
    found = effective_noise(SensorCalibration("gyroscope"), [turning(0.2 * np.sin(0.2 * t))], WHITE, TABLE, NOTHING)
    assert found is not None
    for entry in found["densities"]:
        time = entry["averaging_time_s"]
        share = np.sinc(0.2 * time / (2.0 * np.pi)) * 0.2 / np.sqrt(2.0)
        exact = np.sqrt((0.05**2 * DT) + time * share**2)
        assert entry["density"] == pytest.approx(exact, rel=0.05)
        assert entry["over_white"] == pytest.approx(exact / (0.05 * np.sqrt(DT)), rel=0.05)


def test_a_constant_error_is_a_bias_and_none_of_the_noise() -> None:
    quiet, off = (
        effective_noise(SensorCalibration("gyroscope"), [turning(e)], WHITE, TABLE, NOTHING) for e in (0.0, 3.0)
    )
    assert quiet is not None
    assert off is not None
    for a, b in zip(quiet["densities"], off["densities"], strict=True):
        assert a["density"] == pytest.approx(b["density"], rel=1e-3)


def test_an_effect_of_the_diagnosis_has_the_share_of_its_own_error() -> None:
    t = np.arange(N) * DT
    tilt = np.radians(30.0) * np.sin(0.2 * t)  # about x, so that y and z read gravity by its sine and cosine
    attitude = np.stack([np.cos(tilt / 2), np.sin(tilt / 2), 0.0 * t, 0.0 * t], axis=1)
    rate = np.degrees(np.gradient(tilt, DT))
    parameters = {f"G_{a}{b}": Estimate(0.1 * (a + b == "zy"), "deg/s/g") for a in "xyz" for b in "xyz"}
    force_y = np.sin(tilt)
    reading = 0.005 * np.random.default_rng(2).standard_normal((N, 3))
    reading[:, 0] += rate
    reading[:, 2] += 0.1 * force_y
    recording = Recording(
        "validation", "validation", None, (t * 1e9).astype(np.int64), gyroscope=reading, table_attitude=attitude
    )
    entry = candidate("g_sensitivity", parameters=parameters)
    diagnosis = replace(NOTHING, selected=[entry.effect], ranking=[entry])
    noise = Noise(np.full(3, 0.005), np.zeros(3), 100.0, "static")
    found = effective_noise(SensorCalibration("gyroscope"), [recording], noise, TABLE, diagnosis)
    assert found is not None
    second = found["densities"][1]
    means = (0.1 * (force_y - force_y.mean())).reshape(-1, 100).mean(axis=1)
    exact = np.sqrt(np.mean(means**2) / 3.0)  # one of three axes
    (share,) = second["effects"]
    assert (share["effect"], share["density"]) == ("g_sensitivity", pytest.approx(exact, rel=0.01))
    assert second["density"] == pytest.approx(np.hypot(exact, found["white"]), rel=0.03)


def test_without_held_out_motion_there_is_none() -> None:
    assert effective_noise(SensorCalibration("gyroscope"), [], WHITE, TABLE, NOTHING) is None
