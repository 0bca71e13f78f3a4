"""Arrays in HDF5 files and MATLAB files (5, and 7.3 which is HDF5), read by ``h5py`` and ``scipy.io``.

A group (MATLAB: a struct) is a topic, its arrays are the fields: ``/imu`` with ``acc`` of (n, 3) holds ``acc[0]``,
``acc[1]``, ``acc[2]``. Samples run along the longer dimension. Where the arrays of a group differ in length, those of
one length are a topic with the name of its first array: ``/imu/acc``. A table of named columns is a topic of its own.
A unit is the attribute ``unit`` or ``units`` of an array (HDF5).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.io.message_logs import Topic, library_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.records import Note

FEWEST_ROWS = 2  # shorter arrays are settings, not samples
DEEPEST = 3  # dimensions: images, not read
WIDEST = 64  # columns; a wider array is an image or a matrix
BYTES_OF_A_DOUBLE = 8  # longer numbers are no reading of a converter


def topics(path: Path, _notes: list[Note]) -> Iterator[Topic]:
    """Yield the topics of a file."""
    if library_of(path) == "h5py":
        import h5py  # noqa: PLC0415  (an extra)

        with h5py.File(path, "r") as file:
            yield from _topics("", _tree(file))
    else:
        from scipy.io import loadmat  # noqa: PLC0415  (few logs need it)

        content = loadmat(path, simplify_cells=True)
        yield from _topics("", {n: v for n, v in content.items() if not n.startswith("__")})


def _tree(group: Any) -> dict[str, Any]:  # noqa: ANN401  (h5py.Group)
    """Return the groups and arrays of an HDF5 file; an array with its unit is a pair."""
    found: dict[str, Any] = {}
    for name, item in group.items():
        if hasattr(item, "items"):
            found[name] = _tree(item) if name != "#refs#" else {}
        elif getattr(item, "ndim", DEEPEST) < DEEPEST:
            unit = next((item.attrs[k] for k in ("units", "unit") if k in item.attrs), "")
            found[name] = (item[()], unit.decode() if isinstance(unit, bytes) else str(unit))
    return found


def _topics(place: str, tree: Mapping[str, Any]) -> Iterator[Topic]:
    """Yield the topics of a group, and of those in it."""
    arrays: dict[str, NDArray[Any]] = {}
    units: dict[str, str] = {}
    for name, item in tree.items():
        if isinstance(item, dict):
            yield from _topics(f"{place}/{name}", item)
            continue
        value, unit = item if isinstance(item, tuple) else (item, "")
        array = np.asarray(value)
        if array.dtype.names:
            columns = {n: c for n in array.dtype.names if (c := _samples(array[n])) is not None}
            yield from _by_length(f"{place}/{name}", columns, {})
        elif (samples := _samples(array)) is not None:
            arrays[name], units[name] = samples, unit
    yield from _by_length(place, arrays, units)


def _by_length(place: str, arrays: Mapping[str, NDArray[Any]], units: Mapping[str, str]) -> Iterator[Topic]:
    """Yield the arrays of a group, those of one length together."""
    lengths = sorted({len(a) for a in arrays.values()})
    for length in lengths:
        own = {n: a for n, a in arrays.items() if len(a) == length}
        name = (place or "/") if len(lengths) == 1 else f"{place}/{min(own)}"
        yield Topic(name, own, {n: u for n, u in units.items() if n in own})


def _samples(array: NDArray[Any]) -> NDArray[Any] | None:
    """Return an array of numbers with its samples along the first dimension; None if it holds no samples."""
    if array.dtype.kind not in "iufb" or array.dtype.itemsize > BYTES_OF_A_DOUBLE:
        return None
    array = np.squeeze(array)
    if array.ndim == 2 and array.shape[0] < array.shape[1]:
        array = array.T
    if array.ndim not in (1, 2) or len(array) < FEWEST_ROWS or (array.ndim == 2 and array.shape[1] > WIDEST):
        return None
    return array.astype("u1") if array.dtype.kind == "b" else array
