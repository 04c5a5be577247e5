# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Lifecycle, `ros2 param`, names, qualities of service, and what is around the node: over DDS."""

from array import array
from collections.abc import Mapping
from pathlib import Path
import signal

from circle import drive, fix_at, odometry_at
from geometry_msgs.msg import PoseWithCovarianceStamped
from harness import Client, NodeProcess, RELIABLE, stamp_ns, TFMessage, transform
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
import pytest
from rcl_interfaces.msg import Parameter
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rclpy.parameter import get_parameter_value, parameter_value_to_python
from rclpy.qos import QoSReliabilityPolicy
import yaml

from pose_graph_ros.adapters import launch_arguments
from pose_graph_ros.adapters.parameter_table import Change
from pose_graph_ros.adapters.parameter_texts import constraints
from pose_graph_ros.adapters.parameters import all_parameters


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


def test_it_waits_for_its_manager_and_goes_through_all_states(tmp_path: Path) -> None:
    file = tmp_path / 'others.yaml'
    file.write_text('ekf_node:\n  ros__parameters: {frequency: 5.0}\n')
    arguments = ('-p', 'autostart:=false', '-p', 'fix.sigma_floor:=[0.1, 3.0]',
                 '--params-file', str(file))
    with NodeProcess(tmp_path, arguments) as node:
        client = Client(int(node.env['ROS_DOMAIN_ID']))
        manager = Manager(client)
        assert manager.state == State.PRIMARY_STATE_UNCONFIGURED
        assert client.diagnostics == []
        assert client.odom.get_subscription_count() == 0
        assert 'waiting for the transition configure' in node.stderr()
        assert f'{file} has no effect: it has parameters for /ekf_node' in node.stderr()

        # what does not go together is mended while it is unconfigured
        for parameter, wrong, right in (
                ('fix.sigma_floor', [0.1, 3.0], [0.1, 0.1]), ('fix.topic', '/odom', '/gps/fix')):
            client.set_parameter(parameter, wrong)
            assert not manager.change(Transition.TRANSITION_CONFIGURE)
            assert manager.state == State.PRIMARY_STATE_UNCONFIGURED
            assert client.set_parameter(parameter, right) == (True, '')
        for words in ('fix.sigma_floor', 'parameter fix.topic: expected a topic of'):
            assert any('no transition: ' in line and words in line
                       for line in node.stderr().splitlines())

        assert manager.change(Transition.TRANSITION_CONFIGURE)
        assert manager.state == State.PRIMARY_STATE_INACTIVE
        client.spin_until(lambda: len(client.diagnostics) > 0, 'it tells of itself')
        assert 'Inactive' in client.diagnostics[-1].status[0].message
        assert client.odom.get_subscription_count() == 0
        assert manager.change(Transition.TRANSITION_ACTIVATE)
        client.wait_for_the_node()
        drive(client, 8.0)
        assert client.optimize().success
        nodes = client.values['hidden_nodes']

        # the graph is kept while the node is inactive, and grows when it is active again
        assert manager.change(Transition.TRANSITION_DEACTIVATE)
        client.spin_until(lambda: client.odom.get_subscription_count() == 0, 'nobody listens')
        client.wait_values({'active': '0', 'hidden_nodes': nodes})
        assert manager.change(Transition.TRANSITION_ACTIVATE)
        client.wait_for_the_node()
        drive(client, 10.0, begin=8.0)
        assert client.optimize().success
        assert int(client.values['hidden_nodes']) > int(nodes)
        assert 'odom.jump' not in client.values

        # a clean-up discards it
        assert manager.change(Transition.TRANSITION_DEACTIVATE)
        assert manager.change(Transition.TRANSITION_CLEANUP)
        client.spin_until(lambda: client.node.count_publishers('/diagnostics') == 0, 'silence')
        assert manager.change(Transition.TRANSITION_CONFIGURE)
        assert manager.change(Transition.TRANSITION_ACTIVATE)
        client.wait_values({'received': '0'})
        assert 'hidden_nodes' not in client.values
        assert manager.change(Transition.TRANSITION_ACTIVE_SHUTDOWN)
        assert manager.state == State.PRIMARY_STATE_FINALIZED
        client.close()
        assert node.signal_and_wait(signal.SIGTERM) == 0
        assert 'Traceback' not in node.stderr()


def values_of(client: Client, names: list[str]) -> dict[str, object]:
    values = client.call(
        client.node.create_client(GetParameters, 'pose_graph/get_parameters'),
        GetParameters.Request(names=names)).values
    plain = [parameter_value_to_python(value) for value in values]
    return {name: list(value) if isinstance(value, array) else value
            for name, value in zip(names, plain, strict=True)}


def load(client: Client, texts: Mapping[str, str]) -> dict[str, str]:
    """Set parameters as `ros2 param load` does; return the reasons of those that were refused."""
    parameters = [Parameter(name=name, value=get_parameter_value(text))
                  for name, text in texts.items()]
    results = client.call(client.node.create_client(SetParameters, 'pose_graph/set_parameters'),
                          SetParameters.Request(parameters=parameters)).results
    return {name: result.reason for name, result in zip(texts, results, strict=True)
            if not result.successful}


