# Every unit's files under their stable paths, the summary and the campaign page.
rule gather:
    input:
        of_batches("report"),
        of_batches("export"),
    output:
        f"{RESULTS}/index.html",
        f"{RESULTS}/summary.csv",
        f"{RESULTS}/failures.json",
        [
            directory(f"{RESULTS}/{name}")
            for name in (
                "calibrations",
                "validations",
                "diagnoses",
                "reports",
                "exports",
            )
        ],
    log:
        f"{RESULTS}/logs/gather.log",
    params:
        config=lambda wildcards: write_part(CAMPAIGN, "gather", list(CAMPAIGN.units)),
        code=code_digest("pipeline.stages.gather"),
        batches=",".join(f"{RESULTS}/batches/{batch}" for batch in CAMPAIGN.batches),
    shell:
        "{RUN} gather --config {params.config:q} --batches {params.batches:q} --output {RESULTS:q} > {log:q} 2>&1"
