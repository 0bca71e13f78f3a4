# The campaign, resolved and checked before any job; and what every rule uses.
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
    # A clone: jobs run this copy of the package from any working directory, and keep the user's own path.
    sys.path.insert(0, workflow.basedir)
    own = [workflow.basedir, os.getenv("PYTHONPATH", "")]
    os.environ.update(PYTHONPATH=os.pathsep.join(filter(None, own)))

from pipeline.config import code_digest, load_campaign, settings_file
from pipeline.errors import PipelineError
from pipeline.estimation.stages import stage_module
from pipeline.io.files import recording_files
from pipeline.outcome import outcome
from pipeline.results_folder import finish_publishing, repetitions
from pipeline.run_progress import Monitor
from pipeline.stages.job_server import COMMAND, start_server

try:
    CAMPAIGN = load_campaign(config)
except PipelineError as error:
    raise WorkflowError(str(error)) from None
gc.freeze()  # the campaign stays: looking for garbage in thousands of configurations takes seconds


def without_braces(path):
    """Return a path for Snakemake, which takes {name} for a wildcard: in place of one with braces, a link to it."""
    if "{" not in str(path):
        return str(path)
    link = Path(
        ".snakemake", "paths", hashlib.sha256(os.fsencode(path)).hexdigest()[:16]
    )
    link.parent.mkdir(parents=True, exist_ok=True)
    if not link.is_symlink():
        link.symlink_to(os.path.abspath(path))
    return str(link)


if "{" in str(CAMPAIGN.results):
    CAMPAIGN.results.mkdir(parents=True, exist_ok=True)
RUN = shlex.join(COMMAND)
RESULTS = without_braces(CAMPAIGN.results)
BATCH = f"{RESULTS}/batches/{{batch}}"
LOG = f"{RESULTS}/logs/{{batch}}"
SENSORS = ["accelerometer", "gyroscope"]
STARTED = time.time()
WAITING = {}  # settings files, written when jobs are run, not in a dry run
AGAIN = {}  # output to how often it has been repeated because files of it were edited
EDITED = []  # those files and folders
RUNNING = not workflow.is_main_process
if RUNNING:
    # A job group on another machine: the main process has looked at the files before any job.
    seen = Path(RESULTS, "configs", "again.json")
    AGAIN = json.loads(seen.read_text()) if seen.is_file() else {}
else:
    MONITOR = Monitor(
        CAMPAIGN.results,
        {batch: len(units) for batch, units in CAMPAIGN.batches.items()},
        logger,
    )


wildcard_constraints:
    batch=r"[A-Za-z0-9_.+-]+",
    sensor="|".join(SENSORS),
    stage="[a-z0-9_]+",


def settings_of(stage):
    """Return the function of a rule's params that names the settings file of the stage."""
    return lambda wildcards: settings_path(
        stage,
        CAMPAIGN.batches[wildcards.batch],
        f"batches/{wildcards.batch}/{stage}",
    )


def settings_path(stage, units, output, sensor=""):
    """Return the path of a stage's settings file; it exists once jobs are run."""
    if output not in AGAIN and not RUNNING:
        AGAIN[output], edited = repetitions(Path(RESULTS), output)
        EDITED.extend(edited)
    file = settings_file(CAMPAIGN, stage, units, sensor, AGAIN.get(output, 0))
    path = f"{RESULTS}/configs/{file.path.name}"
    if RUNNING:
        file.write()
    else:
        WAITING[path] = file
    return path


def begin_run():
    """Hold the results, start to print the progress, and write the settings files of the jobs."""
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
        finish_publishing(CAMPAIGN.results)
        for file in WAITING.values():
            file.write()
        if workflow.local_exec:
            atexit.register(start_server())
        MONITOR.print_edited(EDITED)
        Path(RESULTS, "configs", "again.json").write_text(json.dumps(AGAIN))
    except PipelineError as error:
        raise WorkflowError(str(error)) from None
    except OSError as error:
        raise WorkflowError(f"{CAMPAIGN.results} cannot be written: {error}") from None
    WAITING.clear()


def last_fit(sensor):
    """Return the input function that names the folder of a sensor's last stage."""
    return (
        lambda wildcards: f"{BATCH}/fit/{sensor}/{CAMPAIGN.chains[wildcards.batch][sensor][-1]}"
    )


def stage_before(wildcards):
    chain = CAMPAIGN.chains[wildcards.batch][wildcards.sensor]
    i = chain.index(wildcards.stage)
    return f"{BATCH}/fit/{{sensor}}/{chain[i - 1]}".format(**wildcards) if i else []


def settings_of_fit(wildcards):
    stage = "effects" if wildcards.stage == "effects" else f"fit-{wildcards.stage}"
    output = "batches/{batch}/fit/{sensor}/{stage}".format(**wildcards)
    return settings_path(
        stage, CAMPAIGN.batches[wildcards.batch], output, wildcards.sensor
    )


def code_of_fit(wildcards):
    modules = (
        "pipeline.stages.fit",
        stage_module(wildcards.sensor, wildcards.stage),
    )
    return "".join(code_digest(module) for module in modules)


def is_last_stage(wildcards):
    chain = CAMPAIGN.chains[wildcards.batch][wildcards.sensor]
    return "yes" if wildcards.stage == chain[-1] else "no"


def recordings(wildcards):
    """Return a digest of the names, sizes and times of a batch's recordings, which are too many to be listed."""
    digest = hashlib.sha256()
    for unit in [] if CAMPAIGN.simulation else CAMPAIGN.batches[wildcards.batch]:
        config = CAMPAIGN.units[unit].config
        files = recording_files(
            config["procedure"], config["ingest"], CAMPAIGN.folder(unit)
        )
        for path in sorted({path for paths in files.values() for path in paths}):
            found = path.stat()
            digest.update(f"{path}\0{found.st_size}\0{found.st_mtime_ns}\0".encode())
    return digest.hexdigest()[:16]


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
    return [report(p, **o) for p, o in paths.items() if os.path.exists(p)]


def of_batches(stage):
    """Return a stage's folder for every batch."""
    return [f"{RESULTS}/batches/{batch}/{stage}" for batch in CAMPAIGN.batches]


def print_at_the_end(text):
    """Print after Snakemake's last message."""
    MONITOR.ended.set()
    atexit.register(print, f"\n{text}", file=sys.stderr, end="")


def written_in_this_run(path):
    """Return whether a file was written since the run began."""
    return os.path.exists(path) and os.path.getmtime(path) >= STARTED - 1


def print_outcome(failures=""):
    """Print at the end of the terminal output what was found, how to continue, and which units have failed."""
    if not os.path.exists(f"{RESULTS}/summary.csv"):
        return
    try:
        recorded = max(Path(RESULTS, "history").glob("*.json"), default="")
        text = outcome(
            CAMPAIGN.results,
            CAMPAIGN.run_settings(),
            of_this_run=written_in_this_run(recorded),
        )
    except (OSError, PipelineError) as error:
        text = f"the results cannot be summed up: {error}\n"
    print_at_the_end(text + failures)


def print_verdict():
    """Print what was found where units have failed; a run that stopped before its end has no outcome."""
    log = f"{RESULTS}/logs/verdict.log"
    if written_in_this_run(log):
        with open(log) as stream:
            print_outcome(stream.read())


if not RUNNING:
    MONITOR.nothing_to_do = (
        print_outcome  # Snakemake calls no handler where nothing is to be done
    )
