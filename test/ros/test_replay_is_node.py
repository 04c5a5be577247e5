# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The node over DDS and the offline replay give the same path from the same bag."""

import json
from pathlib import Path

import numpy as np
import pytest
from run_schema import problems
from tum_files import read_tum

from pose_graph_ros.adapters.bags import open_bag
from pose_graph_ros.adapters.conversions import planar_pose, stamp_ns
from pose_graph_ros.cli.main import main
from pose_graph_ros.cli.simulate import write_drive
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.offline.simulation.recording import course, record
from pose_graph_ros.offline.simulation.worlds import WORLDS

pytest.importorskip('rclpy', reason='ROS 2 is not there: no rclpy')

SAME_PATH = 1e-9
"""What the two may differ by [m, rad]: both optimise until steps are below 1e-10."""


def difference(a: Trajectory, b: Trajectory) -> float:
    assert np.array_equal(a.stamps_ns, b.stamps_ns)
    delta = a.poses - b.poses
    delta[:, 2] = se2.wrap(delta[:, 2])
    return float(np.max(np.abs(delta)))


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('bags') / 'drive'
    write_drive(record(course(WORLDS['drive'], 3, 200.0)), folder)
    return folder


@pytest.mark.timeout(180)
def test_the_same_bag_gives_the_same_path(bag: Path, tmp_path: Path) -> None:
    topics = ['--odom', '/odom', '--fix', '/gps/fix', '--loop-closure', '/loop_closure',
              '--truth', '/ground_truth', '--hold-out', '5']
    assert main(['demo', '--bag', str(bag), '--rate', '0', '-o', str(tmp_path / 'node'),
                 *topics]) == 0
    assert main(['replay', str(bag), '-o', str(tmp_path / 'replay'), *topics]) == 0
    node, replay = (read_tum(tmp_path / name / 'path.tum') for name in ('node', 'replay'))
    assert len(node) > 300
    assert difference(node, replay) < SAME_PATH

    by_node, by_replay = (json.loads((tmp_path / name / 'summary.json').read_text())
                          for name in ('node', 'replay'))
    assert by_node['loop_closures'] > 0
    taken = by_node['fixes_used'] + by_node['fixes_doubted']
    assert by_node['fixes_held_out'] == pytest.approx(taken / 4, abs=1)
    rows = {row['name']: row for row in by_node['errors']}
    assert rows['corrected path to truth']['rms'] < 0.5 * rows['odometry alone to truth']['rms']
    assert rows['corrected path to truth']['median'] < rows['fixes to truth']['median']
    for row in by_replay['errors']:
        for key in ('count', 'median', 'rms', 'p95', 'maximum'):
            assert rows[row['name']][key] == pytest.approx(row[key], rel=1e-6)
    assert by_node['node']['processed'] == str(by_node['odometry'] + taken
                                               + by_node['loop_closures'])
    told, offline = (json.loads((tmp_path / name / 'run.json').read_text())
                     for name in ('node', 'replay'))
    assert list(problems(told)) == []
    assert told['subtitle'] == 'the node over DDS'
    facts = {each['label']: each['value'] for each in told['facts']}
    assert float(facts['chi2']) == pytest.approx(float(by_node['node']['chi2']), rel=1e-4)
    for table in ('fixes', 'closures'):
        for mine, other in zip(told[table], offline[table], strict=True):
            assert (mine['state'], mine['id']) == (other['state'], other['id'])
    for mine, other in zip(told['sources'], offline['sources'], strict=True):
        assert (mine['name'], mine['used']) == (other['name'], other['used'])
        assert mine['energy']['found'] == pytest.approx(other['energy']['found'], rel=0.02)
    assert 0 < len(told['updates']['t']) <= told['updates']['count']
    assert 0 <= told['updates']['t'][0] < told['updates']['t'][-1] <= told['duration']

    with open_bag(tmp_path / 'node' / 'corrected') as corrected:
        assert {'/path', '/pose', '/odometry/filtered', '/diagnostics'} <= set(corrected.topics)
        assert corrected.topics['/path'].count == 1
        published = {stamp_ns(each): planar_pose(each.pose)
                     for each in next(corrected.messages(['/path'])).decode().poses}
    assert difference(node, Trajectory(
        np.array(list(published)), np.array(list(published.values())))) < SAME_PATH
    assert (tmp_path / 'node' / 'drive.png').read_bytes().startswith(b'\x89PNG')
