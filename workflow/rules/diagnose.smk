# Diagnoses which physical effects the model lacks.
rule diagnose:
    input:
        settings=settings_of("diagnose"),
        ingest=f"{BATCH}/ingest.zip",
        filter=f"{BATCH}/filter.zip",
        accelerometer=last_fit("accelerometer"),
        gyroscope=last_fit("gyroscope"),
        validate=f"{BATCH}/validate.zip",
    output:
        f"{BATCH}/diagnose.zip",
    log:
        f"{LOG}/diagnose.log",
    threads: 1
    resources:
        mem_mb=1000,
        runtime=10,
    shell:
        "{RUN} diagnose --config {input.settings:q} --ingest {input.ingest:q} --filter {input.filter:q} --accelerometer {input.accelerometer:q}"
        " --gyroscope {input.gyroscope:q} --validate {input.validate:q} --output {output:q} > {log:q} 2>&1"
