# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Yaw rates of gyroscopes and twists: what is read, in which frame, and what is refused."""

from collections.abc import Sequence
import math

from geometry_msgs.msg import TwistWithCovarianceStamped
from harness import imu, transform
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu
from tf2_msgs.msg import TFMessage

from pose_graph_ros.adapters.parameters import checked
from pose_graph_ros.adapters.sources import MessageReader
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.measurements import Answer, OdometrySample, YawRate


def reader(**values: object) -> MessageReader:
    given = {'sources': ['odom', 'wheels', 'gyro'], 'wheels.type': 'twist', **values}
    return MessageReader(checked(given))


def rate_message(
    seconds: float, rates: Sequence[float], frame: str = 'base_link', sigma: float = 0.0,
) -> Imu:
    message = imu(seconds, 0.0)
    message.header.frame_id = frame
    velocity = message.angular_velocity
    velocity.x, velocity.y, velocity.z = rates
    message.angular_velocity_covariance = (sigma**2 * np.eye(3)).ravel()
    return message


def twist_message(
    seconds: float, x: float, y: float, rate: float, frame: str = 'base_link',
) -> TwistWithCovarianceStamped:
    message = TwistWithCovarianceStamped()
    message.header.stamp = imu(seconds, 0.0).header.stamp
    message.header.frame_id = frame
    twist = message.twist.twist
    twist.linear.x, twist.linear.y, twist.angular.z = x, y, rate
    message.twist.covariance[0] = message.twist.covariance[7] = 0.01
    message.twist.covariance[35] = 0.04
    return message


@pytest.mark.parametrize('frame', ['base_link', '/base_link', ''])
def test_the_rate_about_z_is_read_with_its_variance(frame: str) -> None:
    rate = reader().read('gyro', rate_message(12.5, (0.3, 0.2, -0.1), frame, 0.02))
    assert rate == YawRate(12_500_000_000, -0.1, pytest.approx(4e-4))


@pytest.mark.parametrize(('mounting', 'sign'), [('up', 1.0), ('down', -1.0)])
def test_a_mounting_needs_no_transform(mounting: str, sign: float) -> None:
    read = reader(**{'gyro.mounting': mounting, 'gyro.time_offset': -0.5})
    rate = read.read('gyro', rate_message(2.0, (0.3, 0.2, 0.7), 'imu'))
    assert rate == YawRate(1_500_000_000, sign * 0.7)


def test_the_rate_is_turned_by_the_transform() -> None:
    read = reader()
    turn = Rotation.from_euler('xyz', (1.3, -0.4, 2.0))
    up = turn.inv().apply((0.0, 0.0, 0.6))
    message = rate_message(1.0, up.tolist(), 'imu')
    message.angular_velocity_covariance = np.diag((0.0, 0.0, 1.0)).ravel()
    refused = read.read('gyro', message)
    assert isinstance(refused, Answer)
    assert refused.reason == 'unknown_frame'
    assert 'gyro.mounting' in refused.detail
    read.frames.receive(TFMessage(transforms=[
        transform('base_link', 'imu', (0.1, 0.2, 0.3), turn.as_quat().tolist())]))
    rate = read.read('gyro', message)
    assert isinstance(rate, YawRate)
    assert rate.rate == pytest.approx(0.6)
    assert rate.variance == pytest.approx(turn.as_matrix()[2, 2]**2)


@pytest.mark.parametrize('variance', [0.0, -0.5, math.nan, -2.0])
def test_an_unknown_variance_is_zero(variance: float) -> None:
    message = rate_message(1.0, (0.0, 0.0, 0.2))
    message.angular_velocity_covariance[8] = variance
    assert reader().read('gyro', message) == YawRate(1_000_000_000, 0.2, 0.0)


def test_an_imu_without_an_angular_velocity_is_refused() -> None:
    message = rate_message(1.0, (0.0, 0.0, 0.2))
    message.angular_velocity_covariance[0] = -1.0
    assert reader().read('gyro', message).reason == 'no_angular_velocity'
    message = rate_message(1.0, (0.0, 0.0, math.nan))
    assert reader().read('gyro', message).reason == 'not_finite'


def test_twists_become_odometry() -> None:
    read, rate = reader(), 0.5
    for k in range(21):
        sample = read.read('wheels', twist_message(1.0 + 0.1 * k, 2.0, 0.0, rate))
        assert isinstance(sample, OdometrySample)
    # half of a circle's arc of 4 m radius
    assert sample.pose == pytest.approx(
        (4.0 * math.sin(1.0), 4.0 * (1.0 - math.cos(1.0)), 1.0), abs=1e-7)
    assert sample.twist == (2.0, 0.0, rate)
    assert sample.speed == 2.0
    assert sample.twist_variance == pytest.approx((0.01, 0.01, 0.04))


def test_a_twist_of_another_place_on_the_robot_is_that_of_its_base() -> None:
    read = reader()
    assert read.read('wheels', twist_message(1.0, 1.0, 0.0, 0.0, 'rear')).reason == 'wrong_frame'
    place, base = np.array((-1.2, 0.4, 0.7)), np.array((1.5, -0.2, 0.3))
    half = 0.5 * place[2]
    read.frames.receive(TFMessage(transforms=[transform(
        'base_link', 'rear', (*place[:2], 0.5), (0.0, 0.0, math.sin(half), math.cos(half)))]))
    # the adjoint maps the velocity of the base to that of the place
    at_place = se2.adjoint(se2.inverse(place)) @ base
    sample = read.read('wheels', twist_message(1.0, *at_place.tolist(), 'rear'))
    assert isinstance(sample, OdometrySample)
    assert sample.twist == pytest.approx(base)


def test_a_twist_that_is_not_finite_is_refused() -> None:
    assert reader().read('wheels', twist_message(1.0, math.nan, 0.0, 0.0)).reason == 'not_finite'
