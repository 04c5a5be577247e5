# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The node: messages in, measurements to the worker, estimates out as messages.

Callbacks convert, post and return. The newest pose goes out with every odometry message, as the
newest estimate carried on by that odometry; the path goes out after an update.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
import time
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.qos import (
    QoSDurabilityPolicy,
    QoSHistoryPolicy,
    QoSProfile,
    QoSReliabilityPolicy,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.task import Future
from sensor_msgs.msg import Imu, NavSatFix
from std_srvs.srv import Trigger

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch import Status
from pose_graph_ros.core.measurements import Answer, OdometrySample, rejected
from pose_graph_ros.ros import diagnostics
from pose_graph_ros.ros.continuity import Continuity
from pose_graph_ros.ros.conversions import frame, Message
from pose_graph_ros.ros.hearing import Hearing
from pose_graph_ros.ros.parameters import (
    checked,
    listed_sources,
    Parameter,
    PARAMETERS,
    SOURCE_PARAMETERS,
    source_parameters,
    type_parameter,
)
from pose_graph_ros.ros.publishers import Publishers, TFMessage
from pose_graph_ros.ros.reader import MessageReader
from pose_graph_ros.ros.sources import backend_config, Kind, Source
from pose_graph_ros.ros.worker import Worker

# Every increment of the odometry counts, so the queue is deep; a best-effort reader hears
# reliable and best-effort writers alike.
SENSOR_QOS = QoSProfile(depth=1000, history=QoSHistoryPolicy.KEEP_LAST,
                        reliability=QoSReliabilityPolicy.BEST_EFFORT)
# A loop closure is rare and must not get lost.
CLOSURE_QOS = QoSProfile(depth=100, reliability=QoSReliabilityPolicy.RELIABLE)
# Every broadcaster's newest message, however late this node starts.
STATIC_QOS = QoSProfile(depth=100, reliability=QoSReliabilityPolicy.RELIABLE,
                        durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)

CLASSES: dict[Kind, tuple[type, QoSProfile]] = {
    Kind.ODOMETRY: (Odometry, SENSOR_QOS), Kind.FIX: (NavSatFix, SENSOR_QOS),
    Kind.GLOBAL_POSE: (PoseWithCovarianceStamped, SENSOR_QOS), Kind.IMU: (Imu, SENSOR_QOS),
    Kind.LOOP_CLOSURE: (PoseWithCovarianceStamped, CLOSURE_QOS)}

# How long the end of the node waits for a solve that is under way [s]; launch kills after 5.
STOP_TIMEOUT = 4.0
# How often a silence is looked for [s].
SILENCE_PERIOD = 0.2


class PoseGraphNode(Node):
    """
    The online back end of pose-graph SLAM as a node.

    Raises
    ------
    ConfigError
        If a parameter has a value that it cannot take.

    """

    def __init__(self, **node_options: Any) -> None:
        super().__init__('pose_graph', **node_options)
        values = self._checked_parameters()
        config = backend_config(values)
        self._reader = MessageReader(values)
        self._out = Publishers(self, values, self._reader.datum)
        sources = self._reader.sources.values()
        self._continuity = {
            name: Continuity(source.maximum_speed) for name, source in config.odometry.items()}
        self._received: Counter[str] = Counter()
        self._refused: Counter[tuple[str, str]] = Counter()
        self._posted = 0
        self._said: set[tuple[str, str]] = set()
        self._hearing = Hearing(
            [source.name for source in sources if source.kind is Kind.LOOP_CLOSURE])
        self._silent: list[str] = []
        self._closing_silence = values['closing_silence']
        self._heard_at = time.monotonic()
        self._closed = True

        # first: what it tells has to be there before the first fix, if that can be
        if TFMessage is not None and any(
                not any(source.lever_arm) for source in sources if source.kind is Kind.FIX):
            self._subscribe('/tf_static', TFMessage, self._on_static_frames, STATIC_QOS)
        self._fresh = self.create_guard_condition(self._publish_path)
        self._worker = Worker(
            PoseGraphBackend(config), lambda _: self._fresh.trigger(), self._warm_up)
        for source in sources:
            message_type, qos = CLASSES[source.kind]
            self._subscribe(source.topic, message_type, partial(self._on_message, source), qos)
        self.create_service(Trigger, '~/set_datum', self._on_set_datum)
        # in a group of its own: in the common one a callback that awaits holds all others up
        self.create_service(Trigger, '~/optimize', self._on_optimize,
                            callback_group=MutuallyExclusiveCallbackGroup())
        # steady: a clock that is set, or a bag that starts again, must not stall a timer
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(1.0 / values['frequency'], self._on_update_timer, clock=steady)
        self.create_timer(SILENCE_PERIOD, self._on_silence_timer, clock=steady)
        self.create_timer(values['diagnostics_period'], self._publish_diagnostics, clock=steady)
        self.create_timer(max(values['path_period'], 0.1), self._publish_path, clock=steady)
        self._worker.start()
        topics = ', '.join(self.resolve_topic_name(source.topic) for source in sources)
        self.get_logger().info(f'ready, listening to {topics}')

    def _subscribe(
        self, topic: str, message_type: type, take: Callable[[Any], None], qos: QoSProfile,
    ) -> None:
        self.create_subscription(
            message_type, topic, take, qos,
            qos_overriding_options=QoSOverridingOptions.with_default_policies())

    def _checked_parameters(self) -> dict[str, Any]:
        """Declare all parameters and return their checked values."""
        given = self._declare(PARAMETERS)
        for source in listed_sources(given):
            kind = self._declare([type_parameter(source)])[f'{source}.type']
            given |= self._declare(source_parameters(source, kind))
        values = checked(given)
        # rclpy does not tell what was given in vain; a file may hold parameters of other nodes
        overrides: Mapping[str, object] = getattr(self, '_parameter_overrides', {})
        for name in sorted(set(overrides) - set(values)):
            if name.rpartition('.')[2] in {own.name for own in SOURCE_PARAMETERS}:
                self.get_logger().warning(
                    f'parameter {name} is not known: {name.rpartition(".")[0]} is not in '
                    'sources, or is of a type that has none')
        return values

    def _declare(self, parameters: Sequence[Parameter]) -> dict[str, Any]:
        """Declare parameters and return the values of those that are set."""
        given: dict[str, Any] = {}
        for parameter in parameters:
            if self.has_parameter(parameter.name):
                given[parameter.name] = self.get_parameter(parameter.name).value
                continue
            # an array without a value has no type yet; numbers may be given as 5 for 5.0
            unset = parameter.default == []
            declared = self.declare_parameter(
                parameter.name, None if unset else parameter.default, _descriptor(parameter))
            if declared.type_ is not RosParameter.Type.NOT_SET:
                given[parameter.name] = (
                    list(declared.value) if isinstance(parameter.default, list)
                    else declared.value)
        return given

    def stop(self) -> None:
        """End the worker."""
        if not self._worker.stop(STOP_TIMEOUT):
            self.get_logger().warning('stopping although a solve is still under way')

    def _warm_up(self, stopped: Callable[[], bool]) -> None:
        """Have the kernels ready before the first measurement; runs in the worker's thread."""
        # imported here, in the thread: the subscriptions need not wait for Numba
        from pose_graph_ros.core.jit import is_cached  # noqa: PLC0415
        from pose_graph_ros.core.warm_up import warm_up  # noqa: PLC0415

        if not is_cached():
            self.get_logger().info(
                'compiling kernels, 20 s to a minute on the first start; what comes in waits')
        seconds = warm_up(stopped)
        if not stopped():
            self.get_logger().info(f'kernels ready after {seconds:.1f} s')

    def _on_message(self, source: Source, message: Message) -> None:
        """Convert a message and post it; never raises, whatever the message holds."""
        name = source.name
        self._received[name] += 1
        self._hearing.hear(name, time.monotonic())
        try:
            measurement = self._reader.read(name, message)
        except Exception as error:
            measurement = rejected('malformed', f'{type(error).__name__}: {error}')
        if not isinstance(measurement, Answer) and not self._worker.post(name, measurement):
            measurement = rejected('inbox_full', 'the solver does not keep up')
        if isinstance(measurement, Answer):
            self._refuse(name, measurement)
            return
        self._posted += 1
        self._heard_at, self._closed = time.monotonic(), False
        if isinstance(measurement, OdometrySample):
            self._carry(name, measurement, message)

    def _carry(self, name: str, sample: OdometrySample, message: Odometry) -> None:
        """Publish where the robot is by the newest estimate, carried on by odometry."""
        estimate = self._worker.estimate
        carries = self._continuity[name].carries(estimate, sample)
        if estimate is None or estimate.lead != name:
            return
        self._check_frames(message)
        if carries:
            self._out.publish_pose(estimate, message, sample)
        else:
            self._worker.request_update()  # with this sample

    def _on_static_frames(self, message: Message) -> None:
        """Take the transforms between the parts of the robot."""
        self._reader.frames.take(message)

    def _refuse(self, source: str, answer: Answer) -> None:
        """Count what cannot be used, and say so once for each source and reason."""
        key = (source, answer.reason)
        self._refused[key] += 1
        if key not in self._said:
            self._said.add(key)
            self.get_logger().warning(
                f'{source}: {answer.reason}: {answer.detail} (said once, counted in diagnostics)')

    def _check_frames(self, odometry: Odometry) -> None:
        """Say once if the odometry's frames are not those that the outputs are given in."""
        for name, parameter, expected in (
                (odometry.header.frame_id, 'odom_frame', self._out.odom_frame),
                (odometry.child_frame_id, 'base_link_frame', self._out.base_frame)):
            key = (parameter, name)
            if frame(name) not in ('', expected) and key not in self._said:
                self._said.add(key)
                self.get_logger().warning(
                    f'the odometry has the frame {frame(name)!r}, but the parameter {parameter} '
                    f'is {expected!r}: set it, or the transform does not fit the tree')

    def _on_update_timer(self) -> None:
        """Ask for an update with what has come in."""
        if not self._closed:
            self._worker.request_update()

    def _on_silence_timer(self) -> None:
        """Ask for the full optimisation that ends a stream, once, when nothing usable comes."""
        silence = time.monotonic() - self._heard_at
        if not self._closed and 0.0 < self._closing_silence < silence:
            self._closed = True
            self._worker.request_closing()

    def _on_set_datum(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Make the next good fix the datum, unless the graph refers to the present one."""
        status, datum = self._worker.status, self._reader.datum
        used = sum(status.counts[name, 'accepted'] for name in self._reader.fixes)
        if datum.plane is not None and used > 0:
            response.message = (f'refused: {used} fixes in the graph refer to the datum '
                                f'[{datum.plane.latitude:.9f}, {datum.plane.longitude:.9f}]')
        elif datum.plane is not None and (status.pending > 0 or status.processed < self._posted):
            response.message = ('refused: measurements that wait for odometry may refer to the '
                                'present datum')
        else:
            datum.renew()
            response.success, response.message = True, 'the next good fix will be the datum'
        return response

    async def _on_optimize(
        self, _: Trigger.Request, response: Trigger.Response,
    ) -> Trigger.Response:
        """Have the worker optimise fully and say what that did; other callbacks go on."""
        closing = self._worker.request_closing()
        done = Future(executor=self.executor)
        closing.add_done_callback(lambda _: done.set_result(None))
        await done
        if closing.cancelled() or closing.exception() is not None:
            response.message = (
                'the node stops' if closing.cancelled() else f'failed: {closing.exception()}')
            return response
        estimate = self._worker.estimate
        if estimate is None:
            response.message = 'there is no odometry yet'
            return response
        # who has the answer must not have to guess which path is the optimised one
        self._out.publish_path(estimate, at_once=True)
        report = closing.result()
        response.success = report.status is Status.CONVERGED
        response.message = (
            f'{report.status.value} after {report.iterations} iterations, chi2 {report.chi2:.6g}'
            + (f': {report.reason}' if report.reason != '' else ''))
        return response

    def _publish_path(self) -> None:
        estimate = self._worker.estimate
        if estimate is not None:
            self._out.publish_path(estimate)

    def _publish_diagnostics(self) -> None:
        now = time.monotonic()
        before, self._silent = self._silent, self._hearing.silent(now)
        for name in set(self._silent) - set(before):
            self.get_logger().warning(f'{name} is silent, other sources go on')
        level, text = diagnostics.health(
            self._worker, self._silent,
            [self.resolve_topic_name(source.topic) for source in self._reader.sources.values()
             if source.kind is Kind.ODOMETRY])
        self._out.publish_diagnostics(level, text, {
            **diagnostics.state(self._worker, self._received, self._refused),
            **diagnostics.inputs(self._reader, self._hearing, now),
            **diagnostics.fits(self._worker)})


def _descriptor(parameter: Parameter) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(
        description=f'{parameter.description} [{parameter.unit}]'.removesuffix(' []'),
        read_only=True, dynamic_typing=not isinstance(parameter.default, bool | str))
    if parameter.smallest is not None and parameter.largest is not None:
        descriptor.floating_point_range = [FloatingPointRange(
            from_value=parameter.smallest, to_value=parameter.largest)]
    return descriptor
