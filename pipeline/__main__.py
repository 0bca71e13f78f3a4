"""The command line: ``python -m pipeline <stage or command>``; a command is imported only when it is asked for."""

from __future__ import annotations

import ast
import os
import sys
from importlib import import_module
from pathlib import Path

for threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(threads, "1")  # a job is one core; set before numpy is imported

STAGES = (
    "ingest", "filter", "fit", "validate", "diagnose", "calibration", "export", "report", "gather", "verdict",
)  # fmt: skip
HERE = Path(__file__).parent


def commands() -> dict[str, str]:
    """Return every command and the module that runs it."""
    people = sorted(f.stem for f in (HERE / "commands").glob("*.py") if f.stem != "__init__")
    return {name: f"pipeline.commands.{name}" for name in people} | {n: f"pipeline.stages.{n}" for n in STAGES}


def summary(module: str) -> str:
    """Return the first line of a module's docstring, without importing it."""
    source = HERE.joinpath(*module.split(".")[1:]).with_suffix(".py").read_text(encoding="utf-8")
    return (ast.get_docstring(ast.parse(source)) or "").splitlines()[0]


def main(argv: list[str]) -> int:
    """Run a command; a user error is one line and exit code 2."""
    known = commands()
    if not argv or argv[0] in ("-h", "--help"):
        print("usage: python -m pipeline COMMAND ... (COMMAND --help says more)\n")
        for name, module in known.items():
            if name == STAGES[0]:
                print("\nstages, which the rules of the workflow call:\n")
            print(f"  {name:<12} {summary(module)}")
        return 0
    if argv[0] not in known:
        print(f"python -m pipeline: no command {argv[0]!r}; known: {', '.join(known)}", file=sys.stderr)
        return 2
    from pipeline.errors import PipelineError  # noqa: PLC0415  (nothing of the package is needed before)

    try:
        return int(import_module(known[argv[0]]).main(argv[1:]))
    except PipelineError as error:
        print(f"python -m pipeline {argv[0]}: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        sys.stderr.close()
        return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
