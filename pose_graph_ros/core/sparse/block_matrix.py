# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Assembly of sparse symmetric matrices from blocks, one row and column of blocks for each node.

The pattern and an order of the nodes with little fill are found once (`BlockPattern`, `order_of`);
then matrices with other numbers, and with blocks of another size, only need sums.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.geometry.se2 import IntArray
from pose_graph_ros.core.sparse.superlu import Factors

Blocks = npt.NDArray[Any]


class BlockPattern:
    """
    Where sums of blocks are in a matrix, of n nodes in the order of elimination.

    Parameters
    ----------
    rows, columns : ndarray of int, shape (K,)
        Nodes of the blocks that are added up. Each pattern is symmetric, and has all diagonals.
    places : ndarray of int, shape (n,), the place of each node in the order, see `order_of`

    """

    def __init__(self, rows: IntArray, columns: IntArray, places: IntArray) -> None:
        self._places, n = places, len(places)
        keys = places[columns] * n + places[rows]
        self._order = np.argsort(keys, kind='stable')
        keys = keys[self._order]
        self._begins = np.flatnonzero(np.diff(keys, prepend=-1))
        self._columns, self._rows = np.divmod(keys[self._begins], n)
        self._starts = np.searchsorted(self._columns, np.arange(n + 1))
        self._layouts: dict[int, tuple[npt.NDArray[Any], ...]] = {}

    def _layout(self, size: int) -> tuple[npt.NDArray[Any], ...]:
        """Return the place of each number of each block, rows and starts of the columns."""
        if size not in self._layouts:
            n_blocks, height = len(self._rows), np.diff(self._starts)
            first = self._starts[self._columns]
            # number (r, m) of block k: column m of its node, below the blocks above it
            at = (size * size * first + size * (np.arange(n_blocks) - first))[:, None, None] + (
                np.arange(size)[:, None] + size * np.arange(size) * height[
                    self._columns][:, None, None])
            rows = np.empty(size * size * n_blocks, dtype=np.int32)
            rows[at] = (size * self._rows)[:, None, None] + np.arange(size)[:, None]
            starts = np.concatenate(([0], np.cumsum(np.repeat(size * height, size))))
            self._layouts[size] = at, rows, starts.astype(np.int32)
        return self._layouts[size]

    def factors(self, blocks: Iterable[Blocks]) -> 'BlockFactors':
        """
        Return the factors of a matrix; raise LinearSolveError if it is singular.

        Parameters
        ----------
        blocks : iterable of ndarray, shape (K, b, b) together, in the order of rows and columns

        """
        summed = np.add.reduceat(np.concatenate([*blocks])[self._order], self._begins, axis=0)
        size = summed.shape[-1]
        at, rows, starts = self._layout(size)
        values = np.empty(len(rows), dtype=summed.dtype)
        values[at] = summed
        return BlockFactors(Factors(values, rows, starts, ordered=True), self._places, size)


class BlockFactors:
    """
    Factors of a matrix of blocks.

    Parameters
    ----------
    factors : Factors
    places : ndarray of int, shape (n,), of the nodes in the order of elimination
    size : int, rows of each block

    """

    def __init__(self, factors: Factors, places: IntArray, size: int) -> None:
        self._factors, self._size = factors, size
        self._numbers = (size * places[:, None] + np.arange(size)).ravel()

    @property
    def is_positive(self) -> bool:
        """Whether the matrix was shown to be positive definite."""
        return self._factors.is_positive

    def solve(self, right: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """
        Return the solution for right-hand sides of the type of the matrix.

        Parameters
        ----------
        right : ndarray, shape (n b,) or (n b, k), by node

        """
        ordered = np.empty_like(right)
        ordered[self._numbers] = right
        return self._factors.solve(ordered)[self._numbers]


def order_of(i: IntArray, j: IntArray, n: int) -> IntArray:
    """
    Return the place of each node in an order of elimination with little fill, shape (n,).

    It is that of minimum degree for edges between the nodes.

    Parameters
    ----------
    i, j : ndarray of int, shape (M,)
    n : int

    """
    nodes = np.arange(n)
    # without an index NumPy loads its masked arrays, which takes 7 ms
    keys, _ = np.unique(np.concatenate((i * n + j, j * n + i, nodes * n + nodes)),
                        return_index=True)
    columns, rows = np.divmod(keys, n)
    starts = np.searchsorted(columns, np.arange(n + 1)).astype(np.int32)
    # diagonally dominant
    values = np.where(rows == columns, np.diff(starts)[columns].astype(np.float64), -0.5)
    return Factors(values, rows.astype(np.int32), starts, ordered=False).places
