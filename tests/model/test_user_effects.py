"""Effects of a user's own: from formulas they are what built-in ones are, and nothing strange is let in."""

from __future__ import annotations

import copy
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import yaml
from bench_session import CONTINUOUS, STOP_AND_GO, K, Session, record
from unit_settings import settings_of

from pipeline import load_calibration
from pipeline.core.errors import ConfigurationError, InputError, MissingInputError
from pipeline.core.records import Coefficient, FittedEffect, Motion, Recording, SensorCalibration
from pipeline.core.settings import UserEffectFiles
from pipeline.estimation.generalized_least_squares import fit_joint
from pipeline.physics.effects import (
    built_in,
    catalogue,
    effect,
    effect_from,
    effect_of,
    forget,
    load_python_effect,
    read_effect_file,
    register,
    register_user_effects,
)
from pipeline.physics.effects.base import Layout, parameter_limits
from pipeline.physics.formula import FUNCTIONS, SIGNALS
from pipeline.physics.kinematics import reference_motion

if TYPE_CHECKING:
    from collections.abc import Iterator

SETTINGS = settings_of()
GEAR = """\
name: gear_mesh
owner: table
sensors: [gyroscope]
meaning: The gear of the table pushes five times a turn.
terms:
  A: {formula: "cos(5 * radians(angle))", unit: deg/s}
  B: {formula: "sin(5 * radians(angle))", unit: deg/s}
limits: {A: 0.1, B: 0.2}
"""


@pytest.fixture(autouse=True)
def registry() -> Iterator[None]:
    yield
    forget()


@pytest.fixture(scope="module")
def session() -> list[Recording]:
    return record(Session(5, replace(CONTINUOUS, rates_dps=(30.0, 100.0)), ramp=10.0))


@pytest.fixture(scope="module")
def motions(session: list[Recording]) -> list[Motion]:
    return [reference_motion(r) for r in session if r.axis is not None]


def own(name: str, sensor: str, terms: dict[str, Any], **more: Any) -> dict[str, Any]:
    described = {t: {"formula": f, "unit": "1"} for t, f in terms.items()}
    return {"name": name, "owner": "sensor", "sensors": [sensor], "meaning": "Mine.", "terms": described, **more}


def test_formulas_give_the_estimates_of_the_built_in_effect(session: list[Recording]) -> None:
    register(effect_from(own("bend", "accelerometer", {"K2": "u**2"}), "bend.yaml"))
    built, made = (fit_joint("accelerometer", session, [n], None, SETTINGS) for n in ("quadratic_nonlinearity", "bend"))
    np.testing.assert_allclose(made.effects[0].values, built.effects[0].values, rtol=1e-9)
    np.testing.assert_allclose(made.matrix, built.matrix, rtol=1e-12)
    np.testing.assert_allclose(made.covariance, built.covariance, rtol=1e-9)
    assert made.effects[0].definition == own("bend", "accelerometer", {"K2": "u**2"})


def test_hidden_coefficients_of_a_vector_and_of_one_axis_are_recovered() -> None:
    terms = {"pull": ["fy * fz", "0", "fx * fy"], "tip": "step(fz)"}
    register(effect_from(own("strange", "gyroscope", terms, axes=["y"]), "strange.yaml"))
    hidden = np.array([0.08, -0.05])
    found = fit_joint(
        "gyroscope", record(Session(3, STOP_AND_GO, {"gyroscope": {"strange": hidden}})), ["strange"], None, SETTINGS
    )
    assert found.converged
    assert list(found.effects[0].parameters) == ["tip_y", "pull"]
    uncertainty = np.sqrt(np.diag(found.covariance))[12:]
    assert np.all(np.abs(found.effects[0].values - hidden) < 4 * uncertainty)
    assert np.all(uncertainty < 0.01)


