# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages out: held to rclpy's own serialisation."""

import math
import time

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not there: no rclpy')

from geometry_msgs.msg import (
    Pose,
    PoseStamped,
    PoseWithCovariance,
    PoseWithCovarianceStamped,
    TransformStamped,
)
from nav_msgs.msg import Odometry, Path
import numpy as np
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Header

from pose_graph_ros.adapters import output_cdr
from pose_graph_ros.adapters.conversions import PLANAR
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.prediction import Prediction
from pose_graph_ros.ros import messages


def path_message(path: Trajectory, stamp_ns: int, frame: str) -> Path:
    """Build the message pose by pose."""
    message = Path()
    message.header.stamp, message.header.frame_id = messages.time_message(stamp_ns), frame
    for stamp, pose in zip(path.stamps_ns.tolist(), path.poses.tolist(), strict=True):
        item = PoseStamped()
        item.header.stamp, item.header.frame_id = messages.time_message(stamp), frame
        item.pose.position.x, item.pose.position.y = pose[0], pose[1]
        # NumPy's sine, which may differ from the one of math in the last bit
        item.pose.orientation.z = float(np.sin(pose[2] / 2.0))
        item.pose.orientation.w = float(np.cos(pose[2] / 2.0))
        message.poses.append(item)
    return message


@pytest.mark.parametrize('frame', ['', 'm', 'ma', 'map', 'map1', 'world', 'robot1', 'robot/1',
                                   'robot/map', 'kürzel'])
