"""The stages of a run: one function for each, which reads the files of a unit, calls the library, and returns files."""

# Stage to the module of its function ``<stage>_unit`` or ``<stage>_batch``, in the order of a run. A stage is repeated
# when the code that its module imports changes: a change of pages does not repeat calibrations.
MODULES = {
    "collect": "ingest",
    "ingest": "ingest",
    "filter": "filter",
    "fit": "fit",
    "validate": "validate",
    "diagnose": "diagnose",
    "calibration": "calibration",
    "export": "export",
    "report": "report",
    "summary": "summary",
    "lots": "prior",
    "prior": "prior",
    "gather": "gather",
    "verdict": "batch",
}
