# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sources as the parameters list them, late, silent, jumping and lifted: with the real node."""

from collections.abc import Callable
import math
from pathlib import Path
import random
import re

from circle import fix_at, odometry_at, odometry_pose, path_error, PLANE, START, true_pose
from harness import (
    Client,
    fix,
    imu,
    NodeProcess,
    odometry,
    PATIENCE,
    pose,
    stamp_ns,
    TFMessage,
    transform,
    yaw,
)
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import Imu, NavSatFix
import yaml

from pose_graph_ros.core.geometry import se2

# Exact measurements: what is left is the rounding of latitude and longitude [m].
EXACT = 1e-3
REAR = (-0.5, 0.25)
DATUM = ('-p', f'datum:=[{PLANE.latitude}, {PLANE.longitude}]')

PARAMETERS = f'''
/**:
  ros__parameters:
    sources: [odom, visual, fix, rear]
    odom: {{topic: wheels/odometry, maximum_speed: 10.0}}
    visual: {{type: odometry, topic: /vo, time_offset: -0.5, sigma_distance: 0.2}}
    fix: {{robust_loss: huber}}
    rear: {{type: fix, topic: rear/fix, lever_arm: [{REAR[0]}, {REAR[1]}], time_offset: 100.0}}
'''


def visual_pose(seconds: float) -> np.ndarray:
    """Odometry of the same drive in a frame of its own."""
    return se2.compose(np.array([-40.0, 2.0, 1.0]), true_pose(seconds))


def visual_at(seconds: float) -> Odometry:
    """The message of that odometry, whose clock is half a second ahead."""
    message = odometry(START + seconds + 0.5, *visual_pose(seconds).tolist())
    message.header.frame_id = 'vo'
    return message


def connected(node: NodeProcess, **options: object) -> Client:
    return Client(int(node.env['ROS_DOMAIN_ID']), **options)


def play(client: Client, steps: range, *senders: Callable[[int], int]) -> int:
    """Call senders, who say how much they have sent, with steps of 0.1 s, and wait."""
    target = int(client.values['processed'])
    for step in steps:
        target += sum(send(step) for send in senders)
        client.spin_for(0.002)
    client.wait_processed(target)
    return target


def every(period: int, publisher: object, make: Callable[[float], object]) -> Callable[[int], int]:
    """Return a sender that publishes in each so many-th step what is made for its time [s]."""
    def send(step: int) -> int:
        if step % period == 0:
            publisher.publish(make(step / 10.0))
        return int(step % period == 0)
    return send


def test_two_of_each_from_a_file_and_one_falls_silent(tmp_path: Path) -> None:
    (tmp_path / 'params.yaml').write_text(PARAMETERS, encoding='utf-8')
    topics = {'wheels/odometry': Odometry, 'vo': Odometry, 'rear/fix': NavSatFix}
    arguments = ('--params-file', str(tmp_path / 'params.yaml'))
    with NodeProcess(tmp_path, arguments) as node, connected(
            node, listens=('fix', 'loop_closure'), more=topics) as client:
        wheels = every(1, client.more['wheels/odometry'], odometry_at)
        visual = every(1, client.more['vo'], visual_at)
        front = every(5, client.fix, fix_at)
        # its clock is 100 s behind
        rear = every(5, client.more['rear/fix'], lambda seconds: fix(
            START + seconds - 100.0, *PLANE.to_geodetic(
                se2.transform(true_pose(seconds), np.array(REAR)), 100.0)[:2]))
        play(client, range(150), wheels, visual, front, rear)
        assert client.optimize().success
        values = client.values
        assert values['odometry'] == 'odom'
        assert (values['odom.accepted'], values['visual.accepted']) == ('150', '150')
        assert (values['fix.accepted'], values['rear.accepted']) == ('30', '30')
        assert values['rear.lever_arm'] == '[-0.500, 0.250] from parameter'
        # more edges than one between two nodes
        assert int(values['edges']) > 1.5 * int(values['hidden_nodes'])
        assert path_error(client) < EXACT
        assert float(values['odom.silence_s']) < PATIENCE
        assert values['loop_closure.silence_s'] == 'never received'

        play(client, range(150, 300), visual, front, rear)
        client.spin_until(lambda: client.values['odometry'] == 'visual', 'visual is primary')
        step = 300
        # soon rear is silent as well
        while not re.search('odom (and rear are|is) silent',
                            client.diagnostics[-1].status[0].message):
            play(client, range(step, step + 1), visual, front)
            step += 1
            assert step < 2000
        assert client.diagnostics[-1].status[0].level == b'\x01'
        client.poses.clear()
        client.transforms.clear()
        play(client, range(step, step + 20), visual, front)
        assert client.optimize().success
        assert path_error(client) < EXACT
        assert len(client.poses) >= 15
        for message in client.poses:
            assert pose_error(message) < 0.05
        # its frame is not the one that the transform speaks of; those of before may come late
        assert all(stamp_ns(item) < (START + step / 10.0) * 1e9 for item in client.transforms)


