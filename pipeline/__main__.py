"""The command line: ``imu-calibration COMMAND ...``, or ``python -m pipeline COMMAND ...`` in a clone."""

from __future__ import annotations

import os
import sys
from importlib import import_module
from pathlib import Path

from pipeline.app.steps import MODULES as STAGES

for threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(threads, "1")  # a job is one core; set before numpy is imported

APP = "pipeline.app.commands"
COMMANDS = {  # name: module and function
    **{name: (f"{APP}.{name}", "main") for name in ("run", "new", "check", "plan", "guide", "explain", "add")},
    "remove": (f"{APP}.add", "remove"),
    **{name: (f"{APP}.{name}", "main") for name in ("convert", "apply", "noise", "simulate", "unpack", "config")},
    "study": ("imu_research.commands", "study"),
    "thesis": ("imu_research.commands", "thesis"),
}
ROOT = Path(__file__).parents[1]
PROGRAM = "imu-calibration" if Path(sys.argv[0]).name == "imu-calibration" else "python -m pipeline"


def _summary(module: str, function: str) -> str:
    """Read the summary line of a command from its source: of the module for ``main``, else of the function."""
    text = ROOT.joinpath(*module.split(".")).with_suffix(".py").read_text(encoding="utf-8")
    start = 0 if function == "main" else text.index(f"\ndef {function}")
    return text[start:].split('"""', 2)[1].splitlines()[0]


def _stage_summary(stage: str, module: str) -> str:
    """Read the summary line of a stage: of its module, or of its function in a module of several stages."""
    alone = [*STAGES.values()].count(module) == 1
    return _summary(f"pipeline.app.steps.{module}", "main" if alone and stage != "verdict" else stage)


def _help(*, stages: bool) -> str:
    hint = "COMMAND --help says more; --help --all names the stages of a run; --version"
    lines = [f"usage: {PROGRAM} COMMAND ... ({hint})", "", "commands:"]
    lines += [f"  {name:<12} {_summary(module, function)}" for name, (module, function) in COMMANDS.items()]
    if stages:
        lines += ["", "stages, which the rules of the workflow call:"]
        lines += [f"  {name:<12} {_stage_summary(name, module)}" for name, module in STAGES.items()]
    return "\n".join(lines)


def main(argv: list[str] | None = None) -> int:
    """Run a command or stage and return its exit code; report a user error in one line, with exit code 2."""
    command, *rest = (sys.argv[1:] if argv is None else argv) or ["--help"]
    if command in ("-h", "--help", "--version"):
        from pipeline.core import VERSION  # noqa: PLC0415  (nothing else is needed)

        print(f"imu-calibration {VERSION}" if command == "--version" else _help(stages="--all" in rest))
        return 0
    if command == "job-server":  # started by workflow/rules/common.smk
        import socket  # noqa: PLC0415

        from pipeline.app.steps.job_server import serve  # noqa: PLC0415

        return serve(socket.socket(fileno=int(rest[0])), run_command)
    if command not in (*COMMANDS, *STAGES):
        known = ", ".join((*COMMANDS, *STAGES))
        print(f"{PROGRAM}: no command {command!r}; known: {known}", file=sys.stderr)
        return 2
    return run_command([command, *rest])


def run_command(words: list[str]) -> int:
    """Run a known command in this process."""
    from pipeline.core.errors import UNKNOWN_LAYOUT, PipelineError  # noqa: PLC0415
    from pipeline.core.files import use_cache  # noqa: PLC0415

    use_cache()
    command, *rest = words
    try:
        if command in COMMANDS:
            module, function = COMMANDS[command]
            return int(getattr(import_module(module), function)(rest))
        return int(import_module("pipeline.app.steps.batch").main(command, rest))
    except PipelineError as error:
        print(f"{PROGRAM} {command}: {error}", file=sys.stderr)
        if error.code in UNKNOWN_LAYOUT:
            print(f"{PROGRAM} check FILE --save PROFILE.yaml proposes how to read it, for --ingest", file=sys.stderr)
        return 2
    except BrokenPipeError:
        sys.stderr.close()
        return 1


if __name__ == "__main__":
    sys.exit(main())
