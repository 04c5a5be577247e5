# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Everything that a configured node owns: inputs, the worker with its graph, outputs and timers.

Callbacks read messages, post measurements and return. With each message of the primary odometry
the newest estimate, propagated by it, is published; path and markers are after updates.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from functools import partial
import logging
import math
import time
from typing import Any, NamedTuple

from rclpy.clock import Clock, ClockType, JumpHandle, JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.subscription import Subscription
from rclpy.timer import Timer

from pose_graph_ros.adapters import sources as kinds
from pose_graph_ros.adapters.conversions import Message
from pose_graph_ros.adapters.sources import backend_config, MessageReader, Source
from pose_graph_ros.core import measurements, quantities
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.estimate import UpdateReport
from pose_graph_ros.core.io.graph_files import SavedGraph
from pose_graph_ros.ros import diagnostics, log, publishers, spinning, topics
from pose_graph_ros.ros.input import Input, PAUSED, PoseContinuity, ReceivedMessage
from pose_graph_ros.ros.stored_graphs import continued, from_journal, initial_graph, journal_of
from pose_graph_ros.ros.watchdog import Watchdog
from pose_graph_ros.ros.worker import SetPoseInput, Worker

logger = logging.getLogger(__name__)

STOP_TIMEOUT = 0.5  # longest wait at the end for what the worker does [s]
NEW_GRAPH = 'a new graph was started: '
JOURNAL_TIMEOUT = 2.0  # the same for the disk [s]


class Replaced(NamedTuple):
    """A graph that was replaced, as long as it can be brought back."""

    worker: Worker  # which was told to end
    reader: MessageReader  # with the datum

    @property
    def n_hidden(self) -> int:
        """Number of its hidden nodes, by the newest estimate."""
        return 0 if self.worker.estimate is None else self.worker.estimate.n_hidden

    def __str__(self) -> str:
        return f'{self.n_hidden} hidden nodes, by ~/undo_reset'


