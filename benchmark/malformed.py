# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A flood of malformed messages over DDS on all inputs of the real node, and a clean drive after it.

The node has a source of every kind. Sent are, as bytes, in turn on all its topics: noise, real
messages that are cut off, and real ones in which fields are replaced by what they must not be:
numbers that are NaN, infinite or too large, stamps of other times, empty texts and
texts of a megabyte, covariances that are none, quaternions that are none; poses to be set, which
are orders, have no position in any case. After every 400 a
service of the same thread is asked, so that none is lost in a queue but on topics of which the
node keeps the newest only. The drive after it has exact odometry and fixes; its path is compared
with the truth.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
import math
import random
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, KeyValue
from geometry_msgs.msg import (
    PoseWithCovarianceStamped,
    TransformStamped,
    TwistWithCovarianceStamped,
)
from lifecycle_msgs.srv import GetState
from nav_msgs.msg import Odometry, Path as PathMessage
import numpy as np
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSDurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Imu, NavSatFix, Range
from std_srvs.srv import Trigger

from benchmark.load import NODE, Process, started
from benchmark.section import about, Options, say, Section
from pose_graph_ros.adapters.parameters import checked
from pose_graph_ros.adapters.sources import KINDS, KNOWN_SOURCES, source_list
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.geodesy import TangentPlane
from pose_graph_ros.ros.topics import INPUTS, message_class, STATIC_TOPIC

TITLE = 'Malformed messages'
COUNT = 1_000_000
BURST = 400
STEP = 0.002
"""Time of the drive between two messages [s]."""
GAP, DRIVE = 600.0, 120.0
"""Between the stamps of malformed messages and of the clean drive, and the drive's length [s]."""
ERROR = 0.5
"""Asked of the path of the clean drive [m]."""
LARGE = 2000
"""One message of so many has a text of a megabyte."""
START = 1_700_000_000.0
SECOND = 1_000_000_000
PATIENCE = 120.0
PLANE = TangentPlane(48.1, 11.6, 100.0)
VALUES: dict[str, Any] = {
    'sources': [*(name for name in KNOWN_SOURCES if name != 'loop_closure'),
                *(name for name in KINDS if name not in {
                    kind.name for kind, _ in KNOWN_SOURCES.values()})],
    'twist.type': 'twist', 'range.type': 'range', 'gyro.mounting': 'up', 'datum': [48.1, 11.6]}
"""Parameters of a node with a source of each kind."""
PARAMETERS = (*(f'{name}:={str(value).replace(chr(39), "")}' for name, value in VALUES.items()),
              'diagnostics_period:=0.2', 'path_period:=0.5')

NONE = math.nan, math.inf, -math.inf, 1.7976931348623157e308, -1e200
"""What no coordinate can be; other numbers make wrong measurements, as `benchmark.belief` has."""
NUMBERS = (math.nan, math.inf, -math.inf, 1.7976931348623157e308, -1e200, 1e9, 1e6, -1.0, -1e-300,
           0.0)
SMALL_NUMBERS = (math.nan, math.inf, -math.inf, 3e38, -3e38, -1.0)
WHOLE = {'int8': (-128, 127), 'uint8': (0, 255), 'uint16': (0, 2**16 - 1),
         'int32': (-2**31, 2**31 - 1), 'uint32': (0, 2**32 - 1)}
"""Smallest and largest value of types of fields."""
TEXTS = ('', 'elsewhere', '/', '@', '@nan', '@-1.0', '@9999999999999999.0', 'x-1', 'x' + '9' * 30,
         'a' * 5000, 'Größe 地図', '%s%n\\', '../../etc', 'fix/' + '1' * 4000, 'auto')


def true_pose(seconds: float) -> np.ndarray:
    """Return where the robot is: on a circle of 20 m, at 2 m/s, in the map."""
    angle = seconds / 10.0
    return np.array([20.0 * math.sin(angle), 20.0 * (1.0 - math.cos(angle)), angle])


# --- messages as they should be

def _stamped(message: Any, seconds: float, frame: str) -> Any:
    stamp_ns = round((START + seconds) * SECOND)
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, SECOND)
    message.header.frame_id = frame
    return message


def _place(holder: Any, pose: np.ndarray) -> None:
    holder.position.x, holder.position.y = pose[:2].tolist()
    holder.orientation.z, holder.orientation.w = math.sin(pose[2] / 2), math.cos(pose[2] / 2)


def odometry(seconds: float) -> Odometry:
    """Return exact odometry, in another frame than the map."""
    message = _stamped(Odometry(child_frame_id='base_link'), seconds, 'odom')
    _place(message.pose.pose, se2.compose(np.array([5.0, -3.0, -2.1]), true_pose(seconds)))
    message.twist.twist.linear.x, message.twist.twist.angular.z = 2.0, 0.1
    return message


