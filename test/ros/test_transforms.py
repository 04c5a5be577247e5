# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The transform from map to odom over DDS: stamps, speed, and other publishers of it."""

from pathlib import Path
import signal

from circle import drive, odometry_at, odometry_pose, START, true_pose
from harness import (
    Client,
    NodeProcess,
    odometry,
    pose,
    RELIABLE,
    stamp_ns,
    TFMessage,
    transform,
    yaw,
)
import numpy as np
import pytest

from pose_graph_ros.core.geometry import se2

pytestmark = pytest.mark.skipif(
    TFMessage is None, reason='tf2_msgs is not built: no /tf')


def broadcast(parent: str, child: str, seconds: float) -> object:
    return TFMessage(transforms=[transform(parent, child, seconds=START + seconds)])


def corrections(client: Client) -> np.ndarray:
    """Return stamp [s] and pose of the odometry frame in the map, shape (N, 4)."""
    return np.array([
        (stamp_ns(item) * 1e-9 - START, item.transform.translation.x,
         item.transform.translation.y, yaw(item.transform.rotation))
        for item in client.transforms if item.header.frame_id == 'map'])


@pytest.mark.parametrize('node', [
    ('-p', 'transform_time_offset:=0.5', '-p', 'odom_frame:=wheels', '-p', 'map_frame:=world'),
], indirect=True)
def test_frames_and_offset_are_as_asked(node: NodeProcess, client: Client) -> None:
    for step in range(50):
        message = odometry_at(step / 10.0)
        message.header.frame_id = '/wheels'
        client.odom.publish(message)
        client.spin_for(0.01)
    client.wait_processed(50)
    # the stamp of a transform is ahead by the offset
    client.wait_answered(START + 4.9)
    client.spin_until(lambda: stamp_ns(client.transforms[-1]) >= (START + 5.4) * 1e9, 'it comes')
    assert len(client.transforms) > 40
    assert {(item.header.frame_id, item.child_frame_id) for item in client.transforms} == {
        ('world', 'wheels')}
    last = stamp_ns(client.poses[-1])
    assert stamp_ns(client.transforms[-1]) == last + 500_000_000
    assert np.all(np.diff([stamp_ns(item) for item in client.transforms]) > 0)


def test_the_same_stamp_is_never_sent_twice(client: Client) -> None:
    drive(client, 5.0)
    for seconds in (4.9, 4.9, 4.8, 4.7, 4.9):
        client.odom.publish(odometry_at(seconds))
        client.spin_for(0.02)
    client.optimize()
    drive(client, 6.0, begin=5.0)
    stamps = [stamp_ns(item) for item in client.transforms]
    assert np.all(np.diff(stamps) > 0)


def test_the_published_transform_moves_no_faster_than_asked(tmp_path: Path) -> None:
    # a single pose that contradicts odometry would be doubted
    limits = ('-p', 'transform_slew_linear:=0.5', '-p', 'transform_slew_angular:=0.1',
              '-p', 'global_pose.robust:=loss')
    with NodeProcess(tmp_path, limits) as node, \
            Client(int(node.env['ROS_DOMAIN_ID'])) as client:
        drive(client, 10.0)
        assert client.optimize().success
        client.wait_answered(START + 9.9)
        client.transforms.clear()
        # from here on the odometry turns too much, which a later pose corrects
        odometry_of = {}
        newest = odometry_pose(9.9)
        for step in range(100, 300):
            seconds = step / 10.0
            motion = se2.between(true_pose(seconds - 0.1), true_pose(seconds))
            newest = se2.compose(newest, motion + np.array([0.0, 0.0, 0.01]))
            odometry_of[step] = newest
            client.odom.publish(odometry(START + seconds, *newest.tolist(), speed=2.0))
            if step == 200:
                updates = int(client.values['updates'])
                client.global_pose.publish(pose(START + seconds, *true_pose(seconds).tolist()))
                client.spin_until(lambda n=updates: int(client.values['updates']) > n, 'it counts')
            client.wait_answered(START + seconds)
        client.spin_until(lambda: len(client.transforms) > 190, 'all of them come')
        found = corrections(client)
        shown, wanted = (np.array([
            se2.compose(row[1:], odometry_of[round(10.0 * row[0])]) for row in rows])
            for rows in (found, found[-1:]))
        moved = np.hypot(*np.diff(shown[:, :2], axis=0).T) / np.diff(found[:, 0])
        # the robot's own 2 m/s and half a metre a second more or less
        assert np.max(np.abs(moved - 2.0)) < 0.51
        assert np.max(np.abs(moved - 2.0)) > 0.4
        # at the end the estimate is still elsewhere
        estimate = client.poses[-1].pose.pose.position
        assert np.hypot(estimate.x - wanted[0, 0], estimate.y - wanted[0, 1]) > 0.2


def test_it_is_not_sent_when_it_is_not_wanted(client: Client) -> None:
    drive(client, 3.0)
    client.wait_answered(START + 2.9)
    assert client.set_parameter('publish_tf', value=False) == (True, '')
    client.transforms.clear()
    drive(client, 5.0, begin=3.0)
    assert client.transforms == []
    client.spin_until(lambda: client.node.count_publishers('/tf') == 0, 'nobody publishes it')
    assert client.set_parameter('publish_tf', value=True) == (True, '')
    client.spin_until(lambda: client.node.count_publishers('/tf') == 1, 'it is published')
    drive(client, 6.0, begin=5.0)
    client.spin_until(lambda: len(client.transforms) > 5, 'transforms come')


def test_another_publisher_of_it_is_warned_of(node: NodeProcess, client: Client) -> None:
    broadcaster = client.node.create_publisher(TFMessage, '/tf', RELIABLE)
    drive(client, 4.0)
    for step in range(40):
        # other transforms of the robot are no conflict
        broadcaster.publish(broadcast('odom', 'base_link', 4.0 + 0.1 * step))
        client.spin_for(0.01)
    client.spin_for(0.5)
    assert 'publishes' not in client.diagnostics[-1].status[0].message
    # a new publisher is listened to at once, and one that is known already only now and then
    other = client.node.create_publisher(TFMessage, '/tf', RELIABLE)

    def warned() -> bool:
        other.publish(broadcast('map', 'odom', 10.0))
        return 'nother node publishes map -> odom' in client.diagnostics[-1].status[0].message
    client.spin_until(warned, 'it warns')
    assert client.diagnostics[-1].status[0].level == b'\x01'


def test_without_tf2_msgs_it_warns_once_and_all_else_runs(tmp_path: Path) -> None:
    program = ("import sys; sys.modules['tf2_msgs'] = None\n"
               'from pose_graph_ros.ros.main import main; sys.exit(main())')
    with NodeProcess(tmp_path, program=('-c', program)) as node:
        with Client(int(node.env['ROS_DOMAIN_ID'])) as client:
            drive(client, 6.0)
            assert client.optimize().success
            client.spin_until(lambda: len(client.poses) > 50, 'poses come')
            assert client.transforms == []
            assert client.set_parameter('publish_tf', value=False) == (True, '')
        assert node.signal_and_wait(signal.SIGINT) == 0
        assert node.stderr().count('tf2_msgs is not installed') == 1
        assert 'Traceback' not in node.stderr()
