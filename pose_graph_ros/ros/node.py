# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The node: messages in, measurements to the worker, estimates out as messages.

Callbacks convert, post and return. The newest pose goes out with every odometry message, as the
newest estimate carried on by that odometry; the path goes out after an update.
"""

from collections import Counter
from collections.abc import Callable
from functools import partial
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.qos import QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.task import Future
from sensor_msgs.msg import NavSatFix
from std_srvs.srv import Trigger

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch import Status
from pose_graph_ros.core.estimate import AlignmentState, Estimate
from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.measurements import Answer, OdometrySample, rejected
from pose_graph_ros.ros.conversions import FixReader, frame, Message, MessageReader
from pose_graph_ros.ros.parameters import backend_config, checked, Parameter, PARAMETERS
from pose_graph_ros.ros.publishers import Publishers
from pose_graph_ros.ros.worker import Worker

# Every increment of the odometry counts, so the queue is deep; a best-effort reader hears
# reliable and best-effort writers alike.
SENSOR_QOS = QoSProfile(depth=1000, history=QoSHistoryPolicy.KEEP_LAST,
                        reliability=QoSReliabilityPolicy.BEST_EFFORT)
# A loop closure is rare and must not get lost.
CLOSURE_QOS = QoSProfile(depth=100, reliability=QoSReliabilityPolicy.RELIABLE)

INPUTS: tuple[tuple[str, str, type, QoSProfile], ...] = (
    ('odom', 'odom', Odometry, SENSOR_QOS),
    ('global_pose', 'global_pose', PoseWithCovarianceStamped, SENSOR_QOS),
    ('fix', 'gps/fix', NavSatFix, SENSOR_QOS),
    ('loop_closure', 'loop_closure', PoseWithCovarianceStamped, CLOSURE_QOS),
)

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
        values = self._declare(PARAMETERS)
        try:
            config = backend_config(values)
            fixes = FixReader(values['datum'], values['fix.lever_arm'])
        except ValueError as error:
            raise ConfigError(str(error)) from error
        self._out = Publishers(self, values, config.odometry_noise)
        self._reader = MessageReader(self._out.map_frame, fixes)
        self._received: Counter[str] = Counter()
        self._refused: Counter[tuple[str, str]] = Counter()
        self._said: set[tuple[str, str]] = set()
        self._closing_silence = values['closing_silence']
        self._heard_at = time.monotonic()
        self._closed = True

        self._fresh = self.create_guard_condition(self._publish_path)
        self._worker = Worker(
            PoseGraphBackend(config), lambda _: self._fresh.trigger(), self._warm_up)
        for source, topic, message_type, qos in INPUTS:
            self.create_subscription(
                message_type, topic, partial(self._on_message, source), qos,
                qos_overriding_options=QoSOverridingOptions.with_default_policies())
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
        topics = ', '.join(self.resolve_topic_name(topic) for _, topic, _, _ in INPUTS)
        self.get_logger().info(f'ready, listening to {topics}')

    def _declare(self, parameters: tuple[Parameter, ...]) -> dict[str, Any]:
        """Declare the parameters and return their values."""
        given: dict[str, Any] = {}
        for parameter in parameters:
            # an array without a value has no type yet; numbers may be given as 5 for 5.0
            unset = parameter.default == []
            declared = self.declare_parameter(
                parameter.name, None if unset else parameter.default, _descriptor(parameter))
            if declared.type_ is not RosParameter.Type.NOT_SET:
                given[parameter.name] = (
                    list(declared.value) if isinstance(parameter.default, list)
                    else declared.value)
        return checked(given)

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

    def _on_message(self, source: str, message: Message) -> None:
        """Convert a message and post it; never raises, whatever the message holds."""
        self._received[source] += 1
        try:
            measurement = self._reader.read(source, message)
        except Exception as error:
            measurement = rejected('malformed', f'{type(error).__name__}: {error}')
        if not isinstance(measurement, Answer) and not self._worker.post(source, measurement):
            measurement = rejected('inbox_full', 'the solver does not keep up')
        if isinstance(measurement, Answer):
            self._refuse(source, measurement)
            return
        self._heard_at, self._closed = time.monotonic(), False
        if source == 'odom':
            self._check_frames(message)
        estimate = self._worker.estimate
        if isinstance(measurement, OdometrySample) and estimate is not None:
            self._out.publish_pose(estimate, message, measurement.pose)

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
        status, estimate = self._worker.status, self._worker.estimate
        values: dict[str, object] = {
            'received': sum(self._received.values()),
            'processed': status.processed + sum(self._refused.values()),
            'pending': status.pending, 'quarantined': status.quarantined,
            'updates': status.updates, 'prepared': int(self._worker.prepared),
            'solve_mean_ms': f'{1e3 * status.solve_mean:.3f}',
            'solve_max_ms': f'{1e3 * status.solve_max:.3f}'}
        for source, count in sorted(self._received.items()):
            values[f'received.{source}'] = count
        for (source, answer), count in sorted((status.counts + self._refused).items()):
            values[f'{source}.{answer}'] = count
        if estimate is not None:
            values.update({
                'alignment': estimate.alignment.value,
                'alignment_sigma_deg': f'{57.29577951308232 * estimate.alignment_sigma:.3f}',
                'hidden_nodes': estimate.n_hidden, 'edges': estimate.n_edges,
                'observed_nodes': estimate.n_observed, 'chi2': f'{estimate.chi2:.6g}'})
        failed = status.report is not None and status.report.status is Status.FAILED
        level, text = _health(
            estimate, failed=failed, alive=self._worker.alive, prepared=self._worker.prepared)
        self._out.publish_diagnostics(level, text, values)


def _health(
    estimate: Estimate | None, *, failed: bool, alive: bool, prepared: bool,
) -> tuple[bytes, str]:
    """Return the level of the diagnostics and a sentence that says what to do."""
    if not alive:
        return DiagnosticStatus.ERROR, 'The worker has ended: start the node again.'
    if failed:
        return (DiagnosticStatus.ERROR, 'The newest measurements made the solver fail and were '
                'set aside; the last good estimate stays. See the log for the reason.')
    if estimate is None:
        return DiagnosticStatus.WARN, (
            'No odometry yet: check the topic odom.' if prepared else
            'Compiling, as at every first start: what comes in waits.')
    if estimate.alignment is AlignmentState.UNALIGNED:
        return (DiagnosticStatus.WARN, 'Unaligned: the angle between odometry and map is not '
                'known yet. Drive some metres with a fix.')
    if estimate.alignment is AlignmentState.LOCAL:
        return (DiagnosticStatus.OK, 'Running; nothing was measured in the map, which begins '
                'where odometry does.')
    return DiagnosticStatus.OK, 'Running.'


def _descriptor(parameter: Parameter) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(
        description=f'{parameter.description} [{parameter.unit}]'.removesuffix(' []'),
        read_only=True, dynamic_typing=not isinstance(parameter.default, bool | str))
    if parameter.smallest is not None and parameter.largest is not None:
        descriptor.floating_point_range = [FloatingPointRange(
            from_value=parameter.smallest, to_value=parameter.largest)]
    return descriptor
