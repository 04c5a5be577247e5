# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`pose-graph compare`: figures are those of evo, and what is wrong is said in one line."""

import json
from pathlib import Path
import subprocess
import sys
from typing import Any

from matplotlib.image import imread
import numpy as np
import pytest

from pose_graph_ros.cli.bag_messages import odometry_messages, write_bag
from pose_graph_ros.cli.main import main
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.io.tum import write_tum

HELPERS = Path(__file__).resolve().parents[1] / 'helpers'
DATA = Path(__file__).resolve().parents[3] / 'shared' / 'data' / 'robot'
START_NS = 5000 * 10**9
"""Of the time of today, evo's stamps have 0.2 us, and interpolated paths a micrometre."""
USUAL: dict[str, Any] = {
    'format': 'tum', 'align': 'none', 'max_difference': 0.01, 'offset': 0.0,
    'interpolate': False, 'delta': 1.0, 'unit': 'frames', 'all_pairs': False,
    'pairs_from_reference': False}
CASES: list[dict[str, Any]] = [
    {},
    {'align': 'se2', 'delta': 7.0},
    {'align': 'sim2', 'delta': 7.0, 'all_pairs': True},
    {'align': 'sim2', 'delta': 5.0, 'unit': 'metres'},
    {'delta': 20.0, 'unit': 'metres', 'all_pairs': True, 'interpolate': True},
    {'delta': 0.7, 'unit': 'rad', 'offset': 0.004},
    {'delta': 1.5, 'unit': 'rad', 'all_pairs': True, 'pairs_from_reference': True},
    {'align': 'se2', 'max_difference': 0.05, 'offset': -0.02, 'interpolate': True},
    {'format': 'kitti', 'align': 'sim2', 'delta': 10.0, 'unit': 'metres'},
]


def drive() -> tuple[Trajectory, Trajectory]:
    """Return the true path of a drive at 10 Hz, and an estimate at 4 Hz with jittered stamps."""
    rng = np.random.default_rng(3)
    times = np.arange(0.0, 60.0, 0.1)
    headings = np.cumsum(0.05 * np.sin(times / 4.0))
    truth = np.column_stack((np.cumsum(np.cos(headings)), np.cumsum(np.sin(headings)), headings))
    path = Trajectory(START_NS + (times * 1e9).astype(np.int64), se2.wrapped(truth))
    stamps = path.stamps_ns[0] + np.cumsum(rng.integers(230_000_000, 270_000_000, 230))
    poses = path.at(stamps) + rng.normal(size=(len(stamps), 3)) * (0.3, 0.3, 0.05)
    moved = se2.compose(np.array([4.0, -7.0, 2.0]), poses * (1.2, 1.2, 1.0))
    return path, Trajectory(stamps, moved)


def write_kitti(poses: np.ndarray, file: Path) -> Path:
    file.write_text('\n'.join(
        f'{c!r} {-s!r} 0 {x!r} {s!r} {c!r} 0 {y!r} 0 0 1 0' for x, y, c, s in np.column_stack(
            (poses[:, :2], np.cos(poses[:, 2]), np.sin(poses[:, 2]))).tolist()))
    return file


def evo(cases: list[dict[str, Any]], home: Path) -> list[dict[str, Any]]:
    """Return figures of evo, which has its settings in a folder of its own."""
    result = subprocess.run(
        [sys.executable, str(HELPERS / 'evo_figures.py'), json.dumps(cases)], text=True,
        capture_output=True, env={'HOME': str(home), 'MPLCONFIGDIR': str(home)}, check=False)
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout.splitlines()[-1])


def words_of(case: dict[str, Any]) -> list[str]:
    flags = [f'--{name.replace("_", "-")}' for name in (
        'interpolate', 'all_pairs', 'pairs_from_reference') if case[name]]
    values = [f'--{name.replace("_", "-")}={case[name]}' for name in (
        'align', 'max_difference', 'offset', 'delta', 'unit')]
    return [case['estimate'], '--truth', case['reference'], '--json', *flags, *values]


