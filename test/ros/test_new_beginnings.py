# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What begins a new graph in the real node, and how the one before comes back."""

from circle import drive, odometry_at, path_error, START
from harness import Client, NodeProcess, RELIABLE
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock


def path(client: Client) -> np.ndarray:
    """Return the newest path as it was published."""
    return np.array([[each.pose.position.x, each.pose.position.y, each.pose.orientation.z]
                     for each in client.paths[-1].poses])


def publisher(client: Client) -> Publisher:
    made = client.node.create_publisher(Odometry, 'odom', RELIABLE)
    client.spin_until(lambda: made.get_subscription_count() > 0, 'it is heard')
    client.wait_matched()
    return made


def send(sender: Publisher, begin: float) -> None:
    """Publish two seconds of odometry at once."""
    for step in range(20):
        sender.publish(odometry_at(begin + 0.1 * step))


@pytest.mark.parametrize('who', ['who sent all before', 'one beside who goes on'])
def test_a_burst_of_old_stamps_is_refused_and_changes_nothing(client: Client, who: str) -> None:
    drive(client, 8.0, paced=True)
    before = client.values
    sender = client.odom if who.startswith('who') else publisher(client)
    send(sender, 3.0)
    client.wait_received(sender)
    drive(client, 10.0, begin=8.0, paced=True)
    client.wait_values({'odom.accepted': '100', 'odom.stamp_leap': '20',
                        'resets': before['resets'], 'reset_reason': before['reset_reason']})
    assert client.optimize().success
    assert path_error(client) < 1e-3


@pytest.mark.parametrize('way', ['~/reset', 'the clock', 'another publisher'])
@pytest.mark.parametrize('node', [('-p', 'use_sim_time:=true')], indirect=True, ids=[''])
def test_the_graph_before_a_new_beginning_is_brought_back_and_goes_on(
    node: NodeProcess, client: Client, way: str,
) -> None:
    clock = client.node.create_publisher(Clock, '/clock', RELIABLE)
    client.spin_until(lambda: clock.get_subscription_count() > 0, 'the clock is heard')
    client.wait_matched()
    message = Clock()
    message.clock.sec = int(START + 8.0)
    clock.publish(message)
    drive(client, 8.0)
    assert client.optimize().success
    before, was = path(client), client.values
    assert 'undo' not in was

    if way == '~/reset':
        assert '~/undo_reset' in client.trigger('reset').message
    elif way == 'the clock':
        message.clock.sec = int(START)
        clock.publish(message)
    else:
        client.node.destroy_publisher(client.odom)
        client.odom = publisher(client)
        # a robot goes on sending, and each message is judged by who publishes at that moment
        for step in range(70):
            client.odom.publish(odometry_at(0.1 * step))
            client.spin_for(0.05)
            if client.values['resets'] == '1':
                break
    client.wait_values({'resets': '1', 'undo': f'{was["hidden_nodes"]} hidden nodes, by '
                        '~/undo_reset'})
    assert any(word in client.values['reset_reason'] for word in (way, 'odom jumped back by 7.9'))
    client.spin_until(lambda: len(client.paths[-1].poses) != len(before), 'it is taken back')

    assert client.trigger('undo_reset').message.startswith(f'{was["hidden_nodes"]} hidden nodes')
    client.spin_until(lambda: len(client.paths[-1].poses) == len(before), 'the path is back')
    np.testing.assert_allclose(path(client), before, rtol=0.0, atol=1e-9)
    client.wait_values({'datum': was['datum'], 'resets': '2'})
    drive(client, 10.0, begin=8.0)
    drive(client, 12.0, begin=10.0, paced=True)
    client.wait_values({'odom.accepted': '120', 'fix.accepted': '24', 'alignment': 'aligned'})
    assert client.optimize().success
    assert len(path(client)) > len(before)
    assert path_error(client) < 1e-3
    assert 'Traceback' not in node.stderr()


def test_two_resets_are_undone_once(client: Client) -> None:
    drive(client, 4.0)
    assert client.optimize().success    # so that the estimate has all of it
    nodes = client.values['hidden_nodes']
    for _ in range(2):
        assert f'{nodes} hidden nodes, by ~/undo_reset' in client.trigger('reset').message
    assert client.trigger('undo_reset').message == f'{nodes} hidden nodes are back'
    answer = client.trigger('undo_reset')
    assert (answer.success, answer.message[:8]) == (False, 'refused:')
    client.wait_current()
    client.wait_values({'hidden_nodes': nodes})
    assert 'undo' not in client.values
