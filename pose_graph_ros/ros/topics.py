# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The topics that the node reads, and a check of all its topics before it is configured.

Where a topic has two types, or a quality of service is wrong, rclpy and the middleware say too
little to find out which parameter to correct.
"""

from collections.abc import Iterator, Mapping
from typing import Any

from diagnostic_msgs.msg import KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped, TwistWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import (
    QoSDurabilityPolicy,
    QoSHistoryPolicy,
    QoSProfile,
    QoSReliabilityPolicy,
)
from sensor_msgs.msg import Imu, NavSatFix

from pose_graph_ros.adapters.sources import Kind, OUTPUTS as OUTPUT_TOPICS, source_list
from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.ros.publishers import OUTPUTS
from pose_graph_ros.ros.transforms import STATIC_TOPIC, TFMessage, TOPIC

CLASSES = {Kind.ODOMETRY: Odometry, Kind.FIX: NavSatFix, Kind.IMU: Imu,
           Kind.GLOBAL_POSE: PoseWithCovarianceStamped,
           Kind.LOOP_CLOSURE: PoseWithCovarianceStamped,
           Kind.TWIST: TwistWithCovarianceStamped, Kind.GYRO: Imu}
"""Class of the messages by kind of source."""
# Profiles are reliable if they do not say otherwise.
# The queue is deep since no odometry may be lost. A best-effort reader matches reliable and
# best-effort writers.
SENSOR_QOS = QoSProfile(depth=1000, reliability=QoSReliabilityPolicy.BEST_EFFORT)
LOOP_CLOSURE_QOS = QoSProfile(depth=100)  # a loop closure is rare and must not get lost
# Late subscribers receive the newest message of every broadcaster.
STATIC_QOS = QoSProfile(depth=100, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
SET_POSE_QOS = QoSProfile(depth=1)
JUDGE_QOS = QoSProfile(depth=100)

SET_POSE_TOPICS = ('initialpose', 'set_pose')
JUDGE_TOPIC = '~/judge'
OUTPUT = 'the output'
OVERRIDES = 'qos_overrides.'  # prefix of the parameters for the quality of service
CHOICES = {
    policy.__name__.removeprefix('QoS').removesuffix('Policy').lower():
    [name.lower() for name in policy.__members__ if name != 'UNKNOWN']
    for policy in (QoSHistoryPolicy, QoSReliabilityPolicy)}
"""Policies that can be overridden, with their values; `depth`, a number, is the third."""
LARGEST_DEPTH = 2**31 - 1


def check_topics(node: Node, values: Mapping[str, Any], overrides: Mapping[str, Any]) -> None:
    """
    Raise a `ConfigError` if the node cannot have its topics as they are set.

    Each topic, after remaps, must have one type and not be both published and read; overrides of
    the quality of service must be such that rclpy can take them.

    Parameters
    ----------
    values : mapping, all checked parameters
    overrides : mapping, values of the parameters given to the node, by name

    """
    used: dict[str, tuple[str, str, bool]] = {}
    entities: set[tuple[str, str]] = set()
    for user, name, message_type, published in _endpoints(values):
        topic, kind = node.resolve_topic_name(name), _type_name(message_type)
        first, other, output = used.setdefault(topic, (user, kind, published))
        if other != kind:
            raise ConfigError(f'{user}: expected a topic of {kind}, got {topic}, which {first} '
                              f'has with {other}')
        if output != published:
            raise ConfigError(
                f'{user}: expected a topic that the node does not publish, got {topic}, which is '
                f'{first}{_renamed(node, first)}')
        entities.add((topic, 'publisher' if published else 'subscription'))
    for name, value in sorted(overrides.items()):
        if name.startswith(OVERRIDES):
            _check_override(name, value, entities)


def _renamed(node: Node, output: str) -> str:
    """Return what to type so that an output has a topic of its own."""
    for name, (topic, *_) in OUTPUT_TOPICS.items():
        if output == f'{OUTPUT} {topic}':
            other = f'{node.get_fully_qualified_name()}/{name}'
            return (f': move that by {name}:={other} with ros2 launch, or by -p outputs.{name}:='
                    f'{other} with ros2 run, instead of a remap, which can move both')
    return ''


def _endpoints(values: Mapping[str, Any]) -> Iterator[tuple[str, str, type, bool]]:
    """Yield who uses a topic, the topic, the type of its messages, and whether it is an output."""
    for name, (topic, *_) in OUTPUT_TOPICS.items():
        yield f'{OUTPUT} {topic}', values[f'outputs.{name}'], OUTPUTS[topic][0], True
    if TFMessage is not None:
        yield f'{OUTPUT} {TOPIC}', TOPIC, TFMessage, True
        yield f'the input {STATIC_TOPIC}', STATIC_TOPIC, TFMessage, False
    for topic in SET_POSE_TOPICS:
        yield f'the input {topic}', topic, PoseWithCovarianceStamped, False
    yield f'the input {JUDGE_TOPIC}', JUDGE_TOPIC, KeyValue, False
    for source in source_list(values):
        yield f'parameter {source.name}.topic', source.topic, CLASSES[source.kind], False


def _type_name(message_type: type) -> str:
    return f'{message_type.__module__.partition(".")[0]}/msg/{message_type.__name__}'


def _check_override(name: str, value: object, entities: set[tuple[str, str]]) -> None:
    topic, _, rest = name.removeprefix(OVERRIDES).partition('.')
    entity, _, policy = rest.partition('.')
    if all(topic != own for own, _ in entities):
        return  # of another node, in a file for several
    if entity.partition('_')[0] not in ('publisher', 'subscription'):
        raise ConfigError(f'parameter {name}: expected {OVERRIDES}{topic}.publisher or '
                          f'.subscription, got {entity!r}')
    if (topic, entity) not in entities:
        return
    if policy == 'depth':
        if isinstance(value, bool) or not isinstance(value, int) or (
                not 0 <= value <= LARGEST_DEPTH):
            raise ConfigError(f'parameter {name}: expected a whole number in '
                              f'[0, {LARGEST_DEPTH}], got {value!r}')
    elif policy not in CHOICES:
        raise ConfigError(f'parameter {name}: expected one of the policies '
                          f'{", ".join(sorted((*CHOICES, "depth")))}, got {policy!r}')
    elif not isinstance(value, str) or value.lower() not in CHOICES[policy]:
        raise ConfigError(f'parameter {name}: expected one of {", ".join(CHOICES[policy])}, '
                          f'got {value!r}')
