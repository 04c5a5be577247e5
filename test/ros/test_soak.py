# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The soak over DDS in short: a drive after each disturbance; `make soak` does it for an hour."""

from pathlib import Path

from circle import drive
from harness import Client, NodeProcess
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState

SECONDS = 8.0
SENT = round(SECONDS * (10 + 2))    # odometry at 10 Hz and fixes at 2 Hz


def restart(client: Client) -> None:
    """Deactivate and activate the node; its graph goes on, so the next drive is a later one."""
    change = client.node.create_client(ChangeState, 'pose_graph/change_state')
    for step in (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_ACTIVATE):
        request = ChangeState.Request(transition=Transition(id=step))
        assert client.call(change, request).success
    client.diagnostics.clear()
    client.wait_for_the_node()


def test_after_disturbances_all_is_received_and_nothing_is_logged_of_messages(
    tmp_path: Path,
) -> None:
    arguments = ['-p', f'state_file:={tmp_path / "state.db"}', '-p', 'closing_silence:=0.0']
    with NodeProcess(tmp_path, arguments) as node, \
            Client(int(node.env['ROS_DOMAIN_ID'])) as client:
        begin = 0.0
        for disturb in (lambda: None, client.start_new_graph, lambda: restart(client),
                        lambda: client.set_parameter('frequency', 20.0)):
            disturb()
            client.wait_current()
            lines, received = node.stderr().count('\n'), int(client.values['received'])
            drive(client, begin + SECONDS, begin=begin)
            client.wait_current()
            assert int(client.values['received']) - received == SENT
            assert node.stderr().splitlines()[lines:] == []
            begin += SECONDS
