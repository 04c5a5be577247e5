# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The batch optimisation against other solvers, stored optima and the meaning of its result."""

from collections.abc import Callable
import hashlib
import json
from pathlib import Path

import numpy as np
from public_data import missing, PUBLIC
import pytest
from random_graphs import (
    consistent_graph,
    corridor_graph,
    dense_system,
    free_part,
    random_edges,
    random_graph,
    random_observed,
    random_poses,
    slow_edge,
    slow_observed,
    snapshot,
)
from scipy.optimize import least_squares
from slow_smoother import EXACT

from pose_graph_ros.core.batch import optimizer
from pose_graph_ros.core.batch.linear_starts import chordal
from pose_graph_ros.core.batch.optimizer import BatchResult, Start, Status
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.exceptions import LinearSolveError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.io.g2o import read_g2o
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother

# chi2 is flat at its minimum: steps of 1e-8 leave a relative error of some 1e-15.
SAME_CHI2 = 1e-9
# A numeric Jacobian stops the other solver some 1e-8 before the minimum.
SAME_POSES = 1e-6
# Relative rounding error of chi2.
# Largest gradient at convergence, from some 1e4 at the start.
STATIONARY = 1e-6

DATA = Path(__file__).parents[2] / 'data'
GOLDEN = {name: entry for name, entry in
          json.loads((DATA / 'golden.json').read_text(encoding='ascii')).items()
          if name != 'about'}

# chi2 at the optima of public graphs, by the literature and other solvers; relative error 1e-5.
PUBLIC_OPTIMA = {
    'ring.g2o': (11.163, None),
    'input_M3500_g2o.g2o': (137.912951, None),
    'intel_vertigo.g2o': (546.461112, None),
    'CSAIL_P_toro.graph': (38.956286, 'toro'),
    'M3500a.g2o': (912.115, 'toro'),
    'city10000.g2o': (511.985164, None),
}
NEEDS_CHORDAL_START = {'M3500a.g2o'}

THOROUGH = SolverConfig(max_iterations=200, step_tolerance=1e-10)


def gradient(graph: Graph) -> FloatArray:
    return free_part(graph, *dense_system(graph))[1]


