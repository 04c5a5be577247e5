# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Memory for arrays that grow: what is not written to takes none, what is freed goes at once."""

import contextlib
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
    size = np.dtype(dtype).itemsize
    for n in shape:
        size *= n
    if size < 2**18:
        return np.zeros(shape, dtype)
    pages = mmap.mmap(-1, size, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    with contextlib.suppress(OSError):  # a kernel without huge pages
        pages.madvise(mmap.MADV_NOHUGEPAGE)
    return np.frombuffer(pages, dtype).reshape(shape)


def give_back(array: npt.NDArray[Any]) -> None:
    """Make a large array of `zeros` all zeros, which takes no memory."""
    owner: Any = array
    while isinstance(owner, np.ndarray):
        owner = owner.base
    if owner is None:
        array[...] = np.zeros((), array.dtype)
    else:
        owner.obj.madvise(mmap.MADV_DONTNEED)
