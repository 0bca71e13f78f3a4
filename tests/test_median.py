"""The median by sorting beside numpy's own."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.records.median import median


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("keepdims", [False, True])
def test_the_median_is_that_of_numpy_bit_for_bit(axis: int, *, keepdims: bool) -> None:
    rng = np.random.default_rng(5)
    for rows in (1, 2, 3, 40, 41):
        values = rng.standard_normal((rows, 4))
        values[:, 1] = np.round(values[:, 1])
        values[rows // 2, 2] = np.inf
        for case in (values, (100 * values[:, :2]).astype(np.int64)):
            expected = np.median(case, axis=axis, keepdims=keepdims)
            np.testing.assert_array_equal(median(case, axis, keepdims=keepdims), expected, strict=True)


def test_a_median_of_what_is_not_known_is_not_known() -> None:
    values = np.array([[1.0, 2.0], [np.nan, 3.0], [0.0, 4.0]])
    np.testing.assert_array_equal(median(values), [np.nan, 3.0])
    assert np.isnan(median(values[:, 0]))
