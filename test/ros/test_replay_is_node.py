# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The node over DDS and the offline replay give the same path from the same bag."""

from collections.abc import Iterable, Iterator
import json
from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys import get_typestore, Stores
from run_schema import problems
from tum_files import read_tum

from pose_graph_ros.adapters.bags import open_bag
from pose_graph_ros.cli.bag_messages import (
    fix_messages,
    Message,
    odometry_messages,
    write_bag,
)
from pose_graph_ros.cli.main import main
from pose_graph_ros.cli.simulate import simulate_drive, write_drive
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.geodesy import TangentPlane
from pose_graph_ros.core.geometry.trajectory import Trajectory

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
    write_drive(simulate_drive(seed=3, duration_s=200.0), folder)
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
    assert (tmp_path / 'node' / 'drive.png').read_bytes().startswith(b'\x89PNG')


SOURCES = """
/**:
  ros__parameters:
    sources: [odom, visual, fix, rear, imu]
    visual: {type: odometry, topic: vo, noise: twist, time_offset: 0.02}
    fix: {robust_loss: huber, covariance_scale: 2.0}
    rear: {type: fix, topic: /rear/fix, lever_arm: [-0.5, 0.25], robust_loss: cauchy}
    imu: {covariance_override: [1.0, 0.2], yaw_offset: 0.1}
"""
ANTENNA = np.array([0.75, -0.25])


def delayed(messages: Iterable[Message], latency_ns: int) -> Iterator[Message]:
    """Let messages be recorded so long after their stamps."""
    for topic, type_name, stamp_ns, message in messages:
        yield topic, type_name, stamp_ns + latency_ns, message


def write_rich_drive(folder: Path) -> None:
    """A drive with two odometries, two receivers, one of them lifted by /tf_static, and an imu."""
    generator = np.random.default_rng(8)
    plane = TangentPlane(50.7, 7.1, 60.0)
    stamps = 1_700_000_000 * 10**9 + np.arange(0, 60 * 10**9, 10**8)
    angle = np.arange(len(stamps)) * 0.02
    truth = np.column_stack((30.0 * np.sin(angle), 30.0 * (1.0 - np.cos(angle)), angle))

    def drifted(scale: float) -> Trajectory:
        steps = se2.between(truth[:-1], truth[1:]) * scale
        steps += generator.normal(0.0, (0.01, 0.01, 0.002), steps.shape)
        poses = [np.array([1.0, 2.0, 3.0 * scale])]
        for step in steps:
            poses.append(se2.compose(poses[-1], step))
        return Trajectory(stamps, np.array(poses))

    def geodetic(arm: np.ndarray) -> np.ndarray:
        places = se2.transform(truth[::5], arm) + generator.normal(0.0, 0.5, (len(truth[::5]), 2))
        return plane.to_geodetic(places, 60.0)

    types = get_typestore(Stores.ROS2_JAZZY).types
    time, header = types['builtin_interfaces/msg/Time'], types['std_msgs/msg/Header']
    vector, quaternion = (types[f'geometry_msgs/msg/{name}'] for name in ('Vector3', 'Quaternion'))
    transform = types['geometry_msgs/msg/TransformStamped'](
        header(time(0, 0), 'base_link'), 'gps', types['geometry_msgs/msg/Transform'](
            vector(*ANTENNA.tolist(), 1.0), quaternion(0.0, 0.0, 0.0, 1.0)))
    frames = types['tf2_msgs/msg/TFMessage']([transform])
    covariance = 0.01 * np.eye(3).ravel()
    headings = [('/imu/data', 'sensor_msgs/msg/Imu', stamp, types['sensor_msgs/msg/Imu'](
        header(time(*divmod(stamp, 10**9)), 'imu'),
        quaternion(0.0, 0.0, np.sin(0.5 * theta - 0.05), np.cos(0.5 * theta - 0.05)), covariance,
        vector(0.0, 0.0, 0.0), covariance, vector(0.0, 0.0, 0.0), covariance))
        for stamp, theta in zip(stamps[::10].tolist(), angle[::10].tolist(), strict=True)]
    variances = (1e-3, 1e-3, 1e6, 1e6, 1e6, 1e-3)
    write_bag(folder, (
        *odometry_messages('/odom', 'odom', drifted(1.01), variances),
        *delayed(odometry_messages('/vo', 'vo', drifted(0.99), variances), 30_000_000),
        *delayed(fix_messages('/gps/fix', stamps[::5], geodetic(ANTENNA), 0.5), 10**8),
        *delayed(fix_messages('/rear/fix', stamps[::5], geodetic(np.array([-0.5, 0.25])), 0.5),
                 2 * 10**8),
        ('/tf_static', 'tf2_msgs/msg/TFMessage', int(stamps[300]), frames), *headings))


@pytest.mark.timeout(180)
def test_many_sources_from_a_file_give_the_same_path(tmp_path: Path) -> None:
    pytest.importorskip('tf2_msgs', reason='tf2_msgs is not built: the node gets no /tf_static')
    write_rich_drive(tmp_path / 'bag')
    (tmp_path / 'params.yaml').write_text(SOURCES, encoding='utf-8')
    arguments = ['--odom', '/odom', '--fix', '/gps/fix', '--params-file',
                 str(tmp_path / 'params.yaml')]
    assert main(['demo', '--bag', str(tmp_path / 'bag'), '--rate', '0', '-o',
                 str(tmp_path / 'node'), *arguments]) == 0
    assert main(['replay', str(tmp_path / 'bag'), '-o', str(tmp_path / 'replay'), *arguments]) == 0
    node, replay = (read_tum(tmp_path / name / 'path.tum') for name in ('node', 'replay'))
    assert len(node) > 50
    assert difference(node, replay) < SAME_PATH
    by_node, by_replay = (json.loads((tmp_path / name / 'summary.json').read_text())
                          for name in ('node', 'replay'))
    counts = by_replay['counts']
    for name, count in (('odom', 600), ('visual', 600), ('fix', 120), ('rear', 120), ('imu', 60)):
        assert counts[f'{name}.accepted'] == count
        assert by_node['node'][f'{name}.accepted'] == str(count)
    assert by_node['node']['fix.lever_arm'] == '[0.750, -0.250] from tf_static'
    rows = {row['name']: row for row in by_replay['errors']}
    assert rows['corrected path to fixes used']['median'] < 0.7
    assert rows['corrected path to fixes used']['count'] == 240
