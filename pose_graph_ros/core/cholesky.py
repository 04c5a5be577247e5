# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Dense kernels of the factorisation: a front is factorised in part, a clique is solved for.

A *front* is the upper triangle of the equations of one clique, `(H | rhs)`, its frontal nodes
first. Factorising the frontal rows leaves rows of R with `R^T R = H` and, in the other rows, the
Schur complement: the *update matrix*, which is added to the front of the parent (J. Liu, "The
multifrontal method for sparse matrix solution", SIAM Review 34 (1992)). Rows of R hold the
reciprocal of their diagonal.
"""

from pose_graph_ros.core.jit import kernel

# A pivot that is smaller than this fraction of what the constraints of its node add to it has
# lost all its digits: the node is not determined.
LEAST_PIVOT = 1e-12

_FAST = {'reassoc', 'contract', 'nsz', 'arcp'}


@kernel(fastmath=_FAST)
def forward_rows(values, rows, n, x):  # type: ignore[no-untyped-def]
    """
    Solve `R^T y = x` for the frontal rows of a clique, and take them off the separator.

    Parameters
    ----------
    values : ndarray, flat
        `rows` rows of n + 1 numbers.
    x : ndarray, shape (n,)

    """
    ld = n + 1
    for k in range(0, rows, 3):
        r0 = values[k * ld:(k + 1) * ld]
        r1 = values[(k + 1) * ld:(k + 2) * ld]
        r2 = values[(k + 2) * ld:(k + 3) * ld]
        a = x[k] * r0[k]
        b = (x[k + 1] - r0[k + 1] * a) * r1[k + 1]
        c = (x[k + 2] - r0[k + 2] * a - r1[k + 2] * b) * r2[k + 2]
        x[k], x[k + 1], x[k + 2] = a, b, c
        for m in range(k + 3, n):
            x[m] -= a * r0[m] + b * r1[m] + c * r2[m]


@kernel(fastmath=_FAST)
def _backward_block(values, k, n, x, a, b, c):  # type: ignore[no-untyped-def]
    """Solve the three rows of R from row k on for the right-hand sides a, b, c."""
    ld = n + 1
    r0 = values[k * ld:(k + 1) * ld]
    r1 = values[(k + 1) * ld:(k + 2) * ld]
    r2 = values[(k + 2) * ld:(k + 3) * ld]
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
        `rows` rows of n + 1 numbers.
    x : ndarray, shape (n,)
        Holds the solution of the separator from `rows` on; the frontal part is written.

    """
    for k in range(rows - 3, -1, -3):
        at = k * (n + 1) + n
        _backward_block(
            values, k, n, x, values[at], values[at + n + 1], values[at + 2 * (n + 1)])
