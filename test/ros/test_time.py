# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Clocks that jump, bags in a loop and at ten times their speed: the real node over DDS."""

import math

from circle import drive, fix_at, odometry_at, path_error, START
from diagnostic_msgs.msg import DiagnosticStatus
from harness import Client, NodeProcess, RELIABLE, stamp_ns
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from rosgraph_msgs.msg import Clock

LOOPS = 5
DATUM = ('-p', 'datum:=[48.1, 11.6]')


def set_clock(publisher: object, seconds: float) -> None:
    message = Clock()
    sec, nanosec = divmod(round((START + seconds) * 1e9), 1_000_000_000)
    message.clock.sec, message.clock.nanosec = sec, nanosec
    publisher.publish(message)


def publish_lap(client: Client) -> None:
    """Publish 8 s of the drive without waiting for the node."""
    for step in range(80):
        client.odom.publish(odometry_at(step / 10.0))
        if step % 5 == 0:
            client.fix.publish(fix_at(step / 10.0))
        client.spin_for(0.003)


def check_one_lap(client: Client, path_begins_at: float = 0.0) -> None:
    """Check that the graph is that of one lap, without measurements of earlier ones."""
    answer = client.optimize()
    assert answer.success, answer.message
    path = client.paths[-1]
    stamps = np.array([stamp_ns(item) for item in path.poses])
    assert np.all(np.diff(stamps) > 0)
    assert stamps[0] == pytest.approx((START + path_begins_at) * 1e9, abs=1e3)
    assert path_error(client) < 1e-3


@pytest.mark.parametrize('node', [('-p', 'use_sim_time:=true', *DATUM)], indirect=True)
def test_loops_of_a_bag_with_its_clock(node: NodeProcess, client: Client) -> None:
    clock = client.node.create_publisher(Clock, '/clock', RELIABLE)
    client.spin_until(lambda: clock.get_subscription_count() > 0, 'the clock is heard')
    datum = client.values['datum']
    for loop in range(LOOPS):
        set_clock(clock, 0.0)
        if loop > 0:
            client.spin_until(lambda n=loop: client.values['resets'] == str(n), 'a new graph')
            assert 'clock jumped back' in client.values['reset_reason']
            client.spin_until(lambda: len(client.paths[-1].poses) == 0, 'the path is taken back')
        client.poses.clear()
        client.transforms.clear()
        drive(client, 4.0)
        set_clock(clock, 4.0)
        drive(client, 8.0, begin=4.0)
        set_clock(clock, 8.0)
        check_one_lap(client)
        # those of this lap must not come in the next one
        client.wait_answered(START + 7.9)
        for messages in (client.poses, client.transforms):
            assert np.all(np.diff([stamp_ns(message) for message in messages]) > 0)
        # nothing is counted of the laps before
        assert client.values['odom.accepted'] == '80'
        assert client.values['datum'].split(',')[:2] == datum.split(',')[:2]
    assert client.values['resets'] == str(LOOPS - 1)


def test_loops_of_a_bag_without_a_clock(node: NodeProcess, client: Client) -> None:
    for loop in range(LOOPS):
        publish_lap(client)
        if loop > 0:
            client.spin_until(lambda n=loop: client.values['resets'] == str(n), 'a new graph')
        client.spin_until(lambda: client.values.get('odom.accepted') == '80', 'all are heard')
        check_one_lap(client)
        assert client.values['odom.accepted'] == '80'
        assert int(client.values['fix.accepted']) >= 15
    assert 'jumped back' in client.values['reset_reason']


@pytest.mark.parametrize('node', [('-p', 'use_sim_time:=true', *DATUM)], indirect=True)
def test_small_corrections_and_jumps_forward_of_the_clock_change_nothing(
    node: NodeProcess, client: Client,
) -> None:
    clock = client.node.create_publisher(Clock, '/clock', RELIABLE)
    client.spin_until(lambda: clock.get_subscription_count() > 0, 'the clock is heard')
    set_clock(clock, 0.0)
    drive(client, 4.0)
    for seconds in (4.0, 3.2, 4.1, 3.9, 4000.0, 3999.5):
        set_clock(clock, seconds)
        client.spin_for(0.05)
    drive(client, 8.0, begin=4.0)
    check_one_lap(client)
    assert client.values['resets'] == '0'


