# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The quick validation of new rows lets nothing through that the full validation refuses."""

from hypothesis import given, strategies as st
import numpy as np

from pose_graph_ros.core.compiled.jit import kernel
from pose_graph_ros.core.exceptions import GraphUpdateError
from pose_graph_ros.core.graph import rows, tables as tb
from pose_graph_ros.core.graph.checks import check
from pose_graph_ros.core.graph.constraints import Factors, full

numbers = st.sampled_from([0.0, 1e-12, 1e-3, 0.5, 1.0, -1.0, 30.0, 1e150, 1e300, np.inf, np.nan])
skews = st.sampled_from([0.0, 1e-9, 1e-4, -0.5])


def is_valid(matrix: np.ndarray) -> bool:
    """Return what the full validation says of an information matrix."""
    with np.errstate(all='ignore'):
        try:
            check(Factors([0], [1], np.zeros((1, 3)), matrix[None], [0]), np.zeros(2, dtype=bool))
        except GraphUpdateError:
            return False
    return True


@kernel
def write(factors, mean, matrix):  # type: ignore[no-untyped-def]
    return rows.write_measurement(factors[0], mean, matrix)


def packed(matrix: np.ndarray) -> tuple[bool, np.ndarray]:
    factors = np.zeros(1, tb.FACTOR)
    valid = write(factors, np.zeros(3), matrix)
    return valid, full(factors['information'])[0]


@given(st.lists(numbers, min_size=6, max_size=6), skews)
def test_whatever_is_quickly_accepted_is_valid(upper: list[float], skew: float) -> None:
    matrix = full(np.array([upper]))[0].copy()
    matrix[2, 0] += skew
    if packed(matrix)[0]:
        assert is_valid(matrix)


@given(st.integers(0, 2**32 - 1), st.integers(1, 3), st.floats(-6.0, 6.0))
def test_semidefinite_matrices_in_any_units_are_accepted_as_they_are(
    seed: int, rank: int, decades: float,
) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(0.0, 1.0, (3, rank)) * np.array([[1.0], [1.0], [10.0**decades]])
    matrix = root @ root.T
    valid, kept = packed(matrix)
    assert valid
    np.testing.assert_array_equal(kept, matrix)
