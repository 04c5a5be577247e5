# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Return memory to the system that only the start of the process needs; imports no rclpy.

Loading compiled kernels leaves more than 100 MB of pages of LLVM and other libraries in memory.
"""

import ctypes
from pathlib import Path

# Constants of <sys/mman.h> and <malloc.h> of Linux.
MADV_DONTNEED, M_MMAP_THRESHOLD, M_ARENA_MAX = 4, -3, -8
LARGE = 256 * 1024  # from this size an array has its own pages, returned when it is freed [bytes]
# Number of heaps: each of the dozen threads of the middleware would have its own, mostly empty.
ARENAS = 2

SMAPS = Path('/proc/self/smaps')


def give_back_large_arrays() -> None:
    """Make glibc return the pages of every large array: by default it keeps most in its heap."""
    mallopt = getattr(ctypes.CDLL(None), 'mallopt', None)
    if mallopt is not None:
        mallopt(M_MMAP_THRESHOLD, LARGE)
        mallopt(M_ARENA_MAX, ARENAS)


def release_memory() -> None:
    """Return pages of the free heap, and of files that can be read again, to the system."""
    libc = ctypes.CDLL(None)
    trim, madvise = getattr(libc, 'malloc_trim', None), getattr(libc, 'madvise', None)
    if trim is not None:
        trim(0)
    if madvise is None:
        return
    for begin, end in unchanged_mappings():
        madvise(ctypes.c_void_p(begin), ctypes.c_size_t(end - begin), MADV_DONTNEED)


def unchanged_mappings() -> list[tuple[int, int]]:
    """Return begin and end of the read-only mappings of files that are equal to the file."""
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
