# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A g2o file as measurements over time."""

from pathlib import Path

import numpy as np
import pytest

from pose_graph_ros.cli.graph_input import read_measurements
from pose_graph_ros.cli.main import main
from pose_graph_ros.core.exceptions import FileFormatError
from pose_graph_ros.core.geometry import covariance
from pose_graph_ros.core.measurements import LoopClosure, OdometrySample

SECOND = 10**9
STEP = '1 0 1.5707963267948966 400 0 0 400 0 2500'
LOOP = '0 0 0 100 0 0 25 0 400'
# A square, twice, with one edge backward and the second lap's end on the first's.
SQUARE = '\n'.join((
    *(f'EDGE_SE2 {k} {k + 1} {STEP}' for k in range(2)),
    'EDGE_SE2 7 3 0 0 0 100 0 0 25 0 400',
    'EDGE_SE2 3 2 0 1 -1.5707963267948966 400 0 0 400 0 2500',
    *(f'EDGE_SE2 {k} {k + 1} {STEP}' for k in range(3, 8)),
    f'EDGE_SE2 0 4 {LOOP}', f'EDGE_SE2 1 5 {LOOP}')) + '\n'


@pytest.fixture
def square(tmp_path: Path) -> Path:
    path = tmp_path / 'square.g2o'
    path.write_text(SQUARE)
    return path


def test_odometry_is_composed_and_closures_come_with_their_later_ends(square) -> None:
    found = read_measurements(square)
    samples = [each for each in found if isinstance(each, OdometrySample)]
    assert [each.stamp_ns for each in samples] == [k * SECOND for k in range(1, 10)]
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0], [1, 0], [1, 1], [0, 1], [0, 0]])
    np.testing.assert_allclose([each.pose[:2] for each in samples], corners, atol=1e-12)
    np.testing.assert_allclose(samples[2].twist_variance, [0.0025, 0.0025, 0.0004])
    closures = {k: each for k, each in enumerate(found) if isinstance(each, LoopClosure)}
    assert {(each.stamp_ns // SECOND, each.reference_ns // SECOND)
            for each in closures.values()} == {(5, 1), (6, 2), (4, 8)}
    for k, each in closures.items():
        assert found[k - 1].stamp_ns == max(each.stamp_ns, each.reference_ns)


def test_covariances_are_in_the_axes_that_the_engine_wants(tmp_path) -> None:
    path = tmp_path / 'turned.g2o'
    path.write_text(SQUARE.replace(f'0 4 {LOOP}', '0 4 0 0 0.7 100 3 0 25 1 400'))
    closure = next(each for each in read_measurements(path)
                   if isinstance(each, LoopClosure) and each.stamp_ns == 5 * SECOND)
    in_edge = covariance.turned(closure.covariance, 0.7)
    np.testing.assert_allclose(
        np.linalg.inv(in_edge), [[100, 3, 0], [3, 25, 1], [0, 1, 400]], atol=1e-9)


def test_a_graph_without_odometry_is_refused_by_the_vertices(tmp_path) -> None:
    path = tmp_path / 'lone.g2o'
    path.write_text(f'EDGE_SE2 0 1 {STEP}\nEDGE_SE2 0 7 {LOOP}\n')
    with pytest.raises(FileFormatError, match='there is none from 1 to 7'):
        read_measurements(path)


@pytest.mark.parametrize('words', [
    ['solve'], ['replay'], ['report'], ['draw', '-o', 'a.svg'],
    ['marginalize', '--nodes', '0', '-o', 'a.g2o']])
def test_a_graph_in_space_is_refused_by_what_can_be_done(words, tmp_path, capsys) -> None:
    path = tmp_path / 'sphere.g2o'
    path.write_text('# a comment\nVERTEX_TRACKXYZ 5 0 0 0\nVERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n')
    assert main([words[0], str(path), *words[1:]]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f'error: {path}:3: VERTEX_SE3:QUAT is of a graph in space (3D)')
    assert 'write x, y and yaw as VERTEX_SE2 and EDGE_SE2' in error
    assert error.count('\n') == 1
