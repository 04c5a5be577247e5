# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Permanent ids of hidden nodes, edges and observed nodes, and the rows that they are in.

Rows are in the order of their ids, so the row of an id is found by bisection. In a graph that
nothing has left, ids are rows; one comparison tells.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.compiled.jit import kernel
from pose_graph_ros.core.geometry.se2 import IntArray
from pose_graph_ros.core.graph import tables as tb


@kernel
def _row(number, ids, n, next_id):  # type: ignore[no-untyped-def]
    """Return the row of an id among the first n, -1 if it has left; new ones are behind them."""
    if number >= next_id:
        return n + number - next_id
    if next_id == n:
        return number
    low, high = 0, n
    while low < high:
        middle = (low + high) // 2
        if ids[middle] < number:
            low = middle + 1
        else:
            high = middle
    return low if low < n and ids[low] == number else -1


@kernel
def node_row(head, node):  # type: ignore[no-untyped-def]
    """
    Return the row of a hidden node, negative if it has left the graph.

    The next new ids have the rows behind the last; so rows of an update that is being added are
    found as well.

    Parameters
    ----------
    node : int, id

    """
    return _row(node, tb.node_id(head), head[tb.N_NODES], head[tb.NEXT_NODE])


@kernel
def edge_row(head, edge):  # type: ignore[no-untyped-def]
    """
    Return the row of an edge, negative if it has left the graph.

    Parameters
    ----------
    edge : int, id

    """
    return _row(edge, tb.edge_id(head), head[tb.N_EDGES], head[tb.NEXT_EDGE])


@kernel
def observed_row(head, observed):  # type: ignore[no-untyped-def]
    """
    Return the row of an observed node, negative if it has left the graph.

    Parameters
    ----------
    observed : int, id

    """
    return _row(observed, tb.observed_id(head), head[tb.N_OBSERVED], head[tb.NEXT_OBSERVED])


class Ids(NamedTuple):
    """Which ids of nodes, edges or observed nodes are in use."""

    end: int
    """Id of the next new row."""
    present: IntArray | None = None
    """Ids by row, ascending; None where they are all of 0..end - 1."""

    @classmethod
    def of(cls, end: int, present: IntArray) -> 'Ids':
        """
        Return the ids of a table.

        Parameters
        ----------
        end : int, id of the next new row
        present : ndarray, ids by row

        """
        return cls(end, None if len(present) == end else present)

    def rows(self, ids: npt.ArrayLike) -> IntArray:
        """Return the row of each id, in the shape of `ids`, -1 where it is in none."""
        wanted = np.asarray(ids, dtype=np.int64)
        if self.present is None:
            return np.where((wanted >= 0) & (wanted < self.end), wanted, -1)
        if len(self.present) == 0:
            return np.full(wanted.shape, -1)
        rows = np.minimum(np.searchsorted(self.present, wanted), len(self.present) - 1)
        return np.where(self.present[rows] == wanted, rows, -1)

    def by_row(self) -> IntArray:
        """Return the ids of all rows."""
        return np.arange(self.end) if self.present is None else self.present

    def extended(self, n: int) -> 'Ids':
        """Return the ids with n more rows."""
        if self.present is None:
            return Ids(self.end + n)
        return Ids(self.end + n, np.append(self.present, self.end + np.arange(n)))


def known(rows: IntArray, ids: npt.ArrayLike, what: str) -> IntArray:
    """
    Return rows; raise ValueError if one is -1.

    Parameters
    ----------
    rows : ndarray, shape (K,)
    ids : array_like of int, shape (K,)
    what : str, what has the ids

    """
    if np.any(rows < 0):
        gone = np.asarray(ids)[rows < 0].flat[0]
        raise ValueError(f'{what} {gone} is not in the graph')
    return rows
