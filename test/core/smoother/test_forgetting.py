# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Nodes that leave take nothing along: not from the tree, and not as a pure function."""


from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from slow_smoother import differences, driven, EXACT, SlowGraph, state, World, world

from pose_graph_ros.core.batch import optimizer
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.elimination.assembly import work_size
from pose_graph_ros.core.exceptions import GraphUpdateError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.priors import model
from pose_graph_ros.core.marginalization.marginalize import marginalize
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother

# Tolerance of poses [m, rad] and of covariances, relative to the largest.
CLOSE = 1e-9

MOTION, INFORMATION = np.array([1.0, 0.0, 0.1]), np.diag([100.0, 100.0, 400.0])

seeds, flags = st.integers(0, 2**32 - 1), st.booleans()


def at_rest(seed: int) -> tuple[IncrementalSmoother, World]:
    """Return a smoother at the minimum of a world with closures, fixes, biases and doubts."""
    smoother, _, here = driven(seed, 11)
    smoother.update(here.joined(here.new_nodes(2), factors=here.observed([0, 1], position=True)))
    return smoother, here


def copied(smoother: IncrementalSmoother) -> IncrementalSmoother:
    """Return a smoother of a copy of the graph, all of which is eliminated at the same poses."""
    other = IncrementalSmoother(EXACT)
    other.graph.fill(smoother.graph.rows())
    other.graph.begin()
    other._step(0)
    return other


