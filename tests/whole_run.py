"""A campaign run in this process: the jobs of the Snakefile, one after the other, without starting Python for each."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.app.config import load_campaign, settings_of_jobs
from pipeline.app.config.owner import check_owner, claim, complete_record
from pipeline.app.results_folder import read_owner, release_locks
from pipeline.app.steps import batch
from pipeline.ingest.files import digests_of_files
from pipeline.physics.effects import forget

if TYPE_CHECKING:
    from collections.abc import Collection
    from pathlib import Path

    from pipeline.app.config.campaign import Campaign


def settings_names(campaign: Campaign) -> dict[str, str]:
    """Return the name of the settings file of each job, by batch and by what it writes."""
    jobs = settings_of_jobs(campaign)
    return {f"{batch}/{output}": file.name for batch, files in jobs.items() for output, file in files.items()}


def run_jobs(campaign: Campaign, stages: Collection[str] = tuple(batch.INPUTS)) -> int:
    """Run the jobs of a campaign, all or those of some stages, and return the exit code of the run."""
    batches, configs = campaign.results / "batches", campaign.results / "configs"
    configs.mkdir(parents=True, exist_ok=True)
    order, settings = list(batch.INPUTS), settings_of_jobs(campaign)
    jobs = [(output.partition("/")[0], name, output) for name, files in settings.items() for output in files]
    for stage, name, output in sorted(jobs, key=lambda job: order.index(job[0])):
        if stage not in stages:
            continue
        file, folder = settings[name][output], batches / name
        (configs / file.name).write_bytes(file.content)
        inputs = {of: folder / f"{of}.zip" for of in batch.INPUTS[stage] if of not in batch.FITS}
        inputs |= {"lots": batches / "lots.zip"} if "lots" in inputs else {}
        for each in set(batch.INPUTS[stage]) & set(batch.FITS):
            inputs[each] = folder / "fit" / each / f"{campaign.chains[name][each][-1]}.zip"
        options = []
        if stage == "fit":
            _, sensor, last = output.split("/")
            chain = campaign.chains[name][sensor]
            earlier = chain[: chain.index(last)]
            previous = folder / "fit" / sensor / f"{earlier[-1]}.zip" if earlier else ""
            options = ["--sensor", sensor, "--stage", last, f"--previous={previous}"]
        of_all = {"gather": batches / "gathered.json", "lots": batches / "lots.zip"}
        target = of_all.get(stage, folder / f"{output}.zip")
        given = [word for of, path in inputs.items() for word in (f"--{of}", str(path))]
        try:
            config = ["--config", str(configs / file.name)]
            assert batch.main(stage, [*config, *given, *options, "--output", str(target)]) == 0
        finally:
            forget()  # a job is a process of its own
            release_locks()
    if "gather" not in stages:
        return 0
    mark, failures = campaign.results / "complete.json", batches / "gathered.json"
    return batch.verdict(["--results", str(campaign.results), "--output", str(mark), "--failures", str(failures)])


def run_campaign(directory: Path, **settings: Any) -> tuple[Campaign, int]:
    """Run the campaign in a directory, its results beside it; return it and the exit code of the run."""
    results = settings.pop("results", directory.absolute().parent / "results")
    campaign = load_campaign({"campaign": str(directory), "results": str(results), **settings})
    claim(campaign, check_owner(campaign, move=True))
    code = run_jobs(campaign)
    complete_record(campaign)
    owner, units = read_owner(campaign.results), campaign.units.items()
    folders = {name: (row.config.procedure, row.config.ingest, campaign.folder(name)) for name, row in units}
    assert owner is not None
    assert owner.units == {name: digests_of_files(*folder) for name, folder in folders.items()}  # read by ingest
    return campaign, code