def test_axes_are_left_out_of_the_columns_of_all(motions: list[Motion]) -> None:
    everything = effect_from(own("a", "gyroscope", {"q": "u**2", "t": "temperature"}), "a.yaml")
    some = effect_from(own("a", "gyroscope", {"q": "u**2", "t": "temperature"}, axes=["z", "x"]), "a.yaml")
    assert (everything.layout, some.layout) == (Layout.PER_AXIS, Layout.SHARED)
    assert [p.name for p in some.parameters("gyroscope")] == ["q_x", "t_x", "q_z", "t_z"]
    columns = everything.columns("gyroscope", motions[0], K["gyroscope"], np.zeros(6))[:, :, [0, 1, 4, 5]]
    assert np.array_equal(some.columns("gyroscope", motions[0], K["gyroscope"], np.zeros(4)), columns)


def test_an_angle_counts_nothing_where_there_is_no_turn_axis(motions: list[Motion]) -> None:
    made = effect_from(read(GEAR), "gear_mesh.yaml")
    motion = replace(motions[0], angle=None, rate=None, axis=None)
    assert made.needs == ("angle",)
    assert not made.available(motion)
    assert not made.columns("gyroscope", motion, K["gyroscope"], np.ones(6)).any()


def test_an_effect_goes_to_another_process(motions: list[Motion]) -> None:
    made = effect_from(own("mine", "gyroscope", {"a": "fx * u"}), "mine.yaml")
    sent = copy.deepcopy(made)  # by __reduce__, as pickle does
    columns = [e.columns("gyroscope", motions[0], K["gyroscope"], np.ones(3)) for e in (made, sent)]
    assert np.array_equal(*columns)


def test_time_asks_for_one_clock() -> None:
    assert effect_from(own("slow", "gyroscope", {"a": "exp(-time / 200)"}), "slow.yaml").needs_clock


@pytest.mark.parametrize(
    ("formula", "message"),
    [
        ("log(fx)", r"effect mine: log\(fx\) is not finite at .* s of recording accel_x, where fx = "),
        ("1 / (temperature - temperature)", r"recording accel_x, where temperature = "),
        ("exp(exp(time))", r"effect mine: exp\(exp\(time\)\) is not finite at .* time = "),
    ],
)
def test_a_formula_without_a_value_names_effect_and_recording(
    formula: str, message: str, motions: list[Motion]
) -> None:
    made = effect_from(own("mine", "accelerometer", {"a": formula}), "mine.yaml")
    with pytest.raises(InputError, match=message):
        made.reading("accelerometer", motions[0], K["accelerometer"], np.ones(3))


def test_a_missing_temperature_is_named(motions: list[Motion]) -> None:
    made = effect_from(own("mine", "accelerometer", {"a": "temperature"}), "mine.yaml")
    with pytest.raises(
        InputError, match="effect mine depends on the temperature, but the recording accel_x holds none"
    ):
        made.reading("accelerometer", replace(motions[0], temperature=None), K["accelerometer"], np.ones(3))


def test_limits_come_with_the_definition_and_the_data_sheet_goes_before_them() -> None:
    made = effect_from(read(GEAR), "gear_mesh.yaml")
    np.testing.assert_array_equal(parameter_limits(made, "gyroscope", {}), [0.1, 0.2] * 3)
    np.testing.assert_array_equal(parameter_limits(made, "gyroscope", {"gear_mesh": 5.0}), [5.0] * 6)
    units = {"gyroscope": "deg/s", "accelerometer": "g"}
    both = {"name": "b", "owner": "sensor", "sensors": ["accelerometer", "gyroscope"], "meaning": "Both."}
    both |= {"terms": {"a": {"formula": "speed", "unit": units}}, "limits": {"a": {"gyroscope": 2, "accelerometer": 1}}}
    made = effect_from(both, "b.yaml")
    assert [made.parameters(s)[0].unit for s in units] == list(units.values())
    assert [parameter_limits(made, s, {})[0] for s in units] == [2.0, 1.0]


def read(text: str) -> dict[str, Any]:
    content: dict[str, Any] = yaml.safe_load(text)
    return content


