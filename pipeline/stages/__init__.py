"""The stages of a run: a function each, which reads the files of a unit, calls the library, and returns files."""

MODULES = {  # stage: the module of its function ``<stage>_unit`` or ``<stage>_batch``, in the order of a run
    "collect": "ingest",
    "ingest": "ingest",
    "filter": "ingest",
    "fit": "fit",
    "validate": "evaluate",
    "diagnose": "evaluate",
    "calibration": "documents",
    "export": "documents",
    "report": "documents",
    "gather": "gather",
    "verdict": "batch",
}
