# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Wheels that send twists and drift, and a gyroscope upside down: with the real node over DDS."""

import math

from circle import fix_at, START, true_pose
from geometry_msgs.msg import PoseStamped, TwistWithCovarianceStamped
from harness import Client, imu, LATCHED, NodeProcess, stamp_ns, TFMessage, transform
import numpy as np
import pytest
from sensor_msgs.msg import Imu

pytestmark = pytest.mark.skipif(TFMessage is None, reason='there is no tf2_msgs')
SPEED, RATE, DRIFT, BIAS = 2.0, 0.1, 0.02, -0.008
"""Of the circle [m/s, rad/s], of the heading by the wheels, and of the gyroscope [rad/s]."""
REST, END_OF_FIXES, END = 4.0, 25.0, 45.0
ARGUMENTS = (
    '-p', 'sources:=[wheels, fix, gyro]', '-p', 'wheels.type:=twist', '-p', 'wheels.topic:=twist',
    '-p', 'gyro.sigma_rate:=0.0005', '-p', 'fix.correlation_time:=0.0')


def twist_at(seconds: float) -> TwistWithCovarianceStamped:
    message = TwistWithCovarianceStamped()
    message.header = imu(START + seconds, 0.0).header
    message.header.frame_id = 'base_link'
    if seconds > 0.0:
        message.twist.twist.linear.x = SPEED
        message.twist.twist.angular.z = RATE + DRIFT
    return message


def rate_at(seconds: float) -> Imu:
    message = imu(START + seconds, 0.0)
    message.header.frame_id = 'imu'
    message.angular_velocity.z = -((RATE if seconds > 0.0 else 0.0) + BIAS)
    return message


def error(item: PoseStamped) -> np.ndarray:
    """Return the error of a pose of the path, shape (3,) [m, m, rad]."""
    truth = true_pose(max(stamp_ns(item) * 1e-9 - START, 0.0))
    position, q = item.pose.position, item.pose.orientation
    return np.array([position.x - truth[0], position.y - truth[1],
                     math.remainder(2.0 * math.atan2(q.z, q.w) - truth[2], 2.0 * math.pi)])


@pytest.mark.parametrize('node', [ARGUMENTS], indirect=True)
def test_the_gyroscope_keeps_the_heading_while_the_wheels_drift(node: NodeProcess) -> None:
    with Client(int(node.env['ROS_DOMAIN_ID']), listens=('fix', 'loop_closure'), more={
            'twist': TwistWithCovarianceStamped, 'imu/data': Imu}) as client:
        frames = client.node.create_publisher(TFMessage, '/tf_static', LATCHED)
        upside_down = (1.0, 0.0, 0.0, 0.0)
        no_rate = rate_at(-REST)
        no_rate.angular_velocity_covariance[0] = -1.0
        client.more['imu/data'].publish(no_rate)
        client.more['imu/data'].publish(rate_at(-REST))
        client.wait_processed(2)
        assert client.values['gyro.no_angular_velocity'] == '1'
        assert client.values['gyro.unknown_frame'] == '1'
        frames.publish(TFMessage(transforms=[transform('base_link', 'imu', q=upside_down)]))
        client.wait_received(frames)
        sent = 2
        for step in range(round(-REST * 20), round(END * 20)):
            seconds = step / 20.0
            client.more['imu/data'].publish(rate_at(seconds))
            sent += 1
            if step % 2 == 0:
                client.more['twist'].publish(twist_at(seconds))
                sent += 1
            if step % 10 == 0 and 0.0 <= seconds < END_OF_FIXES:
                client.fix.publish(fix_at(seconds))
                sent += 1
            client.spin_for(0.0005)
            if step % 100 == 0:
                client.wait_processed(sent)
        client.wait_processed(sent)
        assert client.optimize().success
        client.wait_current()
        assert client.values['odometry'] == 'wheels'
        # the transform may be read after the first of them, though it was received before
        assert int(client.values['gyro.accepted']) >= round((REST + END) * 20) - 1
        assert int(client.values['gyro.rotations']) > 45
        assert float(client.values['gyro.bias']) == pytest.approx(BIAS, abs=6e-4)
        client.spin_until(lambda: stamp_ns(client.paths[-1].poses[-1]) > (START + END - 1.0) * 1e9,
                          'the whole path comes')
        # by the wheels alone 0.4 rad and 8 m
        off = np.array([error(item) for item in client.paths[-1].poses])
        assert np.max(np.hypot(off[:, 0], off[:, 1])) < 1.0
        assert abs(off[-1, 2]) < 0.03