def fix(seconds: float) -> NavSatFix:
    """Return an exact fix."""
    message = _stamped(NavSatFix(position_covariance_type=2), seconds, 'gps')
    message.status.status = 0
    message.position_covariance = np.diag((0.25, 0.25, 4.0)).ravel()
    message.latitude, message.longitude, message.altitude = map(
        float, PLANE.to_geodetic(true_pose(seconds)[:2], PLANE.altitude))
    return message


def _pose(seconds: float, pose: np.ndarray, frame: str) -> PoseWithCovarianceStamped:
    message = _stamped(PoseWithCovarianceStamped(), seconds, frame)
    _place(message.pose.pose, pose)
    message.pose.covariance[[0, 7, 35]] = 0.01, 0.01, 0.001
    return message


def _global_pose(seconds: float) -> PoseWithCovarianceStamped:
    return _pose(seconds, true_pose(seconds), 'map')


def _loop_closure(seconds: float) -> PoseWithCovarianceStamped:
    before = 0.5 * seconds
    return _pose(seconds, se2.between(true_pose(before), true_pose(seconds)),
                 f'@{START + before:.9f}')


def _imu(seconds: float) -> Imu:
    message = _stamped(Imu(), seconds, 'imu')
    angle = true_pose(seconds)[2]
    message.orientation.z, message.orientation.w = math.sin(angle / 2), math.cos(angle / 2)
    message.orientation_covariance[[0, 4, 8]] = 1e-4
    message.angular_velocity.z = 0.1
    return message


def _twist(seconds: float) -> TwistWithCovarianceStamped:
    message = _stamped(TwistWithCovarianceStamped(), seconds, 'base_link')
    message.twist.twist.linear.x, message.twist.twist.angular.z = 2.0, 0.1
    return message


def _range(seconds: float) -> Range:
    x, y, _ = true_pose(seconds).tolist()
    return _stamped(Range(range=math.hypot(x - 12.0, y + 3.0), max_range=100.0), seconds, 'anchor')


def _decision(seconds: float) -> KeyValue:
    return KeyValue(key=f'fix/{round(seconds)}', value='auto')


def _transforms(seconds: float) -> Any:
    transform = _stamped(TransformStamped(child_frame_id='gps'), seconds, 'base_link')
    return message_class(INPUTS[STATIC_TOPIC][0])(transforms=[transform])


BY_TYPE: dict[str, Callable[[float], Any]] = {
    'nav_msgs/msg/Odometry': odometry, 'sensor_msgs/msg/NavSatFix': fix,
    'geometry_msgs/msg/PoseWithCovarianceStamped': _global_pose, 'sensor_msgs/msg/Imu': _imu,
    'geometry_msgs/msg/TwistWithCovarianceStamped': _twist, 'sensor_msgs/msg/Range': _range,
    'diagnostic_msgs/msg/KeyValue': _decision, 'tf2_msgs/msg/TFMessage': _transforms}
"""What makes a message as it should be, of a time of the drive [s]."""


def inputs() -> dict[str, tuple[str, Callable[[float], Any]]]:
    """Return type and maker of messages of each topic that the node reads."""
    kinds = {topic.replace('~', 'pose_graph'): kind for topic, (kind, _) in INPUTS.items()}
    kinds |= {source.topic: source.kind.message_type for source in source_list(checked(VALUES))}
    others = {'loop_closure': _loop_closure, 'initialpose': _order, 'set_pose': _order}
    return {topic: (kind, others.get(topic) or BY_TYPE[kind]) for topic, kind in kinds.items()}


# --- messages as they should not be

def _leaves(message: Any) -> Iterator[tuple[Any, str, str]]:
    """Yield the fields that are no messages: what has it, its name and its type."""
    for name, kind in message.get_fields_and_field_types().items():
        value = getattr(message, name)
        for each in value if kind.startswith('sequence<') else [value]:
            if hasattr(each, 'get_fields_and_field_types'):
                yield from _leaves(each)
            else:
                yield message, name, kind


def _covariance(size: int, rng: random.Random) -> np.ndarray:
    """Return a matrix that is no covariance, or no useful one."""
    side = math.isqrt(size)
    good = np.diag(np.full(side, 0.01))
    some = good.ravel().copy()
    some[[rng.randrange(size) for _ in range(rng.randint(1, 4))]] = rng.choice(NUMBERS)
    return np.ravel(rng.choice((
        np.full(size, rng.choice(NUMBERS)), some, some, np.where(good > 0.0, 0.01, 5.0),
        good + np.triu(np.ones((side, side)), 1), -good, 1e-298 * good, np.zeros(size))))


