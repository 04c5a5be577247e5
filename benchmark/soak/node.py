# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
An hour with the real node over DDS, as fast as it answers, while people and machines disturb it.

At random the graph is reset, the node is deactivated or cleaned up and started again, parameters
change, messages are malformed, a drive begins again as a bag does that is played again, and the
node is killed and goes on from its journal. In between all that is sent must be received.
"""

from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
import itertools
import math
import os
from pathlib import Path
import random
import threading
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from nav_msgs.msg import Odometry
import numpy as np
from rcl_interfaces.srv import SetParameters
import rclpy
from rclpy.context import Context
from rclpy.parameter import Parameter
from sensor_msgs.msg import NavSatFix
from std_srvs.srv import Trigger

from benchmark.feeder import QOS
from benchmark.load import NODE, Process
from benchmark.soak.life import Event, Life
from pose_graph_ros.adapters.conversions import Datum, stamp_ns
from pose_graph_ros.adapters.output_cdr import odometry_cdr
from pose_graph_ros.cli.demo import isolated_environment
from pose_graph_ros.core.estimate import Prediction
from pose_graph_ros.core.measurements import Fix, OdometrySample
from pose_graph_ros.ros.spinning import Spinner

DATUM = 48.1, 11.6
PARAMETERS = (f'datum:=[{DATUM[0]}, {DATUM[1]}]', 'window.nodes:=2000.0',
              'diagnostics_period:=0.5')
UNDER_WAY = 20  # messages of odometry without a pose so far
BEHIND = 1000   # messages that the node has received and the engine has not taken
PATIENCE = 60.0     # longest wait for the node [s]
SILENCE = 2.0   # longest wait for a pose; those that are late count as unanswered [s]
EPOCH = 4.0, 20.0   # time between two disturbances [s]
FAR = 3.0   # error of a pose that is explained [m]
LOSS_WINDOW = 1.5   # what was known so long before a kill must be there after it [s]
CHANGES: dict[str, Callable[[random.Random], object]] = {
    'frequency': lambda draw: draw.uniform(5.0, 20.0),
    'path_period': lambda draw: draw.uniform(0.2, 2.0),
    'closing_silence': lambda draw: draw.choice((0.0, 1.0, 3.0)),
    'minimum_travel_distance': lambda draw: draw.uniform(0.5, 2.0),
    'window.nodes': lambda draw: float(draw.randrange(500, 3000)),
    'odom.maximum_speed': lambda draw: draw.uniform(20.0, 100.0),
    'fix.covariance_scale': lambda draw: draw.uniform(0.5, 2.0),
    'loop_closure.covariance_scale': lambda draw: draw.uniform(0.5, 2.0),
    'transform_slew': lambda draw: draw.choice(([0.0, 0.0], [0.5, 0.2]))}
"""What may change while the node runs, and what to; what is wrong stays judged."""


@dataclass(slots=True)
class Minute:
    """What happened so far, and in the last minute."""

    minutes: float
    resident: float     # memory of the node [MB]
    age: float  # time since the node's process began [min]
    sent: int   # messages so far, of all kinds
    received: int   # of them by the node, so far
    lost: int   # in the difference, where they are compared
    poses: int  # so far
    unanswered: int     # odometry that no pose came of although it flowed, so far
    latency_p50: float  # of a pose in this minute, behind up to `UNDER_WAY` messages [ms]
    latency_p99: float
    latency_max: float
    lines: int  # of log, so far
    errors: int     # of them errors or tracebacks
    crashes: int    # the process ended by itself, so far
    stuck: list[str]    # what was waited for in vain, so far
    actions: dict[str, int]     # disturbances so far
    changes_refused: int    # parameters that should have changed, so far
    missing: int    # hidden nodes that a kill has cost although they were old enough, so far
    error: float    # of poses before disturbances in this minute, median [m]
    error_max: float
    far: list[str]  # when it was more than `FAR`
    nodes: int  # hidden ones
    journal: float  # [MB]
    journal_lag: float  # longest time that the disk took [s]


class Robot:
    """Sends what the sensors of a robot say, and hears the node."""

    def __init__(self, environment: dict[str, str], folder: Path) -> None:
        os.environ.update({name: environment[name] for name in (
            'ROS_AUTOMATIC_DISCOVERY_RANGE', 'ROS_LOG_DIR', 'AMENT_PREFIX_PATH')})
        self._environment, self._folder, self._numbers = environment, folder, itertools.count()
        self._context = Context()
        rclpy.init(context=self._context, domain_id=int(environment['ROS_DOMAIN_ID']))
        self._node = rclpy.create_node('robot', context=self._context)
        self.publishers: dict[str, Any] = {}
        self.connect()
        self._node.create_subscription(DiagnosticArray, '/diagnostics', self._diagnose, QOS)
        self._node.create_subscription(PoseWithCovarianceStamped, 'pose', self._answer, QOS)
        self._spinner = Spinner(self._node)
        self._thread = threading.Thread(target=self._spinner.spin, daemon=True)
        self._thread.start()
        self.values: dict[str, str] = {}
        self.n_diagnostics, self.poses, self.unanswered, self.sent = 0, 0, 0, 0
        self.known = deque[tuple[float, int]](maxlen=100)   # when there were how many nodes
        self._under_way: dict[int, float] = {}  # when odometry was sent, by its stamp
        self.latencies, self.flows, self.newest = list[float](), False, None
        self.logs, self.fixed_ns = list[Path](), 0
        self.start()

    def connect(self) -> None:
        """Make the publishers, anew if there are any."""
        for publisher in self.publishers.values():
            self._node.destroy_publisher(publisher)
        self.publishers = {
            'odom': self._node.create_publisher(Odometry, 'odom', QOS),
            'fix': self._node.create_publisher(NavSatFix, 'gps/fix', QOS),
            'loop_closure': self._node.create_publisher(
                PoseWithCovarianceStamped, 'loop_closure', QOS)}

    def start(self) -> None:
        """Start the node."""
        log = self._folder / f'log{next(self._numbers)}'
        log.mkdir()
        self.logs.append(log / 'stderr')
        self.values, self.began = {}, time.monotonic()
        self.process = Process(NODE, self._environment | {'ROS_LOG_DIR': str(log)}, (
            *PARAMETERS, f'state_file:={self._folder / "state.db"}'))
        self.wait_ready()

    def wait_ready(self) -> None:
        """Wait until the node listens and has its kernels."""
        self.wait(lambda: self.values.get('prepared') == '1' and self.values['active'] == '1'
                  and all(each.get_subscription_count() > 0 for each in self.publishers.values()),
                  'it is ready', 5 * PATIENCE)

    def wait(self, done: Callable[[], bool], what: str, patience: float = PATIENCE) -> None:
        """Wait until something is so; raises TimeoutError if it does not become so."""
        end = time.monotonic() + patience
        while not done():
            if self.process.process.poll() is not None:
                raise ChildProcessError(f'the node ended: {self.process.process.returncode}')
            if time.monotonic() > end:
                raise TimeoutError(what)
            time.sleep(0.01)

    def wait_quiet(self) -> None:
        """Wait until three diagnostics in a row say that nothing more is received."""
        since, seen = self.n_diagnostics, self.values.get('received')

        def done() -> bool:
            nonlocal since, seen
            if self.values.get('received') != seen:
                since, seen = self.n_diagnostics, self.values.get('received')
            return self.n_diagnostics >= since + 3
        self.wait(done, 'nothing more is received')

    def _diagnose(self, message: DiagnosticArray) -> None:
        self.values = {item.key: item.value for item in message.status[0].values}
        self.n_diagnostics += 1
        self.known.append((time.monotonic(), int(self.values.get('hidden_nodes', 0))))

    def _answer(self, message: PoseWithCovarianceStamped) -> None:
        now, stamp = time.monotonic(), stamp_ns(message)
        self.poses, self.flows, self.newest = self.poses + 1, True, message
        if (sent := self._under_way.pop(stamp, None)) is not None:
            self.latencies.append(now - sent)
            for older in [each for each in [*self._under_way] if each < stamp]:
                if self._under_way.pop(older, None) is not None:
                    self.unanswered += 1

    def send(self, source: str, message: object) -> None:
        """Send a message, which may be serialised."""
        self.sent += 1
        self.publishers[source].publish(message)

    def say(self, event: Event) -> None:
        """Send what a sensor says; odometry once few messages are under way."""
        source, measurement = event
        if source == 'fix':
            self.fixed_ns = measurement.stamp_ns
        self.send(source, message_of(measurement))
        if not isinstance(measurement, OdometrySample) or math.isnan(measurement.pose[0]):
            return
        if not self.flows:
            time.sleep(0.02)    # until there is an estimate no pose is published
            return
        self._under_way[measurement.stamp_ns] = begin = time.monotonic()
        while self.behind > BEHIND and time.monotonic() < begin + 10.0:
            time.sleep(0.01)
        while len(self._under_way) > UNDER_WAY:
            time.sleep(0.0005)
            if time.monotonic() - begin > SILENCE:
                self.unanswered += len(self._under_way)
                self.stop_flowing()

    @property
    def behind(self) -> int:
        """Number of messages that the engine has not taken, by the newest diagnostics."""
        return int(self.values.get('received', 0)) - int(self.values.get('processed', 0))

    def stop_flowing(self) -> None:
        """Expect no pose until one comes."""
        self.flows = False
        self._under_way.clear()

    def call(self, kind: Any, name: str, request: object) -> Any:
        """Call a service of the node, and return its answer."""
        client = self._node.create_client(kind, f'pose_graph/{name}')
        try:
            self.wait(client.service_is_ready, f'{name} is there')
            # an answer is lost if the node does not know yet where to send it
            for _ in range(6):
                future = client.call_async(request)
                with suppress(TimeoutError):
                    self.wait(future.done, f'{name} answers', PATIENCE / 6)
                    return future.result()
            raise TimeoutError(f'{name} answers')
        finally:
            self._node.destroy_client(client)

    def close(self) -> None:
        """End the node and the robot."""
        self.process.stop()
        self._spinner.stop()
        self._thread.join(5.0)
        self._spinner.close()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)


def message_of(measurement: object) -> Any:
    """Return the message of a measurement; that of odometry is serialised."""
    if isinstance(measurement, OdometrySample):
        twist = Odometry()
        twist.twist.twist.linear.x = measurement.speed or 0.0
        return odometry_cdr(measurement.stamp_ns, Prediction(
            measurement.pose, np.zeros((3, 3))), twist, 'odom', 'base_link')
    message = NavSatFix() if isinstance(measurement, Fix) else PoseWithCovarianceStamped()
    stamp = message.header.stamp
    stamp.sec, stamp.nanosec = divmod(measurement.stamp_ns, 1_000_000_000)
    if isinstance(measurement, Fix):
        message.header.frame_id, message.status.status = 'gps', 0
        message.latitude, message.longitude, message.altitude = measurement.coordinates
        covariance = np.diag((*np.diagonal(measurement.covariance), 4.0))
        message.position_covariance_type = 2
        message.position_covariance = covariance.ravel()
        return message
    message.header.frame_id = '@{}.{:09d}'.format(*divmod(measurement.reference_ns, 1_000_000_000))
    x, y, theta = measurement.pose.tolist()
    message.pose.pose.position.x, message.pose.pose.position.y = x, y
    message.pose.pose.orientation.z = math.sin(0.5 * theta)
    message.pose.pose.orientation.w = math.cos(0.5 * theta)
    message.pose.covariance = np.zeros(36)
    message.pose.covariance[[0, 7, 35]] = np.diagonal(measurement.covariance)
    return message


def malformed(draw: random.Random, stamp: int) -> tuple[str, Any]:
    """Return a source and a message with a value that is none, else as of a stamp [ns]."""
    source = draw.choice(('odom', 'fix', 'loop_closure'))
    message = {'odom': Odometry, 'fix': NavSatFix}.get(source, PoseWithCovarianceStamped)()
    message.header.frame_id = {'odom': 'odom', 'fix': 'gps'}.get(source, '@1700000000.0')
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 1_000_000_000)
    number = draw.choice((math.nan, math.inf, -math.inf, 1e308))
    where = draw.randrange(4)
    if where == 0:
        message.header.stamp.sec = message.header.stamp.nanosec = 0
    elif where == 1:
        message.header.frame_id = draw.choice(('', 'elsewhere', '@nan', 'x' * 1000, '@-1.5'))
        if source == 'fix':
            message.latitude = number
    elif source == 'fix':
        message.latitude, message.position_covariance_type = DATUM[0], 2
        message.longitude = number if where == 2 else 0.0
        message.position_covariance = np.full(9, number)
    else:
        pose = message.pose.pose
        if where == 2:
            pose.position.x = number
        else:
            pose.orientation.w = 0.0    # a quaternion of nothing
        message.pose.covariance = np.full(36, number)
    return source, message


class Soak:
    """Disturbs a node at random, and counts what comes of it."""

    def __init__(self, robot: Robot, seed: int) -> None:
        self.robot, self._draw = robot, random.Random(seed)
        self.begin = self._told = time.monotonic()
        self.actions, self.stuck = Counter[str](), list[str]()
        self.lost = self.received = self.crashes = self.refused = self.missing = 0
        self.errors, self.far = list[float](), list[str]()
        self._last = ''     # disturbance
        self._weights: dict[Callable[[], None], int] = {
            self.reset: 3, self.deactivate: 3, self.clean_up: 2, self.change: 6, self.again: 2,
            self.kill: 1, self.damage: 6}

    def run(self, seconds: float) -> Iterator[Minute]:
        """Run for a time [s], and yield what happened at the end of each minute."""
        self._restart()
        while (now := time.monotonic()) < self.begin + seconds:
            end = min(now + self._draw.uniform(*EPOCH), self.begin + seconds)
            try:
                self._begin_epoch()
                while time.monotonic() < end:
                    self.robot.say(next(self._events))
                    if time.monotonic() > self._told + 60.0:
                        yield self.minute()
                action, = self._draw.choices([*self._weights], [*self._weights.values()])
                if action != self.kill:     # which may come in the middle of it all
                    self._end_epoch()
                self._last = action.__name__
                self.actions[self._last] += 1
                action()
            except TimeoutError as error:
                self.stuck.append(f'{error} after {self.actions.total()} actions')
                self._start_anew()
            except ChildProcessError:
                self.crashes += 1
                self._start_anew()
        yield self.minute()

    def _restart(self) -> None:
        """Let the drive begin again."""
        self.life = Life(1, 5.0, Datum(DATUM), seed=self._draw.randrange(1000))
        self._events = itertools.chain.from_iterable(
            piece.events for piece in itertools.chain.from_iterable(
                self.life.pieces() for _ in iter(int, 1)))

    def _start_anew(self) -> None:
        self.robot.process.process.kill()
        self.robot.process.process.wait()
        self.robot.stop_flowing()
        self.robot.start()

    def _begin_epoch(self) -> None:
        self.robot.wait_quiet()
        self._from, self._sent = int(self.robot.values['received']), self.robot.sent

    def _end_epoch(self) -> None:
        """Compare what was sent and received, and the pose with the truth."""
        robot = self.robot
        robot.wait_quiet()
        for event in itertools.islice(self._events, 5):
            robot.say(event)    # a pose by an estimate that has all
        robot.wait_quiet()
        received, sent = int(robot.values['received']) - self._from, robot.sent - self._sent
        self.received, self.lost = self.received + received, self.lost + sent - received
        self._from, self._sent = self._from + received, robot.sent
        if robot.newest is not None and robot.values.get('alignment') == 'aligned':
            x, y = self.life.truth_at(np.array([stamp_ns(robot.newest)]))[0, :2]
            where = robot.newest.pose.pose.position
            self.errors.append(math.hypot(where.x - x, where.y - y))
            if self.errors[-1] > FAR:
                told = {name: robot.values.get(name, '') for name in (
                    'hidden_nodes', 'alignment_sigma_deg', 'fix.accepted', 'fix.doubted')}
                without = (stamp_ns(robot.newest) - robot.fixed_ns) / 1_000_000_000
                sigma = math.sqrt(robot.newest.pose.covariance[0])
                self.far.append(f'{self.errors[-1]:.1f} m (sigma {sigma:.1f} m), {sent} messages '
                                f'after {self._last}, {without:.0f} s after a fix, {told}')
        robot.stop_flowing()

    # ---- disturbances

    def reset(self) -> None:
        """Start a new graph."""
        before = int(self.robot.values['resets'])
        self.robot.call(Trigger, 'reset', Trigger.Request())
        self.robot.wait(lambda: int(self.robot.values['resets']) > before, 'a new graph')

    def _change_state(self, *transitions: int) -> None:
        for transition in transitions:
            request = ChangeState.Request(transition=Transition(id=transition))
            if not self.robot.call(ChangeState, 'change_state', request).success:
                raise TimeoutError(f'transition {transition} succeeds')
        self.robot.values = {}
        self.robot.wait_ready()

    def deactivate(self) -> None:
        """Deactivate and activate the node."""
        self._change_state(Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_ACTIVATE)

    def clean_up(self) -> None:
        """Deactivate, clean up, configure and activate the node."""
        self._change_state(Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP,
                           Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE)

    def change(self) -> None:
        """Change a parameter."""
        name = self._draw.choice([*CHANGES])
        wanted = Parameter(name, value=CHANGES[name](self._draw)).to_parameter_msg()
        result, = self.robot.call(
            SetParameters, 'set_parameters', SetParameters.Request(parameters=[wanted])).results
        if not result.successful:
            self.refused += 1
            self.stuck.append(f'{name}: {result.reason}')

    def again(self) -> None:
        """Begin the drive again, with publishers of its own, as a bag that is played again."""
        before = int(self.robot.values['resets'])
        self.robot.connect()
        self.robot.wait_ready()
        self._restart()
        for _ in range(200):
            self.robot.say(next(self._events))
            if int(self.robot.values['resets']) > before:
                break
        self.robot.wait(lambda: int(self.robot.values['resets']) > before, 'time begins again')

    def kill(self) -> None:
        """Kill the node, and start it again with its journal."""
        robot, now = self.robot, time.monotonic()
        before = [nodes for at, nodes in robot.known if at < now - LOSS_WINDOW]
        self._start_anew()
        robot.wait(lambda: 'hidden_nodes' in robot.values or not before[-1:] or before[-1] == 0,
                   'the map is there')
        after = int(robot.values.get('hidden_nodes', 0))
        self.missing += max((before or [0])[-1] - after, 0)

    def damage(self) -> None:
        """Send malformed messages."""
        stamp = 0 if self.robot.newest is None else stamp_ns(self.robot.newest)
        for _ in range(500):
            self.robot.send(*malformed(self._draw, stamp))
            time.sleep(0.0005)
        self.robot.wait_quiet()
        self._end_epoch()

    def minute(self) -> Minute:
        """Return what happened so far."""
        robot, latencies, errors = self.robot, self.robot.latencies, self.errors
        robot.latencies, self.errors, self._told = [], [], time.monotonic()
        ms = 1e3 * np.percentile(latencies or [math.nan], (50, 99, 100))
        lines = [line for log in robot.logs for line in log.read_text('utf-8').splitlines()]
        return Minute(
            (self._told - self.begin) / 60.0, robot.process.memory()['VmRSS'],
            (self._told - robot.began) / 60.0, robot.sent, self.received, self.lost, robot.poses,
            robot.unanswered, *ms.tolist(), len(lines),
            sum('[ERROR]' in line or 'Traceback' in line for line in lines), self.crashes,
            self.stuck[-20:], dict(self.actions), self.refused, self.missing,
            float(np.median(errors or [math.nan])), max(errors, default=math.nan),
            self.far[-20:],
            int(robot.values.get('hidden_nodes', 0)), float(robot.values.get(
                'journal.size_mb', 'nan')), float(robot.values.get('journal.lag_max_s', 'nan')))


def run(minutes: float, folder: Path, seed: int = 0) -> Iterator[Minute]:
    """Run the node for a time; logs and journal are in a folder."""
    with isolated_environment(folder) as environment:
        robot = Robot(environment, folder)
        try:
            yield from Soak(robot, seed).run(60.0 * minutes)
        finally:
            robot.close()
