"""Read the logs of inertial measurement units: CSV, MCAP, ROS bags, ULog, DataFlash, HDF5, MATLAB and others.

    log = imu_logs.read("drive.csv")                        columns of the canonical CSV
    log = imu_logs.read("flight.ulg", "px4_ulog")           a profile, by its name or file
    log.to_pandas()                                         accel_x_g .. gyro_z_dps, time_s
    imu_logs.propose(["unknown.csv"])                       profiles that would read it, with the evidence
    imu_logs.write(log, "drive.mcap")

A profile states names, units, separators and clocks; nothing is guessed while a log is read. What is wrong raises an
error with the line and the setting; what was repaired or left out is a note. Settings in messages are those of the
profile: ``ingest.csv.bad_rows`` is its key ``bad_rows`` in the section ``csv``.

Units are g (9.80665 m/s^2), deg/s, deg, degC and integer ns.
"""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from imu_logs.errors import ConfigurationError, IngestError, InputError, MissingInputError, UserError
from imu_logs.files import ZIP, is_message_log, text_members

if TYPE_CHECKING:
    from collections.abc import Mapping

    import pandas as pd

    from imu_logs.guesses import Evidence
    from imu_logs.log import Log, Note
    from imu_logs.profile import CsvFormat, Profile, load_profile
    from imu_logs.proposal import Proposal

__all__ = [
    "ConfigurationError", "IngestError", "InputError", "Log", "MissingInputError", "Note", "Profile", "UserError",
    "load_profile", "propose", "read", "read_frame", "write"
]  # fmt: skip
CANONICAL_CSV = "canonical_csv"
AT_FIRST_USE = {"Log": "log", "Note": "log", "Profile": "profile", "load_profile": "profile"}  # module of each name
Paths = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]


