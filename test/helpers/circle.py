# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The drive of the tests with the real node: a circle, with exact odometry and fixes."""

import math

from harness import Client, fix, odometry, stamp_ns
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from sensor_msgs.msg import NavSatFix

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.geodesy import TangentPlane

ANGLE = math.radians(122.0)
"""Between the odometry frame and the map in these drives."""
START = 1_700_000_000.0
PLANE = TangentPlane(48.1, 11.6, 100.0)


def true_pose(seconds: float) -> np.ndarray:
    """A circle of 20 m radius, at 2 m/s, in the map; it begins at the origin."""
    angle = seconds / 10.0
    return np.array([20.0 * math.sin(angle), 20.0 * (1.0 - math.cos(angle)), angle])


def odometry_pose(seconds: float) -> np.ndarray:
    """The same drive without noise, in the odometry frame."""
    return se2.compose(np.array([5.0, -3.0, -ANGLE]), true_pose(seconds))


def odometry_at(seconds: float) -> Odometry:
    """The message of the exact odometry."""
    return odometry(START + seconds, *odometry_pose(seconds).tolist(), speed=2.0)


def fix_at(seconds: float) -> NavSatFix:
    """The exact fix of an antenna at the robot."""
    latitude, longitude, _ = PLANE.to_geodetic(true_pose(seconds)[:2], PLANE.altitude)
    return fix(START + seconds, latitude, longitude)


def drive(
    client: Client, end: float, *, begin: float = 0.0, fixes: bool = True, paced: bool = False,
) -> None:
    """
    Publish a drive, or a part of it: odometry at 10 Hz, exact fixes at 2 Hz.

    Only a paced drive waits for each answer. The node keeps ten for a client that is late, so
    that others may miss some on a busy machine.
    """
    already = int(client.values['processed'])
    count = 0
    for step in range(round(begin * 10), round(end * 10)):
        seconds = step / 10.0
        client.odom.publish(odometry_at(seconds))
        count += 1
        if fixes and step % 5 == 0:
            client.fix.publish(fix_at(seconds))
            count += 1
        if step == 3:
            # from the first estimate on every odometry message is answered; it comes when the
            # reorder window of 0.25 s is over
            client.wait_processed(already + count)
        elif paced and step > 3:
            client.wait_answered(START + seconds)
        client.spin_for(0.002)
    client.wait_processed(already + count)


def path_error(client: Client) -> float:
    """Return the largest distance of the newest path from the truth, infinite if it is empty."""
    return max((math.hypot(item.pose.position.x - x, item.pose.position.y - y)
                for item in client.paths[-1].poses
                for x, y, _ in [true_pose(stamp_ns(item) * 1e-9 - START)]), default=math.inf)


def check_pose(message: object) -> None:
    position, q = message.pose.position, message.pose.orientation
    assert np.all(np.isfinite((position.x, position.y, position.z)))
    assert math.hypot(q.x, q.y, q.z, q.w) == pytest.approx(1.0, abs=1e-9)
    covariance = np.asarray(message.covariance).reshape(6, 6)
    assert np.all(np.isfinite(covariance))
    assert np.array_equal(covariance, covariance.T)
    assert np.min(np.linalg.eigvalsh(covariance)) >= 0.0
