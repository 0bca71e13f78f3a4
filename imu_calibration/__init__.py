"""The package ``pipeline`` under the name of its distribution: ``import imu_calibration`` returns ``pipeline`` itself.

``import imu_calibration.errors`` returns ``pipeline.core.errors``, so that no module is loaded twice, with classes that
differ.
"""

from __future__ import annotations

import sys
from importlib import import_module, util
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from typing import TYPE_CHECKING

import pipeline
from pipeline import *  # noqa: F403  (for tools that read this file and do not run it)

if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import ModuleType

ALIAS = f"{__name__}."


class _SameModule(MetaPathFinder, Loader):
    """Finds ``imu_calibration.X`` as ``pipeline.X``."""

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:  # noqa: ARG002  (of the protocol)
        """Return the specification of a module below this name; None for any other."""
        if name == f"{ALIAS}__main__":  # is run, not imported: python -m imu_calibration
            return util.spec_from_file_location(name, f"{pipeline.__path__[0]}/__main__.py")
        return ModuleSpec(name, self) if name.startswith(ALIAS) else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """Return the module of the package, with its own specification, which the import of the other name replaces."""
        module = import_module(f"{pipeline.__name__}.{spec.name.removeprefix(ALIAS)}")
        spec.loader_state = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Restore the specification of the module, which was executed at its first import."""
        if module.__spec__ is not None:
            module.__spec__ = module.__spec__.loader_state


sys.meta_path.insert(0, _SameModule())
sys.modules[__name__] = pipeline
