"""Fail if a requirement of pyproject.toml is not met by the lock files: ``python tests/lock_is_current.py``."""

import re
import sys
import tomllib
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]


def pinned(path: Path) -> dict[str, set[str]]:
    found: dict[str, set[str]] = {}
    for name, version in re.findall(r"^([A-Za-z0-9._-]+)==([^ ;\\]+)", path.read_text(), re.MULTILINE):
        found.setdefault(name.lower(), set()).add(version)
    return found


def main() -> int:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = {"requirements.lock": project["dependencies"]}
    for extra in ("dev", "slurm"):
        wanted[f"requirements-{extra}.lock"] = project["dependencies"] + project["optional-dependencies"][extra]
    wrong = []
    for file, requirements in wanted.items():
        lock = pinned(ROOT / file)
        for requirement in map(Requirement, requirements):
            versions = lock.get(requirement.name.lower(), set())
            if not versions or not all(requirement.specifier.contains(v) for v in versions):
                wrong.append(f"{file}: {requirement} is pinned to {sorted(versions) or 'nothing'}")
    print("\n".join(wrong) or "in order")
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
