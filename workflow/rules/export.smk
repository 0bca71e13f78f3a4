# Writes the calibration in the formats of other programs.
rule export:
    input:
        settings=settings_of("export"),
        calibration=f"{BATCH}/calibration.zip",
        validate=f"{BATCH}/validate.zip",
        diagnose=f"{BATCH}/diagnose.zip",
    output:
        f"{BATCH}/export.zip",
    log:
        f"{LOG}/export.log",
    threads: 1
    resources:
        mem_mb=1000,
        runtime=10,
    shell:
        "{RUN} export --config {input.settings:q} --calibration {input.calibration:q} --validate {input.validate:q}"
        " --diagnose {input.diagnose:q} --output {output:q} > {log:q} 2>&1"
