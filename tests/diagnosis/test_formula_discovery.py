"""Physics that the catalogue does not know: its covariate, shape and place are told, and written as an effect."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import yaml
from bench_session import CONTINUOUS, SIZE, STOP_AND_GO, Course, Session, record, values_of
from unit_settings import settings_of

from pipeline.app.steps.diagnose import effect_file
from pipeline.core.records import Dependence, FittedForm, RankedFormula, Recording, SensorCalibration
from pipeline.estimation.design import EffectColumns
from pipeline.estimation.gauss_markov import Products, Setting
from pipeline.estimation.generalized_least_squares import fit_joint, fit_terms
from pipeline.estimation.noise import estimate_noise
from pipeline.estimation.observations import observe, without_rows
from pipeline.estimation.selection import Selection, select
from pipeline.evaluation.diagnosis import turntable
from pipeline.evaluation.diagnosis.form_scan import ProjectedCurves, Scan, WhiteAxis
from pipeline.evaluation.diagnosis.formula_discovery import (
    Discovery,
    FormProducts,
    Forms,
    discover,
    suggested_effect,
    why_not_suggested,
)
from pipeline.evaluation.diagnosis.functional_forms import (
    Factor,
    Form,
    Span,
    columns_of,
    exponential,
    harmonic,
    power,
    step,
)
from pipeline.evaluation.diagnosis.residual_dependence import dependences
from pipeline.evaluation.diagnosis.words import in_words
from pipeline.physics.effects import effect_from, forget, register
from pipeline.physics.formula import parse
from pipeline.physics.kinematics import reference_motion
from pipeline.physics.signal.filters import smooth_temperature
from pipeline.simulation.description import shipped_settings
from tests.published import diagnose

SHEET = shipped_settings(sensor="mpu6050").sensor
TABLE = settings_of().table
SHORT = replace(STOP_AND_GO, validation_s=0.0)
SLOW = replace(
    CONTINUOUS,
    accelerometer_rates_dps=(3.0, 5.0, 6.0, 8.0),
    both_directions=False,
    rates_dps=(5.0, 60.0),
    validation_s=0.0,
)
Extra = Callable[[Recording], np.ndarray]


@pytest.fixture(autouse=True)
def _nothing_registered() -> Iterator[None]:
    yield
    forget()


def with_extra(sensor: str, extra: Extra, seed: int = 1, course: Course = SHORT, **session: Any) -> list[Recording]:
    """Recordings whose readings of a sensor hold something more: (n, 3) or (n, 1), g or deg/s."""
    recordings = record(Session(seed, course, **session))
    return [replace(r, **{sensor: r.reading(sensor) + extra(r)}) for r in recordings]


def gear(amplitude: float, axes: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Extra:
    def extra(recording: Recording) -> np.ndarray:
        angle = np.zeros(recording.samples) if recording.table_angle is None else recording.table_angle
        turning = float(recording.table_angle is not None)
        return turning * amplitude * np.cos(np.radians(5.0 * angle) + 1.0)[:, None] * np.array(axes)

    return extra


def warm(recording: Recording) -> np.ndarray:
    assert recording.temperature is not None
    return smooth_temperature(recording.time, recording.temperature)


def diagnosed(
    sensor: str, recordings: list[Recording], configured: tuple[str, ...] = (), depth: str = "standard"
) -> dict[str, Any]:
    noise = estimate_noise(sensor, recordings, SHEET.of(sensor))
    settings = settings_of(sensor=SHEET, effects={sensor: list(configured)}, diagnosis={"depth": depth})
    return diagnose(SensorCalibration(sensor), recordings, noise, settings)


def selection_of(sensor: str, recordings: list[Recording]) -> Selection:
    noise = estimate_noise(sensor, recordings, SHEET.of(sensor))
    return select(observe(sensor, recordings, TABLE), [], noise, SHEET.of(sensor))


def require_mended(sensor: str, recordings: list[Recording], part: dict[str, Any]) -> None:
    """The suggested file, read back and configured, leaves noise alone."""
    definition = yaml.safe_load(effect_file(part["suggested_effect"], "U1"))
    register(effect_from(definition, "suggested"))
    after = diagnosed(sensor, recordings, (definition["name"],))
    assert after["verdict"] == "nothing_missing"
    assert after["unexplained"] == []
    assert 0.85 < after["residual_over_noise"] < 1.06 < part["residual_over_noise"]


def test_a_gear_that_pushes_five_times_a_turn_is_told_and_mended() -> None:
    recordings = with_extra("accelerometer", gear(2e-3, (1.0, 0.0, 1.0)))
    part = diagnosed("accelerometer", recordings)
    found = part["unexplained"][0]
    assert (part["verdict"], part["selected"]) == ("unexplained", [])
    assert (found["covariate"], found["axes"]) == ("angle", ["x", "z"])
    assert found["shape"].startswith("5 cycles per turn of the table, amplitude ")
    assert found["size"] == pytest.approx(2e-3, rel=0.06)
    assert all(other["explained_by"] == "angle" for other in part["unexplained"][1:])
    assert part["suggested_effect"]["owner"] == "table"
    require_mended("accelerometer", recordings, part)


def test_only_effects_that_the_recordings_determine_together_are_selected() -> None:
    """A time constant that grows to many recordings makes a warm-up the same as bias and drift."""
    for seed, size in ((1, 0.05), (2, 0.25)):  # the set is proposed as a pair, and effect by effect
        end = max(r.time[-1] for r in record(Session(seed, SHORT)))
        extra = [0.0, 0.0, 0.0, size / end**3]
        recordings = with_extra("gyroscope", lambda r, c=extra: np.polynomial.Polynomial(c)(r.time)[:, None], seed)
        selection = selection_of("gyroscope", recordings)
        settings = settings_of(sensor=SHEET)
        fit_joint("gyroscope", recordings, selection.names, selection.noise, settings)


def test_a_step_of_the_bias_at_a_temperature_is_placed_although_effects_of_temperature_take_most_of_it() -> None:
    recordings = with_extra("gyroscope", lambda r: 0.06 * (0.5 + 0.5 * np.tanh((warm(r) - 27.6) / 0.2))[:, None])
    assert selection_of("gyroscope", recordings).names, "the catalogue would name something"
    part = diagnosed("gyroscope", recordings)
    found = part["unexplained"][0]
    assert (part["verdict"], part["selected"], found["covariate"]) == ("unexplained", [], "temperature")
    place = re.search(r"a step at ([\d.]+) degC", found["shape"])
    assert place, found["shape"]
    assert float(place.group(1)) == pytest.approx(27.6, abs=0.15)
    assert found["size"] == pytest.approx(0.06, rel=0.15)
    assert part["suggested_effect"]["owner"] == "sensor"
    require_mended("gyroscope", recordings, part)


def test_a_resonance_in_a_band_of_speeds_is_told_between_the_speeds_that_were_held() -> None:
    def resonance(recording: Recording) -> np.ndarray:
        rate = np.zeros(recording.samples) if recording.table_rate is None else np.abs(recording.table_rate)
        return 0.003 * ((rate > 4.0) & (rate < 7.0))[:, None]

    recordings = with_extra("accelerometer", resonance, course=SLOW)
    part = diagnosed("accelerometer", recordings)
    found = part["unexplained"][0]
    assert found["covariate"] == "rate"
    low, high = map(float, re.findall(r"a band from ([\d.]+) to ([\d.]+)", found["shape"])[0])
    assert 3.0 < low < 5.0
    assert 6.0 < high < 8.0
    require_mended("accelerometer", recordings, part)


def test_a_ripple_of_the_rate_is_told_with_the_axes_whose_turns_have_it() -> None:
    def ripple(recording: Recording) -> np.ndarray:
        rate = np.zeros((recording.samples, 3))
        if recording.axis in {"x", "z"} and recording.table_angle is not None and recording.table_rate is not None:
            moved = 5e-3 * recording.table_rate * np.cos(np.radians(3.0 * recording.table_angle))
            rate[:, "xyz".index(recording.axis)] = moved
        return rate

    recordings = with_extra("gyroscope", ripple)
    part = diagnosed("gyroscope", recordings)
    found = part["unexplained"][0]
    assert (found["covariate"], found["axes"], found["unit"]) == ("angle", ["x", "z"], "1")
    assert found["shape"].startswith("3 cycles per turn of the table in proportion to the rate, amplitude 0.")
    assert found["size"] == pytest.approx(5e-3, rel=0.03)
    require_mended("gyroscope", recordings, part)


@pytest.mark.parametrize(("sensor", "name"), [("accelerometer", "bias_temperature"), ("gyroscope", "g_sensitivity")])
def test_a_known_effect_is_named_beside_unknown_physics_that_would_hide_or_distort_it(sensor: str, name: str) -> None:
    hidden = {sensor: {name: values_of(sensor, name, np.random.default_rng(0))}}
    amplitude = {"accelerometer": 2e-3, "gyroscope": 0.03}[sensor]
    part = diagnosed(sensor, with_extra(sensor, gear(amplitude), 60, effects=hidden))
    assert part["selected"] == [name]
    assert part["unexplained"][0]["shape"].startswith("5 cycles")
    text = "\n".join(in_words(part, sensor))
    assert f"add {sensor}.unknown_angle; the option --suggested of add does both." in text


def test_a_product_of_signals_is_written_as_it_was_hidden_and_no_other_is_as_good() -> None:
    def late(recording: Recording) -> np.ndarray:
        motion = reference_motion(recording, 1.0)
        assert motion is not None
        return 0.03 * (motion.specific_force[:, :1] * (recording.time[:, None] > 815.0)) * np.array([1.0, -0.7, 1.2])

    recordings = with_extra("gyroscope", late)
    part = diagnosed("gyroscope", recordings)
    (term,) = part["suggested_effect"]["terms"].values()
    assert part["verdict"] == "unexplained"
    found = re.fullmatch(r"fx \* step\(time - ([\d.]+)\)", term["formula"])
    assert found, term["formula"]
    assert float(found[1]) == pytest.approx(815.0, abs=3.0)
    assert term["unit"] == "deg/s/g"
    assert part["suggested_effect"]["owner"] == "recording"
    first, *others = part["formulas"]
    assert first["suggested"]
    assert first["stability"] > 0.9
    assert all(other["score"] < first["score"] and other["complexity"] <= first["complexity"] for other in others)
    require_mended("gyroscope", recordings, part)


def test_nothing_is_searched_where_nothing_is_missing_but_at_full_depth_and_then_nothing_is_invented(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    recordings, searched = record(Session(5, SHORT)), []
    monkeypatch.setattr(turntable, "discover", lambda *a, **k: searched.append(1) or discover(*a, **k))
    assert diagnosed("gyroscope", recordings)["verdict"] == "nothing_missing"
    assert not searched
    part = diagnosed("gyroscope", recordings, depth="full")
    assert (part["verdict"], part["suggested_effect"], part["formulas"], searched) == ("nothing_missing", None, [], [1])


SPAN = Span("temperature", np.linspace(20.0, 40.0, 5))


@pytest.mark.parametrize(
    ("sensor", "factor", "modulator", "unit"),
    [
        ("accelerometer", power("u", 4), None, "1/g^3"),
        ("gyroscope", power("u", 4), None, "1/(deg/s)^3"),
        ("accelerometer", power("temperature", 2), power("fx", 1), "1/degC^2"),
        ("gyroscope", power("temperature", 1), power("fx", 1), "deg/s/degC/g"),
        ("gyroscope", power("speed", 1), power("u", 1), "1/(deg/s)"),
        ("accelerometer", power("speed", 2), None, "g/(deg/s)^2"),
        ("accelerometer", step(SPAN, 30.0, 2.0), None, "g"),
        ("gyroscope", step(SPAN, 30.0), power("time", 1), "deg/s/s"),
        ("gyroscope", harmonic(5), power("u", 1), "1"),
    ],
)
def test_a_coefficient_has_the_unit_that_makes_the_term_one_of_the_sensor(
    sensor: str, factor: Factor, modulator: Factor | None, unit: str
) -> None:
    assert Form(factor, modulator).unit(sensor) == unit


def test_a_scan_of_single_forms_finds_what_the_products_of_all_curves_say() -> None:
    selection = selection_of("gyroscope", with_extra("gyroscope", gear(5e-4)))
    tried = [[*harmonic(5).texts], ["fx * speed", "u * speed"], ["wx", "wy"]]
    scan = Scan(selection)
    for texts in tried:
        columns = columns_of(texts, "gyroscope")
        values = scan.values(columns)
        expected = ProjectedCurves(scan, values).drop([0, 1])[:, :, -1:]
        found = scan.drops(np.stack([values, 2.0 * values + 1.0], axis=-2))[:, :, :1]
        assert found == pytest.approx(expected, rel=1e-6, abs=1e-6)
        one, other = scan.best_axes(found, 2)[0], scan.best_axes(expected, 2)[0]
        assert (one.axes, one.setting) == (other.axes, other.setting)
        assert one.delta_bic == pytest.approx(other.delta_bic, rel=1e-5)


@pytest.mark.parametrize("apart", [True, False])
def test_products_of_factors_and_modulators_gain_what_the_columns_of_the_forms_gain(*, apart: bool) -> None:
    selection = selection_of("gyroscope", with_extra("gyroscope", gear(5e-4)))
    scan, grammar = Scan(selection), Forms(selection)
    for tried in ([power("speed", 2), power("fx", 3)], [harmonic(5), harmonic(6)]):
        for modulator in (None, power("u", 1), power("time", 1)):
            found = FormProducts(grammar, [Form(f, modulator) for f in tried], scan, apart=apart).gains(scan)
            values = [scan.values(columns_of(Form(f, modulator).formulas, "gyroscope")) for f in tried]
            expected = scan.best_axes(scan.drops(np.stack(values, axis=2)), len(tried[0].texts))
            assert [each.axes for each in found] == [each.axes for each in expected]
            for one, other in zip(found, expected, strict=True):
                assert one.delta_bic == pytest.approx(other.delta_bic, rel=1e-6, abs=1e-6)


def test_what_columns_explain_under_white_noise_is_what_least_squares_say() -> None:
    rng = np.random.default_rng(3)
    model, F, G, sets = (rng.standard_normal((40, *shape)) for shape in ((3,), (4,), (2,), (2, 5)))
    reading, sets = rng.standard_normal(40), sets.swapaxes(0, 1)

    def left(*columns: np.ndarray) -> float:
        return float(np.linalg.lstsq(np.column_stack([model, *columns]), reading, rcond=None)[1][0])

    axis = WhiteAxis(reading, model[:, :0])
    axis.add(model)
    assert axis.residual @ axis.residual == pytest.approx(left())
    found, expected = axis.explained(F, G), [[left() - left(f * g) for g in G.T] for f in F.T]
    assert found == pytest.approx(np.array(expected))
    assert axis.explained_together(sets) == pytest.approx(np.array([left() - left(each) for each in sets]))
    assert axis.add(F) == pytest.approx(left() - left(F))


@pytest.mark.parametrize(("cycles", "height", "searched"), [(5, 0.0, True), (5, 0.02, True), (40, 0.02, False)])
def test_no_formula_is_searched_where_none_may_reach_the_noise(cycles: int, height: float, *, searched: bool) -> None:
    def ripple(recording: Recording) -> np.ndarray:
        angle = np.zeros(recording.samples) if recording.table_angle is None else recording.table_angle
        late = height * (recording.time > 815.0)  # between two places of the coarse scan
        return (0.02 * np.cos(np.radians(cycles * angle)) + late)[:, None] * np.ones(3)

    selection = selection_of("accelerometer", with_extra("accelerometer", ripple))
    noise = selection.noise
    assert noise is not None
    assert selection.fit.residual_rms > 2.0 * noise.white.max()
    assert Forms(selection).may_leave(4.0 * float(np.mean(noise.white**2))) == searched


def test_products_of_resamples_are_those_of_their_rows() -> None:
    selection = selection_of("gyroscope", record(Session(2, SHORT)))
    scan = Scan(selection)
    columns = np.concatenate([scan.columns, scan.values(columns_of(["fx * time"], "gyroscope"))[:, 0]], axis=1)
    lengths = [len(part.weight) for part in scan.observations.parts]
    halves = [np.arange(n) * 2 // n for n in lengths]
    edges = np.flatnonzero(np.concatenate([np.diff(half, prepend=-1) for half in halves]))
    rest = without_rows(scan.observations, [half == 1 for half in halves])
    [(found, products)] = scan.resampled(columns, edges, [rest])
    expected = Products(rest.blocks, rest.weight, columns).products(scan.settings)[0]
    size = np.sqrt(np.einsum("pp->p", expected[0]))
    assert products / np.outer(size, size) == pytest.approx(expected / np.outer(size, size), rel=1e-8, abs=1e-10)
    assert found.samples == 3.0 * rest.samples


def test_the_values_of_steps_and_exponentials_are_those_of_their_formulas() -> None:
    span = Span("time", np.linspace(3.0, 1234.56789, 50))
    slow = [exponential(span, 123.456789, growth=growth) for growth in (True, False)]
    for factor in (step(span, 333.3333333), step(span, 333.3333333, 12.3456), *slow):
        values = factor.values(span.values)
        assert values == pytest.approx(parse(factor.texts[0])({"time": span.values}), rel=1e-12)


def test_a_shape_gains_what_a_joint_fit_with_it_gains() -> None:
    selection = selection_of("gyroscope", with_extra("gyroscope", gear(5e-4)))
    definition = {
        "name": "gear",
        "owner": "table",
        "sensors": ["gyroscope"],
        "meaning": "A gear.",
        "terms": {
            "A": {"formula": "cos(5 * radians(angle))", "unit": "deg/s"},
            "B": {"formula": "sin(5 * radians(angle))", "unit": "deg/s"},
        },
    }
    terms = [*selection.fit.terms, EffectColumns(effect_from(definition, "test"), np.zeros(6))]
    fit = fit_terms(selection.observations, terms, selection.start, selection.settings)
    formulas = harmonic(5).texts
    scan = Scan(selection)
    projected = ProjectedCurves(scan, scan.values(columns_of(formulas, "gyroscope")))
    drop = projected.drop([0, 1])[:, :, -1:]
    expected = 2.0 * (fit.log_likelihood - selection.fit.log_likelihood) - 6.0 * np.log(scan.samples)
    assert scan.gains(drop, 6)[0] == pytest.approx(expected, abs=0.5)
    values = fit.terms[-1].values.reshape(3, 2)
    setting = scan.best_axes(drop, 2)[0].setting
    assert projected.coefficients([0, 1], setting) == pytest.approx(values, rel=0.02, abs=2e-6)


def test_a_power_that_the_base_holds_already_says_nothing_new() -> None:
    selection = selection_of("accelerometer", record(Session(2, SHORT)))
    scan = Scan(selection)
    curves = columns_of(["fx", "fx ** 2", "2 * fx ** 2 + 3 * fy", "cos(radians(angle))"], "accelerometer")
    assert ProjectedCurves(scan, scan.values(curves)).independent([0, 1, 2]) == [1]
    drops = scan.drops(scan.values(curves)[..., None])
    assert drops[:, :, 0].max() == 0.0
    assert drops[:, :, 1].max() > 0.0


def test_a_curve_that_rounding_hides_explains_nothing() -> None:
    selection = replace(selection_of("gyroscope", record(Session(2, SHORT))), settings=[Setting(4.4, 800.0)])
    formulas = ["time", "exp(-time / 30000)", "time ** 2", "time + 1e-8 * time ** 2"]
    scan = Scan(selection)
    projected = ProjectedCurves(scan, scan.values(columns_of(formulas, "gyroscope")))
    explained = projected.drop(range(4))
    assert np.all(explained[:, :, 1] > explained[:, :, 0])
    assert np.all(explained[:, :, 1:] == explained[:, :, 1:2])
    assert np.all(projected.coefficients(range(4), 0)[:, 2:] == 0.0)


def test_names_that_are_taken_are_not_given_again() -> None:
    form = FittedForm("5 cycles", "harmonic", ["x"], ["cos(angle)"], ["g"], [[1.0]], 1.0, "g")
    made = suggested_effect("angle", form, "accelerometer", {"unknown_angle", "unknown_angle_2"})
    assert made["name"] == "unknown_angle_3"


@pytest.mark.study
@pytest.mark.parametrize("sensor", SIZE)
@pytest.mark.parametrize("wander", [1.0, 5.0])
def test_nothing_is_guessed_in_sixty_units_without_anything_unknown(sensor: str, wander: float) -> None:
    courses = (STOP_AND_GO, CONTINUOUS, replace(STOP_AND_GO, both_directions=False))
    for seed in range(60):
        session = Session(
            9000 + seed, courses[seed % 3], wander=wander, static=bool(seed % 2), ramp=15.0 * (seed % 5 == 0)
        )
        assert dependences(selection_of(sensor, record(session))) == [], seed


@pytest.mark.parametrize(
    ("covariate", "stability", "hidden", "reason"),
    [
        ("angle", 0.9, {}, None),
        ("angle", None, {"bias_temperature": "it varies by 0.08 degC"}, None),
        ("angle", 0.1, {}, "it is not stable: another formula is the best in 90 % of the resamples"),
        (
            "temperature",
            0.9,
            {"bias_temperature": "it varies by 0.08 degC"},
            "effects of the temperature are not observable: it varies by 0.08 degC",
        ),
    ],
)
def test_a_form_that_is_not_stable_or_of_a_signal_that_hardly_varies_is_not_offered(
    covariate: str, stability: float | None, hidden: dict[str, str], reason: str | None
) -> None:
    selection: Any = None
    formula = RankedFormula("f", 1, 0, 20.0, 10.0, ["x"], stability, suggested=True)
    found = Discovery(selection, selection, [Dependence(covariate, 0.0)], {"name": "f"}, [formula])
    assert why_not_suggested(found, hidden) == reason