def test_a_single_stamp_of_the_past_or_the_future_changes_nothing(client: Client) -> None:
    resets = client.values['resets']
    drive(client, 4.0)
    for seconds in (-100.0, 20.0, 2000.0, 1.0):
        client.odom.publish(odometry_at(seconds))
        client.spin_for(0.02)
    client.wait_processed(48 + 4)
    drive(client, 25.0, begin=4.0)
    assert client.values['resets'] == resets
    assert client.optimize().success


def test_bad_stamps_and_messages_that_are_not_finite_neither_stop_the_node_nor_wipe_the_map(
    client: Client,
) -> None:
    resets = client.values['resets']
    drive(client, 4.0)
    for away in (-1000.0, -2000.0, -3000.0, -4000.0, -5000.0, 5000.0, 5001.0, 5002.0):
        client.odom.publish(odometry_at(4.0 + away))
        client.spin_for(0.02)
    client.wait_processed(48 + 8)
    drive(client, 6.0, begin=4.0)
    for step in range(40):
        message = odometry_at(0.1 * step)
        message.pose.pose.position.x = math.nan
        client.odom.publish(message)
        client.spin_for(0.01)
    drive(client, 12.0, begin=6.0)
    check_one_lap(client)
    values = client.values
    assert (values['odom.accepted'], values['resets']) == ('120', resets)
    assert (values['odom.stamp_leap'], values['odom.not_finite']) == ('8', '40')
    client.wait_answered(START + 11.9)


@pytest.mark.parametrize('node', [(
    *DATUM, '-p', 'sources:=[odom, visual, fix]', '-p', 'visual.type:=odometry')], indirect=True)
@pytest.mark.parametrize('seconds', [30, 3600])
def test_a_second_odometry_that_is_ahead_does_not_take_over(
    node: NodeProcess, seconds: int,
) -> None:
    with Client(int(node.env['ROS_DOMAIN_ID']), listens=('odom', 'fix'),
                more={'visual': Odometry}) as client:
        for step in range(200):
            ahead = odometry_at(0.1 * step)
            ahead.header.stamp.sec += seconds
            # the one that is wrong may be heard first
            client.more['visual'].publish(ahead)
            client.spin_for(0.005)
            client.odom.publish(odometry_at(0.1 * step))
            if step % 5 == 0:
                client.fix.publish(fix_at(0.1 * step))
            client.spin_for(0.005)
        client.wait_answered(START + 19.9)
        assert int(client.values['resets']) <= 1
        assert client.values['odometry'] == 'odom'
        assert float(client.values['visual.delay_s']) == pytest.approx(-seconds, abs=0.5)
        assert client.optimize().success
        assert path_error(client) < 1e-3
        assert client.diagnostics[-1].status[0].level == DiagnosticStatus.WARN
        assert 'of visual were refused' in client.diagnostics[-1].status[0].message
        assert 'ahead of the stamps of odom' in client.diagnostics[-1].status[0].message


def test_fixes_that_are_stamped_with_gps_time_are_told(client: Client) -> None:
    for step in range(100):
        client.odom.publish(odometry_at(0.1 * step))
        if step % 5 == 0:
            ahead = fix_at(0.1 * step)
            ahead.header.stamp.sec += 18
            client.fix.publish(ahead)
        client.spin_for(0.005)
    client.wait_level(DiagnosticStatus.WARN)
    client.spin_until(
        lambda: 'The stamps of fix are 18.0 s ahead' in client.diagnostics[-1].status[0].message,
        'the stamps are named')
    assert float(client.values['fix.delay_s']) == pytest.approx(-18.0, abs=0.5)
    assert 'fix.time_offset' in client.diagnostics[-1].status[0].message


def test_a_drive_at_many_times_its_speed_is_not_lost(client: Client) -> None:
    """Ten messages a millisecond: 20 s within a fraction of one."""
    for step in range(200):
        client.odom.publish(odometry_at(step / 10.0))
    client.wait_processed(200)
    assert client.values['odom.accepted'] == '200'
    assert client.optimize().success
    assert len(client.paths[-1].poses) > 19
