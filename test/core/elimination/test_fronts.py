# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fronts against dense matrices."""

import numpy as np
import pytest

from pose_graph_ros.core.elimination import fronts


@pytest.mark.parametrize(('rows', 'n'), [
    (3, 3), (3, 6), (6, 6), (6, 15), (9, 9), (9, 12), (12, 21), (15, 48), (18, 90)])
def test_a_front_is_factorised_as_a_dense_matrix_is(rows: int, n: int) -> None:
    rng = np.random.default_rng(rows * n)
    root = rng.standard_normal((n, n))
    matrix = np.column_stack((root @ root.T + np.eye(n), rng.standard_normal(n)))
    ld = fronts.padded(n)
    front = np.zeros((n, ld))
    front[:, :n], front[:, -1] = np.triu(matrix[:, :n]), matrix[:, n]
    flat = front.ravel()
    assert fronts.factorize(flat, rows, n, ld, np.zeros(rows)) == -1
    done = np.column_stack((flat.reshape(n, ld)[:, :n], flat.reshape(n, ld)[:, -1]))
    R = np.linalg.solve(np.linalg.cholesky(matrix[:rows, :rows]), matrix[:rows])
    np.testing.assert_allclose(1.0 / np.diag(done)[:rows], np.diag(R), rtol=1e-10)
    np.testing.assert_allclose(np.triu(done[:rows], 1), np.triu(R, 1), atol=1e-10)
    rest = matrix[rows:, rows:] - R[:, rows:n].T @ R[:, rows:]
    np.testing.assert_allclose(np.triu(done[rows:, rows:]), np.triu(rest), atol=1e-9)


@pytest.mark.parametrize('bad', range(12))
def test_a_bad_pivot_is_found_in_its_row(bad: int) -> None:
    ld = fronts.padded(12)
    front = np.zeros((12, ld))
    front[:, :12] = np.diag(np.arange(1.0, 13.0))
    front[bad, bad] = 1e-3
    assert fronts.factorize(front.ravel(), 12, 12, ld, np.full(12, 0.01)) == bad
    front[bad, bad] = np.nan
    assert fronts.factorize(front.ravel(), 12, 12, ld, np.full(12, 0.01)) == bad
