# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Compile all kernels before the first measurement, or load them from the cache.

Importing this module imports all modules of the engine with kernels. What has to be compiled are
the kernels that Python calls, each of which declares its signature (`compiled.jit`).

Compiling takes half a minute or more, and Numba's compiler holds the GIL for most of it. So other
processes compile, and this one only loads the result: meanwhile it receives messages and can be
ended at any moment. It may be a node with threads and handlers of signals, so the others are
started afresh and not forked, and get nothing but the path of imports and the environment.
"""

from collections.abc import Callable, Iterator
import contextlib
import ctypes
import functools
import gc
import mmap
import os
from pathlib import Path
import subprocess
import sys
import threading
import time

from pose_graph_ros.core import backend  # noqa: F401  imports all modules with kernels
from pose_graph_ros.core.compiled import jit

# The path is set before anything of ours is imported: where there are two installations, or none
# that a bare interpreter would find, it must be this one.
BEGIN = ('import importlib, sys; _, module, name, *sys.path = sys.argv; '
         'getattr(importlib.import_module(module), name)()')


@contextlib.contextmanager
def helper(module: str, name: str) -> Iterator[Callable[[], bool]]:
    """Run a function of a module in an interpreter of its own; yield whether it goes on."""
    try:
        # no interpreter is known where Python is embedded; none can be started without memory
        process = subprocess.Popen(
            [sys.executable, '-c', BEGIN, module, name, *map(os.fspath, sys.path)],
            stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    except (OSError, ValueError, TypeError):
        yield lambda: False
        return
    try:
        yield lambda: process.poll() is None
    finally:
        process.kill()
        process.communicate()


def end_with_parent() -> None:
    """End this process as soon as the one that has started it is gone."""
    threading.Thread(target=_wait_for_parent, name='parent', daemon=True).start()


def _wait_for_parent() -> None:
    # the end of the pipe that the parent holds is closed in whichever way it ends
    os.read(sys.stdin.fileno(), 1)
    os._exit(1)


# Functions that the helper processes call: one begins with the first kernel, one with the last.
HELPERS = ((__name__, 'compile_missing'), (__name__, 'compile_backwards'))
# Time after which a helper counts as stuck [s].
PATIENCE = 600.0


def warm_up(stopped: Callable[[], bool] = lambda: False) -> float:
    """
    Make all kernels ready to be called, and return the duration [s].

    Parameters
    ----------
    stopped : callable
        Once it returns True, the rest is skipped: at once while other processes compile, otherwise
        after the present kernel. Kernels that are left are compiled when they are called.

    """
    start = time.perf_counter()
    if jit.can_be_kept() and not jit.is_cached():
        with contextlib.ExitStack() as stack:
            running = [stack.enter_context(helper(*function))
                       for function in HELPERS[:len(os.sched_getaffinity(0))]]
            while (any(goes_on() for goes_on in running) and not stopped()
                   and time.perf_counter() < start + PATIENCE):
                time.sleep(0.05)
    with _rare_collections():
        for name in jit.declared():
            if stopped():
                break
            jit.compile_kernels([name])
    _give_back_compiler()
    return time.perf_counter() - start


def _give_back_compiler() -> None:
    """
    Give back the pages of LLVM's code, 66 MB, which nothing needs once all kernels are there.

    They are read from the file again if something is compiled after all. Free parts of the
    heap, 8 MB, go as well.
    """
    with contextlib.suppress(OSError, AttributeError):  # on another system than Linux
        libc = ctypes.CDLL(None)
        for line in Path('/proc/self/maps').read_text(encoding='utf-8').splitlines():
            place, access, *_, path = line.split()
            if access == 'r-xp' and 'llvmlite' in path:
                begin, end = (int(number, 16) for number in place.split('-'))
                libc.madvise(ctypes.c_void_p(begin), ctypes.c_size_t(end - begin),
                             mmap.MADV_DONTNEED)
        libc.malloc_trim(0)


def compile_missing(step: int = 1) -> None:
    """Compile and store all kernels that are not in the cache; for a helper process."""
    end_with_parent()
    with _rare_collections():
        for name in jit.declared()[::step]:
            if not jit.is_cached(name):
                jit.compile_kernels([name])


# the opposite order: the two meet in the middle
compile_backwards = functools.partial(compile_missing, -1)


@contextlib.contextmanager
def _rare_collections() -> Iterator[None]:
    """Collect garbage rarely, as the compiler creates many objects and keeps most of them."""
    thresholds = gc.get_threshold()
    gc.set_threshold(200_000)
    try:
        yield
    finally:
        gc.set_threshold(*thresholds)
