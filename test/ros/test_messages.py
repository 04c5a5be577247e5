# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is written as bytes is read by rclpy as the message that it would have made."""

import math
import time

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not there: no rclpy')

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry, Path
import numpy as np
from rclpy.serialization import deserialize_message, serialize_message

from pose_graph_ros.adapters import output_cdr
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.prediction import Prediction

STAMP = 2**31 * 10**9 - 1
FRAMES = ['m', 'ma', 'map', 'map1', 'robot/map', 'kürzel']


def numbers(pose: object) -> list[float]:
    """Return the numbers of a pose or a transform."""
    place = pose.position if hasattr(pose, 'position') else pose.translation
    turn = pose.orientation if hasattr(pose, 'orientation') else pose.rotation
    return [place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w]


def planar(pose: np.ndarray) -> list[float]:
    x, y, theta = pose.tolist()
    return pytest.approx([x, y, 0, 0, 0, math.sin(theta / 2), math.cos(theta / 2)], abs=1e-15)


def check_header(message: object, stamp_ns: int, frame: str) -> None:
    stamp = message.header.stamp
    assert (stamp.sec, stamp.nanosec, message.header.frame_id) == (
        *divmod(stamp_ns, 10**9), frame)


def read(data: bytes, kind: type) -> object:
    message = deserialize_message(data, kind)
    assert len(serialize_message(message)) - len(data) in range(4), 'at most the end is padded'
    return message


def some_prediction(seed: int) -> Prediction:
    rng = np.random.default_rng(seed)
    return Prediction(rng.normal(0.0, 1.0, 3), rng.normal(0.0, 1.0, (3, 3)))


def check_covariance(values: object, prediction: Prediction, other: float) -> None:
    wanted = np.diag((0.0, 0.0, other, other, other, 0.0))
    wanted[np.ix_((0, 1, 5), (0, 1, 5))] = prediction.covariance
    np.testing.assert_array_equal(np.asarray(values).reshape(6, 6), wanted)


@pytest.mark.parametrize('frame', ['', *FRAMES])
@pytest.mark.parametrize('count', [0, 1, 2, 50])
def test_a_path(frame: str, count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(output_cdr, 'PATH_CHUNK', 7)
    generator = np.random.default_rng(count)
    path = Trajectory(1_700_000_000_123_456_789 + np.cumsum(generator.integers(1, 2**31, count)),
                      generator.normal(0.0, 100.0, (count, 3)))
    message = read(output_cdr.path_cdr(path, STAMP, frame), Path)
    check_header(message, STAMP, frame)
    assert len(message.poses) == count
    for item, stamp_ns, pose in zip(
            message.poses, path.stamps_ns.tolist(), path.poses, strict=True):
        check_header(item, stamp_ns, frame)
        assert numbers(item.pose) == planar(pose)


def test_a_long_path_is_quick() -> None:
    count = 100_000
    path = Trajectory(np.arange(1, count + 1), np.zeros((count, 3)))
    output_cdr.path_cdr(path, 1, 'map')
    start = time.process_time()
    output_cdr.path_cdr(path, 1, 'map')
    # a hundred times what it takes; message by message it would take seconds
    assert time.process_time() - start < 1.0


@pytest.mark.parametrize('frame', FRAMES)
@pytest.mark.parametrize('base', ['b', 'ba', 'base_link'])
@pytest.mark.parametrize('broken', ['', 'twist', 'covariance'])
def test_odometry_whose_twist_is_unknown_if_it_is_not_finite(
    frame: str, base: str, broken: str,
) -> None:
    prediction, source = some_prediction(len(frame)), Odometry()
    source.twist.twist.linear.x, source.twist.twist.angular.z = 1.25, -0.5
    source.twist.covariance = np.arange(36.0)
    if broken == 'twist':
        source.twist.twist.angular.y = math.inf
    elif broken == 'covariance':
        source.twist.covariance[35] = math.nan
    message = read(output_cdr.odometry_cdr(STAMP, prediction, source, frame, base), Odometry)
    check_header(message, STAMP, frame)
    assert message.child_frame_id == base
    assert numbers(message.pose.pose) == planar(prediction.T_map_base)
    check_covariance(message.pose.covariance, prediction, output_cdr.UNKNOWN_VARIANCE)
    unknown = Odometry().twist
    unknown.covariance = (output_cdr.UNKNOWN_VARIANCE * np.eye(6)).ravel()
    assert message.twist == (source.twist if broken == '' else unknown)


@pytest.mark.parametrize('frame', FRAMES)
def test_a_pose_and_a_transform(frame: str) -> None:
    prediction = some_prediction(1)
    message = read(output_cdr.stamped_pose_cdr(STAMP, prediction, frame),
                   PoseWithCovarianceStamped)
    check_header(message, STAMP, frame)
    assert numbers(message.pose.pose) == planar(prediction.T_map_base)
    check_covariance(message.pose.covariance, prediction, output_cdr.PLANAR_VARIANCE)
    tf2_msgs = pytest.importorskip('tf2_msgs.msg', reason='tf2_msgs is not there')
    for child in ('o', 'odom', 'robot/odom'):
        data = output_cdr.transform_cdr(7, prediction.T_map_base, frame, child)
        (item,) = read(data, tf2_msgs.TFMessage).transforms
        check_header(item, 7, frame)
        assert item.child_frame_id == child
        assert numbers(item.transform) == planar(prediction.T_map_base)
