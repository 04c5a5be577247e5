# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Permanent ids of hidden nodes, edges and observed nodes, and the rows that they are in.

Rows are in the order of their ids, so the row of an id is found by bisection.
"""

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.geometry.se2 import IntArray


def read_only(numbers: IntArray) -> IntArray:
    """Return the array after making it read-only."""
    numbers.flags.writeable = False
    return numbers


def rows_of(present: IntArray, ids: npt.ArrayLike) -> IntArray:
    """
    Return the row of each id, -1 where it is in none.

    Parameters
    ----------
    present : ndarray, shape (N,), ids by row, ascending
    ids : array_like of int

    """
    wanted = np.asarray(ids, dtype=np.int64)
    return np.where((wanted >= 0) & (wanted < len(present)), wanted, -1)


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
