# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""After any edits the smoother agrees with a slow solver; a failed edit leaves no trace."""

from dataclasses import replace
import re

from hypothesis import settings, strategies as st
from hypothesis.stateful import initialize, invariant, rule, RuleBasedStateMachine
import numpy as np
import pytest
from slow_smoother import differences, EXACT, information, SlowGraph, state, world

from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import SmootherConfig
from pose_graph_ros.core.exceptions import GraphUpdateError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother

# Tolerance of poses after an exact step [m, rad].
CLOSE = 1e-6
# Smallest eigenvalue of H, with its diagonal scaled to 1, above which a graph is determined, and
# below which it is not; in between rounding decides.
DETERMINED, NOT_DETERMINED = 1e-7, 1e-13

seeds = st.integers(0, 2**32 - 1)


class Edits(RuleBasedStateMachine):
    """Every edit of a smoother that ends each step at the minimum, against dense matrices."""

    def __init__(self) -> None:
        super().__init__()
        self.smoother = IncrementalSmoother(EXACT)
        self.spared = IncrementalSmoother(EXACT)
        """Receives only the updates that succeed."""
        self.slow = SlowGraph()

    @initialize(seed=seeds)
    def begin(self, seed: int) -> None:
        self.world = world(seed)
        self.update(GraphUpdate(hidden=np.array(self.world.truth), fix=[0]))

    def update(self, update: GraphUpdate) -> None:
        n_before = len(self.slow.poses)
        after = self.slow.edited(update)
        certainty, loose = after.null_space()
        if NOT_DETERMINED < certainty < DETERMINED:
            del self.world.truth[n_before:]
            return
        before = state(self.smoother.graph)
        result = self.smoother.update(update)
        if certainty <= NOT_DETERMINED:
            del self.world.truth[n_before:]
            assert result.status is Status.FAILED
            node = int(re.fullmatch(r'hidden node (\d+) is not determined', result.reason)[1])
            assert np.max(np.abs(loose[3 * node:3 * node + 3])) > 1e-9
            assert differences(before, state(self.smoother.graph)) == []
            return
        assert (result.status, result.reason) == (Status.CONVERGED, '')
        self.spared.update(update)
        self.slow = after.at(self.smoother.poses)
        self.world.gone.update(after.gone)

    @rule(seed=seeds, count=st.integers(1, 3))
    def drive(self, seed: int, count: int) -> None:
        self.world.rng = np.random.default_rng(seed)
        self.update(self.world.new_nodes(count))

    @rule(seed=seeds, anchor=st.sampled_from(['pose', 'fixed', 'positions', 'position', 'none']))
    def start_another_part(self, seed: int, anchor: str) -> None:
        self.world.rng = np.random.default_rng(seed)
        self.update(self.world.new_part(anchor))

    @rule(seed=seeds, count=st.integers(1, 3))
    def close_loops(self, seed: int, count: int) -> None:
        self.world.rng = np.random.default_rng(seed)
        self.update(GraphUpdate(factors=self.world.edges(self.world.pairs(count))))

    @rule(seed=seeds, position=st.booleans(), offset=st.booleans())
    def observe(self, seed: int, position: bool, offset: bool) -> None:
        self.world.rng = np.random.default_rng(seed)
        nodes = self.world.rng.choice(self.world.poses, 2).tolist()
        self.update(GraphUpdate(
            factors=self.world.observed(nodes, position=position, offset=offset)))

    @rule(seed=seeds, count=st.integers(0, 2), measurements=st.integers(0, 3))
    def measure_with_biases(self, seed: int, count: int, measurements: int) -> None:
        self.world.rng = np.random.default_rng(seed)
        self.update(self.world.new_biases(count, measurements))

    @rule(seed=seeds, weight=st.sampled_from([0.0, 0.1, 1.0, 7.0]))
    def weigh(self, seed: int, weight: float) -> None:
        table = self.slow.has_factors()
        if len(table) > 0:
            self.update(GraphUpdate(weigh={table[seed % len(table)]: weight}))

    @rule(seed=seeds)
    def remove(self, seed: int) -> None:
        table = self.slow.has_factors()
        if len(table) > 0:
            rows = table[sorted({seed % len(table), seed // 7 % len(table)})].tolist()
            self.update(GraphUpdate(remove=rows))

    @rule(seed=seeds)
    def fix(self, seed: int) -> None:
        nodes = self.smoother.graph.node_ids
        self.update(GraphUpdate(fix=[nodes[seed % len(nodes)]]))

    @rule(seed=seeds)
    def free(self, seed: int) -> None:
        nodes = self.smoother.graph.node_ids
        self.update(GraphUpdate(free=[nodes[seed % len(nodes)]]))

    @rule(seed=seeds)
    def let_some_leave(self, seed: int) -> None:
        self.world.rng = np.random.default_rng(seed)
        self.update(self.world.leaving(self.slow))

    @rule(seed=seeds)
    def ask_for_what_has_left(self, seed: int) -> None:
        if len(self.slow.gone) > 0:
            node = sorted(self.slow.gone)[seed % len(self.slow.gone)]
            with pytest.raises(GraphUpdateError, match=f'hidden node {node} has left the graph'):
                self.smoother.update(GraphUpdate(fix=[node]))

    @rule(seed=seeds)
    def do_everything_at_once(self, seed: int) -> None:
        self.world.rng = np.random.default_rng(seed)
        self.update(self.world.mixture(self.slow))

    @rule()
    def do_nothing(self) -> None:
        self.update(GraphUpdate())

    @invariant()
    def is_at_the_minimum(self) -> None:
        poses, graph = self.smoother.poses, self.smoother.graph
        if len(poses) == 0:
            return
        assert graph.node_ids.tolist() == np.flatnonzero(self.slow.present).tolist()
        assert graph.factor_ids.tolist() == self.slow.has_factors().tolist()
        assert poses.tobytes() == self.spared.poses.tobytes()
        optimum = self.slow.optimized()
        off = se2.wrapped(optimum.poses[optimum.present] - poses)
        assert np.max(np.abs(off)) < CLOSE
        assert self.smoother.chi2() == pytest.approx(optimum.chi2(), rel=1e-9, abs=1e-9)

    @invariant()
    def knows_a_fixed_node(self) -> None:
        graph = self.smoother.graph
        row = graph.memory.head[tb.FIXED]
        assert graph.fixed[row] if row >= 0 else not np.any(graph.fixed)

    @invariant()
    def counts_its_edges_and_biases(self) -> None:
        graph = self.smoother.graph
        ends = graph.factor_records['ends'][:, :2]
        joins_poses = (ends[:, 1] >= 0) & ~np.any(graph.is_bias[ends], axis=1)
        assert graph.n_biases == np.count_nonzero(graph.is_bias)
        assert graph.n_edges == np.count_nonzero(joins_poses)

    @invariant()
    def has_the_covariances_of_its_linearization(self) -> None:
        graph = self.smoother.graph
        if graph.n_nodes == 0:
            return
        covariance = self.slow.covariance(self.slow.at_ids(information(graph)))
        n, ids = len(self.slow.poses), graph.node_ids
        blocks = covariance.reshape(n, 3, n, 3)[ids, :, ids]
        sigma = np.sqrt(np.einsum('nii->ni', blocks)) + 1e-30
        off = (self.smoother.covariances() - blocks) / sigma[:, :, None] / sigma[:, None, :]
        assert np.max(np.abs(off)) < 1e-6


TestEdits = Edits.TestCase
TestEdits.settings = settings(max_examples=25, stateful_step_count=25)


# --- worlds that are hard for numbers -----------------------------------------------------------

HARD = {
    'far from the origin': {'origin': (5e6, 4e5)},
    'turning round and round': {'turn': 3.0, 'noise': (0.01, 0.01, 0.01)},
    'standing still': {'stride': 0.0, 'noise': (0.01, 0.01, 0.01), 'guess': (0.02, 0.02, 0.02)},
    'long edges': {'stride': 100.0, 'noise': (0.05, 0.05, 0.001), 'guess': (0.1, 0.1, 0.001)},
    'information of all sizes': {
        'weight': lambda rng: 10.0 ** rng.uniform(-2.0, 4.0), 'noise': (0.01, 0.01, 0.005),
        'guess': (0.02, 0.02, 0.01)},
}


@pytest.mark.parametrize('seed', [0, 1])
@pytest.mark.parametrize('name', HARD)
def test_hard_worlds_end_at_the_minimum_as_well(name: str, seed: int) -> None:
    smoother, here, slow = IncrementalSmoother(EXACT), world(seed, **HARD[name]), SlowGraph()
    updates = [GraphUpdate(hidden=np.array(here.truth), fix=[0])]
    for _ in range(25):
        update = updates.pop() if len(updates) > 0 else here.mixture(slow)
        if smoother.update(update).status is Status.FAILED:
            assert slow.edited(update).null_space()[0] < 1e-9
        else:
            slow = slow.edited(update).at(smoother.poses)
        del here.truth[len(slow.poses):]
        # the last digit of a coordinate of the UTM is 1e-9 m
        assert np.max(np.abs(slow.step())) < CLOSE


POSE_INFORMATION = np.array([[100.0, 10.0, 5.0], [10.0, 80.0, -7.0], [5.0, -7.0, 400.0]])


def seen(node: int, pose: object, information: object = POSE_INFORMATION) -> Factors:
    return Factors.on([node], None, [pose], [information], [FactorKind.GLOBAL_POSE])


def link(i: int, j: int, mean: object, information: object = POSE_INFORMATION) -> Factors:
    return Factors([i], [j], [mean], [information], [FactorKind.ODOMETRY])


@pytest.mark.parametrize('step', [0.7, -1.3])
def test_a_node_may_turn_by_many_turns(step: float) -> None:
    # each new heading is a bit further, and the last one no longer counts
    smoother, slow = IncrementalSmoother(EXACT), SlowGraph()
    first = GraphUpdate(hidden=np.zeros((2, 3)), factors=Factors.joined([
        seen(0, np.zeros(3)), link(0, 1, [1.0, 0.0, 0.0])]))
    smoother.update(first)
    slow = slow.edited(first)
    for k in range(1, 40):
        update = GraphUpdate(
            factors=seen(0, [0.0, 0.0, float(se2.wrap(k * step))]),
            remove=[k if k > 1 else 0])
        assert smoother.update(update).status is Status.CONVERGED
        slow = slow.edited(update).at(smoother.poses)
        assert np.max(np.abs(slow.step())) < CLOSE
        assert se2.wrap(smoother.poses[0, 2] - k * step) == pytest.approx(0.0, abs=1e-6)
        assert smoother.chi2() < 1e-9


def test_a_map_turns_about_its_fixed_pose_without_new_linearizations() -> None:
    rng, stiff, weak = np.random.default_rng(0), np.diag((20.0, 20.0, 50.0))**2, np.diag(
        (20.0, 20.0, 2.0))**2
    smoother, at, quarter, seen = IncrementalSmoother(), np.zeros(2), 0, dict[bytes, int]()
    smoother.update(GraphUpdate(hidden=np.zeros((1, 3)), fix=(0,)))
    truth = [np.zeros(3)]
    for k in range(1, 400):     # a walk in a grid, whose first edge knows little of the heading
        quarter += int(rng.integers(-1, 2))
        ahead = np.array((np.cos(quarter * np.pi / 2), np.sin(quarter * np.pi / 2)))
        at = np.clip(at + np.round(ahead), -6, 6)
        truth.append(np.array((*2.0 * at, quarter * np.pi / 2)))
        smoother.extend(se2.between(truth[-2], truth[-1]), weak if k == 1 else stiff)
        before = seen.setdefault(at.tobytes(), k)
        if before < k - 5:
            mean = se2.between(truth[before], truth[k]) + rng.normal(size=3) * 0.01
            smoother.update(GraphUpdate(factors=link(before, k, mean, stiff)))
    turned = se2.compose(np.array((0.0, 0.0, 0.2)), truth[-1])
    result = smoother.update(GraphUpdate(factors=link(0, 399, turned, stiff)))
    assert abs(smoother.poses[1, 2] - truth[1][2]) > 0.1
    assert result.status is Status.CONVERGED
    assert result.relinearized < 100    # of 700; if the fixed pose is eliminated first, 450


# --- failure ------------------------------------------------------------------------------------

def street(n: int, seed: int = 1) -> tuple[IncrementalSmoother, SlowGraph]:
    """Return a chain with loop closures, fixed at its start, default settings."""
    smoother, slow, here = IncrementalSmoother(), SlowGraph(), world(seed, turn=0.2)
    first = GraphUpdate(hidden=np.array(here.truth), fix=[0])
    for update in (first, here.new_nodes(n - 1),
                   GraphUpdate(factors=here.edges(
                       [(k, k + n // 3) for k in range(0, n // 2, 7)]))):
        assert smoother.update(update).status is Status.CONVERGED
        slow = slow.edited(update)
    return smoother, slow


SINGULAR = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
BAD = {
    'a node that nothing holds': lambda n, slow: GraphUpdate(hidden=np.zeros((1, 3))),
    'a node of a position alone': lambda n, slow: GraphUpdate(
        hidden=np.zeros((1, 3)), factors=Factors.on(
            [n], None, np.zeros((1, 3)), [SINGULAR], [FactorKind.POSITION])),
    'an edge that knows no heading': lambda n, slow: GraphUpdate(
        hidden=np.zeros((1, 3)), factors=link(n - 1, n, [1.0, 0.0, 0.0], SINGULAR)),
    'a node that loses its only edge': lambda n, slow: GraphUpdate(
        hidden=np.zeros((1, 3)), factors=link(n - 1, n, [1.0, 0.0, 0.0]),
        remove=[len(slow.factors)]),
    'all that holds the newest node is removed': lambda n, slow: GraphUpdate(
        remove=np.flatnonzero(
            (slow.factors.i == n - 1) | (slow.factors.j == n - 1)).tolist()),
    'the only anchor is freed': lambda n, slow: GraphUpdate(free=[0]),
    'a part of two nodes without anchor': lambda n, slow: GraphUpdate(
        hidden=np.zeros((2, 3)), factors=link(n, n + 1, [1.0, 0.0, 0.0])),
}


@pytest.mark.parametrize('n', [4, 60])
@pytest.mark.parametrize('name', BAD)
def test_a_bad_update_leaves_no_trace(name: str, n: int) -> None:
    smoother, slow = street(n)
    spared, _ = street(n)
    bad = BAD[name](n, slow)
    # with much good in it, so that the whole tree is taken apart before it fails
    rng = np.random.default_rng(3)
    far = [(int(i), int(j)) for i, j in rng.integers(0, n, (20, 2)) if i != j]
    bad = bad._replace(factors=Factors.joined([bad.factors, *(
        link(i, j, rng.normal(size=3)) for i, j in far if n - 1 not in (i, j))]))
    before, poses, chi2 = state(smoother.graph), smoother.poses.copy(), smoother.chi2()
    covariances = smoother.covariances()
    result = smoother.update(bad)
    assert result.status is Status.FAILED
    node = int(re.fullmatch(r'hidden node (\d+) is not determined', result.reason)[1])
    assert 0 <= node < n + len(bad.hidden)
    if len(bad.hidden) > 0:
        assert node >= n
    assert differences(before, state(smoother.graph)) == []
    assert smoother.poses.tobytes() == poses.tobytes()
    assert smoother.chi2() == chi2
    assert smoother.covariances().tobytes() == covariances.tobytes()
    for update in (GraphUpdate(factors=link(0, n - 1, slow.poses[n - 1] + 0.3)),
                   GraphUpdate(hidden=[[0.0, 0.0, 0.0]], factors=link(n - 1, n, [1.0, 0.0, 0.5])),
                   GraphUpdate(remove=[0], weigh={1: 0.5}, fix=[1])):
        assert smoother.update(update)[:5] == spared.update(update)[:5]
        assert smoother.poses.tobytes() == spared.poses.tobytes()


def left_over() -> tuple[IncrementalSmoother, SlowGraph]:
    """Return a smoother that does one iteration at a time and has not yet come to the minimum."""
    smoother, here = IncrementalSmoother(replace(EXACT, max_iterations=1)), world(4)
    slow = SlowGraph()
    for update in (GraphUpdate(hidden=np.array(here.truth), fix=[0]), here.new_nodes(12),
                   GraphUpdate(factors=here.edges([(11, 2), (3, 9), (1, 12)]))):
        smoother.update(update)
        slow = slow.edited(update)
    return smoother, slow


def test_what_is_left_over_is_done_in_the_next_updates() -> None:
    (smoother, slow), (other, _) = left_over(), left_over()
    assert other.update(GraphUpdate(free=[0])).status is Status.FAILED
    steps = []
    for _ in range(12):
        steps.append(np.max(np.abs(slow.at(smoother.poses).step())))
        result = smoother.update(GraphUpdate())
        assert result.iterations <= 1
        # a bad update does not forget it
        other.update(GraphUpdate())
        assert smoother.poses.tobytes() == other.poses.tobytes()
    assert steps[0] > 1e-4
    assert steps[-1] < 1e-8
    assert (result.status, result.iterations) == (Status.CONVERGED, 0)


# --- along a chain ------------------------------------------------------------------------------

@pytest.mark.parametrize('config', [SmootherConfig(), EXACT], ids=['default', 'exact'])
def test_extending_equals_updating(config: SmootherConfig) -> None:
    extended, updated, here = IncrementalSmoother(config), IncrementalSmoother(config), world(3)
    first = GraphUpdate(hidden=np.array(here.truth), factors=seen(0, here.truth[0]))
    extended.update(first)
    updated.update(first)
    for k in range(1, 80):
        here.truth.append(se2.compose(here.truth[-1], np.array([1.0, 0.0, 0.2])))
        mean, information = here.edges([(k - 1, k)]).mean[0], here.informative()
        observed = seen(k, here.disturbed(here.truth[k], here.noise)) if k % 10 == 0 else (
            Factors())
        update = GraphUpdate(
            hidden=se2.compose(updated.poses[-1], mean)[None],
            factors=Factors.joined([link(k - 1, k, mean, information), observed]))
        updated.update(update)
        extended.extend(mean, information)
        if k % 10 == 0:
            extended.update(GraphUpdate(factors=observed))
        if k % 25 == 0:
            # a loop closure, after which the newest node still ends the chain
            for smoother in (extended, updated):
                smoother.update(GraphUpdate(factors=link(
                    k - 20, k, se2.between(here.truth[k - 20], here.truth[k]))))
        # both are within their budget of the minimum
        np.testing.assert_allclose(extended.poses, updated.poses, atol=(
            1e-7 if config is EXACT else 0.03))
        assert extended.chi2() == pytest.approx(updated.chi2(), abs=(
            1e-6 if config is EXACT else 0.05))
    assert extended.graph.factors.mean.tobytes() == updated.graph.factors.mean.tobytes()
    scale = np.sqrt(np.einsum('nii->ni', updated.covariances()))
    off = (extended.covariances() - updated.covariances()) / scale[:, :, None] / scale[:, None]
    assert np.max(np.abs(off)) < 0.05


@pytest.mark.parametrize('weight', [0.01, 100.0])
def test_a_chain_made_with_another_weight_follows_what_pulls_at_it(weight: float) -> None:
    extended, updated = IncrementalSmoother(), IncrementalSmoother()
    mean = np.array([1.0, 0.0, 0.05])
    for smoother in (extended, updated):
        smoother.update(GraphUpdate(hidden=np.zeros((1, 3)), factors=seen(0, np.zeros(3))))
    for k in range(1, 60):
        extended.extend(mean, POSE_INFORMATION, weight)
        updated.update(GraphUpdate(
            hidden=se2.compose(updated.poses[-1], mean)[None],
            factors=link(k - 1, k, mean).replaced(weight=weight)))
    for smoother in (extended, updated):
        # odometry counts as claimed again, and a fix moves the end
        smoother.update(GraphUpdate(weigh=dict.fromkeys(range(1, 60), 1.0)))
        smoother.update(GraphUpdate(factors=seen(
            59, smoother.poses[59] + np.array([3.0, 3.0, 0.0]))))
    np.testing.assert_allclose(extended.poses, updated.poses, rtol=0.0, atol=1e-3)
