# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fixtures of this folder; those that need ROS 2 import `harness`."""

from collections.abc import Iterator
import os
from pathlib import Path
import signal
from typing import Any

import pytest

from pose_graph_ros.core.compiled import jit
from pose_graph_ros.core.warm_up import warm_up


def pytest_collection_finish(session: pytest.Session) -> None:
    """Compile what is not in the cache before a test, whose time is limited, starts a node."""
    here = any(item.path.parent == Path(__file__).parent for item in session.items)
    if here and not session.config.option.collectonly and not jit.is_cached():
        warm_up()


@pytest.fixture(autouse=True, scope='session')
def _on_this_machine_alone(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep the nodes of the tests on this machine, and their logs out of the home folder."""
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
        # the name that Fast DDS has for it in Jazzy, and a later one
        for name in ('FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE'):
            environment.setenv(name, str(Path(__file__).parents[1] / 'helpers' / 'discovery.xml'))
        environment.setenv('ROS_LOG_DIR', str(tmp_path_factory.mktemp('ros_log')))
        assert 'ROS_LOCALHOST_ONLY' not in os.environ, 'unset it: it overrides the range'
        yield


@pytest.fixture
def node(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Any]:
    """Start a node of the test's own, with the arguments that it is parametrized with."""
    from harness import NodeProcess  # noqa: PLC0415  (needs ROS, which other tests do not)

    with NodeProcess(tmp_path, getattr(request, 'param', ())) as process:
        yield process


@pytest.fixture
def client(request: pytest.FixtureRequest) -> Iterator[Any]:
    """Yield a client of the test's own node, or else of the shared one, with a new graph."""
    from harness import Client  # noqa: PLC0415

    is_own = 'node' in request.fixturenames
    process = request.getfixturevalue('node' if is_own else '_shared_node')
    if not is_own:
        process.process.send_signal(signal.SIGCONT)
    with Client(int(process.env['ROS_DOMAIN_ID'])) as connected:
        if not is_own:
            connected.start_new_graph()
        yield connected
    if not is_own:
        assert process.process.poll() is None
        assert 'Traceback' not in process.stderr()
        # until the next test that needs it, which may be minutes away
        process.process.send_signal(signal.SIGSTOP)


@pytest.fixture(scope='session')
def _shared_node(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Start a node with the default parameters, for all tests that leave them as they are."""
    from harness import NodeProcess  # noqa: PLC0415

    with NodeProcess(tmp_path_factory.mktemp('node')) as process:
        yield process
