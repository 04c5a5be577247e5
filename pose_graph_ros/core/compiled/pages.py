# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Memory for arrays that grow: what is not written to takes none, what is freed goes at once."""

import contextlib
import math
import mmap
from typing import Any

import numpy as np
import numpy.typing as npt


def zeros(shape: tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """
    Return an array of zeros; a large one has pages of its own, which take memory when written to.

    NumPy would allocate huge pages and keep them after a table has grown out of them. The pages
    are private: a process that is forked from this one gets copies of those that it writes to.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if size < 2**18:
        return np.zeros(shape, dtype)
    pages = mmap.mmap(-1, size, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    with contextlib.suppress(OSError):  # a kernel without huge pages
        pages.madvise(mmap.MADV_NOHUGEPAGE)
    return np.frombuffer(pages, dtype).reshape(shape)


def give_back(array: npt.NDArray[Any]) -> None:
    """Make all of an array of `zeros` with pages of its own zero again, which takes no memory."""
    pages: Any = array
    while isinstance(pages, np.ndarray):
        pages = pages.base
    pages.obj.madvise(mmap.MADV_DONTNEED)
