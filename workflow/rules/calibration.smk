# Writes the calibration of both sensors, the inputs and the software versions in one document.
rule calibration:
    input:
        settings=settings_of("calibration"),
        ingest=f"{BATCH}/ingest.zip",
        accelerometer=last_fit("accelerometer"),
        gyroscope=last_fit("gyroscope"),
        validate=f"{BATCH}/validate.zip",
        diagnose=f"{BATCH}/diagnose.zip",
    output:
        f"{BATCH}/calibration.zip",
    log:
        f"{LOG}/calibration.log",
    threads: 1
    resources:
        mem_mb=1000,
        runtime=10,
    shell:
        "{RUN} calibration --config {input.settings:q} --ingest {input.ingest:q} --accelerometer {input.accelerometer:q}"
        " --gyroscope {input.gyroscope:q} --validate {input.validate:q} --diagnose {input.diagnose:q} --output {output:q} > {log:q} 2>&1"
