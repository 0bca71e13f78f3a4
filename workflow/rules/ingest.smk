# Converts the recordings of each unit to one Parquet file. The settings contain names, sizes and times of the recordings.
# They are not inputs of the rule, so a missing recording fails only its unit.
SIMULATED_INPUT = local(SIMULATED) if PLAN["simulation"] else []

if PLAN["apart"]:

    # Machines without a shared disk get the recordings of a batch in one file, because Snakemake takes 0.1 ms for each
    # input at each start.
    localrules:
        collect,

    rule collect:
        input:
            settings=lambda wildcards: local(settings_file(wildcards.batch, "ingest")),
            simulated=SIMULATED_INPUT,
        output:
            temp(f"{BATCH}/recordings.zip"),
        log:
            f"{LOG}/collect.log",
        threads: 1
        resources:
            mem_mb=1000,
            runtime=10,
        shell:
            "{RUN} collect --config {input.settings:q} --output {output:q} > {log:q} 2>&1"


rule ingest:
    input:
        settings=settings_of("ingest"),
        simulated=[] if PLAN["apart"] else SIMULATED_INPUT,
        recordings=f"{BATCH}/recordings.zip" if PLAN["apart"] else [],
    output:
        f"{BATCH}/ingest.zip",
    log:
        f"{LOG}/ingest.log",
    threads: 1
    resources:
        mem_mb=1000,
        runtime=10,
    shell:
        "{RUN} ingest --config {input.settings:q} --recordings={input.recordings:q} --output {output:q} > {log:q} 2>&1"