def test_the_file_of_defaults_is_taken_and_what_is_not_known_is_said(tmp_path: Path) -> None:
    file = Path(__file__).resolve().parents[2] / 'config' / 'pose_graph_full.yaml'
    (tmp_path / 'misspelt.yaml').write_text(yaml.safe_dump({
        '/**': {'ros__parameters': {
            'odom': {'sigma_distnce': 0.1}, 'fine': 1, 'use_sim_time': False}},
        '/other': {'ros__parameters': {'map_frme': 'world'}}}))
    arguments = ('--params-file', str(file), '-p', 'wheels.type:=odometry',
                 '--params-file', str(tmp_path / 'misspelt.yaml'), '-p', 'frequncy:=3.0',
                 '-p', 'odom.lever_arm:=[1.0, 0.0]', '-p', 'other_node.gain:=1.0',
                 '-p', 'qos_overrides./scan.publisher.depth:=3')
    with NodeProcess(tmp_path, arguments) as node, connected(node) as client:
        play(client, range(10), every(1, client.odom, odometry_at))
        log = node.stderr()
        assert 'parameter wheels.type is not known' in log
        assert 'parameter odom.lever_arm is not known' in log
        assert log.count('parameter frequncy is not known: did you mean frequency?') == 1
        assert log.count('odom.sigma_distnce is not known: did you mean odom.sigma_distance?') == 1
        assert log.count('is not known') == 5  # and `fine`, which is like no other
        assert 'other_node' not in log


def pose_error(message: object) -> float:
    """Return how far a published pose is from the truth at its stamp."""
    expected = true_pose(stamp_ns(message) * 1e-9 - START)
    position = message.pose.pose.position
    return math.hypot(position.x - expected[0], position.y - expected[1])


def run_fixes(
    folder: Path, order: Callable[[list[tuple[float, object]]], list[tuple[float, object]]],
) -> tuple[np.ndarray, dict[str, str]]:
    """Return the path after a drive whose fixes, noisy, come as ordered, and the diagnostics."""
    generator = random.Random(5)
    fixes = []
    for step in range(0, 200, 5):
        message = fix_at(step / 10.0)
        message.latitude += generator.gauss(0.0, 3e-6)
        message.longitude += generator.gauss(0.0, 3e-6)
        message.altitude += generator.gauss(0.0, 1.0)
        fixes.append((step / 10.0, message))
    folder.mkdir()
    with NodeProcess(folder, DATUM) as node, connected(node) as client:
        arrivals = order(fixes)

        def send(step: int) -> int:
            due = [message for arrival, message in arrivals if round(arrival * 10) == step]
            for message in due:
                client.fix.publish(message)
            return len(due)

        play(client, range(230), every(1, client.odom, odometry_at), send)
        assert client.optimize().success
        return np.array([(stamp_ns(item) * 1e-9, item.pose.position.x, item.pose.position.y,
                          yaw(item.pose.orientation))
                         for item in client.paths[-1].poses]), client.values


def test_late_shuffled_and_repeated_fixes_give_the_same_path(tmp_path: Path) -> None:
    def late(fixes: list[tuple[float, object]]) -> list[tuple[float, object]]:
        generator = random.Random(7)
        arrivals = [(at + generator.uniform(1.0, 2.0), message) for at, message in fixes]
        return sorted(arrivals + [(at + 0.7, message) for at, message in arrivals[::4]],
                      key=lambda arrival: arrival[0])

    prompt, counts = run_fixes(tmp_path / 'prompt', lambda fixes: fixes)
    delayed, late_counts = run_fixes(tmp_path / 'late', late)
    assert counts['fix.accepted'] == late_counts['fix.accepted'] == '40'
    assert 'fix.duplicate_stamp' not in counts
    assert late_counts['fix.duplicate_stamp'] == '10'
    np.testing.assert_allclose(delayed, prompt, rtol=0.0, atol=1e-6)
    # and the noise of the fixes does show
    error = [math.hypot(*(row[1:3] - true_pose(row[0] - START)[:2])) for row in prompt]
    assert 0.01 < max(error) < 1.0


