# Simulates the recordings of a campaign (simulate: true in its campaign.yaml).
# Its sheet stands for the folder: Snakemake would delete a whole folder before the job, with files that no run wrote.
SIMULATED = f"{RESULTS}/simulated/units.csv"

if PLAN["simulation"]:

    rule simulate:
        input:
            local(PLAN["simulation"]),
        output:
            local(SIMULATED),
        log:
            f"{RESULTS}/logs/simulate.log",
        threads: 1
        resources:
            mem_mb=1000,
            runtime=10,
        params:
            folder=f"{RESULTS}/simulated",
            code=code_digest("pipeline.app.commands.simulate"),
        shell:
            "{RUN} simulate {params.folder:q} --from {input:q} --replace > {log:q} 2>&1"
