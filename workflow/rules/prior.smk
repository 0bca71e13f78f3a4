# Computes the priors of all lots from the summaries of all batches, and updates each unit (combine=lot).
LOTS = f"{RESULTS}/batches/lots.zip"

if PLAN["combine"] == "lot":

    localrules:
        lots,

    rule lots:
        input:
            settings=lambda wildcards: local(settings_file("campaign", "lots")),
            summaries=of_batches("summary"),
        output:
            LOTS,
        log:
            f"{RESULTS}/logs/lots.log",
        threads: 1
        resources:
            mem_mb=1000,
            runtime=10,
        shell:
            "{RUN} lots --config {input.settings:q} --output {output:q} > {log:q} 2>&1"

    rule prior:
        input:
            settings=settings_of("prior"),
            ingest=f"{BATCH}/ingest.zip",
            filter=f"{BATCH}/filter.zip",
            calibration=f"{BATCH}/calibration.zip",
            validate=f"{BATCH}/validate.zip",
            diagnose=f"{BATCH}/diagnose.zip",
            report=f"{BATCH}/report.zip",
            lots=LOTS,
        output:
            f"{BATCH}/prior.zip",
        log:
            f"{LOG}/prior.log",
        threads: 1
        resources:
            mem_mb=1000,
            runtime=10,
        shell:
            "{RUN} prior --config {input.settings:q} --ingest {input.ingest:q} --filter {input.filter:q}"
            " --calibration {input.calibration:q} --validate {input.validate:q} --diagnose {input.diagnose:q}"
            " --report {input.report:q} --lots {input.lots:q} --output {output:q} > {log:q} 2>&1"
