# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`ros2 param`, quality of service, and two robots on one machine: the real node over DDS."""

from array import array
from collections.abc import Mapping
from pathlib import Path
import signal

from circle import drive, fix_at, odometry_at, path_error
from harness import AS_A_USER, Client, NodeProcess, stamp_ns
import pytest
from rcl_interfaces.msg import Parameter
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rclpy.parameter import get_parameter_value, parameter_value_to_python
from rclpy.qos import QoSHistoryPolicy, QoSReliabilityPolicy
import yaml

from pose_graph_ros.adapters.parameter_texts import constraints
from pose_graph_ros.adapters.parameters import all_parameters, Change


def test_every_parameter_is_described(client: Client) -> None:
    names = client.call(client.node.create_client(
        ListParameters, 'pose_graph/list_parameters'), ListParameters.Request()).result.names
    own = {parameter.name: parameter for parameter in all_parameters({})}
    assert set(own) <= set(names)
    described = client.call(
        client.node.create_client(DescribeParameters, 'pose_graph/describe_parameters'),
        DescribeParameters.Request(names=list(own))).descriptors
    for descriptor in described:
        parameter = own[descriptor.name]
        assert parameter.description in descriptor.description
        assert descriptor.read_only == (parameter.change is Change.START)
        assert descriptor.additional_constraints == constraints(parameter)
        if parameter.smallest is not None:
            (interval,) = descriptor.floating_point_range
            assert (interval.from_value, interval.to_value) == (
                parameter.smallest, parameter.largest)


def test_periods_change_without_more_and_more_timers(
    tmp_path: Path, capfd: pytest.CaptureFixture[str],
) -> None:
    with NodeProcess(tmp_path, program=AS_A_USER) as node:
        with Client(int(node.env['ROS_DOMAIN_ID'])) as client:
            for frequency in (5.0, 6.0, 7.0):
                assert client.set_parameter('frequency', frequency) == (True, '')
            assert client.set_parameter('diagnostics_period', 30.0) == (True, '')
            client.diagnostics.clear()
            client.spin_for(1.0)
            assert len(client.diagnostics) <= 1, 'the last before'
            assert client.set_parameter('diagnostics_period', 0.05) == (True, '')
            client.spin_until(lambda: len(client.diagnostics) > 10, 'they come often')
        assert node.signal_and_wait(signal.SIGINT) == 0
    # the executor of rclpy prints that it has many timers
    assert 'timers' not in capfd.readouterr().out


def test_a_change_takes_effect_or_is_refused_with_the_reason(
    node: NodeProcess, client: Client,
) -> None:
    drive(client, 8.0)
    assert client.optimize().success
    before = int(client.values['hidden_nodes'])
    # 2 m/s: until now a node every half second, from now on every 2 s
    assert client.set_parameter('minimum_travel_distance', 4.0) == (True, '')
    assert client.set_parameter('minimum_travel_heading', 3) == (True, '')
    assert client.set_parameter('moving_node_interval', 10.0) == (True, '')
    drive(client, 28.0, begin=8.0)
    assert client.optimize().success
    added = int(client.values['hidden_nodes']) - before
    assert 9 <= added <= 12
    assert path_error(client) < 0.01

    for name, value, expected in (
            ('map_frame', 'world', 'configured'), ('odom.topic', 'elsewhere', 'configured'),
            ('sources', ['odom'], 'read-only'), ('fix.robust_loss', 'l1', 'none, huber, cauchy'),
            ('frequency', -1.0, 'range'), ('frequency', 'often', ''),
            ('datum', [48.0, 11.0], 'datum'), ('fix.lever_arm', [1.0], '2 numbers'),
            ('no_such_parameter', 1.0, 'is not known'),
            ('fix.sigma_celing', 1.0, 'did you mean fix.sigma_ceiling?'),
            ('fix.sigma_ceiling', 0.001, 'ceiling')):
        successful, reason = client.set_parameter(name, value)
        assert not successful, name
        assert expected in reason, (name, reason)
        assert reason != ''

    # together, and each by itself
    results = client.set_parameters({'path_period': 0.2, 'map_frame': 'world'})
    assert [successful for successful, _ in results] == [True, False]


def test_the_rate_of_the_diagnostics_changes_while_it_runs(
    node: NodeProcess, client: Client,
) -> None:
    def duration(of: int) -> float:
        return (stamp_ns(client.diagnostics[-1]) - stamp_ns(client.diagnostics[-1 - of])) * 1e-9

    assert client.set_parameter('diagnostics_period', 1.5) == (True, '')
    client.spin_until(lambda: len(client.diagnostics) > 1 and duration(of=1) > 1.0,
                      'they come rarely')
    assert client.set_parameter('diagnostics_period', 0.05) == (True, '')
    client.spin_until(lambda: len(client.diagnostics) > 10 and duration(of=10) < 1.5,
                      'they come often')


def test_qualities_of_service_are_as_asked(tmp_path: Path) -> None:
    overrides = ('-r', 'odom:=wheels/odom',
                 '-p', 'qos_overrides./wheels/odom.subscription.depth:=7',
                 '-p', 'qos_overrides./wheels/odom.subscription.reliability:=reliable',
                 '-p', 'qos_overrides./pose.publisher.reliability:=best_effort')
    with NodeProcess(tmp_path, overrides) as node, \
            Client(int(node.env['ROS_DOMAIN_ID']), odom='wheels/odom') as client:
        (heard,) = client.node.get_subscriptions_info_by_topic('/wheels/odom')
        assert heard.qos_profile.reliability is QoSReliabilityPolicy.RELIABLE
        if heard.qos_profile.history is QoSHistoryPolicy.KEEP_LAST:
            assert heard.qos_profile.depth == 7
        (published,) = client.node.get_publishers_info_by_topic('/pose')
        assert published.qos_profile.reliability is QoSReliabilityPolicy.BEST_EFFORT
        (fixes,) = client.node.get_subscriptions_info_by_topic('/gps/fix')
        assert fixes.qos_profile.reliability is QoSReliabilityPolicy.BEST_EFFORT


