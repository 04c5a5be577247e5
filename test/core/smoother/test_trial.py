# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Copies for the batch optimiser: trials end where an update would; fallbacks of steps."""

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from slow_smoother import differences, EXACT, SlowGraph, state, World, world

from pose_graph_ros.core.batch import optimizer
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.factors import energies
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.smoother.incremental import DIVERGED, IncrementalSmoother
from pose_graph_ros.core.smoother.trial import Trial

seeds = st.integers(0, 2**32 - 1)


def explored(here: World, steps: int = 12) -> IncrementalSmoother:
    smoother = IncrementalSmoother(EXACT)
    smoother.update(GraphUpdate(hidden=np.array(here.truth), fix=[0]))
    for _ in range(steps):
        smoother.update(here.new_nodes(2))
        smoother.update(GraphUpdate(factors=here.edges(here.pairs(2))))
    return smoother


def bent_chain(edges: Factors) -> IncrementalSmoother:
    """Return a chain of 301 nodes with edges that differ from it by more than a model bears."""
    smoother = IncrementalSmoother()
    smoother.update(GraphUpdate(hidden=np.zeros((1, 3)), fix=[0]))
    for _ in range(300):
        smoother.extend(np.array([1.0, 0.0, 0.02]), np.diag([100.0, 100.0, 400.0]))
    smoother.update(GraphUpdate(factors=edges))
    return smoother


def stiff(i: object, j: object, mean: object, weight: float) -> Factors:
    n = len(i)
    return Factors(i, j, mean, [1e4 * np.eye(3)] * n, [FactorKind.LOOP_CLOSURE] * n,
                 weight=[weight] * n)


def closures(first: int, weight: float) -> Factors:
    """Return what closes the chain by a heading that is off."""
    return stiff([first, 50], [300, 250], [[0.0, 3.0, -0.4], [3.0, 90.0, 2.5]], weight)


def finished(trial: Trial) -> int:
    """Do all the work of a trial; return the number of parts."""
    parts = 1
    while trial.work():
        parts += 1
    return parts


def status(trial: Trial) -> Status:
    assert trial.result is not None
    return trial.result.status


@given(seeds, st.booleans())
@settings(max_examples=15)
def test_it_is_adopted_with_all_that_was_done_meanwhile(seed: int, leave: bool) -> None:
    here = world(seed)
    smoother = explored(here)
    chosen = {int(edge): 0.3 for edge in here.rng.choice(smoother.graph.factor_ids, 4)}
    trial = smoother.trial(GraphUpdate(weigh=chosen))
    changed = {int(edge): 0.5 for edge in here.rng.choice(smoother.graph.factor_ids, 3)}
    first = smoother.graph.next_ids.node
    for edit in (
            lambda: GraphUpdate(weigh=changed), lambda: here.new_nodes(3),
            lambda: here.new_biases(2, 3), lambda: here.new_nodes(2),
            lambda: GraphUpdate(factors=here.observed([3, 5])), lambda: GraphUpdate(fix=[4])):
        assert trial.work()
        assert smoother.update(edit()).status is not Status.FAILED
    for node in (7, first) if leave else ():    # unless it holds others
        smoother.update(GraphUpdate(remove_nodes=[node]))
    finished(trial)
    before, poses = smoother.graph.rows(), smoother.poses.copy()
    assert smoother.adopt(trial).status is Status.CONVERGED
    after = smoother.graph.rows()
    for name in ('node_ids', 'factor_ids', 'is_bias', 'fixed'):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    assert after.next_ids == before.next_ids
    for column, expected in zip(after.factors.replaced(weight=1.0).columns,
                                before.factors.replaced(weight=1.0).columns, strict=True):
        np.testing.assert_allclose(column, expected, rtol=1e-15)
    expected = {**changed, **chosen}
    assert after.factors.weight.tolist() == [
        expected.get(edge, 1.0) for edge in before.factor_ids.tolist()]
    assert not np.array_equal(smoother.poses, poses)
    graph = smoother.graph
    slow = SlowGraph(graph.poses.copy(), graph.fixed, graph.factors_by_row)
    np.testing.assert_allclose(
        se2.wrapped(smoother.poses - slow.optimized().poses), 0.0, atol=1e-6)
    assert smoother.update(here.new_nodes(0)).status is Status.CONVERGED


