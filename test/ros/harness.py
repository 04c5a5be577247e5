# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A real node in a process of its own, and an independent client that talks to it over DDS."""

from collections.abc import Callable, Mapping, Sequence
import math
from pathlib import Path
import signal
import subprocess
import sys
import time

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not there: no rclpy')

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry, Path as PathMessage
from rcl_interfaces.srv import SetParameters
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter as RosParameter
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import Imu, NavSatFix
from std_srvs.srv import Trigger

from pose_graph_ros.cli.demo import isolated_environment

try:
    from tf2_msgs.msg import TFMessage
except ImportError:
    TFMessage = None

RELIABLE = QoSProfile(depth=1000, reliability=QoSReliabilityPolicy.RELIABLE)
LATCHED = QoSProfile(depth=1, reliability=QoSReliabilityPolicy.RELIABLE,
                     durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
NANOSECONDS = 1_000_000_000
PATIENCE = 20.0
"""How long a test waits for something that should come at once [s]."""
PREPARE_PATIENCE = 300.0
"""How long it waits for a node that may have to compile its kernels first [s]."""


class NodeProcess:
    """The node as a user starts it."""

    def __init__(
        self, log: Path, arguments: Sequence[str] = (), domain: int | None = None,
        program: Sequence[str] = ('-m', 'pose_graph_ros.ros.main'),
    ) -> None:
        self.env = isolated_environment(log)
        if domain is not None:
            self.env['ROS_DOMAIN_ID'] = str(domain)
        self._stderr = (log / 'stderr').open('w+')
        self.process = subprocess.Popen(
            [sys.executable, *program, '--ros-args',
             '-p', 'diagnostics_period:=0.1', '-p', 'frequency:=10.0', '-p', 'path_period:=0.1',
             *arguments],
            env=self.env, stderr=self._stderr)

    def stderr(self) -> str:
        self._stderr.seek(0)
        return self._stderr.read()

    def signal_and_wait(self, *signals: signal.Signals) -> int:
        for number in signals:
            self.process.send_signal(number)
        return self.process.wait(PATIENCE)

    def __enter__(self) -> 'NodeProcess':
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        self._stderr.close()


class Client:
    """Publishes what sensors would, and keeps everything that the node publishes."""

    def __init__(
        self, domain: int, namespace: str = '', odom: str = 'odom', *, name: str = 'pose_graph',
        listens: Sequence[str] = ('odom', 'global_pose', 'fix', 'loop_closure'),
        more: Mapping[str, type] | None = None,
    ) -> None:
        self._listens, self._name = listens, name
        self._status = f'/{namespace}/{name}: pose graph'.replace('//', '/')
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain)
        self.node = rclpy.create_node('client', context=self._context, namespace=namespace)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        create = self.node.create_publisher
        self.odom = create(Odometry, odom, RELIABLE)
        self.global_pose = create(PoseWithCovarianceStamped, 'global_pose', RELIABLE)
        self.fix = create(NavSatFix, 'gps/fix', RELIABLE)
        self.loop_closure = create(PoseWithCovarianceStamped, 'loop_closure', RELIABLE)
        self.more = {topic: create(kind, topic, RELIABLE) for topic, kind in (more or {}).items()}
        """Publishers on further topics, which the node listens to as well."""
        self.poses: list[PoseWithCovarianceStamped] = []
        self.filtered: list[Odometry] = []
        self.fixes: list[NavSatFix] = []
        self.paths: list[PathMessage] = []
        self.transforms: list[object] = []
        self.diagnostics: list[DiagnosticArray] = []
        subscribe = self.node.create_subscription
        subscribe(PoseWithCovarianceStamped, 'pose', self.poses.append, RELIABLE)
        subscribe(Odometry, 'odometry/filtered', self.filtered.append, RELIABLE)
        subscribe(NavSatFix, 'gps/filtered', self.fixes.append, RELIABLE)
        subscribe(PathMessage, 'path', self.paths.append, LATCHED)
        subscribe(DiagnosticArray, '/diagnostics', self._diagnose, RELIABLE)
        if TFMessage is not None:
            subscribe(TFMessage, '/tf', lambda message: self.transforms.extend(message.transforms),
                      RELIABLE)
        self._optimize = self.node.create_client(Trigger, f'{name}/optimize')
        self._services = {'optimize': self._optimize}
        self._matched: list[object] = []

    def __enter__(self) -> 'Client':
        self.wait_for_the_node()
        return self

    def wait_for_the_node(self) -> None:
        """Wait until an active node listens and has compiled."""
        inputs = (*(getattr(self, name) for name in self._listens), *self.more.values())
        self.spin_until(lambda: all(p.get_subscription_count() > 0 for p in inputs)
                        and len(self.diagnostics) > 0 and self._optimize.service_is_ready(),
                        'the node listens')
        self.spin_until(lambda: self.values['prepared'] == '1', 'the node has compiled',
                        PREPARE_PATIENCE)
        # the other side may know of the match a little later
        self.spin_for(0.3)

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    def spin_until(
        self, done: Callable[[], bool], what: str, patience: float = PATIENCE,
    ) -> None:
        end = time.monotonic() + patience
        while not done():
            assert time.monotonic() < end, f'waited {patience} s until {what}'
            self._executor.spin_once(timeout_sec=0.05)

    def spin_for(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=left)

    def _diagnose(self, message: DiagnosticArray) -> None:
        if message.status[0].name == self._status:
            self.diagnostics.append(message)

    @property
    def values(self) -> dict[str, str]:
        return {item.key: item.value for item in self.diagnostics[-1].status[0].values}

    def wait_processed(self, count: int) -> None:
        self.spin_until(lambda: int(self.values['processed']) >= count,
                        f'{count} messages are processed')

    def call(self, service: object, request: object) -> object:
        """Call a service and return its answer."""
        self.spin_until(service.service_is_ready, 'the service is there')
        if service not in self._matched:
            # an answer is lost if the other side does not know yet where to send it
            self.spin_for(0.3)
            self._matched.append(service)
        future = service.call_async(request)
        self.spin_until(future.done, 'the service answers')
        return future.result()

    def trigger(self, name: str) -> Trigger.Response:
        """Call a service of the node that needs nothing but the call."""
        return self.call(self._service(Trigger, name), Trigger.Request())

    def set_parameter(self, name: str, value: object) -> tuple[bool, str]:
        """Set a parameter as `ros2 param set` does; return whether it was, or why not."""
        return self.set_parameters({name: value})[0]

    def set_parameters(self, values: Mapping[str, object]) -> list[tuple[bool, str]]:
        service = self._service(SetParameters, 'set_parameters')
        wanted = [RosParameter(name, value=value).to_parameter_msg()
                  for name, value in values.items()]
        results = self.call(service, SetParameters.Request(parameters=wanted)).results
        return [(result.successful, result.reason) for result in results]

    def _service(self, kind: type, name: str) -> object:
        if name not in self._services:
            self._services[name] = self.node.create_client(kind, f'{self._name}/{name}')
        return self._services[name]

    def begin_anew(self) -> None:
        """Have the node begin a new graph, and forget what it has published."""
        before = int(self.values['resets'])
        assert self.trigger('reset').success
        self.spin_until(lambda: int(self.values['resets']) > before, 'it begins anew')
        for kept in (self.poses, self.filtered, self.fixes, self.paths, self.transforms):
            kept.clear()

    def set_datum(self) -> Trigger.Response:
        return self.trigger('set_datum')

    def optimize(self) -> Trigger.Response:
        """Have the node optimise; return when its outputs after that have come."""
        response = self.trigger('optimize')
        # one may have been on its way
        count = len(self.diagnostics) + 2
        self.spin_until(lambda: len(self.diagnostics) >= count,
                        'diagnostics come that were made after the answer')
        if response.success:
            self.spin_until(lambda: len(self.paths) > 0 and len(self.paths[-1].poses)
                            == int(self.values['hidden_nodes']) + 1, 'the whole path comes')
        return response


