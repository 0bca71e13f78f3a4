# Every unit's files under their stable paths, the summary and the campaign page; `snakemake --report` shows the pages.
rule gather:
    input:
        of_batches("report"),
        of_batches("export"),
    output:
        report(
            f"{RESULTS}/index.html",
            category="Campaign",
            labels={"page": "the campaign"},
        ),
        report(
            f"{RESULTS}/summary.csv",
            category="Campaign",
            labels={"page": "one row a unit"},
        ),
        f"{RESULTS}/failures.json",
        f"{RESULTS}/parameters.parquet",
        f"{RESULTS}/fleet.json",
        [
            directory(f"{RESULTS}/{name}")
            for name in (
                "calibrations",
                "validations",
                "diagnoses",
                "certificates",
                "exports",
            )
        ],
        report(
            directory(f"{RESULTS}/reports"),
            patterns=["{unit}.html"],
            category="Units",
            labels={"unit": "{unit}"},
        ),
    log:
        f"{RESULTS}/logs/gather.log",
    params:
        config=lambda wildcards: name_part("gather", list(CAMPAIGN.units)),
        code=code_digest("pipeline.stages.gather"),
        batches=",".join(f"{RESULTS}/batches/{batch}" for batch in CAMPAIGN.batches),
    shell:
        "{RUN} gather --config {params.config:q} --batches {params.batches:q} --output {RESULTS:q} > {log:q} 2>&1"
