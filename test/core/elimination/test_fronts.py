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


@pytest.mark.parametrize(('rows', 'n'), [(3, 3), (3, 6), (6, 6), (6, 15), (9, 12), (12, 21)])
def test_rows_are_written_and_solved_as_a_dense_triangle_is(rows: int, n: int) -> None:
    rng, ld = np.random.default_rng(rows * n), fronts.padded(n)
    front = rng.standard_normal((n, ld))
    pool = np.full(n * (n + 3) // 2 + 6, -7.0)
    fronts.write_rows(front.ravel(), n, ld, pool, 3)
    triangle = [number for k in range(n) for number in (*front[k, k:n], front[k, -1])]
    np.testing.assert_array_equal(pool[3:-3], triangle)
    np.testing.assert_array_equal(pool[[0, 1, 2, -3, -2, -1]], -7.0)

    R = np.triu(front[:rows, :n])
    R[np.diag_indices(rows)] = 1.0 / R.diagonal()   # the reciprocal is stored
    right, values = rng.standard_normal(n), np.append(pool[3:-3], np.zeros(3))
    x = np.append(right, np.full(3, np.nan))
    fronts.forward_rows(values, rows, n, x)
    y = np.linalg.solve(R[:, :rows].T, right[:rows])
    np.testing.assert_allclose(x[:n], np.append(y, right[rows:] - R[:, rows:].T @ y), rtol=1e-9)
    for stored, left in ((False, x[:rows].copy()), (True, front[:rows, -1])):
        fronts.backward_rows(values, rows, n, x, stored)
        np.testing.assert_allclose(
            R[:, :rows] @ x[:rows], left - R[:, rows:] @ x[rows:n], rtol=1e-9, atol=1e-9)
