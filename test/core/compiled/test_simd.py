# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Vectors write exactly the numbers that they are given."""

import numpy as np
import pytest

from pose_graph_ros.core.compiled import simd
from pose_graph_ros.core.compiled.jit import kernel


@kernel
def added(source, target, n):
    simd.add(source, 1, target, 2, n)


@pytest.mark.parametrize('n', range(10))
def test_vectors_write_exactly_the_given_numbers(n: int) -> None:
    source, start = np.arange(20.0) + 100.0, np.arange(20.0)
    target, expected = start.copy(), start.copy()
    added(source, target, n)
    expected[2:2 + n] += source[1:1 + n]
    np.testing.assert_array_equal(target, expected)
