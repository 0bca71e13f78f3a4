# Calibration of inertial measurement units: the stages and what they depend on.
#
#   snakemake --cores 2                                          runs data/demo
#   snakemake --cores 2 --config campaign=NAME_OR_DIR            runs another campaign
#   ... --config campaign=C 'overrides=[filter=rc_low_pass]'     Hydra overrides for every unit of the run
#
# ingest -> filter -> fit/{sensor}/{stage} ... -> validate, diagnose, calibration -> export -> report -> summary -> gather -> verdict
#
# A job handles a batch of units and writes one file, results/<campaign>/batches/<batch>/<stage>.zip.


include: "workflow/rules/common.smk"


if DEPLOYED:

    # With `--software-deployment-method apptainer` each job runs in this image (Containerfile).
    container: "imu-calibration.sif"


include: "workflow/rules/prior.smk"
include: "workflow/rules/gather.smk"


rule all:
    default_target: True
    input:
        f"{RESULTS}/complete.json",
        pages,


include: "workflow/rules/simulate.smk"
include: "workflow/rules/ingest.smk"
include: "workflow/rules/filter.smk"
include: "workflow/rules/fit.smk"
include: "workflow/rules/validate.smk"
include: "workflow/rules/diagnose.smk"
include: "workflow/rules/calibration.smk"
include: "workflow/rules/export.smk"
include: "workflow/rules/report.smk"
include: "workflow/rules/summary.smk"
include: "workflow/rules/thesis.smk"
include: "workflow/rules/verdict.smk"


localrules:
    all,
    gather,
    verdict,


onstart:
    begin_run()
    if workflow.local_exec:
        # Snakemake's limit of jobs per second wakes its scheduler once a second for every finished job: in a fleet, a
        # hundred times a second (snakemake/snakemake, issue 2967).
        workflow.scheduler.job_rate_limiter = None


onsuccess:
    print_outcome()


onerror:
    print_verdict()
