# One stage of one sensor's method, on the result of the stage before it.
def stage_before(wildcards):
    chain = CAMPAIGN.chains[wildcards.batch][wildcards.sensor]
    i = chain.index(wildcards.stage)
    return f"{BATCH}/fit/{{sensor}}/{chain[i - 1]}".format(**wildcards) if i else []


def settings_of_fit(wildcards):
    stage = "effects" if wildcards.stage == "effects" else f"fit-{wildcards.stage}"
    output = "batches/{batch}/fit/{sensor}/{stage}".format(**wildcards)
    return settings_path(stage, CAMPAIGN.batches[wildcards.batch], output, wildcards.sensor)


def code_of_fit(wildcards):
    modules = (
        "pipeline.stages.fit",
        f"pipeline.estimation.{wildcards.sensor}.{wildcards.stage}",
    )
    return "".join(code_digest(module) for module in modules)


def is_last_stage(wildcards):
    chain = CAMPAIGN.chains[wildcards.batch][wildcards.sensor]
    return "yes" if wildcards.stage == chain[-1] else "no"


rule fit:
    input:
        filter=f"{BATCH}/filter",
        previous=stage_before,
    output:
        directory(f"{BATCH}/fit/{{sensor}}/{{stage}}"),
    log:
        f"{LOG}/fit-{{sensor}}-{{stage}}.log",
    params:
        config=settings_of_fit,
        code=code_of_fit,
        last=is_last_stage,
    shell:
        "{RUN} fit --config {params.config:q} --sensor {wildcards.sensor} --stage {wildcards.stage}"
        " --last {params.last} --filter {input.filter:q} --previous={input.previous:q} --output {output:q}"
        " > {log:q} 2>&1"
