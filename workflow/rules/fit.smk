# Runs one stage of the method of one sensor on the result of the stage before it.


rule fit:
    input:
        settings=settings_of("fit/{sensor}/{stage}"),
        ingest=f"{BATCH}/ingest.zip",
        filter=f"{BATCH}/filter.zip",
        previous=stage_before,
    output:
        f"{BATCH}/fit/{{sensor}}/{{stage}}.zip",
    log:
        f"{LOG}/fit-{{sensor}}-{{stage}}.log",
    threads: 1
    resources:
        mem_mb=1000,
        runtime=10,
    shell:
        "{RUN} fit --config {input.settings:q} --sensor {wildcards.sensor} --stage {wildcards.stage}"
        " --ingest {input.ingest:q} --filter {input.filter:q} --previous={input.previous:q} --output {output:q}"
        " > {log:q} 2>&1"