WRONG = {
    "name: gear_mesh": [
        ("name: gear mesh", 1, "'gear mesh' is no name of an effect"),
        ("name: table_tilt", 1, "a built-in effect is called table_tilt"),
        ("name: auto", 1, "'auto' is no name"),
        ("name: other", 1, "the effect is called other, the file gear_mesh"),
        ("name: gear_mesh\nname: gear_mesh", 2, "'name' stands twice"),
        ("nam: gear_mesh", 1, "unknown key; nearest: name"),
        ("name: !!python/object/apply:os.system [ls]", 1, "could not determine a constructor"),
        ("name: [", 3, "is not YAML"),
        ("", None, "name is missing"),
    ],
    "owner: table": [
        ("owner: bench", 2, "owner: one of 'sensor', 'recording', 'mounting' or 'table' is expected, not"),
        ("owner: sensor", 6, "owner is sensor, but field logs do not have angle"),
    ],
    "sensors: [gyroscope]": [
        ("sensors: gyroscope", 3, "a list of some of accelerometer, gyroscope"),
        ("sensors: [gyroscope, gyroscope]", 3, "a list of some of"),
        ("sensors: [magnetometer]", 3, "a list of some of"),
        ("sensors: []", 3, "a list of some of"),
    ],
    "meaning: The gear of the table pushes five times a turn.": [
        ("meaning: 7", 4, "a text of 1 to 500 characters"),
        ("meaning: " + "x" * 600, 4, "a text of 1 to 500 characters"),
        ('meaning: "a\\x1bb"', 4, "a text of 1 to 500 characters"),
    ],
    '  A: {formula: "cos(5 * radians(angle))", unit: deg/s}': [
        ('  A: {formula: "cos(5 * radians(angel))", unit: deg/s}', 6, "position 17: no signal is called 'angel'"),
        ("  A: {formula: \"__import__('os')\", unit: deg/s}", 6, "is not allowed in a formula"),
        ('  A: {formula: "cos(angle)"}', 6, "unit is missing"),
        ('  A: {formula: "cos(angle)", unit: 3}', 6, "a text of 1 to 30 characters"),
        ('  A: {formula: "cos(angle)", unit: deg/s, size: 3}', 6, "unknown key"),
        ("  A: {formula: [angle, angle], unit: deg/s}", 6, "one formula, a list of three"),
        ("  A: {formula: {a: b}, unit: deg/s}", 6, "one formula, a list of three"),
        ("  A: {formula: [angle, true, 0], unit: deg/s}", 6, "a formula is text"),
        ('  "A_*": {formula: [angle, 0, 0], unit: deg/s}', 6, "its name has no star"),
        ('  A: {formula: "3 * pi", unit: deg/s}', 6, "names no signal"),
        ("  A: cos(angle)", 6, "a mapping of names is expected"),
        ('  "A x": {formula: angle, unit: deg/s}', 6, "is no name of a term"),
        ("  B_x: {formula: [angle, 0, 0], unit: deg/s}", 5, "two coefficients would be called B_x"),
    ],
    "limits: {A: 0.1, B: 0.2}": [
        ("limits: {A: 0.1}", 8, "a limit for each term is expected"),
        ("limits: {A: -1, B: 0.2}", 8, "a number above 0 is expected, not -1"),
        ("limits: {A: .nan, B: 0.2}", 8, "a number above 0"),
        ("axes: [w]", 8, "a list of some of x, y, z"),
        ("python: /tmp/evil.py", 8, "unknown key"),
        ("built_in: true", 8, "unknown key"),
        ("adds_to: truth", 6, "what is added to the truth is a vector"),
        ("adds_to: table", 8, "one of 'reading' or 'truth'"),
    ],
}


@pytest.mark.parametrize(
    ("line", "instead", "number", "message"), [(line, *wrong) for line, wrongs in WRONG.items() for wrong in wrongs]
)
def test_a_wrong_definition_is_refused_with_its_line(
    line: str, instead: str, number: int | None, message: str, tmp_path: Path
) -> None:
    file = tmp_path / "gear_mesh.yaml"
    file.write_text(GEAR)
    assert read_effect_file(file).definition == read(GEAR)
    assert line in GEAR
    file.write_text(GEAR.replace(line, instead))
    with pytest.raises(ConfigurationError) as caught:
        read_effect_file(file)
    assert message in caught.value.message
    assert caught.value.file == (f"{file}:{number}" if number else str(file))


