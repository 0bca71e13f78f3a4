# Sets the exit code of the run: fails, and names each failed unit with its cause, unless all units are calibrated.
rule verdict:
    input:
        failures=f"{RESULTS}/batches/gathered.json",
        page=local(f"{RESULTS}/{PLAN['page']}.html") if PLAN["page"] else [],
    output:
        f"{RESULTS}/complete.json",
    log:
        local(f"{RESULTS}/logs/verdict.log"),
    threads: 1
    resources:
        mem_mb=1000,
        runtime=10,
    shell:
        "{RUN} verdict --failures {input.failures:q} --results {CAMPAIGN.results:q} --output {output:q} 2> {log:q}"
