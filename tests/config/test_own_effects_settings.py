"""Effects of a user's own in a campaign's configuration: who may bring them, and which stages they reach."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest

from pipeline.app.config import Campaign, load_campaign
from pipeline.app.config.stage_settings import settings_of_jobs
from pipeline.core.errors import ConfigurationError

if TYPE_CHECKING:
    from pathlib import Path

BEND = """\
name: bend
owner: sensor
sensors: [gyroscope]
meaning: Bends.
terms:
  k: {formula: u**2, unit: 1/(deg/s)}
limits: {k: 1e-3}
"""
TIP = BEND.replace("bend", "tip").replace("Bends", "Tips").replace("gyroscope", "accelerometer")
CODE = """\
from pipeline.physics.effects.base import Effect, Layout, Owner, axis_parameters, truth
class Mine(Effect):
    name, owner, layout, sensors = "mine", Owner.SENSOR, Layout.PER_AXIS, ("gyroscope",)
    meaning = excitation = experiment = source = "mine"
    def parameters(self, sensor):
        return axis_parameters("K2", "1/(deg/s)", "mine")
    def regressors(self, sensor, motion, K, values):
        return truth(sensor, motion)[:, :, None] ** 2
EFFECT = Mine()
"""


@pytest.fixture
def bench(tmp_path: Path) -> Path:
    directory = tmp_path / "bench"
    (directory / "effects").mkdir(parents=True)
    (directory / "units.csv").write_text("unit\nU1\nU2\n")
    (directory / "effects" / "bend.yaml").write_text(BEND)
    (directory / "effects" / "tip.yaml").write_text(TIP)
    (tmp_path / "mine.py").write_text(CODE)
    return directory


def load(bench: Path, **settings: object) -> Campaign:
    return load_campaign({"campaign": str(bench), "results": str(bench.parent / "results"), **settings})


def test_a_limit_of_an_effect_that_does_not_exist_is_refused_with_the_nearest(bench: Path) -> None:
    wrong = "+sensor.gyroscope.effects.g_sensitivty=0.01"
    with pytest.raises(ConfigurationError, match="no effect is called 'g_sensitivty'; nearest: g_sensitivity"):
        load(bench, overrides=[wrong])
    limits = load(bench).units["U1"].config.sensor.gyroscope.effects
    assert {"bend", "warm_up", "warm_up_time_constant"} <= limits.keys()


def carried(campaign: Campaign, output: str) -> tuple[list[str], int]:
    files = settings_of_jobs(campaign)[next(iter(campaign.batches))]
    content: dict[str, Any] = json.loads(files[output].content)
    part = content.get("user_effects", {"formulas": [], "python": []})
    return [d["name"] for d in part["formulas"]], len(part["python"])


def test_a_file_beside_the_campaign_is_an_effect_with_its_limits(bench: Path) -> None:
    config = load(bench, overrides="effects.gyroscope=[bend]").units["U1"].config
    assert config.effects.gyroscope == ["bend"]
    assert config.sensor.gyroscope.effects["bend_k"] == 1e-3
    assert "bend_k" not in config.sensor.accelerometer.effects
    config = load(bench, overrides="sensor.gyroscope.effects.bend=0.5").units["U1"].config
    assert [v for k, v in config.sensor.gyroscope.effects.items() if k.startswith("bend")] == [0.5]


def test_a_configuration_directory_of_the_campaign_may_hold_formulas_too(bench: Path) -> None:
    (bench / "configs" / "effect").mkdir(parents=True)
    (bench / "configs" / "effect" / "third.yaml").write_text(BEND.replace("bend", "third"))
    assert load(bench, overrides="effects.gyroscope=[third]").units["U1"].config.effects.gyroscope == ["third"]
    (bench / "configs" / "effect" / "bend.yaml").write_text(BEND)
    with pytest.raises(ConfigurationError, match="the effect bend is also in"):
        load(bench)


def test_a_stage_is_given_the_effects_that_it_needs(bench: Path) -> None:
    asked = ["effects.gyroscope=[bend]", "effects.accelerometer=[warm_up]"]
    plain = load(bench, overrides=asked, python_effects=[str(bench.parent / "mine.py")])
    assert carried(plain, "fit/gyroscope/effects") == (["bend"], 0)
    assert carried(plain, "fit/accelerometer/effects") == ([], 0)
    assert carried(plain, "fit/gyroscope/reference_least_squares") == ([], 0)
    assert carried(plain, "diagnose") == carried(plain, "report") == (["bend", "tip"], 1)
    assert carried(plain, "validate") == carried(plain, "export") == carried(plain, "filter") == ([], 0)
    auto = load(bench, unit_overrides={"U2": ["effects.gyroscope=auto"]}, python_effects=str(bench.parent / "mine.py"))
    assert carried(auto, "fit/gyroscope/effects") == (["bend", "tip"], 1)
    assert carried(auto, "validate") == ([], 1)


def test_a_changed_formula_or_python_file_changes_the_parts_that_hold_it(bench: Path) -> None:
    def parts() -> list[str]:
        found = load(bench, overrides="effects.gyroscope=[bend]", python_effects=[str(bench.parent / "mine.py")])
        files = settings_of_jobs(found)[next(iter(found.batches))]
        return [files[output].name for output in ("fit/gyroscope/effects", "diagnose")]

    before = parts()
    (bench / "effects" / "tip.yaml").write_text(TIP.replace("u**2", "u**4"))
    candidate = parts()
    assert [a == b for a, b in zip(before, candidate, strict=True)] == [True, False]
    (bench / "effects" / "bend.yaml").write_text(BEND.replace("u**2", "u**4"))
    fitted = parts()
    assert [a == b for a, b in zip(candidate, fitted, strict=True)] == [False, False]
    (bench.parent / "mine.py").write_text(CODE + "# another\n")
    assert [a == b for a, b in zip(fitted, parts(), strict=True)] == [True, False]


def test_every_wrong_file_is_named_with_its_line_before_any_job(bench: Path) -> None:
    (bench / "effects" / "bend.yaml").write_text(BEND.replace("u**2", "__import__('os')"))
    (bench / "effects" / "tip.yaml").write_text(TIP.replace("owner: sensor", "owner: nobody"))
    with pytest.raises(ConfigurationError) as caught:
        load(bench)
    assert "bend.yaml:6: terms.k.formula: formula \"__import__('os')\", position 12" in str(caught.value)
    assert "tip.yaml:2: owner: one of 'sensor', 'recording', 'mounting' or 'table' is expected" in str(caught.value)


def test_an_effect_is_refused_for_a_sensor_that_it_does_not_name(bench: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"effects\.gyroscope: tip applies to the accelerometer only"):
        load(bench, overrides="effects.gyroscope=[tip]")


def test_python_comes_from_the_command_line_alone(bench: Path) -> None:
    code = bench.parent / "mine.py"
    found = load(bench, overrides="effects.gyroscope=[mine]", python_effects=[str(code)])
    assert carried(found, "fit/gyroscope/effects") == ([], 1)
    (bench / "effects" / "evil.py").write_text("raise SystemExit(3)")
    with pytest.raises(ConfigurationError, match="no effect is called 'evil'"):
        load(bench, overrides="effects.gyroscope=[evil]")
    refusal = "is loaded only where the command line names it"
    with pytest.raises(ConfigurationError, match=refusal):
        load(bench, overrides=f"python_effects=[{code}]")
    (bench / "campaign.yaml").write_text(f"python_effects: [{code}]\n")
    with pytest.raises(ConfigurationError, match=refusal):
        load(bench)
    (bench / "campaign.yaml").write_text(f'overrides: ["python_effects=[{code}]"]\n')
    with pytest.raises(ConfigurationError, match=refusal):
        load(bench)
    (bench / "campaign.yaml").unlink()
    (bench / "units.csv").write_text(f"unit,python_effects\nU1,{code}\n")
    with pytest.raises(ConfigurationError, match=refusal):
        load(bench)
    (bench / "units.csv").write_text(f"unit,overrides\nU1,+python_effects=[{code}]\n")
    with pytest.raises(ConfigurationError, match=refusal):
        load(bench)
