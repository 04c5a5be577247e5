# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The nodes in `pose_graph_ros.examples`, beside the real node over DDS."""

import math
import subprocess
import sys

from circle import START, true_pose
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from harness import Client, NodeProcess, odometry, RELIABLE, stamp_ns, yaw
import numpy as np
import pytest
from sensor_msgs.msg import BatteryState, LaserScan

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.examples import scan_closures

LASER = (0.3, -0.1, 0.5)
"""Where it is on the robot [m, m, rad]."""
CORNERS = np.array([(-24, -4), (10, -4), (10, -8), (26, -8), (26, 44), (4, 44), (4, 30), (-2, 30),
                    (-2, 40), (-24, 40), (-24, -4)], dtype=float)
"""Of the walls of a hall around the drive [m]; what is behind another wall counts as free."""


def scan_at(seconds: float, random: np.random.Generator) -> LaserScan:
    """Return what a laser with an error of 1 cm sees in the hall."""
    x, y, yaw = se2.compose(true_pose(seconds), np.array(LASER))
    angles = np.linspace(-math.pi, math.pi, 360, endpoint=False)
    ray = np.stack((np.cos(angles + yaw), np.sin(angles + yaw)), axis=1)[:, None]
    wall, begin = np.diff(CORNERS, axis=0), CORNERS[:-1] - (x, y)
    across = ray[..., 0] * wall[:, 1] - ray[..., 1] * wall[:, 0]
    ranges = (begin[:, 0] * wall[:, 1] - begin[:, 1] * wall[:, 0]) / across
    share = (begin[:, 0] * ray[..., 1] - begin[:, 1] * ray[..., 0]) / across
    ranges[(ranges < 0.0) | (share < 0.0) | (share > 1.0)] = math.inf
    measured = np.min(ranges, axis=1) + 0.01 * random.standard_normal(len(angles))
    message = LaserScan(angle_min=-math.pi, angle_increment=math.tau / len(angles),
                        range_min=0.1, range_max=60.0, ranges=measured.tolist())
    message.header.stamp = odometry(START + seconds, 0.0, 0.0, 0.0).header.stamp
    return message


def test_a_match_in_a_corridor_does_not_tell_the_place_along_it() -> None:
    random = np.random.default_rng(1)
    angles = np.linspace(-math.pi, math.pi, 720, endpoint=False) + 1e-4
    ranges = 1.5 / np.abs(np.sin(angles))
    rays = np.stack((np.cos(angles), np.sin(angles)), axis=1)
    old, new = ((ranges + 0.01 * random.standard_normal(720))[:, None] * rays for _ in range(2))
    seen = ranges < 15.0
    found = scan_closures.match(new[seen], old[seen], np.array((0.7, 0.1, 0.05)))
    assert found is not None
    pose, covariance = found
    assert abs(pose[1]) < 0.02
    along, across, _ = np.sqrt(np.diag(covariance))
    assert along > 5.0
    assert across < 0.2


def revisit_error(path: list[PoseStamped]) -> float:
    """Return how far places of the second round are from where the first one sees them [m]."""
    stamps = [stamp_ns(item) * 1e-9 - START for item in path]
    poses = np.array([(item.pose.position.x, item.pose.position.y, yaw(item.pose.orientation))
                      for item in path])
    poses[:, 2] = np.unwrap(poses[:, 2])
    first, second = np.arange(1.0, 30.0), np.arange(1.0, 30.0) + round(20.0 * math.pi)
    a, b = (np.stack([np.interp(at, stamps, column) for column in poses.T], axis=1)
            for at in (first, second))
    true = [se2.between(true_pose(at), true_pose(back))
            for at, back in zip(first, second, strict=True)]
    return float(np.max(np.hypot(*(se2.between(a, b) - np.array(true))[:, :2].T)))


def test_scans_of_a_second_round_correct_the_path(node: NodeProcess, client: Client) -> None:
    """A round and a half, by odometry that turns by 2 % too much and is 1 % too long."""
    random = np.random.default_rng(1)
    scans = client.node.create_publisher(LaserScan, 'scan', RELIABLE)
    closures: list[PoseWithCovarianceStamped] = []
    client.node.create_subscription(
        PoseWithCovarianceStamped, 'loop_closure', closures.append, RELIABLE)
    turn, way = 0.102, 2.02

    def go(at: float) -> None:
        client.odom.publish(odometry(
            START + at, way / turn * math.sin(turn * at),
            way / turn * (1.0 - math.cos(turn * at)), turn * at, way))

    with subprocess.Popen(
        [sys.executable, '-m', 'pose_graph_ros.examples.scan_closures', '--ros-args',
         '-p', f'laser:={list(LASER)}',
         # else scans that come faster than they are compared are lost, and with them closures
         '-p', 'qos_overrides./scan.subscription.reliability:=reliable',
         '-p', 'qos_overrides./scan.subscription.depth:=1000'], env=node.env,
    ) as example:
        try:
            client.spin_until(lambda: scans.get_subscription_count() > 0, 'scans are heard')
            # the end, until enough scans match, is in real time
            for step in range(1550):
                if len(closures) >= 25 and stamp_ns(closures[-1]) * 1e-9 > START + 91.5:
                    break
                go(step / 10.0)
                if step % 10 == 0:
                    scans.publish(scan_at(step / 10.0, random))
                client.spin_for(0.002 if step < 950 else 0.1)
            else:
                pytest.fail(f'only {len(closures)} scans match earlier ones')
            client.spin_until(lambda: int(client.values.get('loop_closure.believed', '0')) >= len(
                closures), 'closures are believed')
        finally:
            example.kill()
    assert client.optimize().success
    assert client.values.get('loop_closure.doubted', '0') == '0'
    assert revisit_error(client.paths[-1].poses) < 0.1


def test_a_robot_in_its_dock_is_where_it_was(node: NodeProcess, client: Client) -> None:
    """Three rounds from the dock and back, by odometry that turns by 2 % too much."""
    lap, turn = 20.0 * math.pi, 0.102
    battery = client.node.create_publisher(BatteryState, 'battery_state', RELIABLE)
    with subprocess.Popen([sys.executable, '-m', 'pose_graph_ros.examples.dock_closures'],
                          env=node.env) as example:
        try:
            client.spin_until(lambda: battery.get_subscription_count() > 0, 'it listens')
            for step in range(round(30.0 * lap) + 1):
                at = step / 10.0
                message = odometry(START + at, 2.0 / turn * math.sin(turn * at),
                                   2.0 / turn * (1.0 - math.cos(turn * at)), turn * at, 2.0)
                client.odom.publish(message)
                if at % lap < 0.2:  # in the dock, and when it has left
                    battery.publish(BatteryState(header=message.header, power_supply_status=(
                        BatteryState.POWER_SUPPLY_STATUS_CHARGING if at % lap < 0.1
                        else BatteryState.POWER_SUPPLY_STATUS_DISCHARGING)))
                client.spin_for(0.002)
            client.wait_values({'loop_closure.believed': '3'})
        finally:
            example.kill()
    assert client.optimize().success
    first, *_, last = (item.pose.position for item in client.paths[-1].poses)
    assert math.dist((first.x, first.y), (last.x, last.y)) < 0.3