@pytest.mark.parametrize('count', [0, 1, 2, 3, 50])
def test_the_path_is_byte_for_byte_what_rclpy_makes(
    frame: str, count: int, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(output_cdr, 'PATH_CHUNK', 7)
    generator = np.random.default_rng(count)
    stamps = 1_700_000_000_123_456_789 + np.cumsum(generator.integers(1, 2**31, count))
    path = Trajectory(stamps, generator.normal(0.0, 100.0, (count, 3)))
    ours = output_cdr.path_cdr(path, 1_800_000_000_000_000_007, frame)
    theirs = path_message(path, 1_800_000_000_000_000_007, frame)
    assert deserialize_message(ours, Path) == theirs
    serialized = bytes(serialize_message(theirs))
    assert len(serialized) - len(ours) in range(4), 'at most the end is padded'
    # the middleware leaves what was in memory in the gaps before aligned numbers
    gaps = padding(len(frame.encode()) + 1, count)
    assert blank(ours[4:], gaps) == blank(serialized[4:len(ours)], gaps)


def padding(name: int, count: int) -> list[int]:
    """Return the offsets of gaps: walk over the fields as the CDR rules say."""
    gaps: list[int] = []
    at = 0

    def field(size: int, alignment: int) -> None:
        nonlocal at
        while at % alignment != 0:
            gaps.append(at)
            at += 1
        at += size

    def header() -> None:
        for _ in range(3):
            field(4, 4)
        field(name, 1)

    header()
    field(4, 4)
    for _ in range(count):
        header()
        for _ in range(7):
            field(8, 8)
    return gaps


def blank(data: bytes, gaps: list[int]) -> bytes:
    """Return data with zeros in the gaps."""
    blanked = bytearray(data)
    for at in gaps:
        blanked[at] = 0
    return bytes(blanked)


def test_a_long_path_is_quick() -> None:
    count = 100_000
    path = Trajectory(np.arange(1, count + 1), np.zeros((count, 3)))
    output_cdr.path_cdr(path, 1, 'map')
    start = time.process_time()
    output_cdr.path_cdr(path, 1, 'map')
    # a hundred times what it takes; message by message it would take seconds
    assert time.process_time() - start < 1.0


def fields(message: object) -> object:
    """Return a message, or what stands in for one, as nested dictionaries."""
    names = (message.get_fields_and_field_types() if hasattr(message, 'get_fields_and_field_types')
             else getattr(message, '_fields', None))
    if names is None:
        return message if isinstance(message, (str, int, float)) else list(message)
    return {name: fields(getattr(message, name)) for name in names}


def random_odometry(frame: str, child_frame: str) -> Odometry:
    generator = np.random.default_rng(len(frame) + 100 * len(child_frame))
    message = Odometry(child_frame_id=child_frame)
    message.header.frame_id = frame
    message.header.stamp.sec, message.header.stamp.nanosec = -5, 2**32 - 1
    for part, vectors in ((message.pose, ('position', 'orientation')),
                          (message.twist, ('linear', 'angular'))):
        inner = part.pose if part is message.pose else part.twist
        for vector in vectors:
            for axis in getattr(inner, vector).get_fields_and_field_types():
                setattr(getattr(inner, vector), axis, generator.normal())
        part.covariance = generator.normal(size=36)
    message.pose.pose.position.z = math.inf
    return message


@pytest.mark.parametrize('child_frame', ['', 'b', 'base_link', 'robot/1'])
@pytest.mark.parametrize('frame', ['', 'o', 'od', 'odo', 'odom', 'Größe 地図', 'a' * 5000])
def test_odometry_is_read_as_rclpy_reads_it(frame: str, child_frame: str) -> None:
    message = random_odometry(frame, child_frame)
    data = bytes(serialize_message(message))
    assert fields(messages.odometry_message(data)) == fields(message)


def test_odometry_in_big_endian_is_read_and_what_is_no_odometry_is_refused() -> None:
    message = random_odometry('odom', 'base_link')
    data = bytes(serialize_message(message))
    # the stamp, two names of which the length stands before, and then only doubles
    names = b''.join(length[::-1] + name for length, name in (
        (data[12:16], data[16:24]), (data[24:28], data[28:44])))
    stamp, numbers = np.frombuffer(data[4:12], '<u4'), np.frombuffer(data[44:], '<f8')
    big = b'\0\0\0\0' + stamp.astype('>u4').tobytes() + names + numbers.astype('>f8').tobytes()
    assert fields(messages.odometry_message(big)) == fields(message)
    for broken in (data[:-8], data[:30], data[:4], data[:12] + b'\xff' * 4 + data[16:],
                   data.replace(b'odom', b'od\xffm')):
        with pytest.raises(ValueError, match=r'too few|decode'):
            messages.odometry_message(broken)


def pose_message(pose: np.ndarray) -> Pose:
    """Return a planar pose, shape (3,), as a message."""
    message = Pose()
    message.position.x, message.position.y = float(pose[0]), float(pose[1])
    message.orientation.z = math.sin(pose[2] / 2.0)
    message.orientation.w = math.cos(pose[2] / 2.0)
    return message


def pose_with_covariance(prediction: Prediction, other: float) -> PoseWithCovariance:
    """Return a prediction as a message; what is not planar has the other variance."""
    covariance = np.diag((0.0, 0.0, *(4 * [other])))
    covariance[PLANAR] = prediction.covariance
    return PoseWithCovariance(
        pose=pose_message(prediction.T_map_base), covariance=covariance.ravel())


def odometry_message(
    stamp_ns: int, prediction: Prediction, source: Odometry, map_frame: str, base_frame: str,
) -> Odometry:
    """Return the pose in the map, with the twist that the odometry came with if it is finite."""
    message = Odometry(
        header=Header(stamp=messages.time_message(stamp_ns), frame_id=map_frame),
        child_frame_id=base_frame,
        pose=pose_with_covariance(prediction, output_cdr.UNKNOWN_VARIANCE))
    twist = source.twist
    linear, angular = twist.twist.linear, twist.twist.angular
    numbers = (linear.x, linear.y, linear.z, angular.x, angular.y, angular.z)
    if all(map(math.isfinite, numbers)) and np.all(np.isfinite(twist.covariance)):
        message.twist = twist
    else:
        message.twist.covariance = (output_cdr.UNKNOWN_VARIANCE * np.eye(6)).ravel()
    return message


def stamped_pose_message(
    stamp_ns: int, pose: PoseWithCovariance, map_frame: str,
) -> PoseWithCovarianceStamped:
    """Return the pose in the map alone."""
    return PoseWithCovarianceStamped(
        header=Header(stamp=messages.time_message(stamp_ns), frame_id=map_frame), pose=pose)


def transform_message(
    stamp_ns: int, T_map_odom: np.ndarray, map_frame: str, odom_frame: str,
) -> TransformStamped:
    """Return the transform from the map to the odometry frame."""
    message = TransformStamped(
        header=Header(stamp=messages.time_message(stamp_ns), frame_id=map_frame),
        child_frame_id=odom_frame)
    pose = pose_message(T_map_odom)
    message.transform.translation.x = pose.position.x
    message.transform.translation.y = pose.position.y
    message.transform.rotation = pose.orientation
    return message


def test_an_odometry_without_a_finite_twist_gets_none() -> None:
    prediction = Prediction(np.array([1.0, 2.0, 3.0]), np.diag([1.0, 2.0, 3.0]))
    source = Odometry()
    source.twist.twist.linear.x = math.nan
    message = odometry_message(1, prediction, source, 'map', 'base_link')
    assert message.twist.twist.linear.x == 0.0
    assert message.twist.covariance[0] == output_cdr.UNKNOWN_VARIANCE
    covariance = np.asarray(message.pose.covariance).reshape(6, 6)
    assert np.array_equal(np.diagonal(covariance), [1.0, 2.0, 1e6, 1e6, 1e6, 3.0])


FRAMES = ['m', 'ma', 'map', 'map1', 'world', 'robot/map', 'kürzel']


def names_padding(at: int, *frames: str) -> list[int]:
    """Return the offsets of the gaps around frame ids that begin at an offset."""
    gaps: list[int] = []
    for frame in frames:
        gaps += range(at, at + -at % 4)
        at += -at % 4 + 4 + len(frame.encode()) + 1
    return gaps + list(range(at, at + -at % 8))


def assert_same_bytes(ours: bytes, theirs: object, gaps: list[int]) -> None:
    assert deserialize_message(ours, type(theirs)) == theirs
    serialized = bytes(serialize_message(theirs))
    assert len(serialized) - len(ours) in range(4), 'at most the end is padded'
    assert blank(ours[4:], gaps) == blank(serialized[4:len(ours)], gaps)


def some_prediction(seed: int) -> Prediction:
    rng = np.random.default_rng(seed)
    return Prediction(rng.normal(0.0, 1.0, 3), rng.normal(0.0, 1.0, (3, 3)))


@pytest.mark.parametrize('map_frame', FRAMES)
@pytest.mark.parametrize('base_frame', ['b', 'ba', 'base', 'base_link', 'robot/base'])
def test_odometry_is_byte_for_byte_what_rclpy_makes(map_frame: str, base_frame: str) -> None:
    prediction, stamp = some_prediction(len(map_frame)), 1_700_000_000_123_456_789
    source = Odometry()
    source.twist.twist.linear.x, source.twist.twist.angular.z = 1.25, -0.5
    source.twist.covariance = np.arange(36.0)
    assert_same_bytes(
        output_cdr.odometry_cdr(stamp, prediction, source, map_frame, base_frame),
        odometry_message(stamp, prediction, source, map_frame, base_frame),
        names_padding(8, map_frame, base_frame))


@pytest.mark.parametrize('frame', FRAMES)
def test_the_pose_is_byte_for_byte_what_rclpy_makes(frame: str) -> None:
    prediction = some_prediction(1)
    assert_same_bytes(
        output_cdr.stamped_pose_cdr(2**31 * 10**9 - 1, prediction, frame),
        stamped_pose_message(
            2**31 * 10**9 - 1, pose_with_covariance(prediction, 1e-6), frame),
        names_padding(8, frame))


@pytest.mark.parametrize('child', ['o', 'odom', 'robot/odom'])
@pytest.mark.parametrize('frame', FRAMES)
def test_the_transform_is_byte_for_byte_what_rclpy_makes(frame: str, child: str) -> None:
    tf2_msgs = pytest.importorskip('tf2_msgs.msg', reason='tf2_msgs is not there')
    pose = np.array([1.5, -2.5, 3.0])
    assert_same_bytes(
        output_cdr.transform_cdr(7, pose, frame, child),
        tf2_msgs.TFMessage(transforms=[transform_message(7, pose, frame, child)]),
        names_padding(12, frame, child))


@pytest.mark.parametrize('where', ['twist', 'covariance'])
def test_serialised_odometry_without_a_finite_twist_gets_none(where: str) -> None:
    prediction, source = some_prediction(0), Odometry()
    source.twist.twist.linear.x = 1.0
    if where == 'twist':
        source.twist.twist.angular.z = math.inf
    else:
        source.twist.covariance[35] = math.nan
    assert_same_bytes(
        output_cdr.odometry_cdr(1, prediction, source, 'map', 'base_link'),
        odometry_message(1, prediction, source, 'map', 'base_link'),
        names_padding(8, 'map', 'base_link'))
