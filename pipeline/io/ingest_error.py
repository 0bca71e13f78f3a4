"""The one error that a damaged, incomplete or unsuitable log ends in."""

from __future__ import annotations

from pipeline.errors import InputError


class IngestError(InputError):
    """A log cannot be used as it is.

    Parameters
    ----------
    message : str
        What is wrong and where, with the facts.
    file : str, optional
    fault : str
        Machine-readable kind of fault: ``not_mcap``, ``truncated``, ``checksum``, ``damaged``, ``incomplete``,
        ``unsupported``, ``ambiguous``, ``missing_topic``, ``bad_message``, ``bad_time`` or ``absent``.
    offset : int, optional
        Byte of the file at which it was seen.
    hint : str
        What to do about it.

    Attributes
    ----------
    message : str
        All of it in one line, as it is shown.
    fact : str
        What is wrong, without byte and hint.
    """

    def __init__(
        self,
        message: str,
        file: str | None = None,
        *,
        fault: str = "damaged",
        offset: int | None = None,
        hint: str = "",
    ) -> None:
        place = "" if offset is None else f" (byte {offset})"
        super().__init__(f"{message}{place}" + (f"; {hint}" if hint else ""), file)
        self.fact = message
        self.fault = fault
        self.offset = offset
        self.hint = hint