def test_parameters_are_described_changed_refused_dumped_and_loaded(tmp_path: Path) -> None:
    with NodeProcess(tmp_path, ('-p', 'frequncy:=3.0')) as node, \
            Client(int(node.env['ROS_DOMAIN_ID'])) as client:
        assert 'frequncy is not known: did you mean frequency?' in node.stderr()
        own = {parameter.name: parameter for parameter in all_parameters({})}
        names = client.call(client.node.create_client(
            ListParameters, 'pose_graph/list_parameters'), ListParameters.Request()).result.names
        assert set(own) <= set(names)
        described = client.call(
            client.node.create_client(DescribeParameters, 'pose_graph/describe_parameters'),
            DescribeParameters.Request(names=list(own))).descriptors
        for descriptor in described:
            parameter = own[descriptor.name]
            assert parameter.description in descriptor.description
            assert descriptor.read_only == (parameter.change is Change.START)
            assert descriptor.additional_constraints == constraints(parameter)

        drive(client, 4.0)
        assert client.optimize().success
        assert client.set_parameter('minimum_travel_distance', 4) == (True, '')
        for name, value, expected in (
                ('map_frame', 'world', 'configured'), ('sources', ['odom'], 'read-only'),
                ('fix.robust_loss', 'l1', 'none, huber, cauchy'), ('frequency', -1.0, 'range'),
                ('frequency', 'often', ''), ('fix.lever_arm', [1.0], '2 numbers'),
                ('fix.covariance_scal', 1.0, 'did you mean fix.covariance_scale?'),
                ('fix.sigma_ceiling', 1.0, 'no longer exists')):
            successful, reason = client.set_parameter(name, value)
            assert not successful, name
            assert reason != ''
            assert expected in reason, (name, reason)
        results = client.set_parameters({'path_period': 0.2, 'map_frame': 'world'})
        assert [successful for successful, _ in results] == [True, False]

        def duration() -> float:
            return (stamp_ns(client.diagnostics[-1]) - stamp_ns(client.diagnostics[-10])) * 1e-9
        assert client.set_parameter('diagnostics_period', 0.02) == (True, '')
        client.spin_until(lambda: len(client.diagnostics) > 9 and duration() < 0.5, 'they hurry')

        # what `ros2 param dump` wrote can be loaded again
        values = values_of(client, names)
        assert values['datum'] is values['fix.covariance_override'] is None
        assert values['qos_overrides./odom.subscription.depth'] == 1000
        texts = {name: str(value) for name, value in values.items()}
        assert load(client, texts) == {}
        assert values_of(client, names) == values
        for _ in range(2):  # what is unset there is unset again, and can be set again
            assert client.set_parameter('fix.covariance_override', [2.0]) == (True, '')
            assert load(client, texts) == {}
            assert values_of(client, ['fix.covariance_override']) == {
                'fix.covariance_override': []}
        refused = load(client, {**texts, 'autostart': 'False', 'sources': '[odom]'})
        assert refused.keys() == {'autostart', 'sources'}

    # and given to another node as a file
    nested: dict[str, object] = {}
    for name, value in values.items():
        if name in own:
            *groups, leaf = name.split('.')
            place = nested
            for group in groups:
                place = place.setdefault(group, {})
            place[leaf] = value
    file, folder = tmp_path / 'dumped.yaml', tmp_path / 'b'
    folder.mkdir()
    file.write_text(yaml.safe_dump({'/pose_graph': {'ros__parameters': nested}}))
    with NodeProcess(folder, ('--params-file', str(file))) as node, \
            Client(int(node.env['ROS_DOMAIN_ID'])) as client:
        assert values_of(client, ['minimum_travel_distance']) == {'minimum_travel_distance': 4.0}
        client.wait_values({'datum': 'none'})
        assert node.stderr().count('WARN') == 0


def launched(folder: Path, **given: str) -> list[str]:
    """Return the arguments that launch gives to the node."""
    own = launch_arguments.arguments(Path(__file__).resolve().parents[2])
    given = {name: default for name, (default, _) in own.items()} | given
    (folder / 'own.yaml').write_text(yaml.safe_dump({f'{given["namespace"]}/{given["name"]}': {
        'ros__parameters': launch_arguments.parameters(given)}}))
    remaps = [('__ns', given['namespace']), ('__node', given['name']),
              *launch_arguments.remappings(given)]
    return ['--params-file', launch_arguments.parameter_file(given),
            '--params-file', str(folder / 'own.yaml'),
            *(word for name, new in remaps for word in ('-r', f'{name}:={new}'))]


