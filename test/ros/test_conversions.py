# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages in: what is read, and how what cannot be used is answered."""

import math

from harness import fix, odometry, pose
import numpy as np
import pytest

from pose_graph_ros.core.measurements import Answer, GlobalPose, LoopClosure, Position, Verdict
from pose_graph_ros.ros import conversions
from pose_graph_ros.ros.bag_writer import message_types
from pose_graph_ros.ros.conversions import FixReader, MessageReader


def test_odometry_is_read_whatever_the_length_of_its_quaternion() -> None:
    message = odometry(12.5, 1.0, -2.0, 2.5)
    message.pose.pose.orientation.z *= 3.0
    message.pose.pose.orientation.w *= 3.0
    sample = conversions.odometry_sample(message)
    assert sample.stamp_ns == 12_500_000_000
    assert sample.pose == pytest.approx([1.0, -2.0, 2.5])


def test_the_message_of_a_bag_reader_is_read_like_that_of_rclpy() -> None:
    types = message_types()
    time = types['builtin_interfaces/msg/Time'](sec=12, nanosec=500_000_000)
    header = types['std_msgs/msg/Header'](stamp=time, frame_id='map')
    point = types['geometry_msgs/msg/Point'](x=1.0, y=-2.0, z=0.0)
    quaternion = types['geometry_msgs/msg/Quaternion'](
        x=0.0, y=0.0, z=math.sin(1.25), w=math.cos(1.25))
    inner = types['geometry_msgs/msg/Pose'](position=point, orientation=quaternion)
    covariance = np.zeros(36)
    covariance[[0, 7, 35]] = (0.01, 0.01, 0.001)
    foreign = types['geometry_msgs/msg/PoseWithCovarianceStamped'](
        header=header,
        pose=types['geometry_msgs/msg/PoseWithCovariance'](pose=inner, covariance=covariance))
    theirs = conversions.global_pose(foreign, 'map')
    ours = conversions.global_pose(pose(12.5, 1.0, -2.0, 2.5), 'map')
    assert isinstance(theirs, GlobalPose)
    assert isinstance(ours, GlobalPose)
    assert theirs.stamp_ns == ours.stamp_ns
    assert np.array_equal(theirs.pose, ours.pose)
    assert np.array_equal(theirs.covariance, ours.covariance)


@pytest.mark.parametrize('frame', ['map', '/map', ''])
def test_a_global_pose_in_the_map_is_taken(frame: str) -> None:
    assert isinstance(conversions.global_pose(pose(1.0, 0.0, 0.0, 0.0, frame), 'map'), GlobalPose)


def test_a_global_pose_elsewhere_is_refused_with_both_frames() -> None:
    answer = conversions.global_pose(pose(1.0, 0.0, 0.0, 0.0, 'utm'), 'map')
    assert isinstance(answer, Answer)
    assert (answer.verdict, answer.reason) == (Verdict.REJECTED, 'wrong_frame')
    assert 'map' in answer.detail
    assert 'utm' in answer.detail


@pytest.mark.parametrize(('frame', 'node', 'time'), [
    ('x42', 42, None), ('@1695.250000000', None, 1_695_250_000_000),
    ('@1695', None, 1_695_000_000_000), ('@1695.25', None, 1_695_250_000_000),
    ('@1700000000.123456789', None, 1_700_000_000_123_456_789)])
def test_the_reference_of_a_loop_closure(frame: str, node: int | None, time: int | None) -> None:
    closure = conversions.loop_closure(pose(2000.0, 1.0, 0.0, 0.0, frame))
    assert isinstance(closure, LoopClosure)
    assert (closure.reference_node, closure.reference_ns) == (node, time)


@pytest.mark.parametrize('frame', [
    '', 'x', '@', 'x-1', '@-1.0', '@1.0e3', 'base_link', 'x1x', ' x1', '@1.1234567890', 'x1\n'])
def test_any_other_frame_of_a_loop_closure_is_refused(frame: str) -> None:
    answer = conversions.loop_closure(pose(2000.0, 1.0, 0.0, 0.0, frame))
    assert isinstance(answer, Answer)
    assert answer.reason == 'wrong_frame'


@pytest.mark.parametrize('x', [1e200, -1e12])
def test_odometry_beyond_any_map_is_refused_at_the_door(x: float) -> None:
    answer = conversions.odometry_sample(odometry(1.0, x, 0.0, 0.0))
    assert isinstance(answer, Answer)
    assert answer.reason == 'too_large'


def test_the_first_good_fix_is_the_datum() -> None:
    reader = FixReader()
    bad = fix(1.0, 48.0, 11.0)
    bad.status.status = -1
    assert isinstance(reader.position(bad), Answer)
    worse = fix(1.5, 0.0, 0.0)
    worse.position_covariance = [-1.0] * 9
    assert reader.position(worse).reason == 'covariance_not_positive'
    assert reader.plane is None
    first = reader.position(fix(2.0, 48.1, 11.6))
    assert isinstance(first, Position)
    assert first.position == pytest.approx([0.0, 0.0], abs=1e-9)
    second = reader.position(fix(3.0, 48.101, 11.6))
    # a thousandth of a degree of latitude is 111 m
    assert second.position == pytest.approx([0.0, 111.2], abs=0.1)


def test_a_datum_with_a_yaw_turns_positions_and_covariances() -> None:
    reader = FixReader([48.1, 11.6, math.pi / 2.0])
    message = fix(1.0, 48.101, 11.6)
    message.position_covariance = [1.0, 0.0, 0.0, 0.0, 4.0, 0.0, 0.0, 0.0, 9.0]
    measurement = reader.position(message)
    assert measurement.position == pytest.approx([111.2, 0.0], abs=0.1)
    assert np.diagonal(measurement.covariance) == pytest.approx([4.0, 1.0])


def test_an_altitude_that_is_not_known_is_that_of_the_datum() -> None:
    reader = FixReader()
    reader.position(fix(1.0, 48.1, 11.6))
    message = fix(2.0, 48.101, 11.6)
    known = reader.position(message).position
    message.altitude = math.nan
    assert reader.position(message).position == pytest.approx(known, abs=1e-6)


def test_the_covariance_of_a_fix_is_honoured_by_its_type() -> None:
    reader = FixReader()
    message = fix(1.0, 48.1, 11.6, sigma=2.0)
    assert reader.position(message).covariance == pytest.approx(4.0 * np.eye(2))
    message.position_covariance_type = 0
    assert not np.any(reader.position(message).covariance)


@pytest.mark.parametrize(('datum', 'lever_arm'), [
    ([1.0], [0.0, 0.0]), ([1.0, 2.0, 3.0, 4.0], [0.0, 0.0]), ([91.0, 0.0], [0.0, 0.0]),
    ([math.nan, 0.0], [0.0, 0.0]), ([], [1.0]), ([], [math.inf, 0.0])])
def test_a_bad_datum_or_lever_arm_is_a_value_error(
    datum: list[float], lever_arm: list[float],
) -> None:
    with pytest.raises(ValueError, match=r'expected'):
        FixReader(datum, lever_arm)


def test_an_input_that_is_not_known_is_a_value_error() -> None:
    with pytest.raises(ValueError, match='expected odom'):
        MessageReader('map', FixReader()).read('imu', None)
