# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `pose-graph simulate`: what its options write, and that replay reads all of it."""

from collections import Counter
import json
from pathlib import Path

import numpy as np
import pytest

from pose_graph_ros.adapters.bags import open_bag
from pose_graph_ros.cli.main import main
from pose_graph_ros.core.io.g2o import read_g2o

ALL = ('--gyro', '--fix', '--global-pose', '2', '--closures', '1')
TOPICS = {'odom': '/odom', 'gyro': '/imu/data', 'fix': '/gps/fix', 'global_pose': '/global_pose',
          'loop_closure': '/loop_closure'}


def simulate(*words: str | Path) -> None:
    assert main(['simulate', *map(str, words)]) == 0


def about(path: Path) -> dict:
    name = path.stem if path.suffix == '.g2o' else path.name
    return json.loads(path.with_name(f'{name}_truth.json').read_text(encoding='ascii'))


@pytest.mark.parametrize('world', ['drive', 'hall', 'grid'])
def test_equal_options_write_equal_bytes(world, tmp_path) -> None:
    words = ('--world', world, '--duration', '60', *ALL, '--delay', '/odom:0.1:0.3',
             '--duplicate', '/gps/fix:0.3', '--tum')
    for folder, seed in (('a', '7'), ('b', '7'), ('c', '8')):
        simulate(tmp_path / folder / 'bag', *words, '--seed', seed)
        simulate(tmp_path / folder / 'graph.g2o', '--world', world, '--duration', '60',
                 '--seed', seed)
    files = [path.relative_to(tmp_path / 'a') for path in sorted((tmp_path / 'a').rglob('*'))
             if path.is_file()]
    assert len(files) == 7
    for file in files:
        a, b, c = ((tmp_path / folder / file).read_bytes() for folder in 'abc')
        assert a == b
        assert a != c or file.suffix == '.yaml'


