"""The errors of files and settings that users see.

The message states what is wrong, where, what was expected and what to do.
"""

from __future__ import annotations

# Codes of logs that a profile does not describe.
UNKNOWN_LAYOUT = ("missing_column", "duplicate_column", "no_header", "missing_topic")


class UserError(Exception):
    """A user error: ``message``, and ``file`` as ``path`` or ``path:line``."""

    code: str = "error"

    def __init__(self, message: str, file: str | None = None) -> None:
        super().__init__(message)
        self.message = message
        self.file = file

    def __str__(self) -> str:
        return f"{self.file}: {self.message}" if self.file else self.message


class InputError(UserError):
    """A recording or another input file cannot be used."""

    code = "bad_input"


class IngestError(InputError):
    """A recording cannot be used.

    ``message``: what is wrong and where, with the facts, kept as ``fact``. ``code``: of ``docs/bad_inputs.md``, such as
    ``not_a_number``. ``offset``: byte of the file at which the error was found. ``hint``: what the user can do.
    """

    sessions: int = 0  # parts of a log whose logger was restarted

    def __init__(
        self, message: str, file: str | None = None, *, code: str = "damaged", offset: int | None = None, hint: str = ""
    ) -> None:
        place = "" if offset is None else f" (byte {offset})"
        super().__init__(f"{message}{place}" + (f"; {hint}" if hint else ""), file)
        self.code, self.fact = code, message


class MissingInputError(InputError):
    """A file that the procedure needs does not exist."""

    code = "missing_file"


class ConfigurationError(UserError):
    """A setting is unknown, of the wrong type or out of its range."""

    code = "bad_configuration"
