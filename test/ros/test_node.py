# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The real node, driven over DDS by an independent process: this one."""

from contextlib import ExitStack
import ctypes
import math
from pathlib import Path
import signal

from circle import (
    check_pose,
    drive,
    fix_at,
    odometry_at,
    odometry_pose,
    path_error,
    START,
    true_pose,
)
from geometry_msgs.msg import PoseWithCovarianceStamped
from harness import (
    Client,
    LATCHED,
    NodeProcess,
    PATIENCE,
    pose,
    RELIABLE,
    stamp_ns,
    TFMessage,
    yaw,
)
import numpy as np
import pytest
from rcl_interfaces.msg import Log
from rclpy.qos import QoSDurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool
from visualization_msgs.msg import Marker, MarkerArray

from pose_graph_ros.core.geometry import se2


def test_every_message_of_a_drive_is_sound(client: Client) -> None:
    rosout: list[Log] = []
    # what is logged before both sides match comes, too
    client.node.create_subscription(Log, '/rosout', rosout.append, QoSProfile(
        depth=100, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL))
    assert client.node.count_subscribers('imu/data') == 0, 'not listened to unasked'
    (heard,) = client.node.get_subscriptions_info_by_topic('/odom')
    assert heard.qos_profile.reliability.name == 'BEST_EFFORT', 'matches every sender'

    drive(client, 20.0, paced=True)
    assert client.optimize().success
    client.wait_values({'alignment': 'aligned', 'odom.accepted': '200', 'fix.accepted': '40'})
    poses, filtered = client.poses, client.filtered
    for messages in (poses, filtered, client.fixes, client.transforms):
        assert np.all(np.diff([stamp_ns(message) for message in messages]) > 0)
    assert len(poses) == len(filtered) == 196
    for message in (*poses, *filtered):
        assert message.header.frame_id == 'map'
        check_pose(message.pose)
    assert {message.child_frame_id for message in filtered} == {'base_link'}
    assert {message.twist.twist.linear.x for message in filtered} == {2.0}
    newest, wanted = poses[-1].pose.pose.position, true_pose(stamp_ns(poses[-1]) * 1e-9 - START)
    assert math.hypot(newest.x - wanted[0], newest.y - wanted[1]) < 0.1

    by_stamp = {stamp_ns(message): message.pose.pose.position for message in poses}
    compared = [item for item in client.transforms if stamp_ns(item) in by_stamp]
    assert len(compared) > 100 or TFMessage is None
    for item in compared:
        assert (item.header.frame_id, item.child_frame_id) == ('map', 'odom')
        shift = item.transform.translation
        place = se2.compose(np.array([shift.x, shift.y, yaw(item.transform.rotation)]),
                            odometry_pose(stamp_ns(item) * 1e-9 - START))
        position = by_stamp[stamp_ns(item)]
        assert (position.x, position.y) == pytest.approx(place[:2], abs=1e-5)

    path = client.paths[-1]
    assert np.all(np.diff([stamp_ns(item) for item in path.poses]) > 0)
    assert path_error(client) < 1e-3
    with Client(client.domain) as late:
        late.spin_until(lambda: len(late.paths) > 0, 'the latched path comes')
        assert len(late.paths[-1].poses) == len(path.poses)

    client.fix.publish(fix_at(1.0))     # a second time: the thread of the engine says so
    client.spin_until(lambda: any('fix: duplicate' in line.msg for line in rosout), 'it is told')
    (line,) = [line for line in rosout if line.msg.startswith('fix: ')]
    assert (line.name, line.level) == ('pose_graph', Log.WARN)

    # 20 s of odometry at once, without a pause between two messages
    for step in range(200, 400):
        client.odom.publish(odometry_at(step / 10.0))
    client.wait_values({'odom.accepted': '400'})
    assert client.trigger('reset').success
    client.spin_until(lambda: len(client.paths[-1].poses) == 0, 'the path is taken back')


