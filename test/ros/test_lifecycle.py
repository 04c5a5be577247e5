# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The managed node: its states over DDS, as `ros2 lifecycle` and Nav2's manager drive them."""

from collections.abc import Iterator
from pathlib import Path
import signal

from circle import drive
from harness import Client, NodeProcess
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
import pytest


class Manager:
    """Asks for states and transitions, as a lifecycle manager does."""

    def __init__(self, client: Client) -> None:
        self._client = client
        create = client.node.create_client
        self._change = create(ChangeState, 'pose_graph/change_state')
        self._state = create(GetState, 'pose_graph/get_state')

    def change(self, transition: int) -> bool:
        request = ChangeState.Request(transition=Transition(id=transition))
        return self._client.call(self._change, request).success

    @property
    def state(self) -> int:
        return self._client.call(self._state, GetState.Request()).current_state.id


@pytest.fixture
def managed(tmp_path: Path) -> Iterator[tuple[Client, Manager]]:
    with NodeProcess(tmp_path, ('-p', 'autostart:=false')) as node:
        client = Client(int(node.env['ROS_DOMAIN_ID']))
        try:
            yield client, Manager(client)
        finally:
            client.close()
        assert node.signal_and_wait(signal.SIGINT) == 0
        assert 'Traceback' not in node.stderr()


def test_by_default_it_is_active(client: Client) -> None:
    assert Manager(client).state == State.PRIMARY_STATE_ACTIVE


def test_it_waits_for_its_manager_and_goes_through_all_states(
    managed: tuple[Client, Manager],
) -> None:
    client, manager = managed
    assert manager.state == State.PRIMARY_STATE_UNCONFIGURED
    client.spin_for(0.5)
    assert client.diagnostics == []
    assert client.odom.get_subscription_count() == 0

    assert manager.change(Transition.TRANSITION_CONFIGURE)
    assert manager.state == State.PRIMARY_STATE_INACTIVE
    client.spin_until(lambda: len(client.diagnostics) > 0, 'it tells of itself')
    assert client.values['active'] == '0'
    assert 'Inactive' in client.diagnostics[-1].status[0].message
    assert client.odom.get_subscription_count() == 0

    assert manager.change(Transition.TRANSITION_ACTIVATE)
    client.wait_for_the_node()
    drive(client, 10.0)
    assert client.optimize().success
    nodes = client.values['hidden_nodes']

    # the graph is kept while the node is inactive, and grows when it is active again
    assert manager.change(Transition.TRANSITION_DEACTIVATE)
    client.spin_until(lambda: client.odom.get_subscription_count() == 0, 'nobody listens')
    client.spin_until(lambda: client.values['active'] == '0', 'it is inactive')
    assert client.values['hidden_nodes'] == nodes
    assert manager.change(Transition.TRANSITION_ACTIVATE)
    client.wait_for_the_node()
    drive(client, 12.0, begin=10.0)
    assert client.optimize().success
    assert int(client.values['hidden_nodes']) > int(nodes)
    assert 'odom.jump' not in client.values

    # a clean-up discards it
    assert manager.change(Transition.TRANSITION_DEACTIVATE)
    assert manager.change(Transition.TRANSITION_CLEANUP)
    assert manager.state == State.PRIMARY_STATE_UNCONFIGURED
    client.spin_until(lambda: client.node.count_publishers('/diagnostics') == 0, 'it is silent')
    assert manager.change(Transition.TRANSITION_CONFIGURE)
    assert manager.change(Transition.TRANSITION_ACTIVATE)
    client.spin_until(lambda: client.values['received'] == '0', 'a new graph is started')
    client.wait_for_the_node()
    assert 'hidden_nodes' not in client.values
    drive(client, 5.0)
    assert client.optimize().success

    assert manager.change(Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert manager.state == State.PRIMARY_STATE_FINALIZED


def test_an_impossible_transition_is_answered(managed: tuple[Client, Manager]) -> None:
    _, manager = managed
    assert not manager.change(Transition.TRANSITION_ACTIVATE)
    assert not manager.change(Transition.TRANSITION_CLEANUP)
    assert manager.state == State.PRIMARY_STATE_UNCONFIGURED
    assert manager.change(Transition.TRANSITION_CONFIGURE)
    assert not manager.change(Transition.TRANSITION_CONFIGURE)
    assert manager.state == State.PRIMARY_STATE_INACTIVE


def test_what_does_not_go_together_is_mended_while_unconfigured(tmp_path: Path) -> None:
    arguments = ('-p', 'autostart:=false', '-p', 'fix.sigma_ceiling:=0.001')
    with NodeProcess(tmp_path, arguments) as node:
        client = Client(int(node.env['ROS_DOMAIN_ID']))
        manager = Manager(client)
        assert not manager.change(Transition.TRANSITION_CONFIGURE)
        assert manager.state == State.PRIMARY_STATE_UNCONFIGURED
        assert client.set_parameter('fix.sigma_ceiling', 100.0) == (True, '')
        assert client.set_parameter('fix.topic', '/odom') == (True, '')
        assert not manager.change(Transition.TRANSITION_CONFIGURE)
        assert client.set_parameter('fix.topic', '/fix') == (True, '')
        assert client.set_parameter('load_graph_on_start', value=True) == (True, '')
        assert client.set_parameter('graph_file', str(tmp_path / 'no.g2o')) == (True, '')
        (tmp_path / 'no.g2o').touch()   # without the .json beside it
        assert not manager.change(Transition.TRANSITION_CONFIGURE)
        assert client.set_parameter('load_graph_on_start', value=False) == (True, '')
        assert manager.change(Transition.TRANSITION_CONFIGURE)
        client.close()
        assert node.signal_and_wait(signal.SIGTERM) == 0
        assert 'ceiling' in node.stderr()
        assert 'no transition: parameter load_graph_on_start: ' in node.stderr()
        assert 'no.json: cannot be read' in node.stderr()
        assert 'no transition: parameter fix.topic: expected a topic of' in node.stderr()
        assert 'Traceback' not in node.stderr()