def test_two_robots_on_one_machine(tmp_path: Path) -> None:
    """Each in its namespace, with its frames: messages to one do not affect the other."""
    (tmp_path / 'b').mkdir()
    with NodeProcess(tmp_path, ('-r', '__ns:=/a', '-p', 'odom_frame:=a/odom')) as first:
        domain = int(first.env['ROS_DOMAIN_ID'])
        with NodeProcess(tmp_path / 'b', ('-r', '__ns:=/b', '-p', 'odom_frame:=b/odom'),
                         domain=domain) as _, \
                Client(domain, namespace='a') as one, Client(domain, namespace='b') as other:
            drive(one, 10.0)
            for step in range(30):
                other.odom.publish(odometry_at(step / 10.0))
                other.fix.publish(fix_at(step / 10.0))
                other.spin_for(0.002)
            other.wait_processed(60)
            assert one.optimize().success
            assert other.optimize().success
            assert one.values['odom.accepted'] == '100'
            assert other.values['odom.accepted'] == '30'
            assert len(one.paths[-1].poses) > len(other.paths[-1].poses)
            assert one.diagnostics[-1].status[0].name == '/a/pose_graph: pose graph'


@pytest.mark.parametrize('node', [('-r', '__node:=back_end')], indirect=True)
def test_it_can_have_another_name(node: NodeProcess) -> None:
    with Client(int(node.env['ROS_DOMAIN_ID']), name='back_end') as client:
        assert client.trigger('reset').success


def parameter_texts(client: Client) -> dict[str, str]:
    """Return what `ros2 param dump` writes of all parameters, by name."""
    create = client.node.create_client
    names = client.call(create(ListParameters, 'pose_graph/list_parameters'),
                        ListParameters.Request()).result.names
    values = client.call(create(GetParameters, 'pose_graph/get_parameters'),
                         GetParameters.Request(names=names)).values
    plain = [parameter_value_to_python(value) for value in values]
    return {name: str(list(value) if isinstance(value, array) else value)
            for name, value in zip(names, plain, strict=True)}


def load(client: Client, texts: Mapping[str, str]) -> dict[str, str]:
    """Set parameters as `ros2 param load` does; return the reasons of those that were refused."""
    parameters = [Parameter(name=name, value=get_parameter_value(text))
                  for name, text in texts.items()]
    results = client.call(client.node.create_client(SetParameters, 'pose_graph/set_parameters'),
                          SetParameters.Request(parameters=parameters)).results
    return {name: result.reason for name, result in zip(texts, results, strict=True)
            if not result.successful}


def test_what_param_dump_wrote_can_be_loaded_again(node: NodeProcess, client: Client) -> None:
    texts = parameter_texts(client)
    assert texts['datum'] == texts['fix.covariance_override'] == 'None'
    assert texts['qos_overrides./odom.subscription.depth'] == '1000'
    assert load(client, texts) == {}
    assert parameter_texts(client) == texts

    # what is unset there is unset again, and can be set again
    for _ in range(2):
        assert client.set_parameter('fix.covariance_override', [2.0]) == (True, '')
        assert load(client, texts) == {}
        assert parameter_texts(client)['fix.covariance_override'] == '[]'
    assert client.set_parameter('fix.covariance_override', [2.0]) == (True, '')
    assert load(client, {'fix.covariance_override': '[]'}) == {}

    # a read-only parameter with another value is refused as ever
    refused = load(client, {**texts, 'autostart': 'False', 'sources': '[odom]', 'frequncy': '1.0'})
    assert refused.keys() == {'autostart', 'sources', 'frequncy'}
    assert 'read-only' in refused['autostart']


def test_a_file_that_param_dump_wrote_can_be_given_again(tmp_path: Path) -> None:
    """What is not set is null there; `ros2 param dump` writes the values that it gets."""
    file = tmp_path / 'dumped.yaml'
    with NodeProcess(tmp_path) as node, Client(int(node.env['ROS_DOMAIN_ID'])) as client:
        names = [parameter.name for parameter in all_parameters({})]
        values = client.call(
            client.node.create_client(GetParameters, 'pose_graph/get_parameters'),
            GetParameters.Request(names=names)).values
        nested: dict[str, object] = {}
        for name, value in zip(names, values, strict=True):
            *groups, leaf = name.split('.')
            place = nested
            for group in groups:
                place = place.setdefault(group, {})
            plain = parameter_value_to_python(value)
            place[leaf] = list(plain) if isinstance(plain, array) else plain
        file.write_text(yaml.safe_dump({'/pose_graph': {'ros__parameters': nested}}))
        assert 'datum: null' in file.read_text()
    (tmp_path / 'b').mkdir()
    with NodeProcess(tmp_path / 'b', ('--params-file', str(file))) as node, \
            Client(int(node.env['ROS_DOMAIN_ID'])) as client:
        drive(client, 3.0)
        assert client.optimize().success
