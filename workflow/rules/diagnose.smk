# Which physical effect is missing.
rule diagnose:
    input:
        filter=f"{BATCH}/filter",
        accelerometer=last_fit("accelerometer"),
        gyroscope=last_fit("gyroscope"),
        validate=f"{BATCH}/validate",
    output:
        directory(f"{BATCH}/diagnose"),
    log:
        f"{LOG}/diagnose.log",
    threads: 1
    resources:
        mem_mb=1000,
        runtime=10,
    params:
        config=settings_of("diagnose"),
        code=code_digest("pipeline.stages.diagnose"),
    shell:
        "{RUN} diagnose --config {params.config:q} --filter {input.filter:q} --accelerometer {input.accelerometer:q}"
        " --gyroscope {input.gyroscope:q} --validate {input.validate:q} --output {output:q} > {log:q} 2>&1"
