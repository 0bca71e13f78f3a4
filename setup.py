"""Copies the rules, configurations and the demo from the top level of the repository into the wheel."""

import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

ROOT = Path(__file__).parent
SHIPPED = ("Snakefile", "workflow", "configs", "profiles", "data/demo")


class BuildWithShippedFiles(build_py):
    """Adds ``pipeline/shipped`` and ``imu_logs/profiles``; an editable installation reads the repository itself."""

    def run(self) -> None:
        """Build the package, then copy the files."""
        super().run()
        if self.editable_mode:
            return
        target = Path(self.build_lib, "pipeline", "shipped")
        shutil.rmtree(target, ignore_errors=True)
        for name in SHIPPED:
            source, copy = ROOT / name, target / name
            if source.is_dir():
                shutil.copytree(source, copy)
            else:
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(source, copy)
        shutil.copytree(ROOT / "configs" / "ingest", Path(self.build_lib, "imu_logs", "profiles"), dirs_exist_ok=True)


setup(cmdclass={"build_py": BuildWithShippedFiles})