@pytest.fixture(scope='module')
def disturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a bag with everything that can be in one."""
    folder = tmp_path_factory.mktemp('disturbed') / 'bag'
    simulate(folder, '--world', 'hall', '--duration', '240', *ALL, '--false-groups', '1:3',
             '--false-rate', '0.25', '--odometry', 'model',
             '--fix-sigma', '0.2', '--fix-correlated', '0.5,20', '--fix-period', '1',
             '--outage', '/gps/fix:100:130', '--outage', '/global_pose:50:200',
             '--jump', '/odom:150:2,0,0.1', '--jump', '/gps/fix:200:9,9:20',
             '--delay', '/gps/fix:1.5:2.5', '--delay', '/loop_closure:3',
             '--duplicate', '/global_pose:0.5', '--duplicate', '/loop_closure:0.3',
             '--clock-offset', '/imu/data:0.02', '--claimed-sigma', '/gps/fix:0.5', '--tum')
    return folder


def test_the_bag_has_what_was_asked_for(disturbed) -> None:
    truth = about(disturbed)
    counts, stamps, sigmas = Counter[str](), dict[str, list[int]](), dict[str, float]()
    late = dict[str, list[float]]()
    with open_bag(disturbed) as bag:
        for record in bag.messages(bag.topics):
            message = record.decode()
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            counts[record.topic] += 1
            stamps.setdefault(record.topic, []).append(stamp)
            late.setdefault(record.topic, []).append((record.recorded_ns - stamp) * 1e-9)
            if record.topic == '/gps/fix':
                sigmas['fix'] = message.position_covariance[0]**0.5
            if record.topic == '/global_pose':
                sigmas['pose'] = message.pose.covariance[0]**0.5
                sigmas['heading'] = message.pose.covariance[35]**0.5
            if record.topic == '/loop_closure':
                sigmas['closure'] = message.pose.covariance[0]**0.5
            if record.topic == '/imu/data':
                sigmas['rate'] = message.angular_velocity_covariance[8]**0.5
    assert dict(counts) == truth['topics']
    assert sigmas == pytest.approx({
        'fix': 0.5 * np.hypot(0.2, 0.5), 'pose': 0.1, 'heading': 0.02, 'closure': 0.05,
        'rate': 5e-3})
    assert late['/odom'] == pytest.approx([0.004] * counts['/odom'])
    assert late['/imu/data'] == pytest.approx([0.002 - 0.02] * counts['/imu/data'])
    assert 1.5 <= min(late['/gps/fix']) < max(late['/gps/fix']) <= 4.0
    assert min(late['/loop_closure']) == pytest.approx(3.0)
    assert stamps['/gps/fix'] != sorted(stamps['/gps/fix'])
    for outage in truth['outages']:
        inside = [stamp for stamp in stamps[outage['topic']]
                  if outage['begin_ns'] <= stamp < outage['end_ns']]
        assert len(inside) == 0 < outage['left_out']
    # false closures by their stamps, as the messages have them
    false = truth['false_closures']
    assert {each['stamps_ns'][1] for each in false} <= set(stamps['/loop_closure'])
    groups = Counter(each['group'] for each in false)
    assert groups[0] == 3
    assert len(false) / (len(false) + truth['true_closures']) == pytest.approx(0.25, abs=0.05)
    assert set(truth['wrong_fixes_ns']) <= set(stamps['/gps/fix'])
    assert len(truth['wrong_fixes_ns']) == 20
    odometry, fixes = truth['jumps']
    assert odometry == {'topic': '/odom', 'at_ns': truth['start_ns'] + 150 * 10**9,
                        'end_ns': None, 'step': [2.0, 0.0, 0.1]}
    assert fixes['end_ns'] - fixes['at_ns'] == 20 * 10**9


def test_replay_reads_all_of_it(disturbed, tmp_path) -> None:
    words = [word for name, topic in TOPICS.items()
             for word in (f'--{name.replace("_", "-")}', topic)]
    assert main(['replay', str(disturbed), '-o', str(tmp_path / 'run'), *words, '-p',
                 'sources:=[odom, global_pose, fix, gyro]', '--truth', '/ground_truth']) == 0
    counts = json.loads((tmp_path / 'run' / 'summary.json').read_text())['counts']
    truth = about(disturbed)
    for name, topic in TOPICS.items():
        read = counts[f'{name}.accepted'] + counts.get(f'{name}.duplicate_stamp', 0)
        assert read == truth['topics'][topic], name


def read_tum(path: Path) -> np.ndarray:
    rows = np.loadtxt(path)
    return np.column_stack((rows[:, 1:3], 2.0 * np.arctan2(rows[:, 6], rows[:, 7])))


def test_a_graph_and_its_truth_have_the_same_ids_and_constraints(tmp_path) -> None:
    path = tmp_path / 'graph.g2o'
    simulate(path, '--world', 'grid', '--duration', '300', '--closures', '1', '--false-rate',
             '0.3', '--false-groups', '2:5', '--fix-sigma', '0.5', '--tum')
    start, truth = read_g2o(path), read_g2o(tmp_path / 'graph_truth.g2o')
    np.testing.assert_array_equal(start.ids, truth.ids)
    np.testing.assert_array_equal(start.graph.factors.edges.mean, truth.graph.factors.edges.mean)
    said = about(path)
    assert truth.graph.energies().chi2 == pytest.approx(said['chi2_of_the_truth'])
    assert len(truth.ids) == said['nodes']
    assert len(truth.graph.factors.edges) == said['edges']
    assert len(truth.graph.factors.observed) == said['observed_nodes'] > 100
    factors = truth.graph.factors
    pairs = set(zip(factors.i.tolist(), factors.j.tolist(), strict=True))
    false = [tuple(each['ids']) for each in said['false_closures']]
    assert set(false) <= pairs
    assert len(set(false)) == len(false)
    assert len(false) >= 10
    tum = read_tum(tmp_path / 'graph_truth.tum')
    np.testing.assert_allclose(tum, truth.graph.poses, atol=1e-12)


@pytest.mark.parametrize('out', ['bag', 'graph.g2o'])
def test_a_map_is_drawn(out, tmp_path, capsys) -> None:
    words = ('--world', 'grid', '--duration', '300', '--fix', '--jump', '/gps/fix:50:9,9',
             '--closures', '1', '--false-rate', '0.5')
    simulate(tmp_path / out, *words, '--plot', tmp_path / 'map.svg')
    text = (tmp_path / 'map.svg').read_text(encoding='utf-8')
    for name in ('odometry alone', 'truth', 'false loop closures', 'fixes moved by a jump',
                 'grid, seed 1'):
        assert name in text
    capsys.readouterr()
    assert main(['simulate', str(tmp_path / 'other'), '--plot', 'map.txt']) == 2
    assert capsys.readouterr().err == (
        'error: --plot map.txt: the name must end in .png, .pdf, .svg\n')


def test_the_outage_and_the_jump_of_the_drive_can_be_taken_away(tmp_path) -> None:
    simulate(tmp_path / 'bag', '--duration', '340', '--outage', '/gps/fix:none', '--jump',
             '/gps/fix:none', '--false-rate', '0')
    truth = about(tmp_path / 'bag')
    assert truth['outages'] == truth['jumps'] == truth['false_closures'] == []
    assert truth['wrong_fixes_ns'] == []
    assert truth['topics']['/gps/fix'] == pytest.approx(680, abs=1)


@pytest.mark.parametrize(('words', 'expected'), [
    (['--outage', '/gps/fix:10'], "expected TOPIC:FROM:TO, got '/gps/fix:10'"),
    (['--outage', '/gps/fix:20:10'], 'expected an end after 20 s, got 10 s'),
    (['--outage', '/nix:1:2'], 'expected a topic of /odom, /imu/data'),
    (['--jump', '/odom:5:1'], "expected TOPIC:AT:DX,DY[,RAD][:FOR], got '/odom:5:1'"),
    (['--delay', '/odom:nan'], 'expected a number that is not negative, got nan'),
    (['--duration', '5'], 'argument --duration: expected a number of at least 10'),
    (['--closures', '2'], "expected a number of at least 0 and at most 1, got '2'"),
    (['--seed', '-1'], "argument --seed: expected a whole number of at least 0, got '-1'"),
    (['--false-groups', '2:1'], "expected groups of at least 2, got '2:1'"),
    (['--fix-correlated', '1'], "expected 2 numbers with commas between them, got '1'"),
])
def test_words_that_cannot_be_read_are_named(words, expected, tmp_path, capsys) -> None:
    with pytest.raises(SystemExit) as ended:
        main(['simulate', str(tmp_path / 'bag'), *words])
    assert ended.value.code == 2
    usage, line = capsys.readouterr().err.splitlines()
    assert usage == 'usage: pose-graph simulate OUT [options]'
    assert expected in line
    assert not (tmp_path / 'bag').exists()


@pytest.mark.parametrize(('out', 'words', 'expected'), [
    ('bag', ['--world', 'hall', '--outage', '/gps/fix:1:2'],
     'error: --outage /gps/fix: nothing is simulated there, expected one of /odom, /loop_closure'),
    ('bag', ['--no-fix', '--fix-sigma', '1'], 'error: --no-fix: expected no other option'),
    ('bag', ['--node-distance', '1'], 'error: --node-distance: only a graph has nodes'),
    ('bag', ['--false-rate', '0.1', '--false-groups', '9:9'], 'error: 9 groups of 9 false'),
    ('a.g2o', ['--gyro'], 'error: --gyro: only a bag has it'),
    ('a.g2o', ['--outage', '/odom:1:2'], 'error: --outage /odom: a graph cannot do without'),
    ('a.g2o', ['--node-distance', '1e9'], 'error: distance of nodes: expected less than'),
    ('no/such/a.g2o', ['--duration', '20', '--jump', '/odom:1:reset'], 'error: jump of /odom'),
    ('file/a.g2o', ['--duration', '20'], 'error: '),
])
def test_what_cannot_be_simulated_is_one_line(out, words, expected, tmp_path, capsys) -> None:
    (tmp_path / 'file').write_text('')
    assert main(['simulate', str(tmp_path / out), *words]) == 2
    line, = capsys.readouterr().err.splitlines()
    assert line.startswith(expected)
    assert [path.name for path in tmp_path.iterdir()] == ['file']
