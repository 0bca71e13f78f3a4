# Loads and checks the campaign before any job, and defines the names that all rules use.
import atexit
import gc
import hashlib
import json
import os
import shlex
import sys
import time
from pathlib import Path

from snakemake.exceptions import WorkflowError
from snakemake.logging import logger
from snakemake.settings.types import Quietness

if Path(workflow.basedir, "pipeline").is_dir():
    # A clone: jobs run this copy of the package from any working directory; the user's path is kept.
    sys.path.insert(0, workflow.basedir)
    paths = [workflow.basedir, os.getenv("PYTHONPATH", "")]
    os.environ.update(PYTHONPATH=os.pathsep.join(filter(None, paths)))

from pipeline.app.config import code_digest, load_campaign, settings_of_jobs
from pipeline.app.config.owner import check_owner, claim, complete_record
from pipeline.core.errors import PipelineError
from pipeline.core.files import write_atomically
from pipeline.output.outcome import outcome
from pipeline.core.pack import PACKED_STEPS as PUBLISHED_STAGES
from pipeline.app.results_folder import finish_publishing, repetitions, replaced_folders
from pipeline.app.run_progress import Monitor
from pipeline.app.steps.batch import forget_last_outputs
from pipeline.app.steps.job_server import COMMAND, start_server
from pipeline.core.files import use_cache

use_cache()
RUNNING = not workflow.is_main_process
NO_RUN = {"-n", "-np", "-pn", "--dry-run", "--dryrun", "--unlock", "--report"}


def without_braces(path):
    """Return a path, or for a path with braces a link to it, because Snakemake reads {name} as a wildcard."""
    if "{" not in str(path):
        return str(path)
    link = Path(
        ".snakemake", "paths", hashlib.sha256(os.fsencode(path)).hexdigest()[:16]
    )
    link.parent.mkdir(parents=True, exist_ok=True)
    if not link.is_symlink():
        link.symlink_to(os.path.abspath(path))
    return str(link)


def again(output):
    """Return the number of repetitions of an output because its files were edited."""
    number, edited = repetitions(CAMPAIGN.results, output)
    EDITED.extend(edited)
    return number


PLAN_FILE = Path(
    ".snakemake",
    "imu-calibration",
    f"{hashlib.sha256(repr(sorted(config.items())).encode()).hexdigest()[:16]}.json",
)
if RUNNING:
    # A job on another machine: the main process has loaded the campaign and checked the results.
    PLAN = json.loads(PLAN_FILE.read_text())
else:
    try:
        CAMPAIGN = load_campaign(config)
        KEPT_BEFORE = set(replaced_folders(CAMPAIGN.results))
        CHECKED = check_owner(CAMPAIGN, move=NO_RUN.isdisjoint(sys.argv))
    except PipelineError as error:
        # Snakemake would print the place in this file before the cause, and its traceback.
        sys.exit(str(error))
    gc.freeze()  # the campaign stays in memory: garbage collection of thousands of configurations takes seconds
    if "{" in str(CAMPAIGN.results):
        CAMPAIGN.results.mkdir(parents=True, exist_ok=True)
    EDITED = []  # files and folders of the results that were edited
    SETTINGS = settings_of_jobs(CAMPAIGN, again)
    PLAN = {
        "results": without_braces(CAMPAIGN.results),
        "directory": without_braces(CAMPAIGN.directory),
        "simulation": CAMPAIGN.simulation and without_braces(CAMPAIGN.simulation),
        "page": CAMPAIGN.page,
        "combine": CAMPAIGN.combine,
        "chains": CAMPAIGN.chains,
        "apart": bool(workflow.storage_settings.default_storage_provider),
        "settings": {
            batch: {output: file.name for output, file in files.items()}
            for batch, files in SETTINGS.items()
        },
    }
    write_atomically(PLAN_FILE, json.dumps(PLAN))
    workflow.configfiles.append(str(PLAN_FILE))  # sent to jobs without a shared disk
    MONITOR = Monitor(
        CAMPAIGN.results,
        {batch: len(units) for batch, units in CAMPAIGN.batches.items()},
        sum(
            "effects" in s for chain in CAMPAIGN.chains.values() for s in chain.values()
        ),
        logger,
    )
# A container does not have the interpreter of this machine; otherwise each machine parses this file with its interpreter.
DEPLOYED = workflow.deployment_settings.deployment_method
RUN = "python -m pipeline" if DEPLOYED else shlex.join(COMMAND)
RESULTS = PLAN["results"]
BATCH = f"{RESULTS}/batches/{{batch}}"
LOG = f"{RESULTS}/logs/{{batch}}"
SENSORS = ["accelerometer", "gyroscope"]
STARTED = time.time()


wildcard_constraints:
    batch=r"[A-Za-z0-9_.+-]+",
    sensor="|".join(SENSORS),
    stage="[a-z0-9_]+",