def system(graph: Graph, poses: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
    """Return H, shape (3N, 3N), and b, shape (3N,), of all nodes at poses, by dense matrices."""
    poses = graph.poses if poses is None else poses
    slow = SlowGraph(poses, graph.fixed, graph.factors_by_row)
    H, b = slow.system()
    for prior in graph.priors:
        rows = graph.node_rows(prior.nodes)
        at = (3 * rows[:, None] + np.arange(3)).ravel()
        linear = model(prior, poses[rows], graph.is_pose[rows])
        H[np.ix_(at, at)] += linear.information
        b[at] += linear.gradient
    return H, b


def some(rng: np.random.Generator, graph: Graph, fraction: float = 0.5) -> list[int]:
    """Return ids of some nodes that may leave; fixed ones do so rarely."""
    ids = graph.node_ids[rng.random(graph.n_nodes) < fraction]
    return [int(node) for node in rng.permutation(ids) if node != graph.newest_pose]


def assert_close(actual: FloatArray, expected: FloatArray, tolerance: float = CLOSE) -> None:
    scale = max(float(np.max(np.abs(expected), initial=0.0)), 1e-12)
    np.testing.assert_allclose(actual / scale, expected / scale, atol=tolerance)


def assert_same_information(graph: Graph, other: Graph, tolerance: float = CLOSE) -> None:
    assert graph.node_ids.tolist() == other.node_ids.tolist()
    (H, b), (G, c) = system(graph), system(other, graph.poses)
    root = 1.0 / np.sqrt(np.maximum(np.diagonal(H), 1e-12))
    np.testing.assert_allclose(G * root * root[:, None], H * root * root[:, None], atol=tolerance)
    np.testing.assert_allclose(c * root, b * root, atol=1e3 * tolerance)


@given(seeds, flags, flags)
@settings(max_examples=40)
def test_the_nodes_that_remain_do_not_move(seed: int, pure: bool, with_priors: bool) -> None:
    smoother, here = at_rest(seed)
    if with_priors:     # made at other poses, they have turned and bent since
        leaving = some(here.rng, smoother.graph, 0.3)
        smoother.forget(leaving)
        here.gone.update(leaving)
        more = here.joined(here.new_nodes(3), factors=Factors.joined([
            here.edges(here.pairs(3)), here.observed(here.poses[:1])]))
        assert smoother.update(more).status is not Status.FAILED
    smoother = copied(smoother)     # as the Jacobians of a smoother may lag a little
    graph, leaving = smoother.graph, some(here.rng, smoother.graph)
    kept = np.setdiff1d(graph.node_ids, leaving)
    poses, chi2, factors = graph.poses_of(kept), smoother.chi2(), graph.factors
    covariances = smoother.covariances()[graph.node_rows(kept)]
    if pure:
        assert smoother.update(marginalize(graph, leaving)).status is Status.CONVERGED
    else:
        forgotten = smoother.forget(leaving)
        assert forgotten.nodes.tolist() == sorted(leaving)
        gone = np.any(np.isin((factors.i, factors.j, factors.k), leaving), axis=0)
        assert len(forgotten.factors) == np.sum(gone)
        # of what leaves as a whole nothing remains, not even its energy
        assert smoother.chi2() <= chi2 * (1.0 + 1e-6) + 1e-6
    for each in (smoother, copied(smoother)):   # also optimised again, from scratch
        assert each.graph.node_ids.tolist() == kept.tolist()
        np.testing.assert_allclose(se2.wrapped(each.poses - poses), 0.0, atol=1e-9)
        assert_close(each.covariances(), covariances, 1e-9)


@given(seeds, flags)
@settings(max_examples=20)
def test_the_gauge_keeps_its_dimension(seed: int, tree: bool) -> None:
    """Without anything absolute, three motions remain that no constraint resists."""
    here = world(seed)
    smoother = IncrementalSmoother(EXACT)
    smoother.update(GraphUpdate(hidden=np.array(here.truth), fix=[0]))
    smoother.update(here.new_nodes(12))
    smoother.update(GraphUpdate(factors=here.edges(here.pairs(4))))
    leaving = [node for node in some(here.rng, smoother.graph) if node != 0]
    if tree:
        smoother.forget(leaving)
    else:
        smoother.update(marginalize(smoother.graph, leaving))
    graph = smoother.graph
    assert not any(prior.anchored for prior in graph.priors)
    for angle in (0.0, 2.0):    # also where it has been turned and bent since
        poses = se2.compose(np.array((1.0, 2.0, angle)), graph.poses)
        poses += here.rng.normal(0.0, 0.05, poses.shape) * (angle > 0.0)
        H, _ = system(graph, poses)
        root = np.sqrt(np.diagonal(H))
        values = np.linalg.eigvalsh(H / root / root[:, None])
        assert np.all(np.abs(values[:3]) < 1e-9)
        assert values[3] > 1e-7


def test_a_chain_node_leaves_one_edge() -> None:
    here = world(4)
    smoother = IncrementalSmoother(EXACT)
    smoother.update(GraphUpdate(hidden=np.array(here.truth), fix=[0]))
    for k in range(1, 6):
        smoother.update(GraphUpdate(
            hidden=here.drive(k - 1)[None], factors=here.edges([(k - 1, k)])))
    update = marginalize(smoother.graph, [3])
    assert (update.factors.edges.i.tolist(), update.factors.edges.j.tolist()) == ([2], [4])
    assert len(update.factors.observed) == len(update.priors) == 0
    expected = se2.between(smoother.graph.poses[2], smoother.graph.poses[4])
    np.testing.assert_allclose(update.factors.edges.mean[0], expected, atol=1e-9)


@given(seeds)
@settings(max_examples=10)
def test_a_graph_that_turns_by_a_radian_keeps_what_it_knows(seed: int) -> None:
    """With and without marginalisation, chi2 is the same to the order of the linearization."""
    here = world(seed, noise=(0.01, 0.01, 0.003), guess=(0.01, 0.01, 0.003))
    smoother = IncrementalSmoother(EXACT)
    smoother.update(GraphUpdate(hidden=np.array(here.truth), fix=[0]))
    smoother.update(here.new_nodes(12))
    smoother.update(GraphUpdate(factors=here.edges(here.pairs(4))))
    leaving = [node for node in some(here.rng, smoother.graph, 0.4) if node != 0]
    whole = copied(smoother)
    smoother.forget(leaving)
    turned = se2.compose(np.array((3.0, -1.0, 1.0)), smoother.graph.poses[0])
    update = GraphUpdate(free=[0], factors=Factors.on(
        [0], None, turned[None], [1e4 * np.eye(3)], [FactorKind.GLOBAL_POSE]))
    for each in (smoother, whole):
        assert each.update(update).status is Status.CONVERGED
    np.testing.assert_allclose(smoother.chi2(), whole.chi2(), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(
        smoother.poses, whole.graph.poses_of(smoother.graph.node_ids), atol=1e-6)


@given(seeds)
@settings(max_examples=20)
def test_what_is_forgotten_can_be_rolled_back_bit_for_bit(seed: int) -> None:
    """As an update, with its prior; the tree has had an update meanwhile."""
    smoother, here = at_rest(seed)
    graph, before = smoother.graph, state(smoother.graph)
    nodes = some(here.rng, graph)
    graph.begin()
    graph.apply(marginalize(graph, nodes))
    graph.rollback()
    assert differences(before, state(graph)) == []


@given(seeds)
@settings(max_examples=10)
def test_a_trial_that_is_adopted_has_the_priors_made_meanwhile(seed: int) -> None:
    smoother, here = at_rest(seed)
    trial = smoother.trial(GraphUpdate(), smoother.poses.copy())
    while trial.work():
        pass
    smoother.forget(some(here.rng, smoother.graph))
    before = copied(smoother)
    if smoother.adopt(trial).status is not Status.FAILED:
        assert_same_information(before.graph, smoother.graph, 1e-7)


def test_what_leaves_is_linear_where_the_graph_is_by_then() -> None:
    """
    Updates leave linearization errors, and a prior keeps them for good.

    Laps with poor headings and a window of a lap and a third: the poses are 1 to 8 mm off the
    optimum of the whole graph, and 9 to 34 mm if nothing is linearized again before it leaves.
    """
    off = [_laps_with_a_window(seed, 300, per_lap=60, lag=80) for seed in range(3)]
    assert np.sqrt(np.mean(np.square(off))) < 0.01


def _laps_with_a_window(seed: int, n: int, *, per_lap: int, lag: int) -> float:
    """Return how far the window is off the optimum of the whole graph after n nodes, rms [m]."""
    rng = np.random.default_rng(seed)
    sigma, turn = np.array((0.05, 0.05, 0.02)), 2.0 * np.pi / per_lap
    smoother, whole, oldest = IncrementalSmoother(), Graph(), 0
    held = Factors.on([0], None, [[0.0, 0.0, 0.0]], [1e10 * np.eye(3)], [FactorKind.GLOBAL_POSE])
    smoother.update(GraphUpdate(hidden=np.zeros((1, 3)), factors=held))
    updates = [GraphUpdate(hidden=np.zeros((1, 3)), factors=held)]
    for k in range(1, n):
        move = se2.compose(np.array((1.0, 0.0, turn)), rng.normal(size=3) * sigma)
        edges = [Factors([k - 1], [k], move[None], [np.diag(sigma**-2)], [FactorKind.ODOMETRY])]
        if k >= per_lap and k % 5 == 0:
            poor = np.array((0.1, 0.1, 0.05))
            edges.append(Factors([k - per_lap], [k], (rng.normal(size=3) * poor)[None],
                               [np.diag(poor**-2)], [FactorKind.LOOP_CLOSURE]))
        updates.append(GraphUpdate(hidden=se2.compose(smoother.poses[-1], move)[None],
                                   factors=Factors.joined(edges)))
        smoother.update(updates[-1])
        if k - oldest >= lag + 10:
            smoother.forget(range(oldest, oldest + 10))
            oldest += 10
    for update in updates:
        whole.apply(update)
    optimizer.optimize(whole, SolverConfig(step_tolerance=1e-9))
    while not smoother.refine().finished:
        pass
    off = (smoother.poses - whole.poses[oldest:])[:, :2]
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def test_what_cannot_leave_is_refused() -> None:
    smoother, _ = at_rest(5)
    with pytest.raises(GraphUpdateError, match='no hidden node'):
        smoother.forget([10**6])
    with pytest.raises(GraphUpdateError, match='newest pose'):
        smoother.forget([smoother.graph.newest_pose])
    assert smoother.forget([]).nodes.tolist() == []


# --- without what they tell ----------------------------------------------------------------------

def test_memory_stays_flat_while_nodes_come_and_go() -> None:
    smoother, rng, n = IncrementalSmoother(), np.random.default_rng(0), 25
    smoother.update(GraphUpdate(hidden=np.zeros((1, 3)), fix=[0]))
    sizes, used = [], np.zeros((2, 3))
    for k in range(1, 4000):
        smoother.extend(MOTION, INFORMATION)
        oldest = k - n
        if oldest >= 0:
            edges = Factors([k - int(rng.integers(2, n - 2))], [k], [rng.normal(size=3) * 0.1],
                          [0.01 * INFORMATION], [FactorKind.LOOP_CLOSURE],
                          weight=[float(k % 3 == 0)])
            assert smoother.update(GraphUpdate(
                factors=edges, remove_nodes=[oldest],
                fix=[oldest + 1])).status is not Status.FAILED
        memory = smoother.graph.memory
        if k in (2000, 3999):
            # the work space is that of the largest front so far
            sizes.append([len(memory[name]) for name in tb.NAMES if name != 'work_f'])
        if k % 2000 >= 1000:
            used[k // 2000] = np.maximum(used[k // 2000], memory.head[[
                tb.POOL_F_END, tb.POOL_I_END, tb.N_CLIQUES]])
    assert sizes[0] == sizes[1]
    assert len(memory['work_f']) <= work_size(n)
    np.testing.assert_allclose(used[1], used[0], rtol=0.3)
    graph = smoother.graph
    assert (graph.n_nodes, graph.newest_pose) == (n, 3999)
    assert graph.node_ids.tolist() == list(range(4000 - n, 4000))
    assert smoother.covariance(3990).shape == (3, 3)
    with pytest.raises(ValueError, match='hidden node 17 is not in the graph'):
        smoother.covariance(17)