def broken(message: Any, rng: random.Random) -> Any:
    """Replace some fields of a message by what they must not be, and return it."""
    leaves = list(_leaves(message))
    leaves += 4 * [each for each in leaves if each[1].endswith('covariance')]
    for owner, name, kind in rng.sample(leaves, min(rng.choice((1, 1, 1, 2, 4)), len(leaves))):
        if kind == 'string':
            value: Any = rng.choice(TEXTS)
        elif kind == 'double' and type(owner).__name__ == 'Quaternion':
            owner.x = owner.y = owner.z = owner.w = value = rng.choice((*NONE, 0.0))
        elif kind == 'double':
            value = rng.choice(NONE)
        elif kind == 'float':
            value = rng.choice(SMALL_NUMBERS)
        elif kind in WHOLE:
            value = rng.choice((*WHOLE[kind], 0, rng.randint(*WHOLE[kind])))
        else:
            value = _covariance(len(getattr(owner, name)), rng)
        setattr(owner, name, value)
    return message


def large(message: Any, rng: random.Random) -> Any:
    """Give a message a text of a megabyte, and return it."""
    owner, name, _ = rng.choice([each for each in _leaves(message) if each[2] == 'string'])
    setattr(owner, name, rng.choice('x@9/') * 2**20)
    return message


def _order(seconds: float) -> PoseWithCovarianceStamped:
    """Return a pose to be set that cannot be: one that can be is an order, which holds."""
    message = _global_pose(seconds)
    message.pose.pose.position.x = math.nan
    return message


def malformed(make: Callable[[float], Any], seconds: float, rng: random.Random) -> tuple[
        str, bytes]:
    """Return what is wrong with a message, and its bytes."""
    if rng.randrange(LARGE) == 0:
        return 'with a text of a megabyte', serialize_message(large(make(seconds), rng))
    chance = rng.random()
    if chance < 0.6:
        return 'with wrong fields', serialize_message(broken(make(seconds), rng))
    if chance < 0.7:
        head = rng.choice((b'', b'\0\1\0\0'))
        return 'noise', head + rng.randbytes(rng.randint(4, 400))
    data = serialize_message(make(seconds))
    return 'cut off', data[:rng.randrange(4, len(data))]


# --- over DDS

@dataclass(slots=True)
class Found:
    """What a flood did to the node."""

    sent: Counter[tuple[str, str]]
    """Malformed messages by topic and what is wrong with them."""
    seconds: float
    """How long they took."""
    behind: float
    """How long the node then took for what was still queued, and to optimise the graph [s]."""
    memory: tuple[float, float, float]
    """Resident, before, after the malformed messages and after the drive [MB]."""
    lines: int
    """Lines that the log had more after it than before."""
    values: dict[str, str]
    """Diagnostics after the malformed messages."""
    error: float
    """Largest distance of the path of the clean drive from the truth [m]."""


