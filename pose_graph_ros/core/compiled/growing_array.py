# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""An array that rows are appended to, at amortised constant cost per row."""

from typing import Any, Self

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.compiled import pages


class GrowingArray:
    """Array of rows that doubles its capacity when it is full."""

    def __init__(self, row_shape: tuple[int, ...], dtype: npt.DTypeLike) -> None:
        self._data = np.empty((16, *row_shape), dtype=dtype)
        self._size = 0

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, name: str) -> npt.NDArray[Any]:
        """Return a column of records, a view as `values`."""
        column: npt.NDArray[Any] = self.values[name]
        return column

    @classmethod
    def of(cls, rows: npt.NDArray[Any]) -> Self:
        """Return an array that begins with some rows."""
        array = cls(rows.shape[1:], rows.dtype)
        array.append(rows)
        return array

    @property
    def values(self) -> npt.NDArray[Any]:
        """Writeable view of all rows; invalid after the next `append`."""
        return self._data[:self._size]

    @property
    def read_only(self) -> npt.NDArray[Any]:
        """Read-only view of all rows; invalid after the next `append`."""
        view = self.values
        view.flags.writeable = False
        return view

    def append(self, rows: npt.ArrayLike) -> None:
        """Append rows, shape (M, *row_shape)."""
        rows = np.asarray(rows, dtype=self._data.dtype)
        end = self._size + len(rows)
        if end > len(self._data):
            grown = pages.zeros((max(end, 2 * len(self._data)), *self._data.shape[1:]),
                                self._data.dtype)
            grown[:self._size] = self.values
            self._data = grown
        self._data[self._size:end] = rows
        self._size = end

    def append_one(self, row: npt.ArrayLike) -> None:
        """Append a single row, shape `row_shape`."""
        if self._size == len(self._data):
            self.append(np.asarray(row, dtype=self._data.dtype)[None])
        else:
            self._data[self._size] = row
            self._size += 1

    def truncate(self, size: int) -> None:
        """Remove all rows from an index on."""
        self._size = min(self._size, size)

    def drop_first(self, n: int) -> None:
        """Remove the first n rows, in place, or into a quarter of the memory if that is enough."""
        left = self._size - n
        if 4 * max(left, 16) < len(self._data):
            self._data = np.concatenate((self._data[n:self._size], self._data[:left]))
        else:
            self._data[:left] = self._data[n:self._size]
        self._size = left

    def select(self, rows: npt.NDArray[np.int64]) -> None:
        """Keep some rows, by number, in this order, and give the memory of the others back."""
        self._data, self._size = self.values[rows], len(rows)
