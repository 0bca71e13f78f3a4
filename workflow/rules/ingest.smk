# A unit's files -> one Parquet file. Names, sizes and times of the recordings are part of the settings; those that do not
# exist are no input: their unit fails, the others go on. Snakemake runs a rule with a local input where it was started, not
# on another machine that does not share a disk with this one: there the packs of ingest replace the recordings.
rule ingest:
    input:
        settings=lambda wildcards: local(settings_file(wildcards.batch, "ingest")),
        simulated=local(SIMULATED) if PLAN["simulation"] else [],
    output:
        f"{BATCH}/ingest.zip",
    log:
        f"{LOG}/ingest.log",
    threads: 1
    resources:
        mem_mb=1000,
        runtime=10,
    params:
        code=code_digest("pipeline.stages.ingest"),
    shell:
        "{RUN} ingest --config {input.settings:q} --output {output:q} > {log:q} 2>&1"