def test_a_reset_of_the_odometry_shows_in_no_output(client: Client) -> None:
    def reset_odometry(seconds: float) -> Odometry:
        if seconds < 10.0:
            return odometry_at(seconds)
        since = se2.between(odometry_pose(10.0), odometry_pose(seconds))
        return odometry(START + seconds, *since.tolist(), speed=2.0)

    def wait_for_the_jump(step: int) -> int:
        if step == 105:     # until there is an estimate no message is answered
            client.spin_until(lambda: client.values.get('odom.jump') == '1', 'it is counted')
        client.spin_for(0.01)
        return 0

    play(client, range(200), every(1, client.odom, reset_odometry),
         every(5, client.fix, fix_at), wait_for_the_jump)
    client.wait_answered(START + 19.9)
    assert client.optimize().success
    assert path_error(client) < 0.5
    errors = {stamp_ns(message) * 1e-9 - START: pose_error(message) for message in client.poses}
    settled = {at: error for at, error in errors.items() if at > 8.0}
    assert max(settled.values()) < 0.6, settled
    # at most a few messages go without an answer
    assert len([at for at in settled if at > 10.0]) > 90


@pytest.mark.skipif(TFMessage is None, reason='tf2_msgs is not built: no /tf_static')
@pytest.mark.parametrize('node', [('-p', 'base_link_frame:=robot')], indirect=True)
def test_the_lever_arm_comes_from_tf_static(node: NodeProcess) -> None:
    with connected(node) as client:
        static = client.node.create_publisher(TFMessage, '/tf_static', QoSProfile(
            depth=10, reliability=QoSReliabilityPolicy.RELIABLE,
            durability=QoSDurabilityPolicy.TRANSIENT_LOCAL))
        client.spin_until(lambda: static.get_subscription_count() > 0, 'the node listens')
        client.fix.publish(fix_at(0.0))
        client.spin_until(lambda: client.values.get('fix.without_lever_arm') == '1',
                          'the missing lever arm is counted')
        assert client.values['fix.lever_arm'] == '[0.000, 0.000] from none'
        half = math.sqrt(0.5)
        static.publish(TFMessage(transforms=[
            transform('robot', 'mast', (0.5, 0.0, 1.0), (0.0, 0.0, half, half)),
            transform('mast', 'gps', (1.0, 0.25, 1.0))]))
        client.wait_received(static)
        lever_arm = (0.25, 1.0)
        play(client, range(150), every(1, client.odom, odometry_at),
             every(5, client.fix, lambda seconds: fix_at(seconds, lever_arm)))
        assert client.optimize().success
        assert client.values['fix.lever_arm'] == '[0.250, 1.000] from tf_static'
        assert client.values['fix.without_lever_arm'] == '1'
        # the first fix, which had no lever arm, is the datum
        assert path_error(client) < EXACT


@pytest.mark.parametrize(
    'node', [(*DATUM[:1], f'datum:=[{PLANE.latitude}, {PLANE.longitude}, 0.5]',
              '-p', 'fix.correlation_time:=0.0')], indirect=True)
def test_the_pose_comes_back_in_latitude_and_longitude(node: NodeProcess, client: Client) -> None:
    def unequal(seconds: float) -> NavSatFix:
        message = fix_at(seconds)
        message.position_covariance[0] = 4.0  # east is less certain
        return message

    play(client, range(150), every(1, client.odom, odometry_at), every(2, client.fix, unequal))
    client.optimize()
    play(client, range(150, 160), every(1, client.odom, odometry_at))
    client.wait_answered(START + 15.9)
    client.spin_until(lambda: len(client.fixes) > 0 and stamp_ns(client.fixes[-1])
                      == stamp_ns(client.poses[-1]), 'the last fix comes')
    assert {stamp_ns(message) for message in client.fixes} <= {
        stamp_ns(message) for message in client.poses}
    for message in client.fixes[-5:]:
        assert message.header.frame_id == 'base_link'
        assert message.status.status == 0
        assert message.position_covariance_type == 3
        assert message.altitude == 100.0
        place = PLANE.to_map(message.latitude, message.longitude, message.altitude)
        np.testing.assert_allclose(
            place, true_pose(stamp_ns(message) * 1e-9 - START)[:2], atol=0.02)
        covariance = np.array(message.position_covariance).reshape(3, 3)
        assert np.array_equal(covariance, covariance.T)
        assert covariance[0, 0] > 1.5 * covariance[1, 1] > 0.0
        assert covariance[2, 2] > 1e3


def test_without_fixes_there_is_no_latitude(client: Client) -> None:
    play(client, range(20), every(1, client.odom, odometry_at))
    client.spin_until(lambda: len(client.poses) > 10, 'poses come')
    assert len(client.fixes) == 0
    assert client.values['datum'] == 'none'


