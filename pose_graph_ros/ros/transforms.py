# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The transform from map to odom: its speed, its stamps, and others that publish it."""

from collections import Counter, deque
from importlib import import_module
import math
import time
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription

from pose_graph_ros.adapters import output_cdr
from pose_graph_ros.adapters.conversions import frame, stamp_ns
from pose_graph_ros.core.alignment.monitor import AlignmentState
from pose_graph_ros.core.estimate import Estimate
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


def other_publishers(node: Node, topic: str) -> list[str]:
    """Return the full names of the other nodes that publish a topic, which may be like its own."""
    names = Counter(
        f'{info.node_namespace.rstrip("/")}/{info.node_name}'
        for info in node.get_publishers_info_by_topic(topic)
        if info.node_name != '_NODE_NAME_UNKNOWN_')   # until rmw has found out
    names -= Counter([node.get_fully_qualified_name()])
    return sorted(names)


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
            parent = frame(transform.header.frame_id)
            t = transform.transform
            if frame(transform.child_frame_id) != self._odom_frame or (
                    stamp_ns(transform), t.translation.x, t.rotation.z) in self._own:
                continue
            names = ' or '.join(other_publishers(self._node, TOPIC))
            names = names and f', by {names}'
            wrong = '' if parent == self._map_frame else ', so that it has two parents'
            self.other = (
                f'another node publishes {parent} -> {self._odom_frame} on '
                f'{self._node.resolve_topic_name(TOPIC)}{names}{wrong}: set publish_tf of one of '
                'the two to false; if it is that of another robot, give each a namespace and its '
                'own tf, with remap_tf:=true of the launch file or -r /tf:=tf '
                '-r /tf_static:=tf_static')
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
            wanted = se2.compose(T_map_odom, T_odom_base)
            step = wanted - shown
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
