# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Permanent ids of the rows of a table as a value; `identities` has them for kernels."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.geometry.se2 import IntArray


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
