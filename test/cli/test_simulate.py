# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The simulated drive: its sensors err as promised, its bag says what the drive says."""

from pathlib import Path

import numpy as np
import pytest

from pose_graph_ros.adapters.bags import open_bag
from pose_graph_ros.cli.simulate import simulate_drive, write_drive
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.offline.simulation.settings import Fixes

OLD = Path(__file__).parents[1] / 'data' / 'drive_2.npz'
FIX_SIGMA = Fixes().sigma


def test_the_drive_is_the_one_of_the_first_version() -> None:
    # every 50th or 500th number of what the first version made, and all of its fixes and closures
    drive, old = simulate_drive(2, gyro=True, heading_drift=0.002), np.load(OLD)
    for name in ('fix_stamps_ns', 'loop_stamps_ns', 'fix_is_wrong', 'loop_is_false'):
        np.testing.assert_array_equal(getattr(drive, name), old[name])
    for name, path in (('odometry', drive.odometry), ('truth', drive.truth)):
        np.testing.assert_array_equal(path.stamps_ns[::50], old[f'{name}_stamps_ns'])
        np.testing.assert_allclose(path.poses[::50], old[name], rtol=0.0, atol=1e-9)
    np.testing.assert_array_equal(drive.rate_stamps_ns[::500], old['rate_stamps_ns'])
    np.testing.assert_allclose(drive.rates[::500], old['rates'], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(drive.fixes[:, :2], old['fixes'][:, :2], rtol=0.0, atol=1e-12)
    # heights may differ by the rounding of geocentric coordinates, as from one PROJ to another
    np.testing.assert_allclose(drive.fixes[:, 2], old['fixes'][:, 2], rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(drive.loop_poses, old['loop_poses'], rtol=0.0, atol=1e-9)


def test_the_bag_says_what_the_drive_says(tmp_path) -> None:
    drive = simulate_drive(duration_s=200.0)
    write_drive(drive, tmp_path / 'drive')
    seen: dict[str, list[tuple[int, tuple[float, ...]]]] = {}
    with open_bag(tmp_path / 'drive') as bag:
        for record in bag.messages(bag.topics):
            message = record.decode()
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            assert stamp < record.recorded_ns < stamp + 10**9
            if record.topic == '/gps/fix':
                value = (message.latitude, message.longitude, message.altitude)
                assert message.status.status == 0
                assert message.position_covariance[0] == pytest.approx(FIX_SIGMA**2)
            else:
                pose = message.pose.pose
                theta = 2.0 * np.arctan2(pose.orientation.z, pose.orientation.w)
                value = (pose.position.x, pose.position.y, float(se2.wrap(theta)))
            seen.setdefault(record.topic, []).append((stamp, value))
            if record.topic == '/loop_closure':
                second, _, fraction = message.header.frame_id[1:].partition('.')
                assert message.header.frame_id.startswith('@')
                assert len(fraction) == 9
                assert int(second + fraction) in drive.loop_stamps_ns[:, 0]

    for topic, stamps, values in (
        ('/odom', drive.odometry.stamps_ns, drive.odometry.poses),
        ('/ground_truth', drive.truth.stamps_ns, drive.truth.poses),
        ('/gps/fix', drive.fix_stamps_ns, drive.fixes),
        ('/loop_closure', drive.loop_stamps_ns[:, 1], drive.loop_poses),
    ):
        np.testing.assert_array_equal([stamp for stamp, _ in seen[topic]], stamps)
        np.testing.assert_allclose([value for _, value in seen[topic]], values, atol=1e-12)
