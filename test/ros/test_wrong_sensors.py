# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A dead gyroscope, and headings that are mounted wrongly: the real node over DDS names them."""

from collections.abc import Callable
import math

from circle import PLANE
from diagnostic_msgs.msg import DiagnosticStatus
from harness import Client, fix, imu, NodeProcess, odometry
from honest_drive import HonestDrive, SPEED
import numpy as np
import pytest
from sensor_msgs.msg import Imu

GYRO = ('-p', 'sources:=[odom, fix, gyro]', '-p', 'gyro.mounting:=up')
HEADING = ('-p', 'sources:=[odom, fix, imu]')


def publish(client: Client, measure: Callable[[float], tuple[float, float]]) -> int:
    """Publish a drive of two minutes; return the number of messages."""
    drive, sent = HonestDrive(3, seconds=120.0, closures=0), 0
    fixes = dict(zip(drive.fix_at.tolist(), drive.positions, strict=True))
    for k, (stamp, pose) in enumerate(zip(
            drive.truth.stamps_ns.tolist(), drive.odometry.poses.tolist(), strict=True)):
        client.odom.publish(odometry(1e-9 * stamp, *pose, speed=SPEED))
        sent += 1
        if k % 2 == 0:
            heading, rate = measure(float(drive.truth.poses[k, 2]))
            message = imu(1e-9 * stamp, heading)
            message.header.frame_id, message.angular_velocity.z = 'imu', rate
            client.more['imu/data'].publish(message)
            sent += 1
        if k in fixes:
            latitude, longitude, _ = PLANE.to_geodetic(fixes[k], PLANE.altitude)
            client.fix.publish(fix(1e-9 * stamp, latitude, longitude))
            sent += 1
        client.spin_for(0.003)
    return sent


@pytest.mark.parametrize(('node', 'measure', 'words'), [
    (GYRO, lambda heading: (0.0, 0.002 * math.sin(9.0 * heading)), ('gyro', 'does not turn')),
    (HEADING, lambda heading: (heading + 0.5 * math.pi, 0.0), ('Imu', 'off by 90 degrees')),
    (HEADING, lambda heading: (0.5 * math.pi - heading, 0.0), ('Imu', 'NED')),
], indirect=['node'], ids=['dead_gyroscope', 'turned_by_90_degrees', 'ned'])
def test_a_source_that_disagrees_with_the_others_is_named(
    node: NodeProcess, measure: Callable[[float], tuple[float, float]], words: tuple[str, ...],
) -> None:
    with Client(int(node.env['ROS_DOMAIN_ID']), listens=('odom', 'fix'),
                more={'imu/data': Imu}) as client:
        client.wait_processed(publish(client, measure))
        client.spin_until(
            lambda: all(word in client.diagnostics[-1].status[0].message for word in words),
            f'{words} are said')
        assert client.diagnostics[-1].status[0].level == DiagnosticStatus.WARN
        assert float(client.values['fix.squared_residual']) > 9.0
        assert node.stderr().count(' contradicts the other sources') == 1


@pytest.mark.parametrize('node', [HEADING], indirect=True)
def test_sources_that_agree_are_not_blamed(node: NodeProcess) -> None:
    rng = np.random.default_rng(1)
    with Client(int(node.env['ROS_DOMAIN_ID']), listens=('odom', 'fix'),
                more={'imu/data': Imu}) as client:
        client.wait_processed(publish(client, lambda heading: (
            heading + 0.01 * float(rng.standard_normal()), 0.0)))
        client.wait_current()
        status = client.diagnostics[-1].status[0]
        assert status.level == DiagnosticStatus.OK, status.message
        assert 0.0 < float(client.values['imu.squared_residual']) < 4.0
