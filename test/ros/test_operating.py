# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Lifecycle, names and qualities of service, over DDS."""

from pathlib import Path
import signal

from circle import drive, odometry_at
from harness import Client, NodeProcess, TFMessage
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.qos import QoSReliabilityPolicy
import yaml

from pose_graph_ros.adapters import launch_arguments


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
