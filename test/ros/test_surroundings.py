# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Silent mistakes around the node: wrong topics, frames and files, and others that publish."""

from collections.abc import Sequence
from pathlib import Path

from circle import drive, fix_at, odometry_at, START
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from harness import Client, imu, NodeProcess, odometry, PATIENCE, RELIABLE
from nav_msgs.msg import Odometry
import pytest
from sensor_msgs.msg import Imu, NavSatFix

from pose_graph_ros.adapters.parameter_files import without_effect

EKF = '/odometry/filtered'


def told(client: Client, node: NodeProcess, *parts: str) -> None:
    """Wait until the log and, as a warning, the diagnostics say something; once in the log."""
    def is_told() -> bool:
        status = client.diagnostics[-1].status[0]
        return status.level == DiagnosticStatus.WARN and all(
            part in status.message for part in parts)
    client.spin_until(is_told, f'the diagnostics say {parts}')
    client.spin_for(0.5)
    assert sum(all(part in line for part in parts) and '[WARN]' in line
               for line in node.stderr().splitlines()) == 1


def send_odometry(client: Client, frame: str, child: str) -> None:
    for step in range(20):
        message = odometry_at(step / 10.0)
        message.header.frame_id, message.child_frame_id = frame, child
        client.odom.publish(message)
        client.spin_for(0.01)


@pytest.mark.parametrize('arguments', [
    ('-p', f'odom.topic:={EKF}', '-p', 'outputs.filtered_odometry:=/own'),
    ('-r', f'odom:={EKF}', '-r', 'odometry/filtered:=/own'),
    ('-r', f'odom:={EKF}', '-p', 'outputs.filtered_odometry:=/own')])
def test_an_input_may_have_the_usual_name_of_an_output(
    tmp_path: Path, arguments: Sequence[str],
) -> None:
    with NodeProcess(tmp_path, arguments) as node, \
            Client(int(node.env['ROS_DOMAIN_ID']), odom=EKF) as client:
        own: list[Odometry] = []
        client.node.create_subscription(Odometry, '/own', own.append, RELIABLE)
        drive(client, 3.0)
        client.spin_until(lambda: len(own) > 0, 'the output comes')
        assert own[-1].header.frame_id == 'map'
        # it is published by the client, which is no other publisher of an output
        assert 'published' not in node.stderr()


@pytest.mark.parametrize('arguments', [
    ('-r', f'odom:={EKF}'), ('-p', f'odom.topic:={EKF}'),
    ('-p', f'odom.topic:={EKF}', '-r', 'odometry/filtered:=/own')])
def test_an_input_on_an_output_ends_the_node_with_what_to_type(
    tmp_path: Path, arguments: Sequence[str],
) -> None:
    with NodeProcess(tmp_path, arguments) as node:
        assert node.process.wait(PATIENCE) == 2
        (line,) = node.stderr().splitlines()
    assert '-p outputs.filtered_odometry:=/pose_graph/filtered_odometry with ros2 run' in line
    assert 'filtered_odometry:=/pose_graph/filtered_odometry with ros2 launch' in line


def test_another_publisher_of_an_output_is_named_once(node: NodeProcess, client: Client) -> None:
    send_odometry(client, 'odom', 'base_link')
    client.node.create_publisher(PoseWithCovarianceStamped, 'pose', RELIABLE)
    told(client, node, '/pose is published by', client.node.get_name(),
         '-p outputs.pose:=/pose_graph/pose')


@pytest.mark.parametrize('node', [
    ('-p', 'sources:=[odom, global_pose, fix, rear]', '-p', 'rear.type:=fix',
     '-r', 'rear:=/gnss')],
    indirect=True)
def test_a_topic_that_nobody_publishes_is_named(node: NodeProcess, client: Client) -> None:
    send_odometry(client, 'odom', 'base_link')
    client.fix.publish(fix_at(1.0))
    told(client, node, 'ear listens to /gnss for sensor_msgs/msg/NavSatFix, but nobody publishes '
         'it; there is /gps/fix')
    client.node.create_publisher(NavSatFix, '/gnss', RELIABLE)
    client.spin_until(lambda: '/gnss' not in client.diagnostics[-1].status[0].message, 'it is')


@pytest.mark.parametrize(('frames', 'parts'), [
    (('odom', 'base_footprint'), (
        "dom has the child_frame_id 'base_footprint', but the parameter base_link_frame is "
        "'base_link'",)),
    (('wheels', 'base_link'), ("dom has the frame_id 'wheels', but the parameter odom_frame is",)),
    (('', 'base_link'), ('dom has no frame_id: it is taken for odom',)),
    (('odom', ''), ('dom has no child_frame_id: it is taken for base_link',))])
def test_frames_that_are_not_those_of_the_parameters_are_a_warning(
    node: NodeProcess, client: Client, frames: tuple[str, str], parts: Sequence[str],
) -> None:
    send_odometry(client, *frames)
    told(client, node, *parts)


