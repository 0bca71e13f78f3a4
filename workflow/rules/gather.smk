# Every unit's files under their stable paths, the summary and the campaign page; `snakemake --report` shows the pages.
#
# The published files are no output of the rule: Snakemake would delete them before the job, and when it fails. The stage
# replaces them by a complete new set; what is changed or deleted by hand is found by `pipeline.results_folder`.
rule gather:
    input:
        of_batches("report"),
        of_batches("export"),
    output:
        f"{RESULTS}/batches/gathered.json",
    log:
        f"{RESULTS}/logs/gather.log",
    params:
        config=lambda wildcards: settings_path("gather", list(CAMPAIGN.units), ""),
        code=code_digest("pipeline.stages.gather"),
    shell:
        "{RUN} gather --config {params.config:q} --output {output:q} > {log:q} 2>&1"


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