def settings_of(output):
    """Return the input function for the settings file of an output."""
    return lambda wildcards: settings_file(wildcards.batch, output.format(**wildcards))


def settings_file(batch, output):
    """Write the settings file of a job, except in a dry run, and return its path."""
    path = f"{RESULTS}/configs/{PLAN['settings'][batch][output]}"
    if RUNNING:
        return path
    given, stored = workflow.storage_settings, None
    there = os.path.exists(path)
    if given.default_storage_provider:
        provider = workflow.storage_registry.default_storage_provider
        stored = provider.object(f"{given.default_storage_prefix}/{path}")
        there = there and stored.exists()
    if not there and workflow.dryrun:
        return []
    if not there:
        try:
            write_atomically(Path(path), SETTINGS[batch][output].content)
        except OSError as error:
            MONITOR.refused = (
                "ProtectedOutputException"  # Snakemake's error for such files
            )
            raise WorkflowError(
                f"{CAMPAIGN.results} cannot be written: {error}"
            ) from None
        if stored:
            stored.set_local_path(Path(path))
            stored.store_object()
    return path


def begin_run():
    """Lock the results, start to print the progress, and complete an interrupted publication."""
    global RUNNING
    if RUNNING:
        return
    output = workflow.output_settings
    silent = {Quietness.ALL, Quietness.PROGRESS} & set(output.quiet or ())
    try:
        MONITOR.begin(
            quiet=bool(silent),
            plain=output.verbose or output.printshellcmds,
        )
        RUNNING = True
        claim(CAMPAIGN, CHECKED)
        if workflow.dag_settings.forceall or workflow.dag_settings.forcerun:
            forget_last_outputs(CAMPAIGN.results)
        finish_publishing(CAMPAIGN.results)
        if workflow.local_exec:
            atexit.register(start_server())
        MONITOR.print_edited(EDITED)
    except PipelineError as error:
        raise WorkflowError(str(error)) from None
    except OSError as error:
        raise WorkflowError(f"{CAMPAIGN.results} cannot be written: {error}") from None


def last_fit(sensor):
    """Return the input function for the output of the last stage of a sensor."""
    return (
        lambda wildcards: f"{BATCH}/fit/{sensor}/{PLAN['chains'][wildcards.batch][sensor][-1]}.zip"
    )


def stage_before(wildcards):
    chain = PLAN["chains"][wildcards.batch][wildcards.sensor]
    i = chain.index(wildcards.stage)
    return f"{BATCH}/fit/{{sensor}}/{chain[i - 1]}.zip".format(**wildcards) if i else []


def pages(wildcards):
    """Return the published pages that exist, for `snakemake --report`."""
    shown = {
        "index.html": dict(category="Campaign", labels={"page": "the campaign"}),
        "summary.csv": dict(category="Campaign", labels={"page": "one row a unit"}),
        "reports": dict(
            patterns=["{unit}.html"], category="Units", labels={"unit": "{unit}"}
        ),
    }
    paths = {f"{RESULTS}/{name}": options for name, options in shown.items()}
    return [local(report(p, **o)) for p, o in paths.items() if os.path.exists(p)]


def of_batches(stage):
    """Return the output of a stage for every batch."""
    return [f"{RESULTS}/batches/{batch}/{stage}.zip" for batch in PLAN["chains"]]


def print_at_the_end(text):
    """Print a text after Snakemake's last message."""
    MONITOR.ended.set()
    atexit.register(print, f"\n{text}", file=sys.stderr, end="")


def written_in_this_run(path):
    """Return whether a file was written since the run began."""
    return os.path.exists(path) and os.path.getmtime(path) >= STARTED - 1


def print_outcome(failures=""):
    """Print the outcome of the run, the commands to continue, and the failed units at the end of the output."""
    if not os.path.exists(f"{RESULTS}/summary.csv"):
        return
    try:
        if RUNNING:
            complete_record(CAMPAIGN)
        recorded = max(Path(RESULTS, "history").glob("*.json"), default="")
        text = outcome(
            CAMPAIGN.results,
            CAMPAIGN.run_settings(),
            of_this_run=written_in_this_run(recorded),
        )
        for folder in replaced_folders(CAMPAIGN.results):
            if folder not in KEPT_BEFORE:
                text += f"older files that this run replaced: {folder}\n"
    except (OSError, PipelineError) as error:
        text = f"the results cannot be summed up: {error}\n"
    print_at_the_end(text + failures)


def print_verdict():
    """Print the outcome of a run with failed units; a run that stopped before its end has none."""
    log = f"{RESULTS}/logs/verdict.log"
    if written_in_this_run(log):
        with open(log) as stream:
            print_outcome(stream.read())


if not RUNNING:
    MONITOR.nothing_to_do = (
        print_outcome  # Snakemake calls no handler if there is nothing to do
    )
