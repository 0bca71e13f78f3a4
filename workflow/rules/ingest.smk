# A unit's files -> one Parquet file. Files that do not exist are no input: their unit fails, the others go on.


def recordings(wildcards):
    """Return a digest of which recordings a batch has, how large and how old: they are too many to be told one by one."""
    digest = hashlib.sha256()
    for unit in [] if CAMPAIGN.simulation else CAMPAIGN.batches[wildcards.batch]:
        config = CAMPAIGN.units[unit].config
        files = recording_files(
            config["procedure"], config["ingest"], CAMPAIGN.folder(unit)
        )
        for path in sorted({path for paths in files.values() for path in paths}):
            found = path.stat()
            digest.update(f"{path}\0{found.st_size}\0{found.st_mtime_ns}\0".encode())
    return digest.hexdigest()[:16]


rule ingest:
    input:
        SIMULATED if CAMPAIGN.simulation else [],
    output:
        directory(f"{BATCH}/ingest"),
    log:
        f"{LOG}/ingest.log",
    params:
        config=settings_of("ingest"),
        recordings=recordings,
        code=code_digest("pipeline.stages.ingest"),
    shell:
        "{RUN} ingest --config {params.config:q} --output {output:q} > {log:q} 2>&1"
