# The campaign, resolved and checked before any job; and what every rule has in common.
import atexit
import gc
import hashlib
import os
import sys
import time
from glob import glob

from snakemake.exceptions import WorkflowError
from snakemake.settings.types import Quietness

sys.path.insert(0, workflow.basedir)
# Jobs run this copy of the package, from any working directory, and find what the user's own path holds.
os.environ["PYTHONPATH"] = os.pathsep.join(
    filter(None, [workflow.basedir, os.environ.get("PYTHONPATH")])
)

from pipeline.config import code_digest, load_campaign, part_file
from pipeline.errors import PipelineError
from pipeline.formats.files import recording_files
from pipeline.outcome import outcome
from pipeline.run_watch import Watch

try:
    CAMPAIGN = load_campaign(config)
except PipelineError as error:
    raise WorkflowError(str(error)) from None
gc.freeze()  # the campaign stays: looking for garbage in thousands of configurations takes seconds

RUN = f"{sys.executable} -m pipeline"
RESULTS = str(CAMPAIGN.results)
BATCH = f"{RESULTS}/batches/{{batch}}"
LOG = f"{RESULTS}/logs/{{batch}}"
SENSORS = ["accelerometer", "gyroscope"]
STARTED = time.time()
WAITING = {}  # parts of the configuration: written where jobs are run, not in a dry run
RUNNING = not workflow.is_main_process
if not RUNNING:
    WATCH = Watch(
        RESULTS, {batch: len(units) for batch, units in CAMPAIGN.batches.items()}
    )


wildcard_constraints:
    batch=r"[A-Za-z0-9_.+-]+",
    sensor="|".join(SENSORS),
    stage="[a-z0-9_]+",


def part(stage):
    """Return the function of a rule's params that names the stage's part of the configuration."""
    return lambda wildcards: name_part(stage, CAMPAIGN.batches[wildcards.batch])


def name_part(stage, units, sensor=""):
    """Return the path of a stage's part of the configuration, which is there once jobs are run."""
    file = part_file(CAMPAIGN, stage, units, sensor)
    if RUNNING:
        return file.write()
    WAITING[file.path] = file
    return str(file.path)


def begin_run():
    """Hold the results, begin to tell how far the run is, and write what jobs read of the configuration."""
    global RUNNING
    if RUNNING:
        return
    told = workflow.output_settings
    silent = {Quietness.ALL, Quietness.PROGRESS} & set(told.quiet or ())
    try:
        WATCH.begin(
            quiet=bool(silent),
            plain=told.verbose or told.printshellcmds,
        )
        RUNNING = True
        for file in WAITING.values():
            file.write()
    except PipelineError as error:
        raise WorkflowError(str(error)) from None
    except OSError as error:
        raise WorkflowError(f"{RESULTS} cannot be written: {error}") from None
    WAITING.clear()


def last_fit(sensor):
    """Return the input function that names the folder of a sensor's last stage."""
    return (
        lambda wildcards: f"{BATCH}/fit/{sensor}/{CAMPAIGN.chains[wildcards.batch][sensor][-1]}"
    )


def of_batches(stage):
    """Return a stage's folder for every batch."""
    return [f"{RESULTS}/batches/{batch}/{stage}" for batch in CAMPAIGN.batches]


def say_at_the_end(text):
    """Print after Snakemake's own last words."""
    WATCH.ended.set()
    atexit.register(print, f"\n{text}", file=sys.stderr, end="")


def written_in_this_run(path):
    """Return whether a file was written since the run began."""
    return os.path.exists(path) and os.path.getmtime(path) >= STARTED - 1


def say_outcome(failures=""):
    """Say at the very end of the terminal output what was found, how to continue, and which units have failed."""
    if not os.path.exists(f"{RESULTS}/summary.csv"):
        return
    try:
        recorded = max(glob(f"{RESULTS}/history/*.json"), default="")
        told = outcome(
            CAMPAIGN.results,
            CAMPAIGN.run_settings(),
            of_this_run=written_in_this_run(recorded),
        )
    except (OSError, PipelineError) as error:
        told = f"the results cannot be summed up: {error}\n"
    say_at_the_end(told + failures)


def say_verdict():
    """Say what was found where units have failed; a run that broke before its end has no outcome."""
    log = f"{RESULTS}/logs/verdict.log"
    if written_in_this_run(log):
        with open(log) as stream:
            say_outcome(stream.read())


if not RUNNING:
    WATCH.idle = say_outcome  # where there is nothing to be done, Snakemake calls no handler
