"""Sorted sets of integers."""

import numpy as np
import pytest

from linprim_geo.base.sorting import distinct


@pytest.mark.parametrize("dtype", [np.int64, np.int32, np.uint8])
@pytest.mark.parametrize("size", [0, 1, 2, 1000])
def test_distinct_returns_sorted_unique_values_and_keeps_its_input(dtype, size):
    values = np.random.default_rng(size).integers(0, 100, size).astype(dtype)
    kept = values.copy()
    found = distinct(values)
    assert found.dtype == dtype
    assert found.tolist() == sorted(set(values.tolist()))
    np.testing.assert_array_equal(values, kept)
