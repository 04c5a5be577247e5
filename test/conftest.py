# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Coverage is measured in the processes that run tests, and not in the nodes that these start.

Nodes would take twice as long under a tracer, and what they run has tests without a process.
Tests that repeat the same lines a thousand times are marked `untraced` and run without it too.
"""

from collections.abc import Iterator
import os
import sys

import pytest

if 'PYTEST_XDIST_WORKER' in os.environ:
    os.environ.pop('COVERAGE_PROCESS_CONFIG', None)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files that wait for other processes, so that none of them is the last."""
    items.sort(key=lambda item: item.path.parent.name not in ('ros', 'test'))


@pytest.fixture(autouse=True)
def _without_tracer(request: pytest.FixtureRequest) -> Iterator[None]:
    tracer = sys.gettrace()
    if request.node.get_closest_marker('untraced') is None:
        yield
        return
    sys.settrace(None)
    yield
    sys.settrace(tracer)