def test_poses_and_closures_are_heard_and_services_answer(client: Client) -> None:
    setter = client.node.create_publisher(PoseWithCovarianceStamped, 'initialpose', RELIABLE)
    arrays: list[MarkerArray] = []
    client.node.create_subscription(MarkerArray, 'graph', arrays.append, LATCHED)
    client.wait_matched()
    client.spin_until(lambda: setter.get_subscription_count() > 0, 'it is heard')
    assert client.trigger('optimize').message == 'there is no odometry yet'
    for count in ('1', '2'):    # a person is answered each time; of two at once the newer counts
        setter.publish(pose(START, 0.0, 0.0, 0.0, frame='elsewhere'))
        client.wait_values({'set_pose.wrong_frame': count})

    client.global_pose.publish(pose(START + 1.0, *true_pose(1.0).tolist()))
    drive(client, 10.0, fixes=False)
    seen = se2.between(true_pose(0.5), true_pose(9.0))
    for frame in (f'@{START + 0.5:.9f}', 'x9999', 'base_link'):
        client.loop_closure.publish(pose(START + 9.0, *seen.tolist(), frame=frame))
    client.wait_values({
        'alignment': 'aligned', 'global_pose.accepted': '1', 'loop_closure.accepted': '1',
        'loop_closure.unknown_node': '1', 'loop_closure.wrong_frame': '1'})
    assert client.optimize().success
    assert path_error(client) < 1e-3
    nodes = client.values['hidden_nodes']

    client.spin_until(lambda: len(arrays) > 0 and any(
        marker.ns == 'loop_closures' for marker in arrays[-1].markers), 'markers come')
    markers = {marker.ns: marker for marker in arrays[-1].markers}
    assert markers[''].action == Marker.DELETEALL
    assert len(markers['hidden_nodes'].points) > 10

    pause = client.node.create_client(SetBool, 'pose_graph/pause')
    assert client.call(pause, SetBool.Request(data=True)).message.startswith('paused')
    count = len(client.poses)
    drive(client, 13.0, begin=10.0, fixes=False, paced=True)
    assert len(client.poses) - count >= 30, 'the outputs go on'
    client.wait_values({'odom.paused': '30', 'hidden_nodes': nodes})
    assert client.call(pause, SetBool.Request(data=False)).success

    wanted = np.array([100.0, -40.0, 2.0])
    setter.publish(pose(START + 9.9, *se2.between(true_pose(9.9), wanted).tolist(),
                        frame='base_link', variances=(0.04, 0.04, 0.01)))
    client.wait_values({'set_pose.accepted': '1'})
    drive(client, 14.0, begin=13.0, fixes=False, paced=True)
    newest = client.poses[-1].pose.pose.position
    expected = se2.compose(wanted, se2.between(true_pose(9.9), true_pose(13.9)))
    assert math.hypot(newest.x - expected[0], newest.y - expected[1]) < 1.0


@pytest.mark.parametrize(
    'node', [('-p', 'use_sim_time:=true', '-p', 'datum:=[48.1, 11.6]')], indirect=True)
def test_loops_of_a_bag_with_its_clock(node: NodeProcess, client: Client) -> None:
    clock = client.node.create_publisher(Clock, '/clock', RELIABLE)
    client.spin_until(lambda: clock.get_subscription_count() > 0, 'the clock is heard')

    def set_clock(seconds: float) -> None:
        message = Clock()
        message.clock.sec = int(START + math.floor(seconds))
        message.clock.nanosec = round(1e9 * (seconds % 1.0))
        clock.publish(message)
        client.wait_received(clock)

    for loop in range(3):
        set_clock(0.0)
        client.wait_values({'resets': str(loop)})
        if loop > 0:
            assert 'clock jumped back' in client.values['reset_reason']
            client.spin_until(lambda: len(client.paths[-1].poses) == 0, 'the path is taken back')
        drive(client, 4.0)
        # small corrections and jumps forward change nothing
        for seconds in (4.0, 3.2, 4.1, 400.0, 399.5):
            set_clock(seconds)
        drive(client, 8.0, begin=4.0)
        assert client.optimize().success
        client.wait_values({'odom.accepted': '80', 'resets': str(loop)})
        assert stamp_ns(client.paths[-1].poses[0]) == round(START * 1e9)
        assert path_error(client) < 1e-3


def test_a_signal_that_any_thread_gets_ends_the_node_without_a_traceback(
    node: NodeProcess, client: Client,
) -> None:
    drive(client, 3.0)
    process = node.process.pid
    newest = max(int(path.name) for path in Path(f'/proc/{process}/task').iterdir())
    ctypes.CDLL(None).tgkill(process, newest, signal.SIGINT)
    assert node.signal_and_wait(signal.SIGTERM) == 0
    assert 'Traceback' not in node.stderr()


BAD = (
    ('-p map_frame:=3', 'map_frame'),
    ('-p qos_overrides./odom.subscription.reliability:=bestefort', 'best_effort'),
    ('--params-file /no/such.yaml', ''))


def test_a_bad_argument_is_one_sentence_and_no_traceback(tmp_path: Path) -> None:
    with ExitStack() as stack:
        nodes = []
        for k, (arguments, _) in enumerate(BAD):
            (tmp_path / str(k)).mkdir()
            nodes.append(stack.enter_context(NodeProcess(tmp_path / str(k), arguments.split())))
        assert [node.process.wait(PATIENCE) for node in nodes] == [2] * len(nodes)
        for node, (_, expected) in zip(nodes, BAD, strict=True):
            assert 'Traceback' not in node.stderr()
            if expected != '':  # else the words are those of rcl
                (line,) = node.stderr().splitlines()
                assert expected in line
            assert 'pose_graph_node: ' in node.stderr()
