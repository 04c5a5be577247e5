# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Accuracy on recordings of real robots, where they are there.

One goes through the node and one through replay; that both give the same path is tested elsewhere.
The recordings are not part of the project; see `public_data`.
"""

import json
from pathlib import Path

from bag_of_messages import write_bag
import numpy as np
from public_data import needs, PUBLIC
import pytest
from tum_files import read_tum

from pose_graph_ros.cli.main import main
from pose_graph_ros.cli.simulate import fix_messages, odometry_messages
from pose_graph_ros.core.geometry.geodesy import TangentPlane
from pose_graph_ros.core.geometry.trajectory import Trajectory

HUSKY, PLAZA = PUBLIC / 'robot/husky_test1_ros2', PUBLIC / 'robot/plaza1'
DATUM = (40.44, -79.94)
"""Where the fixes of plaza1 are placed; anywhere would do."""


@needs('robot/husky_test1_ros2')
@pytest.mark.timeout(180)
def test_husky_ends_near_the_fixes_that_it_got_and_those_that_it_did_not(tmp_path: Path) -> None:
    assert main(['replay', str(HUSKY), '--odom', '/husky_velocity_controller/odom',
                 '--fix', '/fix', '--hold-out', '5', '-o', str(tmp_path)]) == 0
    content = json.loads((tmp_path / 'summary.json').read_text())
    rows = {row['name']: row for row in content['errors']}
    assert rows['corrected path to fixes used']['median'] <= 1.1
    assert rows['corrected path to fixes held out']['median'] <= 1.3
    assert rows['corrected path to fixes held out']['count'] >= 190


@needs('robot/husky_test1_ros2')
def test_husky_with_its_imu_that_is_not_level_is_told(tmp_path: Path) -> None:
    assert main(['replay', str(HUSKY), '-o', str(tmp_path), '-p', 'sources:=[odom, fix, gyro]',
                 '-p', 'gyro.mounting:=up']) == 0
    findings = json.loads((tmp_path / 'run.json').read_text())['findings']
    assert any('does not turn' in each['text'] and each['anchor'] == 'source-gyro'
               and each['level'] == 'warning' for each in findings)


@pytest.fixture(scope='module')
def plaza(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Trajectory]:
    """Return a bag with odometry and fixes of 1 m at 1 Hz, and the truth at the odometry."""
    odometry = np.loadtxt(PLAZA / 'odom.csv', delimiter=',', skiprows=1)
    truth = np.loadtxt(PLAZA / 'gt.csv', delimiter=',', skiprows=1)
    times = np.arange(odometry[0, 0] + 0.37, odometry[-1, 0], 1.0)
    times = times[(times > truth[0, 0]) & (times < truth[-1, 0])]
    positions = np.column_stack([np.interp(times, truth[:, 0], truth[:, k]) for k in (1, 2)])
    positions += np.random.default_rng(7).normal(0.0, 1.0, positions.shape)
    geodetic = TangentPlane(*DATUM).to_geodetic(positions)

    stamps = np.round(odometry[:, 0] * 1e9).astype(np.int64)
    folder = tmp_path_factory.mktemp('plaza') / 'bag'
    write_bag(folder, (
        *odometry_messages('/odom', 'odom', Trajectory(stamps, odometry[:, 1:4]), (0.0,) * 6),
        *fix_messages('/fix', np.round(times * 1e9).astype(np.int64), geodetic, sigma=1.0)))
    return folder, Trajectory(
        np.round(truth[:, 0] * 1e9).astype(np.int64),
        np.column_stack((truth[:, 1:3], np.zeros(len(truth)))))


@needs('robot/plaza1')
@pytest.mark.timeout(180)
def test_plaza_is_within_35_cm_of_the_truth(
    plaza: tuple[Path, Trajectory], tmp_path: Path,
) -> None:
    bag, truth = plaza
    assert main(['replay', str(bag), '-p', f'datum:=[{DATUM[0]}, {DATUM[1]}]',
                 '-o', str(tmp_path)]) == 0
    path = read_tum(tmp_path / 'path.tum')
    inside = truth.covers(path.stamps_ns)
    assert np.mean(inside) > 0.99
    error = path.poses[inside, :2] - truth.at(path.stamps_ns[inside])[:, :2]
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) <= 0.35
