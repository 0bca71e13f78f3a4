# Simulates the recordings of a campaign (simulate: true in its campaign.yaml).
SIMULATED = f"{RESULTS}/simulated"

if PLAN["simulation"]:

    rule simulate:
        input:
            local(PLAN["simulation"]),
        output:
            local(directory(SIMULATED)),
        log:
            f"{RESULTS}/logs/simulate.log",
        threads: 1
        resources:
            mem_mb=1000,
            runtime=10,
        params:
            code=code_digest("pipeline.commands.simulate"),
        shell:
            "{RUN} simulate {output:q} --from {input:q} > {log:q} 2>&1"
