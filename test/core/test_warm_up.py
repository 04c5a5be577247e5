# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""After the warm-up nothing is left to be compiled, whatever the engine does."""

import os
import subprocess
import sys

import pytest


def run_alone(code: str, **environment: str) -> str:
    """Run code in an interpreter of its own, where nothing has been compiled or loaded before."""
    path = os.pathsep.join(map(os.path.abspath, sys.path))
    done = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, check=False,
        env={**os.environ, 'PYTHONPATH': path, **environment})
    assert done.returncode == 0, f'exit code {done.returncode}: {done.stderr[-3000:]}'
    return done.stdout


# --- what the engine does ------------------------------------------------------------------------

LONG_RUN = """
from helpers.all_kernels import call_all_kernels
from pose_graph_ros.core.compiled import jit
from pose_graph_ros.core.warm_up import warm_up

def signatures():
    return {name: list(map(str, kernel.signatures)) for name, kernel in jit._registered.items()}

assert warm_up() > 0.0
before = signatures()
call_all_kernels(700)
call_all_kernels(300, max_iterations=1)
grown = {name: found for name, found in signatures().items() if found != before[name]}
assert not grown, grown
"""
BUILD = """
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.compiled import jit

PoseGraphBackend()
compiled = [name for name, kernel in jit._registered.items() if kernel.signatures]
assert not compiled, compiled
"""
KEPT = """
from pose_graph_ros.core.compiled import jit
from pose_graph_ros.core.warm_up import warm_up

warm_up()
missing = [name for name in jit.declared() if not jit.is_cached(name)]
assert jit.is_cached(), missing
"""


@pytest.mark.timeout(300)
def test_a_long_run_after_the_warm_up_compiles_nothing() -> None:
    run_alone(LONG_RUN)


def test_a_backend_is_built_without_compiling() -> None:
    """So that a node is up before anything is compiled."""
    run_alone(BUILD)


@pytest.mark.timeout(300)
def test_the_next_start_finds_the_code_of_all_kernels() -> None:
    run_alone(KEPT)


def test_it_can_be_stopped_between_two_kernels() -> None:
    run_alone("""
from pose_graph_ros.core import warm_up
loaded = []
warm_up.jit.compile_kernels = loaded.extend
warm_up.warm_up(lambda: len(loaded) == 3)
assert len(loaded) == 3, loaded
warm_up.warm_up()
assert loaded[3:] == warm_up.jit.declared()
""")