@pytest.mark.parametrize('node', [
    (), ('-p', 'fix.correlation_time:=0.0')], indirect=True)
def test_errors_that_live_on_show_in_the_diagnostics(
    node: NodeProcess, client: Client, request: pytest.FixtureRequest,
) -> None:
    generator = random.Random(3)
    error = [0.0, 0.0]

    def wandering(seconds: float) -> NavSatFix:
        for k in range(2):
            error[k] = 0.95 * error[k] + generator.gauss(0.0, 0.3)
        message = fix_at(seconds, sigma=1.0)
        message.latitude += error[0] / 111_200.0
        message.longitude += error[1] / 74_300.0
        return message

    play(client, range(800), every(1, client.odom, odometry_at), every(5, client.fix, wandering))
    assert client.optimize().success
    told = client.values['fix.errors_live']
    assert 0.5 < float(told.partition(' ')[0]) < 100.0
    treated = 'treated as white: set fix.correlation_time' in told
    given = request.node.callspec.params['node']
    assert treated == ('fix.correlation_time:=0.0' in given)
    assert ('and treated so' in told) == (given == ())
    assert 0.01 < float(client.values['fix.squared_residual']) < 3.0


def test_an_imu_turns_the_map_before_the_robot_has_moved_far(tmp_path: Path) -> None:
    arguments = ('-p', 'sources:=[odom, fix, imu]', '-p', 'imu.yaw_offset:=0.25',
                 '-p', f'datum:=[{PLANE.latitude}, {PLANE.longitude}, 1.0]')
    with NodeProcess(tmp_path, arguments) as node, connected(
            node, listens=('odom', 'fix', 'loop_closure'), more={'imu/data': Imu}) as client:
        wrong = imu(START + 0.1, 0.0)
        wrong.orientation_covariance[0] = -1.0
        client.more['imu/data'].publish(wrong)
        play(client, range(20), every(1, client.odom, odometry_at), every(10, client.fix, fix_at),
             every(2, client.more['imu/data'], lambda seconds: imu(
                 START + seconds, true_pose(seconds)[2] - 0.25)))
        assert client.optimize().success
        assert client.values['alignment'] == 'aligned'
        assert client.values['imu.no_orientation'] == '1'
        # every half second one of them is taken
        assert client.values['imu.accepted'] == '4'
        assert client.values['imu.thinned'] == '6'
        newest = client.paths[-1].poses[-1]
        expected = true_pose(stamp_ns(newest) * 1e-9 - START)
        # the map's x axis points 1 rad to the left of east
        assert yaw(newest.pose.orientation) == pytest.approx(expected[2] - 1.0, abs=1e-6)
        turned = se2.transform(np.array([0.0, 0.0, -1.0]), expected[:2])
        assert newest.pose.position.x == pytest.approx(turned[0], abs=EXACT)
        assert newest.pose.position.y == pytest.approx(turned[1], abs=EXACT)


def test_an_imu_is_not_listened_to_unasked(client: Client) -> None:
    assert client.node.count_subscribers('imu/data') == 0
    assert client.node.count_subscribers('gps/fix') == 1


def drifting(seconds: float) -> Odometry:
    """Odometry that turns too much by 0.01 rad a second."""
    angle = 0.11 * seconds
    radius = 2.0 / 0.11
    return odometry(START + seconds, radius * math.sin(angle), radius * (1.0 - math.cos(angle)),
                    angle)


@pytest.mark.parametrize('node', [('-p', 'loop_closure.robust:=none')], indirect=True)
def test_a_loop_closure_waits_until_odometry_has_reached_both_ends(
    node: NodeProcess, client: Client,
) -> None:
    # the other end is later than the stamp; both lie ahead
    seen = se2.between(true_pose(66.0), true_pose(3.0))
    client.loop_closure.publish(pose(
        START + 3.0, *seen.tolist(), frame=f'@{START + 66.0:.9f}', variances=(1e-4, 1e-4, 1e-6)))
    client.loop_closure.publish(pose(
        START + 66.0, *seen.tolist(), frame=f'@{START + 3.0:.9f}', variances=(0.0, 0.0, 0.0)))
    client.spin_until(lambda: client.values['pending'] == '1' and client.values.get(
        'loop_closure.covariance_not_positive') == '1', 'the first waits')
    play(client, range(0, 500), every(1, client.odom, drifting))
    assert client.values['pending'] == '1'
    play(client, range(500, 680), every(1, client.odom, drifting))
    client.spin_until(lambda: client.values.get('loop_closure.accepted') == '1', 'it is used')
    assert client.optimize().success
    stamps = np.array([stamp_ns(item) * 1e-9 - START for item in client.paths[-1].poses])
    path = np.array([(item.pose.position.x, item.pose.position.y, yaw(item.pose.orientation))
                     for item in client.paths[-1].poses])
    early, late = (path[np.argmin(np.abs(stamps - at))] for at in (3.0, 66.0))
    closed = math.hypot(*se2.between(late, early)[:2] - seen[:2])
    assert closed < 2.0  # the nodes nearest to the stamps
    raw_early, raw_late = (drifting(at).pose.pose.position for at in (3.0, 66.0))
    assert math.hypot(raw_early.x - raw_late.x, raw_early.y - raw_late.y) > 6.0