def test_a_node_that_holds_others_cannot_leave() -> None:
    smoother = IncrementalSmoother(EXACT)
    smoother.update(GraphUpdate(hidden=np.zeros((1, 3)), fix=[0]))
    for _ in range(5):
        smoother.extend(MOTION, INFORMATION)
    smoother.update(GraphUpdate(remove_nodes=[0], fix=[1]))
    before = state(smoother.graph)
    result = smoother.update(GraphUpdate(remove_nodes=[3]))
    assert result.status is Status.FAILED
    assert result.reason in {f'hidden node {k} is not determined' for k in (4, 5)}
    assert differences(before, state(smoother.graph)) == []


def test_all_nodes_can_leave_and_the_smoother_goes_on() -> None:
    smoother, *_ = driven(4, 3)
    assert smoother.update(GraphUpdate(
        remove_nodes=smoother.graph.node_ids.tolist())).status is Status.CONVERGED
    assert (smoother.graph.n_nodes, smoother.chi2()) == (0, 0.0)
    first = smoother.graph.next_ids.node
    smoother.update(GraphUpdate(hidden=np.ones((1, 3)), fix=[first]))
    smoother.extend(MOTION, INFORMATION)
    assert smoother.graph.node_ids.tolist() == [first, first + 1]
    other = Graph()
    other.fill(smoother.graph.rows())
    assert other.newest_pose == first + 1


