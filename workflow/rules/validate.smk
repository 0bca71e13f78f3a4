# The error on held-out motion after each step.
rule validate:
    input:
        filter=f"{BATCH}/filter",
        accelerometer=last_fit("accelerometer"),
        gyroscope=last_fit("gyroscope"),
    output:
        directory(f"{BATCH}/validate"),
    log:
        f"{LOG}/validate.log",
    threads: 1
    resources:
        mem_mb=1000,
        runtime=10,
    params:
        config=settings_of("validate"),
        code=code_digest("pipeline.stages.validate"),
    shell:
        "{RUN} validate --config {params.config:q} --filter {input.filter:q} --accelerometer {input.accelerometer:q}"
        " --gyroscope {input.gyroscope:q} --output {output:q} > {log:q} 2>&1"
