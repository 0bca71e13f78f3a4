"""The stages of a run: one function for each, which reads the files of a unit, calls the library, and returns files."""

from pipeline.unit import STEPS

# Stage to the module of its function ``<stage>_unit`` or ``<stage>_batch``, in the order of a run. A stage is repeated
# when the code that its module imports changes: a change of pages does not repeat calibrations.
MODULES = {"collect": "ingest", **{name: step.function.partition(".")[0] for name, step in STEPS.items()}}
MODULES |= {"lots": "prior", "prior": "prior", "gather": "gather", "verdict": "batch"}
