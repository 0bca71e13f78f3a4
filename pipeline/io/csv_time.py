"""The times of a text log's rows: integer nanoseconds, in order, each once.

    time = round(t * 10^9), from the decimal digits themselves where doubles are too coarse

where a double of t seconds is finer than half a nanosecond up to t = 10^6 s (and Unix time, 1.7*10^9 s, is not).

A counter that overflows starts again at 0: a time that falls from within two intervals of M to within two intervals of
0 goes on by M, where M is 2^32 us or ms, or 2^16, 2^24 or 2^32 of the column's unit. Rows that changed places by no
more than five are put in order, rows that stand twice are dropped, both within the budget. Anything else that runs
backwards is another session of the logger.
"""

from __future__ import annotations

from decimal import Decimal
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from pipeline.errors import IngestError
from pipeline.io.csv_parse import parse
from pipeline.io.units import UNITS
from pipeline.records import Note

if TYPE_CHECKING:
    from fractions import Fraction

    from numpy.typing import NDArray

EXACT_BELOW_S = 1e6
LONGEST_S = 9.2e9  # int64 nanoseconds end at 292 years
DECIMAL_DIGITS = {"s": 9, "ms": 6, "us": 3, "ns": 0}
COARSEST = 0.01  # of the median interval
NEAR = 2.5  # intervals
LARGEST_DISPLACEMENT = 5  # rows


def seconds_per_unit(unit: str) -> float:
    """Return the length of a unit of time, s."""
    return UNITS["time"][unit][0] / 1e9


def exact_times(
    data: bytes | memoryview, dialect: tuple[str, str], width: int, index: int, unit: str
) -> NDArray[np.int64]:
    """Return times in ns from their decimal digits: a decimal with enough places is an integer of ns.

    Parameters
    ----------
    data : bytes
        Lines of a text log.
    dialect : (str, str)
        Separator and decimal point.
    width : int
        Number of columns.
    index : int
        Column of the times.
    unit : str

    Raises
    ------
    pyarrow.ArrowInvalid
        If a cell is no number.
    """
    digits = DECIMAL_DIGITS[unit]
    try:
        table = parse(data, *dialect, width, {index: pa.decimal128(38, digits)})
    except pa.ArrowInvalid:  # more digits than whole ns have
        strings = parse(data, *dialect, width, {index: pa.string()}).column(0).to_pylist()
        texts = (s.strip().replace(",", ".") for s in strings)
        return np.array([int(Decimal(s).scaleb(digits).to_integral_value()) for s in texts], np.int64)
    decimals = table.column(0).combine_chunks()
    words = np.frombuffer(decimals.buffers()[1], np.int64)
    return words[2 * decimals.offset : 2 * (decimals.offset + len(decimals)) : 2].copy()  # low words of 128 bits


def whole_times(values: NDArray[np.float64], unit: str, tick_ns: Fraction | None) -> NDArray[np.int64]:
    """Return times in ns of numbers in a unit, or of counts of a tick."""
    if tick_ns is None:
        rounded: NDArray[np.int64] = np.rint(values * UNITS["time"][unit][0]).astype(np.int64)
        return rounded
    if tick_ns.denominator == 1 and bool(np.all(values == np.rint(values))):
        exact: NDArray[np.int64] = values.astype(np.int64) * int(tick_ns)
        return exact
    scaled: NDArray[np.int64] = np.rint(values * float(tick_ns)).astype(np.int64)
    return scaled


def refuse_coarse(values: NDArray[np.float64], exact_ns: NDArray[np.int64], unit: str, name: str, path: str) -> None:
    """Refuse times that were stored as doubles too coarse for them, as nanoseconds since 1970 are.

    Such times are the doubles themselves, or end in zeros where the digits of a double end.
    """
    scale = int(UNITS["time"][unit][0])
    spacing = float(np.spacing(np.abs(values).max())) * scale
    step = float(np.median(np.abs(np.diff(exact_ns)))) if len(exact_ns) > 1 else 0.0
    if spacing < 2 * scale or step == 0:
        return
    zeros = next(z for z in range(18, -1, -1) if not np.any(exact_ns % 10**z))
    resolution = spacing if np.array_equal(exact_ns, values.astype(np.int64) * scale) else 10.0**zeros
    if resolution >= spacing / 10 and resolution > COARSEST * step:
        raise IngestError(
            f"the times in column {name} have passed through floating-point numbers, which are {spacing:g} ns apart "
            f"at {values[0]:.3g} {unit}: more than {COARSEST:.0%} of the median interval of {step:g} ns",
            path,
            fault="coarse_time",
            hint="log them as integers",
        )


def unwrap(time_ns: NDArray[np.int64], tick_ns: float) -> tuple[NDArray[np.int64], list[tuple[int, int]]]:
    """Undo the overflows of a counter.

    Parameters
    ----------
    time_ns : (n,) array of int64, ns
    tick_ns : float, ns
        Length of the column's unit.

    Returns
    -------
    time_ns : (n,) array of int64, ns
    wraps : list of (int, int)
        Row after each overflow, and the modulus, ns.
    """
    steps = np.diff(time_ns)
    back = np.flatnonzero(steps < 0)
    forward = steps[steps > 0]
    if back.size == 0 or forward.size == 0 or time_ns.min() < 0:
        return time_ns, []
    near = NEAR * float(np.median(forward))
    moduli = sorted({2**32 * 1000, 2**32 * 1_000_000} | {round(2**bits * tick_ns) for bits in (16, 24, 32)})
    largest = int(time_ns.max())
    for modulus in (m for m in moduli if m > largest >= m - near):
        rows = back[(time_ns[back] >= modulus - near) & (time_ns[back + 1] < near)]
        if rows.size:
            added = np.zeros(len(time_ns), np.int64)
            added[rows + 1] = modulus
            return time_ns + np.cumsum(added), [(int(r) + 1, modulus) for r in rows]
    return time_ns, []


def order_of(time_ns: NDArray[np.int64]) -> tuple[NDArray[np.intp] | None, int]:
    """Return the stable order of times and the largest displacement in it; None where they are in order."""
    if not np.any(np.diff(time_ns) < 0):
        return None, 0
    order = np.argsort(time_ns, kind="stable")
    return order, int(np.abs(order - np.arange(len(order))).max())


def wrap_note(wraps: list[tuple[int, int]], lines: list[int], tick_ns: float) -> Note:
    """Return the note on overflows that were undone."""
    modulus = wraps[0][1]
    bits = next((b for b in (16, 24, 32) if round(2**b * tick_ns) == modulus), 32)
    detail = f"the time counter of {bits} bits started again at 0 (every {modulus / 1e9:.9g} s) and was counted on"
    return Note("N-WRAP", len(wraps), lines[0], lines[-1], detail)
