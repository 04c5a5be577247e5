# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compile the solver and keep its code, so that the next start of the node need not."""

import argparse
import os
import sys
import time

import numba

from pose_graph_ros.core.compiled import jit
from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.warm_up import warm_up


def execute(_: argparse.Namespace) -> int:
    """Run the tool; return the exit code: 1 if the next start has to compile."""
    if numba.config.DISABLE_JIT:
        raise ConfigError('NUMBA_DISABLE_JIT is set, so nothing is compiled')
    complete = jit.is_cached()
    print(f'{"loading" if complete else "compiling"} the solver for this processor '
          f'({jit.processor()})', flush=True)
    start = time.perf_counter()
    warm_up()
    seconds = time.perf_counter() - start
    if not jit.is_cached():
        print(f'compiled in {seconds:.1f} s, but not kept: the next start compiles again',
              file=sys.stderr)
        return 1
    folders = jit.cache_folders()
    whose = (' (NUMBA_CACHE_DIR)' if numba.config.CACHE_DIR else
             ', in each __pycache__' if all(each.name == '__pycache__' for each in folders) else
             ', where only this user finds it; set NUMBA_CACHE_DIR for others')
    print(f'{"loaded" if complete else "compiled"} in {seconds:.1f} s; kept in '
          f'{os.path.commonpath(folders)}{whose}')
    return 0
