# Applies the configured filter to all recordings, and estimates the noise.
rule filter:
    input:
        settings=settings_of("filter"),
        ingest=f"{BATCH}/ingest.zip",
    output:
        f"{BATCH}/filter.zip",
    log:
        f"{LOG}/filter.log",
    threads: 1
    resources:
        mem_mb=1000,
        runtime=10,
    shell:
        "{RUN} filter --config {input.settings:q} --ingest {input.ingest:q} --output {output:q} > {log:q} 2>&1"
