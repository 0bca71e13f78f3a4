"""Atomic writing of files, JSON documents, the paths of the shipped files, and the cache folder of the user.

A file is written under a temporary name and then renamed, so it is complete or absent even after a crash. ``fsync``
makes it survive a power failure. It takes some milliseconds, so a job that writes many files flushes them together.

A check of a value from a file that users write or edit returns the value, or raises what is wrong and where.
``fields``, ``each`` and ``items`` build the check of a document from those of its values.

The cache holds values that every start of a program would compute again, such as compiled templates. A value is used
while what it follows from is unchanged: the caller's ``state``, the code of the package, and the interpreter. Only the
user can write the folder (mode 0700), because compiled code is read from it. Without such a folder every start computes
the values. Only commands and runs use it (``use_cache``): a call of the library writes no file that its caller did not
name.
"""

from __future__ import annotations

import ctypes
import difflib
import hashlib
import json
import marshal
import math
import os
import re
import stat
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache, partial
from importlib.util import MAGIC_NUMBER
from json.encoder import encode_basestring
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

from pipeline.core.errors import DamagedFileError

JSON: TypeAlias = dict[str, Any]  # a document, or a part of one
_PACKAGE = Path(__file__).resolve().parents[1]
INSTALLED = (_PACKAGE / "shipped").is_dir()  # from a wheel, not from a clone
SHIPPED = _PACKAGE / "shipped" if INSTALLED else _PACKAGE.parent  # holds Snakefile, workflow, configs, data
CONFIGS = SHIPPED / "configs"
EFFECTS_FOLDER = CONFIGS / "effect"
# First characters by which spreadsheets take a text as a formula, or split it (OWASP, CSV injection). With ' in front,
# the text was escaped, or begins so.
FORMULA = re.compile(r"'*[=+\-@\t\r\n\uff1d\uff0b\uff0d\uff20]")
NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?")
WRITE_AGAIN = "run the same command again: snakemake writes the file anew"
_flushed_at_end: list[Path] = []  # folders whose files are flushed together
Check = Callable[[Any], Any]
FOLDERS = {"darwin": "~/Library/Caches", "win32": "~/AppData/Local"}  # by platform; others: XDG base directories
DIGEST_SIZE = 64  # hexadecimal digits of SHA-256