def test_headings_alone_can_be_tied(client: Client) -> None:
    """The walls of a building: the robot points the other way round, wherever it is."""
    play(client, range(400), every(1, client.odom, drifting))
    turn = true_pose(35.0)[2] - true_pose(5.0)[2]
    client.loop_closure.publish(pose(
        START + 35.0, 500.0, -500.0, turn, frame=f'@{START + 5.0:.9f}',
        variances=(math.inf, math.inf, 1e-8)))
    client.spin_until(lambda: client.values.get('loop_closure.accepted') == '1', 'it is used')
    assert client.optimize().success
    stamps = np.array([stamp_ns(item) * 1e-9 - START for item in client.paths[-1].poses])
    headings = np.unwrap([yaw(item.pose.orientation) for item in client.paths[-1].poses])
    early, late = np.interp([5.0, 35.0], stamps, headings)
    # the path is interpolated between its nodes
    assert late - early == pytest.approx(turn, abs=0.02)
    assert 0.11 * 30.0 - turn > 0.25


@pytest.mark.parametrize('node', [('-p', 'wait_for_datum:=true')], indirect=True)
def test_the_datum_is_set_by_the_service(node: NodeProcess, client: Client) -> None:
    play(client, range(10), every(1, client.odom, odometry_at), every(5, client.fix, fix_at))
    client.spin_until(lambda: client.values.get('fix.no_datum') == '2', 'fixes are refused')
    assert client.values['datum'] == 'none'
    answer = client.set_datum()
    assert answer.success, answer.message
    far_off = fix(START + 1.0, 10.0, 10.0)
    far_off.status.status = -1
    client.fix.publish(far_off)
    play(client, range(10, 100), every(1, client.odom, odometry_at), every(5, client.fix, fix_at))
    client.spin_until(lambda: client.values['datum'].startswith('[48.'), 'the datum is shown')
    latitude, longitude, _ = map(float, client.values['datum'].strip('[]').split(','))
    first = fix_at(1.0)
    assert latitude == pytest.approx(first.latitude, abs=1e-9)
    assert longitude == pytest.approx(first.longitude, abs=1e-9)
    answer = client.set_datum()
    assert not answer.success
    assert 'fixes in the graph refer to the datum' in answer.message
    assert client.optimize().success


def test_the_datum_can_be_moved_as_long_as_no_fix_is_used(tmp_path: Path) -> None:
    with NodeProcess(tmp_path, ('-p', 'datum:=[10.0, 10.0]')) as node, connected(node) as client:
        assert client.set_datum().success
        client.fix.publish(fix_at(0.0))
        client.spin_until(lambda: client.values['pending'] == '1', 'it waits for odometry')
        assert client.values['datum'] == 'none'
        assert client.set_datum().success
        client.odom.publish(odometry_at(0.0))
        client.odom.publish(odometry_at(1.0))
        client.spin_until(lambda: client.values['datum'].startswith('[48.1'), 'it has moved')
        answer = client.set_datum()
        assert not answer.success
        assert 'refer to the datum' in answer.message


def test_the_frame_of_the_odometry_decides_on_the_transform(client: Client) -> None:
    def named(frame: str) -> Callable[[float], Odometry]:
        def make(seconds: float) -> Odometry:
            message = odometry_at(seconds)
            message.header.frame_id = frame
            return message
        return make

    if TFMessage is None:
        pytest.skip('tf2_msgs is not built: no /tf')
    play(client, range(10), every(1, client.odom, named('elsewhere')))
    client.spin_until(lambda: len(client.poses) > 3, 'poses come')
    assert len(client.transforms) == 0
    for frame in ('', 'odom', '/odom'):
        before = len(client.transforms)
        start = 10 + 5 * ('', 'odom', '/odom').index(frame)
        play(client, range(start, start + 5), every(1, client.odom, named(frame)))
        client.spin_until(lambda before=before: len(client.transforms) >= before + 5,
                          'transforms come')
