# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which constraints of a whole graph are believed when the surest ones come first."""

from collections.abc import Generator

from false_loops import Drive, laps
import numpy as np
import pytest

from pose_graph_ros.core.batch.optimizer import to_the_end
from pose_graph_ros.core.batch.truncated import TruncatedProblem
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.graph.constraints import Factors
from pose_graph_ros.core.graph.factors import energies, errors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.judgement import closure_search
from pose_graph_ros.core.judgement.closures import forward
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother


def believed(drive: Drive) -> list[bool]:
    problem = TruncatedProblem(drive.graph, drive.closures)
    return list(to_the_end(closure_search.select(problem)))


@pytest.mark.parametrize('seed', range(4))
@pytest.mark.parametrize(('n_wrong', 'groups'), [(0, ()), (20, ()), (0, (6, 6, 6)), (6, (10,))])
def test_the_right_closures_are_found(seed: int, n_wrong: int, groups: tuple[int, ...]) -> None:
    drive = laps(seed, n_wrong=n_wrong, groups=groups)
    found = np.array(believed(drive))
    assert not np.any(found & ~drive.right)
    assert np.sum(found) >= 0.9 * np.sum(drive.right)
    problem = TruncatedProblem(drive.graph, drive.closures)
    choice = to_the_end(closure_search.best(problem))
    assert not np.any(choice.believed & ~drive.right)
    assert drive.error(choice.poses) < 1.0


@pytest.mark.parametrize('seed', range(3))
def test_what_passes_its_gate_is_believed_though_its_error_is_beyond_its_limit(
    seed: int, monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Here nothing is believed at first, by which odometry is off by more than any limit."""
    drive = laps(seed, n_wrong=4)
    problem = TruncatedProblem(drive.graph, drive.closures)
    nothing = np.zeros(len(problem), dtype=bool)

    def no_others(problem: TruncatedProblem) -> Generator[None, None, np.ndarray]:
        yield
        return nothing

    monkeypatch.setattr(closure_search, 'select', no_others)
    choice = to_the_end(closure_search.best(problem, nothing))
    assert not np.any(choice.believed & ~drive.right)
    assert np.sum(choice.believed) >= 0.9 * np.sum(drive.right)


@pytest.mark.parametrize('seed', range(3))
def test_the_order_of_the_rows_does_not_matter(seed: int) -> None:
    drive = laps(seed, n_wrong=10, groups=(5,))
    order = np.random.default_rng(seed).permutation(drive.graph.n_factors)
    rows, shuffled = drive.graph.rows(), Graph()
    shuffled.fill(rows._replace(factors=rows.factors.rows(order)))
    place = np.argsort(order)
    problem = TruncatedProblem(shuffled, place[drive.closures])
    assert list(to_the_end(closure_search.select(problem))) == believed(drive)


def test_a_gate_is_that_of_the_smoother() -> None:
    drive = laps(1, n_wrong=3)
    problem = TruncatedProblem(drive.graph, drive.closures)
    none = np.zeros(len(problem))
    to_the_end(problem.solve(none))
    gates = closure_search._Gates(problem)
    everything = np.arange(len(problem))
    passing = to_the_end(gates.passing(everything))
    smoother = IncrementalSmoother()
    smoother.graph.fill(problem.graph.rows())
    smoother.update(GraphUpdate())
    edges = problem.edges
    for k, (i, j) in enumerate(zip(edges.i, edges.j, strict=True)):
        joint = smoother.joint_covariance(i, j)
        jacobian = _jacobian(problem.graph.poses, edges.rows(slice(k, k + 1)))
        S = jacobian @ joint @ jacobian.T + np.linalg.inv(edges.information[k])
        error = errors(problem.graph.poses, edges.rows(slice(k, k + 1)))[0]
        assert (k in passing) == (error @ np.linalg.solve(S, error) <= problem.limits[k])
        assert gates.volume[k] == pytest.approx(np.sqrt(np.linalg.det(S)), rel=1e-5)


def _jacobian(poses: np.ndarray, edge: Factors) -> np.ndarray:
    """Return the Jacobian of an edge's error by both ends, by differences, shape (3, 6)."""
    columns = []
    for node in (edge.i[0], edge.j[0]):
        for k in range(3):
            moved = [poses.copy(), poses.copy()]
            for sign, each in zip((-1.0, 1.0), moved, strict=True):
                each[node, k] += sign * 1e-6
            low, high = (errors(each, edge)[0] for each in moved)
            columns.append((high - low) / 2e-6)
    return np.array(columns).T


# --- Information for decisions ---------------------------------------------------------------


def test_an_edge_that_is_turned_round_has_the_same_energy() -> None:
    rng = np.random.default_rng(1)
    poses = rng.normal(0.0, 3.0, (2, 3))
    mean = se2.between(poses[1], poses[0]) + rng.normal(0.0, 1e-5, 3)
    root = rng.normal(0.0, 1.0, (3, 3))
    edge = Factors([1], [0], mean[None], (root @ root.T)[None], [1])
    turned = forward(edge)
    assert (turned.i[0], turned.j[0]) == (0, 1)
    before, after = (energies(errors(poses, each), each.information)
                     for each in (edge, turned))
    assert after[0] == pytest.approx(before[0], rel=1e-3)
    assert forward(turned) is turned