def test_of_two_fixed_nodes_the_other_is_known_when_one_leaves() -> None:
    smoother, *_ = driven(4, 3)
    ids = smoother.graph.node_ids
    smoother.update(GraphUpdate(fix=ids[[0, 2]].tolist()))
    smoother.forget([int(ids[0])])
    assert smoother.graph.fixed[smoother.graph.memory.head[tb.FIXED]]
    assert smoother.graph.node_ids[smoother.graph.fixed].tolist() == [ids[2]]


@pytest.mark.parametrize('seed', [57, 97, 294])
def test_a_step_that_diverges_while_nodes_leave_leaves_no_stale_tables(seed: int) -> None:
    rng = np.random.default_rng(seed)
    smoother = tangled(rng)
    ids, head = smoother.graph.node_ids, smoother.graph.memory.head
    smoother.forget(ids[1:1 + int(len(ids) * rng.uniform(0.1, 0.5))].tolist())
    # kernels have the addresses of all tables from it
    assert smoother.graph.memory.head is head
    assert np.all(np.isfinite(smoother.newest_covariance()))
    assert smoother.update(GraphUpdate()).status is not Status.FAILED


def tangled(rng: np.random.Generator) -> IncrementalSmoother:
    """Return a smoother of a chain with wrong closures whose next step diverges."""
    smoother = IncrementalSmoother()
    smoother.update(GraphUpdate(hidden=np.zeros((1, 3)), fix=(0,)))
    n_nodes = int(rng.integers(150, 500))
    turn, sigma = rng.choice([0.0, 2.0 * np.pi / 50.0, 0.3]), 10.0**rng.uniform(-2.0, 0.0)
    sigmas = sigma * np.array([1.0, 1.0, 0.3])
    information = np.diag(sigmas**-2)
    for k in range(n_nodes - 1):
        smoother.extend(np.array([1.0, 0.0, turn]) + rng.normal(size=3) * sigmas, information)
        if rng.random() < 0.05 and k > 20:
            at, spread = int(rng.integers(0, k - 10)), rng.random() < 0.5
            closure = rng.normal(size=3) * ((10.0, 10.0, 2.0) if spread else (0.1, 0.1, 0.05))
            smoother.update(GraphUpdate(factors=Factors(
                [at], [k + 1], closure[None], information[None] * rng.choice([0.1, 1.0, 10.0]),
                [FactorKind.LOOP_CLOSURE])), fall_back=bool(rng.random() < 0.5))
    return smoother