def stamp_ns(message: object) -> int:
    stamp = message.header.stamp
    return stamp.sec * NANOSECONDS + stamp.nanosec


def yaw(quaternion: object) -> float:
    return 2.0 * math.atan2(quaternion.z, quaternion.w)


def odometry(seconds: float, x: float, y: float, theta: float, speed: float = 1.0) -> Odometry:
    message = Odometry()
    message.header.stamp.sec, nanosec = divmod(round(seconds * NANOSECONDS), NANOSECONDS)
    message.header.stamp.nanosec = nanosec
    message.header.frame_id, message.child_frame_id = 'odom', 'base_link'
    message.pose.pose.position.x, message.pose.pose.position.y = x, y
    message.pose.pose.orientation.z = math.sin(theta / 2.0)
    message.pose.pose.orientation.w = math.cos(theta / 2.0)
    message.twist.twist.linear.x = speed
    return message


def pose(
    seconds: float, x: float, y: float, theta: float, frame: str = 'map', *,
    variances: Sequence[float] = (0.01, 0.01, 0.001),
) -> PoseWithCovarianceStamped:
    message = PoseWithCovarianceStamped()
    message.header = odometry(seconds, 0.0, 0.0, 0.0).header
    message.header.frame_id = frame
    message.pose.pose = odometry(seconds, x, y, theta).pose.pose
    for index, variance in zip((0, 7, 35), variances, strict=True):
        message.pose.covariance[index] = variance
    return message


def fix(seconds: float, latitude: float, longitude: float, sigma: float = 0.5) -> NavSatFix:
    message = NavSatFix()
    message.header = odometry(seconds, 0.0, 0.0, 0.0).header
    message.header.frame_id = 'gps'
    message.status.status = 0
    message.latitude, message.longitude, message.altitude = latitude, longitude, 100.0
    message.position_covariance_type = 2
    message.position_covariance = [sigma * sigma, 0.0, 0.0, 0.0, sigma * sigma, 0.0, 0.0, 0.0, 4.0]
    return message


def imu(seconds: float, heading: float, variance: float = 1e-4) -> Imu:
    message = Imu()
    message.header = odometry(seconds, 0.0, 0.0, 0.0).header
    message.orientation = odometry(seconds, 0.0, 0.0, heading).pose.pose.orientation
    message.orientation_covariance = [variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, variance]
    return message
