"""A campaign run in this process: the jobs of the Snakefile, one after the other, without starting Python for each."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.config import load_campaign, settings_file
from pipeline.model.effects import forget
from pipeline.results_folder import HELD
from pipeline.stages import batch, verdict

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.config.campaign import Campaign
    from pipeline.config.stage_settings import SettingsFile


def settings_of_jobs(campaign: Campaign) -> dict[str, SettingsFile]:
    """Return the settings file of each job, by rule, batch, sensor and stage, in an order in which the jobs can run."""
    files = {}
    for name, units in campaign.batches.items():
        for stage in ("ingest", "filter"):
            files[f"{stage}/{name}"] = settings_file(campaign, stage, units)
        for sensor, chain in campaign.chains[name].items():
            for stage in chain:
                kind = stage if stage == "effects" else f"fit-{stage}"
                files[f"fit/{name}/{sensor}/{stage}"] = settings_file(campaign, kind, units, sensor)
        for stage in ("validate", "diagnose", "calibration", "export", "report"):
            files[f"{stage}/{name}"] = settings_file(campaign, stage, units)
    files["gather"] = settings_file(campaign, "gather", list(campaign.units))
    return files


def run_jobs(campaign: Campaign) -> int:
    """Run all jobs of a campaign and return the exit code of the run."""
    batches = campaign.results / "batches"
    for job, file in settings_of_jobs(campaign).items():
        stage, _, place = job.partition("/")
        name, _, fit = place.partition("/")
        folder = batches / name
        output, options = folder / stage, []
        inputs = {of: folder / of for of in batch.INPUTS[stage] if of not in batch.FITS}
        for sensor in set(batch.INPUTS[stage]) & set(batch.FITS):
            inputs[sensor] = folder / "fit" / sensor / campaign.chains[name][sensor][-1]
        if stage == "fit":
            sensor, _, last = fit.partition("/")
            chain = campaign.chains[name][sensor]
            earlier = chain[: chain.index(last)]
            previous = folder / "fit" / sensor / earlier[-1] if earlier else ""
            output = folder / "fit" / fit
            options = ["--sensor", sensor, "--stage", last, f"--previous={previous}"]
            options += ["--last", "yes" if last == chain[-1] else "no"]
        if stage == "gather":
            output = batches / "gathered.json"
        given = [word for of, path in inputs.items() for word in (f"--{of}", str(path))]
        try:
            assert batch.main(stage, ["--config", file.write(), *given, *options, "--output", str(output)]) == 0
        finally:
            forget()  # a job is a process of its own
            while HELD:
                HELD.pop().close()
    mark, failures = campaign.results / "complete.json", batches / "gathered.json"
    return verdict.main(["--results", str(campaign.results), "--output", str(mark), "--failures", str(failures)])


def run_campaign(directory: Path, **settings: Any) -> tuple[Campaign, int]:
    """Run the campaign in a directory, its results beside it; return it and the exit code of the run."""
    results = settings.pop("results", directory.absolute().parent / "results")
    campaign = load_campaign({"campaign": str(directory), "results": str(results), **settings})
    return campaign, run_jobs(campaign)