def test_fixes_without_a_frame_need_the_place_of_the_antenna(
    node: NodeProcess, client: Client,
) -> None:
    send_odometry(client, 'odom', 'base_link')
    message = fix_at(1.0)
    message.header.frame_id = ''
    client.fix.publish(message)
    told(client, node, 'ix has no frame_id: its antenna is taken to be in base_link: set '
         'fix.lever_arm')


@pytest.mark.parametrize('node', [
    ('-p', 'sources:=[odom, global_pose, fix, rear]', '-p', 'rear.type:=fix',
     '-p', 'rear.topic:=/gps/fix')],
    indirect=True)
def test_two_sources_on_one_topic_are_told(node: NodeProcess, client: Client) -> None:
    send_odometry(client, 'odom', 'base_link')
    told(client, node, 'ix and rear listen to the same topic, /gps/fix')


@pytest.mark.parametrize('node', [
    ('-p', 'sources:=[odom, global_pose, fix, imu, gyro]', '-p', 'gyro.mounting:=up')],
    indirect=True)
def test_the_heading_and_the_rate_of_one_imu_are_no_mistake(
    node: NodeProcess, client: Client,
) -> None:
    client.wait_current()
    assert 'same topic' not in node.stderr()


SECTIONS = {
    'other': 'ekf_node:\n  ros__parameters: {frequency: 5.0}\n',
    'no slash': 'pose_graph:\n  ros__parameters: {frequency: 5.0}\n',
    'nested': 'robot:\n  pose_graph:\n    ros__parameters: {frequency: 5.0}\n',
    'stars': '/**/pose_graph:\n  ros__parameters: {frequency: 5.0}\n',
    'all': '/**:\n  ros__parameters: {frequency: 5.0}\n',
    'several': 'a:\n  ros__parameters: {}\n/pose_graph:\n  ros__parameters: {frequency: 5.0}\n'}


@pytest.mark.parametrize(('name', 'has_effect', 'in_namespace'), [
    ('other', False, False), ('no slash', True, False), ('nested', False, True),
    ('stars', True, True), ('all', True, True), ('several', True, False)])
def test_a_parameter_file_for_other_nodes_is_told(
    tmp_path: Path, name: str, has_effect: bool, in_namespace: bool,
) -> None:
    file = tmp_path / 'file.yaml'
    file.write_text(SECTIONS[name])
    arguments = ['node', '--ros-args', '--params-file', str(file), '-r', 'a:=b']
    for node, wanted in (('/pose_graph', has_effect), ('/robot/pose_graph', in_namespace)):
        said = list(without_effect(arguments, node))
        assert (len(said) == 0) == wanted
    assert list(without_effect(['--params-file', '/no/such.yaml'], '/pose_graph')) == []


def test_a_node_that_waits_says_for_what_and_tells_of_its_states(tmp_path: Path) -> None:
    file = tmp_path / 'file.yaml'
    file.write_text(SECTIONS['other'])
    arguments = ('-p', 'autostart:=false', '--params-file', str(file))
    with NodeProcess(tmp_path, arguments) as node:
        client = Client(int(node.env['ROS_DOMAIN_ID']))
        client.spin_until(lambda: 'waiting for the transition configure' in node.stderr(), 'it is')
        assert (f'{file} has no effect: it has parameters for /ekf_node, and none for '
                '/pose_graph') in node.stderr()
        client.close()


def test_a_jump_of_odometry_is_logged(node: NodeProcess, client: Client) -> None:
    drive(client, 2.0, fixes=False)
    for step in range(20, 30):
        client.odom.publish(odometry(START + step / 10.0, 500.0 + 0.1 * step, 0.0, 0.0))
        client.spin_for(0.01)
    client.wait_processed(30)
    client.spin_until(lambda: client.values.get('odom.jump') == '1', 'it is counted')
    assert '[WARN]' in next(
        line for line in node.stderr().splitlines() if 'odom jumped by' in line)


def test_every_mistake_of_an_operator_is_answered(node: NodeProcess, client: Client) -> None:
    publisher = client.node.create_publisher(
        PoseWithCovarianceStamped, 'initialpose', RELIABLE)
    client.wait_matched()
    message = PoseWithCovarianceStamped()
    message.header.frame_id = 'nowhere'
    for count in range(1, 4):
        publisher.publish(message)
        client.spin_until(
            lambda n=count: node.stderr().count('the pose is not set: wrong_frame') == n,
            'it is answered')


@pytest.mark.parametrize('node', [('-p', 'sources:=[odom, global_pose, fix, imu]')], indirect=True)
def test_an_imu_at_its_usual_rate_is_no_warning(node: NodeProcess, client: Client) -> None:
    publisher = client.node.create_publisher(Imu, 'imu/data', RELIABLE)
    client.spin_until(lambda: publisher.get_subscription_count() > 0, 'it listens')
    for step in range(20):
        client.odom.publish(odometry_at(step / 10.0))
        publisher.publish(imu(START + step / 10.0, 0.0))
        client.spin_for(0.01)
    client.spin_until(lambda: int(client.values.get('imu.thinned', 0)) > 10, 'most are left out')
    (line,) = [line for line in node.stderr().splitlines() if 'imu: ' in line]
    assert '[INFO]' in line