_used: list[bool] = []  # not empty in the processes of commands and runs


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file under a temporary name in its folder, which is created, flush it to the disk, then rename it."""
    folder, name = os.path.split(path)
    temporary = os.path.join(folder, f".{name}.{os.getpid()}.tmp")  # noqa: PTH118  (a fleet has thousands of files)
    with _new_file(temporary) as stream:
        stream.write(content.encode() if isinstance(content, str) else content)
        if not _flushed_at_end:
            stream.flush()
            os.fsync(stream.fileno())
    os.replace(temporary, path)  # noqa: PTH105


def write_new(path: str, content: bytes) -> None:
    """Write a file in a folder that gets its name, and is flushed, when all files are written."""
    with _new_file(path) as stream:
        stream.write(content)


def _new_file(path: str) -> BinaryIO:
    """Open a file to write; its folder is created."""
    try:
        return open(path, "wb")  # noqa: PTH123
    except FileNotFoundError:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        return open(path, "wb")  # noqa: PTH123


def state_of_files(files: Iterable[Path]) -> str:
    """Return a digest of the names, sizes and times of files."""
    digest = hashlib.sha256()
    for file in sorted(files):
        status = file.stat()
        digest.update(f"{file}\0{status.st_size}\0{status.st_mtime_ns}\0".encode())
    return digest.hexdigest()[:16]


def read_json(path: Path, read: Callable[[Path], bytes] = Path.read_bytes) -> Any:  # noqa: ANN401  (any JSON value)
    """Read a JSON file that an earlier stage of a run wrote; ``read`` returns its content.

    Raises ``DamagedFileError`` if it does not exist or is not JSON.
    """
    from pydantic_core import from_json  # noqa: PLC0415  (takes a fifth of the time of ``json.loads``)

    try:
        return from_json(read(path))
    except (OSError, ValueError) as error:
        reason = f"cannot be read, it is missing or damaged ({error}); {WRITE_AGAIN}"
        raise DamagedFileError(reason, str(path)) from None


def _not_finite(value: Any, place: str = "value") -> Iterator[str]:  # noqa: ANN401
    """Yield the place of each number that is not finite, with the texts in the same objects, which identify it."""
    value = value.tolist() if hasattr(value, "tolist") else value
    if isinstance(value, float) and not math.isfinite(value):
        yield f"{place} is {value}"
    elif isinstance(value, dict):
        names = " ".join(v for v in value.values() if isinstance(v, str))
        for key, member in value.items():
            yield from _not_finite(member, f"{place}.{key}{f' ({names})' * bool(names)}")
    elif hasattr(value, "__len__") and not isinstance(value, str):
        for number, member in enumerate(value):
            yield from _not_finite(member, f"{place}[{number}]")


def json_text(value: Any, levels: int = 3) -> str:  # noqa: ANN401
    """Return a value as JSON; ``ValueError`` names the place of a number that is not finite.

    Down to ``levels``, containers of containers are indented. Each other value is on one line, without blanks, which
    takes a tenth of the time of ``json.dumps``.
    """
    from pydantic_core import to_json  # noqa: PLC0415  (a command that writes no JSON need not import it)

    encode = partial(to_json, inf_nan_mode="constants", fallback=lambda array: array.tolist())  # numpy arrays

    def text_of(value: Any, levels: int, indent: str) -> str:  # noqa: ANN401
        if levels and isinstance(value, (dict, list)):  # a tuple: a union takes three times as long
            members = list(value.values() if isinstance(value, dict) else value)
            if any(isinstance(member, (dict, list, tuple)) for member in members):
                opening, closing = "{}" if isinstance(value, dict) else "[]"
                names = [f"{encode_basestring(str(n))}: " if opening == "{" else "" for n in value]
                inner = indent + " "
                lines = [name + text_of(m, levels - 1, inner) for name, m in zip(names, members, strict=True)]
                return f"{opening}{inner}{f',{inner}'.join(lines)}{indent}{closing}"
        return encode(value).decode()

    text = text_of(value, levels, "\n")
    if ("NaN" in text or "Infinity" in text) and (places := ", ".join(_not_finite(value))):
        raise ValueError(f"numbers that are not finite are not JSON compliant: {places}")
    return text


def write_json(path: Path, value: Any) -> None:  # noqa: ANN401
    """Write a value as a JSON file, atomically."""
    write_atomically(path, json_text(value) + "\n")


def spreadsheet_cell(text: str) -> str:
    """Return a text for a CSV file that people open in a spreadsheet: one that would be a formula gets a ' in front.

    Numbers remain numbers. ``text_of_cell`` is the inverse.
    """
    return f"'{text}" if FORMULA.match(text) and not NUMBER.fullmatch(text) else text


def text_of_cell(cell: str) -> str:
    """Return the text of a cell of ``spreadsheet_cell``."""
    return cell[1:] if cell.startswith("'") and FORMULA.match(cell) else cell


def exchange(one: Path, other: Path) -> None:
    """Exchange two files or folders of one file system atomically, so that both names always exist.

    Only Linux has the system call (``renameat2``). On other systems three renames exchange them.
    """
    at_cwd, rename_exchange = -100, 2  # AT_FDCWD of fcntl.h, RENAME_EXCHANGE of linux/fs.h
    system = ctypes.CDLL(None, use_errno=True)
    names = os.fsencode(one), os.fsencode(other)
    if not hasattr(system, "renameat2") or system.renameat2(at_cwd, names[0], at_cwd, names[1], rename_exchange) != 0:
        between = one.with_name(f".{one.name}.{os.getpid()}.tmp")
        other.rename(between)
        one.rename(other)
        between.rename(one)


@contextmanager
def flushed_together(folder: Path) -> Iterator[None]:
    """Flush all files that the block writes to the file system of a folder once, at the end of the block."""
    _flushed_at_end.append(folder)
    try:
        yield
    finally:
        _flushed_at_end.pop()
    flush_file_system(folder)


def flush_file_system(folder: Path) -> None:
    """Flush the buffers of the file system that contains a folder; raises ``OSError`` on failure."""
    system = ctypes.CDLL(None, use_errno=True)
    if not hasattr(system, "syncfs"):  # not Linux
        os.sync()
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        if system.syncfs(descriptor) != 0:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number), str(folder))
    finally:
        os.close(descriptor)


def canonical_json(value: Any) -> bytes:  # noqa: ANN401  (any JSON value)
    """Return JSON with sorted keys and no blanks, for digests."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


class WrongValueError(Exception):
    """A value is invalid: the reason, and the keys and indices that lead to the value."""

    def __init__(self, reason: str, *path: str | int) -> None:
        super().__init__(reason)
        self.reason, self.path = reason, path

    def __str__(self) -> str:
        place = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in self.path).lstrip(".")
        return f"{place}: {self.reason}" if place else self.reason


def expected(what: str, given: object) -> WrongValueError:
    """Return the error that states the expected value and the given one."""
    shown = json.dumps(given, default=str, ensure_ascii=False)
    return WrongValueError(f"{what} is expected, not {shown if len(shown) <= 60 else f'{shown[:57]}...'}")


