# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What the node holds while it is configured: sources, the worker with its graph, outputs, timers.

Callbacks convert, post and return. The newest pose goes out with every odometry message, as the
newest estimate carried on by that odometry; path and markers follow the updates.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from copy import copy
from functools import partial
import math
import time
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.clock import Clock, ClockType, JumpHandle, JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import (
    QoSDurabilityPolicy,
    QoSHistoryPolicy,
    QoSProfile,
    QoSReliabilityPolicy,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from sensor_msgs.msg import Imu, NavSatFix

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.estimate import UpdateReport
from pose_graph_ros.core.measurements import OdometrySample
from pose_graph_ros.core.saved_graph import SavedGraph
from pose_graph_ros.core.springs import Spring
from pose_graph_ros.ros import diagnostics, memory
from pose_graph_ros.ros.continuity import Continuity
from pose_graph_ros.ros.conversions import frame, Message
from pose_graph_ros.ros.intake import Intake, PAUSED
from pose_graph_ros.ros.publishers import Publishers
from pose_graph_ros.ros.rewind import Heard
from pose_graph_ros.ros.setting import PoseSetting
from pose_graph_ros.ros.sources import backend_config, Kind, SET_POSE, Source
from pose_graph_ros.ros.transforms import TFMessage
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
SETTING_QOS = QoSProfile(depth=1, reliability=QoSReliabilityPolicy.RELIABLE)

CLASSES: dict[Kind, tuple[type, QoSProfile]] = {
    Kind.ODOMETRY: (Odometry, SENSOR_QOS), Kind.FIX: (NavSatFix, SENSOR_QOS),
    Kind.GLOBAL_POSE: (PoseWithCovarianceStamped, SENSOR_QOS), Kind.IMU: (Imu, SENSOR_QOS),
    Kind.LOOP_CLOSURE: (PoseWithCovarianceStamped, CLOSURE_QOS)}

# How long the end of the node waits for a solve that is under way [s]; launch kills after 5.
STOP_TIMEOUT = 4.0
# How often a silence is looked for [s].
SILENCE_PERIOD = 0.2
# How often the constraints with the largest energies are looked for [s], and how many of them.
STRAIN_PERIOD = 5.0
N_STRAINED = 3


class Session:
    """
    From the configuration of the node to its clean-up.

    Parameters
    ----------
    node : rclpy.node.Node
    values : mapping
        All checked parameters.

    Raises
    ------
    ConfigError
        If they do not go together.

    """

    def __init__(self, node: Node, values: Mapping[str, Any]) -> None:
        self.node, self.values = node, dict(values)
        self._config = backend_config(values)
        self.intake = Intake(values, node.get_logger().warning)
        self.out = Publishers(node, values, node.get_logger().warning)
        self._setting = PoseSetting(
            self.out.map_frame, self.out.odom_frame, self.out.base_frame)
        self.active = False
        self.n_resets, self.reset_reason = 0, ''
        self._subscriptions: list[Subscription] = []
        self._timers: dict[str, Timer] = {}
        self._jump_handle: JumpHandle | None = None
        # steady: a clock that is set, or a bag that starts again, must not stall a timer
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._clear()
        self.worker = self._begin(PoseGraphBackend(self._config), self._warm_up)
        self._set_timer('diagnostics', values['diagnostics_period'], self.publish_diagnostics)

    def _clear(self, *, goes_on: bool = False) -> None:
        self._continuity = {
            name: Continuity(source.maximum_speed, goes_on=goes_on)
            for name, source in self._config.odometry.items()}
        self.silent: list[str] = []
        """Sources that have ended while others go on."""
        self.strained: Sequence[Spring] = []
        """The constraints with the largest energies."""
        self._strain_at = -math.inf

    def _begin(
        self, backend: PoseGraphBackend,
        prepare: Callable[[Callable[[], bool]], None] | None = None,
    ) -> Worker:
        """Start the thread that owns a graph."""
        worker = Worker(backend, partial(self._show, self.out.graph), prepare)
        worker.start()
        return worker

    def _warm_up(self, stopped: Callable[[], bool]) -> None:
        """Have the kernels ready before the first measurement; runs in the worker's thread."""
        # imported here, in the thread: the subscriptions need not wait for Numba
        from pose_graph_ros.core.jit import is_cached  # noqa: PLC0415
        from pose_graph_ros.core.warm_up import warm_up  # noqa: PLC0415

        if not is_cached():
            self.node.get_logger().info(
                'compiling kernels, 20 s to a minute on the first start; what comes in waits')
        seconds = warm_up(stopped)
        memory.let_go()
        if not stopped():
            self.node.get_logger().info(f'kernels ready after {seconds:.1f} s')

    # ---- transitions of the node

    def activate(self) -> None:
        """Begin to listen and to publish, or go on."""
        sources = self.intake.reader.sources.values()
        # first: what it tells has to be there before the first fix, if that can be
        if TFMessage is not None and any(source.kind is Kind.FIX for source in sources):
            self._subscribe('/tf_static', TFMessage, self.intake.reader.frames.take, STATIC_QOS)
        for topic in ('initialpose', 'set_pose'):
            self._subscribe(topic, PoseWithCovarianceStamped, self._on_set_pose, SETTING_QOS)
        for source in sources:
            message_type, qos = CLASSES[source.kind]
            self._subscribe(source.topic, message_type, partial(self._on_message, source), qos)
        self._watch_time()
        self.active = True
        topics = ', '.join(self.node.resolve_topic_name(source.topic) for source in sources)
        self.node.get_logger().info(f'ready, listening to {topics}')

    def deactivate(self) -> None:
        """Listen and publish no more; the graph stays."""
        self.active = False
        if self._jump_handle is not None:
            self._jump_handle.unregister()
            self._jump_handle = None
        for name in ('update', 'silence', 'views'):
            self.node.destroy_timer(self._timers.pop(name))
        for subscription in self._subscriptions:
            self.node.destroy_subscription(subscription)
        self._subscriptions.clear()

    def close(self) -> None:
        """Let everything go."""
        if self.active:
            self.deactivate()
        for timer in self._timers.values():
            self.node.destroy_timer(timer)
        if not self.worker.stop(STOP_TIMEOUT):
            self.node.get_logger().warning('stopping although a solve is still under way')
        self.out.close()

    def configure(self, values: Mapping[str, Any]) -> None:
        """Take parameters that can be changed now."""
        self.values = dict(values)
        self._config = config = backend_config(values)
        self.intake.configure(values)
        self.out.configure(values)
        for name, source in config.odometry.items():
            self._continuity[name].maximum_speed = source.maximum_speed
        self.worker.call(lambda backend: backend.configure(config))
        self._set_timer('diagnostics', values['diagnostics_period'], self.publish_diagnostics)
        if self.active:
            self._watch_time()

    def _subscribe(
        self, topic: str, message_type: type, take: Callable[[Any], None], qos: QoSProfile,
    ) -> None:
        self._subscriptions.append(self.node.create_subscription(
            message_type, topic, take, copy(qos),  # rclpy writes the overrides into it
            qos_overriding_options=QoSOverridingOptions.with_default_policies()))

    def _set_timer(self, name: str, period: float, tick: Callable[[], None]) -> None:
        if name in self._timers:
            self.node.destroy_timer(self._timers.pop(name))
        self._timers[name] = self.node.create_timer(period, tick, clock=self._steady)

    # ---- messages

    def _on_message(self, source: Source, message: Message) -> None:
        """Take a message; never raises, whatever it holds."""
        estimate = self.worker.estimate
        taken = self.intake.hear(source, message, '' if estimate is None else estimate.lead)
        if taken.jump_ns > 0:
            self.begin_anew(f'the stamps of {source.name} jumped back by '
                            f'{taken.jump_ns * 1e-9:.3f} s', taken.released)
        else:
            for heard in taken.released:
                self._use(heard)

    def _use(self, heard: Heard) -> None:
        """Read a message and hand it to the engine; publish what follows from it at once."""
        measurement = self.intake.read(heard)
        if measurement is None:
            return
        self.intake.post(heard.source, measurement, self.worker.post)
        if isinstance(measurement, OdometrySample):
            self._carry(heard.source, measurement, heard.message)

    def _carry(self, name: str, sample: OdometrySample, message: Odometry) -> None:
        """Publish where the robot is by the newest estimate, carried on by odometry."""
        estimate = self.worker.estimate
        carries = self._continuity[name].carries(estimate, sample)
        if estimate is None or estimate.lead != name:
            return
        self._check_frames(message)
        if carries:
            self.out.publish_pose(estimate, message, sample, self.intake.reader.datum)
        elif not self.intake.paused:
            self.worker.request_update()  # with this sample

    def _check_frames(self, odometry: Odometry) -> None:
        """Say once if the odometry's frames are not those that the outputs are given in."""
        for name, parameter, expected in (
                (odometry.header.frame_id, 'odom_frame', self.out.odom_frame),
                (odometry.child_frame_id, 'base_link_frame', self.out.base_frame)):
            if frame(name) not in ('', expected):
                self.intake.say_once(parameter, name, (
                    f'the odometry has the frame {frame(name)!r}, but the parameter {parameter} '
                    f'is {expected!r}: set it, or the transform does not fit the tree'))

    def _on_set_pose(self, message: Message) -> None:
        """Take where the robot is from somebody who knows."""
        answer = PAUSED if self.intake.paused else self._setting.take(
            message, early=self.worker.estimate is None)
        if answer is not None:
            self.intake.refuse(SET_POSE, answer)
        self._set_pose()

    def _set_pose(self) -> None:
        """Hand a pose that was set to the engine, once there is odometry."""
        estimate = self.worker.estimate
        if estimate is None or (pose := self._setting.pop(estimate)) is None:
            return
        x, y, yaw = pose.pose
        self.node.get_logger().info(
            f'the pose is set to ({x:.3f}, {y:.3f}, {yaw:.3f}) in {self.out.map_frame}')
        self.out.jump()
        self.worker.call(lambda backend: backend.set_pose(pose, SET_POSE))
        self.worker.request_update()

    # ---- time

    def _watch_time(self) -> None:
        """Start the timers, and have jumps of the clock backward beyond the threshold told."""
        values = self.values
        self._set_timer('update', 1.0 / values['frequency'], self._on_update_timer)
        self._set_timer('silence', SILENCE_PERIOD, self._on_silence_timer)
        self._set_timer('views', max(min(values['path_period'], 0.5), 0.1), self._on_views_timer)
        if self._jump_handle is not None:
            self._jump_handle.unregister()
        threshold = JumpThreshold(
            min_forward=None, on_clock_change=False,
            min_backward=Duration(seconds=-values['clock_jump_threshold']))
        self._jump_handle = self.node.get_clock().create_jump_callback(
            threshold, post_callback=self._on_clock_jump)

    def _on_clock_jump(self, jump: TimeJump) -> None:
        back_ns = -jump.delta.nanoseconds
        self.intake.rewind.clock_jumped(back_ns)
        self.begin_anew(f'the clock jumped back by {back_ns * 1e-9:.3f} s',
                        self.intake.rewind.release())

    def reset(self) -> None:
        """Begin a new graph as somebody asks for it; what comes next may be of any time."""
        self.intake.rewind.forget()
        self.begin_anew('a call of ~/reset')

    def begin_anew(self, reason: str, messages: Sequence[Heard] = ()) -> None:
        """Begin a new graph; a datum that was given, and what /tf_static told, stay."""
        self._replace(PoseGraphBackend(self._config), f'the graph begins anew: {reason}')
        for heard in messages:
            self.intake.received[heard.source] += 1
            self._use(heard)

    def load(self, saved: SavedGraph, backend: PoseGraphBackend, name: str) -> None:
        """Go on with a graph that was loaded."""
        self.intake.rewind.forget()
        self._replace(backend, f'the graph in {name} was loaded', goes_on=True)
        if saved.datum is not None:
            self.intake.reader.datum.keep(saved.datum)
        self.worker.request_update()

    def _replace(
        self, backend: PoseGraphBackend, reason: str, *, goes_on: bool = False,
    ) -> None:
        self.node.get_logger().warning(reason)
        prepare = None if self.worker.prepared else self._warm_up
        self.worker.stop(0.0)  # a solve that is under way ends in vain
        self.out.begin_anew()
        self.intake.begin_anew(self.values)
        self._setting.forget()
        self._clear(goes_on=goes_on)
        self.n_resets, self.reset_reason = self.n_resets + 1, reason
        self.worker = self._begin(backend, prepare)

    # ---- timers

    def _on_update_timer(self) -> None:
        """Ask for an update with what has come in."""
        self._set_pose()
        if self.intake.goes_on:
            self.worker.request_update()

    def _on_silence_timer(self) -> None:
        """Ask for the full optimisation that ends a stream, once, when nothing usable comes."""
        for heard in self.intake.overdue():
            self._use(heard)
        silence = time.monotonic() - self.intake.heard_at
        if self.intake.goes_on and 0.0 < self.values['closing_silence'] < silence:
            self.intake.goes_on = False
            self.worker.request_closing()

    def _on_views_timer(self) -> None:
        """Have the worker's thread publish path and markers that are due."""
        if self.worker.estimate is not None and self.worker.prepared:
            self.worker.call(partial(self._show, self.out.graph))

    def _show(self, graph: int, backend: PoseGraphBackend, *, at_once: bool = False) -> None:
        """Publish path and markers that are due, in the worker's thread."""
        estimate = self.worker.estimate
        if estimate is None:
            return
        if self.out.path_is_due(estimate) or at_once:
            newest = backend.estimate()
            assert newest is not None
            self.out.publish_path(estimate, newest.path, graph)
        if self.out.graph_is_due() and (view := backend.view()) is not None:
            self.out.publish_graph(view, estimate.stamp_ns, graph)

    def optimize(self) -> 'Future[UpdateReport]':
        """Have the whole graph optimised, and its path published at once."""
        worker, graph = self.worker, self.out.graph

        def job(backend: PoseGraphBackend) -> UpdateReport:
            report = worker.close(backend)
            # who has the answer must not have to guess which path is the optimised one
            self._show(graph, backend, at_once=True)
            return report
        return worker.call(job)

    @property
    def odometry_topics(self) -> list[str]:
        """Where odometry is expected."""
        return [self.node.resolve_topic_name(source.topic)
                for source in self.intake.reader.sources.values()
                if source.kind is Kind.ODOMETRY]

    def publish_diagnostics(self) -> None:
        """Publish the state of the node."""
        now = time.monotonic()
        before, self.silent = self.silent, (
            self.intake.hearing.silent(now) if self.active else [])
        for name in sorted(set(self.silent) - set(before)):
            self.node.get_logger().warning(f'{name} is silent, other sources go on')
        if self.out.transforms is not None and self.active:
            self.out.transforms.look_for_others()
        if now - self._strain_at > STRAIN_PERIOD and self.worker.prepared:
            self._strain_at = now
            self.worker.call(self._look_for_strain)
        level, text = diagnostics.health(self)
        self.out.publish_diagnostics(level, text, diagnostics.values(self))

    def _look_for_strain(self, backend: PoseGraphBackend) -> None:
        self.strained = backend.largest_energies(N_STRAINED)
