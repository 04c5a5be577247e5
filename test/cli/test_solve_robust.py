# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What `pose-graph solve --robust` may never do: return worse than it was given."""

import json
from pathlib import Path

from false_loops import laps
import numpy as np
import pytest

from pose_graph_ros.cli.main import main
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.factors import energies
from pose_graph_ros.core.io.g2o import read_g2o, write_g2o

LIMIT = 11.345  # 99 % of chi2 with three degrees of freedom
ODOMETRY, CLOSURE = np.array([0.05, 0.05, 0.02]), np.array([0.1, 0.1, 0.03])


def drive(
    path: Path, seed: int, odometry: float, closure: float, n_wrong: int = 0,
) -> None:
    """Write a drive in loops with honest errors and up to 29 right closures."""
    rng = np.random.default_rng(seed)
    n, truth = int(rng.integers(30, 120)), [np.zeros(3)]
    for k in range(n - 1):
        truth.append(se2.compose(truth[-1], np.array([2.0, 0.0, 0.25 + 0.2 * np.sin(k)])))
    poses = np.array(truth)
    lines = ['FIX 0']

    def add(i: int, j: int, mean: FloatArray, sigma: FloatArray) -> None:
        numbers = [*(mean + rng.normal(0.0, sigma)), *np.diag(sigma**-2.0)[np.triu_indices(3)]]
        lines.append(f'EDGE_SE2 {i} {j} ' + ' '.join(f'{number:.12g}' for number in numbers))

    for k in range(n - 1):
        add(k, k + 1, se2.between(poses[k], poses[k + 1]), odometry * ODOMETRY)
    near = np.hypot(*(poses[:, None] - poses)[..., :2].transpose(2, 0, 1)) < 4.0
    places = np.argwhere(np.triu(near, 4))
    for i, j in rng.permutation(places)[:int(rng.integers(5, 30))].tolist():
        add(i, j, se2.between(poses[i], poses[j]), closure * CLOSURE)
    for _ in range(n_wrong):
        i, j = sorted(rng.choice(n - 3, 2, replace=False).tolist())
        add(i, j + 3, rng.uniform([-2.0, -2.0, -3.0], [2.0, 2.0, 3.0]), closure * CLOSURE)
    path.write_text('\n'.join(lines) + '\n', encoding='ascii')


def closures_of(path: Path) -> IntArray:
    edges = read_g2o(path).graph.factors.edges
    return np.flatnonzero(np.abs(edges.j - edges.i) != 1)


def truncated(path: Path, poses: FloatArray, scale: float) -> float:
    graph = read_g2o(path).graph
    graph.set_poses(poses)
    edges = graph.factors.edges
    squares = energies(graph.errors(edges), edges.information)
    rows = closures_of(path)
    squares[rows] = np.minimum(squares[rows] / scale**2, LIMIT)
    return float(np.sum(squares))


@pytest.mark.parametrize('method', ['selection', 'gnc'])
@pytest.mark.parametrize(('seed', 'odometry', 'closure', 'n_wrong'), [
    (0, 15.0, 4.0, 0), (4, 10.0, 4.0, 0), (5, 15.0, 1.0, 0), (8, 15.0, 4.0, 0),
    (9, 15.0, 1.0, 2)])
def test_a_robust_solution_costs_no_more_than_the_plain_one(  # noqa: PLR0917
    seed, odometry, closure, n_wrong, method, tmp_path, capsys,
) -> None:
    path, plain, robust = (tmp_path / name for name in ('graph.g2o', 'plain.g2o', 'robust.g2o'))
    drive(path, seed, odometry, closure, n_wrong)
    assert main(['solve', str(path), '-o', str(plain)]) == 0
    capsys.readouterr()
    assert main(['solve', str(path), '--robust', method, '-o', str(robust), '--json']) == 0
    told = json.loads(capsys.readouterr().out)['robust']
    before, after = (truncated(path, read_g2o(each).rows.poses, told['scale'])
                     for each in (plain, robust))
    assert after <= before * (1.0 + 1e-6)
    assert told['truncated_cost'] == pytest.approx(after, rel=1e-3)
    assert told['truncated_cost_of_all'] == pytest.approx(before, rel=1e-3)


def test_a_robust_solution_costs_no_more_than_the_poses_of_the_file(tmp_path, capsys) -> None:
    path, given, out = (tmp_path / name for name in ('graph.g2o', 'given.g2o', 'out.g2o'))
    drive(path, 5, 15.0, 1.0)
    main(['solve', str(path), '-o', str(given)])
    # wrong ones come in afterwards
    with given.open('a', encoding='ascii') as file:
        file.writelines(f'EDGE_SE2 {k} {k + 12} 1 -1 2 1e4 0 0 1e4 0 1e5\n' for k in range(8))
    capsys.readouterr()
    assert main(['solve', str(given), '--robust', 'gnc', '-o', str(out), '--json']) == 0
    scale = json.loads(capsys.readouterr().out)['robust']['scale']
    assert (truncated(given, read_g2o(out).rows.poses, scale)
            <= truncated(given, read_g2o(given).rows.poses, scale) * (1.0 + 1e-6))


@pytest.mark.parametrize('seed', range(6))
def test_odometry_that_is_loose_does_not_speak_against_honest_closures(
    seed, tmp_path, capsys,
) -> None:
    path = tmp_path / 'graph.g2o'
    drive(path, seed, 4.0, 0.2)
    assert main(['solve', str(path), '--robust', '--json']) == 0
    values = json.loads(capsys.readouterr().out)
    assert values['doubted'] == []
    assert values['robust']['scale'] <= 1.2


def test_landmarks_between_poses_do_not_make_odometry_a_closure(tmp_path, capsys) -> None:
    """iSAM numbers poses and landmarks in one sequence, as they come."""
    path, drive_of = tmp_path / 'laps.g2o', laps(1, n_wrong=5)
    n = drive_of.graph.n_nodes
    write_g2o(drive_of.graph, path, 2 * np.arange(n))
    with path.open('a', encoding='ascii') as file:
        file.writelines(f'EDGE_SE2_XY {2 * k} {2 * k + 1} 1 2 4 0 4\n' for k in range(n))
    assert main(['solve', str(path), '--robust', '--json']) == 0
    values = json.loads(capsys.readouterr().out)
    wrong = drive_of.graph.factors_at(drive_of.closures[~drive_of.right])
    assert values['robust']['closures'] == len(drive_of.closures)
    assert sorted(values['doubted']) == sorted([2 * i, 2 * j] for i, j in zip(
        wrong.i.tolist(), wrong.j.tolist(), strict=True))
