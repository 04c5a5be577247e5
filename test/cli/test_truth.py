# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The truth from a file, in the tools that compare with one."""

import json
from pathlib import Path

from bag_of_messages import write_bag
from circle_bag import circle, fixes, odometry
import numpy as np
import pytest

from pose_graph_ros.cli.main import main
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.geodesy import TangentPlane
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.io.path_files import csv_lines, read_path, seconds_text, write_tum

T0 = 1_700_000_000


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('truth') / 'bag'
    write_bag(folder, (*odometry(), *fixes(np.zeros(2))))
    return folder


def write_truth(path: Path, form: str, moved: tuple[float, float, float] = (0, 0, 0)) -> Path:
    """Write the circle, in a map of its own, in one of the forms that are read."""
    truth = Trajectory(circle().stamps_ns, se2.compose(np.array(moved), circle().poses))
    times = [seconds_text(stamp) for stamp in truth.stamps_ns.tolist()]
    rows = [*zip(times, truth.poses.tolist(), strict=True)]
    if form == 'tum':
        write_tum(truth, path)
        path.write_text('\n# made by hand\n' + path.read_text())
    elif form == 'own csv':
        path.write_text('\n'.join(csv_lines(truth, np.full((len(truth), 3, 3), np.nan))))
    elif form == 'plain csv':   # also backwards
        path.write_text('# a robot\n#Time [s], y[m], x (m), note, theta\n' + ''.join(
            f'{time}, {y}, {x}, a, {yaw}\n' for time, (x, y, yaw) in rows[::-1]))
    else:
        places = TangentPlane(50.7, 7.1, 60.0).to_geodetic(truth.poses[:, :2], 60.0)
        path.write_text('timestamp,lat,lon\n' + ''.join(
            f'{time},{lat!r},{lon!r}\n' for time, (lat, lon, _) in zip(
                times, places.tolist(), strict=True)))
    return path


def errors(capsys: pytest.CaptureFixture[str], *words: object) -> dict[str, float]:
    capsys.readouterr()
    assert main(['replay', *map(str, words), '--json']) == 0
    return {row['name']: row['rms'] for row in json.loads(capsys.readouterr().out)['errors']}


@pytest.mark.parametrize('form', ['tum', 'own csv', 'plain csv', 'csv on the Earth'])
def test_a_file_is_the_truth_aligned_or_not(bag, form, tmp_path, capsys) -> None:
    suffix = '.txt' if form == 'tum' else '.csv'
    here = write_truth(tmp_path / f'here{suffix}', form)
    away = write_truth(tmp_path / f'away{suffix}', form, (3.0, 4.0, 0.0))
    words = bag, '-o', tmp_path / 'out', '--truth'
    # whether a path in a map is aligned does not depend on the form of its file
    both = () if form.endswith(' csv') else ((here, (), 0.0), (away, ('--no-align',), 5.0))
    for file, options, expected in (
            *both, (here, ('--no-align',), 0.0), (away, ('--align',), 0.0)):
        found = errors(capsys, *words, file, *options)
        assert found['corrected path to truth'] == pytest.approx(expected, abs=0.02)
        assert ('corrected heading to truth' in found) == (form != 'csv on the Earth')
    facts = json.loads((tmp_path / 'out' / 'summary.json').read_text())
    assert facts['nees_position']['count'] > 0
    assert (facts['nees_pose'] is None) == (form == 'csv on the Earth')


@pytest.mark.parametrize('tool', ['replay', 'report', 'tune'])
def test_a_file_of_other_times_is_one_line_with_both(bag, tool, tmp_path, capsys) -> None:
    file = tmp_path / 'truth.tum'
    file.write_text('5 0 0 0 0 0 0 1\n7.5 1 0 0 0 0 0 1\n')
    assert main([tool, str(bag), '--run' if tool == 'report' else '-o', str(tmp_path / 'out'),
                 '--truth', str(file)]) == 2
    assert capsys.readouterr().err == (
        f'error: {file}: has times from 5.000000000 to 7.500000000 s, none of them in those of '
        f'the path, from {T0}.000000000 to {T0 + 39}.900000000 s\n')


def test_two_poses_fit_any_path_so_they_are_not_aligned(bag, tmp_path, capsys) -> None:
    file = tmp_path / 'truth.tum'
    file.write_text(f'{T0 + 5} 0 0 0 0 0 0 1\n{T0 + 15} 1 0 0 0 0 0 1\n')
    words = 'replay', str(bag), '-o', str(tmp_path / 'out'), '--truth', str(file)
    assert main([*words]) == 2
    assert 'truth.tum: expected at least 3 poses in the time' in capsys.readouterr().err
    assert main([*words, '--no-align']) == 0


