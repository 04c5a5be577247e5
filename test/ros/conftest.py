# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the tests of this folder share; those that need ROS 2 import `harness`."""

from collections.abc import Iterator
import os
from pathlib import Path
import sys
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(autouse=True, scope='session')
def _on_this_machine_alone(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The client of a test must not be heard outside, nor write into the home folder."""
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
        # the name that Fast DDS has for it in Jazzy, and a later one
        for name in ('FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE'):
            environment.setenv(name, str(Path(__file__).parent / 'discovery.xml'))
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
    """A client of a node that other tests of the module had before, which began anew."""
    _one_node.begin_anew()
    return _one_node
