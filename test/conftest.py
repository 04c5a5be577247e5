# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Coverage is measured in the processes that run tests, and not in the nodes that these start.

Nodes would take twice as long under a tracer, and what they run has tests without a process. A
long test repeats the same lines, so it is traced at its beginning alone. The folder ros is left
out of this, as its tests use signals themselves; those marked `untraced` have no tracer at all.
"""

from collections.abc import Iterator
from contextlib import suppress
import importlib
import os
import pkgutil
import signal
import sys

import pytest

import pose_graph_ros

OTHERS = ('numba', 'scipy.optimize', 'hypothesis', 'matplotlib', 'rosbags.highlevel', 'rclpy.node')
"""Modules whose imports take long."""
TRACED = 0.25
"""Time of the processor for which a test is traced [s]."""

if 'PYTEST_XDIST_WORKER' in os.environ:
    os.environ.pop('COVERAGE_PROCESS_CONFIG', None)


@pytest.hookimpl(hookwrapper=True)
def pytest_collection() -> Iterator[None]:
    """Trace the imports of our modules, and not those of others nor what pytest does."""
    tracer = sys.gettrace()
    if tracer is not None:
        sys.settrace(None)
        for name in OTHERS:
            _import(name)
        sys.settrace(tracer)
        for module in pkgutil.walk_packages(pose_graph_ros.__path__, 'pose_graph_ros.'):
            _import(module.name)
        sys.settrace(None)
    yield
    sys.settrace(tracer)


def _import(name: str) -> None:
    with suppress(ImportError):
        importlib.import_module(name)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files that wait for other processes, so that none of them is the last."""
    items.sort(key=lambda item: item.path.parent.name not in ('ros', 'test'))


@pytest.fixture(autouse=True)
def _tracer(request: pytest.FixtureRequest) -> Iterator[None]:
    tracer = sys.gettrace()
    if tracer is None:
        yield
        return
    if request.node.get_closest_marker('untraced') is not None:
        sys.settrace(None)
    elif request.path.parent.name != 'ros':
        signal.signal(signal.SIGVTALRM, lambda *_: sys.settrace(None))
        signal.setitimer(signal.ITIMER_VIRTUAL, TRACED)
    yield
    signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
    sys.settrace(tracer)