def test_nothing_is_compared_where_the_truth_has_a_hole(bag, tmp_path, capsys) -> None:
    file, out = write_truth(tmp_path / 'truth.tum', 'tum'), tmp_path / 'out'
    file.write_text(''.join(
        line for line in file.read_text().splitlines(keepends=True)
        if line[0] in '\n#' or not 10.0 < float(line.split()[0]) - T0 < 30.0))
    found = errors(capsys, bag, '-o', out, '--truth', file)
    assert found['fixes to truth'] < 0.1
    nees = json.loads((out / 'summary.json').read_text())['nees_position']
    assert nees['within'] == 1.0
    assert nees['count'] > 10


def test_tune_compares_with_a_file(bag, tmp_path, capsys) -> None:
    file = write_truth(tmp_path / 'truth.tum', 'tum', (30.0, 40.0, 1.0))
    assert main(['tune', str(bag), '-o', str(tmp_path / 'tuned.yaml'), '--folds', '2', '--json',
                 '--truth', str(file)]) in (0, 1)
    assert 0.0 < json.loads(capsys.readouterr().out)['to_truth']['before'] < 0.5


def test_a_graph_is_compared_by_the_times_of_its_path(tmp_path, capsys) -> None:
    graph = tmp_path / 'graph.g2o'
    graph.write_text(''.join(
        f'EDGE_SE2 {k} {k + 1} 1 0 0.5 400 0 0 400 0 2500\n' for k in range(12)))
    words = graph, '-o', tmp_path / 'out'
    errors(capsys, *words)
    found = errors(capsys, *words, '--truth', tmp_path / 'out' / 'path.tum', '--no-align')
    assert found['corrected path to truth'] == pytest.approx(0.0, abs=1e-12)
    assert main(['replay', *map(str, words), '--truth', '/truth']) == 2
    assert f'/truth: {graph} has no topics' in capsys.readouterr().err


@pytest.mark.parametrize(('name', 'text', 'said'), [
    ('a.tum', '1 0 0 0 0 0 0 1\n\n2 0 0 0 0 0 0\n', ':3: expected 8 values'),
    ('a.tum', '1 0 0 0 0 0 0 0\n', ':1: the quaternion is zero'),
    ('a.tum', '1 0 0 0 0 0 0 1\n2 x 0 0 0 0 0 1\n', ":2: expected x, a number of at most 1e+09"),
    ('a.tum', '1 nan 0 0 0 0 0 1\n', ":1: expected x, a number of at most 1e+09, got 'nan'"),
    ('a.txt', '1700000000000000000 0 0 0 0 0 0 1\n', ':1: expected stamp in seconds'),
    ('a.csv', '1,2,3\n', ':1: expected a header with the columns stamp, x, y'),
    ('a.csv', 't,x,y\n\n1,2\n', ':3: expected 3 values, stamp x y, got 2'),
    ('a.csv', 't,lat,lon\n1,91,0\n', ':2: expected latitude, a number of at most 90'),
    ('a.csv', 't,x,y,yaw [deg]\n1,2,3,90\n', ":1: expected yaw in rad, got 'deg'"),
    ('a.csv', 't,x (mm),y (mm)\n1,2,3\n', ":1: expected x in m, got 'mm'"),
    ('a.csv', '# nothing\n', ': holds no pose'), ('a.tum', b'\xff\xfe\0', ': no text')])
def test_a_wrong_file_is_one_line_with_file_and_line(name, text, said, tmp_path, capsys) -> None:
    file = tmp_path / name
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    assert main(['replay', 'bag', '--truth', str(file)]) == 2   # before the bag is looked for
    error = capsys.readouterr().err
    assert error.startswith(f'error: {file}{said}')
    assert error.count('\n') == 1


def test_what_is_written_is_read_back_to_the_nanosecond(tmp_path) -> None:
    path = Trajectory(np.array([-1, 0, 1_746_518_400_281_485_483, 2**63 - 10**4]), np.array(
        [[0.1, -2.5, 3.0], [1e6 / 3.0, 0, -3.1], [5e6, 1e-9, 0.0], [1.0, 2.0, 1.5]]))
    write_tum(path, tmp_path / 'path.tum')
    (tmp_path / 'path.csv').write_text('\n'.join(csv_lines(path, np.zeros((4, 3, 3)))))
    for file in ('path.tum', 'path.csv'):
        stamps, places, headings, is_on_earth = read_path(tmp_path / file)
        np.testing.assert_array_equal(stamps, path.stamps_ns)
        np.testing.assert_array_equal(places[:, :2], path.poses[:, :2])
        np.testing.assert_allclose(headings, path.poses[:, 2], atol=1e-15)
        assert not is_on_earth
