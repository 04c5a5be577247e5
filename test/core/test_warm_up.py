# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""After the warm-up nothing is left to be compiled, whatever the engine does."""

from collections.abc import Iterator
import importlib
import inspect
import itertools
import os
import pkgutil
import subprocess
import sys
from types import CodeType, FunctionType, ModuleType

from numba.core.dispatcher import Dispatcher
import pytest

from pose_graph_ros import core
from pose_graph_ros.core.compiled import jit


def run_alone(code: str, **environment: str) -> str:
    """Run code in an interpreter of its own, where nothing has been compiled or loaded before."""
    path = os.pathsep.join(map(os.path.abspath, sys.path))
    done = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, check=False,
        env={**os.environ, 'PYTHONPATH': path, **environment})
    assert done.returncode == 0, f'exit code {done.returncode}: {done.stderr[-3000:]}'
    return done.stdout


# --- what must be covered: all kernels that functions of Python call -----------------------------

def modules_of_core() -> list[ModuleType]:
    return [importlib.import_module(found.name)
            for found in pkgutil.walk_packages(core.__path__, 'pose_graph_ros.core.')]


def functions_of(owner: ModuleType | type, module: str) -> Iterator[FunctionType]:
    """Yield the functions of a module or class that Python runs."""
    for each in vars(owner).values():
        if isinstance(each, Dispatcher):
            continue
        member = getattr(each, 'fget', None) or inspect.unwrap(getattr(each, '__func__', each))
        if getattr(member, '__module__', None) != module:
            continue
        if isinstance(member, FunctionType):
            yield member
        elif isinstance(member, type):
            yield from functions_of(member, module)


def codes(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from codes(constant)


def kernels_in(function: FunctionType) -> Iterator[Dispatcher]:
    """Yield the kernels whose names occur in a function, as globals or after modules."""
    for code in codes(function.__code__):
        known = [function.__globals__.get(name) for name in code.co_names]
        spaces = [vars(value) for value in known if isinstance(value, ModuleType)]
        in_modules = itertools.chain.from_iterable(
            map(space.get, code.co_names) for space in spaces)
        for value in itertools.chain(known, in_modules):
            if isinstance(value, Dispatcher):
                yield value


def called_from_python() -> set[str]:
    names = {id(kernel): name for name, kernel in jit._registered.items()}
    return {names[id(kernel)] for module in modules_of_core()
            for function in functions_of(module, module.__name__)
            for kernel in kernels_in(function)}


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
