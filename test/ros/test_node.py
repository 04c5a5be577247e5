# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The real node, driven over DDS by an independent process: this one."""

from collections.abc import Sequence
from contextlib import ExitStack
import ctypes
import math
from pathlib import Path
import random
import signal

from circle import (
    check_pose,
    drive,
    fix_at,
    odometry_pose,
    path_error,
    PLANE,
    START,
    true_pose,
)
from diagnostic_msgs.msg import DiagnosticStatus
from harness import (
    AS_A_USER,
    Client,
    fix,
    NodeProcess,
    odometry,
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
from rclpy.serialization import serialize_message

from pose_graph_ros.core.geometry import se2


def test_every_message_of_a_drive_is_sound(client: Client) -> None:
    drive(client, 30.0, paced=True)
    answer = client.optimize()
    assert answer.success, answer.message

    assert client.values['alignment'] == 'aligned'
    assert client.values['odom.accepted'] == '300'
    # the last fix is as new as odometry that had not come: all but it can be used
    assert client.values['fix.accepted'] == '60'
    for messages in (client.poses, client.filtered, client.paths, client.transforms):
        stamps = [stamp_ns(message) for message in messages]
        assert all(np.diff(stamps) > 0), 'stamps do not increase'
    assert len(client.poses) == len(client.filtered) == 296
    for message in client.filtered:
        assert (message.header.frame_id, message.child_frame_id) == ('map', 'base_link')
        assert message.twist.twist.linear.x == 2.0
        check_pose(message.pose)
    for message in client.poses:
        assert message.header.frame_id == 'map'
        check_pose(message.pose)
    assert client.values['hidden_nodes'] == str(len(client.paths[-1].poses) - 1)

    path = client.paths[-1]
    assert path.header.frame_id == 'map'
    stamps = np.array([stamp_ns(item) for item in path.poses])
    assert all(np.diff(stamps) > 0)
    assert {item.header.frame_id for item in path.poses} == {'map'}
    poses = np.array([(item.pose.position.x, item.pose.position.y, yaw(item.pose.orientation))
                      for item in path.poses])
    # exact measurements: what is left is the rounding of latitude and longitude
    truth = np.array([true_pose(stamp * 1e-9 - START) for stamp in stamps])
    error = poses - truth
    error[:, 2] = se2.wrap(error[:, 2])
    assert np.max(np.abs(error)) < 1e-3
    newest = client.poses[-1]
    at = true_pose(stamp_ns(newest) * 1e-9 - START)
    position = newest.pose.pose.position
    assert math.hypot(position.x - at[0], position.y - at[1]) < 0.1
    assert newest.pose.covariance[0] < 1.0


@pytest.mark.skipif(TFMessage is None, reason='tf2_msgs is not built: no /tf')
def test_the_transform_times_odometry_is_the_pose(client: Client) -> None:
    drive(client, 1.0)
    client.spin_until(lambda: len(client.paths) > 0, 'the first estimate comes')
    drive(client, 15.0, begin=1.0)
    client.wait_answered(START + 14.9)
    poses = {stamp_ns(message): message.pose.pose for message in client.poses}
    compared = 0
    for transform in client.transforms:
        assert transform.header.frame_id == 'map'
        assert transform.child_frame_id == 'odom'
        stamp = stamp_ns(transform)
        if stamp not in poses:
            continue
        translation = transform.transform.translation
        T_map_odom = np.array(
            [translation.x, translation.y, yaw(transform.transform.rotation)])
        expected = se2.compose(T_map_odom, odometry_pose(stamp * 1e-9 - START))
        assert poses[stamp].position.x == pytest.approx(expected[0], abs=1e-5)
        assert poses[stamp].position.y == pytest.approx(expected[1], abs=1e-5)
        compared += 1
    assert compared > 100


def test_the_output_says_that_it_is_unaligned_until_the_angle_is_known(client: Client) -> None:
    drive(client, 2.0)
    client.spin_until(lambda: client.values.get('alignment') == 'unaligned', 'it is unaligned')
    client.wait_level(DiagnosticStatus.WARN)
    client.spin_for(0.3)
    client.odom.publish(odometry(START + 2.0, *odometry_pose(2.0).tolist()))
    last = len(client.poses)
    client.spin_until(lambda: len(client.poses) > last, 'a pose comes')
    assert client.poses[-1].pose.covariance[35] > 3.0
    drive_on = [(step / 10.0) for step in range(21, 150)]
    for seconds in drive_on:
        client.odom.publish(odometry(START + seconds, *odometry_pose(seconds).tolist()))
        latitude, longitude, _ = PLANE.to_geodetic(true_pose(seconds)[:2])
        client.fix.publish(fix(START + seconds, latitude, longitude))
        client.spin_for(0.002)
    client.spin_until(lambda: client.values['alignment'] == 'aligned', 'it is aligned')
    client.wait_level(DiagnosticStatus.OK)


def test_a_global_pose_and_a_loop_closure_are_heard(client: Client) -> None:
    client.global_pose.publish(pose(START + 1.0, *true_pose(1.0).tolist()))
    client.global_pose.publish(pose(START + 1.5, 0.0, 0.0, 0.0, frame='elsewhere'))
    drive(client, 10.0, fixes=False)
    seen = se2.between(true_pose(0.5), true_pose(9.0))
    client.loop_closure.publish(
        pose(START + 9.0, *seen.tolist(), frame=f'@{START + 0.5:.9f}'))
    client.loop_closure.publish(pose(START + 9.0, 0.0, 0.0, 0.0, frame='x9999'))
    client.loop_closure.publish(pose(START + 9.0, 0.0, 0.0, 0.0, frame='base_link'))
    client.wait_processed(105)
    answer = client.optimize()
    assert answer.success, answer.message
    client.spin_until(lambda: client.values.get('loop_closure.unknown_node') == '1',
                      'the unknown node is counted')
    values = client.values
    assert values['alignment'] == 'aligned'
    assert values['global_pose.accepted'] == '1'
    assert values['global_pose.wrong_frame'] == '1'
    assert values['loop_closure.accepted'] == '1'
    assert values['loop_closure.wrong_frame'] == '1'
    assert float(values['chi2']) < 1e-6


def test_a_silence_ends_with_the_full_optimisation(tmp_path: Path) -> None:
    with NodeProcess(tmp_path, ('-p', 'closing_silence:=0.5')) as node, \
            Client(int(node.env['ROS_DOMAIN_ID'])) as client:
        drive(client, 20.0)
        client.spin_until(lambda: len(client.paths) > 0 and path_error(client) < 1e-3,
                          'the optimised path comes')


def test_the_path_is_current_without_an_optimisation(client: Client) -> None:
    """A pose that comes 18 s late turns the whole path; a loop closure mends what has drifted."""
    drive(client, 20.0, fixes=False)
    client.spin_until(lambda: len(client.paths) > 0 and 1.0 < path_error(client) < math.inf,
                      'a path comes')
    client.global_pose.publish(pose(
        START + 2.0, *true_pose(2.0).tolist(), variances=(1e-4, 1e-4, 1e-6)))
    client.spin_until(lambda: path_error(client) < 1e-3, 'the path lies in the map')
    client.spin_until(lambda: client.values['alignment'] == 'aligned', 'the diagnostics follow')

    # on for a lap and a bit, with odometry that turns a little too much
    newest = odometry_pose(19.9)
    for step in range(200, 680):
        seconds = step / 10.0
        motion = se2.between(true_pose(seconds - 0.1), true_pose(seconds))
        newest = se2.compose(newest, motion + np.array([0.0, 0.0, 0.0005]))
        client.odom.publish(odometry(START + seconds, *newest.tolist(), speed=2.0))
        client.spin_for(0.002)
    client.wait_processed(200 + 1 + 480)
    client.spin_until(lambda: stamp_ns(client.paths[-1].poses[-1]) > (START + 67.8) * 1e9,
                      'the path reaches to the end')
    drifted = path_error(client)
    assert drifted > 1.0
    # three that agree: a single one with so wide a gate would wait for support
    for later in (65.0, 66.0, 67.0):
        seen = se2.between(true_pose(later - 64.0), true_pose(later))
        client.loop_closure.publish(pose(
            START + later, *seen.tolist(), frame=f'@{START + later - 64.0:.9f}',
            variances=(1e-4, 1e-4, 1e-6)))
    client.spin_until(lambda: path_error(client) < 0.3 * drifted, 'the loop is closed')
    # the three may be in as many updates
    client.spin_until(lambda: 2 <= int(client.values['updates']) <= 4, 'the updates are counted')
    assert 0.0 < float(client.values['solve_mean_ms']) <= float(client.values['solve_max_ms'])


@pytest.mark.parametrize('node', [('-p', 'global_pose.sigma_ceiling:=100000.0')], indirect=True)
def test_what_cannot_be_solved_for_is_set_aside_and_the_node_goes_on(
    node: NodeProcess, client: Client,
) -> None:
    drive(client, 5.0, fixes=False)
    # a sharp heading, but 100 km uncertain of the place: it holds the graph nowhere
    client.global_pose.publish(pose(
        START + 2.0, 0.0, 0.0, 1.0, variances=(1e10, 1e10, 1e-6)))
    client.spin_until(lambda: client.values.get('quarantined') == '1', 'it is set aside')
    assert client.values['solver.failed'] == '1'
    assert client.values['quarantined.1'] == f'global_pose at {START + 2.0:.3f} s near x3'
    # the level is that of the newest update, which may be a later one
    assert 'the solver failed with what is set aside' in node.stderr()
    assert client.values['alignment'] == 'local'
    client.global_pose.publish(pose(START + 3.0, *true_pose(3.0).tolist()))
    client.spin_until(lambda: client.values['alignment'] == 'aligned', 'it is aligned')
    client.spin_until(lambda: len(client.paths) > 0 and path_error(client) < 1e-3,
                      'the path lies in the map')
    client.wait_level(DiagnosticStatus.OK)


def test_malformed_messages_are_counted_and_the_node_goes_on(
    node: NodeProcess, client: Client,
) -> None:
    nan, infinite, huge = math.nan, math.inf, 1e200
    sent = 0
    for number in (nan, infinite, -infinite, huge):
        client.odom.publish(odometry(START, number, 0.0, 0.0))
        client.global_pose.publish(pose(START + 0.5, number, 0.0, 0.0))
        client.global_pose.publish(
            pose(START + 0.5, 0.0, 0.0, 0.0, variances=(number, number, 1.0)))
        client.fix.publish(fix(START + 0.5, number, 11.6))
        client.fix.publish(fix(START + 0.5, 48.1, 11.6, sigma=number))
        client.loop_closure.publish(pose(START + 0.5, number, 0.0, 0.0, frame='x0'))
        sent += 6
    empty = odometry(START, 0.0, 0.0, 0.0)
    empty.pose.pose.orientation.w = 0.0
    client.odom.publish(empty)
    client.odom.publish(odometry(0.0, 0.0, 0.0, 0.0))
    no_fix = fix(START + 0.5, 48.1, 11.6)
    no_fix.status.status = -1
    client.fix.publish(no_fix)
    client.fix.publish(fix(0.0, 48.1, 11.6))
    sent += 4
    client.wait_processed(sent)
    generator = random.Random(1)
    whole = serialize_message(odometry(START, 1.0, 2.0, 3.0))
    for _ in range(50):
        cut = whole[:generator.randrange(4, len(whole))]
        client.odom.publish(cut + generator.randbytes(generator.randrange(40)))
    client.spin_for(0.3)
    # stamps before the good ones: what of the noise could be read as odometry does not matter
    seen = int(client.values['received'])
    assert seen >= sent
    before = int(client.values.get('odom.accepted', '0'))
    for step in range(20):
        client.odom.publish(odometry(4e9 / 2 + step, float(step), 0.0, 0.0))
    client.spin_until(lambda: int(client.values.get('odom.accepted', '0')) >= before + 20,
                      'good odometry is accepted')
    values = client.values
    assert values['odom.zero_stamp'] == '1'
    assert values['fix.no_fix'] == '1'
    assert values['fix.zero_stamp'] == '1'
    assert int(values['odom.not_finite']) >= 3
    assert int(values['odom.too_large']) >= 1
    for message in client.filtered:
        check_pose(message.pose)
    assert values['fix.not_finite'] in ('3', '4')
    assert values['loop_closure.not_finite'] == '3'
    assert values['loop_closure.too_large'] == '1'
    assert node.process.poll() is None
    assert 'Traceback' not in node.stderr()


@pytest.mark.parametrize('signals', [
    (signal.SIGINT,), (signal.SIGTERM,), (signal.SIGINT, signal.SIGINT),
    (signal.SIGTERM, signal.SIGTERM), (signal.SIGINT, signal.SIGTERM)])
def test_signals_end_the_node_without_a_traceback(
    node: NodeProcess, client: Client, signals: tuple[signal.Signals, ...],
) -> None:
    drive(client, 3.0)
    assert node.signal_and_wait(*signals) == 0
    assert 'Traceback' not in node.stderr()


def test_a_signal_that_the_system_hands_to_another_thread_ends_the_node(
    node: NodeProcess, client: Client,
) -> None:
    process = node.process.pid
    for thread in sorted(int(path.name) for path in Path(f'/proc/{process}/task').iterdir())[1:]:
        if node.process.poll() is None:
            ctypes.CDLL(None).tgkill(process, thread, signal.SIGINT)
    assert node.process.wait(PATIENCE) == 0


def test_what_the_thread_of_the_engine_logs_reaches_rosout(
    node: NodeProcess, client: Client,
) -> None:
    rosout: list[Log] = []
    # what is logged before both sides match comes, too
    client.node.create_subscription(Log, '/rosout', rosout.append, QoSProfile(
        depth=100, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL))
    drive(client, 2.0)
    client.fix.publish(fix_at(1.0))     # a second time
    client.spin_until(lambda: any(line.msg.startswith('fix: duplicate') for line in rosout),
                      'the warning comes')
    [line] = [line for line in rosout if line.msg.startswith('fix: ')]
    assert (line.name, line.level) == ('pose_graph', Log.WARN)


BAD = (
    ('frequency:=1000.0', 'frequency'), ('datum:=[95.0, 10.0]', 'latitude'),
    ('map_frame:=3', 'map_frame'), ('odom_frame:=map', 'different'),
    ('fix.lever_arm:=[1.0]', 'fix.lever_arm'),
    ('sources:=[odom, wheels]', 'wheels.type'), ('sources:=[]', 'odometry or twist, got []'),
    ('odom.robust_loss:=l1', 'none, huber, cauchy'), ('fix.sigma_ceiling:=0.001', 'ceiling'),
    ('fix.topic:=/odom', 'fix.topic: expected a topic of sensor_msgs/msg/NavSatFix, got /odom'),
    ('qos_overrides./odom.subscription.reliability:=bestefort', 'best_effort'),
    ('load_graph_on_start:=true', 'parameter graph_file: expected the name of a file'),
    ('qos_overrides./path.publisher.lifespan:=5', 'depth, history, reliability'))
UNREADABLE = (('-p', 'frequency'), ('--params-file', '/no/such.yaml'), ('--no-such',))


def errors_of(
    folder: Path, several: Sequence[Sequence[str]], program: Sequence[str] = (),
) -> list[str]:
    """Return what nodes with these arguments, started at the same time, say before they end."""
    with ExitStack() as stack:
        nodes = []
        for k, arguments in enumerate(several):
            (folder / str(k)).mkdir()
            nodes.append(stack.enter_context(NodeProcess(
                folder / str(k), arguments, program=program)))
        assert [node.process.wait(PATIENCE) for node in nodes] == [2] * len(nodes)
        return [node.stderr() for node in nodes]


@pytest.mark.parametrize('some', [BAD[:4], BAD[4:8], BAD[8:]])
def test_a_bad_parameter_is_one_line_and_no_traceback(
    tmp_path: Path, some: tuple[tuple[str, str], ...],
) -> None:
    errors = errors_of(tmp_path, [('-p', parameter) for parameter, _ in some])
    for error, (_, expected) in zip(errors, some, strict=True):
        lines = error.splitlines()
        assert len(lines) == 1, lines
        assert expected in lines[0]


def test_whole_numbers_are_numbers_and_optimizing_nothing_says_so(tmp_path: Path) -> None:
    arguments = ('-p', 'frequency:=5', '-p', 'datum:=[48, 11]', '-p', 'fix.lever_arm:=[1, 0]')
    with NodeProcess(tmp_path, arguments) as node, \
            Client(int(node.env['ROS_DOMAIN_ID'])) as client:
        answer = client.optimize()
        assert not answer.success
        assert 'no odometry' in answer.message


def test_arguments_that_ros_cannot_read_end_the_node_without_a_traceback(tmp_path: Path) -> None:
    for error in errors_of(tmp_path, UNREADABLE, AS_A_USER):
        assert 'pose_graph_node: ' in error
        assert 'Traceback' not in error


@pytest.mark.parametrize(
    'node', [('-r', '__ns:=/robot1', '-r', 'odom:=wheels', '-p', 'map_frame:=world')],
    indirect=True)
def test_a_namespace_a_remap_and_a_frame(node: NodeProcess) -> None:
    with Client(int(node.env['ROS_DOMAIN_ID']), namespace='robot1', odom='wheels') as client:
        drive(client, 5.0)
        client.spin_until(lambda: len(client.paths) > 0, 'a path comes')
        client.wait_answered(START + 4.9)
        assert client.paths[-1].header.frame_id == 'world'
        assert client.filtered[-1].header.frame_id == 'world'
        names = {name for name, _ in client.node.get_topic_names_and_types()}
        assert {'/robot1/path', '/robot1/pose', '/robot1/odometry/filtered', '/tf',
                '/diagnostics'} - ({'/tf'} if TFMessage is None else set()) <= names


def test_best_effort_senders_are_heard_and_a_late_subscriber_gets_the_path(client: Client) -> None:
    drive(client, 8.0)
    client.optimize()
    with Client(client.domain) as late:
        late.spin_until(lambda: len(late.paths) > 0, 'the latched path comes')
        assert len(late.paths[-1].poses) == len(client.paths[-1].poses)
    info = client.node.get_subscriptions_info_by_topic('/odom')
    assert [item.qos_profile.reliability.name for item in info] == ['BEST_EFFORT']
    assert RELIABLE.depth >= 200
