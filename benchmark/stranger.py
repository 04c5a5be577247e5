# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A peer that nobody asked for: sends so many messages or calls of a kind as it is told on its input.

    python -m benchmark.stranger    # then lines such as `fix 10000 5.0 1700000000`

Each is another one, as far as that kind has texts or numbers of its own: frames, beacons, ids.
"""

from collections.abc import Callable
from contextlib import suppress
import sys
import threading
import time
from typing import Any

from diagnostic_msgs.msg import KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.srv import SetParameters
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSDurabilityPolicy, QoSProfile
from sensor_msgs.msg import Imu, NavSatFix, Range
from std_srvs.srv import SetBool, Trigger
from tf2_msgs.msg import TFMessage

NODE = 'pose_graph'
LATCHED = QoSProfile(depth=100, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
Fill = Callable[[Any, int], None]


def _odometry(message: Odometry, k: int) -> None:
    message.pose.pose.orientation.w = 0.0   # it would contradict that of the drive
    message.header.frame_id, message.child_frame_id = f'odom_{k}x', f'base_{k}x'


def _framed(message: Any, k: int) -> None:
    message.header.frame_id = f'frame_{k}x'


def _pose(message: PoseWithCovarianceStamped, k: int) -> None:
    message.header.frame_id = 'map'
    message.pose.pose.position.x, message.pose.pose.orientation.w = float(k % 100), 1.0


def _fix(message: NavSatFix, k: int) -> None:
    _framed(message, k)
    message.status.status, message.position_covariance_type = 0, 2
    message.latitude, message.longitude = 48.0, 11.0
    message.position_covariance[0] = message.position_covariance[4] = 1e4


def _imu(message: Imu, k: int) -> None:
    _framed(message, k)
    message.orientation.w, message.orientation_covariance[8] = 1.0, 1e-2


def _closure(message: PoseWithCovarianceStamped, k: int) -> None:
    _pose(message, k)
    message.header.frame_id = f'x{k}' if k % 2 else f'place_{k}x'
    for place in (0, 7, 35):
        message.pose.covariance[place] = 0.01


def _range(message: Range, k: int) -> None:
    message.header.frame_id = f'beacon_{k}x'
    message.range, message.max_range = 5.0, 100.0


def _transform(message: TFMessage, k: int) -> None:
    item = TransformStamped(child_frame_id=f'child_{k}x')
    item.header.frame_id, item.transform.rotation.w = 'base_link', 1.0
    message.transforms = [item]


def _decision(message: KeyValue, k: int) -> None:
    message.key, message.value = f'loop_closure/{k}', ('in', 'out', 'auto', f'text {k}x')[k % 4]


def _pause(request: SetBool.Request, _: int) -> None:
    request.data = False


def _parameters(request: SetParameters.Request, k: int) -> None:
    value = Parameter('path_period', value=1.0 + 1e-3 * (k % 100)) if k % 2 else Parameter(
        f'unknown_{k}x', value=f'text {k}x')
    request.parameters = [value.to_parameter_msg()]


TOPICS: dict[str, tuple[type, str, Fill]] = {
    'odom': (Odometry, 'odom', _odometry),
    'global_pose': (PoseWithCovarianceStamped, 'global_pose', _framed),
    'fix': (NavSatFix, 'gps/fix', _fix), 'imu': (Imu, 'imu/data', _imu),
    'range': (Range, 'range', _range),
    'loop_closure': (PoseWithCovarianceStamped, 'loop_closure', _closure),
    'initialpose': (PoseWithCovarianceStamped, 'initialpose', _framed),
    'set_pose': (PoseWithCovarianceStamped, 'set_pose', _pose),
    'judge': (KeyValue, f'{NODE}/judge', _decision), 'tf_static': (TFMessage, '/tf_static',
                                                                   _transform)}
SERVICES: dict[str, tuple[type, Fill]] = {
    'set_parameters': (SetParameters, _parameters), 'pause': (SetBool, _pause),
    **{name: (Trigger, lambda *_: None)
       for name in ('save_graph', 'optimize', 'set_datum', 'load_graph', 'reset')}}
"""Those that begin another graph come last."""
KINDS = *TOPICS, *SERVICES


class Stranger:
    """Has a publisher or a client for each kind, from the start."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publishers = {kind: node.create_publisher(
            message_type, topic, LATCHED if kind == 'tf_static' else QoSProfile(depth=1000))
            for kind, (message_type, topic, _) in TOPICS.items()}
        self._clients = {kind: node.create_client(service_type, f'{NODE}/{kind}')
                         for kind, (service_type, _) in SERVICES.items()}
        self.n_answered = 0

    def ready(self) -> bool:
        """Tell whether the node under test hears all of it."""
        return all(each.get_subscription_count() > 0 for each in self._publishers.values()) and (
            all(each.service_is_ready() for each in self._clients.values()))

    def send(self, kind: str, count: int, seconds: float, stamp: float) -> None:
        """Send a burst of a kind, spread over a time, with stamps around one [s]."""
        self.n_answered, begin = 0, time.monotonic()
        for k in range(count):
            time.sleep(max(begin + seconds * k / count - time.monotonic(), 0.0))
            if kind in SERVICES:
                service_type, fill = SERVICES[kind]
                request = service_type.Request()
                fill(request, k)
                self._clients[kind].call_async(request).add_done_callback(self._count)
            else:
                message_type, _, fill = TOPICS[kind]
                message = message_type()
                if hasattr(message, 'header'):
                    whole, rest = divmod(round(1e9 * stamp) + k * 1000, 1_000_000_000)
                    message.header.stamp.sec, message.header.stamp.nanosec = whole, rest
                fill(message, k)
                self._publishers[kind].publish(message)

    def _count(self, _: Any) -> None:
        self.n_answered += 1


def main() -> None:
    """Do what the lines of the input say; tell of each when it is done."""
    rclpy.init()
    node = rclpy.create_node('stranger')
    stranger = Stranger(node)
    threading.Thread(target=_spin, args=(node,), daemon=True).start()
    while not stranger.ready():
        time.sleep(0.05)
    print('ready', flush=True)
    for line in sys.stdin:
        kind, count, seconds, stamp = line.split()
        stranger.send(kind, int(count), float(seconds), float(stamp))
        print(stranger.n_answered, flush=True)
    rclpy.try_shutdown()


def _spin(node: Node) -> None:
    with suppress(ExternalShutdownException):
        rclpy.spin(node)


if __name__ == '__main__':
    main()
