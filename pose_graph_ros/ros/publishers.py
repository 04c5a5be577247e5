# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The outputs of the node, with strictly increasing stamps.

Pose, odometry, fix and transform are published with each odometry message, from the executor's
thread; path, markers and verdicts, which can be large, from the thread that owns the engine. All
but the transform and the diagnostics are made only while there is a subscriber.
"""

from collections.abc import Callable, Mapping, Sequence
from copy import copy
import math
import threading
import time
from typing import Any

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry, Path
import numpy as np
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSDurabilityPolicy, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import NavSatFix, NavSatStatus
from std_msgs.msg import Header
from visualization_msgs.msg import Marker, MarkerArray

from pose_graph_ros.adapters import output_cdr
from pose_graph_ros.adapters.conversions import frame, Message
from pose_graph_ros.adapters.fixes import Datum
from pose_graph_ros.adapters.markers import markers_cdr
from pose_graph_ros.adapters.sources import (
    IN_MAP,
    NANOSECONDS,
    OUTPUTS as OUTPUT_TOPICS,
    source_list,
)
from pose_graph_ros.adapters.verdict_messages import verdicts_cdr
from pose_graph_ros.core.alignment.monitor import AlignmentState
from pose_graph_ros.core.estimate import Estimate
from pose_graph_ros.core.geometry import covariance as cov
from pose_graph_ros.core.geometry.covariance import UNKNOWN_HEADING_VARIANCE
from pose_graph_ros.core.geometry.geodesy import TangentPlane
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.graph.graph_view import GraphView
from pose_graph_ros.core.judgement.verdicts import SourceVerdicts, Verdict
from pose_graph_ros.core.measurements import OdometrySample
from pose_graph_ros.core.prediction import predict, Prediction
from pose_graph_ros.ros.transforms import Slew, TF_QOS, TFMessage, TOPIC, TransformPublisher

OUTPUT_QOS = QoSProfile(depth=10)  # reliable, as profiles are by default
# Late subscribers receive the newest path and graph at once.
LATCHED_QOS = QoSProfile(depth=1, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)

OUTPUTS = {
    'pose': (PoseWithCovarianceStamped, OUTPUT_QOS),
    'odometry/filtered': (Odometry, OUTPUT_QOS),
    'gps/filtered': (NavSatFix, OUTPUT_QOS),
    'path': (Path, LATCHED_QOS),
    'graph': (MarkerArray, LATCHED_QOS),
    '~/verdicts': (DiagnosticArray, LATCHED_QOS),
    '/diagnostics': (DiagnosticArray, OUTPUT_QOS)}
"""Messages and quality of service by default topic, but for /tf."""
LEAST_GRAPH_PERIOD = 0.1
"""Least time between two sets of markers, and between two lists of verdicts [s]."""
UNPLACED = np.diag((
    output_cdr.UNKNOWN_VARIANCE, output_cdr.UNKNOWN_VARIANCE, UNKNOWN_HEADING_VARIANCE))
"""Covariance of a pose of which only the motion since the start is known."""
MOST_FROZEN = 20_000
"""Poses that have left the graph in a message; a day at 1 m/s has four times as many."""


class Publishers:
    """
    The outputs of the node.

    Parameters
    ----------
    values : mapping, all checked parameters
    on_other : callable, called with a sentence if another node publishes the same transform

    """

    def __init__(
        self, node: Node, values: Mapping[str, Any], on_other: Callable[[str], None],
    ) -> None:
        self._node = node
        self.map_frame = frame(values['map_frame'])
        self.odom_frame = frame(values['odom_frame'])
        self.base_frame = frame(values['base_link_frame'])
        given = {topic: values[f'outputs.{name}'] for name, (topic, *_) in OUTPUT_TOPICS.items()}
        self._publishers = [self._publisher(message_type, given[topic], qos)
                            for topic, (message_type, qos) in OUTPUTS.items()]
        (self._pose, self._odometry, self._fix, self._path, self._graph, self._verdicts,
         self._diagnostics) = self._publishers
        self.transforms: TransformPublisher | None = None
        """None if `publish_tf` is false or tf2_msgs is not installed."""
        self._on_other = on_other
        self._map_topics = [node.resolve_topic_name(source.topic)
                            for source in source_list(values) if source.kind in IN_MAP]
        self._awaits_map = False    # whether there ever was a publisher on one of these
        self._slew = Slew()
        self._aligned = False
        self._newest_ns = 0
        self.graph = 0  # number of the present graph: how many were started after the first
        # shared by the two threads
        self._lock = threading.Lock()
        self._forget_views()
        self.configure(values)

    def _forget_views(self) -> None:
        self._path_shown: Estimate | None = None
        self._path_stamp_ns = self._graph_stamp_ns = self._verdicts_stamp_ns = 0
        self._path_at = self._graph_at = self._verdicts_at = -float('inf')
        self._verdicts_shown: object = None

    def _publisher(self, message_type: type, topic: str, qos: QoSProfile) -> Publisher:
        return self._node.create_publisher(
            message_type, topic, copy(qos),  # rclpy writes the overrides into it
            qos_overriding_options=QoSOverridingOptions.with_default_policies())

    def configure(self, values: Mapping[str, Any]) -> None:
        """Set the parameters that can change while the node runs."""
        if values['publish_tf'] and TFMessage is None:
            self._node.get_logger().warning(
                'tf2_msgs is not installed: the transform from map to odom is not published',
                once=True)
        elif values['publish_tf'] and self.transforms is None:
            self.transforms = TransformPublisher(
                self._node, self._publisher(TFMessage, TOPIC, TF_QOS), self.map_frame,
                self.odom_frame, self._on_other)
            self._slew.forget()
        elif not values['publish_tf'] and self.transforms is not None:
            self.transforms.close()
            self.transforms = None
        self._waits = values['wait_for_map']
        self._tf_offset_ns = round(values['transform_time_offset'] * NANOSECONDS)
        self._slew_limits = tuple(values['transform_slew'])
        self._path_period = values['path_period']
        self._graph_period = max(2.0 * self._path_period, LEAST_GRAPH_PERIOD)

    def publish_pose(
        self, estimate: Estimate, odometry: Message, sample: OdometrySample, datum: Datum,
    ) -> None:
        """
        Publish pose, odometry, fix and transform at an odometry message, if they are not held.

        Parameters
        ----------
        estimate : Estimate, the newest estimate, with the same primary odometry
        odometry : Message, with the fields of nav_msgs/Odometry
        sample : OdometrySample, the same message, as it was read

        """
        stamp, plane = sample.stamp_ns, datum.plane
        if stamp <= self._newest_ns or self._holds(estimate):
            return
        self._newest_ns = stamp
        if (self.transforms is not None
                and frame(odometry.header.frame_id) in ('', self.odom_frame)):
            if (estimate.alignment is AlignmentState.ALIGNED) != self._aligned:
                # the map frame itself has moved, which is no correction of the pose
                self._aligned = not self._aligned
                self._slew.forget()
            self.transforms.publish(stamp + self._tf_offset_ns, self._slew.limited(
                stamp, estimate.T_map_odom, sample.pose, *self._slew_limits))
        wanted = [publisher for publisher in (self._pose, self._odometry, self._fix)
                  if publisher.get_subscription_count() > 0]
        if len(wanted) == 0:
            return
        prediction = predict(estimate, sample)
        if self._is_unplaced(estimate):
            prediction = prediction._replace(covariance=UNPLACED)
        if self._odometry in wanted:
            self._odometry.publish(output_cdr.odometry_cdr(
                stamp, prediction, odometry, self.map_frame, self.base_frame))
        if self._pose in wanted:
            self._pose.publish(output_cdr.stamped_pose_cdr(stamp, prediction, self.map_frame))
        # before the first measurement in the map, its place on the Earth is unknown
        if (self._fix in wanted and plane is not None
                and estimate.alignment is not AlignmentState.LOCAL):
            self._fix.publish(fix_message(
                stamp, prediction, plane, datum.altitude, self.base_frame))

    def _holds(self, estimate: Estimate) -> bool:
        """Tell whether nothing is to be published of an estimate, as it is not in the map yet."""
        return (self._waits and len(self._map_topics) > 0
                and estimate.alignment is not AlignmentState.ALIGNED)

    def _is_unplaced(self, estimate: Estimate) -> bool:
        """Tell whether a source is to tell where odometry lies; without one, that is the map."""
        if estimate.alignment is not AlignmentState.LOCAL:
            return False
        self._awaits_map = self._awaits_map or any(
            self._node.count_publishers(topic) > 0 for topic in self._map_topics)
        return self._awaits_map

    def jump(self) -> None:
        """Let the next transform be published without limits: the robot was put elsewhere."""
        self._slew.forget()

    def path_is_due(self, estimate: Estimate) -> bool:
        """Tell whether to publish the path of an estimate: new, wanted, and not too soon."""
        return (estimate is not self._path_shown and not self._holds(estimate)
                and time.monotonic() - self._path_at >= self._path_period
                and self._path.get_subscription_count() > 0)

    def publish_path(
        self, estimate: Estimate, path: Trajectory, graph: int, n_frozen: int = 0,
    ) -> None:
        """
        Publish the path of an estimate, if it is of the present graph.

        Parameters
        ----------
        graph : int, number of its graph
        n_frozen : int
            Number of its first poses that have left the graph: of more than `MOST_FROZEN` only
            every second one is published, or every third, and so on.

        """
        shown = thinned(path, n_frozen)
        with self._lock:
            if graph != self.graph or self._holds(estimate):
                return
            self._path_shown, self._path_at = estimate, time.monotonic()
            # a better path with the same newest odometry: 1 ns keeps the stamps increasing
            self._path_stamp_ns = max(estimate.stamp_ns, self._path_stamp_ns + 1)
            self._path.publish(output_cdr.path_cdr(shown, self._path_stamp_ns, self.map_frame))

    def graph_is_due(self) -> bool:
        """Tell whether to publish the markers of the graph: wanted, and not too soon."""
        return (self._graph.get_subscription_count() > 0
                and time.monotonic() - self._graph_at >= self._graph_period)

    def publish_graph(self, view: GraphView, stamp_ns: int, graph: int) -> None:
        """
        Publish the markers of a graph, if it is the present one.

        Parameters
        ----------
        stamp_ns, graph : int, stamp of the newest odometry in it [ns], and number of the graph

        """
        with self._lock:
            if graph != self.graph:
                return
            self._graph_at = time.monotonic()
            self._graph_stamp_ns = max(stamp_ns, self._graph_stamp_ns + 1)
            self._graph.publish(markers_cdr(view, self._graph_stamp_ns, self.map_frame))

    def verdicts_are_due(self, state: object, *, at_once: bool = False) -> bool:
        """
        Tell whether to publish the verdicts: changed, wanted, and not too soon.

        Parameters
        ----------
        state : object, equal to that of the verdicts published last if they have not changed
        at_once : bool, whether it cannot be too soon

        """
        return (state != self._verdicts_shown
                and (at_once or time.monotonic() - self._verdicts_at >= self._graph_period)
                and self._verdicts.get_subscription_count() > 0)

    def publish_verdicts(
        self, verdicts: Sequence[Verdict], totals: Mapping[str, SourceVerdicts], stamp_ns: int,
        graph: int, *, state: object,
    ) -> None:
        """
        Publish the verdicts on the constraints of a graph, if it is the present one.

        Parameters
        ----------
        totals : mapping, what is believed of each source
        stamp_ns, graph : int, stamp of the newest odometry in it [ns], and number of the graph
        state : object, what `verdicts_are_due` was asked for

        """
        with self._lock:
            if graph != self.graph:
                return
            self._verdicts_at, self._verdicts_shown = time.monotonic(), state
            self._verdicts_stamp_ns = max(stamp_ns, self._verdicts_stamp_ns + 1)
            self._verdicts.publish(verdicts_cdr(
                verdicts, totals, self._verdicts_stamp_ns, self.map_frame))

    def start_new_graph(self) -> None:
        """Forget all stamps; take path, markers and verdicts back if any were published."""
        self._newest_ns, self._aligned = 0, False
        self._slew.forget()
        if self.transforms is not None:
            self.transforms.forget()
        with self._lock:
            self.graph += 1
            path_ns, graph_ns = self._path_stamp_ns, self._graph_stamp_ns
            verdicts_ns = self._verdicts_stamp_ns
            self._forget_views()
            if path_ns > 0:
                self._path.publish(Path(header=self._after(path_ns)))
            if graph_ns > 0:
                self._graph.publish(MarkerArray(
                    markers=[Marker(header=self._after(graph_ns), action=Marker.DELETEALL)]))
            if verdicts_ns > 0:
                self._verdicts.publish(verdicts_cdr([], {}, verdicts_ns + 1, self.map_frame))

    def _after(self, stamp_ns: int) -> Header:
        return Header(stamp=time_message(stamp_ns + 1), frame_id=self.map_frame)

    def publish_diagnostics(self, level: bytes, text: str, values: Mapping[str, object]) -> None:
        """
        Publish the state of the node; the only output that is stamped by the node's clock.

        Parameters
        ----------
        level : bytes, as in DiagnosticStatus

        """
        status = DiagnosticStatus(
            level=level, name=f'{self._node.get_fully_qualified_name()}: pose graph', message=text,
            hardware_id='pose_graph',
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])
        self._diagnostics.publish(DiagnosticArray(
            header=Header(stamp=self._node.get_clock().now().to_msg()), status=[status]))

    def close(self) -> None:
        """Destroy all publishers."""
        if self.transforms is not None:
            self.transforms.close()
        with self._lock:
            self.graph += 1     # nothing more is published of the graph so far
            for publisher in self._publishers:
                self._node.destroy_publisher(publisher)


def thinned(path: Trajectory, n_frozen: int) -> Trajectory:
    """
    Return a path with at most `MOST_FROZEN` of its frozen poses.

    Every n-th of them is kept, from the first on, with the smallest n that is enough: poses that
    are published stay the same, until n grows.

    Parameters
    ----------
    n_frozen : int, how many of its first poses are frozen

    """
    step = -(-n_frozen // MOST_FROZEN)
    if step <= 1:
        return path
    kept = np.concatenate((np.arange(0, n_frozen, step), np.arange(n_frozen, len(path))))
    return Trajectory(path.stamps_ns[kept], path.poses[kept])


def time_message(stamp_ns: int) -> Time:
    """Return a stamp [ns] as a message."""
    seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS)
    return Time(sec=seconds, nanosec=nanoseconds)


def fix_message(
    stamp_ns: int, prediction: Prediction, plane: TangentPlane, altitude: float, base_frame: str,
) -> NavSatFix:
    """
    Return the robot's position on the Earth, its covariance in east and north.

    Parameters
    ----------
    altitude : float, above the ellipsoid [m]; NaN if unknown

    """
    latitude, longitude, _ = plane.to_geodetic(
        prediction.T_map_base[:2], altitude if math.isfinite(altitude) else plane.altitude)
    covariance = np.diag((0.0, 0.0, output_cdr.UNKNOWN_VARIANCE))
    turned = cov.turned(prediction.covariance[:2, :2], -plane.yaw)
    covariance[:2, :2] = 0.5 * (turned + turned.T)
    return NavSatFix(
        header=Header(stamp=time_message(stamp_ns), frame_id=base_frame),
        status=NavSatStatus(status=NavSatStatus.STATUS_FIX), latitude=float(latitude),
        longitude=float(longitude), altitude=float(altitude),
        position_covariance=covariance.ravel(),
        position_covariance_type=NavSatFix.COVARIANCE_TYPE_KNOWN)
