# Publishes the files of all units, the summary and the campaign page; `snakemake --report` shows the pages.
#
# The published files are not an output of the rule, because Snakemake would delete them before the job and after a
# failure. The stage replaces them by a complete new set; `pipeline.app.results_folder` detects edited or deleted files.
rule gather:
    input:
        settings=lambda wildcards: local(settings_file("campaign", "gather")),
        packs=[of_batches(stage) for stage in PUBLISHED_STAGES],
        priors=[LOTS, *of_batches("prior")] if PLAN["combine"] == "lot" else [],
    output:
        f"{RESULTS}/batches/gathered.json",
    log:
        f"{RESULTS}/logs/gather.log",
    threads: 1
    resources:
        mem_mb=1000,
        runtime=10,
    shell:
        "{RUN} gather --config {input.settings:q} --output {output:q} > {log:q} 2>&1"
