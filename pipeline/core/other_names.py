"""Modules under a second name: the same module object, so that no class exists twice.

``import pipeline.errors`` returns ``pipeline.core.errors``, where that module stood before, with a DeprecationWarning.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.abc import InspectLoader, Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec, spec_from_file_location
from types import CodeType, ModuleType

MOVED = {  # where modules and packages are that stood in ``pipeline`` in version 0.1, and have the same name
    "pipeline.app": ("commands", "config", "field_logs", "one_unit", "results_folder", "run_progress"),
    "pipeline.core": ("errors", "files", "pack", "records", "settings", "verdicts"),
    "pipeline.evaluation": ("diagnosis",),
    "pipeline.output": ("campaign_results", "exports", "history", "outcome"),
    "pipeline.physics": ("signal",),
    "imu_research": ("study", "thesis"),
}
RENAMED = {
    "pipeline.io": "pipeline.ingest",
    "pipeline.model": "pipeline.physics",
    "pipeline.planning": "pipeline.app",
    "pipeline.preprocessing": "pipeline.checks",
    "pipeline.profile_detection": "pipeline.app",
    "pipeline.report": "pipeline.output.pages",
    "pipeline.result": "pipeline.app.one_unit",
    "pipeline.stages": "pipeline.app.steps",
    "pipeline.validation": "pipeline.evaluation.held_out",
    "pipeline.version": "pipeline.core",
}
FORMER = {f"pipeline.{name}": f"{place}.{name}" for place, names in MOVED.items() for name in names} | RENAMED


class SameModule(MetaPathFinder, Loader):
    """Finds a module under the name that ``other_name`` maps to the module's own; None for any other name."""

    def __init__(self, other_name: Callable[[str], str | None]) -> None:
        self.other_name = other_name

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:  # noqa: ARG002  (of the protocol)
        """Return the specification of a module that has another name."""
        now = self.other_name(name)
        if now and name.endswith(".__main__"):  # is run, not imported
            own = find_spec(now)
            return own and spec_from_file_location(name, str(own.origin))
        return ModuleSpec(name, self) if now else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """Return the module, with its own specification, which the import of the other name replaces."""
        if spec.name in FORMER:  # a module of a package is imported after the package
            warnings.warn(f"{spec.name} is now {FORMER[spec.name]}", DeprecationWarning, stacklevel=2)
        module = import_module(str(self.other_name(spec.name)))
        spec.loader_state = module.__spec__
        return module

    def get_code(self, name: str) -> CodeType | None:
        """Return the code of a module that ``python -m`` runs."""
        now = str(self.other_name(name))
        spec = find_spec(now)
        return spec.loader.get_code(now) if spec and isinstance(spec.loader, InspectLoader) else None

    def exec_module(self, module: ModuleType) -> None:
        """Restore the specification of the module, which was executed at its first import."""
        if module.__spec__ is not None:
            module.__spec__ = module.__spec__.loader_state


def former_name(name: str) -> str | None:
    """Return the name now of a module that has moved; None for any other."""
    first = ".".join(name.split(".")[:2])
    if first not in FORMER:
        return None
    return FORMER[first] + name.removeprefix(first)


def know_former_names() -> None:
    """Let imports find modules under the names that they had in version 0.1."""
    if not any(isinstance(finder, SameModule) and finder.other_name is former_name for finder in sys.meta_path):
        sys.meta_path.insert(0, SameModule(former_name))  # before the path of the package, which has another name now