def test_two_robots_on_one_machine_have_names_frames_and_qualities_of_their_own(
    tmp_path: Path,
) -> None:
    """One as the launch file starts it, one by hand: messages to one do not affect the other."""
    (tmp_path / 'b').mkdir()
    file = tmp_path / 'user.yaml'
    file.write_text(yaml.safe_dump({'/**': {'ros__parameters': {
        'odom': {'topic': '/from_file'}, 'use_sim_time': False, 'map_frame': 'world'}}}))
    first = launched(tmp_path, params_file=str(file), namespace='/a', odom='/wheels', path='/way',
                     name='back_end')
    second = ('-r', '__ns:=/b', '-r', 'odom:=wheels', '-p', 'odom_frame:=b/odom',
              '-p', 'transform_time_offset:=0.5',
              '-p', 'qos_overrides./b/wheels.subscription.reliability:=reliable',
              '-p', 'qos_overrides./b/pose.publisher.reliability:=best_effort')
    with NodeProcess(tmp_path, first) as node, \
            NodeProcess(tmp_path / 'b', second, domain=int(node.env['ROS_DOMAIN_ID'])), \
            Client(int(node.env['ROS_DOMAIN_ID']), 'a', '/wheels', name='back_end') as one, \
            Client(int(node.env['ROS_DOMAIN_ID']), 'b', 'wheels') as other:
        drive(one, 5.0, fixes=False)
        for step in range(30):
            message = odometry_at(step / 10.0)
            message.header.frame_id = '/b/odom'
            other.odom.publish(message)
        other.wait_values({'odom.accepted': '30'})
        one.wait_values({'odom.accepted': '50', 'received': '50'})
        assert one.trigger('optimize').success
        assert one.diagnostics[-1].status[0].name == '/a/back_end: pose graph'
        one.spin_until(lambda: len(one.poses) > 0, 'poses come')
        assert one.poses[-1].header.frame_id == 'world'

        published = one.node.get_publishers_info_by_topic
        heard = one.node.get_subscriptions_info_by_topic
        assert heard('/from_file') == []
        assert len(published('/way')) == 1
        names = {name for name, _ in one.node.get_topic_names_and_types()}
        assert {'/a/pose', '/a/odometry/filtered', '/b/path', '/diagnostics'} <= names
        services = {name for name, _ in one.node.get_service_names_and_types()}
        assert {'/a/back_end/save_graph', '/b/pose_graph/optimize'} <= services
        reliable = QoSReliabilityPolicy.RELIABLE
        assert [info.qos_profile.reliability is reliable for topic in ('/b/wheels', '/b/gps/fix')
                for info in heard(topic)] == [True, False]
        assert [info.qos_profile.reliability is reliable for info in published('/b/pose')] == [
            False]
        if TFMessage is not None:
            # the launch file gives each its own, the other one has that of all
            assert len(published('/a/tf')) == len(published('/tf')) == 1
            for step in range(30, 35):
                message = odometry_at(step / 10.0)
                message.header.frame_id = 'b/odom'
                other.odom.publish(message)
            other.spin_until(lambda: len(other.transforms) >= 5, 'transforms come')
            assert {(item.header.frame_id, item.child_frame_id) for item in other.transforms} == {
                ('map', 'b/odom')}
            assert stamp_ns(other.transforms[-1]) % 10**9 in {
                (stamp_ns(odometry_at(step / 10.0)) + 5 * 10**8) % 10**9 for step in range(35)}


@pytest.mark.parametrize('node', [
    ('-p', 'sources:=[odom, global_pose, fix, rear]', '-p', 'rear.type:=fix',
     '-r', 'rear:=/gnss')], indirect=True)
def test_mistakes_around_the_node_are_logged_once(node: NodeProcess, client: Client) -> None:
    """Wrong topics and frames, and others that publish."""
    client.node.create_publisher(PoseWithCovarianceStamped, 'pose', RELIABLE)
    other = None if TFMessage is None else client.node.create_publisher(TFMessage, '/tf', RELIABLE)
    said = [
        '/pose is published by /client as well: give one of them another topic',
        'rear listens to /gnss for sensor_msgs/msg/NavSatFix, but nobody publishes it; there is '
        '/gps/fix',
        "odom has the child_frame_id 'base_footprint', but the parameter base_link_frame is",
        'fix has no frame_id: its antenna is taken to be in base_link: set fix.lever_arm',
        *(['another node publishes map -> odom on /tf'] if other else [])]
    lone = fix_at(0.1)
    lone.header.frame_id = ''
    client.fix.publish(lone)
    step = 0

    def all_is_said() -> bool:
        nonlocal step
        step += 1
        message = odometry_at(step / 20.0)
        message.child_frame_id = 'base_footprint'
        client.odom.publish(message)
        if other is not None:
            # others are no conflict
            other.publish(TFMessage(transforms=[
                transform('odom', 'base_link', seconds=float(step)),
                transform('map', 'odom', seconds=float(step))]))
        return all(words in node.stderr() for words in said)

    client.spin_until(all_is_said, 'all is said')
    assert client.diagnostics[-1].status[0].level == b'\x01'
    client.wait_current()
    for words in said:
        (line,) = [line for line in node.stderr().splitlines() if words in line]
        assert '[WARN]' in line
