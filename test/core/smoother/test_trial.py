# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A trial of other weights ends where an update with them would, whatever happens meanwhile."""

from hypothesis import given, settings, strategies as st
import numpy as np
from slow_smoother import differences, EXACT, SlowGraph, state, World, world

from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.graph.constraints import EdgeKind, Edges
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.smoother.results import DIVERGED
from pose_graph_ros.core.smoother.trial import Trial

seeds = st.integers(0, 2**32 - 1)


def driven(here: World, steps: int = 12) -> IncrementalSmoother:
    smoother = IncrementalSmoother(EXACT)
    smoother.update(GraphUpdate(hidden=np.array(here.truth), fix=[0]))
    for _ in range(steps):
        smoother.update(here.new_nodes(2))
        smoother.update(GraphUpdate(edges=here.edges(here.pairs(1))))
    return smoother


def optimum(smoother: IncrementalSmoother) -> np.ndarray:
    graph = smoother.graph
    slow = SlowGraph(graph.poses.copy(), graph.fixed, graph.edges, graph.observed)
    return slow.optimized().poses


def finished(trial: Trial) -> int:
    """Do all the work of a trial; return the number of parts."""
    parts = 1
    while trial.work():
        parts += 1
    return parts


def status(trial: Trial) -> Status:
    assert trial.result is not None
    return trial.result.status


@given(seeds)
@settings(max_examples=15)
def test_it_is_adopted_with_all_that_was_added_meanwhile(seed: int) -> None:
    here = world(seed)
    smoother = driven(here)
    n = smoother.graph.n_edges
    weights = dict.fromkeys(here.rng.choice(n, 3, replace=False).tolist(), 0.3)
    trial = smoother.trial(GraphUpdate(weigh_edges=weights))
    changed = {int(row): 0.5 for row in here.rng.choice(n, 3)}
    for edit in (
            GraphUpdate(weigh_edges=changed), here.new_nodes(3), here.new_biases(2, 3),
            here.new_nodes(2), GraphUpdate(observed=here.observed([3, 5])), GraphUpdate(fix=[4])):
        assert trial.work()
        assert smoother.update(edit).status is not Status.FAILED
    finished(trial)
    assert trial.result is not None
    before, poses = smoother.graph.rows(), smoother.poses.copy()
    assert smoother.adopt(trial).status is Status.CONVERGED
    after = smoother.graph.rows()
    for name in ('is_bias', 'fixed'):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    for one, other in ((after.edges, before.edges), (after.observed, before.observed)):
        for column, expected in zip(one.columns, other.columns, strict=True):
            if column is not one.weight:
                np.testing.assert_allclose(column, expected, rtol=1e-15)
    expected = {**changed, **weights}
    np.testing.assert_array_equal(
        after.edges.weight, [expected.get(row, 1.0) for row in range(len(after.edges))])
    assert smoother.graph.newest_pose == np.flatnonzero(~after.is_bias)[-1]
    assert not np.array_equal(smoother.poses, poses)
    difference = smoother.poses - optimum(smoother)
    difference[:, 2] = se2.wrap(difference[:, 2])
    np.testing.assert_allclose(difference, 0.0, atol=1e-6)
    assert smoother.update(here.new_nodes(1)).status is Status.CONVERGED


def test_without_a_result_or_with_other_poses_nothing_is_adopted() -> None:
    here = world(6)
    smoother = driven(here, 3)
    ends = smoother.graph.edges
    loose = np.flatnonzero((ends.i == 2) | (ends.j == 2))
    trial = smoother.trial(GraphUpdate(weigh_edges=dict.fromkeys(loose.tolist(), 0.0)))
    finished(trial)
    assert status(trial) is Status.FAILED
    before = state(smoother.graph)
    assert smoother.adopt(trial).status is Status.FAILED
    trial = smoother.trial(GraphUpdate(weigh_edges={1: 0.5}))
    finished(trial)
    assert differences(before, state(smoother.graph)) == []
    smoother.graph.set_poses(se2.compose(np.array([5.0, 0.0, 1.0]), smoother.poses))
    assert trial.is_outdated
    assert smoother.adopt(trial).status is Status.FAILED


def test_an_update_that_diverges_can_be_left_to_a_trial() -> None:
    # a chain that closes by a heading that is off by more than a linear model stands
    smoother, here = IncrementalSmoother(), world(2)
    smoother.update(GraphUpdate(hidden=np.array(here.truth), fix=[0]))
    for _ in range(300):
        smoother.extend(np.array([1.0, 0.0, 0.02]), np.diag([100.0, 100.0, 400.0]))
    edges = Edges([0, 50], [300, 250], [[0.0, 3.0, -0.4], [3.0, 90.0, 2.5]],
                  [np.diag([1e4, 1e4, 1e4])] * 2, [EdgeKind.LOOP_CLOSURE] * 2, weight=[0.0, 0.0])
    smoother.update(GraphUpdate(edges=edges))
    before, weights = state(smoother.graph), GraphUpdate(weigh_edges={300: 1.0, 301: 1.0})
    result = smoother.update(weights, fall_back=False)
    assert (result.status, result.reason) == (Status.FAILED, DIVERGED)
    assert differences(before, state(smoother.graph)) == []
    trial = smoother.trial(weights)
    finished(trial)
    assert smoother.adopt(trial).status is not Status.FAILED
    there = smoother.chi2()
    again = IncrementalSmoother()
    again.graph.fill(smoother.graph.rows())
    assert again.update(GraphUpdate()).status is not Status.FAILED
    assert again.chi2() <= there * (1.0 + 1e-6)


def test_a_minimum_that_later_updates_would_diverge_at_is_not_adopted() -> None:
    # wrong closures bend a chain until Gauss-Newton leads away from the minimum
    smoother, rng, n = IncrementalSmoother(), np.random.default_rng(4), 6
    smoother.update(GraphUpdate(hidden=np.zeros((1, 3)), fix=[0]))
    for _ in range(300):
        smoother.extend(np.array([1.0, 0.0, 0.02]), np.diag([100.0, 100.0, 400.0]))
    i = rng.integers(0, 140, n)
    edges = Edges(i, i + rng.integers(100, 160, n), rng.uniform(-1.0, 1.0, (n, 3)) * (30, 30, 3),
                  [np.diag([1e4, 1e4, 1e4])] * n, [EdgeKind.LOOP_CLOSURE] * n, weight=[0.0] * n)
    smoother.update(GraphUpdate(edges=edges))
    before = state(smoother.graph)
    trial = smoother.trial(GraphUpdate(weigh_edges=dict.fromkeys(range(300, 300 + n), 1.0)))
    assert finished(trial) < 100
    assert status(trial) is Status.FAILED
    assert smoother.adopt(trial).status is Status.FAILED
    assert differences(before, state(smoother.graph)) == []
