# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Topics that the node cannot have, and bad overrides of their quality of service."""

from collections.abc import Iterator
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not there: no rclpy')

import rclpy
from rclpy.context import Context
from rclpy.node import Node

from pose_graph_ros.adapters.parameters import checked
from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.ros.topics import check_topics


@pytest.fixture(scope='module')
def node() -> Iterator[Node]:
    context = Context()
    rclpy.init(context=context, args=['--ros-args', '-r', 'same:=odom', '-r', '__ns:=/robot'])
    made = Node('pose_graph', context=context, start_parameter_services=False)
    yield made
    made.destroy_node()
    rclpy.shutdown(context=context)


def check(node: Node, values: dict[str, Any], overrides: dict[str, Any] | None = None) -> None:
    check_topics(node, checked(values), overrides or {})


@pytest.mark.parametrize('values', [
    {}, {'sources': ['odom', 'fix', 'rear'], 'rear.type': 'fix', 'rear.topic': 'gps/fix'},
    {'global_pose.topic': 'set_pose'}, {'odom.topic': '/path'},
    {'odom.topic': 'odometry/filtered', 'outputs.filtered_odometry': 'pose_graph/odometry'},
    {'odom.topic': 'path', 'outputs.path': 'odom'}])
def test_topics_may_be_shared_by_inputs_of_one_type(node: Node, values: dict[str, Any]) -> None:
    check(node, values)


@pytest.mark.parametrize(('values', 'said'), [
    ({'fix.topic': 'odom'}, r'fix\.topic: expected a topic of sensor_msgs/msg/NavSatFix, got '
     r'/robot/odom, which parameter odom\.topic has with nav_msgs/msg/Odometry'),
    ({'fix.topic': '/robot/odom'}, r'fix\.topic: '), ({'fix.topic': 'same'}, r'fix\.topic: '),
    ({'odom.topic': 'path'}, r'odom\.topic: .* got /robot/path, which the output path has with '
     'nav_msgs/msg/Path'),
    ({'odom.topic': 'odometry/filtered'}, r'odom\.topic: expected a topic that the node does not '
     'publish, got /robot/odometry/filtered'),
    ({'fix.topic': 'initialpose'}, 'the input initialpose has'),
    ({'outputs.pose': 'x', 'global_pose.topic': 'x'}, r'global_pose\.topic: .* got /robot/x, '
     'which is the output pose: move that by pose:=/robot/pose_graph/pose with ros2 launch, or '
     'by -p '
     'outputs.pose:=/robot/pose_graph/pose with ros2 run')])
def test_a_topic_has_one_type_and_one_direction(
    node: Node, values: dict[str, Any], said: str,
) -> None:
    with pytest.raises(ConfigError, match=said) as caught:
        check(node, values)
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize(('name', 'value'), [
    ('/robot/odom.subscription.depth', 7), ('/robot/odom.subscription.history', 'KEEP_ALL'),
    ('/robot/path.publisher.reliability', 'best_effort'), ('/robot/odom.publisher.depth', 'x'),
    ('/scan.subscription.reliability', 'x'), ('', 1)])
def test_overrides_are_taken_and_those_of_other_nodes_ignored(
    node: Node, name: str, value: object,
) -> None:
    check(node, {}, {f'qos_overrides.{name}': value, 'frequency': 5.0})


@pytest.mark.parametrize(('name', 'value', 'said'), [
    ('subscription.reliability', 'bestefort', "expected one of .*best_effort.* got 'bestefort'"),
    ('subscription.history', 1, 'expected one of .*keep_all.* got 1'),
    ('subscription.depth', -1, 'expected a whole number from 0 on, got -1'),
    ('subscription.depth', True, 'expected a whole number'),
    ('subscription.reliabilty', 'reliable', "got 'reliabilty'")])
def test_a_bad_override_is_refused_with_what_was_expected(
    node: Node, name: str, value: object, said: str,
) -> None:
    with pytest.raises(ConfigError, match=said) as caught:
        check(node, {}, {f'qos_overrides./robot/odom.{name}': value})
    assert str(caught.value).startswith(f'parameter qos_overrides./robot/odom.{name}: ')
    assert '\n' not in str(caught.value)
