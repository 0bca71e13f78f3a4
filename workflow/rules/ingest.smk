# A unit's files -> one Parquet file. Files that do not exist are no input: their unit fails, the others go on.
def recordings(wildcards):
    if CAMPAIGN.simulation:
        return [SIMULATED]
    found = []
    for unit in CAMPAIGN.batches[wildcards.batch]:
        config = CAMPAIGN.units[unit].config
        files = recording_files(
            config["procedure"], config["ingest"], CAMPAIGN.folder(unit)
        )
        found += [str(path) for paths in files.values() for path in paths]
    return sorted(set(found))


rule ingest:
    input:
        recordings,
    output:
        directory(f"{BATCH}/ingest"),
    log:
        f"{LOG}/ingest.log",
    params:
        config=part("ingest"),
        code=code_digest("pipeline.stages.ingest"),
    shell:
        "{RUN} ingest --config {params.config:q} --output {output:q} > {log:q} 2>&1"
