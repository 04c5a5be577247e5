# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A real node in a process of its own, and an independent client that talks to it over DDS."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
import math
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import time

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not there: no rclpy')

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from lifecycle_msgs.srv import GetState
from nav_msgs.msg import Odometry, Path as PathMessage
from prepared_node import PreparedNode
from rcl_interfaces.srv import SetParameters
import rclpy
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter as RosParameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import Imu, NavSatFix
from std_srvs.srv import Trigger

from pose_graph_ros import core as core_package
from pose_graph_ros.cli.demo import isolated_environment
from pose_graph_ros.core.compiled import kernel_cache

try:
    from tf2_msgs.msg import TFMessage
except ImportError:
    TFMessage = None

RELIABLE = QoSProfile(depth=1000, reliability=QoSReliabilityPolicy.RELIABLE)
LATCHED = QoSProfile(depth=1, reliability=QoSReliabilityPolicy.RELIABLE,
                     durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
NANOSECONDS = 1_000_000_000
PATIENCE = 60.0
"""How long a test waits for something that comes at once, but for a busy machine [s]."""
PREPARE_PATIENCE = 300.0
"""How long it waits for a node that may have to compile its kernels first [s]."""
AS_A_USER = ('-m', 'pose_graph_ros.ros.main')
"""How Python starts a node from nothing."""


def copy_kernels(folder: Path, *, without: str) -> None:
    """
    Fill a folder for NUMBA_CACHE_DIR with the compiled kernels, but for those of one package.

    A node that starts with it compiles the rest, as at a first start, in a fraction of the time.
    """
    core = Path(core_package.__path__[0])
    for source in (core, *(each for each in core.iterdir() if each.is_dir())):
        cache = kernel_cache.find_folders(source)[0]
        if source.name in (without, '__pycache__') or cache is None:
            continue
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(kernel_cache.numba.config, 'CACHE_DIR', str(folder))
            target = next(kernel_cache._candidates(source))
        target.mkdir(parents=True)
        for file in cache.glob('*.nb*'):
            shutil.copy(file, target)


class NodeProcess:
    """
    A node in a process of its own.

    Parameters
    ----------
    log : path, folder for its logs
    arguments : sequence of str, further arguments of ROS
    domain : int, optional, of ROS; by default a free one
    program : sequence of str, optional
        What Python runs, such as AS_A_USER; by default the process comes from one that has done
        the slow part of a start.

    """

    def __init__(
        self, log: Path, arguments: Sequence[str] = (), domain: int | None = None,
        program: Sequence[str] = (),
    ) -> None:
        self._stack = ExitStack()
        self.env = self._stack.enter_context(isolated_environment(log))
        if domain is not None:
            self.env['ROS_DOMAIN_ID'] = str(domain)
        self._stderr = (log / 'stderr').open('w+')
        arguments = ['--ros-args', '-p', 'diagnostics_period:=0.1', '-p', 'frequency:=10.0',
                     '-p', 'path_period:=0.1', '-p', f'file_folder:={log.parent}', *arguments]
        self.process = (
            subprocess.Popen([sys.executable, *program, *arguments], env=self.env,
                             stderr=self._stderr) if program
            else PreparedNode(arguments, self.env, log / 'stderr'))

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
        self._stack.close()


class Client:
    """Publishes what sensors would, and keeps everything that the node publishes."""

    def __init__(
        self, domain: int, namespace: str = '', odom: str = 'odom', *, name: str = 'pose_graph',
    ) -> None:
        self.domain, self._name = domain, name
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
        self.poses: list[PoseWithCovarianceStamped] = []
        self.filtered: list[Odometry] = []
        self.fixes: list[NavSatFix] = []
        self.paths: list[PathMessage] = []
        self.transforms: list[object] = []
        self.diagnostics: list[DiagnosticArray] = []
        self._sent_ns = 0   # when the newest of them was sent
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
        """Wait until the node is active, matched, and has compiled its kernels."""
        inputs = (self.odom, self.global_pose, self.fix, self.loop_closure)
        self.spin_until(lambda: all(p.get_subscription_count() > 0 for p in inputs)
                        and len(self.diagnostics) > 0 and self._optimize.service_is_ready(),
                        'the node listens')
        self.wait_prepared()
        self.wait_matched()

    def wait_prepared(self) -> None:
        """Wait for diagnostics of a node that has compiled its kernels, or loaded them."""
        self.spin_until(lambda: len(self.diagnostics) > 0 and self.values['prepared'] == '1',
                        'the node has compiled', PREPARE_PATIENCE)

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

    def _diagnose(self, message: DiagnosticArray, info: Mapping[str, int]) -> None:
        if message.status[0].name == self._status:
            self.diagnostics.append(message)
            self._sent_ns = info['source_timestamp']

    @property
    def values(self) -> dict[str, str]:
        return {item.key: item.value for item in self.diagnostics[-1].status[0].values}

    def wait_values(self, wanted: Mapping[str, str]) -> None:
        """Wait for diagnostics with some values, which may come later than what they tell of."""
        try:
            self.spin_until(
                lambda: len(self.diagnostics) > 0 and wanted.items() <= self.values.items(),
                f'the diagnostics have {wanted}')
        except AssertionError as error:
            age = 1e-9 * (time.time_ns() - self._sent_ns)
            error.add_note(f'the newest, {age:.1f} s ago: {self.values if age < 1e9 else "none"}')
            raise

    def wait_processed(self, count: int) -> None:
        self.spin_until(lambda: int(self.values['processed']) >= count,
                        f'{count} messages are processed')

    def wait_current(self) -> None:
        """Wait for diagnostics that were sent after all that has come so far."""
        now = time.time_ns()
        self.spin_until(lambda: self._sent_ns > now, 'newer diagnostics come')

    def wait_received(self, publisher: Publisher) -> None:
        """Wait until the node has what was published: before what is published from now on."""
        assert publisher.wait_for_all_acked(Duration(seconds=PATIENCE))

    def wait_answered(self, seconds: float) -> None:
        """Wait until pose, odometry and transform at the stamp of an odometry [s] have come."""
        last = round(seconds * NANOSECONDS)
        outputs = (self.poses, self.filtered, self.transforms)
        for messages in outputs[:2 if TFMessage is None else 3]:
            self.spin_until(lambda sent=messages: len(sent) > 0 and stamp_ns(sent[-1]) >= last,
                            f'the outputs at {seconds} s come')

    def call(self, service: object, request: object) -> object:
        """Call a service and return its answer."""
        self.spin_until(service.service_is_ready, 'the service is there')
        if service not in self._matched:
            self.wait_matched()
            self._matched.append(service)
        future = service.call_async(request)
        self.spin_until(future.done, 'the service answers')
        return future.result()

    def wait_matched(self) -> None:
        """
        Wait until the node knows all publishers, subscribers and clients created before.

        An answer is lost if the node does not know yet where to send it. Endpoints are announced
        in order, so a node that answers a newer client knows the older ones.
        """
        newest = self.node.create_client(GetState, f'{self._name}/get_state')
        self.spin_until(newest.service_is_ready, 'the node is there')
        end = time.monotonic() + PATIENCE
        while True:
            future = newest.call_async(GetState.Request())
            self._executor.spin_until_future_complete(future, timeout_sec=0.5)
            if future.done():
                break
            newest.remove_pending_request(future)
            assert time.monotonic() < end, f'waited {PATIENCE} s until the node answers'
        self.node.destroy_client(newest)

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

    def start_new_graph(self) -> None:
        """Make the node start a new graph, without messages that were sent before."""
        self.spin_until(self._is_idle, 'the node has received all that was sent')
        before = int(self.values['resets'])
        assert self.trigger('reset').success
        self.spin_until(lambda: int(self.values['resets']) > before, 'a new graph is started')
        for kept in (self.poses, self.filtered, self.fixes, self.paths, self.transforms):
            kept.clear()

    def _is_idle(self) -> bool:
        """Whether nothing was received and nothing waits in the newest three diagnostics."""
        received = [{item.key: item.value for item in message.status[0].values}['received']
                    for message in self.diagnostics[-3:]]
        return len(received) == 3 and len(set(received)) == 1

    def _has_whole_path(self) -> bool:
        if len(self.paths) == 0:
            return False
        poses, n_nodes = self.paths[-1].poses, int(self.values['hidden_nodes'])
        if len(poses) == n_nodes:
            # the newest odometry is at the newest node, and not a pose of its own
            return len(self.poses) > 0 and stamp_ns(poses[-1]) >= stamp_ns(self.poses[-1])
        return len(poses) == n_nodes + 1

    def optimize(self) -> Trigger.Response:
        """Have the node optimise; return when its outputs after that have come."""
        response = self.trigger('optimize')
        self.wait_current()
        if response.success:
            self.spin_until(self._has_whole_path, 'the whole path comes')
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


def transform(
    parent: str, child: str, place: Sequence[float] = (0, 0, 0),
    q: Sequence[float] = (0, 0, 0, 1), seconds: float = 0.0,
) -> TransformStamped:
    message = TransformStamped(child_frame_id=child)
    message.header = odometry(seconds, 0.0, 0.0, 0.0).header
    message.header.frame_id = parent
    translation, rotation = message.transform.translation, message.transform.rotation
    translation.x, translation.y, translation.z = map(float, place)
    rotation.x, rotation.y, rotation.z, rotation.w = map(float, q)
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