def figures(words: list[str], capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    assert main(['compare', *words]) == 0
    return json.loads(capsys.readouterr().out)


def check_against_evo(
    cases: list[dict[str, Any]], home: Path, capsys: pytest.CaptureFixture[str],
) -> None:
    for case, expected in zip(cases, evo(cases, home), strict=True):
        (found,) = figures(words_of(case), capsys)['estimates']
        for name, statistics in expected.items():
            for key, value in statistics.items():
                assert found[name][key] == pytest.approx(value, rel=1e-6, abs=1e-6), (
                    case, name, key)


def test_the_figures_are_those_of_evo(
    tmp_path: Path, capsys: pytest.CaptureFixture[str],
) -> None:
    truth, estimate = drive()
    files = {}
    for name, path in (('reference', truth), ('estimate', estimate)):
        write_tum(path, tmp_path / f'{name}.tum')
        poses = truth.at(estimate.stamps_ns) if path is truth else estimate.poses
        files[name] = {'tum': str(tmp_path / f'{name}.tum'),
                       'kitti': str(write_kitti(poses, tmp_path / f'{name}.kitti'))}
    cases = [USUAL | case for case in CASES]
    cases = [case | {name: files[name][case['format']] for name in files} for case in cases]
    swapped = {'reference': files['estimate']['tum'], 'estimate': files['reference']['tum']}
    cases.append(cases[0] | swapped)
    check_against_evo(cases, tmp_path, capsys)


def test_the_figures_of_a_lawn_mower_are_those_of_evo(
    tmp_path: Path, capsys: pytest.CaptureFixture[str],
) -> None:
    if not (DATA / 'plaza1').exists():
        pytest.skip('the public recording plaza1 is not here')
    files = {}
    for name, file in (('reference', 'gt'), ('estimate', 'odom')):
        rows = np.genfromtxt(DATA / 'plaza1' / f'{file}.csv', delimiter=',', skip_header=1)
        rows = rows[np.all(np.isfinite(rows[:, :4]), axis=1)][:800]  # evo takes long for all
        path = Trajectory((rows[:, 0] * 1e9).astype(np.int64), se2.wrapped(rows[:, 1:4]))
        write_tum(path, tmp_path / f'{name}.tum')
        files[name] = str(tmp_path / f'{name}.tum')
    check_against_evo([USUAL | files | case for case in (
        {'align': 'se2'}, {'align': 'sim2', 'delta': 50.0, 'unit': 'metres'},
        {'align': 'se2', 'delta': 3.0, 'unit': 'rad', 'interpolate': True})], tmp_path, capsys)


@pytest.fixture
def paths(tmp_path: Path) -> Path:
    """Return a folder with a truth, a run without and one with covariances, and a bag."""
    truth, _ = drive()
    rng = np.random.default_rng(4)
    noisy = Trajectory(truth.stamps_ns, truth.poses + rng.normal(
        size=truth.poses.shape) * (0.3, 0.3, 0.05))
    write_tum(truth, tmp_path / 'truth.tum')
    for name in ('demo', 'replay'):
        (tmp_path / name).mkdir()
        write_tum(noisy, tmp_path / name / 'path.tum')
    rows = [f'{stamp / 1e9:.9f},{x!r},{y!r},{yaw!r},0.09,0,0,0.09,0,0.0025' for stamp, (x, y, yaw)
            in zip(noisy.stamps_ns.tolist(), noisy.poses.tolist(), strict=True)]
    (tmp_path / 'replay' / 'path.csv').write_text(
        '\n'.join(['stamp,x,y,yaw,xx,xy,xyaw,yy,yyaw,yawyaw', *rows]))
    write_bag(tmp_path / 'bag', odometry_messages('/odom', 'odom', noisy, [0.0] * 6))
    return tmp_path


def test_folders_of_runs_and_topics_of_bags_are_trajectories(
    paths: Path, capsys: pytest.CaptureFixture[str],
) -> None:
    found = figures([str(paths / 'truth.tum'), str(paths / 'demo'), str(paths / 'replay'),
                     f'{paths / "bag"}:/odom', '--json'], capsys)
    assert (found['reference_poses'], found['align'], found['unit']) == (600, 'none', 'frames')
    demo, replay, odom = found['estimates']
    for estimate in (demo, replay, odom):
        assert (estimate['poses'], estimate['associated']) == (600, 600)
        assert estimate['ate']['rmse'] == pytest.approx(np.hypot(0.3, 0.3), rel=0.05)
        assert estimate['ate'] == {key: pytest.approx(value, rel=1e-9)
                                   for key, value in demo['ate'].items()}
        assert estimate['alignment'] == {'x': 0.0, 'y': 0.0, 'theta': 0.0, 'scale': 1.0}
    for name, dimension in (('nees_position', 2), ('nees_pose', 3)):
        assert name not in demo
        assert odom[name] is None  # all covariances of this bag are zero
        assert replay[name]['expected'] == dimension
        assert replay[name]['interval'][0] < replay[name]['mean'] < replay[name]['interval'][1]
        assert replay[name]['within'] == pytest.approx(0.95, abs=0.03)


def test_the_table_is_aligned_and_says_what_would_help(
    paths: Path, capsys: pytest.CaptureFixture[str],
) -> None:
    _, estimate = drive()
    write_tum(estimate, paths / 'moved.tum')
    words = [str(paths / name) for name in ('truth.tum', 'moved.tum', 'replay')]
    assert main(['compare', *words]) == 0
    text = capsys.readouterr().out
    assert '(--align se2)' in text
    assert 'errors\nalong one path are not independent' in text
    lines = [line for line in text.splitlines() if line.startswith(('ATE', 'RPE', '...'))]
    assert len({len(line) for line in lines[:4]}) == 1
    assert max(map(len, lines)) < 90
    assert text.count('RPE [m], over 1 frames') == 1
    assert main(['compare', *words, '--align', 'sim2']) == 0
    text = capsys.readouterr().out
    assert 'scaled by 0.8' in text
    assert '(--align' not in text


def test_the_picture_has_all_paths_and_their_errors(
    paths: Path, capsys: pytest.CaptureFixture[str],
) -> None:
    write_tum(drive()[1], paths / 'moved.tum')
    words = [str(paths / name) for name in ('truth.tum', 'moved.tum', 'replay')]
    assert main(['compare', *words, '--align=se2', '--plot', str(paths / 'errors.png')]) == 0
    pixels = imread(paths / 'errors.png')
    assert pixels.shape[:2] == (850, 1600)
    for half in (pixels[:, :700], pixels[:, 850:]):
        for colour in ('0072B2', 'D55E00'):
            rgb = [int(colour[k:k + 2], 16) / 255 for k in (0, 2, 4)]
            assert np.sum(np.all(np.abs(half[..., :3] - rgb) < 0.02, axis=-1)) > 20


def test_its_help_has_examples(paths: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['compare', str(paths / 'demo'), str(paths / 'replay')]) == 0
    assert 'NEES of the pose ' in capsys.readouterr().out
    with pytest.raises(SystemExit, match='0'):
        main(['compare', '--help'])
    assert 'examples:\n  pose-graph compare replay --truth truth.tum' in capsys.readouterr().out


@pytest.mark.parametrize(('words', 'message'), [
    (['demo'], 'demo: nothing to compare it with'),
    (['truth.tum', 'nowhere.tum'], 'nowhere.tum: does not exist'),
    (['truth.tum', '.'], 'no folder of a replay or a demo'),
    (['truth.tum', 'bag'], 'bag: name a topic of the bag, as .*; it has /odom (nav_msgs'),
    (['truth.tum', 'bag:/gps'], 'no topic /gps; expected one of'),
    (['truth.tum', 'nowhere:/gps'], 'nowhere: does not exist'),
    (['truth.tum', 'demo', '--offset', '900'], 'truth.tum and .*demo: no stamps are within'),
    (['truth.tum', 'broken.tum'], 'broken.tum:2: expected 8 values, got 3'),
    (['truth.tum', 'demo', '--delta', '1.5'], 'delta: expected a whole number of frames'),
    (['truth.tum', 'demo', '--unit', 'metres', '--delta', 'nan'], 'delta: expected a finite'),
    (['truth.tum', 'demo', '--plot', 'a.txt'], 'a.txt: the name must end in .png'),
])
def test_what_is_wrong_is_said_in_one_line(
    words: list[str], message: str, paths: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(paths)
    (paths / 'broken.tum').write_text('0 0 0 0 0 0 0 1\n1 2 3\n')
    assert main(['compare', *words]) == 2
    printed = capsys.readouterr()
    assert printed.out == ''
    assert printed.err.count('\n') == 1
    for part in message.split('.*'):
        assert part in printed.err


@pytest.mark.parametrize('words', [
    ['--offset', 'nan'], ['--offset', '1e300'], ['--max-difference', '-1'],
    ['--max-difference', 'inf'], ['--align', 'so3'], ['--delta', 'one']])
def test_options_that_are_none_are_refused(
    words: list[str], capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit, match='2'):
        main(['compare', 'a', 'b', *words])
    assert f'argument {words[0]}: ' in capsys.readouterr().err


def test_poses_with_a_stamp_twice_are_told(
    paths: Path, capsys: pytest.CaptureFixture[str],
) -> None:
    file = paths / 'truth.tum'
    file.write_text(file.read_text() + file.read_text().splitlines()[-1] + '\n')
    assert main(['compare', str(file), str(paths / 'demo'), '--json']) == 0
    printed = capsys.readouterr()
    assert printed.err.endswith('truth.tum: 1 poses have the stamp of another and are left out\n')
    json.loads(printed.out)
