# Writes the page of each unit, also of failed units.
rule report:
    input:
        settings=settings_of("report"),
        ingest=f"{BATCH}/ingest.zip",
        filter=f"{BATCH}/filter.zip",
        calibration=f"{BATCH}/calibration.zip",
        validate=f"{BATCH}/validate.zip",
        diagnose=f"{BATCH}/diagnose.zip",
        export=f"{BATCH}/export.zip",
    output:
        f"{BATCH}/report.zip",
    log:
        f"{LOG}/report.log",
    threads: 1
    resources:
        mem_mb=1000,
        runtime=10,
    shell:
        "{RUN} report --config {input.settings:q} --ingest {input.ingest:q} --filter {input.filter:q} --calibration {input.calibration:q}"
        " --validate {input.validate:q} --diagnose {input.diagnose:q}"
        " --export {input.export:q} --output {output:q} > {log:q} 2>&1"