def test_a_file_that_unfolds_without_end_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "laughs.yaml"
    twenty = ", ".join(["*a"] * 20)
    file.write_text(f"a: &a [{', '.join('x' * 20)}]\nb: &b [{twenty}]\nc: [{twenty.replace('a', 'b')}]\n")
    with pytest.raises(ConfigurationError, match="values, each alias"):
        read_effect_file(file)
    file.write_text("[" * 16000)
    with pytest.raises(ConfigurationError, match="nested more than 50 deep"):
        read_effect_file(file)
    file.write_text("#" * 20000)
    with pytest.raises(ConfigurationError, match="more than 16384 bytes"):
        read_effect_file(file)


def test_registered_effects_stand_beside_the_built_in_ones() -> None:
    register_user_effects(UserEffectFiles(formulas=[read(GEAR)], python=[]))
    assert list(catalogue()) == [*built_in(), "gear_mesh"]
    assert effect("gear_mesh").definition == read(GEAR)


def calibration(definition: dict[str, Any]) -> SensorCalibration:
    values = {"d_x": 0.01, "d_y": -0.02, "d_z": 0.015}
    fitted = FittedEffect("loose_part", {n: Coefficient(v, "", 0.0) for n, v in values.items()}, definition)
    matrix = np.linalg.inv(K["accelerometer"])
    return SensorCalibration("accelerometer", np.array([0.1, 0.2, -0.1]), matrix, effects=(fitted,))


def written(directory: Path, found: SensorCalibration) -> Path:
    file = directory / "U1.json"
    document = {"unit": "U1", "schema_version": 1, "status": "ok", "accelerometer": found.to_json(), "gyroscope": None}
    file.write_text(json.dumps(document))
    return file


def read_off(found: SensorCalibration, force: np.ndarray) -> np.ndarray:
    """What the sensor reads: the formula written out by hand."""
    return found.bias + force @ K["accelerometer"].T + np.tanh(8.0 * force[:, 2:]) * found.effects[0].values


def test_a_calibration_alone_takes_off_a_formula_of_the_sensor(tmp_path: Path) -> None:
    found = calibration(own("loose_part", "accelerometer", {"d": "tanh(8 * fz)"}))
    force = np.random.default_rng(1).normal(0.0, 0.6, (500, 3))
    force[3] = np.nan
    applied = load_calibration(written(tmp_path, found)).apply(accelerometer=read_off(found, force))
    np.testing.assert_allclose(applied.accelerometer, force, atol=1e-9)


@pytest.mark.parametrize(
    ("formula", "sensor", "what"),
    [
        ("u ** 0", "gyroscope", "a constant, which is the bias"),
        ("cos(0 * time)", "accelerometer", "a constant, which is the bias"),
        ("3 * u + 2", "accelerometer", "a combination of bias and matrix"),
        ("fx", "accelerometer", "a combination of bias and matrix"),
        (["fy", "-fx", "0"], "accelerometer", "a combination of bias and matrix"),
        ("fx", "gyroscope", ""),  # it depends on the specific force
        ("abs(u)", "accelerometer", ""),
        ("maximum(u, 5)", "accelerometer", ""),
        ("band(temperature, 70, 71)", "accelerometer", ""),
        ("step(temperature - 25)", "gyroscope", ""),
    ],
)
def test_a_formula_that_is_bias_or_matrix_is_refused_where_it_is_loaded(
    formula: str | list[str], sensor: str, what: str, tmp_path: Path
) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(yaml.safe_dump(own("mine", sensor, {"c": formula}), sort_keys=False))
    if not what:
        assert read_effect_file(file).name == "mine"
        return
    with pytest.raises(ConfigurationError, match=rf"mine\.yaml:\d+.*the {sensor} the formula is {what}"):
        read_effect_file(file)


def test_two_calibrations_keep_their_own_formulas_of_one_name() -> None:
    register(effect_from(own("loose_part", "accelerometer", {"d": "fx"}), "another.yaml"))
    kinds = [effect_of(calibration(own("loose_part", "accelerometer", {"d": t})).effects[0]) for t in ("fy", "fz")]
    assert [kind.declared.terms["d"].text for kind in kinds] == ["fy", "fz"]