def other_solver(graph: Graph) -> tuple[float, FloatArray]:
    """Return chi2 and the poses of scipy's optimum, from the graph's own start."""
    edges, observed, free = graph.factors.edges, graph.factors.observed, ~graph.fixed
    roots = [np.linalg.cholesky(w).T for w in edges.information]
    values, vectors = np.linalg.eigh(observed.information)
    unary_roots = np.sqrt(np.maximum(values, 0.0))[:, :, None] * np.swapaxes(vectors, 1, 2)

    def moved(x: FloatArray) -> FloatArray:
        poses = graph.poses.copy()
        poses[free] = x.reshape(-1, 3)
        return poses

    def errors(x: FloatArray) -> FloatArray:
        poses = moved(x)
        whitened = [
            root @ slow_edge(poses[i], poses[j], z)[0]
            for root, i, j, z in zip(roots, edges.i, edges.j, edges.mean, strict=True)]
        whitened += [
            root @ slow_observed(poses[i], offset, z)[0]
            for root, i, offset, z in zip(
                unary_roots, observed.i, observed.offset, observed.mean, strict=True)]
        return np.concatenate(whitened)

    result = least_squares(errors, graph.poses[free].ravel(), xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return float(2.0 * result.cost), se2.wrapped(moved(result.x))


@pytest.mark.parametrize('seed', range(6))
def test_the_optimum_is_that_of_scipy(seed: int) -> None:
    graph = consistent_graph(seed, noise=0.05)
    rng = np.random.default_rng(seed)
    at = [1, 4, 6]
    observed = random_observed(rng, at)
    mean = se2.compose(graph.poses[at], observed.offset) + 0.1 * rng.standard_normal((3, 3))
    mean[0, 2] = 0.0     # a position
    graph.apply(GraphUpdate(factors=Factors.on(
        observed.i, observed.offset, mean, observed.information, observed.kind)))
    chi2, poses = other_solver(graph)
    result = optimizer.optimize(graph, SolverConfig())
    assert result.status is Status.CONVERGED
    assert result.chi2 == pytest.approx(chi2, rel=SAME_CHI2)
    difference = graph.poses - poses
    np.testing.assert_allclose(difference[:, :2], 0.0, atol=SAME_POSES)
    np.testing.assert_allclose(se2.wrap(difference[:, 2]), 0.0, atol=SAME_POSES)


def plain_gauss_newton(graph: Graph) -> list[float]:
    """Return chi2 before and after each of 50 steps with dense matrices; the poses stay."""
    start, found = graph.poses.copy(), [graph.energies().chi2]
    for _ in range(50):
        H, b = free_part(graph, *dense_system(graph))
        graph.set_poses(np.vstack((
            graph.poses[:1], graph.poses[1:] - np.linalg.solve(H, b).reshape(-1, 3))))
        found.append(graph.energies().chi2)
    graph.set_poses(start)
    return found


def test_it_converges_where_plain_gauss_newton_does_not() -> None:
    graph = consistent_graph(seed=111, noise=0.8, n_nodes=12)
    plain = plain_gauss_newton(graph)
    assert np.ptp(plain[-10:]) > 1.0
    result = optimizer.optimize(graph, THOROUGH)
    assert result.status is Status.CONVERGED
    assert result.chi2 < min(plain[-10:])
    np.testing.assert_allclose(gradient(graph), 0.0, atol=STATIONARY)


@pytest.mark.parametrize(('seed', 'status'), [
    *((seed, Status.STALLED) for seed in (55, 154, 393)),
    *((seed, Status.CONVERGED) for seed in (69, 101, 287))])
def test_being_stuck_where_an_angle_jumps_does_not_count_as_converged(
    seed: int, status: Status,
) -> None:
    graph = consistent_graph(seed, noise=0.8, n_nodes=12)
    assert optimizer.optimize(graph, THOROUGH).status is status
    steepest = np.max(np.abs(gradient(graph)))
    assert steepest > 1.0 if status is Status.STALLED else steepest < STATIONARY


def test_a_map_far_from_its_origin_converges_to_the_same_shape() -> None:
    near, far, rng = consistent_graph(6, noise=0.05), Graph(), np.random.default_rng(6)
    n = near.n_nodes
    observed = Factors.on(
        np.arange(n), None, near.poses + rng.normal(0.0, 0.1, (n, 3)),
        np.tile(np.diag([100.0, 80.0, 0.0]), (n, 1, 1)), [FactorKind.POSITION] * n)
    near.apply(GraphUpdate(factors=observed, free=[0]))
    shift = np.array([691_000.0, 5_334_000.0, 0.0])     # as UTM has it
    far.apply(GraphUpdate(near.poses + shift, Factors.joined([
        near.factors.edges, observed.replaced(mean=observed.mean + shift)])))
    for graph in (near, far):
        assert optimizer.optimize(graph, SolverConfig()).status is Status.CONVERGED
    # a double has steps of 1e-9 m there
    np.testing.assert_allclose(far.poses - shift, near.poses, atol=1e-7)


def floating(rng: np.random.Generator) -> Graph:
    return random_graph(int(rng.integers(100)), n_observed=0)


def with_a_loose_part(rng: np.random.Generator) -> Graph:
    graph = random_graph(1, fix=(0,))
    graph.apply(GraphUpdate(hidden=random_poses(rng, 2), factors=random_edges(rng, [7], [8])))
    return graph


def without_any_heading(_: np.random.Generator) -> Graph:
    graph = Graph()
    graph.apply(GraphUpdate(hidden=np.zeros((1, 3)), factors=Factors.on(
        [0], None, [[1.0, 2.0, 0.0]], [np.diag([1.0, 1.0, 0.0])], [FactorKind.POSITION])))
    return graph


def beyond_all_numbers(_: np.random.Generator) -> Graph:
    graph = random_graph(2, fix=(0,))
    graph.apply(GraphUpdate(factors=Factors.on(
        [3], None, [[1e200, 0.0, 0.0]], [np.eye(3)], [FactorKind.GLOBAL_POSE])))
    return graph


def cut_off(_: np.random.Generator) -> Graph:
    graph = random_graph(seed=5, n_nodes=4, n_observed=0, fix=(0,))
    edges = graph.factors.edges
    graph.apply(GraphUpdate(
        remove=np.flatnonzero((edges.i == 0) | (edges.j == 0)).tolist()))
    return graph


@pytest.mark.parametrize('optimize', [optimizer.optimize, optimizer.optimize_from_linear_start])
@pytest.mark.parametrize(('make', 'reason'), [
    (floating, 'connected to no fixed'), (with_a_loose_part, 'hidden node 7 and 1 others'),
    (cut_off, 'hidden node 1 and 2 others'), (without_any_heading, 'not determined'),
    (beyond_all_numbers, 'not finite')])
def test_a_failure_is_a_result_and_leaves_everything_as_it_was(
    make: Callable[[np.random.Generator], Graph], reason: str,
    optimize: Callable[[Graph, SolverConfig], BatchResult],
) -> None:
    graph = make(np.random.default_rng(8))
    before = snapshot(graph)
    with np.errstate(over='ignore', invalid='ignore'):
        result = optimize(graph, SolverConfig())
    assert (result.status, result.iterations) == (Status.FAILED, 0)
    assert reason in result.reason
    assert snapshot(graph) == before


# --- From nothing ----------------------------------------------------------------------------

@pytest.mark.parametrize('seed', range(10))
def test_from_nothing_it_finds_the_minimum_from_anywhere(seed: int) -> None:
    graph = consistent_graph(seed, noise=0.03)
    optimizer.optimize(graph, THOROUGH)
    optimum, rng = graph.poses.copy(), np.random.default_rng(seed)
    poses = random_poses(rng, graph.n_nodes, 100.0)
    poses[0] = optimum[0]
    graph.set_poses(poses)
    result = optimizer.optimize_from_linear_start(graph, THOROUGH)
    assert result.status is Status.CONVERGED
    np.testing.assert_allclose(graph.poses, optimum, atol=1e-9)


# --- The smoother continues ------------------------------------------------------------------

@pytest.mark.parametrize('from_nothing', [False, True])
@pytest.mark.parametrize('seed', range(5))
def test_the_smoother_continues_from_the_result(seed: int, *, from_nothing: bool) -> None:
    smoother, rng = IncrementalSmoother(EXACT), np.random.default_rng(seed)
    first = consistent_graph(seed, noise=0.05)
    smoother.update(GraphUpdate(hidden=first.poses, factors=first.factors, fix=[0]))
    graph = smoother.graph
    graph.apply(GraphUpdate(
        factors=random_observed(rng, [3]), weigh={graph.n_factors: 0.01}))
    optimize = optimizer.optimize_from_linear_start if from_nothing else optimizer.optimize
    assert optimize(graph, THOROUGH).status is Status.CONVERGED
    poses = graph.poses.copy()
    for k in range(3):
        n = graph.n_nodes
        edges = Factors(
            [n - 1, k], [n, n], [[1.0, 0.1, 0.2], se2.between(poses[k], poses[-1])],
            np.tile(np.diag([50.0, 50.0, 100.0]), (2, 1, 1)), [0, 1])
        hidden = se2.compose(graph.poses[-1], np.array([1.0, 0.1, 0.2]))[None]
        result = smoother.update(GraphUpdate(hidden=hidden, factors=edges))
        assert result.status is Status.CONVERGED
        found = graph.poses.copy()
        other = Graph()
        other.apply(GraphUpdate(hidden=found, factors=graph.factors, fix=[0]))
        assert optimizer.optimize(other, THOROUGH).status is Status.CONVERGED
        np.testing.assert_allclose(found, other.poses, atol=SAME_POSES)


# --- Stored optima ---------------------------------------------------------------------------

@pytest.mark.parametrize('name', GOLDEN)
@pytest.mark.parametrize('from_chordal', [False, True])
def test_small_graphs_reach_their_stored_optima(name: str, *, from_chordal: bool) -> None:
    path = DATA / name
    assert hashlib.sha256(path.read_bytes()).hexdigest() == GOLDEN[name]['sha256']
    graph = read_g2o(path).graph
    if from_chordal:
        graph.set_poses(chordal(graph))
    result = optimizer.optimize(graph, SolverConfig())
    assert result.status is Status.CONVERGED
    assert result.chi2 == pytest.approx(GOLDEN[name]['chi2'], rel=SAME_CHI2)
    np.testing.assert_allclose(gradient(graph), 0.0, atol=STATIONARY)


@pytest.mark.parametrize('from_nothing', [False, True])
@pytest.mark.parametrize('name', PUBLIC_OPTIMA)
def test_public_graphs_reach_their_known_optima(name: str, *, from_nothing: bool) -> None:
    path = PUBLIC / 'graphs' / name
    if missing(f'graphs/{name}'):
        pytest.skip(missing(f'graphs/{name}'))
    chi2, edge2_order = PUBLIC_OPTIMA[name]
    graph = read_g2o(path, edge2_order).graph
    if from_nothing:
        result = optimizer.optimize_from_linear_start(graph, SolverConfig())
    else:
        if name in NEEDS_CHORDAL_START:
            graph.set_poses(chordal(graph))
        result = optimizer.optimize(graph, SolverConfig())
    assert result.status is Status.CONVERGED
    assert result.chi2 == pytest.approx(chi2, rel=1e-5)


# --- Several starts --------------------------------------------------------------------------

@pytest.mark.parametrize(('sigma', 'length'), [(0.3, 150), (0.5, 250)])
@pytest.mark.parametrize('seed', [0, 2])
def test_headings_that_cancel_each_other_out_have_a_start(
    seed: int, sigma: float, length: int,
) -> None:
    graph = corridor_graph(seed, sigma, length)
    from_truth = optimizer.optimize(graph, THOROUGH)
    assert from_truth.start is Start.PRESENT
    poses = random_poses(np.random.default_rng(seed), graph.n_nodes, 50.0)
    poses[0] = graph.poses[0]
    graph.set_poses(poses)
    with pytest.raises(LinearSolveError, match='cancel each other out'):
        chordal(graph)
    result = optimizer.optimize_from_linear_start(graph, THOROUGH)
    assert (result.status, result.start) == (Status.CONVERGED, Start.UNIT)
    assert result.chi2 <= 1.01 * from_truth.chi2


def test_a_graph_too_large_for_superlu_has_the_other_starts(monkeypatch) -> None:
    graph = corridor_graph(0, 0.3, 150)
    monkeypatch.setattr(optimizer, 'MOST_VALUES', 0)
    monkeypatch.setattr(optimizer.linear_starts, 'joint', None)     # not called
    result = optimizer.optimize_from_linear_start(graph, THOROUGH)
    assert (result.status, result.start) == (Status.CONVERGED, Start.PRESENT)
    graph.apply(GraphUpdate(factors=random_observed(np.random.default_rng(0), [1, 5])))
    assert optimizer.optimize_from_two_starts(graph, THOROUGH).status is Status.CONVERGED


def test_a_graph_without_its_cliques_is_as_good_as_before() -> None:
    graph = corridor_graph(1, 0.01)
    result = optimizer.optimize(graph, SolverConfig())
    poses = graph.poses.copy()
    optimizer.uproot(graph)
    np.testing.assert_array_equal(graph.poses, poses)
    assert graph.energies().chi2 == pytest.approx(result.chi2, rel=SAME_CHI2)
    # online and as a whole it goes on
    smoother = IncrementalSmoother(graph=graph)
    smoother.extend(np.array([1.0, 0.0, 0.0]), np.eye(3))
    assert optimizer.optimize(graph, SolverConfig()).chi2 == pytest.approx(
        result.chi2, rel=SAME_CHI2)
