"""A results folder belongs to one campaign: who may write into it, who is refused, and what is moved aside."""

from __future__ import annotations

import json
import shutil
from typing import TYPE_CHECKING, Any

import pytest
from fake_runs import as_of_version_1, campaign_of, run, sha256, units_of, write_campaign

from pipeline.app.commands import add, explain, simulate, unpack
from pipeline.app.commands import run as run_command
from pipeline.app.config import load_campaign, owner
from pipeline.app.config.owner import OtherCampaignError, check_owner, claim
from pipeline.app.results_folder import read_owner, release_locks
from pipeline.core.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from pipeline.app.config.campaign import Campaign

DESCRIPTION = "seed: {}\nunits: [{{unit: A, count: 2, course: {{step_deg: 30.0, validation_s: 60.0}}}}]\n"


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("template") / "bench"


@pytest.fixture
def bench(tmp_path: Path, template: Path) -> Iterator[Bench]:
    made = Bench(tmp_path, template)
    write_campaign(tmp_path / "a" / "bench", {"U1": "one", "U2": "two"})
    made.run("a")
    yield made
    release_locks()


class Bench:
    """Campaigns with the name bench, in several places, and their results."""

    def __init__(self, directory: Path, template: Path) -> None:
        self.directory, self.template = directory, template
        self.results = directory / "results" / "bench"

    def campaign(self, place: str, *, take_over: bool = False) -> Campaign:
        directory, results = self.directory / place / "bench", self.directory / "results"
        return campaign_of(directory, results, template=self.template, take_over=take_over)

    def run(self, place: str, *, take_over: bool = False, packed: bool = False) -> None:
        try:
            run(self.campaign(place, take_over=take_over), {}, packed=packed)
        finally:
            release_locks()

    def copy(self, place: str, to: str, **others: str) -> None:
        shutil.copytree(self.directory / place / "bench", self.directory / to / "bench")
        write_campaign(self.directory / to / "bench", units_of(self.directory / place / "bench") | others)

    def files(self) -> dict[str, bytes]:
        found = [f for f in self.results.rglob("*") if f.is_file() and not f.name.endswith(".lock")]
        return {str(f.relative_to(self.results)): f.read_bytes() for f in found}


def test_another_campaign_of_the_same_name_is_refused_and_changes_nothing(bench: Bench) -> None:
    write_campaign(bench.directory / "b" / "bench", {"U1": "one of another device"})
    before = bench.files()
    with pytest.raises(OtherCampaignError) as refused:
        bench.run("b")
    assert bench.files() == before
    assert refused.value.code == "other_campaign"
    for text in ("other_campaign", f"{bench.directory}/a/bench", f"{bench.directory}/b/bench", "results=DIR",
                 "take_over=true", "unit U1"):  # fmt: skip
        assert text in str(refused.value)


def test_take_over_keeps_the_older_results_as_a_whole_and_they_can_be_used_again(bench: Bench) -> None:
    write_campaign(bench.directory / "b" / "bench", {"U1": "one of another device"})
    (bench.results / "notes.txt").write_text("mine")
    before = bench.files()
    bench.run("b", take_over=True)
    assert "one of another device" in (bench.results / "calibrations" / "U1.json").read_text()
    assert (bench.results / "notes.txt").read_text() == "mine"
    (kept,) = bench.results.glob("replaced-*")
    moved = {name: content for name, content in before.items() if name != "notes.txt"}
    assert {str(f.relative_to(kept)): f.read_bytes() for f in kept.rglob("*") if f.is_file()} == moved
    bench.run("b", take_over=True)
    assert list(bench.results.glob("replaced-*")) == [kept]
    aside = bench.directory / "apart" / "bench"
    aside.parent.mkdir()
    kept.rename(aside)
    check_owner(campaign_of(bench.directory / "a" / "bench", aside.parent, template=bench.template))
    bench.run("a", take_over=True)
    assert read_owner(bench.results).campaign == f"{bench.directory}/a/bench"  # type: ignore[union-attr]


