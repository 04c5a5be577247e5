# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What the node publishes, with strictly increasing stamps.

Path, pose and odometry go out only while someone listens.
"""

from collections.abc import Mapping
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry, Path
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import NavSatFix

from pose_graph_ros.core.estimate import AlignmentState, Estimate
from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.measurements import OdometrySample
from pose_graph_ros.core.prediction import predict
from pose_graph_ros.ros import messages
from pose_graph_ros.ros.conversions import frame
from pose_graph_ros.ros.fixes import Datum
from pose_graph_ros.ros.sources import NANOSECONDS

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # ROS 2 from PyPI lacks tf2_msgs until it is built
    TFMessage = None

OUTPUT_QOS = QoSProfile(depth=10, reliability=QoSReliabilityPolicy.RELIABLE)
# Who joins late gets the newest path at once.
PATH_QOS = QoSProfile(depth=1, reliability=QoSReliabilityPolicy.RELIABLE,
                      durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
# As tf2_ros has it.
TF_QOS = QoSProfile(depth=100, reliability=QoSReliabilityPolicy.RELIABLE)


class Publishers:
    """
    The outputs of the node.

    Parameters
    ----------
    node : rclpy.node.Node
    values : mapping
        The node's parameters.
    datum : Datum
        Where the map lies on the Earth.

    """

    def __init__(self, node: Node, values: Mapping[str, Any], datum: Datum) -> None:
        self._node = node
        self._datum = datum
        self.map_frame = frame(values['map_frame'])
        self.odom_frame = frame(values['odom_frame'])
        self.base_frame = frame(values['base_link_frame'])
        self._tf_offset_ns = round(values['transform_time_offset'] * NANOSECONDS)
        self._path_period = values['path_period']
        frames = (self.map_frame, self.odom_frame, self.base_frame)
        if '' in frames or len(set(frames)) < len(frames):
            raise ConfigError('map_frame, odom_frame and base_link_frame: expected three '
                              f'different names, got {", ".join(map(repr, frames))}')
        self._pose = self._publisher(PoseWithCovarianceStamped, 'pose', OUTPUT_QOS)
        self._odometry = self._publisher(Odometry, 'odometry/filtered', OUTPUT_QOS)
        self._fix = self._publisher(NavSatFix, 'gps/filtered', OUTPUT_QOS)
        self._path = self._publisher(Path, 'path', PATH_QOS)
        self._diagnostics = self._publisher(DiagnosticArray, '/diagnostics', OUTPUT_QOS)
        self._tf: Publisher | None = None
        if values['publish_tf'] and TFMessage is None:
            node.get_logger().warning(
                'tf2_msgs is not installed: the transform from map to odom is not published')
        elif values['publish_tf']:
            self._tf = self._publisher(TFMessage, '/tf', TF_QOS)
        self._newest_ns = 0
        self._path_shown: Estimate | None = None
        self._path_stamp_ns = 0
        self._path_at = -float('inf')

    def _publisher(self, message_type: type, topic: str, qos: QoSProfile) -> Publisher:
        return self._node.create_publisher(
            message_type, topic, qos,
            qos_overriding_options=QoSOverridingOptions.with_default_policies())

    def publish_pose(self, estimate: Estimate, odometry: Odometry, sample: OdometrySample) -> None:
        """Publish pose, odometry, fix and transform at an odometry message and its sample."""
        stamp, plane = sample.stamp_ns, self._datum.plane
        if stamp <= self._newest_ns:
            return
        self._newest_ns = stamp
        if self._tf is not None and frame(odometry.header.frame_id) in ('', self.odom_frame):
            transform = messages.transform_message(
                stamp + self._tf_offset_ns, estimate.T_map_odom, self.map_frame, self.odom_frame)
            self._tf.publish(TFMessage(transforms=[transform]))
        wanted = [publisher for publisher in (self._pose, self._odometry, self._fix)
                  if publisher.get_subscription_count() > 0]
        if len(wanted) == 0:
            return
        prediction = predict(estimate, sample.pose)
        message = messages.odometry_message(
            stamp, prediction, odometry, self.map_frame, self.base_frame)
        if self._odometry in wanted:
            self._odometry.publish(message)
        if self._pose in wanted:
            self._pose.publish(
                messages.stamped_pose_message(stamp, message.pose, self.map_frame))
        # before anything was measured in it, the map may be anywhere on the Earth
        if (self._fix in wanted and plane is not None
                and estimate.alignment is not AlignmentState.LOCAL):
            self._fix.publish(messages.fix_message(
                stamp, prediction, plane, self._datum.altitude, self.base_frame))

    def publish_path(self, estimate: Estimate, *, at_once: bool = False) -> None:
        """
        Publish the path of an estimate that was not shown yet.

        That is done at most once in the period, except `at_once`.
        """
        now = time.monotonic()
        early = now - self._path_at < self._path_period and not at_once
        if (estimate is self._path_shown or early
                or self._path.get_subscription_count() == 0):
            return
        self._path_shown, self._path_at = estimate, now
        # the same newest odometry with better poses: a nanosecond keeps the stamps increasing
        self._path_stamp_ns = max(int(estimate.path.stamps_ns[-1]), self._path_stamp_ns + 1)
        self._path.publish(
            messages.path_cdr(estimate.path, self._path_stamp_ns, self.map_frame))

    def publish_diagnostics(
        self, level: bytes, text: str, values: Mapping[str, object],
    ) -> None:
        """Publish the state of the node; this alone is stamped by the node's clock."""
        name = f'{self._node.get_fully_qualified_name()}: pose graph'
        self._diagnostics.publish(messages.diagnostics_message(
            self._node.get_clock().now().to_msg(), name, level, text, values))
