# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The simulated drive: its sensors err as promised, its bag says what the drive says."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pose_graph_ros.adapters.bags import open_bag
from pose_graph_ros.cli.simulate import write_drive
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.offline.simulation.recording import course, record
from pose_graph_ros.offline.simulation.settings import CLOSURES, FIXES, Fixes, GYRO, Gyro
from pose_graph_ros.offline.simulation.worlds import WORLDS

OLD = Path(__file__).parents[1] / 'data' / 'drive_2.npz'
FIX_SIGMA = Fixes().sigmas[0]


def test_the_drive_is_the_one_of_the_first_version() -> None:
    # every 50th or 500th number of what the first version made, and all of its fixes and closures
    drive, old = record(course(WORLDS['drive'], 2, 440.0, lambda usual: replace(
        usual, gyro=Gyro(), wheels=replace(usual.wheels, heading_drift=0.002)))), np.load(OLD)
    fixes, closures, rates = (drive.measured[topic] for topic in (FIXES, CLOSURES, GYRO))
    np.testing.assert_array_equal(fixes.stamps_ns, old['fix_stamps_ns'])
    np.testing.assert_array_equal(fixes.wrong >= 0, old['fix_is_wrong'])
    np.testing.assert_array_equal(closures.stamps_ns, old['loop_stamps_ns'])
    np.testing.assert_array_equal(closures.wrong >= 0, old['loop_is_false'])
    for name, path in (('odometry', drive.odometry), ('truth', drive.truth)):
        np.testing.assert_array_equal(path.stamps_ns[::50], old[f'{name}_stamps_ns'])
        np.testing.assert_allclose(path.poses[::50], old[name], rtol=0.0, atol=1e-9)
    np.testing.assert_array_equal(rates.stamps_ns[::500], old['rate_stamps_ns'])
    np.testing.assert_allclose(rates.values[::500], old['rates'], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(fixes.values[:, :2], old['fixes'][:, :2], rtol=0.0, atol=1e-12)
    # heights may differ by the rounding of geocentric coordinates, as from one PROJ to another
    np.testing.assert_allclose(fixes.values[:, 2], old['fixes'][:, 2], rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(closures.values, old['loop_poses'], rtol=0.0, atol=1e-9)


def test_the_bag_says_what_the_drive_says(tmp_path) -> None:
    drive = record(course(WORLDS['drive'], 1, 200.0))
    fixes, closures = (drive.measured[topic] for topic in (FIXES, CLOSURES))
    write_drive(drive, tmp_path / 'drive')
    seen: dict[str, list[tuple[int, tuple[float, ...]]]] = {}
    with open_bag(tmp_path / 'drive') as bag:
        for sent in bag.messages(bag.topics):
            message = sent.decode()
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            assert stamp < sent.recorded_ns < stamp + 10**9
            if sent.topic == '/gps/fix':
                value = (message.latitude, message.longitude, message.altitude)
                assert message.status.status == 0
                assert message.position_covariance[0] == pytest.approx(FIX_SIGMA**2)
            else:
                pose = message.pose.pose
                theta = 2.0 * np.arctan2(pose.orientation.z, pose.orientation.w)
                value = (pose.position.x, pose.position.y, float(se2.wrap(theta)))
            seen.setdefault(sent.topic, []).append((stamp, value))
            if sent.topic == '/loop_closure':
                second, _, fraction = message.header.frame_id[1:].partition('.')
                assert message.header.frame_id.startswith('@')
                assert len(fraction) == 9
                assert int(second + fraction) in closures.stamps_ns[:, 0]

    for topic, stamps, values in (
        ('/odom', drive.odometry.stamps_ns, drive.odometry.poses),
        ('/ground_truth', drive.truth.stamps_ns, drive.truth.poses),
        ('/gps/fix', fixes.stamps_ns, fixes.values),
        ('/loop_closure', closures.later_ns, closures.values),
    ):
        np.testing.assert_array_equal([stamp for stamp, _ in seen[topic]], stamps)
        np.testing.assert_allclose([value for _, value in seen[topic]], values, atol=1e-12)
