# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Dense priors: a quadratic form that turns with its nodes, the same for smoother and batch."""

from dataclasses import replace
from typing import Any

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from random_graphs import random_poses
from random_priors import random_prior, rigid_motions
from slow_smoother import differences, EXACT, SlowGraph, state, world

from pose_graph_ros.core.batch import gauss_newton, optimizer
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.exceptions import GraphUpdateError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.priors import model, packed
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother

seeds, flags = st.integers(0, 2**32 - 1), st.booleans()


@given(seeds, st.integers(1, 5), flags)
def test_the_gradient_is_the_derivative_of_the_energy(seed: int, k: int, anchored: bool) -> None:
    rng = np.random.default_rng(seed)
    reference = random_poses(rng, k)
    prior = random_prior(rng, list(range(k)), reference, anchored=anchored)
    poses = reference + rng.normal(0.0, 0.3, (k, 3))
    is_pose = np.ones(k, np.bool_)
    found, step = model(prior, poses, is_pose), 1e-6
    numeric = [
        (model(prior, poses + change, is_pose).energy
         - model(prior, poses - change, is_pose).energy) / (4.0 * step)
        for change in step * np.eye(3 * k).reshape(-1, k, 3)]
    np.testing.assert_allclose(
        found.gradient, numeric, atol=1e-5 * np.max(np.abs(prior.information)))


@given(seeds, st.integers(1, 5), st.floats(-4.0, 4.0))
def test_a_rigid_motion_changes_nothing_in_a_relative_prior(
    seed: int, k: int, angle: float,
) -> None:
    rng = np.random.default_rng(seed)
    reference = random_poses(rng, k)
    prior = random_prior(rng, list(range(k)), reference, anchored=False)
    poses = reference + rng.normal(0.0, 0.3, (k, 3))
    moved = se2.compose(np.array((*rng.normal(size=2), angle)), poses)
    is_pose = np.ones(k, np.bool_)
    before, after = model(prior, poses, is_pose), model(prior, moved, is_pose)
    tolerance = 1e-8 * np.max(np.abs(prior.information))
    np.testing.assert_allclose(after.energy, before.energy, atol=tolerance)
    # nor does it gain any information on where the nodes are
    np.testing.assert_allclose(after.information @ rigid_motions(moved), 0.0, atol=tolerance)
    np.testing.assert_allclose(after.gradient @ rigid_motions(moved), 0.0, atol=tolerance)


@given(seeds, st.integers(2, 5), st.floats(-4.0, 4.0))
def test_relative_information_in_an_anchored_prior_says_nothing_about_the_map(
    seed: int, k: int, angle: float,
) -> None:
    """Whatever the poses are, a rigid motion has the information that it had at the reference."""
    rng = np.random.default_rng(seed)
    reference, is_pose = random_poses(rng, k), np.ones(k, np.bool_)
    relative = random_prior(rng, list(range(k)), reference, anchored=False)
    poses = se2.compose(
        np.array((*rng.normal(size=2), angle)), reference + rng.normal(0.0, 0.3, (k, 3)))
    tolerance = 1e-8 * np.max(np.abs(relative.information))
    found = model(replace(relative, anchored=True), poses, is_pose).information
    np.testing.assert_allclose(found @ rigid_motions(poses), 0.0, atol=tolerance)
    # and the whole has no more of it than a pose of the first node with the same information
    motions = rigid_motions(reference - (*reference[0, :2], 0.0))
    root = 10.0 * rng.normal(size=(3, 3 * k))
    U = relative.information + root.T @ root
    moved = model(replace(relative, anchored=True, information=U), poses, is_pose).information
    gained = rigid_motions(poses - (*reference[0, :2], 0.0))
    np.testing.assert_allclose(
        np.linalg.slogdet(gained.T @ moved @ gained), np.linalg.slogdet(motions.T @ U @ motions),
        atol=1e-6)


def graph_with_priors(seed: int, *, held: bool) -> tuple[IncrementalSmoother, Any]:
    """Return a smoother of a random world with a relative and an anchored prior."""
    here = world(seed)
    smoother = IncrementalSmoother(EXACT)
    smoother.update(GraphUpdate(hidden=np.array(here.truth), fix=[0]))
    smoother.update(here.new_nodes(9))
    smoother.update(GraphUpdate(factors=here.edges(here.pairs(2))))
    rng, poses = here.rng, np.array(here.truth)
    priors = []
    for anchored in (False, True):
        nodes = rng.permutation(10)[:rng.integers(1, 5)].tolist()
        reference = se2.wrapped(poses[nodes] + rng.normal(0.0, 0.02, (len(nodes), 3)))
        priors.append(random_prior(rng, nodes, reference, anchored=anchored))
    result = smoother.update(GraphUpdate(priors=priors, free=[] if held else [0]))
    assert result.status is Status.CONVERGED
    return smoother, here


