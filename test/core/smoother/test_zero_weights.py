# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rows with weight 0 are as if they were not there: to updates, refinements and the optimiser."""

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from slow_smoother import differences, state, World, world

from pose_graph_ros.core.batch import optimizer
from pose_graph_ros.core.batch.optimizer import chi2_of
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.graph.constraints import Factors
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother

seeds = st.integers(0, 2**32 - 1)


class Twins:
    """A smoother with rows of weight 0 between the others, and one without any."""

    def __init__(self, seed: int) -> None:
        self.here: World = world(seed, noise=(0.2, 0.2, 0.1))
        self.full, self.bare = IncrementalSmoother(), IncrementalSmoother()
        self.idle: list[int] = []
        """Rows of the full graph with weight 0."""
        first = GraphUpdate(hidden=np.array(self.here.truth), fix=[0])
        self.update(first)

    def update(self, update: GraphUpdate) -> None:
        """Do an update in both, in one of them with false constraints of weight 0."""
        expected = self.bare.update(update)
        n = self.full.graph.n_nodes + len(update.hidden)
        idle = self.here.edges([])
        if n > 2:
            rng = self.here.rng
            idle = self.here.edges([tuple(rng.choice(n, 2, replace=False)) for _ in range(2)])
            idle = Factors.joined([idle, self.here.observed([int(rng.integers(n))])])
        idle.mean[:] += 30.0
        idle.weight[:] = 0.0
        at = self.full.graph.n_factors
        self.idle += range(at, at + len(idle))
        actual = self.full.update(update._replace(factors=Factors.joined([idle, update.factors])))
        assert actual == expected

    def drive(self, steps: int) -> None:
        for _ in range(steps):
            update = self.here.new_nodes(int(self.here.rng.integers(1, 3)))
            more = self.here.edges(self.here.pairs(int(self.here.rng.integers(0, 2))))
            self.update(update._replace(factors=Factors.joined([update.factors, more])))

    def check(self) -> None:
        full, bare = self.full, self.bare
        np.testing.assert_allclose(full.poses, bare.poses, rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(full.covariances(), bare.covariances(), rtol=1e-9, atol=1e-15)
        assert chi2_of(full.graph) == pytest.approx(chi2_of(bare.graph), rel=1e-9, abs=1e-9)
        assert full.graph.energies().chi2 == pytest.approx(chi2_of(full.graph), abs=1e-6)
        assert not np.any(full.graph.energies().factors[self.idle])


@given(seeds, st.integers(1, 20))
@settings(max_examples=20)
def test_a_drive_is_the_same_with_and_without_them(seed: int, steps: int) -> None:
    twins = Twins(seed)
    twins.drive(steps)
    twins.check()
    for smoother in (twins.full, twins.bare):
        for _ in range(20):
            if smoother.refine().finished:
                break
    twins.check()
    results = [optimizer.optimize_from_linear_start(smoother.graph, SolverConfig())
               for smoother in (twins.full, twins.bare)]
    assert results[0].status is results[1].status
    np.testing.assert_allclose(twins.full.poses, twins.bare.poses, rtol=0.0, atol=1e-9)


def test_adding_them_solves_nothing() -> None:
    twins = Twins(3)
    twins.drive(15)
    graph = twins.full.graph
    before, cliques = state(graph), graph.memory['cliques'].copy()
    idle = Factors.joined([twins.here.edges([(0, 9), (4, 12)]), twins.here.observed([7, 7])])
    idle.weight[:] = 0.0
    result = twins.full.update(GraphUpdate(factors=idle))
    assert result[2:6] == (0, 0, 0, 0)
    np.testing.assert_array_equal(graph.memory['cliques'], cliques)
    assert set(differences(before, state(graph))) == {'factors', 'factor_id', 'next'}
