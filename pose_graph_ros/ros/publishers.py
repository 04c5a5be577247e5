# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The outputs of the node, with strictly increasing stamps.

Pose, odometry, fix and transform are published with each odometry message, from the executor's
thread; path, markers and verdicts, which can be large, from the thread that owns the engine. All
but the diagnostics are made only while there is a subscriber. Of the transform
it is also about its speed, and others that publish it.
"""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
import math
import threading
import time
from typing import Any

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from nav_msgs.msg import Path
import numpy as np
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from sensor_msgs.msg import NavSatFix, NavSatStatus
from std_msgs.msg import Header
from visualization_msgs.msg import Marker, MarkerArray

from pose_graph_ros.adapters import output_cdr, parameter_table, parameters, sources
from pose_graph_ros.adapters.conversions import Datum, frame, Message, stamp_ns
from pose_graph_ros.core import alignment, measurements
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.estimate import Estimate, predict
from pose_graph_ros.core.geometry import covariance as cov, se2, trajectory
from pose_graph_ros.core.judgement.texts import details, sentence, total_values, totals_text
from pose_graph_ros.core.judgement.verdicts import SourceVerdicts, State, Verdict
from pose_graph_ros.core.quantities import NANOSECONDS, Seconds, StampNs
from pose_graph_ros.ros import spinning, topics
from pose_graph_ros.ros.topics import TFMessage, TOPIC
from pose_graph_ros.ros.worker import Worker

OUTPUT_QOS = QoSProfile(depth=10)  # reliable, as profiles are by default

# The profile of tf2_ros, which is reliable.
TF_QOS = QoSProfile(depth=100)
# Reading all of /tf costs as much as odometry: how long it is read, and the period of that [s].
LISTENING, PAUSE = 2.0, 30.0

# Period of asking who listens, which takes as long as to write a message [s].
ASKING = 0.02

LATCHED = ('path', 'graph', 'verdicts')
# Covariance of a pose of which only the motion since the start is known.
UNPLACED = np.diag((
    output_cdr.UNKNOWN_VARIANCE, output_cdr.UNKNOWN_VARIANCE, cov.UNKNOWN_HEADING_VARIANCE))
LEVELS = {State.BELIEVED: DiagnosticStatus.OK, State.WEAKLY_BELIEVED: DiagnosticStatus.OK,
          State.DOUBTED: DiagnosticStatus.WARN, State.WAITING: DiagnosticStatus.STALE}


class View:
    """A latched output that the thread of the engine makes now and then."""

    def __init__(self, publisher: Publisher) -> None:
        self.publisher = publisher
        self.forget()

    def forget(self) -> None:
        """Let the next message have any stamp, at once."""
        self.stamp_ns, self.at = 0, -math.inf
        self.shown: object = None

    def is_due(self, state: object, period: Seconds) -> bool:
        """Tell whether to publish what is new, if a state is given, wanted, and not too soon."""
        return ((state is None or state != self.shown) and time.monotonic() - self.at >= period
                and bool(self.publisher.get_subscription_count() > 0))


class Publishers:
    """The outputs of the node."""

    def __init__(self, node: Node, values: Mapping[str, Any]) -> None:
        self._node = node
        self.frames = tuple(frame(values[name]) for name in parameters.FRAMES)
        self.map_frame, self.odom_frame, self.base_frame = self.frames
        self._publishers = {name: node.create_publisher(
            topics.message_class(type_name), values[f'outputs.{name}'],
            **topics.overridable(topics.LATCHED_QOS if name in LATCHED else OUTPUT_QOS))
            for name, (_, type_name, _) in parameter_table.OUTPUTS.items()}
        self._pose, self._odometry, self._fix = (
            self._publishers[name] for name in ('pose', 'filtered_odometry', 'filtered_fix'))
        self.path, self.markers, self.verdicts = (View(self._publishers[name]) for name in LATCHED)
        # None if `publish_tf` is false or tf2_msgs is not installed
        self.transforms: TransformPublisher | None = None
        self._map_topics = [node.resolve_topic_name(source.topic)
                            for source in sources.source_list(values) if source.kind.in_map]
        self._awaits_map = False    # whether there ever was a publisher on one of these
        self._newest_ns = 0
        self._asked_at = -math.inf
        self._wanted: list[Publisher] = []
        self.graph = 0  # number of the present graph: how many were started after the first
        # shared by the two threads
        self._lock = threading.Lock()
        self.configure(values)

    def configure(self, values: Mapping[str, Any]) -> None:
        """Set the parameters that can change while the node runs."""
        if values['publish_tf'] and TFMessage is None:
            self._node.get_logger().warning('tf2_msgs is not installed: the transform from map to '
                                            'odom is not published', once=True)
        elif values['publish_tf'] and self.transforms is None:
            self.transforms = TransformPublisher(self._node, self.map_frame, self.odom_frame)
        elif not values['publish_tf'] and self.transforms is not None:
            self.transforms.close()
            self.transforms = None
        self._asked_at = -math.inf
        self._waits = values['wait_for_map']
        self._tf_offset_ns = round(values['transform_time_offset'] * NANOSECONDS)
        self._slew_limits = tuple(values['transform_slew'])
        self._path_period = values['path_period']

    def publish_pose(self, estimate: Estimate, odometry: Message,
                     sample: measurements.OdometrySample, datum: Datum) -> None:
        """
        Publish pose, odometry, fix and transform at an odometry message, if they are not held.
        """
        stamp, plane = sample.stamp_ns, datum.plane
        if stamp <= self._newest_ns or self._holds(estimate):
            return
        self._newest_ns = stamp
        if (now := time.monotonic()) - self._asked_at >= ASKING:
            self._asked_at, self._wanted = now, [publisher for publisher in (
                self._pose, self._odometry, self._fix, *(
                    [] if self.transforms is None else [self.transforms.publisher]))
                if publisher.get_subscription_count() > 0]
        wanted = self._wanted
        if (self.transforms is not None and self.transforms.publisher in wanted
                and frame(odometry.header.frame_id) in ('', self.odom_frame)):
            self.transforms.publish(estimate, sample, self._tf_offset_ns, self._slew_limits)
        if len(wanted) == 0:
            return
        prediction = predict(estimate, sample)
        is_local = estimate.alignment is alignment.AlignmentState.LOCAL
        if is_local:
            # without a source that is to tell where odometry lies, that is the map
            self._awaits_map = self._awaits_map or any(
                self._node.count_publishers(topic) > 0 for topic in self._map_topics)
            if self._awaits_map:
                prediction = prediction._replace(covariance=UNPLACED)
        if self._odometry in wanted:
            self._odometry.publish(output_cdr.odometry_cdr(
                stamp, prediction, odometry, self.map_frame, self.base_frame))
        if self._pose in wanted:
            self._pose.publish(output_cdr.stamped_pose_cdr(stamp, prediction, self.map_frame))
        # before the first measurement in the map, its place on the Earth is unknown
        if self._fix in wanted and plane is not None and not is_local:
            altitude = datum.altitude
            latitude, longitude, _ = plane.to_geodetic(
                prediction.T_map_base[:2], altitude if math.isfinite(altitude) else plane.altitude)
            # in east and north
            covariance = np.diag((0.0, 0.0, output_cdr.UNKNOWN_VARIANCE))
            turned = cov.turned(prediction.covariance[:2, :2], -plane.yaw)
            covariance[:2, :2] = 0.5 * (turned + turned.T)
            self._fix.publish(NavSatFix(
                header=_header(stamp, self.base_frame),
                status=NavSatStatus(status=NavSatStatus.STATUS_FIX), latitude=float(latitude),
                longitude=float(longitude), altitude=float(altitude),
                position_covariance=covariance.ravel(),
                position_covariance_type=NavSatFix.COVARIANCE_TYPE_KNOWN))

    def _holds(self, estimate: Estimate) -> bool:
        """Tell whether nothing is to be published of an estimate, as it is not in the map yet."""
        return (self._waits and len(self._map_topics) > 0
                and estimate.alignment is not alignment.AlignmentState.ALIGNED)

    def jump(self) -> None:
        """Let the next transform be published without limits: the robot was put elsewhere."""
        if self.transforms is not None:
            self.transforms.slew = Slew()

    def publish_views(self, worker: Worker, graph: int, backend: PoseGraphBackend, *,
                      at_once: bool = False) -> None:
        """
        Publish path, markers and verdicts that are due; the path and verdicts also `at_once`.

        For the thread of a worker, which may no longer be the one of the present graph.
        """
        estimate, status = worker.estimate, worker.status
        if estimate is None or graph != self.graph:
            return

        def publish(view: View, state: object, message_at: Callable[[StampNs], object]) -> None:
            with self._lock:
                if graph == self.graph:
                    view.shown, view.at = state, time.monotonic()
                    # with the same newest odometry: 1 ns keeps the stamps increasing
                    view.stamp_ns = max(estimate.stamp_ns, view.stamp_ns + 1)
                    view.publisher.publish(message_at(view.stamp_ns))

        is_due = estimate is not self.path.shown and self.path.is_due(None, self._path_period)
        if (is_due or at_once) and not self._holds(estimate):
            newest = backend.estimate()
            assert newest is not None
            worker.keep_path(newest)
            path = thinned(newest.path, newest.n_frozen)
            publish(self.path, estimate, lambda at: output_cdr.path_cdr(path, at, self.map_frame))
        period = max(2.0 * self._path_period, 0.1)
        if self.markers.is_due(None, period) and (view := backend.view()) is not None:
            publish(self.markers, None,
                    lambda at: output_cdr.markers_cdr(view, at, self.map_frame))
        state = status.verdicts, status.n_changes, status.counts[sources.JUDGE, 'accepted']
        if self.verdicts.is_due(state, 0.0 if at_once else period):
            # of those that are believed, the newest of each source
            publish(self.verdicts, state, lambda at: verdicts_message(
                backend.verdicts(50), status.verdicts, _header(at, self.map_frame)))

    def start_new_graph(self) -> None:
        """Forget all stamps; take path, markers and verdicts back if any were published."""
        self._newest_ns = 0
        if self.transforms is not None:
            self.transforms.forget()
        with self._lock:
            self.graph += 1
            for view, empty in ((self.path, lambda header: Path(header=header)),
                                (self.markers, lambda header: MarkerArray(
                                    markers=[Marker(header=header, action=Marker.DELETEALL)])),
                                (self.verdicts, lambda header: verdicts_message([], {}, header))):
                if view.stamp_ns > 0:
                    view.publisher.publish(empty(_header(view.stamp_ns + 1, self.map_frame)))
                view.forget()

    def publish_diagnostics(self, level: bytes, text: str, values: Mapping[str, object]) -> None:
        """Publish the state of the node; the only output that is stamped by the node's clock."""
        self._publishers['diagnostics'].publish(DiagnosticArray(
            header=Header(stamp=self._node.get_clock().now().to_msg()), status=[DiagnosticStatus(
                level=level, name=f'{self._node.get_fully_qualified_name()}: pose graph',
                message=text, hardware_id='pose_graph', values=_key_values(values))]))

    def close(self) -> None:
        """Destroy all publishers."""
        if self.transforms is not None:
            self.transforms.close()
        with self._lock:
            self.graph += 1     # nothing more is published of the graph so far
            for publisher in self._publishers.values():
                self._node.destroy_publisher(publisher)


