# The exit code of the run: fails, and names every failed unit with its cause, unless all units are calibrated.
rule verdict:
    input:
        f"{RESULTS}/failures.json",
    output:
        f"{RESULTS}/complete.json",
    log:
        f"{RESULTS}/logs/verdict.log",
    shell:
        "{RUN} verdict --failures {input:q} --output {output:q} 2> {log:q}"
