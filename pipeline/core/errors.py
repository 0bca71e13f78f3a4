"""The classes of errors that users see.

The message states what is wrong, where, what was expected and what to do. A command prints a user error in one line
and exits with code 2. (After the error of an unknown log, a second line names the command that proposes a profile.) In
a batch a user error becomes the failure record of one unit. Any other exception is a bug and keeps its traceback.
"""

from __future__ import annotations

import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from imu_logs.errors import UNKNOWN_LAYOUT, ConfigurationError, IngestError, InputError, MissingInputError
from imu_logs.errors import UserError as PipelineError

# Those of ``imu_logs``, beside the names below.
__all__ = ["UNKNOWN_LAYOUT", "ConfigurationError", "IngestError", "InputError", "MissingInputError", "PipelineError"]


class DamagedFileError(InputError):
    """A file that an earlier stage wrote is damaged or missing; the same command run again writes it."""

    code = "damaged_file"


class NotObservableError(PipelineError):
    """The recording does not determine a quantity that the method estimates."""

    code = "not_observable"


class ConvergenceError(PipelineError):
    """An iterative estimate did not converge."""

    code = "did_not_converge"


class CannotCalibrateError(PipelineError):
    """The procedure or method cannot calibrate this sensor: its result is ``null`` with a reason, not a failure."""

    code = "cannot_calibrate"


class InternalError(PipelineError):
    """A bug of the package; the exception is its cause."""

    code = "internal_error"


def as_published(error: Exception) -> PipelineError:
    """Return the error with the code, message and file that a run publishes for an exception."""
    if isinstance(error, PipelineError):
        return error
    if isinstance(error, OSError) and error.filename is not None:
        return InputError(error.strerror or str(error), str(error.filename))
    return InternalError(f"{type(error).__name__}: {error} (a bug; see the log)")


def failure_of(error: Exception, unit: str, stage: str) -> dict[str, Any]:
    """Return the record of a unit's failure; print the traceback of an exception that is a bug."""
    if isinstance(error, DamagedFileError):
        with suppress(OSError), Path(str(error.file)).open("ab") as stream:
            stream.write(b"\0")  # changes the size: the next run detects that the file was changed
    known = as_published(error)
    if isinstance(known, InternalError):
        traceback.print_exc()
    return {"unit": unit, "stage": stage, "code": known.code, "message": known.message, "file": known.file}


def omission(error: Exception, unit: str, stage: str) -> dict[str, Any]:
    """Return the record of what a step after the fit cannot make of a unit, and print it.

    Raises the error again if it is of the run, such as a full disk, or a damaged file, which the next run writes anew.
    """
    if isinstance(error, DamagedFileError) or is_of_run(error):
        raise error
    record = failure_of(error, unit, stage)
    print(f"{stage}: {unit} NOT COMPLETE: {record['message']}", file=sys.stderr, flush=True)  # noqa: T201
    return record


def is_of_run(error: Exception) -> bool:
    """Return whether an error is of the run, not of the unit: a full disk."""
    return isinstance(error, OSError) and error.filename is None


def shortened(names: Sequence[str], most: int, of: str = "") -> list[str]:
    """Return the first ``most`` names or lines; one last entry states the number of the others."""
    return [*names[:most], *([f"and {len(names) - most} more {of}".rstrip()] if len(names) > most else [])]
