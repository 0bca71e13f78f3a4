# Compares the results of the thesis's campaign with its printed figures (page: thesis in campaign.yaml).
if PLAN["page"] == "thesis":

    rule thesis:
        input:
            rules.gather.output,
            local(
                collect(
                    f"{PLAN['directory']}/{{file}}",
                    file=[
                        "seeds.csv",
                        "printed/accel_parameters.csv",
                        "printed/gyro_parameters.csv",
                        "printed/errors.csv",
                        "printed/method_comparison.csv",
                        "printed/conference_paper.csv",
                        "printed/conference_paper_six_positions.csv",
                        "printed/explanations.yaml",
                    ],
                )
            ),
        output:
            local(
                report(
                    f"{RESULTS}/thesis.html",
                    category="Campaign",
                    labels={"page": "beside what was printed"},
                )
            ),
        log:
            f"{RESULTS}/logs/thesis.log",
        threads: 1
        resources:
            mem_mb=1000,
            runtime=10,
        params:
            campaign=lambda wildcards: str(CAMPAIGN.directory),
            code=code_digest("imu_research.thesis.page"),
        shell:
            "{RUN} thesis page --campaign {params.campaign:q} --results {RESULTS:q} --output {output:q} > {log:q} 2>&1"
