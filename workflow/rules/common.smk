# The campaign, resolved and checked before any job; and what every rule has in common.
import atexit
import os
import sys
import time

from snakemake.exceptions import WorkflowError

sys.path.insert(0, workflow.basedir)
os.environ["PYTHONPATH"] = (
    workflow.basedir
)  # jobs run this copy of the package, from any working directory

from pipeline.config import code_digest, load_campaign, write_part
from pipeline.errors import PipelineError
from pipeline.formats.files import recording_files

try:
    CAMPAIGN = load_campaign(config)
except PipelineError as error:
    raise WorkflowError(str(error)) from None

RUN = f"{sys.executable} -m pipeline"
RESULTS = str(CAMPAIGN.results)
BATCH = f"{RESULTS}/batches/{{batch}}"
LOG = f"{RESULTS}/logs/{{batch}}"
SENSORS = ["accelerometer", "gyroscope"]
STARTED = time.time()


wildcard_constraints:
    batch=r"[A-Za-z0-9_.+-]+",
    sensor="|".join(SENSORS),
    stage="[a-z0-9_]+",


def part(stage):
    """Return the function of a rule's params that names the stage's part of the configuration."""
    return lambda wildcards: write_part(
        CAMPAIGN, stage, CAMPAIGN.batches[wildcards.batch]
    )


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
    atexit.register(print, f"\n{text}", file=sys.stderr, end="")


def repeat_verdict():
    """Say at the very end of the terminal output which units have failed, and why."""
    log = f"{RESULTS}/logs/verdict.log"
    if os.path.exists(log) and os.path.getmtime(log) >= STARTED - 1:
        with open(log) as stream:
            say_at_the_end(stream.read())