def fields(checks: Mapping[str, Check], required: Iterable[str] = (), *, others: bool = False) -> Check:
    """Return the check of a mapping with these keys; ``others``: allow any other key, and drop it."""

    def check(given: object) -> dict[str, Any]:
        values = mapping(given)
        for key in () if others else values:
            if key not in checks:
                close = difflib.get_close_matches(str(key), checks, 1)
                nearest = f"; nearest: {close[0]}" if close else ""
                raise WrongValueError(f"unknown key{nearest}; valid: {', '.join(checks)}", str(key))
        for key in required:
            if key not in values:
                raise WrongValueError(f"{key} is missing")
        return {key: _at(key, checks[key], value) for key, value in values.items() if key in checks}

    return check


def each(check: Check) -> Check:
    """Return the check of a mapping of any keys to values."""
    return lambda given: {str(key): _at(str(key), check, value) for key, value in mapping(given).items()}


def items(check: Check, count: int | None = None) -> Check:
    """Return the check of a list; with ``count``, of exactly so many values."""
    what = "a list" if count is None else f"a list of {count} values"

    def checked(given: object) -> list[Any]:
        if not isinstance(given, list) or count not in {None, len(given)}:
            raise expected(what, given)
        return [_at(i, check, value) for i, value in enumerate(given)]

    return checked


def or_none(check: Check) -> Check:
    """Return the check of a value that may be null."""
    return lambda given: None if given is None else check(given)


def one_of(*known: str) -> Check:
    """Return the check that a value is one of the given texts."""
    *first, last = (repr(str(k)) for k in known)
    what = f"one of {', '.join(first)} or {last}" if first else last

    def check(given: object) -> str:
        if given not in known:
            raise expected(what, given)
        return known[known.index(str(given))]

    return check


def of_type(kind: type, what: str) -> Check:
    """Return the check of a value of a type; ``what``: the type in words."""

    def check(given: object) -> object:
        if not isinstance(given, kind):
            raise expected(what, given)
        return given

    return check


mapping, text, flag = of_type(dict, "a mapping of names"), of_type(str, "a text"), of_type(bool, "true or false")


def number(given: object) -> float:
    """Return the value if it is a finite number."""
    if isinstance(given, bool) or not isinstance(given, (int, float)) or not math.isfinite(given):
        raise expected("a finite number", given)
    return given


def _at(key: str | int, check: Check, value: object) -> Any:  # noqa: ANN401
    """Return the checked value of a key; an error names the key."""
    try:
        return check(value)
    except WrongValueError as wrong:
        raise WrongValueError(wrong.reason, key, *wrong.path) from None


def use_cache() -> None:
    """Read and keep values in this process, and in those that it forks."""
    _used[:] = [True]


@cache
def cache_folder() -> Path | None:
    """Return the folder, which is created if there is none; None where it cannot be written, or others can write it."""
    named = os.environ.get("XDG_CACHE_HOME", "")
    try:
        above = Path(named if named.startswith("/") else FOLDERS.get(sys.platform, "~/.cache")).expanduser()
        folder = above / "imu-calibration"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.lstat()
    except (OSError, RuntimeError):  # RuntimeError: a user without a home
        return None
    private = sys.platform == "win32" or (status.st_uid == os.getuid() and not status.st_mode & 0o077)
    return folder if private and stat.S_ISDIR(status.st_mode) else None


def from_cache(name: str, state: str) -> Any:  # noqa: ANN401  (what ``to_cache`` stored)
    """Return the value of a name that was stored in the same state; None if there is none."""
    if _used and (folder := cache_folder()) is not None:
        with suppress(OSError, EOFError, ValueError, TypeError):
            content = (folder / name).read_bytes()
            if content[:DIGEST_SIZE] == _digest(state, content[DIGEST_SIZE:]):
                return marshal.loads(content[DIGEST_SIZE:])  # noqa: S302  (the user's own file)
    return None


def to_cache(name: str, state: str, value: Any) -> None:  # noqa: ANN401  (numbers, texts, lists, dictionaries, code)
    """Store the value of a name, where the folder can be written."""
    if _used and (folder := cache_folder()) is not None:
        with suppress(OSError, ValueError):
            content = marshal.dumps(value)
            write_atomically(folder / name, _digest(state, content) + content)


def _digest(state: str, content: bytes) -> bytes:
    return hashlib.sha256(f"{state}\0{_program()}\0".encode() + content).hexdigest().encode()


@cache
def _program() -> str:
    """Return a digest of the interpreter, and of the names, sizes and times of the package's modules."""
    return f"{MAGIC_NUMBER.hex()} {state_of_files(Path(__file__).resolve().parent.rglob('*.py'))}"