class Sender:
    """Sends what drivers would, and worse; hears path and diagnostics."""

    def __init__(self, domain: int, *, seed: int = 0) -> None:
        self._rng = random.Random(seed)
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain)
        self._node = rclpy.create_node('sender', context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._inputs = inputs()
        self._publishers = {topic: self._node.create_publisher(
            message_class(kind), topic, QoSProfile(depth=1000, durability=(
                QoSDurabilityPolicy.TRANSIENT_LOCAL if topic == STATIC_TOPIC
                else QoSDurabilityPolicy.VOLATILE))) for topic, (kind, _) in self._inputs.items()}
        self._state = self._node.create_client(GetState, 'pose_graph/get_state')
        self._optimize = self._node.create_client(Trigger, 'pose_graph/optimize')
        self._path = PathMessage()
        self.values: dict[str, str] = {}
        """Of the newest diagnostics."""
        self._node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)
        self._node.create_subscription(
            PathMessage, 'path', self._on_path,
            QoSProfile(depth=1, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL))

    def __enter__(self) -> 'Sender':
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.values = {item.key: item.value for item in message.status[0].values}

    def _on_path(self, message: PathMessage) -> None:
        self._path = message

    def _until(self, done: Callable[[], bool], what: str, patience: float = PATIENCE) -> None:
        end = time.monotonic() + patience
        while not done():
            if time.monotonic() > end:
                raise TimeoutError(f'waited {patience} s until {what}: {self.values}')
            self._executor.spin_once(timeout_sec=0.05)

    def wait_until_ready(self) -> None:
        """Wait until the node reads all topics, has its kernels and answers."""
        self._until(lambda: all(each.get_subscription_count() > 0
                                for each in self._publishers.values())
                    and self.values.get('prepared') == '1', 'the node is ready', 300.0)
        while not self._answers(0.5):
            pass

    def _answers(self, patience: float) -> bool:
        """Ask a service of the thread that reads the topics."""
        future = self._state.call_async(GetState.Request())
        self._executor.spin_until_future_complete(future, timeout_sec=patience)
        return future.done()

    def flood(
        self, count: int, topics: Sequence[str] = (),
    ) -> tuple[Counter[tuple[str, str]], float]:
        """Send malformed messages; return how many by topic and kind, and the time taken [s]."""
        topics, sent = topics or list(self._inputs), Counter[tuple[str, str]]()
        begin = time.monotonic()
        for index in range(count):
            topic = topics[index % len(topics)]
            kind, data = malformed(self._inputs[topic][1], STEP * index, self._rng)
            self._publishers[topic].publish(data)
            sent[topic, kind] += 1
            if index % BURST == BURST - 1 and not self._answers(PATIENCE):
                raise TimeoutError(f'the node does not answer after {index + 1} messages')
            if index % 50_000 == 49_999:
                say(f'  {index + 1} in {time.monotonic() - begin:.0f} s, hidden nodes '
                    f'{self.values["hidden_nodes"]}, {self.values["memory_mb"]} MB')
        return sent, time.monotonic() - begin

    def optimize(self) -> float:
        """Wait until the node has done all it was sent, and optimised; return the time [s]."""
        begin, future = time.monotonic(), self._optimize.call_async(Trigger.Request())
        self._until(future.done, 'the graph is optimised', 3600.0)
        return time.monotonic() - begin

    def drive(self, begin: float) -> float:
        """Drive from a time on [s]; return the largest distance of the path from the truth [m]."""
        for step in range(round(10 * DRIVE)):
            seconds = begin + 0.1 * step
            self._publishers['odom'].publish(odometry(seconds))
            if step % 5 == 0:
                self._publishers['gps/fix'].publish(fix(seconds))
            if step % 20 == 0 and not self._answers(PATIENCE):
                raise TimeoutError('the node does not answer')
        self.optimize()
        last = START + begin + DRIVE - 0.5
        self._until(lambda: len(self._path.poses) > 0 and _seconds(
            self._path.poses[-1].header) > last, 'the path has the drive')
        return max(math.hypot(each.pose.position.x - x, each.pose.position.y - y)
                   for each in self._path.poses if _seconds(each.header) >= START + begin
                   for x, y, _ in [true_pose(_seconds(each.header) - START)])


def _seconds(header: Any) -> float:
    return float(header.stamp.sec + 1e-9 * header.stamp.nanosec)


def flooded(count: int) -> Found:
    """Start a node, send it malformed messages, then a clean drive."""
    with started(NODE, PARAMETERS) as (process, feeder), Sender(feeder.domain) as sender:
        sender.wait_until_ready()
        before, lines = process.memory()['VmRSS'], _lines(process)
        sent, seconds = sender.flood(count)
        behind = sender.optimize()
        after, values = process.memory()['VmRSS'], dict(sender.values)
        error = sender.drive(STEP * count + GAP)
        return Found(sent, seconds, behind, (before, after, process.memory()['VmRSS']),
                     _lines(process) - lines, values, error)


def _lines(process: Process) -> int:
    return process.log.read_text(encoding='utf-8', errors='replace').count('\n')


def messages(options: Options) -> Section:
    """
    Flood the node, then drive.

    Then is what the node took for what was still queued, and to optimise the graph. Read since are
    the measurements that could be read since the newest reset, hidden nodes what they made. Memory
    is the resident set of the node.
    """
    count = options.sizes[0] if options.sizes else COUNT // 100 if options.quick else COUNT
    section, found = Section('A flood, then a drive', about(messages)), flooded(count)
    kinds = sorted({kind for _, kind in found.sent})
    table = section.table('Sent', 'topic', *kinds)
    for topic in dict.fromkeys(topic for topic, _ in found.sent):
        table.add(topic, *(str(found.sent[topic, kind]) for kind in kinds))
    table = section.table(
        'The node', 'messages', 'time [s]', 'a second', 'then [s]', 'resets', 'read since',
        'hidden nodes', 'memory before / after / after the drive [MB]', 'lines of log',
        'largest error of the drive [m]')
    table.add(str(count), f'{found.seconds:.0f}', f'{count / found.seconds:.0f}',
              f'{found.behind:.0f}', *(
                  found.values[name] for name in ('resets', 'received', 'hidden_nodes')),
              ' / '.join(f'{each:.0f}' for each in found.memory), str(found.lines),
              f'{found.error:.3f}')
    section.ask(f'{count} messages: largest error of the drive after them', found.error, ' m',
                most=ERROR)
    return section


SECTIONS = {'messages': messages}
