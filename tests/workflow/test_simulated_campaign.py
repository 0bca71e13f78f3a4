"""A campaign whose run makes its recordings: they are among the results, and its directory stays as it is."""

from pathlib import Path

import pytest

from pipeline.app.commands import simulate

from .conftest import Bench

pytestmark = pytest.mark.workflow


@pytest.fixture
def simulated_bench(tmp_path: Path) -> Bench:
    campaign = tmp_path / "made"
    campaign.mkdir()
    description = "seed: 3\nunits: [{unit: A, count: 2, course: {step_deg: 30.0, validation_s: 60.0}}]\n"
    (campaign / "simulation.yaml").write_text(description)
    (campaign / "campaign.yaml").write_text("simulate: true\noverrides: [method.gyroscope=null]\n")
    assert simulate.main([str(campaign), "--sheet-only"]) == 0
    return Bench(tmp_path, campaign)


def test_the_run_makes_the_recordings_once_and_leaves_the_campaign_as_it_is(simulated_bench: Bench) -> None:
    before = sorted(f.name for f in simulated_bench.campaign.iterdir())
    assert before == ["campaign.yaml", "simulation.yaml", "units.csv"]
    run = simulated_bench.snakemake()
    assert run.code == 0, run.output
    assert (simulated_bench.results / "simulated" / "raw" / "A002" / "gyro_z.csv").is_file()
    assert sorted(f.name for f in simulated_bench.campaign.iterdir()) == before
    assert "Nothing to be done" in simulated_bench.snakemake().output
    with (simulated_bench.campaign / "simulation.yaml").open("a") as stream:
        stream.write("# a change\n")
    assert {"simulate"} < simulated_bench.snakemake(dry=True).jobs
