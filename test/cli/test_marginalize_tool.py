# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The tool `pose-graph marginalize`: what remains says the same as the graph before."""

import json
from pathlib import Path

import numpy as np
import pytest

from pose_graph_ros.cli.main import main
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.io.g2o import read_g2o
from pose_graph_ros.core.marginalization.marginalize import equations

IDENTITY = '1 0 0 1 0 1'
POSES = f"""
VERTEX_SE2 3 0 0 0
VERTEX_SE2 4 1 0 0.5
VERTEX_SE2 5 1.9 0.5 1
VERTEX_SE2 7 2.4 1.3 1.5
FIX 3
EDGE_SE2 3 4 1 0.1 0.5 {IDENTITY}
EDGE_SE2 4 5 1 0 0.5 {IDENTITY}
EDGE_SE2 5 7 1 0 0.6 {IDENTITY}
"""
SEEN_TWICE = """
VERTEX_XY 20 2 3
EDGE_SE2_XY 4 20 2.4 2.1 4 0 4
EDGE_SE2_XY 5 20 2.2 1.3 4 0 4
VERTEX_XY 21 4 3
EDGE_SE2_XY 5 21 3.3 -0.3 4 0 4
EDGE_SE2_XY 7 21 1.8 -1.4 4 0 4
"""
SEEN_BY_THREE = SEEN_TWICE + 'EDGE_SE2_XY 7 20 1.6 0.6 4 0 4\n'


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding='utf-8')
    return path


def solved(path: Path) -> Path:
    """Optimise a file in place."""
    assert main(['solve', str(path), '-o', str(path)]) == 0
    return path


def covariance_of_poses(graph: Graph) -> np.ndarray:
    """Return the joint covariance of the free poses, by a dense inverse."""
    H = equations(graph)[0]
    used = np.diagonal(H) > 0.0
    free = np.repeat(~graph.fixed, 3) & used
    pose = np.repeat(graph.is_pose, 3)[free]
    return np.linalg.inv(H[np.ix_(free, free)])[np.ix_(pose, pose)]


def test_landmarks_leave_and_poses_and_covariances_remain(tmp_path, capsys) -> None:
    path = solved(write(tmp_path / 'seen.g2o', POSES + SEEN_TWICE))
    out = tmp_path / 'poses.g2o'
    capsys.readouterr()
    assert main(['marginalize', str(path), '--nodes', 'landmarks', '-o', str(out)]) == 0
    assert capsys.readouterr().out == (
        '2 hidden nodes removed; 4 left, with 5 edges and 0 observed nodes\n'
        f'written: {out}\n')
    before, after = read_g2o(path), read_g2o(out)
    assert after.ids.tolist() == [3, 4, 5, 7]
    np.testing.assert_allclose(
        covariance_of_poses(after.graph), covariance_of_poses(before.graph), rtol=1e-9, atol=1e-12)
    solved(out)
    np.testing.assert_allclose(read_g2o(out).graph.poses, before.graph.poses[:4], atol=1e-6)


def test_dense_priors_are_refused_or_become_conservative_edges(tmp_path, capsys) -> None:
    path = solved(write(tmp_path / 'seen.g2o', POSES + SEEN_BY_THREE))
    out, words = tmp_path / 'poses.g2o', ['--nodes', 'landmarks']
    capsys.readouterr()
    assert main(['marginalize', str(path), *words, '-o', str(out)]) == 2
    assert capsys.readouterr().err == (
        f'error: {path}: without these nodes there are 1 dense priors, the largest one on 3 '
        'nodes, which g2o does not have; --sparse puts edges in their place\n')
    assert not out.exists()
    assert main(['marginalize', str(path), *words, '-o', str(out), '--sparse', '--json']) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts['dense_priors'] == 1
    assert facts['largest_dense_prior'] == 3
    before, after = read_g2o(path), read_g2o(out)
    assert facts['edges'] == len(after.graph.factors.edges)
    # no covariance is smaller than it was
    more = covariance_of_poses(after.graph) - covariance_of_poses(before.graph)
    assert np.linalg.eigvalsh(more)[0] > -1e-9
    np.testing.assert_allclose(after.graph.poses, before.graph.poses[:4], atol=1e-12)


def test_poses_leave_by_their_ids_in_the_file(tmp_path) -> None:
    path = write(tmp_path / 'chain.g2o', POSES)
    out = tmp_path / 'out.g2o'
    assert main(['marginalize', str(path), '--nodes', '4:5', '-o', str(out)]) == 0
    after = read_g2o(out)
    assert after.ids.tolist() == [3, 7]
    # a fixed neighbour keeps its place
    np.testing.assert_array_equal(after.graph.fixed, [True, False])
    np.testing.assert_allclose(
        covariance_of_poses(after.graph),
        covariance_of_poses(read_g2o(path).graph)[6:, 6:], rtol=1e-9)


@pytest.mark.parametrize(('nodes', 'message'), [
    ('9', 'error: --nodes: the graph has no hidden node 9; ids are 3 to 7'),
    ('3:7', 'error: --nodes: no pose would be left'),
    ('some', 'error: --nodes: expected ids such as 3,7,20:25'),
    ('landmarks', 'error: {path}: has no landmarks')])
def test_wrong_input_is_refused_in_one_line(nodes, message, tmp_path, capsys) -> None:
    path = write(tmp_path / 'chain.g2o', POSES)
    out = tmp_path / 'out.g2o'
    assert main(['marginalize', str(path), '--nodes', nodes, '-o', str(out)]) == 2
    error = capsys.readouterr().err
    assert error.startswith(message.format(path=path))
    assert error.count('\n') == 1
    assert not out.exists()
