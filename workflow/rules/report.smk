# One page a unit, those that failed included.
rule report:
    input:
        filter=f"{BATCH}/filter",
        calibration=f"{BATCH}/calibration",
        validate=f"{BATCH}/validate",
        diagnose=f"{BATCH}/diagnose",
        export=f"{BATCH}/export",
    output:
        directory(f"{BATCH}/report"),
    log:
        f"{LOG}/report.log",
    threads: 1
    resources:
        mem_mb=1000,
        runtime=10,
    params:
        config=settings_of("report"),
        code=code_digest("pipeline.stages.report"),
    shell:
        "{RUN} report --config {params.config:q} --filter {input.filter:q} --calibration {input.calibration:q}"
        " --validate {input.validate:q} --diagnose {input.diagnose:q}"
        " --export {input.export:q} --output {output:q} > {log:q} 2>&1"
