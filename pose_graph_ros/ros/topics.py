# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The topics of the node: those that it reads, a check of all, and the transform from map to odom.

Where a topic has two types, or a quality of service is wrong, rclpy and the middleware say too
little to find out which parameter to correct. Of the transform it is about its speed, its stamps,
and others that publish it.
"""

from collections import Counter, deque
from collections.abc import Mapping
from copy import copy
from importlib import import_module
import math
import time
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSDurabilityPolicy, QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription

from pose_graph_ros.adapters import output_cdr
from pose_graph_ros.adapters.conversions import frame, stamp_ns
from pose_graph_ros.adapters.parameter_table import OUTPUTS
from pose_graph_ros.adapters.sources import GLOBAL_POSE, source_list
from pose_graph_ros.core.alignment import AlignmentState
from pose_graph_ros.core.estimate import Estimate
from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.measurements import OdometrySample
from pose_graph_ros.ros.spinning import guarded


def message_class(type_name: str) -> Any:
    """Return the class of messages of a type, such as nav_msgs/msg/Odometry."""
    package, _, name = type_name.partition('/msg/')
    return getattr(import_module(f'{package}.msg'), name)


TF_TYPE = 'tf2_msgs/msg/TFMessage'
try:
    TFMessage = message_class(TF_TYPE)
except ImportError:  # ROS 2 from PyPI lacks tf2_msgs until it is built
    TFMessage = None

# The profile of tf2_ros, which is reliable.
TF_QOS = QoSProfile(depth=100)
TOPIC, STATIC_TOPIC = '/tf', '/tf_static'
# Reading all of /tf costs as much as odometry: how long it is read, and the period of that [s].
LISTENING, PAUSE = 2.0, 30.0


def overridable(profile: QoSProfile) -> dict[str, Any]:
    """Return the arguments of a publisher or subscription whose parameters override a profile."""
    return {'qos_profile': copy(profile),  # rclpy writes the overrides into it
            'qos_overriding_options': QoSOverridingOptions.with_default_policies()}


def other_publishers(node: Node, topic: str) -> list[str]:
    """Return the full names of the other nodes that publish a topic, which may be like its own."""
    names = Counter(
        f'{info.node_namespace.rstrip("/")}/{info.node_name}'
        for info in node.get_publishers_info_by_topic(topic)
        if info.node_name != '_NODE_NAME_UNKNOWN_')   # until rmw has found out
    names -= Counter([node.get_fully_qualified_name()])
    return sorted(names)


# Profiles are reliable if they do not say otherwise.
# The queue is deep since no odometry may be lost. A best-effort reader matches reliable and
# best-effort writers.
SENSOR_QOS = QoSProfile(depth=1000, reliability=QoSReliabilityPolicy.BEST_EFFORT)
CLOSURE_QOS = QoSProfile(depth=100)     # a loop closure is rare and must not get lost
JUDGE_TOPIC = '~/judge'
INPUTS = {'initialpose': (GLOBAL_POSE.message_type, QoSProfile(depth=1)),
          'set_pose': (GLOBAL_POSE.message_type, QoSProfile(depth=1)),
          JUDGE_TOPIC: ('diagnostic_msgs/msg/KeyValue', QoSProfile(depth=100))}
"""Messages and quality of service by topic, but for the sources."""
if TFMessage is not None:   # late subscribers receive the newest message of every broadcaster
    INPUTS[STATIC_TOPIC] = TF_TYPE, QoSProfile(
        depth=100, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)

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
        if name.startswith(OVERRIDES) and topic in used and entity == (
                'subscription' if used[topic][2] == '' else 'publisher'):
            _check_override(name, policy, value)


def moved(node: Node, output: str) -> str:
    """Return how an output gets a topic of its own."""
    own = f'{output}:={node.get_fully_qualified_name()}/{output}'
    return f'by {own} with ros2 launch, or by -p outputs.{own} with ros2 run'


def _check_override(name: str, policy: str, value: object) -> None:
    if policy == 'depth':
        expected, good = 'a whole number from 0 on', type(value) is int and 0 <= value < 2**31
    elif policy in CHOICES:
        expected = f'one of {", ".join(CHOICES[policy])}'
        good = str(value).lower() in CHOICES[policy]
    else:
        expected, value, good = f'depth, {" or ".join(CHOICES)} as the policy', policy, False
    if not good:
        raise ConfigError(f'parameter {name}: expected {expected}, got {value!r}')


# --- the transform from map to odom

class TransformPublisher:
    """Publishes the transform from map to odom, each with a newer stamp than the one before."""

    def __init__(self, node: Node, publisher: Publisher, map_frame: str, odom_frame: str) -> None:
        self._node, self._publisher = node, publisher
        self._map_frame, self._odom_frame = map_frame, odom_frame
        self._newest_ns, self._aligned, self.slew = 0, False, Slew()
        # its newest, to recognise them
        self._own: deque[tuple[int, float, float]] = deque(maxlen=2000)
        self._subscription: Subscription | None = None
        self._since = -float('inf')
        self.other = ''  # warning about another publisher of the transform; empty if there is none

    def publish(
        self, estimate: Estimate, sample: OdometrySample, offset_ns: int,
        limits: tuple[float, float],
    ) -> None:
        """Publish the transform at odometry, unless its stamp is not newer than the last one."""
        if (estimate.alignment is AlignmentState.ALIGNED) != self._aligned:
            # the map frame itself has moved, which is no correction of the pose
            self._aligned = not self._aligned
            self.slew = Slew()
        T_map_odom = self.slew.limited(sample.stamp_ns, estimate.T_map_odom, sample.pose, *limits)
        at_ns = sample.stamp_ns + offset_ns
        if at_ns <= self._newest_ns:
            return
        self._newest_ns = at_ns
        self._own.append((at_ns, float(T_map_odom[0]), math.sin(T_map_odom[2] / 2.0)))
        self._publisher.publish(output_cdr.transform_cdr(
            at_ns, T_map_odom, self._map_frame, self._odom_frame))

    def forget(self) -> None:
        """Let the next transform have any stamp, and be without limits."""
        self._newest_ns, self._aligned, self.slew = 0, False, Slew()

    def check_for_others(self) -> None:
        """Listen to /tf for a while if other nodes publish there; to be called periodically."""
        silence = time.monotonic() - self._since
        if self._subscription is not None:
            if silence > LISTENING:
                self._stop_listening()
        # by endpoint: a second instance of this node, started by mistake, has the same name
        elif self.other == '' and silence > PAUSE and self._node.count_publishers(TOPIC) > 1:
            self._since = time.monotonic()
            self._subscription = self._node.create_subscription(
                TFMessage, TOPIC, guarded(self._on_transforms, lambda: True), TF_QOS, raw=True)

    def close(self) -> None:
        """Destroy the publisher and the subscription."""
        self._stop_listening()
        self._node.destroy_publisher(self._publisher)

    def _stop_listening(self) -> None:
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None

    def _on_transforms(self, data: bytes) -> None:
        # most transforms are of the robot's joints: not worth a deserialisation
        if self._odom_frame.encode() not in data or self.other != '':
            return
        for transform in deserialize_message(data, TFMessage).transforms:
            parent, t = frame(transform.header.frame_id), transform.transform
            if frame(transform.child_frame_id) != self._odom_frame or (
                    stamp_ns(transform), t.translation.x, t.rotation.z) in self._own:
                continue
            names = ' or '.join(other_publishers(self._node, TOPIC))
            names = names and f', by {names}'
            wrong = '' if parent == self._map_frame else ', so that it has two parents'
            self.other = (f'another node publishes {parent} -> {self._odom_frame} on '
                          f'{self._node.resolve_topic_name(TOPIC)}{names}{wrong}: set publish_tf '
                          'of one of the two to false; if it is that of another robot, give each '
                          'a namespace and its own tf, with remap_tf:=true of the launch file or '
                          '-r /tf:=tf -r /tf_static:=tf_static')
            return


class Slew:
    """
    Limits the speed at which corrections move the robot in the published transform.

    A small turn of the odometry frame moves a robot far from its origin by much, so the limits
    hold at the robot. They do not affect the graph.
    """

    def __init__(self) -> None:
        self._last: FloatArray | None = None
        self._stamp_ns = 0

    def limited(
        self, stamp_ns: int, T_map_odom: FloatArray, T_odom_base: FloatArray, linear: float,
        angular: float,
    ) -> FloatArray:
        """
        Return the transform from map to odom to publish, given the estimate and odometry now.

        The limits are the greatest speeds of corrections at the robot [m/s, rad/s]; 0: no limit.
        """
        if self._last is not None and (linear > 0.0 or angular > 0.0):
            elapsed = (stamp_ns - self._stamp_ns) * 1e-9
            shown = se2.compose(self._last, T_odom_base)
            step = se2.compose(T_map_odom, T_odom_base) - shown
            step[2] = se2.wrap(step[2])
            distance, turn = math.hypot(step[0], step[1]), abs(float(step[2]))
            if 0.0 < linear * elapsed < distance:
                step[:2] *= linear * elapsed / distance
            if 0.0 < angular * elapsed < turn:
                step[2] *= angular * elapsed / turn
            T_map_odom = se2.compose(
                se2.wrapped(np.asarray(shown + step)), se2.inverse(T_odom_base))
        self._last, self._stamp_ns = T_map_odom, stamp_ns
        return T_map_odom
