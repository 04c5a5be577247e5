# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Marginal covariances that `pose-graph solve` writes, against the inverse of a dense H."""

from collections.abc import Sequence
import csv
import json
from pathlib import Path
import re

import numpy as np
import pytest
from random_graphs import dense_system, free_part

from pose_graph_ros.cli.main import main
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.io.g2o import read_g2o

DATA = Path(__file__).resolve().parents[1] / 'data'


def covariances(lines: Sequence[str]) -> dict[int, FloatArray]:
    """Return matrices by id."""
    found = {}
    for row in csv.DictReader(lines):
        matrix = np.zeros((3, 3))
        for key, value in row.items():
            if key.startswith('cov_'):
                names = key.removeprefix('cov_').replace('theta', 't')
                i, j = ('xyt'.index(name) for name in names)
                matrix[i, j] = matrix[j, i] = float(value)
        found[int(row['id'])] = matrix
    return found


def dense(path: Path) -> dict[int, FloatArray]:
    """Return the covariances of a file with poses at the optimum, by the inverse of all of H."""
    file = read_g2o(path)
    inverse = np.linalg.inv(free_part(file.graph, *dense_system(file.graph))[0])
    found = dict.fromkeys(file.ids.tolist(), np.zeros((3, 3)))
    for k, node in enumerate(np.flatnonzero(~file.graph.fixed).tolist()):
        found[int(file.ids[node])] = inverse[3 * k:3 * k + 3, 3 * k:3 * k + 3]
    return found


@pytest.mark.parametrize('name', ['chain.g2o', 'manhattan.g2o', 'ring.g2o'])
def test_covariances_are_those_of_the_dense_inverse(name, tmp_path, capsys) -> None:
    graph, table = tmp_path / 'out.g2o', tmp_path / 'out.csv'
    assert main(['solve', str(DATA / name), '-o', str(graph), '-o', str(table)]) == 0
    expected = dense(graph)
    found = covariances(table.read_text(encoding='ascii').splitlines())
    assert list(found) == list(expected)
    for each, matrix in expected.items():
        np.testing.assert_allclose(found[each], matrix, rtol=1e-5, atol=1e-9)

    newest = max(expected)
    for which, names in (('newest', [newest]), (f'{newest},{min(expected)}', [
            min(expected), newest])):
        capsys.readouterr()
        assert main(['solve', str(DATA / name), '--marginals', which]) == 0
        lines = capsys.readouterr().out.splitlines()
        found = covariances(lines[-len(names) - 1:])
        assert list(found) == names
        for each in names:
            np.testing.assert_allclose(found[each], expected[each], rtol=1e-5, atol=1e-9)
    assert main(['solve', str(DATA / name), '--marginals', 'newest', '--json']) == 0
    values = json.loads(capsys.readouterr().out)
    (row,) = values['marginals']
    assert row['id'] == newest
    assert row['cov_xx'] == pytest.approx(expected[newest][0, 0], rel=1e-5)
    assert 0.0 < values['marginals_relative_error'] < 1e-9


def test_a_point_has_no_heading(tmp_path, capsys) -> None:
    path = tmp_path / 'graph.g2o'
    path.write_text('VERTEX_SE2 0 0 0 0\nEDGE_SE2_XY 0 1 1 2 4 0 16\n', encoding='ascii')
    assert main(['solve', str(path), '--marginals', '1']) == 0
    row = capsys.readouterr().out.splitlines()[-1].split(',')
    assert [float(text or 'nan') for text in row] == pytest.approx(
        [1.0, 1.0, 2.0, np.nan, 0.25, 0.0, np.nan, 0.0625, np.nan, np.nan], nan_ok=True)


@pytest.mark.parametrize(('text', 'which', 'said'), [
    ('EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1', '7', 'no hidden node 7'),
    ('EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1', 'some', "expected ids such as 3,7,20:25, got 'some'"),
    ('EDGE_PRIOR_SE2_XY 5 1 1 1 0 1', 'all', 'hidden node 5 is not determined')])
def test_what_cannot_be_told_is_one_line_of_error(text, which, said, tmp_path, capsys) -> None:
    path = tmp_path / 'graph.g2o'
    path.write_text(text, encoding='ascii')
    assert main(['solve', str(path), '--marginals', which]) == 2
    err = capsys.readouterr().err
    assert len(err.splitlines()) == 1
    assert said in err


def test_how_far_rounding_reaches_is_told_where_it_is_much(tmp_path, capsys) -> None:
    path, n = tmp_path / 'chain.g2o', 1500
    mean = np.array([1.0, 0.2, 0.01])
    information = np.diag([1e6, 0.1, 2.5e7])
    numbers = ' '.join(map(repr, map(float, (*mean, *information[np.triu_indices(3)]))))
    path.write_text('\n'.join(f'EDGE_SE2 {k} {k + 1} {numbers}' for k in range(n)), 'ascii')
    # a chain adds up its noises, in the frame of the last node
    exact, back = np.zeros((3, 3)), np.linalg.inv(se2.adjoint(mean[None])[0])
    pose = np.zeros(3)
    for _ in range(n):
        exact = back @ exact @ back.T + np.linalg.inv(information)
        pose = se2.compose(pose, mean)
    turn = se2.adjoint(np.array([[0.0, 0.0, pose[2]]]))[0]
    exact = turn @ exact @ turn.T
    assert main(['solve', str(path), '--marginals', 'newest', '--json']) == 0
    captured = capsys.readouterr()
    values = json.loads(captured.out)
    row, bound = values['marginals'][0], values['marginals_relative_error']
    for k, name in enumerate(('cov_xx', 'cov_yy', 'cov_thetatheta')):
        assert abs(row[name] / exact[k, k] - 1.0) < bound
    assert 1e-6 < bound < 0.1
    assert re.search(r'by rounding, covariances may be off by \S+ of themselves', captured.err)
    # without an error, f is 0, which nothing is below
    assert values['certificate']['verdict'] == 'certified'
