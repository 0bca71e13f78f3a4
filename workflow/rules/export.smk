# The calibration in the formats of those who use it.
rule export:
    input:
        calibration=f"{BATCH}/calibration",
        validate=f"{BATCH}/validate",
        diagnose=f"{BATCH}/diagnose",
    output:
        directory(f"{BATCH}/export"),
    log:
        f"{LOG}/export.log",
    threads: 1
    resources:
        mem_mb=1000,
        runtime=10,
    params:
        config=settings_of("export"),
        code=code_digest("pipeline.stages.export"),
    shell:
        "{RUN} export --config {params.config:q} --calibration {input.calibration:q} --validate {input.validate:q}"
        " --diagnose {input.diagnose:q} --output {output:q} > {log:q} 2>&1"
