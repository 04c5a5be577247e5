# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Nodes leave the graph of a smoother; `test_incremental` has the law for all edits.

Here are what takes long, needs a copy, or fails.
"""

import numpy as np
import pytest
from slow_smoother import differences, EXACT, SlowGraph, state, world

from pose_graph_ros.core.batch import optimizer
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.graph.constraints import EdgeKind, Edges
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.solver_config import SolverConfig

MOTION, INFORMATION = np.array([1.0, 0.0, 0.1]), np.diag([100.0, 100.0, 400.0])


def slow(smoother: IncrementalSmoother) -> SlowGraph:
    """Return a slow graph built anew from the rows."""
    graph = smoother.graph
    return SlowGraph(graph.poses.copy(), graph.fixed, graph.edges_by_row, graph.observed_by_row)


def assert_at_minimum(smoother: IncrementalSmoother) -> None:
    off = slow(smoother).optimized().poses - smoother.poses
    off[:, 2] = se2.wrap(off[:, 2])
    np.testing.assert_allclose(off, 0.0, atol=1e-9)


def test_memory_stays_flat_while_nodes_come_and_go() -> None:
    smoother, rng, n = IncrementalSmoother(), np.random.default_rng(0), 25
    smoother.update(GraphUpdate(hidden=np.zeros((1, 3)), fix=[0]))
    sizes = []
    for k in range(1, 4000):
        smoother.extend(MOTION, INFORMATION)
        oldest = k - n
        if oldest >= 0:
            edges = Edges([k - int(rng.integers(2, n - 2))], [k], [rng.normal(size=3) * 0.1],
                          [0.01 * INFORMATION], [EdgeKind.LOOP_CLOSURE],
                          weight=[float(k % 3 == 0)])
            assert smoother.update(GraphUpdate(
                edges=edges, remove_nodes=[oldest], fix=[oldest + 1])).status is not Status.FAILED
        if k in (2000, 3999):
            head = smoother.graph.memory.head
            sizes.append([len(smoother.graph.memory[name]) for name in tb.NAMES] + head[[
                tb.N_NODES, tb.POOL_F_END, tb.POOL_I_END, tb.N_CLIQUES, tb.N_WAITING]].tolist())
    assert sizes[0][:-4] == sizes[1][:-4]
    np.testing.assert_allclose(sizes[0][-4:-1], sizes[1][-4:-1], rtol=0.3)
    graph = smoother.graph
    assert (graph.n_nodes, graph.newest_pose) == (n, 3999)
    assert graph.node_ids.tolist() == list(range(4000 - n, 4000))
    assert smoother.covariance(3990).shape == (3, 3)
    with pytest.raises(ValueError, match='hidden node 17 has left the graph'):
        smoother.covariance(17)


def driven(seed: int, steps: int = 12) -> tuple[IncrementalSmoother, object]:
    here, smoother = world(seed), IncrementalSmoother(EXACT)
    smoother.update(GraphUpdate(hidden=np.array(here.truth), fix=[0]))
    for _ in range(steps):
        smoother.update(here.new_nodes(2))
        smoother.update(GraphUpdate(edges=here.edges(here.pairs(2))))
    return smoother, here


def let_leave(smoother: IncrementalSmoother, here: object, nodes: list[int]) -> bool:
    """Remove nodes; tell whether the others are determined without them."""
    left = smoother.update(GraphUpdate(remove_nodes=nodes)).status is Status.CONVERGED
    here.gone.update(nodes if left else ())     # type: ignore[attr-defined]
    return left


@pytest.mark.parametrize('seed', range(4))
def test_a_trial_is_adopted_although_nodes_have_left_meanwhile(seed: int) -> None:
    smoother, here = driven(seed)
    chosen = {int(edge): 0.3 for edge in here.rng.choice(smoother.graph.edge_ids, 4)}
    trial = smoother.trial(GraphUpdate(weigh_edges=chosen))
    trial.work()
    first = smoother.graph.next_ids
    smoother.update(here.new_nodes(3))
    gone = [7, first.node]
    assert let_leave(smoother, here, gone) or let_leave(smoother, here, gone[:1])
    edges = here.edges([(2, 9)])
    smoother.update(GraphUpdate(edges=edges, fix=[3], weigh_edges={int(
        smoother.graph.edge_ids[-1]): 0.7}))
    while trial.work():
        pass
    before = smoother.graph.rows()
    assert smoother.adopt(trial).status is Status.CONVERGED
    after = smoother.graph.rows()
    for name in ('node_ids', 'edge_ids', 'observed_ids', 'fixed'):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    assert after.next_ids == before.next_ids
    expected = [chosen.get(number, weight) for number, weight in zip(
        before.edge_ids.tolist(), before.edges.weight.tolist(), strict=True)]
    assert after.edges.weight.tolist() == expected
    assert_at_minimum(smoother)


def test_the_batch_fallback_lets_nodes_leave_as_well() -> None:
    # a chain that closes by a heading that is off by more than a linear model stands
    smoother, here = IncrementalSmoother(), world(2)
    smoother.update(GraphUpdate(hidden=np.array(here.truth), fix=[0]))
    for _ in range(300):
        smoother.extend(np.array([1.0, 0.0, 0.02]), INFORMATION)
    closures = Edges([1, 50], [300, 250], [[0.0, 3.0, -0.4], [3.0, 90.0, 2.5]],
                     [np.diag([1e4, 1e4, 1e4])] * 2, [EdgeKind.LOOP_CLOSURE] * 2)
    update = GraphUpdate(edges=closures, remove_nodes=[0], fix=[1])
    before = state(smoother.graph)
    assert smoother.update(update, fall_back=False).status is Status.FAILED
    assert differences(before, state(smoother.graph)) == []
    assert smoother.update(update).status is not Status.FAILED
    assert smoother.graph.node_ids.tolist() == list(range(1, 301))
    assert smoother.graph.edge_ids.tolist() == list(range(1, 302))
    anew = Graph()
    anew.fill(smoother.graph.rows())
    result = optimizer.optimize_from_linear_start(anew, SolverConfig())
    assert smoother.chi2() == pytest.approx(result.chi2, rel=1e-3)


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
    smoother, _ = driven(4, 3)
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