def __getattr__(name: str) -> Any:  # noqa: ANN401  (a class or a function)
    """Import ``Log``, ``Note``, ``Profile`` and ``load_profile`` at their first use.

    They need numpy or pydantic, which a program that only looks up files does not load.
    """
    if name in AT_FIRST_USE:
        return getattr(import_module(f"imu_logs.{AT_FIRST_USE[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def read(
    paths: Paths,
    profile: Profile | Mapping[str, Any] | str | os.PathLike[str] | None = None,
    *,
    session: int | None = None,
    layouts: Sequence[CsvFormat] | None = None,
) -> Log:
    """Read a log.

    Parameters
    ----------
    paths : str or Path, or a sequence of them
        The file, or the files of one recording that the profile joins (``parts``), in its order. The suffix states the
        format: ``.mcap``, ``.gcsv``, those of ``imu_logs.files.MESSAGE_FORMATS``; any other is text.
    profile : Profile, mapping, str or Path, optional
        A profile, its keys, the name of a shipped one, or a YAML file. The default is ``canonical_csv``: the canonical
        columns of a text log, the only Imu topic of a message log.
    session : int, optional
        Which part, from 1, of a text log whose logger was restarted.
    layouts : sequence of CsvFormat, optional
        ``csv_formats(profile)``, for a caller that reads many logs.

    Returns
    -------
    Log
        Arrays in g, deg/s, deg and degC, times in ns, and notes. Logs of the recording with a clock of their own, such
        as that of a table, are in ``apart``; ``pipeline`` aligns them by the motion.

    Raises
    ------
    IngestError
        If the log does not exist, is damaged, contradicts the profile, or has impossible times.
    ConfigurationError
        If the profile is not valid.
    """
    files = [Path(p) for p in ([paths] if isinstance(paths, str | os.PathLike) else paths)]
    from imu_logs.profile import Profile, checks_of, csv_formats, load_profile  # noqa: PLC0415  (pydantic)

    known = profile if isinstance(profile, Profile) else load_profile(profile or CANONICAL_CSV)
    if is_message_log(files[0]):
        from imu_logs.message_read import read_logs  # noqa: PLC0415  (slow import, not for text logs)

        return read_logs(files, known)
    from imu_logs.text_read import read_csv, read_gcsv  # noqa: PLC0415  (a log of messages needs no parser of text)

    if files[0].suffix == ".gcsv":
        return read_gcsv(files[0], checks_of(known))
    layouts = layouts or csv_formats(known)
    if [file.suffix.lower() for file in files] == [ZIP] and files[0].is_file():
        files = _in_zip(files[0], known)
    if len(files) != len(layouts):
        raise ConfigurationError(f"the profile reads a recording from {len(layouts)} files; got {len(files)}")
    if session is None:
        return read_csv(files, layouts, checks_of(known))
    log = read_csv(files, [f.model_copy(update={"session": session}) for f in layouts], checks_of(known))
    return replace(log, source={**log.source, "session": session})


def _in_zip(archive: Path, profile: Profile) -> list[Path]:
    """Return the text logs in a zip file that the profile names as parts, else the only one."""
    members, parts = text_members(archive), [part["file"] for part in profile.csv.get("parts") or ()]
    if parts:
        return [archive / part for part in parts]
    if len(members) == 1:
        return members
    listed = ", ".join(file.name for file in members) or "none"
    message = f"{len(members)} text logs are in the zip file ({listed}), and the profile names none as its parts"
    raise IngestError(message, str(archive), code="missing_column", hint="name one: log.zip/Accelerometer.csv")


def read_frame(frame: pd.DataFrame, name: str = "(DataFrame)", profile: Profile | None = None) -> Log:
    """Return a DataFrame with canonical columns as a log, with the checks of a text log; ``name``: for messages.

    ``profile``: of its ``checks``. Raises ``IngestError``; row 0 is line 2.
    """
    from imu_logs.text_write import canonical_csv  # noqa: PLC0415  (likewise)

    return read_canonical(name, canonical_csv(name, frame), profile)


def read_canonical(name: str, text: bytes, profile: Profile | None) -> Log:
    """Read a canonical CSV that is in memory; ``name`` stands for it in messages; ``profile``: of its ``checks``."""
    from imu_logs.profile import checks_of, csv_formats, load_profile  # noqa: PLC0415  (as in ``read``)
    from imu_logs.text_read import read_stream  # noqa: PLC0415  (likewise)

    canonical = load_profile(CANONICAL_CSV)
    (layout,) = csv_formats(canonical)
    try:
        return read_stream(io.BytesIO(text), name, layout, checks_of(profile or canonical))
    except IngestError as error:
        if error.code != "missing_column":
            raise
        hint = "name the columns of the DataFrame as in the canonical CSV"
        raise IngestError(error.fact, error.file, code=error.code, hint=hint) from None


def propose(paths: Paths, evidence: Evidence | None = None) -> list[Proposal]:
    """Propose profiles for unknown logs, one for each layout among them; they are never applied without a request.

    ``proposal.text(name)`` is the YAML with the evidence for each line and ``???`` where the user must decide;
    ``proposal.profile(name)`` is the profile, where ``proposal.complete``. ``evidence``: what decides units that no
    name states; by default the size of the numbers alone. Raises ``IngestError`` for a file without a table of numbers.
    """
    from imu_logs import guesses, proposal  # noqa: PLC0415  (only where it is needed)

    files = [Path(p) for p in ([paths] if isinstance(paths, str | os.PathLike) else paths)]
    return proposal.propose([log for f in files for log in proposal.layouts_of(f)], evidence or guesses.Evidence())


def write(log: Log, path: str | os.PathLike[str], decimals: Mapping[str, int] = MappingProxyType({})) -> None:
    """Write a log: ROS 2 messages (``.mcap``), Parquet (``.parquet``), or canonical CSV (any other suffix).

    ``decimals``: canonical column to digits after the point, in a CSV; other columns are written without loss. The file
    is replaced atomically.
    """
    target = Path(path)
    if target.suffix.lower() == ".mcap":
        from imu_logs.mcap_write import write_mcap  # noqa: PLC0415  (needs the mcap library)

        write_mcap(target, log)
        return
    from imu_logs.text_write import write_canonical_csv, write_parquet  # noqa: PLC0415  (only where it is needed)

    if target.suffix.lower() == ".parquet":
        write_parquet(target, log)
    else:
        write_canonical_csv(target, log, decimals)
