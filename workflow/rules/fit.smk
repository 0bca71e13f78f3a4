# One stage of one sensor's method, on the result of the stage before it.


rule fit:
    input:
        filter=f"{BATCH}/filter",
        previous=stage_before,
    output:
        directory(f"{BATCH}/fit/{{sensor}}/{{stage}}"),
    log:
        f"{LOG}/fit-{{sensor}}-{{stage}}.log",
    threads: 1
    resources:
        mem_mb=1000,
        runtime=10,
    params:
        config=settings_of_fit,
        code=code_of_fit,
        last=is_last_stage,
    shell:
        "{RUN} fit --config {params.config:q} --sensor {wildcards.sensor} --stage {wildcards.stage}"
        " --last {params.last} --filter {input.filter:q} --previous={input.previous:q} --output {output:q}"
        " > {log:q} 2>&1"
