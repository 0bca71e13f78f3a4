# The readings of every recording through the configured filter.
rule filter:
    input:
        ingest=f"{BATCH}/ingest",
    output:
        directory(f"{BATCH}/filter"),
    log:
        f"{LOG}/filter.log",
    params:
        config=settings_of("filter"),
        code=code_digest("pipeline.stages.filter"),
    shell:
        "{RUN} filter --config {params.config:q} --ingest {input.ingest:q} --output {output:q} > {log:q} 2>&1"