def test_a_calibration_with_a_harmful_definition_is_refused(tmp_path: Path) -> None:
    file = written(tmp_path, calibration(own("loose_part", "accelerometer", {"d": "__import__('os')"})))
    with pytest.raises(ConfigurationError, match="is not allowed in a formula") as caught:
        load_calibration(file)
    assert caught.value.file == str(file)


PYTHON = """\
import numpy as np
from pipeline.physics.effects.base import Effect, Layout, Owner, axis_parameters


class LoosePart(Effect):
    name = "loose_part"
    owner = Owner.SENSOR
    layout = Layout.EVERY_AXIS
    sensors = ("accelerometer",)
    meaning = "A loose part tips over."
    excitation = "rests on both sides"
    experiment = "shake it"
    source = "the user's own"

    def parameters(self, sensor):
        return axis_parameters("d", "g", "size")

    def regressors(self, sensor, motion, K, values):
        return np.tanh(8.0 * motion.specific_force[:, 2:])


EFFECT = LoosePart()
"""


def test_a_python_effect_is_applied_where_its_file_is_named_and_unchanged(tmp_path: Path) -> None:
    code = tmp_path / "loose_part.py"
    code.write_text(PYTHON)
    found = calibration(load_python_effect(code).definition or {})
    file = written(tmp_path, found)
    with pytest.raises(
        ConfigurationError, match=r"Python file loose_part.py .* is not loaded; name that file: --python"
    ):
        load_calibration(file)
    force = np.random.default_rng(2).normal(0.0, 0.6, (50, 3))
    applied = load_calibration(file, python_effects=[code]).apply(accelerometer=read_off(found, force))
    np.testing.assert_allclose(applied.accelerometer, force, atol=1e-9)
    code.write_text(PYTHON.replace("8.0", "9.0"))
    with pytest.raises(ConfigurationError, match="has another content than the one that was fitted"):
        load_calibration(file, python_effects=[code])
    assert not list(tmp_path.glob("__pycache__"))


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("1 / 0", "cannot be run: ZeroDivisionError"),
        ("x = (", "cannot be run: SyntaxError"),
        ("EFFECT = 3", "holds no effect: EFFECT = MyEffect"),
        (PYTHON.replace('"loose_part"', '"other"'), "its EFFECT is called 'other'; give it the file's name"),
        (PYTHON.replace("    source =", "    from_whom ="), "its EFFECT lacks source"),
    ],
)
def test_a_python_file_without_an_effect_is_refused(code: str, message: str, tmp_path: Path) -> None:
    file = tmp_path / "loose_part.py"
    file.write_text(code)
    with pytest.raises(ConfigurationError, match=message):
        load_python_effect(file)
    with pytest.raises(MissingInputError):
        load_python_effect(tmp_path / "absent.py")


def test_the_page_on_effects_of_ones_own_holds(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "effects_of_your_own.md").read_text()
    example, vector, of_level_frame = (
        yaml.safe_load(text) for text in re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    )
    assert effect_from(example, "page").name == "gear_mesh"
    assert effect_from({**example, **vector, "limits": {"pull": 1}}, "page").layout == Layout.SHARED
    rate = effect_from({**example, **of_level_frame, "limits": dict.fromkeys(("E_x", "E_y", "E_z"), 1.0)}, "page")
    assert rate.layout == catalogue()["earth_rotation"].layout
    assert [p.name for p in rate.parameters("gyroscope")] == ["E_x", "E_y", "E_z"]
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    (tmp_path / "loose_part.py").write_text(code)
    assert load_python_effect(tmp_path / "loose_part.py").limits("accelerometer") == {"loose_part": 0.05}
    words = set(re.findall(r"[a-z_]+", page))
    assert {*SIGNALS, *FUNCTIONS} <= words
    (tmp_path / "gear_mesh.yaml").write_text(yaml.safe_dump(example).replace("(angle)", "(angel)", 1))
    message = re.search(r"formula 'cos\(5 \* radians\(angel\)\)', position 17: no signal is called 'angel'", page)
    with pytest.raises(ConfigurationError) as caught:
        read_effect_file(tmp_path / "gear_mesh.yaml")
    assert message is not None
    assert message.group() in caught.value.message
