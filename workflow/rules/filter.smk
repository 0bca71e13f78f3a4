# The readings of every recording through the configured filter.
rule filter:
    input:
        ingest=f"{BATCH}/ingest",
    output:
        directory(f"{BATCH}/filter"),
    log:
        f"{LOG}/filter.log",
    threads: 1
    resources:
        mem_mb=1000,
        runtime=10,
    params:
        config=settings_of("filter"),
        code=code_digest("pipeline.stages.filter"),
    shell:
        "{RUN} filter --config {params.config:q} --ingest {input.ingest:q} --output {output:q} > {log:q} 2>&1"
