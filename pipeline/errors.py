"""The tree of user errors.

Each says what is wrong, where, what was expected and what to do. A user error is one line and exit code 2 on the
command line (of an unknown log a second line names the command that proposes a profile), and a failure record of one
unit in a batch; all else that is raised is a bug and keeps its traceback.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence


UNKNOWN_LAYOUT = ("missing_column", "no_header", "missing_topic")  # codes of logs that a profile does not describe


class PipelineError(Exception):
    """A user error.

    ``message``: what is wrong, where (line, time, axis), what was expected and what to do; ``file``: the file
    concerned, with its line as ``path:line`` where there is one.
    """

    code: str = "error"

    def __init__(self, message: str, file: str | None = None) -> None:
        super().__init__(message)
        self.message = message
        self.file = file

    def __str__(self) -> str:
        return f"{self.file}: {self.message}" if self.file else self.message


class InputError(PipelineError):
    """A recording or another input file cannot be used as it is."""

    code = "bad_input"


class IngestError(InputError):
    """A recording cannot be used as it is.

    Parameters
    ----------
    message : str
        What is wrong and where, with the facts.
    code : str
        That of ``docs/bad_inputs.md``: ``not_a_number``, ``wrong_sense`` ...
    offset : int, optional
        Byte of the file at which the error was found.
    hint : str
        What to do about it.

    Attributes
    ----------
    fact : str
        The message without byte and hint.
    sessions : int
        Of a log that was restarted: how many parts it has.
    """

    sessions: int = 0

    def __init__(
        self, message: str, file: str | None = None, *, code: str = "damaged", offset: int | None = None, hint: str = ""
    ) -> None:
        place = "" if offset is None else f" (byte {offset})"
        super().__init__(f"{message}{place}" + (f"; {hint}" if hint else ""), file)
        self.code, self.fact = code, message


class MissingInputError(InputError):
    """A file that the procedure needs does not exist."""

    code = "missing_file"


class DamagedFileError(InputError):
    """A file that an earlier stage of a run wrote is damaged or missing; the same command writes it anew."""

    code = "damaged_file"


class ConfigurationError(PipelineError):
    """A setting is unknown, of the wrong type or out of its range."""

    code = "bad_configuration"


class NotObservableError(PipelineError):
    """The recording does not determine what was asked of it."""

    code = "not_observable"


class ConvergenceError(PipelineError):
    """An iterative estimate did not converge."""

    code = "did_not_converge"


class CannotCalibrateError(PipelineError):
    """The procedure or method cannot calibrate this sensor at all: it becomes ``null`` with a reason, no failure."""

    code = "cannot_calibrate"


def first(names: Sequence[str], most: int, of: str = "") -> list[str]:
    """Return the first ``most`` names or lines of a message, and instead of the others how many they are."""
    return [*names[:most], *([f"and {len(names) - most} more {of}".rstrip()] if len(names) > most else [])]
