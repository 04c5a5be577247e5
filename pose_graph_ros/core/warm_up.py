# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Compile all kernels before the first measurement, or load them from the cache.

Importing this module imports all modules of the engine with kernels. What has to be compiled are
the kernels that Python calls, each of which declares its signature (`compiled.jit`).

Compiling takes half a minute or more, and Numba's compiler holds the GIL for most of it. So other
processes compile, and this one only loads the result: meanwhile it receives messages and can be
ended at any moment.
"""

from collections.abc import Callable, Iterator
import contextlib
import gc
import os
import time

from pose_graph_ros.core import backend  # noqa: F401  imports all modules with kernels
from pose_graph_ros.core.compiled import jit
from pose_graph_ros.core.helper_process import end_with_parent, HelperProcess

# Functions that the helper processes call: one begins with the first kernel, one with the last.
HELPERS = ((__name__, 'compile_forwards'), (__name__, 'compile_backwards'))
# Time after which a helper counts as stuck [s].
PATIENCE = 600.0
# Threshold of the garbage collector while kernels are compiled [objects].
MANY_OBJECTS = 200_000


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
            helpers = [stack.enter_context(HelperProcess(*function))
                       for function in HELPERS[:len(os.sched_getaffinity(0))]]
            for helper in helpers:
                helper.wait(PATIENCE, stopped)
    with _rare_collections():
        for name in jit.declared():
            if stopped():
                break
            jit.compile_kernels([name])
    return time.perf_counter() - start


def compile_forwards() -> None:
    """Compile and store all kernels that are not in the cache; for a helper process."""
    _compile_missing(jit.declared())


def compile_backwards() -> None:
    """Do as `compile_forwards`, in the opposite order: the two meet in the middle."""
    _compile_missing(jit.declared()[::-1])


def _compile_missing(names: list[str]) -> None:
    end_with_parent()
    with _rare_collections():
        for name in names:
            if not jit.is_cached(name):
                jit.compile_kernels([name])


@contextlib.contextmanager
def _rare_collections() -> Iterator[None]:
    """Collect garbage rarely, as the compiler creates many objects and keeps most of them."""
    thresholds = gc.get_threshold()
    gc.set_threshold(MANY_OBJECTS)
    try:
        yield
    finally:
        gc.set_threshold(*thresholds)
