# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The topics of the node: those that it reads, and a check of all.

Where a topic has two types, or a quality of service is wrong, rclpy and the middleware say too
little to find out which parameter to correct.
"""

from collections import Counter
from collections.abc import Mapping
from copy import copy
from importlib import import_module
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from pose_graph_ros.adapters.parameter_table import OUTPUTS
from pose_graph_ros.adapters.sources import GLOBAL_POSE, source_list
from pose_graph_ros.core.exceptions import ConfigError


def message_class(type_name: str) -> Any:
    """Return the class of messages of a type, such as nav_msgs/msg/Odometry."""
    package, _, name = type_name.partition('/msg/')
    return getattr(import_module(f'{package}.msg'), name)


TF_TYPE = 'tf2_msgs/msg/TFMessage'
try:
    TFMessage = message_class(TF_TYPE)
except ImportError:  # ROS 2 from PyPI lacks tf2_msgs until it is built
    TFMessage = None

TOPIC, STATIC_TOPIC = '/tf', '/tf_static'


def overridable(profile: QoSProfile) -> dict[str, Any]:
    """Return the arguments of a publisher or subscription whose parameters override a profile."""
    return {'qos_profile': copy(profile),  # rclpy writes the overrides into it
            'qos_overriding_options': QoSOverridingOptions.with_default_policies()}


def other_publishers(node: Node, topic: str) -> list[str]:
    """Return the full names of the other nodes that publish a topic, which may be like its own."""
    return sorted(Counter(
        f'{info.node_namespace.rstrip("/")}/{info.node_name}'
        for info in node.get_publishers_info_by_topic(topic)
        if info.node_name != '_NODE_NAME_UNKNOWN_')     # until rmw has found out
        - Counter([node.get_fully_qualified_name()]))


# Profiles are reliable if they do not say otherwise.
# The queue is deep since no odometry may be lost. A best-effort reader matches reliable and
# best-effort writers.
SENSOR_QOS = QoSProfile(depth=1000, reliability=QoSReliabilityPolicy.BEST_EFFORT)
CLOSURE_QOS = QoSProfile(depth=100)     # a loop closure is rare and must not get lost
# Late subscribers receive the newest message at once, of static frames that of every broadcaster.
LATCHED_QOS = QoSProfile(depth=1, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
STATIC_QOS = QoSProfile(depth=100, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
JUDGE_TOPIC = '~/judge'
INPUTS = {'initialpose': (GLOBAL_POSE.message_type, QoSProfile(depth=1)),
          'set_pose': (GLOBAL_POSE.message_type, QoSProfile(depth=1)),
          JUDGE_TOPIC: ('diagnostic_msgs/msg/KeyValue', QoSProfile(depth=100))}
"""Messages and quality of service by topic, but for the sources."""
if TFMessage is not None:
    INPUTS[STATIC_TOPIC] = TF_TYPE, STATIC_QOS

OVERRIDES = 'qos_overrides.'  # prefix of the parameters for the quality of service
CHOICES = {
    policy.__name__.removeprefix('QoS').removesuffix('Policy').lower():
    [name.lower() for name in policy.__members__ if name != 'UNKNOWN']
    for policy in (QoSHistoryPolicy, QoSReliabilityPolicy)}
"""Policies that can be overridden, with their values; `depth`, a number, is the third."""


def check_topics(node: Node, values: Mapping[str, Any], overrides: Mapping[str, Any]) -> None:
    """
    Raise a `ConfigError` if the node cannot have its topics as they are set.

    Each topic, after remaps, must have one type and not be both published and read; overrides of
    the quality of service must be such that rclpy can take them.
    """
    used: dict[str, tuple[str, str, str]] = {}
    for user, name, kind, output in (
            *((f'the output {topic}', values[f'outputs.{name}'], kind, name)
              for name, (topic, kind, _) in OUTPUTS.items()),
            (f'the output {TOPIC}', TOPIC, TF_TYPE, TOPIC),
            *((f'the input {topic}', topic, kind, '') for topic, (kind, _) in INPUTS.items()),
            *((f'parameter {source.name}.topic', source.topic, source.kind.message_type, '')
              for source in source_list(values))):
        topic = node.resolve_topic_name(name)
        first, other, published = used.setdefault(topic, (user, kind, output))
        if other != kind:
            raise ConfigError(f'{user}: expected a topic of {kind}, got {topic}, which {first} '
                              f'has with {other}')
        if published != '' and output == '':
            hint = f': move that {moved(node, published)}, instead of a remap, which moves both'
            raise ConfigError(f'{user}: expected a topic that the node does not publish, got '
                              f'{topic}, which is {first}{hint if published in OUTPUTS else ""}')
    for name, value in sorted(overrides.items()):
        topic, _, rest = name.removeprefix(OVERRIDES).partition('.')
        entity, _, policy = rest.partition('.')
        # others are of other nodes, in a file for several
        if not name.startswith(OVERRIDES) or topic not in used or entity != (
                'subscription' if used[topic][2] == '' else 'publisher'):
            continue
        if policy == 'depth':
            expected, good = 'a whole number from 0 on', type(value) is int and 0 <= value < 2**31
        elif policy in CHOICES:
            expected = f'one of {", ".join(CHOICES[policy])}'
            good = str(value).lower() in CHOICES[policy]
        else:
            raise ConfigError(f'parameter {name}: expected depth, {" or ".join(CHOICES)} as the '
                              f'policy, got {policy!r}')
        if not good:
            raise ConfigError(f'parameter {name}: expected {expected}, got {value!r}')


def moved(node: Node, output: str) -> str:
    """Return how an output gets a topic of its own."""
    own = f'{output}:={node.get_fully_qualified_name()}/{output}'
    return f'by {own} with ros2 launch, or by -p outputs.{own} with ros2 run'
