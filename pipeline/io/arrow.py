"""Numbers between numpy and pyarrow; ``to_numpy`` and ``pyarrow.array`` would import pandas, which takes 0.25 s."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

if TYPE_CHECKING:
    from numpy.typing import NDArray


def to_numpy(column: Any) -> NDArray[Any]:  # noqa: ANN401  (pyarrow has no types)
    """Return the numbers of a column without nulls."""
    return np.asarray(np.from_dlpack(column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column))


def to_arrow(values: NDArray[Any]) -> pa.Array:
    """Return numbers as a column."""
    return pa.Array.from_buffers(pa.from_numpy_dtype(values.dtype), len(values), [None, pa.py_buffer(values)])


def text_scalar(text: str) -> pa.Scalar:
    """Return a text as a scalar for functions of ``pyarrow.compute``."""
    data = text.encode()
    offsets = np.array([0, len(data)], np.int32)
    return pa.Array.from_buffers(pa.string(), 1, [None, pa.py_buffer(offsets), pa.py_buffer(data)])[0]
