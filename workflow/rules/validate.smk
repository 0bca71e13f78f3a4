# Computes the error on held-out motion after each step.
rule validate:
    input:
        settings=settings_of("validate"),
        ingest=f"{BATCH}/ingest.zip",
        filter=f"{BATCH}/filter.zip",
        accelerometer=last_fit("accelerometer"),
        gyroscope=last_fit("gyroscope"),
    output:
        f"{BATCH}/validate.zip",
    log:
        f"{LOG}/validate.log",
    threads: 1
    resources:
        mem_mb=1000,
        runtime=10,
    shell:
        "{RUN} validate --config {input.settings:q} --ingest {input.ingest:q} --filter {input.filter:q} --accelerometer {input.accelerometer:q}"
        " --gyroscope {input.gyroscope:q} --output {output:q} > {log:q} 2>&1"