class Session:
    """Inputs, graph and outputs of the node, from its configuration to its clean-up."""

    def __init__(self, node: Node, values: Mapping[str, Any]) -> None:
        self.node, self.values = node, dict(values)
        self._given_datum: dict[str, list[float]] = {}  # instead of the parameter
        self._config = backend_config(values)
        path, datum = initial_graph(values)
        self.input = Input(values, self._publishers)
        self.out = publishers.Publishers(node, values)
        self._set_pose_input = SetPoseInput(self.out.frames)
        self._pose_set_at = -math.inf
        self.active = False
        self.n_resets, self.reset_reason = 0, ''
        self.replaced: Replaced | None = None  # the newest graph with odometry that was replaced
        self._told: dict[str, str] = {}  # what is logged and not over, by what does not vary
        self.activated_at = math.inf  # by a monotonic clock [s]
        self.compiling = False  # whether kernels are compiled, which a start from the cache is not
        self._subscriptions: list[Subscription] = []
        self._timers: dict[str, Timer] = {}
        self._jump_handle: JumpHandle | None = None
        # a clock that is set back, or a bag that starts again, must not stall a timer
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.journal = journal = journal_of(values)
        self._closing, self._recovering = False, Watchdog()
        kept = self.input.reader.datum

        def prepare(stopped: Callable[[], bool]) -> PoseGraphBackend | None:
            self._warm_up(stopped)
            # also what was replaced meanwhile, as it can be brought back
            backend = None if journal is None or self._closing else from_journal(
                journal, self._config, kept, self._recovering.over)
            if backend is None and path is not None and not self._closing:
                backend = continued(path, values['file_folder'], self._config)
            if backend is None and not stopped():
                self._set_loaded(is_loaded=False)
            return backend

        if datum is not None:
            kept.keep(datum)
        self._begin(PoseGraphBackend(self._config), prepare, has_graph=path is not None,
                    resumes=journal is not None or path is not None)
        self._set_timer('diagnostics', values['diagnostics_period'], self.publish_diagnostics)
        self._set_timer('watchdog', 0.2, self._watch)

    def _watch(self) -> None:
        for each in (self._recovering, self.worker.watchdog):
            each.watch(self.values['solve_timeout'])

    def _begin(self, backend: PoseGraphBackend, prepare: Callable[[Callable[[], bool]], Any], *,
               resumes: bool, has_graph: bool) -> None:
        """Start the thread that owns a graph, which may resume a drive, of the journal or not."""
        self._continuity = {name: PoseContinuity(source.maximum_speed, resumes=resumes)
                            for name, source in self._config.odometry.items()}
        self._set_loaded(is_loaded=resumes)
        # of this graph, so that the answer of an earlier worker is nobody's
        self.searches = diagnostics.Searches()
        graph = self.out.graph
        self.worker = worker = Worker(
            backend, lambda backend: self.out.publish_views(worker, graph, backend), prepare,
            None if self.journal is None else self.journal.begin(has_state=has_graph))
        worker.thread.start()
        if resumes:
            self._keep_state()
            self.worker.request_update()

    def _set_loaded(self, *, is_loaded: bool) -> None:
        """Note whether the graph began as one that was loaded, which odometry must not take."""
        self.is_loaded = is_loaded
        self.input.time_jumps.senders.strangers_may = not is_loaded

    def _warm_up(self, stopped: Callable[[], bool]) -> None:
        """Compile or load all kernels before the first measurement; for the worker's thread."""
        # imported here, in the thread, so that the subscriptions do not wait for Numba
        from pose_graph_ros.core.compiled.jit import is_cached  # noqa: PLC0415
        from pose_graph_ros.core.warm_up import warm_up  # noqa: PLC0415

        if not is_cached():
            self.compiling = True
            logger.info('compiling kernels, up to two minutes, only at the first start; '
                        'measurements wait until then, none is lost')
        seconds = warm_up(stopped)
        if not stopped():   # else another worker may be compiling by now
            self.compiling = False
            logger.info('kernels ready after %.1f s', seconds)

    # ---- transitions of the node

    def activate(self) -> None:
        """Create the subscriptions and start the timers."""
        sources = self.input.reader.sources.values()
        callbacks: dict[str, Callable[[Any], None]] = {
            'initialpose': self.receive_pose, 'set_pose': self.receive_pose,
            # the worker is replaced with the graph
            topics.JUDGE_TOPIC: lambda message: self.worker.decide(message)}  # noqa: PLW0108
        if any(source.kind.in_frames for source in sources):
            callbacks[topics.STATIC_TOPIC] = self.input.reader.frames.receive
        wanted = [(topic, *given, callbacks[topic]) for topic, given in topics.INPUTS.items()
                  if topic in callbacks]
        wanted += [(source.topic, source.kind.message_type,
                    topics.CLOSURE_QOS if source.kind.is_rare else topics.SENSOR_QOS,
                    partial(self._on_message, source)) for source in sources]
        self._subscriptions = [self.node.create_subscription(
            topics.message_class(kind), topic, spinning.guarded(callback, lambda: self.active),
            **topics.overridable(qos)) for topic, kind, qos, callback in wanted]
        self._watch_time()
        self.active, self.activated_at = True, time.monotonic()
        for arrivals in self.input.arrivals.values():
            arrivals.resume(self.activated_at)
        logger.info('ready, listening to %s', ', '.join(
            self.node.resolve_topic_name(source.topic) for source in sources))

    def deactivate(self) -> None:
        """Destroy the subscriptions and stop the timers; keep the graph."""
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
        """Stop the worker; destroy subscriptions, timers and publishers."""
        self._closing = True
        if self.active:
            self.deactivate()
        for name in ('diagnostics', 'watchdog'):
            self.node.destroy_timer(self._timers.pop(name))
        if self.journal is not None:
            # a failure is logged, and all else has to be closed
            with suppress(Exception):
                self._keep_state().result(STOP_TIMEOUT)
        if not self.worker.stop(STOP_TIMEOUT):
            logger.warning('stopping in the middle of %s',
                           'a compilation' if self.compiling else 'a solve')
        if self.journal is not None and not self.journal.close(JOURNAL_TIMEOUT):
            logger.warning('the journal is still being written')
        self.out.close()

    def _keep_state(self) -> 'Future[None]':
        """Make the worker's thread hand the state of the engine to the journal, if it exists."""
        worker, datum = self.worker, self.input.reader.datum

        def keep(_: PoseGraphBackend) -> None:
            worker.keep_state(None if datum.plane is None else datum.plane.origin)
        return worker.call(keep, 'the state for the journal', 'one is enough')

    def configure(self, values: Mapping[str, Any]) -> None:
        """Set the parameters that can change while the node runs."""
        self.values = {**values, **self._given_datum}
        self._config = config = backend_config(values)
        self.input.reader.configure(values)
        self.out.configure(values)
        for name, source in config.odometry.items():
            self._continuity[name].maximum_speed = source.maximum_speed
        self.worker.call(lambda backend: backend.configure(config), 'a change of parameters',
                         'the newest')
        self._set_timer('diagnostics', values['diagnostics_period'], self.publish_diagnostics)
        if self.active:
            self._watch_time()

    def set_datum(self, given: Sequence[float]) -> None:
        """Use a datum as if the parameter gave it; raises ValueError if it is not on Earth."""
        self.input.reader.datum.give(*given)
        # a new graph has it as well
        self._given_datum['datum'] = self.values['datum'] = [*given]
        if self.journal is not None:
            self._keep_state()

    def _set_timer(self, name: str, period: float, tick: Callable[[], None]) -> None:
        timer, period_ns = self._timers.get(name), round(period * quantities.NANOSECONDS)
        if timer is None:
            self._timers[name] = self.node.create_timer(
                period, spinning.guarded(tick, lambda: name in self._timers), clock=self._steady)
        elif timer.timer_period_ns != period_ns:
            # not a new one: the executor knows it before the one that it replaces is gone
            timer.timer_period_ns = period_ns
            timer.reset()

    # ---- messages

    def _on_message(self, source: Source, message: Message) -> None:
        """Receive a message; never raises, whatever its content."""
        decision = self.input.receive(source.name, message)
        if decision.jump_ns > 0:
            self._start_new_graph(f'the stamps of {source.name} jumped back by '
                                  f'{decision.jump_ns * 1e-9:.3f} s', decision.released)
        else:
            for received in decision.released:
                self._use(received)

    def _use(self, received: ReceivedMessage) -> None:
        """Post the measurement of a message; publish the pose at once for odometry."""
        self.input.post(received, self.worker.post)
        name, message, sample, refusal = received
        if refusal is not None or not isinstance(sample, measurements.OdometrySample):
            return
        estimate = self.worker.estimate
        covers = self._continuity[name].covers(estimate, sample)
        if estimate is not None and estimate.primary == name:
            if covers:
                self.out.publish_pose(estimate, message, sample, self.input.reader.datum)
            elif not self.input.paused:
                self.worker.request_update()  # with this sample

    def receive_pose(self, message: Message) -> None:
        """Receive a pose that a user sets."""
        answer = PAUSED if self.input.paused else self._set_pose_input.receive(
            message, early=self.worker.estimate is None)
        if answer is not None:
            self.input.reject(kinds.SET_POSE, answer)
            logger.warning(
                'the pose is not set: %s: %s', answer.reason, answer.detail, extra=log.ANSWER)
        # of more than a person sets the newest is taken with the next update
        if time.monotonic() - self._pose_set_at > 1.0:
            self._set_pose()

    def _set_pose(self) -> None:
        """Hand the pose that was set, if there is one, to the engine once there is odometry."""
        estimate = self.worker.estimate
        if estimate is not None and (pose := self._set_pose_input.pop(estimate)) is not None:
            self._pose_set_at = time.monotonic()
            self.out.jump()
            self.worker.set_pose(pose, self.out.map_frame)

    # ---- time

    def _watch_time(self) -> None:
        """Start the timers, and register the callback for jumps of the clock back in time."""
        values = self.values
        self._set_timer('update', 1.0 / values['frequency'], self._on_update_timer)
        self._set_timer('silence', 0.2, self._on_silence_timer)
        self._set_timer('views', max(min(values['path_period'], 0.5), 0.1), self._on_views_timer)
        if self._jump_handle is None:
            self._jump_handle = self.node.get_clock().create_jump_callback(
                JumpThreshold(min_forward=None, on_clock_change=False,
                              min_backward=Duration(nanoseconds=-kinds.CLOCK_JUMP_NS)),
                post_callback=spinning.guarded(self._on_clock_jump, lambda: self.active))

    def _on_clock_jump(self, jump: TimeJump) -> None:
        back_ns = -jump.delta.nanoseconds
        self.input.time_jumps.clock_jumped(back_ns, self.node.get_clock().now().nanoseconds)
        self._start_new_graph(f'the clock jumped back by {back_ns * 1e-9:.3f} s',
                              self.input.time_jumps.release())

    def reset(self) -> None:
        """Start a new graph on request; the next messages may have any stamps."""
        self.input.time_jumps.forget()
        why = 'a call of ~/reset'
        if self.is_loaded or any(each.count > 0 for each in self.input.arrivals.values()):
            self._start_new_graph(why)
        else:   # nothing has come since the last one
            self.n_resets, self.reset_reason = self.n_resets + 1, f'{NEW_GRAPH}{why}'

    def _publishers(self, source: str) -> set[bytes]:
        """Return the ids of those who publish the topic of a source."""
        topic = self.input.reader.sources[source].topic
        return {bytes(info.endpoint_gid) for info in self.node.get_publishers_info_by_topic(topic)}

    def _start_new_graph(self, reason: str, messages: Sequence[ReceivedMessage] = ()) -> None:
        """Start a new graph with some messages; keep the datum by parameter and /tf_static."""
        self._replace(PoseGraphBackend(self._config), f'{NEW_GRAPH}{reason}')
        for source, message, *_ in messages:
            self.input.arrivals[source].count += 1
            # read again, as the first fix of the new graph may be its datum
            if (measurement := self.input.read(source, message)) is not None:
                self._use(ReceivedMessage(source, message, measurement))

    def load(self, saved: SavedGraph, backend: PoseGraphBackend, name: str) -> None:
        """Replace the graph by one that was loaded."""
        self.input.time_jumps.forget()
        reader = MessageReader(self.values, self.input.reader.frames, self.input.reader.keeper)
        if saved.datum is not None:
            reader.datum.keep(saved.datum)
        self._replace(backend, f'the graph in {name} was loaded', resumes=True, reader=reader)

    def undo_reset(self, replaced: Replaced) -> None:
        """Exchange the graph for the one that was replaced, whose worker has ended."""
        backend, rest = replaced.worker.rest()
        backend.configure(self._config)
        self.input.time_jumps.forget()
        self.replaced = None
        self._replace(backend, 'the graph before is back: a call of ~/undo_reset', resumes=True,
                      reader=replaced.reader)
        for source, measurement in rest:
            self.worker.post(source, measurement)

    def _replace(self, backend: PoseGraphBackend, reason: str, *, resumes: bool = False,
                 reader: MessageReader | None = None) -> None:
        """Replace the graph, and its reader if one is given; keep the one so far for an undo."""
        prepared = self.worker.prepared
        self.worker.stop(0.0)  # of a running solve nothing is published
        if self.worker.has_odometry or self.is_loaded:
            self.replaced = Replaced(self.worker, self.input.reader)
        logger.warning('%s%s', reason, '' if self.replaced is None else (
            f'; what can be brought back: {self.replaced}'), extra=log.ANSWER)
        self.out.start_new_graph()
        self.input.start_new_graph(self.values, reader)
        self._set_pose_input.waiting = None
        self.n_resets, self.reset_reason = self.n_resets + 1, reason
        self._begin(backend, (lambda _: None) if prepared else self._warm_up, resumes=resumes,
                    has_graph=resumes)

    # ---- timers

    def _on_update_timer(self) -> None:
        """Request an update if the stream of measurements has not ended."""
        self._set_pose()
        if self.input.is_streaming:
            self.worker.request_update()

    def _on_silence_timer(self) -> None:
        """Request the final optimisation, once, when no measurements come any more."""
        for received in self.input.release_overdue():
            self._use(received)
        silence = time.monotonic() - self.input.posted_at
        if self.input.is_streaming and 0.0 < self.values['closing_silence'] < silence:
            self.input.is_streaming = False
            self.optimize()
        if self.worker.prepared and self.worker.chapter is not None and (
                self.worker.chapter.is_due(silence)):
            self._keep_state()

    def _on_views_timer(self) -> None:
        """Make the worker's thread publish path and markers that are due."""
        if self.worker.estimate is not None and self.worker.prepared:
            self.worker.call(partial(self.out.publish_views, self.worker, self.out.graph),
                             'the path or the markers', 'the newest')

    def optimize(self) -> 'Future[UpdateReport]':
        """Request a full optimisation, after which the path is published at once."""
        worker, graph = self.worker, self.out.graph

        def job(backend: PoseGraphBackend) -> UpdateReport:
            report = worker.optimize_fully(backend)
            # so that the next path after the answer is the optimised one
            self.out.publish_views(worker, graph, backend, at_once=True)
            return report
        return worker.call(job, 'the full optimisation', 'the one')

    def publish_diagnostics(self) -> None:
        """Publish the state of the node."""
        status = self.worker.status
        self.input.watch(status.counts, status.refusals, active=self.active)
        if self.out.transforms is not None and self.active:
            self.out.transforms.check_for_others()
        self.searches.update(self.worker)
        # in this order: the sentence is then at least as new as the values beside it
        values, found = diagnostics.values(self), [*diagnostics.concerns(self)]
        level, text, _ = found[0]
        self.out.publish_diagnostics(level, f'{text[0].upper()}{text[1:]}.', values)
        if self.active:
            present = {log.VARYING.sub('', each.text): each.text for each in found if each.logged}
            for key in present.keys() - self._told.keys():
                logger.warning('%s', present[key])
            for key in self._told.keys() - present.keys():
                logger.info('over: %s', self._told[key])
            self._told = present
