# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The node over DDS and the offline replay give the same path from the same bag."""

import json
from pathlib import Path
import shutil
import subprocess
import sys

import numpy as np
import pytest

from pose_graph_ros.cli.bag_messages import odometry_messages, write_bag
from pose_graph_ros.cli.main import main
from pose_graph_ros.cli.simulate import simulate_drive, write_drive
from pose_graph_ros.core import se2
from pose_graph_ros.core.io.tum import read_tum
from pose_graph_ros.core.trajectory import Trajectory
from pose_graph_ros.ros.bag_writer import BagWriter
from pose_graph_ros.ros.bags import open_bag

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
    write_drive(simulate_drive(seed=3, duration_s=330.0), folder)
    return folder


@pytest.mark.timeout(180)
def test_the_same_bag_gives_the_same_path(bag: Path, tmp_path: Path) -> None:
    topics = ['--odom', '/odom', '--fix', '/gps/fix', '--loop-closure', '/loop_closure',
              '--truth', '/ground_truth', '--hold-out', '5']
    assert main(['demo', '--bag', str(bag), '--rate', '0', '-o', str(tmp_path / 'node'),
                 *topics]) == 0
    assert main(['replay', str(bag), '-o', str(tmp_path / 'replay'), *topics]) == 0
    node, replay = (read_tum(tmp_path / name / 'path.tum') for name in ('node', 'replay'))
    assert len(node) > 500
    assert difference(node, replay) < SAME_PATH

    by_node, by_replay = (json.loads((tmp_path / name / 'summary.json').read_text())
                          for name in ('node', 'replay'))
    assert by_node['loop_closures'] > 0
    assert by_node['fixes_held_out'] == pytest.approx(by_node['fixes_used'] / 4, abs=1)
    rows = {row['name']: row for row in by_node['errors']}
    assert rows['corrected path to truth']['rms'] < 0.5 * rows['odometry alone to truth']['rms']
    assert rows['corrected path to truth']['median'] < rows['fixes to truth']['median']
    for row in by_replay['errors']:
        for key in ('count', 'median', 'rms', 'p95', 'maximum'):
            assert rows[row['name']][key] == pytest.approx(row[key], rel=1e-6)
    assert by_node['node']['processed'] == str(by_node['odometry'] + by_node['fixes_used']
                                               + by_node['loop_closures'])
    with open_bag(tmp_path / 'node' / 'corrected') as corrected:
        assert {'/path', '/pose', '/odometry/filtered', '/diagnostics'} <= set(corrected.topics)
        assert corrected.topics['/path'].count == 1
    assert (tmp_path / 'node' / 'drive.png').read_bytes().startswith(b'\x89PNG')


def test_replay_runs_without_any_ros(bag: Path, tmp_path: Path) -> None:
    code = ("import sys; sys.modules.update(dict.fromkeys(('rclpy', 'rosidl_runtime_py')));"
            'from pose_graph_ros.cli.main import main; sys.exit(main(sys.argv[1:]))')
    done = subprocess.run(
        [sys.executable, '-c', code, 'replay', str(bag), '--odom', '/odom', '-o',
         str(tmp_path / 'out')], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / 'out' / 'path.tum').exists()


def test_a_sqlite_bag_a_lone_file_and_a_folder_give_the_same_path(
    bag: Path, tmp_path: Path,
) -> None:
    with open_bag(bag) as reader, BagWriter(tmp_path / 'sqlite', storage='sqlite3') as writer:
        for message in reader.messages(['/odom', '/gps/fix']):
            writer.write(message.topic, message.type, message.recorded_ns, message.raw)
    lone = tmp_path / 'lone.db3'
    shutil.copy(next((tmp_path / 'sqlite').glob('*.db3')), lone)
    paths = []
    for index, source in enumerate((tmp_path / 'sqlite', lone, bag)):
        out = tmp_path / str(index)
        assert main(['replay', str(source), '--odom', '/odom', '--fix', '/gps/fix',
                     '-o', str(out)]) == 0
        paths.append(read_tum(out / 'path.tum'))
    assert difference(paths[0], paths[1]) == 0.0
    # the third has loop closures, too
    assert len(paths[2]) == len(paths[0])


@pytest.mark.parametrize(('arguments', 'expected'), [
    (['no_such_bag'], 'no_such_bag'), (['{bag}', '--odom', '/no_such'], '/no_such'),
    (['{bag}', '--odom', '/gps/fix'], 'nav_msgs/msg/Odometry'), (['{bag}'], '/ground_truth'),
    (['{bag}', '--odom', '/odom', '--hold-out', '1'], 'hold out'),
    (['{bag}', '--odom', '/odom', '-p', 'frequency:=0.0'], 'frequency'),
    (['{bag}', '--odom', '/odom', '-p', 'frequency'], 'NAME:=VALUE'),
    (['{bag}', '--odom', '/odom', '--params-file', 'no.yaml'], 'no.yaml'),
    (['{bag}', '--odom', '/odom', '--truth', '/gps/fix'], '/gps/fix')])
def test_what_the_user_can_mend_is_one_line(
    bag: Path, arguments: list[str], expected: str, capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(['replay', *(word.format(bag=bag) for word in arguments)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith('error: ')
    assert expected in lines[0]


def test_a_bag_with_messages_that_cannot_be_decoded_is_replayed(tmp_path: Path) -> None:
    steps = np.arange(1, 101)
    path = Trajectory(steps * 10**9, np.column_stack((0.5 * steps, 0 * steps, 0 * steps)))
    junk = [('/odom', 'nav_msgs/msg/Odometry', step * 10**9 + 1, b'\0\1\0\0junk')
            for step in range(10, 101, 10)]
    write_bag(tmp_path / 'bag', (*odometry_messages('/odom', 'odom', path, (0.0,) * 6), *junk))
    assert main(['replay', str(tmp_path / 'bag'), '-o', str(tmp_path / 'out')]) == 0
    content = json.loads((tmp_path / 'out' / 'summary.json').read_text())
    assert content['counts'] == {'odom.accepted': 100, 'odom.malformed': 10}
    assert len(read_tum(tmp_path / 'out' / 'path.tum')) > 40