def test_results_that_lie_in_the_directory_of_a_campaign_are_not_moved(bench: Bench) -> None:
    write_campaign(bench.directory / "b" / "bench", {"U1": "one of another device"})
    shutil.copytree(bench.directory / "a" / "bench", bench.results, dirs_exist_ok=True)
    with pytest.raises(OtherCampaignError) as refused:
        bench.run("b", take_over=True)
    assert "take_over" not in str(refused.value)


def test_the_same_path_is_the_same_campaign_without_a_look_at_its_recordings(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(owner, "digests_of_files", lambda *_: 1 / 0)
    write_campaign(bench.directory / "a" / "bench", {"U1": "edited", "U3": "three"})
    bench.run("a")
    (kept,) = bench.results.glob("replaced-*")
    left = {"calibrations/U2.json", "validations/U2.json", "diagnoses/U2.json", "reports/U2.html",
            "certificates/U2.html", "certificates/U2.json", "exports/U2/kalibr.yaml",
            "exports/U2/px4.params"}  # fmt: skip
    assert {str(f.relative_to(kept)) for f in kept.rglob("*") if f.is_file()} == left
    assert not list(bench.results.glob("calibrations/U2*"))


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize(
    ("others", "same"), [({}, 1), ({"U3": "three"}, 1), ({"U2": "edited"}, 0), ({"U1": "two", "U2": "one"}, 0)]
)
def test_another_path_is_the_same_campaign_by_the_recordings_of_all_units_in_both(
    bench: Bench, others: dict[str, str], same: int, version: int
) -> None:
    bench.copy("a", "b", **others)
    if version == 1:
        as_of_version_1(bench.results)
    if not same:
        with pytest.raises(OtherCampaignError, match=r"the recordings of unit U[12] are others"):
            bench.run("b")
        return
    bench.run("b")
    assert not list(bench.results.glob("replaced-*"))
    recorded = read_owner(bench.results)
    assert recorded is not None
    assert recorded.campaign == f"{bench.directory}/b/bench"
    assert recorded.units == {unit: [sha256(text)] for unit, text in ({"U1": "one", "U2": "two"} | others).items()}


def test_a_campaign_without_a_unit_in_common_is_another_one(bench: Bench) -> None:
    write_campaign(bench.directory / "b" / "bench", {"V1": "one", "V2": "two"})
    with pytest.raises(OtherCampaignError, match="no unit with the same recordings is in both"):
        bench.run("b")


def test_results_in_packs_and_units_that_failed_count_too(bench: Bench) -> None:
    bench.copy("a", "b", U2="bad file")
    bench.run("a", packed=True)
    (bench.results / ".owner.json").unlink()
    shutil.rmtree(bench.results / "batches")
    with pytest.raises(OtherCampaignError, match="unit U2"):
        bench.run("b")
    write_campaign(bench.directory / "a" / "bench", {"U1": "one", "U2": "bad as well"})
    settings = bench.results / "configs" / "ingest-1.json"  # the version before recorded the path in settings alone
    settings.parent.mkdir()
    settings.write_text(json.dumps({"directory": str(bench.directory / "a" / "bench")}))
    bench.run("a")
    with pytest.raises(OtherCampaignError, match="unit U2"):
        bench.run("b")


def test_a_run_that_began_at_the_same_time_is_refused_when_it_gets_the_lock(tmp_path: Path, template: Path) -> None:
    bench = Bench(tmp_path, template)
    for place in ("a", "b"):
        write_campaign(tmp_path / place / "bench", {"U1": f"of {place}"})
    checked = check_owner(bench.campaign("b"), move=True)
    bench.run("a")
    with pytest.raises(OtherCampaignError):
        claim(bench.campaign("b"), checked)
    assert read_owner(bench.results).campaign == f"{tmp_path}/a/bench"  # type: ignore[union-attr]


def test_commands_refuse_the_results_of_another_campaign_before_they_change_a_file(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.run("a", packed=True)
    directory = write_campaign(bench.directory / "b" / "bench", {"U1": "one of another device"})
    before, given = bench.files(), ["--results", str(bench.directory / "results")]
    monkeypatch.setattr(add, "run_snakemake", lambda *_: 1 / 0)
    effect = ["U1", "gyroscope.g_sensitivity"]
    for command, words in ((add.main, effect), (add.remove, effect), (add.main, ["--missing", "--no-run"]),
                           (add.main, ["--missing", "--config", "take_over=true"]), (add.main, ["U1", "--suggested"]),
                           (unpack.main, ["U1"]), (explain.main, [])):  # fmt: skip
        with pytest.raises(OtherCampaignError):
            command([str(directory), *words, *given])
    assert sorted(f.name for f in directory.iterdir()) == ["raw", "units.csv"]
    assert bench.files() == before
    assert add.main([str(directory), *effect, "--no-run", *given]) == 0  # it touches no results
    assert unpack.main([str(bench.directory / "a" / "bench"), "U1", *given]) == 0


def test_the_command_run_takes_over_on_request(monkeypatch: pytest.MonkeyPatch) -> None:
    commands: list[list[str]] = []

    class Done:
        returncode = 0

    monkeypatch.setattr(run_command.subprocess, "run", lambda command, **_: commands.append(command) or Done())
    assert run_command.main(["my_bench", "--take-over"]) == 0
    assert commands[0][-2:] == ["campaign=my_bench", "take_over=true"]


def test_take_over_is_true_or_false_and_no_result_states_it(tmp_path: Path) -> None:
    directory = str(write_campaign(tmp_path / "bench", {"U1": "one"}))
    found: list[Any] = [load_campaign({"campaign": directory, "take_over": given}) for given in ("true", False)]
    assert [campaign.take_over for campaign in found] == [True, False]
    assert found[0].run_settings() == {"campaign": directory}
    with pytest.raises(ConfigurationError, match="take_over: true or false is expected, got 'yes'"):
        load_campaign({"campaign": directory, "take_over": "yes"})


def simulated(directory: Path, seed: int) -> Campaign:
    directory.mkdir(parents=True)
    (directory / "simulation.yaml").write_text(DESCRIPTION.format(seed))
    (directory / "campaign.yaml").write_text("simulate: true\n")
    (directory / "units.csv").write_text("unit\nA001\nA002\n")
    return load_campaign({"campaign": str(directory), "results": str(directory.parents[1] / "results")})


def test_simulated_recordings_are_identified_by_their_description(tmp_path: Path) -> None:
    first = simulated(tmp_path / "a" / "made", 3)
    claim(first, check_owner(first, move=True))
    folder = str(first.results / "simulated")
    assert simulate.main([folder, "--from", str(first.simulation), "--quiet", "--replace"]) == 0
    moved, other = simulated(tmp_path / "b" / "made", 3), simulated(tmp_path / "c" / "made", 4)
    for _ in ("with the record", "by the true parameters"):
        check_owner(moved)
        with pytest.raises(OtherCampaignError, match=r"differs from the description|true parameters of unit A001"):
            check_owner(other)
        (first.results / ".owner.json").unlink(missing_ok=True)


def test_simulated_recordings_are_replaced_as_a_whole_and_files_of_others_stay(tmp_path: Path) -> None:
    first = simulated(tmp_path / "a" / "made", 3)
    folder, mine = first.results / "simulated", first.results / "simulated" / "raw" / "A001" / "mine.txt"
    words = [str(folder), "--from", str(first.simulation), "--quiet", "--replace"]
    assert simulate.main(words) == 0
    mine.write_text("mine")
    (folder / "truth" / "A002.json").write_text("edited")
    text = DESCRIPTION.format(3).replace("count: 2", "count: 1").replace("unit: A", "unit: A001")
    first.simulation.write_text(text)  # type: ignore[union-attr]
    assert simulate.main(words) == 0
    assert mine.read_text() == "mine"
    assert not (folder / "raw" / "A002").exists()
    (kept,) = first.results.glob("replaced-*/simulated/truth/A002.json")
    assert kept.read_text() == "edited"
    assert json.loads((folder / "truth" / "A001.json").read_text())["unit"] == "A001"