def dense_covariances(graph: Graph) -> FloatArray:
    """Return the covariances of all nodes, shape (N, 3, 3), at their poses, by a dense inverse."""
    slow = SlowGraph(graph.poses, graph.fixed, graph.factors)
    H, _ = slow.system()
    for prior in graph.priors:
        at = (3 * prior.nodes[:, None] + np.arange(3)).ravel()
        linear = model(prior, graph.poses[prior.nodes], graph.is_pose[prior.nodes])
        H[np.ix_(at, at)] += linear.information
    free = np.repeat(~graph.fixed, 3)
    whole = np.zeros_like(H)
    whole[np.ix_(free, free)] = np.linalg.inv(H[np.ix_(free, free)])
    return np.array([whole[k:k + 3, k:k + 3] for k in range(0, len(whole), 3)])


@given(seeds, flags)
@settings(max_examples=25)
def test_smoother_and_batch_find_the_same_minimum(seed: int, held: bool) -> None:
    smoother, here = graph_with_priors(seed, held=held)
    for _ in range(2):
        copy = Graph()
        copy.fill(smoother.graph.rows())
        result = optimizer.optimize(copy, SolverConfig())
        assert result.status is Status.CONVERGED
        right = np.empty((copy.n_nodes, 3))
        gauss_newton.evaluate(copy.memory.head, right)
        information = max(float(np.max(p.information)) for p in copy.priors)
        np.testing.assert_allclose(right[~copy.fixed], 0.0, atol=1e-6 * information)
        np.testing.assert_allclose(smoother.poses, copy.poses, atol=1e-6)
        np.testing.assert_allclose(smoother.chi2(), result.chi2, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(copy.energies().chi2, result.chi2, rtol=1e-8, atol=1e-8)
        # arms of Jacobians may lag by one per cent (`factors.MUCH_LONGER`); without that lag the
        # covariances are those of the matrix at these poses
        expected = dense_covariances(copy)
        largest = float(np.max(np.abs(expected)))
        np.testing.assert_allclose(smoother.covariances(), expected, atol=0.03 * largest)
        copy.set_poses(copy.poses)
        anew = IncrementalSmoother(EXACT, copy)
        assert anew._eliminate().status is not Status.FAILED
        np.testing.assert_allclose(anew.covariances(), expected, atol=1e-9 * largest)
        smoother.update(here.joined(
            here.new_nodes(2), factors=here.observed([int(here.rng.integers(10))])))


@given(seeds, flags)
@settings(max_examples=25)
def test_priors_survive_what_removes_all_cliques(seed: int, held: bool) -> None:
    smoother, _ = graph_with_priors(seed, held=held)
    before = smoother.graph.priors
    graph = Graph()
    graph.fill(smoother.graph.rows())
    assert optimizer.optimize(graph, SolverConfig()).status is Status.CONVERGED
    graph.set_poses(graph.poses)
    assert IncrementalSmoother(EXACT, graph)._eliminate().status is not Status.FAILED
    key = {prior.nodes.tobytes(): prior for prior in graph.priors}
    assert len(key) == len(before)
    for prior in before:
        assert packed(prior).tobytes() == packed(key[prior.nodes.tobytes()]).tobytes()


@given(seeds)
@settings(max_examples=15)
def test_a_failed_update_takes_its_priors_back(seed: int) -> None:
    smoother, here = graph_with_priors(seed, held=True)
    before = state(smoother.graph)
    lost = here.drive(0)[None]     # a node that nothing determines
    prior = random_prior(here.rng, [0, 1], smoother.poses[:2].copy(), anchored=False)
    result = smoother.update(GraphUpdate(hidden=lost, priors=[prior]))
    assert result.status is Status.FAILED
    assert differences(before, state(smoother.graph)) == []
    assert len(smoother.graph.priors) == 2


def test_a_prior_alone_holds_its_nodes() -> None:
    rng, poses = np.random.default_rng(1), np.zeros((3, 3))
    poses[:, 0] = range(3)
    prior = random_prior(rng, [0, 1, 2], poses, anchored=True)
    smoother = IncrementalSmoother(EXACT)
    assert smoother.update(GraphUpdate(hidden=poses, priors=[prior])).status is Status.CONVERGED
    information = model(prior, smoother.poses, np.ones(3, np.bool_)).information
    np.testing.assert_allclose(
        smoother.covariance(2), np.linalg.inv(information)[6:, 6:], rtol=1e-4)
    loose = IncrementalSmoother(EXACT)
    assert loose.update(GraphUpdate(hidden=poses, priors=[
        random_prior(rng, [0, 1, 2], poses, anchored=False)])).status is Status.FAILED


def test_a_prior_on_a_node_that_is_not_there_is_refused() -> None:
    prior = random_prior(np.random.default_rng(2), [0, 9], np.zeros((2, 3)), anchored=True)
    graph = Graph()
    with pytest.raises(GraphUpdateError, match='hidden nodes'):
        graph.apply(GraphUpdate(hidden=np.zeros((2, 3)), priors=[prior]))
    assert graph.n_nodes == 0
