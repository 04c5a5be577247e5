# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Arrays that grow at their end, at amortised constant cost a row."""

import numpy as np
import numpy.typing as npt


class GrowingArray:
    """
    Rows of one shape and type; appending never copies more than it adds, amortised.

    Parameters
    ----------
    row_shape : tuple of int
        Shape of one row; `()` for numbers.
    dtype : dtype
        Type of the numbers.

    """

    def __init__(self, row_shape: tuple[int, ...], dtype: npt.DTypeLike) -> None:
        self._data = np.empty((16, *row_shape), dtype=dtype)
        self._size = 0

    def __len__(self) -> int:
        return self._size

    @property
    def values(self) -> npt.NDArray[np.generic]:
        """View of all rows, writeable; stale after the next `append`."""
        return self._data[:self._size]

    @property
    def read_only(self) -> npt.NDArray[np.generic]:
        """View of all rows that cannot be written to; stale after the next `append`."""
        view = self.values
        view.flags.writeable = False
        return view

    def append(self, rows: npt.ArrayLike) -> None:
        """Append rows, shape (M, *row_shape)."""
        rows = np.asarray(rows)
        end = self._size + len(rows)
        if end > len(self._data):
            grown = np.empty((max(end, 2 * len(self._data)), *self._data.shape[1:]),
                             dtype=self._data.dtype)
            grown[:self._size] = self.values
            self._data = grown
        self._data[self._size:end] = rows
        self._size = end

    def append_one(self, row: npt.ArrayLike) -> None:
        """Append a single row, shape `row_shape`."""
        if self._size == len(self._data):
            self.append(np.asarray(row)[None])
        else:
            self._data[self._size] = row
            self._size += 1

    def truncate(self, size: int) -> None:
        """Forget all rows from `size` on."""
        if not 0 <= size <= self._size:
            raise ValueError(f'expected a size in 0..{self._size}, got {size}')
        self._size = size
