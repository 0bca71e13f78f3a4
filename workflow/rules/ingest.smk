# A unit's files -> one Parquet file. Files that do not exist are no input: their unit fails, the others go on.


rule ingest:
    input:
        SIMULATED if CAMPAIGN.simulation else [],
    output:
        directory(f"{BATCH}/ingest"),
    log:
        f"{LOG}/ingest.log",
    threads: 1
    resources:
        mem_mb=1000,
        runtime=10,
    params:
        config=settings_of("ingest"),
        recordings=recordings,
        code=code_digest("pipeline.stages.ingest"),
    shell:
        "{RUN} ingest --config {params.config:q} --output {output:q} > {log:q} 2>&1"
