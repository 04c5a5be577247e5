# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A robot over DDS: it sends what sensors say, or what they must not say, and hears the node."""

from collections import deque
from collections.abc import Callable
from contextlib import suppress
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
from nav_msgs.msg import Odometry
import numpy as np
import rclpy
from rclpy.context import Context
from sensor_msgs.msg import NavSatFix

from benchmark.feeder import QOS
from benchmark.load import NODE, Process
from benchmark.soak.life import Event
from pose_graph_ros.adapters.conversions import stamp_ns
from pose_graph_ros.adapters.output_cdr import odometry_cdr
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
