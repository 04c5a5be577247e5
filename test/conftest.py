# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Coverage is measured in the processes that run tests, and not in the nodes that these start.

Nodes would take twice as long under a tracer, and what they run has tests without a process. A
long test repeats the same lines, and so do the cases of one that is parametrized: each function is
traced for a while only, all its cases together. In the folder ros it is the threads of a file
that are traced for a while only. Those marked `untraced`, as all with a node in another process,
have no tracer at all.
"""

from collections.abc import Iterator
from contextlib import suppress
import importlib
import os
import pkgutil
import signal
import sys
import threading
import time

import pytest

import pose_graph_ros

OTHERS = ('numba', 'scipy.optimize', 'hypothesis', 'matplotlib', 'rosbags.highlevel', 'rclpy.node')
"""Modules whose imports take long."""
TRACED, TRACED_THREADS = 0.2, 6.0
"""Time of the processor for which a function is traced, and the threads of a file [s]."""

_left: dict[object, float] = {}
"""Rest of that time, by file or function."""

if 'PYTEST_XDIST_WORKER' in os.environ:
    os.environ.pop('COVERAGE_PROCESS_CONFIG', None)


@pytest.hookimpl(hookwrapper=True)
def pytest_collection(session: pytest.Session) -> Iterator[None]:
    """Trace the imports of our modules, and not those of others nor what pytest does."""
    tracer, config = sys.gettrace(), session.config
    distributes = config.getoption('numprocesses', None) and not hasattr(config, 'workerinput')
    if tracer is not None and not distributes:
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
    """
    Let two files follow each one that waits for other processes.

    So the processors have something to do meanwhile, and none of those that wait is the last.
    """
    waiting, others = ({path: None for path in (item.path for item in items)
                        if (path.parent.name in ('ros', 'test')) is waits}
                       for waits in (True, False))
    turns = {path: 2 * turn for turn, path in enumerate(waiting)}
    turns |= {path: turn | 1 for turn, path in enumerate(others)}
    items.sort(key=lambda item: turns[item.path])


@pytest.fixture(autouse=True)
def _tracer(request: pytest.FixtureRequest) -> Iterator[None]:
    tracer, threads = sys.gettrace(), threading.gettrace()
    if tracer is None:
        yield
        return

    def stop(*_: object) -> None:
        sys.settrace(None)
        threading.settrace(None)

    in_process = request.path.parent.name == 'ros'
    key = request.path if in_process else (request.path, request.cls, request.function.__name__)
    left = _left.get(key, TRACED_THREADS if in_process else TRACED)
    began = time.process_time()
    if request.node.get_closest_marker('untraced') is not None:
        stop()
    elif in_process:
        if left <= 0.0:
            threading.settrace(None)
    elif left <= 0.0:
        stop()
    else:
        signal.signal(signal.SIGVTALRM, stop)
        signal.setitimer(signal.ITIMER_VIRTUAL, left)
    yield
    signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
    _left[key] = left - (time.process_time() - began)
    threading.settrace(threads)
    sys.settrace(tracer)