def test_without_a_result_or_with_other_poses_nothing_is_adopted() -> None:
    here = world(6)
    smoother = explored(here, 3)
    ends = smoother.graph.factors
    loose = np.flatnonzero((ends.i == 2) | (ends.j == 2))
    trial = smoother.trial(GraphUpdate(weigh=dict.fromkeys(loose.tolist(), 0.0)))
    finished(trial)
    assert status(trial) is Status.FAILED
    before = state(smoother.graph)
    assert smoother.adopt(trial).status is Status.FAILED
    trial = smoother.trial(GraphUpdate(weigh={1: 0.5}))
    finished(trial)
    assert differences(before, state(smoother.graph)) == []
    smoother.graph.set_poses(se2.compose(np.array([5.0, 0.0, 1.0]), smoother.poses))
    assert trial.is_outdated
    assert smoother.adopt(trial).status is Status.FAILED


def test_an_update_that_diverges_can_be_left_to_a_trial() -> None:
    smoother = bent_chain(closures(0, 0.0))
    before, weights = state(smoother.graph), GraphUpdate(weigh={300: 1.0, 301: 1.0})
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


def test_the_batch_fallback_lets_nodes_leave_as_well() -> None:
    smoother = bent_chain(Factors())
    update = GraphUpdate(factors=closures(1, 1.0), remove_nodes=[0], fix=[1])
    assert smoother.update(update).status is not Status.FAILED
    assert smoother.graph.node_ids.tolist() == list(range(1, 301))
    assert smoother.graph.factor_ids.tolist() == list(range(1, 302))
    anew = Graph()
    anew.fill(smoother.graph.rows())
    result = optimizer.optimize_from_linear_start(anew, SolverConfig())
    assert smoother.chi2() == pytest.approx(result.chi2, rel=1e-3)


def crossed(seed: int) -> IncrementalSmoother:
    """Return a bent chain with six wrong closures of weight 0: Gauss-Newton leads away."""
    rng = np.random.default_rng(seed)
    i = rng.integers(0, 140, 6)
    return bent_chain(stiff(
        i, i + rng.integers(100, 160, 6), rng.uniform(-1.0, 1.0, (6, 3)) * (30, 30, 3), 0.0))


CROSSING = dict.fromkeys(range(300, 306), 1.0)


def test_a_minimum_that_later_updates_would_diverge_at_is_not_adopted() -> None:
    smoother = crossed(4)
    before = state(smoother.graph)
    trial = smoother.trial(GraphUpdate(weigh=CROSSING))
    assert finished(trial) < 100
    assert status(trial) is Status.FAILED
    assert smoother.adopt(trial).status is Status.FAILED
    assert differences(before, state(smoother.graph)) == []


@pytest.mark.parametrize('seed', [2, 5, 36])
def test_no_update_ends_uphill(seed: int) -> None:
    """Where the batch finds no minimum that a step stays at, the graph is as before."""
    smoother = crossed(seed)
    before, factors = state(smoother.graph), smoother.graph.factors_at(np.array([*CROSSING]))
    highest = float(np.sum(energies(smoother.graph.errors(factors), factors.information)))
    result = smoother.update(GraphUpdate(weigh=CROSSING))
    assert smoother.chi2() < highest
    if result.status is Status.FAILED:
        assert differences(before, state(smoother.graph)) == []
    for weight in (0.999, 0.998, 0.997):
        smoother.update(GraphUpdate(weigh={300: weight}))
        assert smoother.chi2() < highest
