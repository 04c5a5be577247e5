# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fixtures of this folder; those that need ROS 2 import `harness`."""

from collections.abc import Iterator
import os
from pathlib import Path
from typing import Any

import pytest


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
    from harness import NodeProcess  # noqa: PLC0415  (needs ROS, which other tests do not)

    with NodeProcess(tmp_path, getattr(request, 'param', ())) as process:
        yield process


@pytest.fixture
def client(node: Any) -> Iterator[Any]:
    from harness import Client  # noqa: PLC0415

    with Client(int(node.env['ROS_DOMAIN_ID'])) as connected:
        yield connected


@pytest.fixture(scope='module')
def _one_node(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    from harness import Client, NodeProcess  # noqa: PLC0415

    with NodeProcess(tmp_path_factory.mktemp('node')) as process, \
            Client(int(process.env['ROS_DOMAIN_ID'])) as connected:
        yield connected
        assert 'Traceback' not in process.stderr()


@pytest.fixture
def shared(_one_node: Any) -> Any:
    """A client of the node that the tests of a module share, with a new graph."""
    _one_node.start_new_graph()
    return _one_node
