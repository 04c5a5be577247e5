# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sparse systems of blocks against dense ones, and what is loaded for them."""

import subprocess
import sys

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
import scipy.sparse
from scipy.sparse.csgraph import connected_components

from pose_graph_ros.core.exceptions import LinearSolveError
from pose_graph_ros.core.sparse import BlockPattern, components, order_of

# Loads the extension by its file name, then SciPy, which has to use the same one.
ALONE = """
import sys
import numpy as np
from pose_graph_ros.core.sparse import BlockPattern, order_of
from pose_graph_ros.core.sparse import NAME
i = np.arange(3)
pattern = BlockPattern(i, i, order_of(i[:-1], i[1:], 3))
assert pattern.factors([2.0 * np.ones((3, 1, 1))]).solve(np.ones(3)).tolist() == [0.5] * 3
assert 'scipy.sparse' not in sys.modules and 'numba' not in sys.modules
extension = sys.modules[NAME]
import scipy.sparse.linalg
from scipy.sparse.linalg._dsolve import linsolve
assert linsolve._superlu is extension
assert scipy.sparse.linalg.splu(scipy.sparse.eye_array(3).tocsc()).solve(np.ones(3)).sum() == 3.0
"""


# As where SciPy has its extension modules in another place.
ELSEWHERE = """
import sys
import numpy as np
from pose_graph_ros.core import sparse
sparse.EXTENSION_SUFFIXES = ('.elsewhere',)
i = np.arange(3)
pattern = sparse.BlockPattern(i, i, sparse.order_of(i[:-1], i[1:], 3))
factors = pattern.factors([2.0 * np.ones((3, 1, 1))])
assert factors.is_positive and factors.solve(np.ones(3)).tolist() == [0.5] * 3
assert sys.modules['scipy.sparse.linalg'].splu
"""


def test_superlu_is_that_of_an_imported_scipy_if_it_is_not_found() -> None:
    subprocess.run([sys.executable, '-c', ELSEWHERE], check=True)


def test_superlu_is_loaded_without_the_rest_of_scipy() -> None:
    subprocess.run([sys.executable, '-c', ALONE], check=True)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 12), size=st.integers(1, 3),
       is_complex=st.booleans(), definite=st.booleans())
def test_factors_are_those_of_the_dense_matrix(
    seed: int, n: int, size: int, is_complex: bool, definite: bool,
) -> None:
    rng = np.random.default_rng(seed)
    m = 2 * n
    i, j = rng.integers(0, n, (2, m))
    rows, columns = (np.concatenate((*pair, np.arange(n))) for pair in ((i, i, j, j),
                                                                      (i, j, i, j)))
    shape = (m, size, 2 * size)
    factor = rng.normal(size=shape) + (1j * rng.normal(size=shape) if is_complex else 0.0)
    square = np.conj(np.swapaxes(factor, 1, 2)) @ factor
    own = np.tile(np.eye(size), (n, 1, 1)).astype(square.dtype)
    if not definite:
        own[0] -= 1000.0 * np.eye(size)
    blocks = [square[:, :size, :size], square[:, :size, size:], square[:, size:, :size],
              square[:, size:, size:], own]
    dense = np.zeros((n * size, n * size), dtype=square.dtype)
    for row, column, block in zip(rows, columns, np.concatenate(blocks), strict=True):
        dense[size * row:size * row + size, size * column:size * column + size] += block
    places = order_of(i, j, n)
    assert sorted(places.tolist()) == list(range(n))
    factors = BlockPattern(rows, columns, places).factors(blocks)
    right = rng.normal(size=(n * size, 2)).astype(square.dtype)
    assert factors.is_positive == (np.linalg.eigvalsh(dense)[0] > 0.0)
    expected = np.linalg.solve(dense, right)
    scale = np.linalg.cond(dense) * np.max(np.abs(expected))
    np.testing.assert_allclose(factors.solve(right), expected, rtol=0.0, atol=1e-12 * scale)


def test_a_singular_matrix_is_an_error() -> None:
    i = np.arange(2)
    pattern = BlockPattern(i, i, i)
    with pytest.raises(LinearSolveError, match='singular'):
        pattern.factors([np.array([1.0, 0.0])[:, None, None]])


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 40), m=st.integers(0, 40))
def test_components_are_those_of_scipy(seed: int, n: int, m: int) -> None:
    i, j = np.random.default_rng(seed).integers(0, n, (2, m))
    label = components(i, j, n)
    _, expected = connected_components(
        scipy.sparse.coo_array((np.ones(m), (i, j)), shape=(n, n)), directed=False)
    for k in range(n):
        assert label[k] == np.flatnonzero(expected == expected[k])[0]


def test_a_long_path_is_one_component() -> None:
    order = np.random.default_rng(0).permutation(20_000)
    assert not np.any(components(order[:-1], order[1:], 20_000))
