# The campaign, resolved and checked before any job; and what every rule has in common.
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
from snakemake.settings.types import Quietness

sys.path.insert(0, workflow.basedir)
# Jobs run this copy of the package, from any working directory, and find what the user's own path holds.
os.environ["PYTHONPATH"] = os.pathsep.join(
    filter(None, [workflow.basedir, os.environ.get("PYTHONPATH")])
)

from pipeline.config import code_digest, load_campaign, part_file
from pipeline.errors import PipelineError
from pipeline.io.files import recording_files
from pipeline.outcome import outcome
from pipeline.publish import finish_publishing
from pipeline.run_watch import Watch
from pipeline.written import times_again

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
RUN = f"{shlex.quote(sys.executable)} -m pipeline"
RESULTS = without_braces(CAMPAIGN.results)
BATCH = f"{RESULTS}/batches/{{batch}}"
LOG = f"{RESULTS}/logs/{{batch}}"
SENSORS = ["accelerometer", "gyroscope"]
STARTED = time.time()
WAITING = {}  # parts of the configuration: written where jobs are run, not in a dry run
AGAIN = (
    {}
)  # output to how often it has been made again, because files of it were changed or deleted
CHANGED = []  # those files and folders
RUNNING = not workflow.is_main_process
if RUNNING:
    # A job group on another machine: the main process has looked at the files before any job.
    seen = Path(RESULTS, "configs", "again.json")
    AGAIN = json.loads(seen.read_text()) if seen.is_file() else {}
else:
    WATCH = Watch(
        str(CAMPAIGN.results),
        {batch: len(units) for batch, units in CAMPAIGN.batches.items()},
    )


wildcard_constraints:
    batch=r"[A-Za-z0-9_.+-]+",
    sensor="|".join(SENSORS),
    stage="[a-z0-9_]+",


def part(stage):
    """Return the function of a rule's params that names the stage's part of the configuration."""
    return lambda wildcards: name_part(
        stage,
        CAMPAIGN.batches[wildcards.batch],
        f"batches/{wildcards.batch}/{stage}",
    )


def name_part(stage, units, output, sensor=""):
    """Return the path of a stage's part of the configuration, which is there once jobs are run."""
    if output not in AGAIN and not RUNNING:
        AGAIN[output], changed = times_again(Path(RESULTS), output)
        CHANGED.extend(changed)
    file = part_file(CAMPAIGN, stage, units, sensor, AGAIN.get(output, 0))
    path = f"{RESULTS}/configs/{file.path.name}"
    if RUNNING:
        file.write()
    else:
        WAITING[path] = file
    return path


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
        finish_publishing(CAMPAIGN.results)
        for file in WAITING.values():
            file.write()
        WATCH.tell_changed(CHANGED)
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
        recorded = max(Path(RESULTS, "history").glob("*.json"), default="")
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
    WATCH.idle = (
        say_outcome  # where there is nothing to be done, Snakemake calls no handler
    )