def verdicts_message(verdicts: Sequence[Verdict], totals: Mapping[str, SourceVerdicts],
                     header: Header) -> DiagnosticArray:
    """Return a status for each constraint, after one that also counts those not listed."""
    n_all = sum(sum(each.counts.values()) for each in totals.values())
    of_sources = '; '.join(f'{source}: {totals_text(each)}' for source, each in totals.items())
    summary = DiagnosticStatus(
        level=DiagnosticStatus.WARN if any(each.doubting for each in totals.values()) else
        DiagnosticStatus.OK, name='summary', values=_key_values(total_values(totals)),
        message=f'{len(verdicts)} of {n_all} are listed; {of_sources or "nothing is judged yet"}')
    return DiagnosticArray(header=header, status=[summary, *(DiagnosticStatus(
        level=LEVELS[each.state], name=each.id, message=sentence(each), hardware_id=each.source,
        values=_key_values(details(each))) for each in verdicts)])


def _key_values(values: Mapping[str, object]) -> list[KeyValue]:
    return [KeyValue(key=key, value=str(value)) for key, value in values.items()]


def thinned(path: trajectory.Trajectory, n_frozen: int) -> trajectory.Trajectory:
    """
    Return a path with every n-th of its poses that have left the graph, from the first on.

    n is the smallest with at most 20 000 of them, a quarter of a day at 1 m/s: so poses that are
    published stay the same until it grows.
    """
    if (step := -(-n_frozen // 20_000)) <= 1:
        return path
    kept = np.concatenate((np.arange(0, n_frozen, step), np.arange(n_frozen, len(path))))
    return trajectory.Trajectory(path.stamps_ns[kept], path.poses[kept])


def _header(stamp_ns: StampNs, frame_id: str) -> Header:
    seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS)
    return Header(stamp=Time(sec=seconds, nanosec=nanoseconds), frame_id=frame_id)


# --- the transform from map to odom

class TransformPublisher:
    """Publishes the transform from map to odom, each with a newer stamp than the one before."""

    def __init__(self, node: Node, map_frame: str, odom_frame: str) -> None:
        self._node = node
        self.publisher = node.create_publisher(TFMessage, TOPIC, **topics.overridable(TF_QOS))
        self._map_frame, self._odom_frame = map_frame, odom_frame
        self._newest_ns, self._aligned, self.slew = 0, False, Slew()
        # its newest, to recognise them
        self._own: deque[tuple[int, float, float]] = deque(maxlen=2000)
        self._subscription: Subscription | None = None
        self._since = -math.inf
        self.other = ''  # warning about another publisher of the transform; empty if there is none

    def publish(self, estimate: Estimate, sample: measurements.OdometrySample, offset_ns: int,
                limits: tuple[float, float]) -> None:
        """Publish the transform at odometry, unless its stamp is not newer than the last one."""
        if (estimate.alignment is alignment.AlignmentState.ALIGNED) != self._aligned:
            # the map frame itself has moved, which is no correction of the pose
            self._aligned = not self._aligned
            self.slew = Slew()
        T_map_odom = self.slew.limited(sample.stamp_ns, estimate.T_map_odom, sample.pose, *limits)
        at_ns = sample.stamp_ns + offset_ns
        if at_ns <= self._newest_ns:
            return
        self._newest_ns = at_ns
        self._own.append((at_ns, float(T_map_odom[0]), math.sin(T_map_odom[2] / 2.0)))
        self.publisher.publish(output_cdr.transform_cdr(
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
            self._subscription = self._node.create_subscription(TFMessage, TOPIC, spinning.guarded(
                self._on_transforms, lambda: True), TF_QOS, raw=True)

    def close(self) -> None:
        """Destroy the publisher and the subscription."""
        self._stop_listening()
        self._node.destroy_publisher(self.publisher)

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
            names = ' or '.join(topics.other_publishers(self._node, TOPIC))
            self.other = (f'another node publishes {parent} -> {self._odom_frame} on '
                          f'{self._node.resolve_topic_name(TOPIC)}{names and ", by "}{names}' + (
                              '' if parent == self._map_frame else ', so that it has two parents')
                          + ': set publish_tf of one of the two to false; if it is that of '
                          'another robot, give each a namespace and its own tf, with '
                          'remap_tf:=true of the launch file or -r /tf:=tf '
                          '-r /tf_static:=tf_static')
            return


class Slew:
    """
    Limits the speed at which corrections move the robot in the published transform.

    A small turn of the odometry frame moves a robot far from its origin by much, so the limits
    hold at the robot. They do not affect the graph.
    """

    def __init__(self) -> None:
        self._last: se2.FloatArray | None = None
        self._stamp_ns = 0

    def limited(self, stamp_ns: int, T_map_odom: se2.FloatArray, T_odom_base: se2.FloatArray,
                linear: float, angular: float) -> se2.FloatArray:
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
