# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Dense kernels of the factorisation: a front is factorised in part, a clique is solved for.

A *front* is the upper triangle of the equations of one clique, `(H | rhs)`, its frontal nodes
first. Factorising the frontal rows leaves rows of R with `R^T R = H` and, in the other rows, the
Schur complement: the *update matrix*, which is added to the front of the parent (J. Liu, "The
multifrontal method for sparse matrix solution", SIAM Review 34 (1992)). Rows of R hold the
reciprocal of their diagonal. Both are stored as upper triangles by rows, without gaps.
"""

from pose_graph_ros.core.jit import kernel

# A pivot that is smaller than this fraction of what the constraints of its node add to it has
# lost all its digits: the node is not determined.
LEAST_PIVOT = 1e-12

_FAST = {'reassoc', 'contract', 'nsz', 'arcp'}


@kernel
def row_start(k, n):  # type: ignore[no-untyped-def]
    """
    Return where column 0 of row k would be, in the upper triangle of n columns stored by rows.

    A row holds its columns from k on, and its right-hand side as column n.
    """
    return k * n - k * (k - 1) // 2


@kernel
def triangle_size(rows, n):  # type: ignore[no-untyped-def]
    """Return how many numbers the first rows of such a triangle are."""
    return rows * (n + 1) - rows * (rows - 1) // 2


@kernel(fastmath=_FAST)
def forward_rows(values, rows, n, x):  # type: ignore[no-untyped-def]
    """
    Solve `R^T y = x` for the frontal rows of a clique, and take them off the separator.

    Parameters
    ----------
    values : ndarray, flat
        Upper triangle of n columns, its first `rows` rows.
    x : ndarray, shape (n,)

    """
    for k in range(0, rows, 3):
        r0, r1, r2 = (values[row_start(k, n):], values[row_start(k + 1, n):],
                      values[row_start(k + 2, n):])
        a = x[k] * r0[k]
        b = (x[k + 1] - r0[k + 1] * a) * r1[k + 1]
        c = (x[k + 2] - r0[k + 2] * a - r1[k + 2] * b) * r2[k + 2]
        x[k], x[k + 1], x[k + 2] = a, b, c
        for m in range(k + 3, n):
            x[m] -= a * r0[m] + b * r1[m] + c * r2[m]


@kernel(fastmath=_FAST)
def _backward_block(values, k, n, x, a, b, c):  # type: ignore[no-untyped-def]
    """Solve the three rows of R from row k on for the right-hand sides a, b, c."""
    r0, r1, r2 = (values[row_start(k, n):], values[row_start(k + 1, n):],
                  values[row_start(k + 2, n):])
    for m in range(k + 3, n):
        a -= r0[m] * x[m]
        b -= r1[m] * x[m]
        c -= r2[m] * x[m]
    c *= r2[k + 2]
    b = (b - r1[k + 2] * c) * r1[k + 1]
    x[k] = (a - r0[k + 1] * b - r0[k + 2] * c) * r0[k]
    x[k + 1], x[k + 2] = b, c


@kernel
def backward_rows(values, rows, n, x):  # type: ignore[no-untyped-def]
    """Solve `R x = y` as `solve_rows` does, y being the frontal part of x instead of a column."""
    for k in range(rows - 3, -1, -3):
        _backward_block(values, k, n, x, x[k], x[k + 1], x[k + 2])


@kernel
def solve_rows(values, rows, n, x):  # type: ignore[no-untyped-def]
    """
    Solve the rows of R of a clique from the last to the first.

    Parameters
    ----------
    values : ndarray, flat
        Upper triangle of n columns, its first `rows` rows.
    x : ndarray, shape (n,)
        Holds the solution of the separator from `rows` on; the frontal part is written.

    """
    for k in range(rows - 3, -1, -3):
        at = row_start(k, n) + n
        _backward_block(
            values, k, n, x, values[at], values[at + n - k], values[at + 2 * (n - k) - 1])
