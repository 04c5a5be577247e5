# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Memory that only the start of the process has needed, back to the system; no rclpy.

To load compiled kernels the start reads much of LLVM, and of other libraries: more than 100 MB of
files stay mapped in that nobody looks at again.
"""

import ctypes
from pathlib import Path

# As <sys/mman.h> and <malloc.h> of Linux have them.
MADV_DONTNEED = 4
M_MMAP_THRESHOLD = -3
M_ARENA_MAX = -8
# Arrays beyond this get pages of their own, which go back when they are freed [bytes].
LARGE = 256 * 1024
# The middleware has a dozen threads; each would have a heap of its own, mostly empty.
ARENAS = 2

SMAPS = Path('/proc/self/smaps')


def give_back_large_arrays() -> None:
    """
    Have every large array give its pages back when it is freed.

    Left alone, glibc learns from the first ones that are freed to keep later ones in its heap.
    """
    mallopt = getattr(ctypes.CDLL(None), 'mallopt', None)
    if mallopt is not None:
        mallopt(M_MMAP_THRESHOLD, LARGE)
        mallopt(M_ARENA_MAX, ARENAS)


def let_go() -> None:
    """
    Let go of file pages and of free heap; does nothing where the system has no such thing.

    Only what can be read from its file again at any time: of mappings that cannot be written to,
    and in which nothing was changed when they were loaded.
    """
    libc = ctypes.CDLL(None)
    trim, madvise = getattr(libc, 'malloc_trim', None), getattr(libc, 'madvise', None)
    if trim is not None:
        trim(0)
    if madvise is None:
        return
    for begin, end in unchanged_mappings():
        madvise(ctypes.c_void_p(begin), ctypes.c_size_t(end - begin), MADV_DONTNEED)


def unchanged_mappings() -> list[tuple[int, int]]:
    """Return begin and end of what is mapped from files read-only, and as it is there."""
    try:
        lines = SMAPS.read_text(encoding='utf-8', errors='replace').splitlines()
    except OSError:
        return []
    found: list[tuple[int, int]] = []
    wanted = False
    for line in lines:
        first, *rest = line.split()
        if not first.endswith(':'):
            permissions, path = rest[0], rest[4] if len(rest) > 4 else ''
            wanted = permissions[1] == '-' and permissions[3] == 'p' and path.startswith('/')
            begin, end = (int(number, 16) for number in first.split('-'))
        elif wanted and first == 'Anonymous:' and int(rest[0]) == 0:
            found.append((begin, end))
    return found
