# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The transform from map to odom: who publishes it, and that nobody else does."""

from collections import deque
from collections.abc import Callable
import math
import time

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription

from pose_graph_ros.core.se2 import FloatArray
from pose_graph_ros.ros import messages
from pose_graph_ros.ros.conversions import frame, stamp_ns

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # ROS 2 from PyPI lacks tf2_msgs until it is built
    TFMessage = None

# As tf2_ros has it.
TF_QOS = QoSProfile(depth=100, reliability=QoSReliabilityPolicy.RELIABLE)
TOPIC = '/tf'
# Reading all of /tf costs as much as reading odometry: it is read for so long at a time [s] ...
LISTENING = 2.0
# ... and again after so long, or at once where there is a new publisher [s].
PAUSE = 30.0
# The newest transforms of this node, to know them when they are heard.
OWN = 2000


class TransformPublisher:
    """
    Publishes `map -> odom`, each with a newer stamp than the one before.

    Parameters
    ----------
    node : rclpy.node.Node
    publisher : rclpy.publisher.Publisher
    map_frame, odom_frame : str
    on_other : callable
        Called once when somebody else is heard to publish the same transform, with a sentence.

    """

    def __init__(
        self, node: Node, publisher: Publisher, map_frame: str, odom_frame: str,
        on_other: Callable[[str], None],
    ) -> None:
        self._node, self._publisher = node, publisher
        self._map_frame, self._odom_frame = map_frame, odom_frame
        self._on_other = on_other
        self._newest_ns = 0
        self._own: deque[tuple[int, float, float]] = deque(maxlen=OWN)
        self._subscription: Subscription | None = None
        self._known: set[bytes] = set()
        self._since = -float('inf')
        self.other = ''
        """What is to be said of another publisher; empty if none was heard."""

    def publish(self, at_ns: int, T_map_odom: FloatArray) -> None:
        """Publish the transform at a stamp [ns], unless one as new was."""
        if at_ns <= self._newest_ns:
            return
        self._newest_ns = at_ns
        self._own.append((at_ns, float(T_map_odom[0]), math.sin(T_map_odom[2] / 2.0)))
        self._publisher.publish(messages.transform_cdr(
            at_ns, T_map_odom, self._map_frame, self._odom_frame))

    def forget(self) -> None:
        """Let time begin anew."""
        self._newest_ns = 0

    def look_for_others(self) -> None:
        """Listen to /tf for a while if there are others who publish there; call now and then."""
        if self.other != '':
            return
        now = time.monotonic()
        if self._subscription is not None:
            if now - self._since > LISTENING:
                self._listen_no_more()
            return
        # another instance of this node, by mistake, has its name as well
        everyone = {bytes(info.endpoint_gid)
                    for info in self._node.get_publishers_info_by_topic(TOPIC)}
        if len(everyone) > 1 and (not everyone <= self._known or now - self._since > PAUSE):
            self._known, self._since = everyone, now
            self._subscription = self._node.create_subscription(
                TFMessage, TOPIC, self._hear, TF_QOS, raw=True)

    def close(self) -> None:
        """Publish and listen no more."""
        self._listen_no_more()
        self._node.destroy_publisher(self._publisher)

    def _listen_no_more(self) -> None:
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None

    def _hear(self, data: bytes) -> None:
        # most of what is on /tf is about the robot's joints: not worth a message
        if self._odom_frame.encode() not in data or self.other != '':
            return
        for transform in deserialize_message(data, TFMessage).transforms:
            parent = frame(transform.header.frame_id)
            if frame(transform.child_frame_id) != self._odom_frame or (
                    _key(transform) in self._own):
                continue
            wrong = '' if parent == self._map_frame else ', so that it has two parents'
            self.other = (
                f'somebody else publishes {parent} -> {self._odom_frame} on {TOPIC}{wrong}: '
                'set publish_tf of one of the two to false')
            self._on_other(self.other)
            return


def _key(transform: object) -> tuple[int, float, float]:
    t = transform.transform  # type: ignore[attr-defined]
    return stamp_ns(transform), t.translation.x, t.rotation.z
