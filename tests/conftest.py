"""Modules beside this file, such as ``bench_session``, can be imported by tests of any folder.

A test is one core, as a job is: linear algebra on small matrices is slower on several.
"""

import gc
import os
from collections.abc import Generator

for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")  # before numpy is imported
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # programs that tests start are compiled once, as installed ones are

import pytest  # noqa: E402
from hypothesis import HealthCheck, settings  # noqa: E402

SHORT = ("config", "exports", "imu_logs")  # folders whose files take at most some seconds

# The same cases each time, and none fails for the machine being busy; ``--hypothesis-profile default`` varies.
settings.register_profile("fixed", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("fixed")


def pytest_xdist_auto_num_workers() -> int:
    """Return one worker more than cores: those that run campaigns wait for Snakemake a tenth of their time."""
    return 1 + (os.cpu_count() or 1)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run whole campaigns first and short files last: a long file at the end would leave the other worker idle."""
    items.sort(key=lambda item: (item.get_closest_marker("workflow") is None, item.path.parent.name in SHORT))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Let the search for garbage leave out what is imported: a seventh of the time of the tests of the commands."""
    gc.disable()
    result = yield
    gc.freeze()
    gc.enable()
    return result
