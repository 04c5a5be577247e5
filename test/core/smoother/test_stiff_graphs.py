# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Nearly singular covariances: batch and smoother reach the optimum of an orthogonal solver."""

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from stiff_graphs import stiff_graph, StiffGraph

from pose_graph_ros.core.batch import optimizer
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother

# Decades of the information in the stiff direction above the others.
DECADES = (0.0, 6.0, 10.0, 11.5)
# Relative difference of chi2 at the minimum of a batch optimisation.
SAME_CHI2 = 1e-6
# Largest chi2 of the smoother above its minimum, after each step.
EXCESS = 0.02
# Largest error of a covariance, in products of the sigmas; processors round differently.
COVARIANCE = 0.05

seeds = st.integers(0, 2**32 - 1)


def replay(made: StiffGraph, at_end: bool) -> IncrementalSmoother:
    """Return a smoother that got the edges of each node as it came, or all loops at the end."""
    smoother, edges = IncrementalSmoother(), made.edges
    smoother.update(GraphUpdate(hidden=made.poses[:1], fix=[0]))
    last, is_loop = np.maximum(edges.i, edges.j), np.abs(edges.j - edges.i) > 1
    updates = [np.flatnonzero((last == k) & ~(is_loop & at_end))
               for k in range(1, len(made.poses))]
    for k, rows in enumerate(updates, 1):
        pose = se2.compose(smoother.poses[k - 1], edges.mean[k - 1])
        result = smoother.update(GraphUpdate(hidden=pose[None], factors=edges.rows(rows)))
        assert result.reason == ''
    if at_end:
        result = smoother.update(GraphUpdate(factors=edges.rows(np.flatnonzero(is_loop))))
        assert result.reason == ''
    for _ in range(3):
        smoother.update(GraphUpdate())
    return smoother


@pytest.mark.parametrize('decades', DECADES)
@settings(max_examples=4, deadline=None)
@given(seed=seeds, from_odometry=st.booleans())
def test_the_batch_reaches_the_optimum(decades: float, seed: int, from_odometry: bool) -> None:
    made = stiff_graph(seed, decades)
    _, chi2, _ = made.optimum()
    graph = made.graph()
    solve = optimizer.optimize if from_odometry else optimizer.optimize_from_linear_start
    result = solve(graph, SolverConfig(max_iterations=100))
    assert result.status is Status.CONVERGED
    assert result.chi2 == pytest.approx(chi2, rel=SAME_CHI2)


@pytest.mark.parametrize('decades', DECADES)
@settings(max_examples=4, deadline=None)
@given(seed=seeds, at_end=st.booleans())
def test_the_smoother_reaches_the_optimum(decades: float, seed: int, at_end: bool) -> None:
    made = stiff_graph(seed, decades)
    _, chi2, _ = made.optimum()
    assert replay(made, at_end).chi2() == pytest.approx(chi2, abs=EXCESS)


@pytest.mark.parametrize('decades', DECADES)
@settings(max_examples=4, deadline=None)
@given(seed=seeds)
def test_covariances_are_those_of_an_orthogonal_solver(decades: float, seed: int) -> None:
    made = stiff_graph(seed, decades)
    poses, _, expected = made.optimum()
    smoother = IncrementalSmoother()
    smoother.update(GraphUpdate(hidden=poses, factors=made.edges, fix=[0]))
    sigmas = np.sqrt(np.einsum('nii->ni', expected[1:]))
    scale = sigmas[:, :, None] * sigmas[:, None, :]
    difference = np.abs(smoother.covariances()[1:] - expected[1:]) / scale
    assert np.max(difference) < COVARIANCE
    np.testing.assert_allclose(smoother.newest_covariance() / scale[-1],
                               expected[-1] / scale[-1], atol=COVARIANCE)
    assert smoother.joint_covariance(1, len(poses) - 1).shape == (6, 6)


@pytest.mark.parametrize('decades', [8.0, 11.0])
def test_a_part_that_nothing_holds_is_still_refused(decades: float) -> None:
    made = stiff_graph(3, decades)
    smoother = IncrementalSmoother()
    refused = [smoother.update(GraphUpdate(hidden=made.poses[:n], factors=made.edges.rows(
        np.flatnonzero(np.maximum(made.edges.i, made.edges.j) < n)))).status
        for n in range(2, len(made.poses))]
    assert set(refused) == {Status.FAILED}
