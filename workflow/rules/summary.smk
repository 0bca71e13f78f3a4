# Collects the data of each unit for the files about all units.
rule summary:
    input:
        settings=settings_of("summary"),
        calibration=f"{BATCH}/calibration.zip",
        validate=f"{BATCH}/validate.zip",
        diagnose=f"{BATCH}/diagnose.zip",
        report=f"{BATCH}/report.zip",
    output:
        f"{BATCH}/summary.zip",
    log:
        f"{LOG}/summary.log",
    threads: 1
    resources:
        mem_mb=1000,
        runtime=10,
    shell:
        "{RUN} summary --config {input.settings:q} --calibration {input.calibration:q} --validate {input.validate:q}"
        " --diagnose {input.diagnose:q} --report {input.report:q} --output {output:q} > {log:q} 2>&1"
